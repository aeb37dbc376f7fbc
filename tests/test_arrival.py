"""What follows where a curve was settled: its end at the tip, its direction, and the gaps of its stations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle
import pytest
from arms import arm_problem
from scipy.spatial.transform import Rotation

import vgtm_qp as vq
from vgtm_qp.arm.arm import Pose
from vgtm_qp.builder import source_of
from vgtm_qp.compiled import compiler
from vgtm_qp.native import building
from vgtm_qp.step.arrival import Arrival, ending_function, gap_function
from vgtm_qp.step.attempt import Attempt, Tracking
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.driver import Driver

POINTING = {"end_effector": {"track": ["position", "pointing"]}, "waypoint": {"pointing": [0.0, 0.0, 1.0]}}
ARMS = {
    "octahedral": ("octahedral", 4, 5, {}),
    "octahedral, pointing": ("octahedral", 6, 6, POINTING),
    "hexapod, pointing": ("hexapod", 3, 5, POINTING),
    "longeron, three vertices": ("longeron", 4, 3, POINTING),
}


def layout_of(name, **changes):
    module, bays, vertices, more = ARMS[name]
    truss, curve = {"module": module, "stroke": None}, {"control_vertices": vertices, **changes}
    problem = arm_problem((0.5, 0.2, 2.5), bays=bays, truss=truss, curve=curve, **more)
    return build_arm(problem, solves=False).layout


def near_home(layout, rng, size):
    """A curve near the straight one, and a tip near that of home."""
    axis = np.linspace(0.0, 1.0, layout.vertices)[:, None] * [0.0, 0.0, layout.arm.height]
    tip = layout.arm.end_effector
    position = tip.position(layout.arm.home) + size * rng.normal(size=3)
    turn = Rotation.from_rotvec(size * rng.normal(size=3)).as_matrix()
    return axis + size * rng.normal(size=axis.shape), position, turn @ tip.frame


def ended(layout, vertices, position, rotation):
    """The least change of all vertices but the first two, by least squares; the slope keeps length and sense."""
    if not layout.ends_at_tip:
        return vertices
    rows, wanted = [layout.curve_weights[-1]], [position]
    if layout.ends_along_tip:
        rows.append(layout.curve_slopes[-1])
        slope = rows[1] @ vertices
        wanted.append(np.sign(slope @ rotation[:, 2]) * np.linalg.norm(slope) * rotation[:, 2])
    missing, found = np.array(wanted) - np.array(rows) @ vertices, vertices.copy()
    found[2:] += np.linalg.lstsq(np.array(rows)[:, 2:], missing, rcond=None)[0]
    return found


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("name", ARMS)
def test_the_curve_ends_at_the_tip_by_the_least_change(name, compiled, rng):
    layout = layout_of(name)
    kernel = ending_function(layout).kernel(compiled=compiled)
    if compiled:
        assert kernel.compile() == (compiler() is not None)
    reversals = []
    for size in (0.0, 1e-9, 0.01, 0.3, 1.0, 3.0):
        for _ in range(10):
            vertices, position, rotation = near_home(layout, rng, size)
            normal = Rotation.from_rotvec(size * rng.normal(size=3)).as_matrix()[:, 2]
            given = vertices, position, rotation.T, normal
            for argument, values in zip(kernel.inputs, given, strict=False):
                argument[:] = values.reshape(-1)
            kernel()
            wanted = ended(layout, vertices, position, rotation)
            np.testing.assert_allclose(
                kernel.outputs[0].reshape(-1, 3), wanted, rtol=0.0, atol=1e-12 * (1.0 + 10.0 * size)
            )
            first, last = wanted[1] - wanted[0], wanted[-1] - wanted[-2]
            along = [first @ normal, *([last @ rotation[:, 2]] if layout.ends_along_tip else [])]
            assert bool(kernel.outputs[1][0]) == (min(along) < 0.0)
            reversals.append(min(along) < 0.0)
    assert 0 < sum(reversals) < len(reversals)


@pytest.mark.parametrize("base", [None, Pose(np.zeros(3), np.diag([1.0, -1.0, -1.0]))])
def test_a_curve_reverses_against_the_base_wherever_that_is(base):
    layout = layout_of("octahedral")
    vertices, position, rotation = near_home(layout, np.random.default_rng(0), 0.0)
    found, reverses = Arrival(layout).ended(vertices, position, rotation, base)
    assert reverses == (base is not None)
    np.testing.assert_allclose(found, vertices, atol=1e-14)
    assert not np.shares_memory(found, Arrival(layout).ended(vertices, position, rotation, base)[0])


def test_an_arm_without_a_curve_has_no_end_and_no_gap():
    layout = build_arm(arm_problem(method={"tracking": "none"}), solves=False).layout
    nothing, arrival = np.zeros((0, 3)), Arrival(layout)
    assert arrival.ended(nothing, np.zeros(3), np.eye(3)) == (nothing, False)
    assert np.isnan(arrival.gap(layout.arm.home, nothing, np.zeros(0), None))


@pytest.mark.parametrize("hard_turns", [False, True])
@pytest.mark.parametrize("name", ["octahedral", "hexapod, pointing"])
def test_the_gap_is_the_greatest_of_all_stations(name, hard_turns, rng):
    layout = replace(layout_of(name), hard_turns=hard_turns)
    arrival = Arrival(layout)
    for _ in range(10):
        X = layout.arm.home + 0.1 * rng.normal(size=layout.arm.home.shape)
        vertices = near_home(layout, rng, 0.1)[0]
        wanted = oracle.tracking_error(layout, X, vertices, None, layout.curve_weights @ vertices)
        assert arrival.gap(X, vertices, np.zeros(0), None) == pytest.approx(wanted, abs=1e-13)


@pytest.mark.parametrize("where", ["a node", "a vertex"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_no_number_is_no_gap(where, value):
    layout = layout_of("octahedral")
    X, vertices = layout.arm.home.copy(), near_home(layout, np.random.default_rng(0), 0.0)[0]
    (X if where == "a node" else vertices)[-2, 1] = value
    assert not Arrival(layout).gap(X, vertices, np.zeros(0), None) < np.inf
    if np.isnan(value):
        assert np.isnan(Arrival(layout).gap(X, vertices, np.zeros(0), None))


def test_the_code_does_not_grow_with_the_arm():
    sizes = []
    for bays in (10, 100):
        problem = arm_problem(bays=bays, truss={"stroke": None}, curve={"control_vertices": 5})
        layout = build_arm(problem, solves=False).layout
        functions = ending_function(layout).function, gap_function(layout).function
        sizes.append(sum(len(source_of(function)) for function in functions))
    assert sizes[1] < 1.02 * sizes[0]


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("curve", [{}, {"nodes": "arc-length"}], ids=["plain", "arc-length"])
def test_an_arm_that_gives_way_measures_its_turns_as_well(curve, monkeypatch):
    """The step in one call has the gap of its state, with the turns that should be equalities."""
    assert building().finish() is not None
    run, take, taken = Attempt.run, Driver.take, []

    def recorded(*asked):
        taken.append(take(*asked))
        return taken[-1]

    monkeypatch.setattr(Attempt, "usual", lambda *_: None)
    monkeypatch.setattr(Attempt, "run", lambda *asked, **_: run(*asked, tracking=Tracking.ELASTIC))
    monkeypatch.setattr(Driver, "take", recorded)
    truss, method = {"module": "hexapod", "stroke": None}, {"hard_coordinates": ["position", "pointing"]}
    curve = {"control_vertices": 5, **curve}
    resolver = vq.Resolver(arm_problem(bays=3, truss=truss, curve=curve, method=method))
    assert resolver.setup.layout.hard_turns
    for _ in range(3):
        step = resolver.step(position=resolver.tip()[0] + [0.05, 0.02, -0.02])
        assert step.moved
        assert step.gap == pytest.approx(resolver.setup.gap_of(step.state), abs=1e-14)
        assert step.gave_way
    assert any(isinstance(one, vq.Step) and one.moved for one in taken)
