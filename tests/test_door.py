"""Both kinds of arm behind the one door: what a step asks of an arm holds for trusses and for serial arms alike."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from arms import arm_problem, make_layout
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from steps import plain_arm

import vgtm_qp as vq
from vgtm_qp.arm.build import make_arm
from vgtm_qp.arm.serial import chain as serial_chain
from vgtm_qp.arm.serial.chain import SerialChain
from vgtm_qp.cli import main
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.geometry.shapes import sphere
from vgtm_qp.problem import Problem
from vgtm_qp.qp.linearise import Linearisation, StepInput
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.rows.clearance import clearance_rows
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.checks import check_problem
from vgtm_qp.step.engine import FusedEngine, GeneralEngine
from vgtm_qp.step.path import Path

H = 1e-6


def chain(links=5, *, prismatic=False, **arm):
    """Universal joints along a gentle arc, and a joint that slides at the end if asked for."""
    joints = []
    for k in range(links):
        common = {"limits": [-1.2, 1.2], "rate": 0.5}
        joints.append(
            {
                "name": f"p{k + 1}",
                "axis": [1, 0, 0],
                "position": [0, 0, 0.4 if k else 0.1],
                "home": 0.16,
                **common,
            }
        )
        joints.append({"name": f"y{k + 1}", "axis": [0, 2, 0], "home": 0.1, **common})
    if prismatic:
        slide = {"name": "slide", "kind": "prismatic", "axis": [0, 0, 1], "position": [0, 0, 0.3]}
        joints.append({**slide, "rotation_vector": [0.1, 0.2, 0.0], "limits": [-0.1, 0.3], "rate": 0.2})
    return {"joint": joints, "tip": [0.0, 0.0, 0.4], "link_radius": 0.03, **arm}


def following(arm, **followers):
    """The same arm with joints that follow others: each with a name, multiplier and offset."""
    rules = {
        name: dict(zip(("joint", "multiplier", "offset"), rule, strict=True))
        for name, rule in followers.items()
    }
    joints = [
        {**joint, "mimic": rules[joint["name"]]} if joint["name"] in rules else joint
        for joint in arm["joint"]
    ]
    return {**arm, "joint": joints}


def clothed(arm):
    """The same arm with bodies of its own: on the base, beside its links, and two that touch at home."""
    names = [joint["name"] for joint in arm["joint"]]
    body = [
        {"name": "foot", "points": [[0.0, 0.0, 0.0], [0.02, 0.0, 0.05]], "radius": 0.05},
        *(
            {"name": f"link {name}", "joint": name, "points": [[0.01, 0, 0], [0, 0.02, 0.35]], "radius": 0.03}
            for name in names[1::2]
        ),
        {"name": "fin", "joint": names[1], "points": [[0.0, 0.0, 0.8]], "radius": 0.2},
        {"name": "eye", "joint": names[-1], "points": [[0.0, 0.05, 0.1]], "radius": 0.02},
    ]
    return {**arm, "body": body, "tip_rotation_vector": [0.1, -0.2, 0.3]}


def hulled(arm):
    """The same arm with convex hulls on its links, one of them thicker by a radius, a capsule and a ball."""
    dressed = clothed(arm)
    beam = np.array(np.meshgrid((-0.03, 0.02), (-0.02, 0.03), (0.02, 0.33))).reshape(3, -1).T.tolist()
    wedge = [[-0.03, -0.03, 0.0], [0.04, 0.0, 0.02], [0.0, 0.03, 0.01], [0.0, 0.01, 0.35], [0.01, -0.02, 0.3]]
    for k, body in enumerate(body for body in dressed["body"] if body["name"].startswith("link")):
        if k < 2:
            body.update(points=(beam, wedge)[k], radius=0.01 * k)
    return dressed


def problem_of(name, **more):
    """A problem of an arm of that name that tracks a curve."""
    common = {"curve": {"control_vertices": 4}, **more}
    if name in SERIAL:
        return serial_problem(SERIAL[name], **common)
    truss = {"stroke": None, "bays": 3, **TRUSSES[name]}
    return arm_problem((0.1, 0.1, 2.2), truss=truss, bays=3, **common)


def serial_problem(arm, **more):
    maneuver = {"steps": 10, "waypoint": [{"time": 10.0, "position": [0.1, -0.2, 1.8]}]}
    return Problem.from_dict({"schema_version": 1, "arm": arm, "maneuver": maneuver, **more})


TRUSSES = {
    "octahedral": {"module": "octahedral"},
    "hexapod": {"module": "hexapod"},
    "offset joints": {"module": "octahedral", "joint_offset": 0.1},
}
SERIAL = {
    "serial": chain(),
    "serial with a slide": chain(4, prismatic=True),
    "serial, locked": chain(5, locked=["p2", "y4"]),
    "serial with followers": following(
        chain(prismatic=True), y2=("p1", -0.5, 0.05), y4=("p1", 1.0, 0.0), slide=("p5", 0.1, 0.02)
    ),
    "serial with bodies": clothed(chain(4, prismatic=True)),
    "serial with hulls": hulled(chain(4, prismatic=True)),
}


@pytest.fixture(autouse=True)
def _without_a_compiler(monkeypatch):
    monkeypatch.setenv("VGTM_CC", "none")


@pytest.fixture(params=[*TRUSSES, *SERIAL])
def name(request):
    return request.param


@pytest.fixture
def arm(name):
    return make_arm(problem_of(name))


def evaluated(arm, q):
    kinematics = arm.kinematics(compiled=False)
    kinematics.evaluate(q)
    return kinematics


def bent(arm, rng, size=0.05):
    """A configuration off home to which the actuators have led."""
    q = arm.home_configuration
    for _ in range(3):
        strokes = size * rng.normal(size=len(arm.actuators)) / 3
        q = arm.advanced(q, moved_by(arm, q, strokes), strokes)
    return q


def moved_by(arm, q, strokes):
    """Displacements (N, 3) of the nodes that belong to strokes, to first order."""
    response, _ = evaluated(arm, q).motion().response()
    nodes = np.zeros_like(arm.home)
    nodes[arm.free] = (response @ strokes).reshape(-1, 3)
    return nodes


def spanned(arm, q):
    """The points (B, V, 3) whose hulls the bodies are, but for their radii."""
    points = arm.points(q)[arm.bodies.points]
    return arm.bodies.weights_of(np.arange(len(arm.bodies))) @ points if arm.bodies.hulls else points


def derivative(arm, q, strokes, function):
    """The derivative of a function of the configuration along strokes, and the nodes' displacements per unit."""
    nodes = moved_by(arm, q, strokes)
    ahead, behind = (function(arm.advanced(q, s * H * nodes, s * H * strokes)) for s in (1.0, -1.0))
    return (np.asarray(ahead) - np.asarray(behind)) / (2.0 * H), nodes


