"""The fused engine against the general one: one QP, two ways to its numbers, one answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import oracle
import pytest
from arms import TRUSSES, make_layout
from steps import SHAPES, WholeSolver, answers, assert_same_answer, make_step, pressing, shaped

from vgtm_qp.arm.symbols import Bound, Constants
from vgtm_qp.curve.families import make_family
from vgtm_qp.native import building
from vgtm_qp.qp.answer import Accuracy, CurvePoint
from vgtm_qp.qp.fused import FusedSolver
from vgtm_qp.qp.linearise import Linearisation
from vgtm_qp.qp.long.chain import find_chain
from vgtm_qp.qp.long.staged import StagedSolver
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.qp.shape import CurveShape
from vgtm_qp.qp.solvers import make_solver
from vgtm_qp.rotation import rotation_from_vector
from vgtm_qp.rows.curve import polygon_bending
from vgtm_qp.step.engine import FusedEngine, GeneralEngine
from vgtm_qp.step.path import Path
from vgtm_qp.step.target import QPInput, Target

ELIMINABLE = [name for name in TRUSSES if name != "graph"]
TRACKS = {"hexapod": ("position", "orientation"), "longeron": ("x", "pointing")}


@pytest.fixture(autouse=True)
def _interpreted(monkeypatch):
    """The graphs themselves are what is compared; so many of them would keep a compiler busy for minutes."""
    compile_ = Bound.kernel
    monkeypatch.setattr(Bound, "kernel", lambda bound, **_: compile_(bound, compiled=False))


def engines(name, *, joint_offset=0.0, track=None, vertices=5, **options):
    truss = TRUSSES[name](joint_offset=joint_offset)
    layout, task = make_layout(truss, track or TRACKS.get(name, ("position",)), vertices=vertices)
    if options:
        layout = shaped(layout, **options)
    assert layout.arm.symbols(Constants()).can_eliminate
    kinematics = layout.arm.kinematics()
    return layout, kinematics, task, general(layout, kinematics, task), fused_engine(layout, kinematics, task)


def fused_engine(layout, kinematics, task):
    """An engine whose C is there, if there is a compiler."""
    assert building().finish() is not None
    engine = FusedEngine(layout, kinematics, task, FusedSolver(layout))
    assert engine.is_ready
    return engine


def general(layout, kinematics, task):
    return GeneralEngine(layout, kinematics, task, make_solver("daqp", layout))


@pytest.mark.parametrize("base", [False, True])
@pytest.mark.parametrize("joint_offset", [0.0, 0.1])
@pytest.mark.parametrize("name", ELIMINABLE)
def test_both_engines_give_one_answer(name, joint_offset, base, rng):
    layout, kinematics, _, plain, fused = engines(name, joint_offset=joint_offset)
    arm = layout.arm
    X, Y, vertices, target, rows = make_step(layout, kinematics, rng, base=base)
    for motion, progress in ((True, 0.0), (False, 0.7)):
        goal = target.path.at(progress)
        at = Y if motion else X
        asked = QPInput(X, at, vertices, np.zeros(0), target, goal, progress, rows, motion)
        free = plain.solve(asked)
        both = answers((fused, plain), asked._replace(rows=pressing(rows, free)))
        if both is None:
            continue
        first, second = both
        assert_same_answer(first, second)
        np.testing.assert_allclose(first.clearance_multipliers, second.clearance_multipliers, atol=1e-8)
        assert first.clearance_multipliers.max() > 0.0
    done, near = 0, arm.home + 1e-3 * rng.normal(size=X.shape)
    near[arm.base] = arm.home[arm.base]
    for pose in (arm.home, near):
        kinematics.evaluate(pose)
        goal = target.path.at(0.0)._replace(position=arm.end_effector.position(pose) + 1e-6)
        box = replace(target, lower=target.lower - 1.0, upper=target.upper + 1.0)
        accuracy, curve = Accuracy(1e-12, 1e-7, np.inf), CurvePoint(vertices, np.zeros(0))
        settled = []
        for engine in (fused, plain):
            settled.append(engine.settle(pose, curve, box, goal, accuracy))
        if None in settled:
            # From so far off a kept Jacobian may lead nowhere: both engines must say that another QP is due.
            assert settled == [None, None]
            continue
        done += 1
        first, second = (one.closed for one in settled)
        np.testing.assert_allclose(first.q, second.q, atol=1e-9)
        np.testing.assert_allclose(first.quantities, second.quantities, atol=1e-10)
        np.testing.assert_allclose(settled[0].curve.vertices, settled[1].curve.vertices, atol=1e-9)
    assert done or name == "tetrahedral-2"


@pytest.mark.parametrize("hard", [False, True])
@pytest.mark.parametrize("name", ELIMINABLE)
def test_both_engines_leave_an_elastic_tip_behind_by_as_much(name, hard, rng):
    """Boxes of all sizes: where they are narrow, the tip cannot reach its goal."""
    layout, task = make_layout(TRUSSES[name](), TRACKS.get(name, ("position",)), vertices=5)
    layout = replace(layout, elastic_tip=True)
    if hard:
        layout = replace(layout, hard_tracking=True)
    kinematics = layout.arm.kinematics()
    both = general(layout, kinematics, task), fused_engine(layout, kinematics, task)
    behind = 0
    for size in (1e-4, 1e-3, 1e-2, 1e-1):
        X, Y, vertices, target, rows = make_step(layout, kinematics, rng, base=False)
        kinematics.evaluate(X)
        now = kinematics.quantities[layout.arm.actuators]
        target = replace(target, lower=now - size, upper=now + size)
        asked = QPInput(X, Y, vertices, np.zeros(0), target, target.path.at(0.0), 0.0, rows, True)
        found = answers(both, asked)
        if found is None:
            continue
        assert_same_answer(*found, tolerance=1e-7)
        assert found[0].tip_slack == pytest.approx(found[1].tip_slack, abs=1e-7)
        assert found[0].progress == pytest.approx(1.0, abs=1e-12)
        behind += found[0].tip_slack > 1e-4
    assert behind


@pytest.mark.parametrize(
    ("name", "shape", "family"),
    [(name, "everything", "bezier") for name in ELIMINABLE]
    + [("hexapod", shape, "b-spline") for shape in SHAPES]
    + [("octahedral", None, "beta-spline"), ("longeron", "everything", "beta-spline")],
)
def test_both_engines_give_one_answer_on_every_curve(name, shape, family, rng):
    """Arc-length nodes, torsion, spacing and goals of control vertices, on a moving base."""
    layout, kinematics, task, plain, fused = engines(name, shape=shape, family=family, goals=(2, 4))
    X, Y, vertices, target, rows = make_step(layout, kinematics, rng, base=True)
    goals = np.full(vertices.shape, np.nan)
    goals[2], goals[4] = vertices[2] + [0.3, 0.0, 0.0], vertices[4] + [0.0, 0.002, 0.0]
    torsion = 0.1 * rng.normal(size=layout.torsion)
    target = replace(target, vertex_goals=goals)
    whole = GeneralEngine(layout, kinematics, task, WholeSolver(layout))
    for motion, progress in ((True, 0.0), (False, 0.7)):
        goal = target.path.at(progress)
        asked = QPInput(X, Y if motion else X, vertices, torsion, target, goal, progress, rows, motion)
        pressed = asked._replace(rows=pressing(rows, plain.solve(asked)))
        all_three = answers((fused, plain, whole), pressed)
        if all_three is None:
            continue
        found, wanted, other = all_three
        assert_same_answer(found, wanted)
        np.testing.assert_allclose(found.torsion, wanted.torsion, atol=1e-10)
        assert_same_answer(other, wanted, 3e-6)
        np.testing.assert_allclose(other.torsion, wanted.torsion, atol=3e-5)
        assert np.any(wanted.torsion) == bool(layout.torsion)


@pytest.mark.parametrize("hard", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("name", "family"), [("hexapod", "bezier"), ("longeron", "beta-spline")])
def test_both_engines_go_to_one_place_on_every_curve(name, family, shape, hard):
    """One asks the compiled functions of the curve while it settles, the other one the curve's shape, from Python."""
    layout, kinematics, *_ = engines(name, track=("position",), shape=shape, family=family)
    layout = replace(layout, hard_tracking=hard)
    arm = layout.arm
    plain, fused = general(layout, kinematics, None), fused_engine(layout, kinematics, None)
    kinematics.evaluate(arm.home)
    lengths, here = kinematics.quantities[arm.actuators].copy(), arm.end_effector.position(arm.home)
    path = Path(
        np.array([0.0, 1.0]), here + np.outer([0.0, 1.0], [0.02, 0.01, -0.015]), np.stack([np.eye(3)] * 2)
    )
    target = Target(path, 0.0, 1.0, lengths - 0.3, lengths + 0.3, 1.0, 1.0)
    centres = arm.stations.centres(arm.home)[[0, -1]]
    vertices = np.linspace(0, 1, layout.vertices)[:, None] * (centres[1] - centres[0]) + centres[0]
    vertices[2] += [0.01, -0.02, 0.005]
    torsion = np.linspace(0.1, 0.05, layout.torsion)
    asked = QPInput(arm.home, arm.home, vertices, torsion, target, path.at(0.0), 0.0, ClearanceRows(), True)
    moves = [engine.move(asked, Accuracy(1e-10, 1e-8, 1e-1), lambda _: None) for engine in (fused, plain)]
    one, other = moves
    assert one.closed is not None
    assert np.abs(one.closed.q - arm.home).max() > 0.01
    np.testing.assert_allclose(one.closed.q, other.closed.q, atol=2e-8)
    np.testing.assert_allclose(one.vertices, other.vertices, atol=1e-7)
    np.testing.assert_allclose(one.torsion, other.torsion, atol=1e-7)
    assert bool(layout.torsion) == bool(np.abs(one.torsion - torsion).max(initial=0.0) > 1e-6)
    points = layout.shape.at(one.vertices, one.torsion, arm.stations.frames[0]).position
    off = np.abs(arm.stations.centres(one.closed.q)[layout.tracked] - points).max(axis=1)
    assert off[-1] < 1e-8
    assert (off.max() < 1e-8) == hard


