"""The step in one call of C takes the same steps as an attempt, and accepts nothing that an attempt would refuse."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from arms import arm_problem
from recorded_states import CASES
from steps import drives_nothing, solved

import vgtm_qp as vq
from vgtm_qp.compiled import Kernel, compiler, finish_compiling
from vgtm_qp.native import building
from vgtm_qp.problem.obstacle import Sphere
from vgtm_qp.qp import fused
from vgtm_qp.qp.residual import InfeasibleStepError
from vgtm_qp.rotation import rotation_from_vector, vector_from_rotation
from vgtm_qp.step.chain_engine import ChainEngine
from vgtm_qp.step.driver import NO_CONVERGENCE, Begun, Driver
from vgtm_qp.step.path import Path
from vgtm_qp.step.setup import Setup
from vgtm_qp.study.scenes import random_scene
from vgtm_qp.study.serial_scenes import random_serial_scene

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")

SAME = 1e-10
"""Greatest difference of two steps, m.

That of solvers that only come near is a hundred times as large, and so is that of elastic tips: a great penalty and a
small curvature cost DAQP some digits.
"""

NAMES = [name for name, case in CASES.items() if case.load().method.name == "qp"]


def answers_of(patch: pytest.MonkeyPatch, of: Callable[[object], Any]) -> list[Any]:
    """What the answer of each step that is offered in one call is, from now on."""
    assert building().finish() is not None
    found, take = list[Any](), Driver.take

    def kept(self, *asked):
        taken = take(self, *asked)
        found.append(of(taken))
        return taken

    patch.setattr(Driver, "take", kept)
    return found


@pytest.fixture
def driven(monkeypatch) -> list[bool]:
    """Whether each of the steps that was offered so far was taken in one call."""
    return answers_of(monkeypatch, lambda answer: isinstance(answer, vq.Step) and answer.moved)


@pytest.fixture
def answers(monkeypatch) -> list[object]:
    """The answer of each of the steps that was offered so far."""
    return answers_of(monkeypatch, lambda answer: answer)


def without(problem: vq.Problem) -> vq.Resolver:
    """A resolver whose steps are attempts alone."""
    with pytest.MonkeyPatch.context() as patch:
        drives_nothing(patch)
        return vq.Resolver(problem)


def goals(resolver: vq.Resolver, rng: np.random.Generator, count: int) -> Iterator[dict[str, object]]:
    """Goals near the tip; far ones among them, so that rows press."""
    for _ in range(count):
        position, rotation = resolver.tip()
        size = rng.choice([0.005, 0.03, 0.3], p=[0.3, 0.5, 0.2]) * resolver.setup.arm.unit
        goal: dict[str, object] = {}
        if len(resolver.setup.task.axes):
            goal["position"] = position + size * rng.normal(size=3)
        if resolver.setup.task.turns == "pointing":
            goal["pointing"] = rotation[:, 2] + 0.05 * rng.normal(size=3)
        yield goal


def assert_same(one: vq.Step, other: vq.Step, tolerance: float) -> None:
    assert one.status == other.status
    assert one.progress == pytest.approx(other.progress, abs=1e3 * tolerance)
    for name in (
        "time",
        "q",
        "nodes",
        "control_vertices",
        "torsion",
        "quantities",
        "motion",
        "duration",
        "late",
    ):
        np.testing.assert_allclose(
            getattr(one.state, name), getattr(other.state, name), rtol=0.0, atol=tolerance, err_msg=name
        )
    rates = one.state.duration * (one.state.rates - other.state.rates)
    np.testing.assert_allclose(rates, 0.0, atol=tolerance)
    assert one.gave_way == other.gave_way
    assert one.gap == pytest.approx(other.gap, abs=tolerance, nan_ok=True)
    # Which rows press is not unique where these depend on one another.
    assert bool(one.active) == bool(other.active)


def compare(problem: vq.Problem, rng: np.random.Generator, count: int, tolerance: float) -> None:
    """Compare the steps of one QP; how further QPs converge depends on the last digits of the first one."""
    one, other = vq.Resolver(problem), without(problem)
    brakes = bool(np.isfinite(one.setup.arm.acceleration).any())
    for goal in goals(one, rng, count):
        other.state = one.state
        before = one.state
        found, expected = one.step(**goal), other.step(**goal)
        if brakes and not found.status == expected.status == vq.StepStatus.REACHED:
            # The other arm does not know how this one was to brake.
            break
        if found.qps == expected.qps == 1:
            assert_same(found, expected, tolerance)
        assert (one.state is before) == (not found.moved)


@pytest.mark.dear
@pytest.mark.parametrize("name", NAMES)
def test_it_takes_the_steps_of_an_attempt(name, driven, rng):
    problem = CASES[name].load()
    iterative = problem.method.solver != "daqp"
    compare(problem, rng, 10, (100.0 if iterative else 1.0) * SAME)


def test_it_takes_the_steps_of_an_attempt_beside_a_cylinder(driven):
    """FCL's points of a rim turned with rounding: steps differed by 1e-8 m."""
    problem = CASES["tetrahedral 4, far goal"].load()
    one, other = vq.Resolver(problem), without(problem)
    supplied = 0
    for position in one.tip()[0] + np.linspace(0.0, 1.0, 40)[:, None] * [-0.2, 0.8, -1.1]:
        other.state = one.state
        found, expected = one.step(position=position), other.step(position=position)
        if found.qps == expected.qps == 1:
            supplied += found.fcl_rows
            assert_same(found, expected, SAME)
    assert supplied
    assert any(driven)


