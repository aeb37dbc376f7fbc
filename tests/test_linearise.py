"""The symbolic QP of a step, linearised and condensed, against plain formulas at random configurations."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace

import numpy as np
import oracle
import pytest
from arms import TRUSSES, make_layout
from steps import BASE_POSE, SHAPES, asked_at, make_step, shaped

from vgtm_qp.errors import GoalError
from vgtm_qp.qp.fused_rows import row_function
from vgtm_qp.qp.linearise import Linearisation, TipGoal
from vgtm_qp.qp.shape import CurveRows
from vgtm_qp.rotation import rotation_from_vector
from vgtm_qp.rows.tip import row_names, tip_function
from vgtm_qp.step.path import PathPoint
from vgtm_qp.step.task import TipTask
from vgtm_qp.step.tracking import TrackingError

EXACT = 1e-11
FRAMED = [name for name in TRUSSES if name != "graph"]
TRACKS = [("position",), ("y",), ("x", "z"), ("position", "pointing"), ("z", "orientation"), ("orientation",)]
CURVES = [None, "none", "hard", "hard turns", *SHAPES, "hard torsion", "drawn"]


@pytest.fixture(autouse=True)
def _without_a_compiler(monkeypatch):
    monkeypatch.setenv("VGTM_CC", "none")


def assert_close(found, wanted, atol, err_msg=""):
    """Compare by absolute differences alone; of arrays without entries only that they have none."""
    if np.size(found) or np.size(wanted):
        np.testing.assert_allclose(found, wanted, rtol=0.0, atol=atol, err_msg=err_msg)


def curved(truss, track, curve, family="bezier"):
    """A layout whose curve is None (plain tables), absent, held by the stations, of a shape, or drawn to goals."""
    layout, task = make_layout(truss, track, vertices=0 if curve == "none" else 6)
    if curve in SHAPES:
        return shaped(layout, curve, family=family), task
    if curve == "hard":
        return replace(layout, hard_tracking=True), task
    if curve == "hard turns":
        return replace(layout, hard_tracking=True, hard_turns=True), task
    if curve == "hard torsion":
        return shaped(layout, "torsion", family=family, hard=True), task
    if curve == "drawn":
        return shaped(layout, family=family, goals=(2, 4)), task
    return layout, task


def inputs(layout, seed, *, base=False, progress=0.0, motion=True):
    """What a QP is asked for at a random configuration, its Jacobians elsewhere, and its clearance rows."""
    rng = np.random.default_rng(seed)
    kinematics = layout.arm.kinematics(compiled=False)
    X, Y, vertices, target, rows = make_step(layout, kinematics, rng, base=base)
    goals = np.full(vertices.shape, np.nan)
    if layout.vertex_goals:
        goals[2], goals[4] = vertices[2] + [0.3, 0.0, 0.0], vertices[4] + [0.0, 0.002, 0.0]
    torsion = 0.1 * rng.normal(size=layout.torsion)
    target = replace(target, vertex_goals=goals)
    asked = asked_at(X, vertices, target, progress, rows, at=Y, torsion=torsion, motion=motion)
    return kinematics, asked.linear(layout), rows


def assert_same_numbers(found, wanted, tolerance=EXACT):
    """Compare all there is in two ``StepNumbers``."""
    assert_close(found.motion.gradient, wanted.motion.gradient, atol=tolerance)
    assert_close(found.motion.rhs, wanted.motion.rhs, atol=tolerance)
    compared = 0
    for field in fields(wanted):
        one, other = getattr(found, field.name), getattr(wanted, field.name)
        if field.name in ("motion", "clearance"):
            continue
        assert is_dataclass(one) == is_dataclass(other), field.name
        if not is_dataclass(other):
            if other is None:
                assert one is None
                continue
            assert_close(one, other, atol=tolerance, err_msg=field.name)
            compared += 1
            continue
        for part in fields(other):
            assert_close(
                getattr(one, part.name), getattr(other, part.name), atol=tolerance, err_msg=part.name
            )
    assert compared == len(fields(wanted)) - 3


def compare(layout, seeds, **options):
    """Compare both symbolic forms of the QP with the plain formulas."""
    linearisation = Linearisation(layout, compiled=False)
    kernel = None if layout.elastic_tip else row_function(layout).kernel(compiled=False)
    for seed in seeds:
        for motion, progress, base in ((True, 0.0, False), (True, 0.3, True), (False, 0.7, True)):
            kinematics, asked, rows = inputs(
                layout, seed, base=base, progress=progress, motion=motion, **options
            )
            wanted = oracle.numbers(layout, kinematics, asked, rows)
            found = linearisation.numbers(asked, rows)
            assert found.clearance is rows
            assert_same_numbers(found, wanted)
            assert_close(
                linearisation.quantities[layout.arm.actuators], asked.lower - wanted.lower, atol=EXACT
            )
            if kernel is not None:
                assert_same_condensed(kernel, layout, asked, wanted)


def assert_same_condensed(kernel, layout, asked, numbers):
    wanted = oracle.condensed(layout, asked, numbers)
    size, rows = len(wanted.gradient), len(layout.tip_rows)
    asked.load(kernel)
    kernel()
    stack, tip, lower, upper, gradient, curvature, offset, normal = kernel.outputs
    scale = 1.0 + np.abs(wanted.rows).max()
    assert_close(stack.reshape(size, -1).T, wanted.rows, atol=EXACT * scale)
    assert_close(tip.reshape(rows, size), wanted.tip, atol=EXACT * scale)
    for found, bound in ((lower, wanted.lower), (upper, wanted.upper)):
        bounded = np.abs(bound) < 1e29
        np.testing.assert_array_equal(np.abs(found) < 1e29, bounded)
        assert_close(found[bounded], bound[bounded], atol=EXACT * scale)
    assert_close(gradient, wanted.gradient, atol=EXACT)
    assert_close(curvature, [numbers.progress_curvature], atol=EXACT)
    assert_close(offset.reshape(-1, 3), wanted.offset.reshape(-1, 3), atol=EXACT)
    assert_close(normal, wanted.normal, atol=EXACT)


@pytest.mark.parametrize("joint_offset", [0.0, 0.1])
@pytest.mark.parametrize("name", FRAMED)
def test_every_module_and_joint(name, joint_offset):
    layout, _ = curved(TRUSSES[name](joint_offset=joint_offset), ("position", "pointing"), None)
    compare(layout, range(3))


@pytest.mark.parametrize("joint_offset", [0.0, 0.1])
@pytest.mark.parametrize("track", [("position",), ("y",)])
def test_a_graph_is_linearised_although_it_is_not_condensed_node_by_node(track, joint_offset):
    layout, _ = curved(TRUSSES["graph"](joint_offset=joint_offset), track, None)
    linearisation = Linearisation(layout, compiled=False)
    for seed in range(3):
        kinematics, asked, rows = inputs(layout, seed, base=bool(seed % 2), progress=0.2)
        wanted = oracle.numbers(layout, kinematics, asked, rows)
        assert_same_numbers(linearisation.numbers(asked, rows), wanted)


@pytest.mark.parametrize("elastic", [False, True])
@pytest.mark.parametrize("track", TRACKS, ids="+".join)
def test_every_coordinate_of_a_tip(track, elastic):
    layout, _ = curved(TRUSSES["hexapod"](), track, None)
    compare(replace(layout, elastic_tip=elastic), range(2))


@pytest.mark.parametrize("family", ["bezier", "b-spline", "beta-spline"])
@pytest.mark.parametrize("curve", CURVES)
def test_every_curve(curve, family):
    layout, _ = curved(TRUSSES["hexapod"](), ("position",), curve, family)
    compare(layout, range(2))


@pytest.mark.parametrize("curve", ["hard", "everything", "drawn"])
@pytest.mark.parametrize("name", ["double-octahedral", "longeron", "tetrahedral-2", "tetrahedral-123"])
def test_other_modules_with_other_curves(name, curve):
    layout, _ = curved(TRUSSES[name](joint_offset=0.05), ("position", "pointing"), curve)
    compare(layout, range(1))


def test_other_weights():
    layout, _ = curved(TRUSSES["hexapod"](), ("position", "orientation"), "everything")
    names = type(layout.weights).model_fields
    drawn = dict(zip(names, np.random.default_rng(1).uniform(0.2, 3.0, len(names)).tolist(), strict=True))
    compare(replace(layout, weights=layout.weights.model_copy(update=drawn)), range(1))


@pytest.mark.parametrize("compiled", [False, True])
def test_numbers_are_arrays_of_their_own(compiled, monkeypatch):
    monkeypatch.delenv("VGTM_CC")
    layout, _ = curved(TRUSSES["octahedral"](), ("position",), None)
    linearisation = Linearisation(layout, compiled=compiled)
    (_, first, rows), (_, second, _) = inputs(layout, 0), inputs(layout, 1)
    kept = linearisation.numbers(first, rows)
    linearisation.numbers(second, rows)
    assert_same_numbers(kept, Linearisation(layout, compiled=False).numbers(first, rows), 1e-13)


@pytest.mark.parametrize("curve", ["hard", "hard turns", "hard torsion"])
@pytest.mark.parametrize("base", [False, True])
def test_what_is_left_of_hard_tracking(curve, base):
    layout, _ = curved(TRUSSES["hexapod"](), ("position",), curve)
    measured = []
    for seed in range(3):
        kinematics = layout.arm.kinematics(compiled=False)
        rng = np.random.default_rng(seed)
        X, _, vertices, target, _ = make_step(layout, kinematics, rng, base=base)
        torsion = 0.1 * rng.normal(size=layout.torsion)
        given = asked_at(X, vertices, target, 0.0, torsion=torsion).linear(layout).curve
        assert isinstance(given, CurveRows) == bool(layout.torsion)
        wanted = oracle.tracking_error(layout, kinematics, X, vertices, given)
        error = TrackingError(layout, layout.arm.kinematics(compiled=False))
        measured.append(error.greatest(X, vertices, torsion, BASE_POSE if base else None))
        assert measured[-1] == pytest.approx(wanted, abs=1e-14)
    assert min(measured) > 1e-3


# The rows of the tip as functions of numbers


def tip_of(track, position, rotation, goal, motion=False):
    """Error, rate, turned axes and weight by the package's own function."""
    function = tip_function(row_names(track))
    found = function(
        position, rotation, goal.position, goal.rotation, goal.velocity, goal.spin, 1.0 if motion else 0.0
    )
    error, rate, across, weight = (np.array(part) for part in found)
    return error[:, 0], rate[:, 0], across, float(weight[0, 0])