@pytest.mark.parametrize("name", ["octahedral", "longeron"])
def test_both_engines_hold_faces_on_the_curve_where_these_determine_the_nodes(name):
    layout, task = make_layout(TRUSSES[name](), vertices=5, hard_tracking=True)
    arm, kinematics = layout.arm, layout.arm.kinematics()
    plain, fused = general(layout, kinematics, task), fused_engine(layout, kinematics, task)
    X = arm.home
    kinematics.evaluate(X)
    lengths, here = kinematics.quantities[arm.actuators].copy(), arm.end_effector.position(X)
    rotation = np.stack([kinematics.tip_rotation] * 2)
    path = Path(np.array([0.0, 1.0]), here + np.outer([0.0, 1.0], [0.02, 0.01, -0.015]), rotation)
    target = Target(path, 0.0, 1.0, lengths - 0.3, lengths + 0.3, 1.0, 1.0)
    centres = arm.stations.centres(X)[[0, *layout.tracked]]
    vertices = np.linspace(0, 1, layout.vertices)[:, None] * (centres[-1] - centres[0]) + centres[0]
    asked = QPInput(X, X, vertices, np.zeros(0), target, path.at(0.0), 0.0, ClearanceRows(), True)
    accuracy, closed = Accuracy(1e-10, 1e-8, 1e-2), []
    for engine in (fused, plain):
        answer = engine.solve(asked)
        goal = path.at(answer.progress)
        curve = CurvePoint(vertices, np.zeros(0)).after(answer)
        settled = engine.settle(X + answer.nodes, curve, target, goal, accuracy)
        closed.append(settled.closed)
        gap = arm.stations.centres(closed[-1].q)[layout.tracked]
        gap -= layout.curve_weights @ settled.curve.vertices
        assert np.abs(gap).max() < 1e-10
        assert np.abs(answer.nodes).max() > 0.01
    np.testing.assert_allclose(closed[0].q, closed[1].q, atol=1e-10)
    move = fused.move(asked, accuracy, lambda _: None)
    np.testing.assert_allclose(move.closed.q, closed[0].q, atol=1e-12)