def as_it_is(problem: vq.Problem, rng: np.random.Generator) -> vq.Problem:
    return problem


def on_a_curve_with_torsion(problem: vq.Problem, rng: np.random.Generator) -> vq.Problem:
    return problem.replace({"curve.torsion_vertices": 1, "curve.nodes": "arc-length"})


def on_a_moving_base(problem: vq.Problem, rng: np.random.Generator) -> vq.Problem:
    """The problem on a base that moves and turns, and then rests."""
    setup, table = vq.Resolver(problem).setup, "arm" if problem.truss is None else "truss"
    poses = [
        {
            "time": steps * setup.dt,
            "position": (0.02 * setup.arm.unit * rng.normal(size=3)).tolist(),
            "rotation_vector": (0.02 * rng.normal(size=3)).tolist(),
        }
        for steps in (2.5, 6.0)
    ]
    return problem.replace({f"{table}.base_motion": poses})


def among_moving_obstacles(problem: vq.Problem, rng: np.random.Generator) -> vq.Problem:
    """The problem with obstacles that move, each on its own way."""
    setup = vq.Resolver(problem).setup
    size = 0.03 * setup.arm.unit / setup.dt
    moving = [
        {**table, "velocity": (size * rng.normal(size=3)).tolist()} for table in problem.to_dict()["obstacle"]
    ]
    return problem.replace({"obstacle": moving})


def among_these_on_a_moving_base(problem: vq.Problem, rng: np.random.Generator) -> vq.Problem:
    return on_a_moving_base(among_moving_obstacles(problem, rng), rng)


def with_an_elastic_tip(problem: vq.Problem, rng: np.random.Generator) -> vq.Problem:
    return problem.replace({"end_effector.mode": "elastic"})


def with_an_elastic_tip_among_what_moves(problem: vq.Problem, rng: np.random.Generator) -> vq.Problem:
    return among_these_on_a_moving_base(with_an_elastic_tip(problem, rng), rng)


def with_a_step_limit(problem: vq.Problem, rng: np.random.Generator) -> vq.Problem:
    return problem.replace({"method.step_limit": 0.02 * vq.Resolver(problem).setup.arm.unit})


def with_a_step_limit_among_what_moves(problem: vq.Problem, rng: np.random.Generator) -> vq.Problem:
    return with_a_step_limit(among_these_on_a_moving_base(problem, rng), rng)


BUNDLED = {
    as_it_is: ["snake_past_a_cube", "twelve_joints_past_a_crate"],
    on_a_curve_with_torsion: ["snake_past_a_cube"],
    on_a_moving_base: [
        "five_bay_two_cubes",
        "snake_past_a_cube",
        "twelve_joints_past_a_crate",
        "hexapod_past_a_cube",
        "beta_spline_past_a_cube",
    ],
    among_moving_obstacles: ["five_bay_two_cubes", "snake_past_a_cube", "twelve_joints_past_a_crate"],
    with_an_elastic_tip: [
        "five_bay_two_cubes",
        "five_bay_two_cubes_pointing",
        "hexapod_past_a_cube",
        "tetrahedral_past_a_cube",
        "longeron_past_a_cube",
        "offset_joints_past_a_cube",
        "beta_spline_past_a_cube",
        "snake_past_a_cube",
        "twelve_joints_past_a_crate",
    ],
    with_an_elastic_tip_among_what_moves: ["five_bay_two_cubes", "snake_past_a_cube"],
    with_a_step_limit: [
        "five_bay_two_cubes_pointing",
        "tetrahedral_past_a_cube",
        "offset_joints_past_a_cube",
        "twelve_joints_past_a_crate",
    ],
    with_a_step_limit_among_what_moves: ["five_bay_two_cubes", "twelve_joints_past_a_crate"],
}
"""Names of problems, by how they are changed."""


@pytest.mark.parametrize(
    ("change", "name"), [(change, name) for change, names in BUNDLED.items() for name in names]
)
def test_it_takes_the_steps_of_bundled_problems(change, name, driven, rng):
    problem = change(vq.load_problem(name), rng)
    compare(problem, rng, 10, (100.0 if problem.end_effector.mode == "elastic" else 1.0) * SAME)
    assert any(driven)


