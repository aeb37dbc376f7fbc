"""The engine of long arms against the general one: one QP and one settled configuration, two ways to them."""

from __future__ import annotations

from dataclasses import replace

import modules
import numpy as np
import pytest
from arms import make_layout
from steps import answers, assert_same_answer, make_step, pressing

from vgtm_qp.arm.truss.build import lock_members
from vgtm_qp.bench.scenes import make_scenes
from vgtm_qp.methods import Resolver
from vgtm_qp.qp.answer import Accuracy, CurvePoint
from vgtm_qp.qp.long.chain import find_chain
from vgtm_qp.qp.long.chain_data import ChainData, PeriodValues
from vgtm_qp.qp.long.elimination import Elimination
from vgtm_qp.qp.long.select import chain_solver
from vgtm_qp.step.chain_engine import ChainEngine
from vgtm_qp.step.engine import GeneralEngine
from vgtm_qp.step.path import Path
from vgtm_qp.step.step import StepStatus
from vgtm_qp.step.target import QPInput

MODULES = {
    "octahedral": lambda: modules.octahedral(5),
    "hexapod": lambda: modules.hexapod(3),
    "longeron": lambda: modules.longeron(4),
    "tetrahedral-23": lambda: modules.tetrahedral(6, actuated=(2, 3)),
    "locked": lambda: lock_members(modules.octahedral(4), ["B2-1", "B4-3"]),
}
TRACKS = {"hexapod": ("position", "orientation"), "longeron": ("x", "pointing")}
SQUARE = ["octahedral", "longeron"]
ACCURACY = Accuracy(1e-10, 1e-8, np.inf)


@pytest.fixture(autouse=True)
def _without_a_compiler(monkeypatch):
    """The graphs themselves are what is compared."""
    monkeypatch.setenv("VGTM_CC", "none")


def engines(name, *, vertices=5, hard=False, track=None):
    layout, task = make_layout(
        MODULES[name](), track or TRACKS.get(name, ("position",)), vertices=vertices, hard_tracking=hard
    )
    kinematics = layout.arm.kinematics()
    solvers = [chain_solver(layout) for _ in range(2)]
    assert ChainEngine.serves(solvers[0])
    plain = GeneralEngine(layout, kinematics, task, solvers[0])
    return layout, kinematics, plain, ChainEngine(solvers[1], kinematics, task)


@pytest.mark.parametrize("base", [False, True])
@pytest.mark.parametrize(
    ("name", "vertices", "hard"),
    [(name, vertices, False) for name in MODULES for vertices in (5, 0)]
    + [(name, 7, True) for name in SQUARE],
)
def test_both_engines_give_one_answer(name, vertices, hard, base, rng):
    layout, kinematics, plain, chain = engines(name, vertices=vertices, hard=hard)
    X, Y, points, target, rows = make_step(layout, kinematics, rng, base=base)
    target = replace(target, lower=target.lower - 1.0, upper=target.upper + 1.0) if hard else target
    for motion, progress in ((True, 0.0), (False, 0.7), (True, 0.0)):
        goal = target.path.at(progress)
        at = Y if motion else X
        asked = QPInput(X, at, points, np.zeros(0), target, goal, progress, rows, motion)
        free = plain.solve(asked)
        pressed = asked if hard else asked._replace(rows=pressing(rows, free))
        both = answers((chain, plain), pressed)
        if both is None:
            continue
        first, second = both
        assert_same_answer(first, second)
        np.testing.assert_allclose(first.clearance_multipliers, second.clearance_multipliers, atol=1e-8)
        np.testing.assert_allclose(first.actuator_multipliers, second.actuator_multipliers, atol=1e-8)