def random_pose(rng, turn=1.0):
    return rng.normal(size=3), rotation_from_vector(turn * rng.normal(size=3))


@pytest.mark.parametrize("track", TRACKS, ids="+".join)
def test_the_rows_of_a_tip_are_those_of_the_formulas(track):
    rng = np.random.default_rng(0)
    for turn in (1e-9, 1e-6, 1e-3, 0.3, 2.0):
        position, rotation = random_pose(rng)
        there, _ = random_pose(rng)
        turned = rotation_from_vector(turn * rng.normal(size=3)) @ rotation
        goal = TipGoal(there, turned, rng.normal(size=3), rng.normal(size=3))
        error, rate, across, weight = tip_of(track, position, rotation, goal)
        wanted = oracle.tip_rows(row_names(track), position, rotation, goal)
        assert_close(error, wanted.error, atol=1e-14)
        assert_close(rate, wanted.rate, atol=1e-14)
        assert_close(across, wanted.across, atol=1e-14)
        assert weight == pytest.approx(oracle.progress_weight(wanted.rate))


@pytest.mark.parametrize("way", [0.0, 1e-7, 1e-5, 1e-3, 0.1, 1.0])
def test_progress_counts_more_on_a_short_way(way):
    goal = TipGoal(np.zeros(3), np.eye(3), way * np.array([0.6, 0.0, 0.8]), np.zeros(3))
    weight = tip_of(("position",), np.zeros(3), np.eye(3), goal)[3]
    assert weight == pytest.approx({0.0: 1.0, 1e-7: 1.0, 1e-5: 1e-7, 1e-3: 1e-5}.get(way, way * way))