@settings(deadline=None, max_examples=5)
@given(seed=st.integers(0, 1000))
def check_motion(arm, seed):
    rng = np.random.default_rng(seed)
    q = bent(arm, rng)
    strokes = rng.normal(size=len(arm.actuators))
    change, nodes = derivative(arm, q, strokes, arm.nodes)
    np.testing.assert_allclose(change, nodes, atol=1e-7)
    change, _ = derivative(arm, q, strokes, arm.measured)
    wanted = np.zeros(len(arm.quantity_names))
    wanted[arm.actuators] = strokes
    np.testing.assert_allclose(change, wanted, atol=1e-7)
    np.testing.assert_allclose(evaluated(arm, q).quantities, arm.measured(q), atol=1e-12)


@pytest.mark.smoke
@pytest.mark.property
def test_nodes_and_quantities_move_with_the_actuators(arm):
    check_motion(arm)


@pytest.mark.parametrize("rows", [0, 1, 7])
def test_rows_over_nodes_are_rows_over_actuators_by_the_response(arm, rows, rng):
    motion = evaluated(arm, bent(arm, rng)).motion()
    over_nodes = rng.normal(size=(rows, 3 * len(arm.free)))
    wanted = over_nodes @ motion.response()[0]
    np.testing.assert_allclose(motion.over_actuators(over_nodes), wanted, atol=1e-9)


def test_rows_over_nodes_of_a_long_arm_are_rows_over_actuators(rng):
    """Long enough for sparse matrices."""
    arm = make_arm(vq.load_problem("five_bay_free").replace({"truss.bays": 40}))
    motion = evaluated(arm, bent(arm, rng)).motion()
    over_nodes = rng.normal(size=(3, 3 * len(arm.free)))
    wanted = over_nodes @ motion.response()[0]
    np.testing.assert_allclose(motion.over_actuators(over_nodes), wanted, atol=1e-9)


def test_no_pose_is_out_of_reach(arm, rng):
    """The bound is met by the arm stretched out, and by no pose surpassed."""
    base, bound = np.flatnonzero(arm.base), arm.reach()
    for size in (0.0, 0.05, 0.2):
        q = bent(arm, rng, size) if size < 0.2 or arm.bays is not None else arm.home_configuration + 0.0
        if q.ndim == 1:
            q[:-6] += arm.following(size * 5.0 * rng.normal(size=len(q) - 6)) * arm.revolute
        nodes = arm.nodes(q)
        tip = arm.end_effector.position(nodes)
        assert (np.linalg.norm(tip - nodes[base], axis=1) <= bound + 1e-9).all()
    assert np.isfinite(bound).any()


def test_forces_do_as_much_work_as_the_load_at_the_tip(arm, rng):
    """In every motion, also one that stretches members or bends joints that cannot: virtual work."""
    q, load = bent(arm, rng), rng.normal(size=3)
    forces = arm.forces(q, load)
    for _ in range(4):
        way = np.zeros_like(q)
        if q.ndim == 2:
            way[arm.free] = rng.normal(size=(len(arm.free), 3))
        else:
            way[:-6] = arm.following(rng.normal(size=len(q) - 6))
        ends = [q + s * H * way for s in (1.0, -1.0)]
        tips = [arm.end_effector.position(arm.nodes(at)) for at in ends]
        quantities = [arm.measured(at) for at in ends]
        work = load @ (tips[0] - tips[1]) / (2.0 * H)
        assert forces @ (quantities[0] - quantities[1]) / (2.0 * H) == pytest.approx(work, abs=1e-6)