@pytest.mark.parametrize("name", ["hexapod", "tetrahedral-123", "tetrahedral-23"])
def test_both_engines_keep_the_whole_pose_of_faces_on_the_curve(name, rng):
    layout, kinematics, _, plain, fused = engines(name, vertices=6, track=("z",), shape="torsion", hard=True)
    X, Y, vertices, target, rows = make_step(layout, kinematics, rng)
    target = replace(target, lower=target.lower - 1.0, upper=target.upper + 1.0)
    torsion = np.array([0.05, -0.02])
    for motion in (True, False):
        at, goal = Y if motion else X, target.path.at(0.0)
        asked = QPInput(X, at, vertices, torsion, target, goal, 0.0, rows, motion)
        answers = [engine.solve(asked) for engine in (fused, plain)]
        assert_same_answer(*answers, 1e-9)
    stations = layout.arm.stations
    moved = X + answers[0].nodes
    kinematics.evaluate(moved)
    curve = layout.shape.rows(
        vertices + answers[0].vertices, torsion + answers[0].torsion, stations.frames[0]
    )
    gap = stations.centres(moved)[layout.tracked] - curve.position
    rotations = kinematics.station_rotation[layout.tracked].copy()
    before = layout.shape.rows(vertices, torsion, stations.frames[0])
    kinematics.evaluate(X)
    turned, turns = (
        np.abs([oracle.turns(*pair, 3) for pair in zip(*pairs, strict=True)]).max()
        for pairs in ((kinematics.station_rotation[layout.tracked], before.frame), (rotations, curve.frame))
    )
    first = stations.centres(X)[layout.tracked] - before.position
    assert np.abs(gap).max() < 0.1 * np.abs(first).max() + 1e-3
    assert turns < 0.3 * turned + 1e-3