@pytest.mark.parametrize("tight", [False, True])
@pytest.mark.parametrize(
    ("name", "vertices", "hard"),
    [(name, vertices, False) for name in MODULES for vertices in (5, 0)]
    + [(name, 7, True) for name in SQUARE],
)
def test_both_engines_settle_in_one_place(name, vertices, hard, tight, rng):
    """From the end of a motion; `tight` actuators end at a bound, or beyond it, and are brought back."""
    layout, kinematics, plain, chain = engines(name, vertices=vertices, hard=hard)
    arm, tip = layout.arm, layout.arm.end_effector
    points = np.linspace(0, 1, layout.vertices)[:, None] * [0.0, 0.0, arm.height]
    _, _, _, target, rows = make_step(layout, kinematics, rng)
    kinematics.evaluate(arm.home)
    home = kinematics.quantities[arm.actuators]
    reach = 0.004 if tight else 0.5
    target = replace(target, lower=home - reach, upper=home + reach)
    here = tip.position(arm.home)
    path = Path(
        np.array([0.0, 1.0]),
        np.stack([here, here + np.array([0.02, 0.01, -0.005])]),
        np.stack([kinematics.tip_rotation, kinematics.tip_rotation]),
    )
    target = replace(target, path=path)
    ends = []
    for engine in (plain, chain):
        home = arm.home
        asked = QPInput(home, home, points, np.zeros(0), target, path.at(0.0), 0.0, rows, True)
        answer = engine.solve(asked)
        goal = path.at(max(answer.progress, 0.0))
        curve = CurvePoint(points, np.zeros(0)).after(answer)
        settled = engine.settle(home + answer.nodes, curve, target, goal, ACCURACY)
        ends.append(None if settled is None else settled.closed)
    if ends[0] is None:
        assert tight or hard
        assert ends[1] is None
        return
    assert ends[1] is not None
    np.testing.assert_allclose(ends[1].q, ends[0].q, atol=1e-10)
    np.testing.assert_allclose(ends[1].quantities, ends[0].quantities, atol=1e-10)
    np.testing.assert_allclose(ends[1].tip_rotation, ends[0].tip_rotation, atol=1e-10)
    assert ends[1].error <= ACCURACY.member
    kinematics.evaluate(ends[1].q)
    np.testing.assert_allclose(kinematics.quantities, ends[1].quantities, atol=1e-14)
    fixed = ~arm.actuated
    np.testing.assert_allclose(kinematics.quantities[fixed], arm.home_quantities[fixed], atol=1e-10)
    strokes = kinematics.quantities[arm.actuators]
    assert (strokes >= target.lower - 1e-12).all()
    assert (strokes <= target.upper + 1e-12).all()
    if hard:
        on_curve = layout.curve_weights @ (points + answer.vertices)
        np.testing.assert_allclose(arm.stations.centres(ends[1].q)[layout.tracked], on_curve, atol=1e-10)


@pytest.mark.parametrize("name", ["octahedral", "hexapod", "tetrahedral-23"])
@pytest.mark.parametrize("reverse", [False, True])
def test_the_rows_of_a_period_are_derivatives(name, reverse, rng):
    """Lengths, gaps and angles against central differences of themselves, the Jacobians being taken at X too."""
    layout, kinematics, *_ = engines(name)
    chain, arm = find_chain(layout), layout.arm
    elimination = Elimination(chain)
    data = ChainData(chain, elimination.inputs.sizes, is_reversed=reverse)
    values = PeriodValues(chain, data)
    X, _, points, _, _ = make_step(layout, kinematics, rng)
    moved = rng.normal(size=X.shape)
    moved[arm.base] = 0.0

    def part(array, which, name):
        sizes = elimination.inputs.sizes[which]
        names = list(sizes)
        start = sum(sizes[before] for before in names[: names.index(name)])
        return array[:, start : start + sizes[name]].copy()

    def at(step):
        values.fill(X + step * moved, X + step * moved, points, None, motion=True)
        return values.lengths.copy(), part(data.tail, "tail", "gap"), part(data.tail, "tail", "tilt")

    h = 1e-5
    ahead, behind = at(h), at(-h)
    change = [(a - b) / (2 * h) for a, b in zip(ahead, behind, strict=True)]
    at(0.0)
    kinematics.evaluate(X)
    np.testing.assert_allclose(values.lengths, kinematics.quantities, atol=1e-14)
    members = np.arange(len(arm.quantity_names))
    nodes, rows = data.member_rows(members)
    np.testing.assert_allclose(np.einsum("rqc,rqc->r", rows, moved[nodes]), change[0], atol=1e-8)
    faces = moved[data.window][:, chain.station_places].reshape(len(data.stations), 9)
    centres = np.einsum("f,kfc->kc", chain.station_weights[0], faces.reshape(-1, 3, 3))
    np.testing.assert_allclose(change[1].reshape(-1, 3), centres, atol=1e-8)
    turns = part(data.head, "head", "tangent_face").reshape(-1, 2, 9)
    np.testing.assert_allclose(np.einsum("kaf,kf->ka", turns, faces), change[2].reshape(-1, 2), atol=1e-8)


def test_steps_that_close_parts_of_gaps_are_not_served():
    """A chain's rows have whole gaps."""
    layout, _ = make_layout(MODULES["octahedral"](), ("position",), vertices=7, hard_tracking=True)
    assert ChainEngine.serves(chain_solver(layout))
    assert not ChainEngine.serves(chain_solver(layout.giving_way()))


@pytest.mark.parametrize("tracking", ["elastic", "hard"])
def test_whole_maneuvers_are_the_same(tracking, monkeypatch):
    (scene,) = make_scenes(["cubes"], [24], [tracking])
    ends = []
    for plain in (False, True):
        if plain:
            monkeypatch.setattr(ChainEngine, "serves", staticmethod(lambda _: False))
        resolver = Resolver(scene.problem)
        assert isinstance(resolver.setup.engine, GeneralEngine if plain else ChainEngine)
        tip = resolver.tip()[0]
        for k in range(1, 6):
            step = resolver.step(position=tip + k * np.array([0.03, 0.0, -0.001]))
            assert step.status is StepStatus.REACHED
        ends.append(resolver.state)
    np.testing.assert_allclose(ends[0].nodes, ends[1].nodes, atol=1e-10)
    np.testing.assert_allclose(ends[0].control_vertices, ends[1].control_vertices, atol=1e-10)
