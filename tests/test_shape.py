"""The reference curve of an arm at work: families, hard tracking, torsion, spacing, shape by hand, redundancy."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import oracle
import pytest
from arms import arm_problem, check_curve_rows
from scipy.spatial.transform import Rotation

import vgtm_qp as vq
from vgtm_qp.arm.arm import Pose
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.curve.curve import Curve
from vgtm_qp.errors import CurveError, GoalError, ProblemError
from vgtm_qp.methods import Resolver
from vgtm_qp.qp.linearise import Linearisation
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.step.arrival import Arrival
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.checks import find_warnings
from vgtm_qp.step.path import Path
from vgtm_qp.step.step import StepStatus
from vgtm_qp.step.target import QPInput, Target

STRIDE = np.array([0.05, 0.02, -0.02])
POSE = ["position", "pointing", "orientation"]


@pytest.fixture(autouse=True)
def _without_a_compiler(monkeypatch):
    monkeypatch.setenv("VGTM_CC", "none")


def shaped_problem(module="octahedral", bays=4, curve=None, **more):
    curve = {"control_vertices": 5, **(curve or {})}
    truss = {"module": module, "stroke": None}
    return arm_problem((0.5, 0.2, 2.5), bays=bays, truss=truss, curve=curve, **more)


def walk(resolver, count=6, stride=STRIDE, **goal):
    """Step the tip on by strides; every step is to reach its goal."""
    for _ in range(count):
        step = resolver.step(position=resolver.tip()[0] + stride, **goal)
        assert step.status is StepStatus.REACHED, (step.reason, step.blocked_by)
    return step


def gaps(resolver):
    """Positions and turns between the tracked faces and the curve, by the curve's own class and the oracle."""
    setup, state = resolver.setup, resolver.state
    layout, truss = setup.layout, truss_of(setup.arm)
    rows = layout.shape.rows(state.control_vertices, state.torsion, truss.face_frames[0])
    rotations = oracle.face_rotations(truss, state.nodes)[layout.tracked]
    turns = [oracle.turns(R, F, layout.turns) for R, F in zip(rotations, rows.frame, strict=True)]
    return oracle.gaps(truss, state.nodes, layout.tracked, rows.position), np.array(turns)


CURVES = [
    {"family": "bezier"},
    {"family": "b-spline", "degree": 3},
    {"family": "b-spline", "degree": 2},
    {"family": "beta-spline"},
    {"family": "beta-spline", "bias": 1.5, "tension": 4.0},
]


@pytest.mark.parametrize("nodes", ["parameter", "arc-length"])
@pytest.mark.parametrize("curve", CURVES, ids=lambda c: "-".join(map(str, c.values())))
def test_every_family_starts_on_the_faces_and_goes_with_them(curve, nodes):
    resolver = Resolver(shaped_problem(curve={**curve, "nodes": nodes}))
    assert np.abs(gaps(resolver)[0]).max() < 1e-9
    walk(resolver)
    assert np.abs(gaps(resolver)[0]).max() < 0.1
    state, shape = resolver.state, resolver.setup.layout.shape
    if nodes == "arc-length":
        now = Curve(shape.family, state.control_vertices)
        s = now.arc_parameter(shape.nodes)
        np.testing.assert_allclose(now.length(s) / now.length(1.0), [0.25, 0.5, 0.75, 1.0], atol=1e-9)


GENERAL = [
    ("octahedral", 4, {"nodes": "arc-length"}, {}),
    ("hexapod", 3, {"torsion_vertices": 2}, {"weights": {"spacing": 0.4, "roll": 0.2}}),
    ("longeron", 4, {"nodes": "arc-length", "torsion_vertices": 1}, {"weights": {"spacing": 1.0}}),
    ("hexapod", 3, {"family": "b-spline"}, {"tracking_mode": "hard", "hard_coordinates": POSE}),
    (
        "hexapod",
        3,
        {"nodes": "arc-length"},
        {"tracking_mode": "hard", "hard_coordinates": ["position", "pointing"]},
    ),
    ("octahedral", 4, {"control_vertex_goals": [{"index": 3, "position": [0.4, 0.1, 1.8]}]}, {}),
]


def built(module, bays, curve, method):
    return build_arm(shaped_problem(module, bays, curve, method=method), solves=False)