@pytest.mark.parametrize(
    ("name", "mode"),
    [
        ("five_bay_two_cubes_pointing", "elastic"),
        ("five_bay_two_cubes_pointing", "hard"),
        ("hexapod_past_a_cube", "elastic"),
        ("twelve_joints_past_a_crate", "elastic"),
    ],
)
def test_an_elastic_tip_is_left_behind_by_as_much_as_in_an_attempt(name, mode, driven, rng):
    """Goals further than the rates allow, along and against every coordinate that is tracked."""
    problem = with_an_elastic_tip(vq.load_problem(name), rng).replace({"method.tracking_mode": mode})
    one, other = vq.Resolver(problem), without(problem)
    arm, task, late = one.setup.arm, one.setup.task, 0
    for _ in range(8):
        other.state = one.state
        position, rotation = one.tip()
        goal = {"position": position + rng.choice([0.1, 0.5]) * arm.unit * rng.normal(size=3)}
        if task.turns == "pointing":
            goal["pointing"] = rotation[:, 2] + rng.choice([0.05, 0.5]) * rng.normal(size=3)
        found, expected = one.step(**goal, dt=0.02), other.step(**goal, dt=0.02)
        if not (found.qps == expected.qps and found.moved and expected.moved):
            continue
        assert_same(found, expected, 100.0 * SAME)
        slacks = found.solution.tip_slack, expected.solution.tip_slack
        assert slacks[0] == pytest.approx(slacks[1], abs=1e-8)
        late += max(slacks) > 1e-3 * arm.unit
    assert late
    assert any(driven)


@pytest.mark.dear
@pytest.mark.parametrize("number", range(12))
@pytest.mark.parametrize(
    ("change", "of_serial_arms"),
    [
        (as_it_is, as_it_is),
        (on_a_moving_base, on_a_moving_base),
        (among_moving_obstacles, among_these_on_a_moving_base),
    ],
)
def test_it_takes_the_steps_of_random_arms(change, of_serial_arms, number, driven, rng):
    seed = int(rng.integers(2**31))
    compare(change(random_scene(seed, number, steps=10).problem, rng), rng, 8, SAME)
    # Some of these tips cannot start in every direction.
    with contextlib.suppress(vq.ProblemError):
        compare(of_serial_arms(random_serial_scene(seed, number, steps=10), rng), rng, 8, SAME)


POSE = ["position", "pointing", "orientation"]
CURVES = [
    ("octahedral", 4, {"nodes": "arc-length"}, {}),
    ("hexapod", 3, {"torsion_vertices": 1}, {}),
    (
        "hexapod",
        3,
        {"nodes": "arc-length", "torsion_vertices": 2},
        {"weights": {"spacing": 0.4, "roll": 0.2}},
    ),
    ("longeron", 4, {"family": "b-spline", "torsion_vertices": 1}, {"weights": {"spacing": 1.0}}),
    (
        "double-octahedral",
        3,
        {"family": "beta-spline", "bias": 1.2, "nodes": "arc-length"},
        {"hard": ["position"]},
    ),
    ("tetrahedral", 3, {"torsion_vertices": 1}, {"hard": POSE}),
    ("hexapod", 3, {"family": "b-spline"}, {"hard": POSE}),
    ("hexapod", 3, {"nodes": "arc-length"}, {"hard": ["position", "pointing"]}),
    ("octahedral", 4, {"nodes": "arc-length"}, {"goals": True}),
]


@pytest.mark.dear
@pytest.mark.parametrize("solver", ["daqp", "piqp"])
@pytest.mark.parametrize(("module", "bays", "curve", "method"), CURVES, ids=str)
def test_it_takes_the_steps_on_curves_that_tables_do_not_describe(
    module, bays, curve, method, solver, driven, rng
):
    method, curve = {"solver": solver, **method}, {"control_vertices": 5, **curve}
    hard = method.pop("hard", None)
    method |= {"tracking_mode": "hard", "hard_coordinates": hard} if hard else {"tracking_mode": "elastic"}
    if method.pop("goals", False):
        curve["control_vertex_goals"] = [{"index": 3, "position": [0.4, 0.1, 1.8]}]
    truss = {"module": module, "stroke": None}
    problem = arm_problem((0.5, 0.2, 2.5), bays=bays, truss=truss, curve=curve, method=method)
    assert vq.Resolver(problem).setup.layout.general is not None
    driven.clear()
    compare(problem, rng, 10, (100.0 if solver == "piqp" else 1.0) * SAME)
    assert any(driven)


@pytest.mark.parametrize("name", ["hexapod_past_a_cube", "beta_spline_past_a_cube"])
def test_most_steps_on_such_curves_are_usual(name, driven):
    maneuver = vq.solve(vq.load_problem(name))
    assert maneuver.certificate.ok
    assert np.mean(driven) > 0.7