def test_weights_do_as_much_work_as_their_centres_sink(rng):
    """The centre of each mass is a body here, whose place is one of the arm's nodes."""
    centers, masses, gravity = (
        rng.uniform(-0.3, 0.3, (4, 3)),
        rng.uniform(0.0, 3.0, 4),
        np.array([1.0, -2.0, -9.0]),
    )
    kinds = ["revolute", "prismatic", "revolute", "revolute"]
    joints = [
        {
            "name": f"j{k}",
            "kind": kind,
            "axis": rng.normal(size=3).tolist(),
            "position": [0.1, 0.0, 0.3],
            "rotation_vector": rng.normal(size=3).tolist(),
            "mass": masses[k],
            "center_of_mass": centers[k].tolist(),
        }
        for k, kind in enumerate(kinds)
    ]
    joints[1]["limits"], joints[3]["mimic"] = [-1.0, 1.0], {"joint": "j0", "multiplier": -0.7}
    bodies = [
        {"name": f"b{k}", "joint": f"j{k}", "points": [center.tolist()], "radius": 0.01}
        for k, center in enumerate(centers)
    ]
    table = {"joint": joints, "body": bodies, "tip": [0.0, 0.0, 0.2]}
    waypoint = [{"time": 1.0, "position": [0.5, 0.0, 0.5]}]
    arm = make_arm(vq.Problem.from_dict({"arm": table, "maneuver": {"waypoint": waypoint}}))
    assert arm.mass == pytest.approx(masses.sum())
    q = bent(arm, rng)
    q[-6:] = rng.normal(size=6)
    forces = arm.forces(q, np.zeros(3), gravity=gravity)
    for _ in range(4):
        way = np.zeros_like(q)
        way[:-6] = arm.following(rng.normal(size=4))
        ends = [q + s * H * way for s in (1.0, -1.0)]
        # A ball's axis is short, not zero: its middle is the ball's centre.
        heights = [masses @ (arm.nodes(at)[arm.bodies.points].mean(axis=1) @ gravity) for at in ends]
        moved = [arm.measured(at) for at in ends]
        work = (heights[0] - heights[1]) / (2.0 * H)
        assert forces @ (moved[0] - moved[1]) / (2.0 * H) == pytest.approx(work, abs=1e-6)


TRACKS = [("position",), ("position", "orientation"), ("x", "z", "pointing")]


@pytest.mark.smoke
@pytest.mark.parametrize("track", TRACKS, ids="+".join)
def test_rows_of_tip_and_stations_are_the_derivatives_of_their_residuals(arm, track, rng):
    layout, _ = make_layout(arm, track, vertices=5)
    linearisation = Linearisation(layout, compiled=False)
    q = bent(arm, rng)
    kinematics, tip, count = evaluated(arm, q), arm.end_effector, len(arm.actuators)
    goal = TipGoal(
        tip.position(arm.nodes(q)), kinematics.tip_rotation.copy(), rng.normal(size=3), np.zeros(3)
    )
    vertices = np.linspace(0.0, 1.0, 5)[:, None] * goal.position + 0.05 * rng.normal(size=(5, 3))

    def numbers(at):
        box = arm.measured(at)[arm.actuators]
        asked = StepInput(at, at, arm.nodes(at), vertices, box - 0.1, box + 0.1, True, 0.0, goal)
        return linearisation.numbers(asked, ClearanceRows())

    here = numbers(q)
    response, rest = here.motion.response()
    np.testing.assert_allclose(response, kinematics.motion().response()[0], atol=1e-10)
    assert np.abs(rest).max() < 0.05
    strokes = rng.normal(size=count)
    gap, nodes = derivative(arm, q, strokes, lambda at: numbers(at).position_rhs)
    centres = np.einsum("fk,fkc->fc", arm.stations.weights, nodes[arm.stations.nodes])[layout.tracked]
    np.testing.assert_allclose(gap, centres, atol=1e-6)
    turn, _ = derivative(arm, q, strokes, lambda at: numbers(at).tangent_rhs)
    over_faces = nodes[arm.stations.nodes[layout.tracked]].reshape(len(layout.tracked), 9)
    np.testing.assert_allclose(turn, np.einsum("ktn,kn->kt", here.tangent_face, over_faces), atol=1e-6)
    error, _ = derivative(arm, q, strokes, lambda at: numbers(at).tip_rhs)
    np.testing.assert_allclose(-error, here.tip_jacobian @ nodes[tip.nodes].reshape(-1), atol=1e-6)
    if "position" in track:
        np.testing.assert_allclose(here.tip_rate[:3], goal.velocity, atol=1e-12)


def test_rows_of_clearances_are_the_derivatives_of_the_distances(arm, rng):
    q = bent(arm, rng)
    points = arm.points(q)
    beside = points[arm.bodies.points[len(arm.bodies) // 2]].mean(axis=0) + np.array([0.31, 0.17, 0.05])
    monitor = Clearance(arm.bodies, [sphere("ball", beside, 0.1)], safe=0.05, influence=1.0)
    strokes = rng.normal(size=len(arm.actuators))

    def contacts(at):
        return monitor.near(arm.points(at), self_reach=0.6)

    def ordered(found):
        """Distances by pair, those of pairs with one row."""
        pairs = [found.pair(k) for k in range(len(found))]
        return {
            pair: float(d) for pair, d in zip(pairs, found.distance, strict=True) if pairs.count(pair) == 1
        }

    here = contacts(q)
    coefficients, _ = clearance_rows(here.distance, here.normal, here.weights, here.is_self, 0.05, 0.05)
    over, coefficients = arm.over_nodes(q, here.points, coefficients)
    nodes = moved_by(arm, q, strokes)
    ahead, behind = (ordered(contacts(arm.advanced(q, s * H * nodes, s * H * strokes))) for s in (1.0, -1.0))
    compared = 0
    for k in range(len(here)):
        pair = here.pair(k)
        if pair in ahead and pair in behind and pair in ordered(here):
            row = float(np.sum(coefficients[k] * nodes[over[k]]))
            assert row == pytest.approx((ahead[pair] - behind[pair]) / (2.0 * H), abs=2e-5)
            compared += 1
    assert compared >= 3


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10_000), size=st.floats(0.001, 0.5))
def check_deviation(arm, seed, size):
    rng = np.random.default_rng(seed)
    start = bent(arm, rng, 0.2)
    end = start + size * rng.normal(size=start.shape) / len(start)
    bound = arm.deviation(start, end)

    def places(q):
        # The corners round hulls may go further than these.
        return spanned(arm, q).reshape(-1, 3) if arm.bodies.hulls else arm.points(q)

    first, last = places(start), places(end)
    for s in np.linspace(0.0, 1.0, 9)[1:-1]:
        off = places(start + s * (end - start)) - (first + s * (last - first))
        # Two points that both leave their chords come nearer by twice as much.
        assert 2.0 * np.linalg.norm(off, axis=1).max() <= bound + 1e-12
    moved = last - first if arm.bodies.hulls else arm.nodes(end) - arm.nodes(start)
    assert np.abs(moved).max() <= arm.travel(end - start) + 1e-12