def near_home(setup, rng):
    """A curve and poses that are nearly those at home."""
    vertices = setup.control_vertices + 0.05 * rng.normal(size=setup.control_vertices.shape)
    poses = (setup.arm.home + 0.03 * rng.normal(size=setup.arm.home.shape) for _ in range(2))
    return (*poses, vertices, setup.torsion + 0.1 * rng.normal(size=setup.torsion.shape))


@pytest.mark.parametrize(("module", "bays", "curve", "method"), GENERAL, ids=str)
def test_the_rows_of_a_general_curve_are_those_of_the_equations(module, bays, curve, method, rng):
    setup = built(module, bays, curve, method)
    layout, count = setup.layout, len(setup.arm.actuators)
    linearisation = Linearisation(layout, compiled=False)
    rotations = np.stack([np.eye(3), Rotation.from_rotvec([0.4, -0.3, 0.8]).as_matrix()])
    path = Path(np.array([0.0, 2.0]), rng.normal(size=(2, 3)), rotations)
    for motion in (True, False):
        q, at, vertices, torsion = near_home(setup, rng)
        lower = rng.uniform(0.5, 1.0, count)
        pose = Pose(0.05 * rng.normal(size=3), Rotation.from_rotvec(0.1 * rng.normal(size=3)).as_matrix())
        target = Target(path, 0.5, 1.75, lower, lower + 0.1, 1.0, 1.0, pose, setup.vertex_goals)
        goal, none = target.goal(0.4), ClearanceRows()
        asked = QPInput(q, at, vertices, torsion, target, goal, 0.4, none, motion).linear(layout)
        np.testing.assert_allclose(asked.goal.velocity, 1.25 * np.diff(path.positions, axis=0)[0] / 2.0)
        np.testing.assert_allclose(asked.goal.spin, 1.25 * np.array([0.4, -0.3, 0.8]) / 2.0, atol=1e-14)
        np.testing.assert_allclose(asked.goal.position, path.at(1.0).position)
        based = np.where(setup.arm.base[:, None], setup.arm.home @ pose.rotation.T + pose.position, q)
        np.testing.assert_allclose(asked.base, based, atol=1e-15)
        if layout.general is not None:
            begins = oracle.face_rotations(truss_of(setup.arm), based)[0]
            for table, known in zip(asked.curve, layout.shape.rows(vertices, torsion, begins), strict=True):
                np.testing.assert_allclose(table, known, atol=1e-10)
        found = linearisation.numbers(asked, none)
        oracle.check_numbers(found, oracle.numbers(layout, asked), layout)
        assert (found.curve is None) == (layout.general is None)


@pytest.mark.parametrize(("module", "bays", "curve", "method"), GENERAL, ids=str)
def test_rows_of_gaps_and_turns_are_the_derivatives_of_their_residuals(module, bays, curve, method, rng):
    setup = built(module, bays, curve, method)
    layout, arm, h = setup.layout, setup.arm, 1e-6
    linearisation = Linearisation(layout, compiled=False)
    q, _, vertices, torsion = near_home(setup, rng)
    q[arm.base] = arm.home[arm.base]
    moved = np.where(arm.base[:, None], 0.0, rng.normal(size=q.shape))
    points, turned = rng.normal(size=vertices.shape), rng.normal(size=torsion.shape)
    lengths = arm.home_quantities[arm.actuators]
    still = Path(np.array([0.0, 1.0]), np.zeros((2, 3)), np.stack([np.eye(3)] * 2))
    target = Target(still, 0.0, 1.0, lengths, lengths, 1.0, 1.0, None, setup.vertex_goals)

    def numbers(step):
        at, none = q + step * moved, ClearanceRows()
        curve_at = vertices + step * points, torsion + step * turned
        return linearisation.numbers(
            QPInput(at, at, *curve_at, target, target.goal(0.0), 0.0, none, True).linear(layout), none
        )

    here, plus, minus = (numbers(step) for step in (0.0, h, -h))
    position, turn = here.curve_rows(layout)
    along = np.concatenate([points.reshape(-1), turned])
    faces = moved[arm.stations.nodes[layout.tracked]].reshape(len(layout.tracked), 9)
    gap = arm.stations.centres(moved)[layout.tracked].reshape(-1) - position @ along
    tilt = np.einsum("kan,kn->ka", here.tangent_face, faces).reshape(-1) + turn @ along
    wanted = (
        (plus.position_rhs - minus.position_rhs) / (2.0 * h),
        (plus.tangent_rhs - minus.tangent_rhs) / (2.0 * h),
    )
    np.testing.assert_allclose(gap, wanted[0].reshape(-1), atol=1e-6)
    np.testing.assert_allclose(tilt, wanted[1].reshape(-1), atol=1e-5)