def moved_curve(shape, vertices, torsion, frame, step):
    size = vertices.size
    return shape.rows(vertices + step[:size].reshape(-1, 3), torsion + step[size:], frame)


@pytest.mark.parametrize("family", ["bezier", "b-spline", "beta-spline"])
@pytest.mark.parametrize("shape", SHAPES)
def test_rows_of_a_curve_are_its_derivatives(shape, family, rng):
    """By central differences over all coordinates: nodes that slide by arc length slide in the differences too."""
    layout, _ = make_layout(TRUSSES["hexapod"](), vertices=6)
    curve = shaped(layout, shape, family=family).shape
    curve = replace(curve, nodes=np.array([0.4, 1.0]))
    vertices = np.linspace(0.0, 1.0, 6)[:, None] * [0.1, 0.0, 2.0] + 0.1 * rng.normal(size=(6, 3))
    torsion = 0.2 * rng.normal(size=curve.torsion)
    frame = rotation_from_vector([0.05, -0.1, 0.3])
    rows = curve.rows(vertices, torsion, frame)
    h = 1e-6
    for k in range(vertices.size + curve.torsion):
        step = h * np.eye(vertices.size + curve.torsion)[k]
        ahead, behind = (moved_curve(curve, vertices, torsion, frame, sign * step) for sign in (1.0, -1.0))
        np.testing.assert_allclose(
            rows.position_rows[:, :, k], (ahead.position - behind.position) / (2 * h), atol=1e-7
        )
        tangent = (ahead.frame - behind.frame)[:, :, 2] / (2 * h)
        np.testing.assert_allclose(np.cross(rows.spin_rows[:, :, k], rows.frame[:, :, 2]), tangent, atol=1e-7)
        turned = (
            ahead.frame @ behind.frame.transpose(0, 2, 1) - behind.frame @ ahead.frame.transpose(0, 2, 1)
        ) / 2
        spin = np.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], axis=1) / (2 * h)
        if curve.tracks_roll:
            np.testing.assert_allclose(
                rows.spin_rows[:, :, k], spin, atol=2e-3 if family == "beta-spline" else 2e-5
            )
        np.testing.assert_allclose(
            rows.spacing_rows[:, k], (ahead.spacing - behind.spacing) / (2 * h), atol=1e-7
        )


@pytest.mark.parametrize("base", [False, True])
@pytest.mark.parametrize("name", ["hexapod", "longeron"])
@pytest.mark.parametrize("shape", SHAPES)
def test_both_engines_linearise_a_curve_as_arrays_do(shape, name, base, rng):
    """Both take their rows from one graph: that is held against NumPy, residuals at q and Jacobians at another pose."""
    layout, kinematics, *_ = engines(name, shape=shape, goals=(3,))
    X, Y, vertices, target, rows = make_step(layout, kinematics, rng, base=base)
    goals = np.full(vertices.shape, np.nan)
    goals[3] = vertices[3] + [0.0, 0.002, 0.0]
    target, torsion = replace(target, vertex_goals=goals), np.linspace(0.1, -0.2, layout.torsion)
    asked = QPInput(X, Y, vertices, torsion, target, target.path.at(0.0), 0.0, rows, motion=True)
    numbers = Linearisation(layout, compiled=False).numbers(asked.linear(layout), rows)
    stations, faces = layout.arm.stations, layout.tracked
    frame = target.base.rotation @ stations.frames[0] if base else stations.frames[0]
    curve = layout.shape.rows(vertices, torsion, frame)
    kinematics.evaluate(Y)
    spin = kinematics.station_spin[faces]
    kinematics.evaluate(X)
    frames = list(zip(kinematics.station_rotation[faces], curve.frame, strict=True))
    by_face, by_curve = (
        np.array(rows)
        for rows in zip(*(oracle.turn_rows(*pair, layout.turns) for pair in frames), strict=True)
    )
    wanted = {
        "tangent_face": by_face @ spin,
        "tangent_curve": by_curve @ curve.spin_rows,
        "tangent_rhs": np.array([oracle.turns(*pair, layout.turns) for pair in frames]),
        "spacing_rhs": curve.spacing,
    }
    for which, value in wanted.items():
        np.testing.assert_allclose(getattr(numbers, which), value, atol=1e-12, err_msg=which)
    for which in ("position_rows", "spacing_rows"):
        np.testing.assert_allclose(getattr(numbers.curve, which), getattr(curve, which), atol=1e-12)
    gap = stations.centres(X)[faces] - curve.position
    np.testing.assert_allclose(numbers.position_rhs, gap, atol=1e-13)
    weights = layout.weights
    pull = weights.smoothness * polygon_bending(layout.vertices) @ vertices
    pull[3] -= weights.vertex_goal * np.array([0.0, 0.002, 0.0])
    np.testing.assert_allclose(numbers.vertex_gradient, pull, atol=1e-12)