@pytest.mark.property
@pytest.mark.parametrize("name", ["offset joints", *SERIAL])
def test_points_leave_their_chords_by_no_more_than_is_said(name):
    arm = make_arm(problem_of(name))
    assert arm.leaves_chords
    check_deviation(arm)


@pytest.mark.parametrize("name", ["octahedral", "hexapod"])
def test_points_of_pin_joints_stay_on_their_chords(name, rng):
    arm = make_arm(problem_of(name))
    assert not arm.leaves_chords
    start, end = bent(arm, rng), bent(arm, rng)
    half = arm.points(0.5 * (start + end))
    np.testing.assert_allclose(half, 0.5 * (arm.points(start) + arm.points(end)), atol=1e-14)


CLUTTER = {
    "obstacle": [{"name": "ball", "shape": "sphere", "center": [0.8, 0.3, 1.2], "radius": 0.2}],
    "clearance": {"safe": 0.05, "influence": 0.5},
}


def stride_of(arm):
    return 0.004 * arm.height * np.array([1.0, 0.6, -0.5])


@pytest.mark.parametrize("solver", ["daqp", "osqp"])
def test_steps_reach_their_goals_keep_their_limits_and_stay_clear(name, solver):
    problem = problem_of(name, method={"solver": solver}, **CLUTTER)
    resolver = vq.Resolver(problem)
    arm = resolver.setup.arm
    moved = 0
    for _ in range(8):
        before = resolver.state
        goal = resolver.tip()[0] + stride_of(arm)
        step = resolver.step(position=goal)
        if step.status is vq.StepStatus.BLOCKED:
            assert step.reason or step.blocked_by
            break
        moved += 1
        state = resolver.state
        if step.progress == 1.0:
            np.testing.assert_allclose(resolver.tip()[0], goal, atol=1e-6)
        values = arm.measured(state.q)
        np.testing.assert_allclose(values, state.quantities, atol=1e-9)
        fixed = ~arm.actuated
        np.testing.assert_allclose(values[fixed], arm.home_quantities[fixed], atol=1e-9)
        stroke = arm.stroke[arm.actuators]
        assert (values[arm.actuators] >= stroke[:, 0] - 1e-9).all()
        assert (values[arm.actuators] <= stroke[:, 1] + 1e-9).all()
        rates = np.abs(values - arm.measured(before.q))[arm.actuators] / (state.time - before.time)
        assert (rates <= arm.rate[arm.actuators] + 1e-9).all()
        for s in np.linspace(0.0, 1.0, 21):
            least = resolver.setup.least_clearance(
                before.q + s * (state.q - before.q), state.time, "obstacles"
            )
            assert least >= 0.05 - 1e-4
    assert moved >= 3


@pytest.mark.parametrize("hard", [False, True])
def test_both_engines_take_the_same_steps(name, hard):
    method = {"tracking_mode": "hard" if hard else "elastic"}
    problem = problem_of(name, method=method, **CLUTTER)
    fast, plain = vq.Resolver(build_arm(problem)), vq.Resolver(plain_arm(problem, compiled=False))
    assert isinstance(fast.setup.engine, FusedEngine)
    assert isinstance(plain.setup.engine, GeneralEngine)
    for _ in range(4):
        plain.state = fast.state
        goal = fast.tip()[0] + stride_of(fast.setup.arm)
        first, second = fast.step(position=goal), plain.step(position=goal)
        assert first.status is second.status
        if first.status is vq.StepStatus.BLOCKED:
            break
        np.testing.assert_allclose(fast.state.q, plain.state.q, atol=1e-6 if hard else 1e-8)


def test_a_moving_base_carries_every_arm(name):
    where = {"time": 5.0, "position": [0.1, 0.0, 0.05], "rotation_vector": [0.0, 0.0, 0.1]}
    table = {"base_motion": [where]}
    if name in SERIAL:
        problem = serial_problem({**SERIAL[name], **table}, curve={"control_vertices": 4})
    else:
        truss = {"stroke": None, "bays": 3, **TRUSSES[name], **table}
        problem = arm_problem((0.1, 0.1, 2.2), truss=truss, bays=3, curve={"control_vertices": 4})
    resolver = vq.Resolver(problem)
    arm = resolver.setup.arm
    for _ in range(3):
        goal = resolver.tip()[0] + stride_of(arm)
        step = resolver.step(position=goal, dt=1.0)
        assert step.status is vq.StepStatus.REACHED, step.reason
    turn = Rotation.from_rotvec([0.0, 0.0, 0.1 * 3 / 5]).as_matrix()
    wanted = arm.home[arm.base] @ turn.T + 0.6 * np.array([0.1, 0.0, 0.05])
    np.testing.assert_allclose(resolver.state.nodes[arm.base], wanted, atol=1e-9)
    np.testing.assert_allclose(resolver.tip()[0], goal, atol=1e-6)