def test_a_curve_with_nearly_a_cusp_is_left_to_attempts(driven):
    """Its control vertices are set by hand: the compiled code denies what it finds, and the steps are right."""
    problem = arm_problem(
        bays=4, curve={"control_vertices": 5, "nodes": "arc-length"}, method={"tracking_mode": "elastic"}
    )
    one, other = vq.Resolver(problem), without(problem)
    vertices = one.state.control_vertices.copy()
    vertices[:, 2] = vertices[0, 2] + (vertices[4, 2] - vertices[0, 2]) * np.array(
        [0.0, 0.75, 0.5, 0.25, 1.0]
    )
    vertices[3, 0] += 1e-3
    for resolver in (one, other):
        resolver.state = replace(resolver.state, control_vertices=vertices)
    driven.clear()
    goal = one.tip()[0] + np.array([0.01, 0.0, -0.01])
    found, expected = one.step(position=goal), other.step(position=goal)
    assert found.moved
    assert driven
    assert not any(driven)
    assert found.qps == expected.qps
    np.testing.assert_allclose(found.state.q, expected.state.q, atol=1e-9)


POINTING = {"end_effector": {"track": ["position", "pointing"]}, "waypoint": {"pointing": [0, 0, 1]}}
ORIENTED = {
    "end_effector": {"track": ["position", "orientation"]},
    "waypoint": {"rotation_vector": [0, 0, 0]},
}
LONG = [
    ("octahedral", "elastic", {}),
    ("octahedral", "exact", {}),
    ("octahedral", "hard", {}),
    ("octahedral", "elastic", POINTING),
    ("hexapod", "elastic", ORIENTED),
    ("hexapod", "elastic", {}),
    ("tetrahedral", "elastic", {}),
    ("longeron", "elastic", {}),
]


@pytest.mark.dear
@pytest.mark.parametrize("distance", ["fcl", "exact"])
@pytest.mark.parametrize(("module", "mode", "asked"), LONG, ids=str)
def test_it_takes_the_steps_of_long_arms_among_obstacles(module, mode, asked, distance, driven, rng):
    truss = {"module": module, "stroke": [0.6, 1.5] if module == "tetrahedral" else None}
    more = {"curve": {"control_vertices": 6}, "method": {"tracking_mode": mode}}
    problem = arm_problem(bays=26, truss=truss, **more, **asked)
    height = vq.Resolver(problem).tip()[0][2]
    obstacles = [
        {"shape": "box", "name": "cube", "center": [1.22, 0.1, 0.97 * height], "size": [0.8, 0.8, 0.8]},
        {"shape": "sphere", "name": "ball", "center": [-0.3, 1.25, 0.93 * height], "radius": 0.5},
        {
            "shape": "cylinder",
            "name": "post",
            "center": [-1.0, -0.8, 0.97 * height],
            "radius": 0.4,
            "height": 2.0,
        },
    ]
    clearance = {"clearance.safe": 0.05, "clearance.influence": 0.4, "clearance.distance": distance}
    problem = problem.replace({"obstacle": obstacles, **clearance})
    # Only the kernels of a resolver that lives are compiled.
    resolver = vq.Resolver(problem)
    assert isinstance(resolver.setup.engine, ChainEngine)
    assert finish_compiling()
    driven.clear()
    compare(problem, rng, 12, SAME)
    assert any(driven)


def problem_of_two_qps(name: str, **changes: object) -> vq.Problem:
    """A problem in which steps towards far goals need further QPs; contacts by closed forms, which are exact."""
    problem = CASES[name].load() if name in CASES else vq.load_problem(name)
    return problem.replace({"clearance.distance": "exact", **changes})


FURTHER = {
    "octahedral": ("octahedral 5", {"method.tracking_mode": "exact"}),
    "octahedral, elastic": ("octahedral 4, far goal", {}),
    "double-octahedral": ("double-octahedral 4", {}),
    "hexapod": ("hexapod 5, no curve", {}),
    "hexapod, elastic": ("loop hexapod 4, vertex goals", {"method.tracking_mode": "elastic"}),
    "longeron": ("longeron_past_a_cube", {"method.tracking_mode": "elastic"}),
    "longeron, hard tip": ("longeron 5, hard tip", {}),
    "tetrahedral": ("tetrahedral 4, hard tracking", {}),
    "pointing": ("octahedral 6, pointing", {}),
    "two cubes": ("five_bay_two_cubes_pointing", {}),
    "two cubes, elastic": ("five_bay_two_cubes_pointing", {"method.tracking_mode": "elastic"}),
    "offset joints": ("octahedral 5, offset joints", {}),
    "offset joints, elastic": ("offset_joints_past_a_cube", {"method.tracking_mode": "elastic"}),
    "serial": ("snake_past_a_cube", {}),
    "serial, pressed": ("twelve_joints_past_a_crate", {}),
    "torsion": ("hexapod_past_a_cube", {}),
    "torsion, elastic": ("hexapod_past_a_cube", {"method.tracking_mode": "elastic"}),
    "arc length": ("beta_spline_past_a_cube", {}),
    "arc length, elastic": ("beta_spline_past_a_cube", {"method.tracking_mode": "elastic"}),
    "arc length and torsion, serial": (
        "snake_past_a_cube",
        {"curve.torsion_vertices": 1, "curve.nodes": "arc-length"},
    ),
}
"""Problems by name, and their changes."""