def test_spacing_is_measured_from_the_base():
    curve = CurveShape(make_family("bezier", 4), np.array([0.5, 1.0]), spacing=np.array([0.4, 0.4]))
    vertices = np.linspace(0.0, 1.0, 4)[:, None] * [0.0, 0.0, 1.0]
    np.testing.assert_allclose(curve.rows(vertices, np.zeros(0), np.eye(3)).spacing, [0.1, 0.1], atol=1e-14)


def test_names_of_general_rows_are_unique_and_measured(rng):
    layout, kinematics, _, plain, fused = engines("hexapod", shape="everything", goals=(3,))
    X, _, vertices, target, _ = make_step(layout, kinematics, rng)
    asked = QPInput(
        X, X, vertices, np.array([0.1]), target, target.path.at(0.0), 0.0, ClearanceRows(), motion=True
    )
    qp = plain.qp(asked)
    names = [label.name for label in qp.rows]
    assert len(set(names)) == len(names) == qp.A.shape[0]
    assert {"tilt: face 1 z", "spacing: piece 0"} <= set(names)
    columns = [label.name for label in qp.columns]
    assert len(set(columns)) == len(columns) == qp.A.shape[1]
    assert "torsion 1" in columns
    assert np.all(np.linalg.eigvalsh(qp.P.toarray()) > -1e-12)
    same = fused.qp(asked)
    assert (same.rows, same.columns) == (qp.rows, qp.columns)
    np.testing.assert_allclose(same.A.toarray(), qp.A.toarray(), atol=1e-14)


@pytest.mark.parametrize("name", ["longeron", "hexapod"])
def test_all_engines_keep_legs_of_the_control_polygon_from_turning_round(name, rng):
    """Goals draw the second control vertex behind the base, and the last but one beyond the tip."""
    layout, task = make_layout(TRUSSES[name](), ("position", "pointing"), vertices=6)
    heavy = layout.weights.model_copy(update={"vertex_goal": 1e3})
    layout = replace(layout, vertex_goals=(1, 4), weights=heavy)
    kinematics = layout.arm.kinematics()
    X, _, vertices, target, rows = make_step(layout, kinematics, rng)
    kinematics.evaluate(X)
    base, tip = np.array([0.0, 0.0, 1.0]), kinematics.tip_rotation[:, 2]
    vertices[5] = layout.arm.end_effector.position(X)
    vertices[1], vertices[4] = vertices[0] + 0.02 * base, vertices[5] - 0.02 * tip
    goals = np.full(vertices.shape, np.nan)
    goals[1], goals[4] = vertices[0] - base, vertices[5] + tip
    target = replace(target, vertex_goals=goals)
    asked = QPInput(X, X, vertices, np.zeros(0), target, target.path.at(0.0), 0.0, rows, True)
    plain = general(layout, kinematics, task)
    chain = GeneralEngine(layout, kinematics, task, StagedSolver(find_chain(layout)))
    wanted = plain.solve(asked)
    for engine in (fused_engine(layout, kinematics, task), chain):
        assert_same_answer(engine.solve(asked), wanted, 1e-9)
    qp, legs = plain.qp(asked), np.diff(wanted.vertices, axis=0)
    least = [bound for label, bound in zip(qp.rows, qp.row_lower, strict=True) if label.kind == "curve leg"]
    assert least == [0.0, 0.0], "legs that are too short may not become shorter"
    np.testing.assert_allclose([base @ legs[0], tip @ legs[-1]], 0.0, atol=1e-9)