TURNING = [
    {"time": t, "rotation_vector": [0.0, 0.0, angle]}
    for t, angle in ((3.0, 2.9), (4.0, 3.6), (8.0, 6.4), (9.0, 6.6))
]


@pytest.mark.parametrize("serial", list(SERIAL))
def test_stations_are_as_many_as_can_keep_to_the_curve(serial):
    arm = make_arm(problem_of(serial))
    assert arm.stations.trackable == ("position",)
    every = arm.chain.every
    assert not make_arm(serial_problem({**SERIAL[serial], "every": every - 1})).stations.trackable


def test_a_straight_snake_has_stations_that_it_cannot_hold():
    joints = [{**joint, "home": 0.0} for joint in chain()["joint"]]
    arm = make_arm(serial_problem(chain(joint=joints)))
    assert not arm.stations.trackable
    assert len(arm.stations) == 4


def test_a_base_may_turn_on_past_half_a_turn_and_past_a_whole_one():
    resolver = vq.Resolver(serial_problem({**chain(), "base_motion": TURNING}, curve={"control_vertices": 4}))
    away = resolver.tip()[0]
    while resolver.state.time < 9.0 - 1e-9:
        then = resolver.setup.base_at(resolver.state.time + 0.05)
        step = resolver.step(position=then.rotation @ away, dt=0.05)
        assert step.status is vq.StepStatus.REACHED, (resolver.state.time, step.reason)
    np.testing.assert_allclose(resolver.state.q[-3:], [0.0, 0.0, 6.6], atol=1e-9)


def test_the_base_that_verification_places_turns_on_too():
    from vgtm_qp.result.poses import base_poses
    from vgtm_qp.step.path import base_motion

    problem = serial_problem({**chain(), "base_motion": TURNING})
    times = np.linspace(0.0, 10.0, 301)
    poses = base_poses(problem.to_dict(), times)
    assert np.abs(np.diff(poses[:, 3:], axis=0)).max() < 0.05
    motion = base_motion(problem.arm.base_motion)
    for time, pose in zip(times, poses, strict=True):
        np.testing.assert_allclose(
            Rotation.from_rotvec(pose[3:]).as_matrix(), motion.pose(time).rotation, atol=1e-12
        )


@pytest.mark.parametrize("serial", list(SERIAL))
def test_a_chain_is_where_the_product_of_its_joints_says(serial, rng):
    arm = make_arm(problem_of(serial))
    joints = SERIAL[serial]["joint"]
    for _ in range(5):
        q = np.concatenate([rng.uniform(-1.0, 1.0, len(joints)), rng.normal(size=6)])
        at, frame = q[-6:-3], Rotation.from_rotvec(q[-3:])
        origins = [at]
        for joint, value in zip(joints, q, strict=False):
            axis = np.array(joint["axis"]) / np.linalg.norm(joint["axis"])
            at = at + frame.apply(joint.get("position", [0.0, 0.0, 0.0]))
            frame = frame * Rotation.from_rotvec(joint.get("rotation_vector", [0.0, 0.0, 0.0]))
            origins.append(at)
            if joint.get("kind") == "prismatic":
                at = at + value * frame.apply(axis)
            else:
                frame = frame * Rotation.from_rotvec(value * axis)
        origins.append(at + frame.apply([0.0, 0.0, 0.4]))
        np.testing.assert_allclose(arm.nodes(q)[: len(origins)], origins, atol=1e-12)
        np.testing.assert_allclose(arm.end_effector.position(arm.nodes(q)), origins[-1], atol=1e-12)


def solved(name, **more):
    """The whole maneuver of an arm, past a ball."""
    problem = problem_of(name, **{**CLUTTER, **more})
    tip = vq.Resolver(problem).tip()[0]
    waypoint = [{"time": 10.0, "position": (tip + 8.0 * stride_of(make_arm(problem))).tolist()}]
    return vq.solve(problem.replace({"maneuver.waypoint": waypoint, "maneuver.steps": 12}))


@pytest.fixture(scope="module")
def maneuvers():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VGTM_CC", "none")
        return {name: solved(name) for name in [*TRUSSES, *SERIAL]}


def test_certificates_hold_and_files_come_back_as_they_went(name, maneuvers, tmp_path):
    maneuver = maneuvers[name]
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    assert maneuver.steps >= 3
    assert np.isfinite(maneuver.certificate.clearance_between.value)
    again = vq.load_result(maneuver.save(tmp_path / "result.npz"))
    assert set(again.arrays) == set(maneuver.arrays)
    for key, array in maneuver.arrays.items():
        np.testing.assert_array_equal(again.arrays[key], array)
    serial = {"joints", "joint_names", "body_names"}
    trusses = {"nodes", "members", "member_names", "member_actuated", "member_lengths"}
    assert (set(again.arrays) & (serial | trusses)) == (serial if name in SERIAL else trusses)
    assert vq.verify(again).ok
    arm = make_arm(problem_of(name))
    # Of hulls the nodes of a result are the vertices, those of the arm are not.
    count = min(again.nodes.shape[1], len(arm.home)) if not arm.bodies.hulls else arm.segments + 2
    np.testing.assert_allclose(again.nodes[0, :count], arm.home[:count], atol=1e-12)
    if name in SERIAL:
        drawn = np.unique(spanned(arm, arm.home_configuration).reshape(-1, 3).round(9), axis=0)
        recorded = again.nodes[0][again.members]
        np.testing.assert_allclose(drawn, np.unique(recorded.reshape(-1, 3).round(9), axis=0), atol=1e-8)