@pytest.mark.parametrize(("module", "bays", "curve", "method"), GENERAL[:5], ids=str)
def test_the_rows_of_a_curve_are_the_derivatives_of_its_nodes_frames_and_spacings(
    module, bays, curve, method, rng
):
    setup = built(module, bays, curve, method)
    shape, arm = setup.layout.shape, setup.arm
    _, _, vertices, torsion = near_home(setup, rng)
    # The frame is carried along from the base face: it stays where the curve leaves that along its normal.
    vertices[1] = vertices[0] + [0.0, 0.0, 0.4]
    check_curve_rows(shape, vertices, torsion, arm.stations.frames[0], atol=1e-7, turn_atol=1e-7, first=5)


@pytest.mark.parametrize(("module", "bays", "curve", "method"), GENERAL[3:5], ids=str)
def test_tracking_errors_are_the_greatest_gap_or_turn(module, bays, curve, method, rng):
    setup = built(module, bays, curve, method)
    layout = setup.layout
    X, _, vertices, torsion = near_home(setup, rng)
    rows = layout.shape.rows(vertices, torsion, setup.arm.stations.frames[0])
    for each in (layout, replace(layout, hard_turns=False), replace(layout, hard_tracking=True, shape=None)):
        frames, points = rows.frame, rows.position
        if each.general is None:
            frames, points = None, each.curve_weights @ vertices
        wanted = oracle.tracking_error(each, X, vertices, frames, points)
        found = Arrival(each).gap(X, vertices, torsion, None)
        assert found == pytest.approx(wanted, abs=1e-13)
        assert found > 0.01


HARD = [
    ("octahedral", 4, ["position"], {}),
    ("double-octahedral", 3, ["position"], {}),
    ("hexapod", 3, ["position"], {}),
    ("hexapod", 3, POSE, {}),
    ("hexapod", 3, ["position", "pointing"], {"nodes": "arc-length"}),
    ("longeron", 6, ["position"], {}),
    ("longeron", 6, POSE, {"torsion_vertices": 1}),
    ("tetrahedral", 3, ["position"], {}),
    ("tetrahedral", 3, POSE, {"torsion_vertices": 1}),
]


@pytest.mark.parametrize(("module", "bays", "coordinates", "curve"), HARD, ids=str)
def test_hard_tracking_holds_at_every_state(module, bays, coordinates, curve):
    problem = shaped_problem(
        module, bays, curve, method={"tracking_mode": "hard", "hard_coordinates": coordinates}
    )
    resolver = Resolver(problem)
    layout = resolver.setup.layout
    stations = resolver.setup.arm.stations
    assert list(np.diff(layout.tracked)) == [stations.stride] * (len(layout.tracked) - 1)
    assert layout.tracked[-1] == len(stations) - 1
    for _ in range(4):
        walk(resolver, 1)
        gap, turn = gaps(resolver)
        assert np.abs(gap).max() < 1e-6
        assert layout.hard_turns == (len(coordinates) > 1)
        if layout.hard_turns:
            assert np.abs(turn).max() < 1e-6


@pytest.mark.parametrize(
    ("module", "coordinates", "curve", "message"),
    [
        ("octahedral", POSE, {}, r"hard_coordinates.*cannot keep pointing, orientation"),
        ("longeron", ["pointing"], {}, r"hard_coordinates.*the first one, two or three"),
        ("hexapod", POSE, {}, r"torsion_vertices.*asked for roll"),
    ],
)
def test_what_the_bays_cannot_keep_is_refused(module, coordinates, curve, message):
    point = {"rotation_vector": [0.0, 0.1, 0.2]} if module == "hexapod" else {}
    track = ["position", "orientation"] if point else ["position"]
    with pytest.raises(ProblemError, match=message):
        Resolver(
            shaped_problem(
                module,
                3,
                curve,
                waypoint=point,
                end_effector={"track": track},
                method={"tracking_mode": "hard", "hard_coordinates": coordinates},
            )
        )