def far_goals(resolver: vq.Resolver, rng: np.random.Generator, count: int) -> Iterator[dict[str, object]]:
    """Goals so far from the tip that the answers of their first QPs often have to be corrected."""
    unit = resolver.setup.arm.unit
    for _ in range(count):
        position, rotation = resolver.tip()
        goal: dict[str, object] = {"position": position + rng.choice([0.2, 0.5]) * unit * rng.normal(size=3)}
        if resolver.setup.task.turns == "pointing":
            goal["pointing"] = rotation[:, 2] + 0.2 * rng.normal(size=3)
        yield goal


@pytest.mark.dear
@pytest.mark.parametrize("name", FURTHER)
def test_further_qps_are_those_of_an_attempt(name, driven, monkeypatch, rng):
    problem = problem_of_two_qps(FURTHER[name][0], **FURTHER[name][1])
    one, other = vq.Resolver(problem), vq.Resolver(problem)
    found, apart, corrected = [], [], Driver.corrected

    def told(self, state, target, begun, code):
        taken = corrected(self, state, target, begun, code)
        if not isinstance(taken, Begun):
            assert taken.solution is begun.first.solution
            assert taken.rows is begun.rows
        return taken

    monkeypatch.setattr(Driver, "corrected", told)
    for goal in far_goals(one, rng, 25):
        other.state = one.state
        with monkeypatch.context() as patch:
            # The first QP is the same; then an attempt goes on.
            patch.setattr(Driver, "corrected", lambda self, state, target, begun, code: begun)
            expected = other.step(**goal)
        step = one.step(**goal)
        assert (step.status, step.qps, step.reason) == (expected.status, expected.qps, expected.reason)
        # Settling that ends one iteration sooner or later by rounding moves a state by some 1e-11 m, which may grow.
        assert_same(step, expected, 1e3 * SAME)
        apart.append(np.abs(step.state.q - expected.state.q).max())
        found.append(step.qps)
    assert max(found) > 1
    assert np.mean(np.array(apart) < SAME) > 0.8


def ball_beside(setup: Setup, body: int) -> tuple[dict[str, object], np.ndarray]:
    """A ball that is 5 mm from the clearance of a body at home, and the direction from the body to it."""
    ends = setup.arm.bodies.some(setup.arm.home)[body]
    middle, aside = ends.mean(axis=0), np.cross(ends[1] - ends[0], [0.0, -1.0, 0.0])
    aside *= np.copysign(1.0 / np.linalg.norm(aside), middle[0] * aside[0])
    way = setup.arm.bodies.radius[body] + setup.safe + 0.005 + 0.1
    return {
        "name": "ball",
        "shape": "sphere",
        "radius": 0.1,
        "center": (middle + way * aside).tolist(),
    }, aside


@pytest.mark.parametrize(
    ("name", "body"), [("five_bay_free", 0), ("moving_base", 4), ("snake_past_a_cube", 2)]
)
def test_a_body_that_the_base_pushes_onto_a_ball_gives_way(name, body, driven):
    problem = vq.load_problem(name)
    setup, table = vq.Resolver(problem).setup, "arm" if problem.truss is None else "truss"
    ball, aside = ball_beside(setup, body)
    motion = [{"time": 20 * setup.dt, "position": (0.04 * aside).tolist()}]
    problem = problem.replace({"obstacle": [ball], f"{table}.base_motion": motion})
    one, other = vq.Resolver(problem), without(problem)
    pressed = 0
    driven.clear()
    for _ in range(12):
        other.state = before = one.state
        found, expected = one.step(position=one.tip()[0]), other.step(position=one.tip()[0])
        assert found.qps == expected.qps == 1
        assert_same(found, expected, SAME)
        # What the base does to other nodes counts once.
        moved = np.where(setup.arm.base[:, None], 0.0, found.state.nodes - before.nodes)
        for rows, solution in ((found.rows, found.solution), (expected.rows, expected.solution)):
            value = np.einsum("rsc,rsc->r", rows.coefficients, moved[rows.nodes])
            presses = solution.clearance_multipliers > 1e-9
            np.testing.assert_allclose(value[presses], rows.lower[presses], atol=2e-4)
        pressed += presses.any()
    assert pressed >= 3
    assert all(driven)