def test_a_certificate_finds_states_that_were_bent(name, maneuvers, rng):
    from dataclasses import replace

    maneuver = maneuvers[name]
    key = "joints" if name in SERIAL else "nodes"
    bent_states = getattr(maneuver, key).copy()
    bent_states[-1] += 1e-4 * rng.normal(size=bent_states[-1].shape)
    found = vq.verify(replace(maneuver, **{key: bent_states}))
    assert not found.ok
    assert any(line.startswith(("tip error", "array error")) for line in found.failures())


def test_a_ball_that_was_moved_into_the_way_is_found_between_states(name, maneuvers):
    from dataclasses import replace

    maneuver = maneuvers[name]
    middle = maneuver.nodes[-2:, maneuver.members[-1]].mean(axis=(0, 1))
    ball = {**maneuver.manifest["problem"]["obstacle"][0], "center": middle.tolist(), "radius": 0.01}
    problem = {**maneuver.manifest["problem"], "obstacle": [ball]}
    found = vq.verify(replace(maneuver, manifest={**maneuver.manifest, "problem": problem}))
    assert found.clearance_between.value < 0.0
    assert any(line.startswith("clearance between") for line in found.failures())


def test_the_record_of_a_serial_arm_is_held_against_its_problem(maneuvers):
    from dataclasses import replace

    maneuver = maneuvers["serial"]
    arm = maneuver.manifest["arm"]
    for key, value in {
        "rate": [1.0, *arm["rate"][1:]],
        "axis": [[0.0, 1.0, 0.0], *arm["axis"][1:]],
        "radius": [0.01] * len(arm["radius"]),
        "tip": [0.0, 0.0, 0.5],
    }.items():
        changed = {**maneuver.manifest, "arm": {**arm, key: value}}
        found = vq.verify(replace(maneuver, manifest=changed))
        assert any("arm record" in line for line in found.contradictions), key
    with pytest.raises(vq.VgtmError, match="joints"):
        replace(maneuver, joints=maneuver.joints[:, 1:], joint_names=maneuver.joint_names[1:])


def test_a_recorded_chain_bends_no_more_than_its_bound(rng):
    from vgtm_qp.result.chain import RecordedChain

    for serial in SERIAL:
        arm = make_arm(problem_of(serial))
        chain = RecordedChain(arm.record())
        for size in (0.01, 0.3):
            before = arm.home_configuration + 0.2 * rng.normal(size=arm.home_configuration.shape)
            after = before + size * rng.normal(size=before.shape)
            # What the base slides is straight.
            ways = before + np.linspace(0.0, 1.0, 201)[:, None] * (after - before)
            points = chain.placed(ways)[0]
            count = arm.segments + 2 if arm.bodies.hulls else points.shape[1]
            np.testing.assert_allclose(points[0, :count], arm.nodes(before)[:count], atol=1e-12)
            second = np.linalg.norm(np.diff(points, n=2, axis=0), axis=2).max(axis=0) * 200.0**2
            bound = chain.bend(before, after, np.arange(len(chain.links)))
            assert (second[chain.links].max(axis=1) <= bound * (1.0 + 1e-6) + 1e-9).all()


def test_bodies_come_no_nearer_than_the_bound_of_their_approach(rng):
    tightest = np.inf
    for serial in SERIAL:
        arm = make_arm(problem_of(serial))
        joints = len(arm.chain)
        slides = ~arm.revolute
        for size in (0.02, 0.5):
            before = arm.home_configuration + 0.3 * rng.normal(size=joints + 6)
            motion = size * rng.normal(size=joints + 6) * rng.integers(0, 2, size=joints + 6)
            motion[joints:] = 0.0
            before[:-6][slides] = rng.uniform(*arm.values[slides].T)
            motion[:-6][slides] = rng.uniform(*arm.values[slides].T) - before[:-6][slides]
            approach, bodies = arm.approach(motion), np.arange(len(arm.bodies))
            ends = np.stack([spanned(arm, before + s * motion) for s in np.linspace(0, 1, 21)])
            # Points of a body: its ends and its middle.
            points = np.concatenate([ends, ends.mean(axis=2, keepdims=True)], axis=2)
            moved = np.linalg.norm(points - points[0], axis=3).max(axis=(0, 2))
            assert (moved <= approach(bodies) + 1e-12).all()
            first, second = np.triu_indices(len(bodies), 1)
            apart = np.linalg.norm(points[:, first, :, None] - points[:, second, None], axis=4)
            nearer, bound = (apart[0] - apart).max(axis=(0, 2, 3)), approach(first, second)
            assert (nearer <= bound + 1e-12).all()
            np.testing.assert_allclose(bound, approach(second, first))
            assert (bound <= approach(first) + approach(second) + 1e-12).all()
            tightest = min(tightest, float((bound / np.maximum(nearer, 1e-3)).min()))
        still = arm.approach(np.zeros(joints + 6))
        assert not still(bodies).any()
        assert not still(first, second).any()
    assert tightest < 1.5