@pytest.mark.parametrize(("module", "bays"), [("hexapod", 3), ("longeron", 4), ("tetrahedral", 3)])
def test_torsion_takes_up_the_roll_of_the_tip(module, bays):
    """Turned about its axis the arm shares the roll along its faces, and the curve's frame turns with them."""
    problem = shaped_problem(
        module,
        bays,
        {"torsion_vertices": 1},
        waypoint={"rotation_vector": [0.0, 0.0, 0.3]},
        end_effector={"track": ["position", "orientation"]},
    )
    resolver = Resolver(problem)
    here = resolver.tip()[0]
    for angle in np.linspace(0.0, 0.3, 7)[1:]:
        step = resolver.step(position=here, rotation_vector=[0.0, 0.0, angle])
        assert step.status is StepStatus.REACHED
    for _ in range(20):
        resolver.step(position=here)
    assert 0.15 < resolver.state.torsion[0] < 0.45
    truss = truss_of(resolver.setup.arm)
    roll = [
        Rotation.from_matrix(frame @ home.T).as_rotvec()[2]
        for frame, home in zip(
            oracle.face_rotations(truss, resolver.state.nodes), truss.face_frames, strict=True
        )
    ]
    assert roll[-1] == pytest.approx(0.3, abs=1e-6)
    assert 0.05 < roll[len(roll) // 2] < 0.25


def test_spacing_keeps_the_curve_nodes_apart_as_at_home():
    spread = []
    for weight in (0.0, 20.0):
        resolver = Resolver(shaped_problem(method={"weights": {"spacing": weight}}))
        walk(resolver, 9, np.array([0.02, 0.0, -0.08]))
        family = resolver.setup.layout.family
        points = Curve(family, resolver.state.control_vertices).position(np.linspace(0, 1, 5))
        spread.append(
            np.abs(np.linalg.norm(np.diff(points, axis=0), axis=1) - resolver.setup.arm.height / 4).max()
        )
    assert spread[1] < 0.8 * spread[0]


@pytest.mark.parametrize("solver", ["daqp", "piqp"])
def test_a_vertex_goes_to_its_goal_and_the_arm_follows_while_the_tip_stays(solver):
    resolver = Resolver(shaped_problem(bays=5, method={"solver": solver}, curve={"control_vertices": 6}))
    walk(resolver, 4, np.array([0.0, 0.0, -0.15]))
    tip, before = resolver.tip()[0], resolver.state
    goal = before.control_vertices[3] + [0.35, 0.1, 0.0]
    resolver.set_control_vertex_goal(3, goal)
    assert resolver.state is before
    for _ in range(120):
        assert resolver.step(position=tip).status is StepStatus.REACHED
    after = resolver.state
    assert np.linalg.norm(after.control_vertices[3] - goal) < 0.5 * np.linalg.norm(
        before.control_vertices[3] - goal
    )
    np.testing.assert_allclose(resolver.tip()[0], tip, atol=1e-6)
    faces = truss_of(resolver.setup.arm).faces
    middle = [state.nodes[faces[3]].mean(axis=0) for state in (before, after)]
    assert middle[1][0] - middle[0][0] > 0.05
    resolver.set_control_vertex_goal(3, None)
    assert resolver.control_vertex_goals == {}
    assert resolver.step(position=tip).status is StepStatus.REACHED


def test_a_goal_far_away_does_not_hold_the_tip_back():
    problem = shaped_problem(curve={"control_vertex_goals": [{"index": 2, "position": [-3.0, 0.0, 1.0]}]})
    resolver = Resolver(problem)
    np.testing.assert_array_equal(resolver.control_vertex_goals[2], [-3.0, 0.0, 1.0])
    plain = Resolver(shaped_problem())
    for each in (resolver, plain):
        walk(each, 8)
    np.testing.assert_allclose(resolver.tip()[0], plain.tip()[0], atol=1e-6)
    assert resolver.state.control_vertices[2, 0] < plain.state.control_vertices[2, 0] - 0.01


def test_goals_set_as_a_whole_and_wrong_ones_refused():
    resolver = Resolver(shaped_problem())
    resolver.control_vertex_goals = {2: [0.1, 0.0, 1.5], 3: [0.2, 0.0, 2.0]}
    assert sorted(resolver.control_vertex_goals) == [2, 3]
    setup = resolver.setup
    resolver.control_vertex_goals = {2: [0.3, 0.0, 1.5], 3: [0.2, 0.0, 2.0]}
    assert resolver.setup is setup
    np.testing.assert_array_equal(resolver.control_vertex_goals[2], [0.3, 0.0, 1.5])
    for index in (5, -1, "2"):
        with pytest.raises(GoalError, match="0 to 4"):
            resolver.set_control_vertex_goal(index, [0.0, 0.0, 1.0])
    with pytest.raises(GoalError, match="three finite"):
        resolver.set_control_vertex_goal(2, [0.0, np.nan, 1.0])
    assert sorted(resolver.control_vertex_goals) == [2, 3]
    bare = Resolver(arm_problem(bays=2, method={"tracking": "none"}))
    with pytest.raises(GoalError, match="no curve"):
        bare.set_control_vertex_goal(0, [0.0, 0.0, 1.0])
    with pytest.raises(GoalError, match="no curve"):
        bare.set_control_vertices(6)
    with pytest.raises(ProblemError, match="control_vertex_goals"):
        shaped_problem(curve={"control_vertex_goals": [{"index": 9, "position": [0.0, 0.0, 1.0]}]})


@pytest.mark.parametrize("family", ["bezier", "b-spline"])
@pytest.mark.parametrize("torsion", [0, 1])
def test_more_control_vertices_leave_the_curve_where_it_is(family, torsion):
    curve = {"family": family, "torsion_vertices": torsion}
    resolver = Resolver(shaped_problem("hexapod", 4, curve))
    walk(resolver, 3)
    s = np.linspace(0, 1, 40)

    def points():
        return Curve(resolver.setup.layout.family, resolver.state.control_vertices).position(s)

    first_setup, before = resolver.setup, points()
    assert resolver.set_control_vertices(7) < 1e-12
    assert resolver.state.control_vertices.shape == (7, 3)
    np.testing.assert_allclose(points(), before, atol=1e-12)
    gap = np.abs(gaps(resolver)[0]).max()
    walk(resolver, 3)
    assert np.abs(gaps(resolver)[0]).max() < gap + 0.05
    before = points()
    change = resolver.set_control_vertices(5)
    assert change == pytest.approx(np.linalg.norm(points() - before, axis=1).max(), rel=0.2)
    assert resolver.setup.layout.vertices == 5
    walk(resolver, 2)
    if family == "bezier":
        assert resolver.setup is first_setup
    with pytest.raises(CurveError, match="control vertices"):
        resolver.set_control_vertices(2)
    assert resolver.state.control_vertices.shape == (5, 3)


def test_a_curve_that_is_freer_than_the_arm_is_warned_of_with_the_number(caplog):
    problem = arm_problem(bays=3, curve={"control_vertices": 7})
    Resolver(problem)
    (said,) = caplog.messages
    assert re.search(
        r"control_vertices = 7: 4 or fewer.*16 degrees of freedom and the arm 9: 7 without effect", said
    )
    assert any("the arm 9" in mistake.expected for mistake in find_warnings(problem, build_arm(problem)))
    caplog.clear()
    Resolver(arm_problem(bays=3, curve={"control_vertices": 4}))
    assert not caplog.messages


def test_a_maneuver_on_a_general_curve_is_the_same_by_every_solver():
    tips = []
    for solver in ("daqp", "piqp"):
        problem = shaped_problem(
            "hexapod",
            3,
            {"nodes": "arc-length", "torsion_vertices": 1},
            steps=6,
            waypoint={"position": [0.4, 0.1, 2.1]},
            method={"solver": solver, "weights": {"spacing": 0.1}},
        )
        maneuver = vq.solve(problem)
        assert maneuver.status == "solved"
        assert maneuver.certificate.ok, maneuver.certificate.failures()
        tips.append(maneuver.nodes[-1])
    np.testing.assert_allclose(tips[1], tips[0], atol=1e-4)