@pytest.mark.parametrize("name", ["five_bay_free", "snake_past_a_cube", "twelve_joints_past_a_crate"])
@pytest.mark.parametrize("distance", ["fcl", "exact"])
def test_an_arm_gives_way_to_a_ball_that_pushes_it(name, distance, driven):
    problem = vq.load_problem(name).replace({"clearance.distance": distance})
    setup = vq.Resolver(problem).setup
    ball, aside = ball_beside(setup, len(setup.arm.bodies) // 2)
    ball["velocity"] = (-0.01 * setup.arm.unit / setup.dt * aside).tolist()
    problem = problem.replace({"obstacle": [ball]})
    one, other = vq.Resolver(problem), without(problem)
    pressed, goal = 0, one.tip()[0]
    driven.clear()
    for _ in range(12):
        other.state = one.state
        found, expected = one.step(position=goal), other.step(position=goal)
        assert found.moved
        if found.qps == expected.qps == 1:
            assert_same(found, expected, SAME)
        asked = found.fcl_rows, found.exact_rows
        assert not asked[distance == "fcl"]
        pressed += any(active.startswith("clearance") for active in found.blocked_by)
    assert pressed >= 3
    assert np.mean(driven) > 0.8


@pytest.mark.parametrize("until", ["through", "into"])
@pytest.mark.parametrize("name", ["five_bay_free", "snake_past_a_cube"])
def test_an_obstacle_that_comes_into_the_arm_between_two_states_stops_it(name, until, driven):
    problem = vq.load_problem(name)
    setup = vq.Resolver(problem).setup
    middle = setup.arm.bodies.some(setup.arm.home)[len(setup.arm.bodies) // 2].mean(axis=0)
    far = 4.0 * setup.arm.height * np.array([0.0, 1.0, 0.0])
    steps = 2.5 if until == "through" else 3.0
    bullet = {"name": "bullet", "shape": "sphere", "radius": 0.8, "center": (middle + steps * far).tolist()}
    bullet["velocity"] = (-far / setup.dt).tolist()
    resolver = vq.Resolver(problem.replace({"obstacle": [bullet]}))
    goal = resolver.tip()[0]
    driven.clear()
    for _ in range(2):
        assert resolver.step(position=goal).status is vq.StepStatus.REACHED
    assert all(driven)
    driven.clear()
    before = resolver.state
    assert not resolver.step(position=goal).moved
    assert resolver.state is before
    assert driven
    assert not any(driven)


@pytest.mark.parametrize("name", ["five_bay_two_cubes", "moving_base"])
@pytest.mark.parametrize("velocity", [[0.0, 0.0, 0.0], [0.01, 0.005, -0.01]], ids=["rest", "move"])
def test_most_steps_are_usual(name, velocity, driven):
    problem = vq.load_problem(name)
    obstacles = [{**table, "velocity": velocity} for table in problem.to_dict()["obstacle"]]
    maneuver = vq.solve(problem.replace({"obstacle": obstacles}))
    assert maneuver.certificate.ok
    assert len(driven) >= 20
    assert np.mean(driven) > 0.9


def test_most_steps_of_further_qps_are_taken_by_calls(answers):
    vq.solve(vq.load_problem("five_bay_two_cubes_pointing"))
    steps = [one for one in answers if isinstance(one, vq.Step)]
    taken = [one for one in steps if one.moved and one.qps > 1]
    left = [one for one in answers if isinstance(one, Begun)]
    further = [*taken, *left, *(one for one in steps if one.reason == NO_CONVERGENCE)]
    assert sum(one.qps == 2 for one in taken) >= 10
    assert len(left) < 0.1 * len(further)


@pytest.mark.parametrize("name", ["octahedral", "offset joints"])
def test_a_qp_of_which_a_call_says_so_has_no_answer(name, answers):
    resolver = vq.Resolver(problem_of_two_qps(FURTHER[name][0]))
    # Far out and against the cubes stations cannot stay on the curve.
    ways = np.random.default_rng(1).normal(size=(4, 3))
    for way in np.repeat(ways / np.linalg.norm(ways, axis=1, keepdims=True), 15, axis=0):
        resolver.step(position=resolver.tip()[0] + 0.05 * way)
    denied = [one for one in answers if isinstance(one, vq.Step) and one.failure]
    assert len(denied) > 3
    for one in denied[:: len(denied) // 3]:
        with pytest.raises((InfeasibleStepError, AssertionError)):
            solved(one.failed_qp)


def lying(make, change):
    """A function like `make`, whose results are what `change` makes of those."""

    def made(layout):
        honest = make(layout)
        inputs = honest.function.mx_in()
        results = [ca.densify(result) for result in change(*inputs[:3], *honest.function(*inputs))]
        function = ca.Function(f"lying_{honest.function.name()}", inputs, results)
        return replace(honest, function=function)

    return made


def moved(node):
    way = np.zeros((3, 18))
    way[:, node] = 1e-6

    def change(q, lower, upper, closer, quantities, errors):
        return (
            closer + ca.DM(way),
            quantities,
            ca.if_else(ca.norm_inf(ca.vec(closer - q)) < 1e-5, 0.0, errors),
        )

    return change


LIES = {
    "closed at once": (
        "closing_function",
        lambda q, lower, upper, closer, lengths, _: (closer, lengths, ca.DM(2, 1)),
    ),
    "other lengths": (
        "closing_function",
        lambda q, lower, upper, closer, lengths, errors: (closer, lengths + 1e-6, errors),
    ),
    "the base moved": ("closing_function", moved(0)),
    "a node moved": ("closing_function", moved(9)),
    "at the goal": ("missing_function", lambda *all: (0.0 * all[3], *all[4:])),
}


@pytest.mark.parametrize("track", [["pointing"], ["orientation"]])
def test_a_direction_that_is_not_the_goals_is_refused(track, driven, monkeypatch):
    problem = vq.load_problem("hexapod_past_a_cube").to_dict()
    problem["end_effector"]["track"] = track
    problem["method"] = {"tracking": "none"}
    del problem["curve"]
    key = {"pointing": "pointing", "orientation": "rotation_vector"}[track[0]]
    problem["maneuver"]["waypoint"] = [{"time": 1.0, key: [0.1, 0.0, 1.0]}]
    problem["obstacle"] = []
    rotation = vq.Resolver(vq.Problem.from_dict(problem)).tip()[1]
    turned = rotation_from_vector([0.04, -0.03, 0.05]) @ rotation
    goals = {
        "pointing": {"pointing": turned[:, 2]},
        "orientation": {"rotation_vector": vector_from_rotation(turned)},
    }
    goal = goals[track[0]]
    honest = vq.Resolver(vq.Problem.from_dict(problem))
    driven.clear()
    assert honest.step(**goal, dt=1.0).status is vq.StepStatus.REACHED
    assert all(driven)
    monkeypatch.setattr(fused, "missing_function", lying(fused.missing_function, LIES["at the goal"][1]))
    resolver = vq.Resolver(vq.Problem.from_dict(problem))
    driven.clear()
    assert resolver.step(**goal, dt=1.0).status is vq.StepStatus.BLOCKED
    assert driven
    assert not any(driven)


@pytest.mark.parametrize(
    "motion", [[], [{"time": 5.0, "position": [0.02, 0.01, 0.0]}]], ids=["rests", "moves"]
)
@pytest.mark.parametrize("lie", LIES)
def test_a_state_that_is_not_what_it_is_said_to_be_is_refused(lie, motion, driven, monkeypatch):
    name, change = LIES[lie]
    monkeypatch.setattr(fused, name, lying(getattr(fused, name), change))
    changes = {"method.tracking_mode": "elastic", "truss.base_motion": motion}
    resolver = vq.Resolver(vq.load_problem("five_bay_free").replace(changes))
    # At home nothing has to be settled.
    driven.clear()
    before = resolver.state
    step = resolver.step(position=resolver.tip()[0] + np.array([0.15, 0.0, -0.05]))
    assert step.status is vq.StepStatus.BLOCKED
    assert resolver.state is before
    assert driven
    assert not any(driven)


@pytest.mark.parametrize(
    "name",
    [
        "five_bay_free",
        "tetrahedral_past_a_cube",
        "offset_joints_past_a_cube",
        "snake_past_a_cube",
        "station_arm_past_a_module",
    ],
)
def test_what_c_knows_of_an_arm_is_what_the_arm_says(name, rng):
    arm = vq.Resolver(vq.load_problem(name)).setup.arm
    known = arm.arithmetic()
    moves = np.setdiff1d(np.arange(arm.home_configuration.size), known.based)
    q, then = (arm.home_configuration.copy() for _ in range(2))
    for configuration, size in ((q, 0.05), (then, 0.06)):
        configuration.reshape(-1)[moves] += size * rng.normal(size=len(moves))
    if known.place is None:
        np.testing.assert_array_equal(arm.nodes(q), q)
    else:
        known.place.inputs[0][:] = q
        known.place()
        np.testing.assert_allclose(known.place.outputs[0].reshape(-1, 3), arm.nodes(q), atol=1e-14)
    bound = 0.0
    if known.bend is not None:
        known.bend.inputs[0][:], known.bend.inputs[1][:] = q.reshape(-1), then.reshape(-1)
        known.bend()
        bound = 0.25 * known.bend.outputs[0][:2].max()
    assert bound == pytest.approx(arm.deviation(q, then), abs=1e-15)
    points = arm.nodes(q)
    if known.ends is not None:
        known.ends.place.inputs[0][:] = q.reshape(-1)
        known.ends.place()
        points = known.ends.place.outputs[0].reshape(-1, 3)
    np.testing.assert_allclose(points, arm.points(q), atol=1e-14)
    if known.distances:
        values = np.linalg.norm(points[known.first] - points[known.last], axis=1)
    else:
        values = q[known.first] - known.multiplier * q[known.last]
    np.testing.assert_allclose(values, arm.measured(q), atol=1e-14)
    moved = np.abs(then - q)
    travel = moved.max() if known.levers is None else moved @ known.levers
    assert travel == pytest.approx(arm.travel(then - q))


@pytest.mark.parametrize("name", ["octahedral 5, offset joints", "hexapod 4, offset joints"])
def test_the_rows_of_offset_joints_are_those_of_an_attempt(name, driven, rng):
    problem = CASES[name].load().replace({"clearance.distance": "exact", "clearance.influence": 0.6})
    one, other = vq.Resolver(problem), without(problem)
    one.step(position=one.tip()[0])
    counted = 0
    for goal in goals(one, rng, 100):
        if counted == 10:
            break
        other.state = one.state
        found, expected = one.step(**goal), other.step(**goal)
        if found.qps == expected.qps == 1 and found.moved and len(found.rows):
            counted += 1
            first, second = (
                sorted(range(len(rows)), key=lambda k, rows=rows: (rows.name(k), round(rows.lower[k], 9)))
                for rows in (found.rows, expected.rows)
            )
            assert [found.rows.name(k) for k in first] == [expected.rows.name(k) for k in second]
            for part in ("nodes", "coefficients", "lower"):
                pair = getattr(found.rows, part)[first], getattr(expected.rows, part)[second]
                np.testing.assert_allclose(*pair, atol=1e-12)
    assert counted
    assert np.mean(driven) > 0.5


@pytest.mark.parametrize(("start", "end"), [(0, 1), (1, 2), (2, 1), (1, 0), (0.5, 1.5), (2, 2.5), (1, 0.5)])
def test_the_tip_is_on_its_path_whichever_way_it_goes(start, end, driven):
    resolver = vq.Resolver(vq.load_problem("five_bay_free"))
    for _ in range(4):
        resolver.step(position=resolver.tip()[0])
    tip, rotation = resolver.tip()
    places = tip + np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [0.02, 0.02, -0.01]])
    path = Path(np.array([0.0, 1.0, 2.0]), places, np.stack([rotation] * 3))
    resolver.follow(Path.straight(tip, rotation, path.at(start).position, rotation, None), 0.0, 1.0)
    driven.clear()
    step = resolver.follow(path, start, end)
    reached = path.at(start + step.progress * (end - start)).position
    assert step.moved
    np.testing.assert_allclose(resolver.tip()[0], reached, atol=1e-8)
    assert driven == [(start, end) in ((0, 1), (1, 2), (2, 1))]


def test_rows_of_another_scene_are_not_asked_about(rng):
    resolver = vq.Resolver(vq.load_problem("five_bay_two_cubes"))
    for k in range(60):
        if k % 10 == 0:
            for name in [one.name for one in resolver.obstacles if one.name.startswith("ball")]:
                resolver.remove_obstacle(name)
            way = rng.normal(size=3)
        if k % 10 == 3:
            for j in range(3):
                aside = rng.normal(size=3)
                center = resolver.state.nodes[rng.integers(3, 18)] + 0.35 * aside / np.linalg.norm(aside)
                name = f"ball {k} {j}"
                ball = Sphere(name=name, shape="sphere", center=center.tolist(), radius=0.15)
                if resolver.add_obstacle(ball):
                    resolver.remove_obstacle(name)
        before = resolver.setup.monitor.scene.fcl.asked
        step = resolver.step(position=resolver.tip()[0] + 0.04 * way / np.linalg.norm(way))
        if step.qps == 1:
            asked = resolver.setup.monitor.scene.fcl.asked - before
            assert asked in (step.fcl_rows + step.exact_rows, asked if not step.moved else -1)


def test_a_driver_serves_as_long_as_its_engine(monkeypatch, rng):
    made, begin = [], Driver.__init__

    def counted(self, *given):
        made.append(self)
        begin(self, *given)

    monkeypatch.setattr(Driver, "__init__", counted)
    resolver = vq.Resolver(vq.load_problem("snake_past_a_cube"))
    home, vertex = resolver.tip()[0], resolver.state.control_vertices[2].copy()
    for _ in range(6):
        resolver.control_vertex_goals = {2: vertex + 0.01 * rng.normal(size=3)}
        assert resolver.step(position=home + 0.01 * rng.normal(size=3)).moved
    # For arms with and without such goals, each on the curve and off it.
    assert len(made) <= 4


def test_kernels_that_are_compiled_later_are_used(tmp_path, monkeypatch):
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path))
    resolver = vq.Resolver(vq.load_problem("five_bay_free"))
    home = resolver.tip()[0]

    def tour(count):
        for k in range(count):
            assert resolver.step(position=home + 0.005 * np.array([k % 3, k % 2, 0.0])).moved

    tour(20)
    finish_compiling()
    tour(2)
    interpreted, call = list[str](), Kernel.__call__

    def counted(self):
        interpreted.append(self.name)
        call(self)

    monkeypatch.setattr(Kernel, "__call__", counted)
    tour(2)
    assert not {"rows", "close", "missing"} & {name.split("-")[0] for name in interpreted}


def test_a_state_that_does_not_fit_leaves_nothing_behind():
    problem = vq.load_problem("five_bay_free").replace({"clearance.self_collision": False})
    resolver = vq.Resolver(problem)
    for _ in range(5):
        resolver.step(position=resolver.tip()[0] + [0.01, 0.0, 0.0])
    good = resolver.state
    q = good.q.copy()
    q[3:] += [0.004, 0.0, 0.0]
    resolver.state = replace(good, q=q, nodes=q, quantities=np.append(good.quantities, 0.0))
    with pytest.raises(ValueError, match="could not broadcast"):
        resolver.step(position=resolver.tip()[0] + [0.01, 0.0, 0.0])
    resolver.state = good
    step = resolver.step(position=resolver.tip()[0] + [0.01, 0.0, 0.0])
    np.testing.assert_allclose(step.state.motion, step.state.q - good.q, atol=1e-15)