@pytest.mark.parametrize("form", ["png", "html", "csv", "mcap", "ros"])
def test_a_serial_maneuver_is_drawn_and_exported(form, maneuvers, tmp_path):
    from vgtm_qp.export.formats import export_maneuver

    path = export_maneuver(
        maneuvers["serial"], tmp_path / f"snake.{'yaml' if form == 'ros' else form}", to=form
    )
    assert path.stat().st_size > 500


def joint(name, axis=(1, 0, 0), position=(0, 0, 0.5), **more):
    return {"name": name, "axis": list(axis), "position": list(position), "home": 0.1, **more}


FINGERS = [joint("a"), joint("b", (0, 1, 0)), joint("c")]
MISTAKES = {
    "no length": ([joint("a"), joint("b", position=(0, 0, 0))], {"tip": [0, 0, 0]}, "arm.tip"),
    "one joint": ([joint("a")], {}, "end_effector.track"),
    "all locked": (FINGERS, {"locked": ["a", "b", "c"]}, "end_effector.track"),
    "no end of a slide": ([*FINGERS, joint("s", (0, 0, 1), kind="prismatic", home=0.0)], {}, "limits"),
    "links in one another": (
        [
            joint(name, axis, (0, 0, 0), kind="prismatic", home=0.0, limits=[-1, 1])
            for name, axis in (("x", (1, 0, 0)), ("y", (0, 1, 0)), ("z", (0, 0, 1)))
        ],
        {},
        "arm.link_radius",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_an_arm_that_cannot_be_moved_is_refused_by_the_key_that_is_to_blame(mistake):
    joints, more, key = MISTAKES[mistake]
    with pytest.raises(vq.ProblemError) as raised:
        vq.solve(
            serial_problem(
                {
                    "joint": [dict(j, axis=[float(x) for x in j["axis"]]) for j in joints],
                    "tip": [0, 0, 0.5],
                    **more,
                }
            )
        )
    assert key in str(raised.value)


def test_a_straight_home_is_refused_with_one_that_works():
    problem = vq.load_problem("snake_past_a_cube")
    data = problem.to_dict()
    for one in data["arm"]["joint"]:
        one["home"] = 0.0
    with pytest.raises(vq.ProblemError) as raised:
        vq.solve(Problem.from_dict(data))
    values = re.search(r"it can with home values ([-\d., e]+)", str(raised.value))
    for one, value in zip(data["arm"]["joint"], values[1].split(","), strict=True):
        one["home"] = float(value)
    resolver = vq.Resolver(Problem.from_dict(data))
    for axis in np.eye(3):
        assert resolver.step(position=resolver.tip()[0] - 0.01 * axis).progress > 0.9


WIDE = chain(10, joint=[{**joint, "limits": [-2.5, 2.5]} for joint in chain(10)["joint"]])
STOPS = {
    "its own links": (
        WIDE,
        {"clearance": {"safe": 0.1, "self_safe": 0.1}},
        [0.0, 0.0, 0.4],
        r"link \w+ / link \w+$",
    ),
    "a ball": (
        chain(),
        {"obstacle": [{"name": "ball", "shape": "sphere", "center": [0.9, -0.9, 1.3], "radius": 0.3}]},
        [0.9, -0.9, 1.3],
        r"link \w+ / ball$",
    ),
}


@pytest.mark.parametrize("what", STOPS)
def test_what_stops_a_serial_arm_is_named_as_what_it_is(what):
    arm, more, towards, name = STOPS[what]
    resolver = vq.Resolver(serial_problem(arm, curve={"control_vertices": 4}, **more))
    for _ in range(200):
        (here, rotation), last = resolver.tip(), resolver.state
        stride = 0.03 * (towards - here) / np.linalg.norm(towards - here)
        step = resolver.step(position=here + stride)
        if step.progress < 1e-3 or np.linalg.norm(resolver.tip()[0] - towards) < 0.03:
            break
    path = Path(np.array([0.0, 1.0]), np.stack([here, here + stride]), np.stack([rotation, rotation]))
    stop = resolver.explain(path, 0.0, 1.0, last=step, state=last)
    assert stop.kind.value == ("obstacle" if what == "a ball" else "members")
    assert stop.obstacles == (("ball",) if what == "a ball" else ())
    assert any(re.search(name, one) for one in stop.names)


def test_a_lock_of_what_an_arm_has_not_names_what_it_has():
    with pytest.raises(vq.GoalError, match=r'"p9", which there is not; actuators are p1, y1'):
        vq.Resolver(problem_of("serial")).lock("p9")


def test_stations_of_joints_in_one_place_have_an_attitude():
    problem = vq.load_problem("snake_past_a_cube").replace({"arm.every": 1})
    stations = build_arm(problem, solves=False).arm.stations
    assert (
        (np.diff(stations.centres(build_arm(problem, solves=False).arm.home), axis=0) == 0.0)
        .all(axis=1)
        .any()
    )
    np.testing.assert_allclose(
        stations.frames @ np.swapaxes(stations.frames, 1, 2) - np.eye(3), 0.0, atol=1e-12
    )


@pytest.mark.parametrize("tracking", ["parallel", "recursive"])
def test_a_qp_by_bays_is_refused_by_its_key(tracking):
    with pytest.raises(vq.ProblemError, match=rf'method\.tracking: found "{tracking}"'):
        vq.load_problem("snake_past_a_cube").replace({"method.tracking": tracking})


def test_a_locked_joint_is_named_as_one_and_the_key_of_trusses_is_read_too():
    tables = [["p2", {"joint": "y4", "time": 4.0}], [{"member": "p2"}, {"member": "y4", "time": 4.0}]]
    problems = [serial_problem(chain(locked=locked)) for locked in tables]
    assert problems[0] == problems[1] == Problem.from_dict(problems[1].to_dict())
    assert build_arm(problems[0], solves=False).jams == (("y4", 4.0),)
    for wrong, key in (({"joint": "p9"}, "arm.locked[0].joint"), ({"link": "p2"}, "arm.locked[0].link")):
        with pytest.raises(vq.ProblemError) as raised:
            serial_problem(chain(locked=[wrong]))
        assert key in str(raised.value)


def test_a_joint_that_jams_on_the_way_is_held_and_certified():
    problem = serial_problem(chain(locked=[{"joint": "y4", "time": 4.0}]), curve={"control_vertices": 4})
    maneuver = vq.solve(problem)
    later = maneuver.joints[maneuver.time >= 4.0 - 1e-9, maneuver.joint_names.tolist().index("y4")]
    assert len(later) > 1
    np.testing.assert_allclose(later, later[0], atol=1e-9)
    assert vq.verify(maneuver).ok


def test_a_goal_out_of_reach_is_measured_from_the_base_itself():
    problem = serial_problem(chain()).replace({"maneuver.waypoint": [{"time": 1.0, "position": [0, 0, 9]}]})
    mistakes = check_problem(problem, build_arm(problem, solves=False))
    assert any('from base node "base", all links' in str(mistake) for mistake in mistakes)


def test_one_station_is_told_of_in_the_singular():
    text = str(make_arm(serial_problem(chain(every=10))).describe())
    assert "\n1 station tracks the curve; it " in text
    assert "stations" not in text


@pytest.mark.parametrize("command", [["replay"], ["export", "--to", "mjcf"]])
def test_what_mujoco_cannot_model_of_a_serial_arm_is_named_with_its_file(command, tmp_path, capsys):
    pytest.importorskip("mujoco")
    arm = chain(4, prismatic=True)
    file = vq.solve(serial_problem(arm, curve={"control_vertices": 4})).save(tmp_path / "arm.npz")
    assert main([command[0], str(file), *command[1:]]) == 2
    assert f"{file}: link slide stretches" in capsys.readouterr().err


def test_bodies_that_touch_at_home_are_not_kept_apart_and_that_is_told():
    maneuver = vq.solve(problem_of("serial with bodies"))
    record = maneuver.manifest["arm"]
    names = record["body_names"]
    touching = {frozenset(names[k] for k in pair) for pair in record["touching"]}
    assert touching
    assert all("fin" in pair for pair in touching)
    assert maneuver.status == "solved", str(maneuver.certificate)
    apart = [names.index("foot"), names.index("eye")]
    forged = {**maneuver.manifest, "arm": {**record, "touching": [*record["touching"], apart]}}
    certificate = vq.verify(replace(maneuver, manifest=forged))
    assert any("foot / eye do not touch at home" in line for line in certificate.contradictions)


def test_the_attitude_of_the_tip_is_that_of_the_last_frame_turned():
    arm = make_arm(problem_of("serial with bodies"))
    frame = np.eye(3)
    for joint in SERIAL["serial with bodies"]["joint"]:
        turn = (
            joint["home"] * np.array(joint["axis"]) / np.linalg.norm(joint["axis"])
            if "home" in joint
            else [0.0] * 3
        )
        placed = Rotation.from_rotvec(joint.get("rotation_vector", [0.0] * 3))
        frame = frame @ placed.as_matrix() @ Rotation.from_rotvec(turn).as_matrix()
    wanted = frame @ Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    np.testing.assert_allclose(evaluated(arm, arm.home_configuration).tip_rotation, wanted, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda bodies: bodies[1].update(radius=0.04), "shape of body link y1"),
        (lambda bodies: bodies[1].update(radius=0.0299), "shape of body link y1"),
        (lambda bodies: bodies[1].update(points=[[0.01, 0, 0], [0, 0.02, 0.35001]]), "shape of body link y1"),
        (lambda bodies: bodies[-1].update(points=[[0.0, 0.05, 0.1001]]), "shape of body eye"),
        (lambda bodies: bodies[1].update(points=[[0, 0, 0], [0, 0, 0.3]]), "shape of body link y1"),
        (lambda bodies: bodies[1].update(joint="p1"), "joint of body link y1"),
        (lambda bodies: bodies[0].update(joint="p1"), "joint of body foot"),
        (lambda bodies: bodies.pop(), "bodies of the arm record"),
    ],
)
def test_bodies_of_another_problem_are_found(change, said):
    problem = problem_of("serial with bodies")
    maneuver = vq.solve(problem)
    data = problem.to_dict()
    change(data["arm"]["body"])
    certificate = vq.verify(maneuver, problem=Problem.from_dict(data))
    assert any(said in line for line in certificate.contradictions)


@pytest.mark.parametrize("prismatic", [False, True])
def test_long_chains_loop_over_their_joints_and_give_the_same(monkeypatch, prismatic, rng):
    spec = serial_problem(chain(12, prismatic=prismatic)).arm
    looped, written_out = SerialChain.of(spec, []), SerialChain.of(spec, [])
    monkeypatch.setattr(serial_chain, "UNROLLED", 0)
    assert looped.functions[1].is_a("MXFunction")
    monkeypatch.setattr(serial_chain, "UNROLLED", 100)
    assert written_out.functions[1].is_a("SXFunction")
    q = rng.normal(scale=0.3, size=len(looped) + 6)
    for one, other in zip(looped.at(q), written_out.at(q), strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-14)