@pytest.mark.parametrize("off", [1e-7, 2.1e-8, 1.9e-8, 1e-10, 0.0])
def test_a_motion_need_not_close_what_a_state_may_have(off):
    goal = TipGoal(np.array([0.0, -off, 0.0]), np.eye(3), np.zeros(3), np.zeros(3))
    for motion in (False, True):
        error = tip_of(("position", "pointing"), np.zeros(3), np.eye(3), goal, motion=motion)[0]
        wanted = 0.0 if motion and off < 2e-8 else -off
        np.testing.assert_array_equal(error, [0.0, wanted, 0.0, 0.0, 0.0])


@pytest.mark.parametrize("seed", range(5))
def test_towards_the_opposite_direction_the_tip_turns_half_round_about_its_own_x_axis(seed):
    _, rotation = random_pose(np.random.default_rng(seed))
    half = rotation_from_vector(np.pi * rotation[:, 0])
    goal = TipGoal(np.zeros(3), half @ rotation, np.zeros(3), np.zeros(3))
    error, _, across, _ = tip_of(("pointing",), np.zeros(3), rotation, goal)
    assert_close(error, [np.pi, 0.0], atol=1e-12)
    assert_close(rotation_from_vector(across.T @ error), half, atol=1e-12)


@pytest.mark.parametrize("off", [0.0, 1e-15, 1e-13, 1e-11, 1e-9, 1e-6, 1e-3])
def test_near_the_opposite_direction_the_turn_is_half_a_turn_less_what_is_off(off):
    """Wherever one formula gives way to the other, the turn leads to the goal's direction."""
    rotation = rotation_from_vector([0.3, -0.8, 0.4])
    for side in (rotation[:, 0], rotation[:, 1], rotation[:, :2] @ [0.6, -0.8]):
        turned = rotation_from_vector((np.pi - off) * side) @ rotation
        goal = TipGoal(np.zeros(3), turned, np.zeros(3), np.zeros(3))
        error, _, across, _ = tip_of(("pointing",), np.zeros(3), rotation, goal)
        assert np.linalg.norm(error) == pytest.approx(np.pi - off, abs=2e-9)
        there = rotation_from_vector(across.T @ error) @ rotation[:, 2]
        assert_close(there, turned[:, 2], atol=2e-9 if off <= 1e-9 else 1e-12)


def test_the_same_direction_is_no_turn():
    rotation = rotation_from_vector([0.3, -0.8, 0.4])
    goal = TipGoal(
        np.zeros(3), rotation_from_vector(1.3 * rotation[:, 2]) @ rotation, np.zeros(3), np.zeros(3)
    )
    error = tip_of(("pointing",), np.zeros(3), rotation, goal)[0]
    assert_close(error, 0.0, atol=1e-15)


@pytest.mark.parametrize("off", [0.0, 1e-15, 1e-13, 1e-11, 1e-9, 1e-7, 1e-5, 1e-3])
@pytest.mark.parametrize(
    "axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, -0.8), (-0.36, 0.48, 0.8)]
)
def test_an_orientation_half_a_turn_away_is_half_a_turn_away(axis, off):
    rotation = rotation_from_vector([0.2, 0.5, -0.4])
    turned = rotation_from_vector((np.pi - off) * np.array(axis)) @ rotation
    goal = TipGoal(np.zeros(3), turned, np.zeros(3), np.zeros(3))
    error = tip_of(("orientation",), np.zeros(3), rotation, goal)[0]
    assert np.linalg.norm(error) == pytest.approx(np.pi - off, abs=2e-9)
    assert_close(rotation_from_vector(error) @ rotation, turned, atol=1e-9)


@pytest.mark.parametrize("track", TRACKS, ids="+".join)
def test_tip_rows_at_numbers_are_those_in_symbols(track):
    layout, task = curved(TRUSSES["hexapod"](), track, "none")
    kinematics, asked, rows = inputs(layout, 3, progress=0.4)
    wanted = oracle.numbers(layout, kinematics, replace_goal(asked), rows)
    kinematics.evaluate(asked.at)
    spin = kinematics.tip_spin.copy()
    kinematics.evaluate(asked.q)
    found = task.rows(asked.q, kinematics, PathPoint(*asked.goal), spin)
    assert_close(found.jacobian, wanted.tip_jacobian, atol=1e-13)
    assert_close(found.rate, wanted.tip_rate, atol=1e-13)
    assert_close(found.error, wanted.tip_rhs, atol=1e-13)
    position = layout.arm.end_effector.position(asked.q)
    worst = task.error(position, kinematics.tip_rotation, PathPoint(*asked.goal))
    assert worst == pytest.approx(np.abs(wanted.tip_rhs).max())


def replace_goal(asked):
    """The same, for a correction: every error counts."""
    return asked._replace(motion=False)


def test_what_cannot_be_tracked_is_refused_before_anything_is_built():
    layout, _ = make_layout(TRUSSES["graph"]())
    with pytest.raises(GoalError, match="three or more nodes"):
        TipTask(("orientation",), layout.arm)
