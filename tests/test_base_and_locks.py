"""A base that moves, actuators that jam, and coordinates of the end effector that an arm has or has not."""

from __future__ import annotations

import modules
import numpy as np
import pytest
from arms import arm_problem, central_differences
from scipy.spatial.transform import Rotation

import vgtm_qp as vq
from vgtm_qp.arm.arm import Pose
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.errors import GoalError, ProblemError
from vgtm_qp.methods import Resolver
from vgtm_qp.problem.truss import BasePose
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.step.path import base_motion
from vgtm_qp.step.step import StepStatus

POSES = (
    {"time": 2.0, "position": [0.2, 0.0, 0.1], "rotation_vector": [0.0, 0.2, 0.3]},
    {"time": 5.0, "position": [0.5, -0.1, 0.1], "rotation_vector": [0.0, 0.0, 0.4]},
)

HOME = Pose(np.zeros(3), np.eye(3))
STRIDE = np.array([0.05, 0.0, -0.02])
WAY = np.array([0.25, 0.1, -0.2])


@pytest.fixture(autouse=True)
def _without_a_compiler(monkeypatch):
    """So many arms are built here that the C compiler would take more time than their few steps."""
    monkeypatch.setenv("VGTM_CC", "none")


def test_a_base_passes_its_poses_and_is_rigid_between():
    truss = modules.octahedral(2)
    motion = base_motion([BasePose(**pose) for pose in POSES])

    def nodes(time):
        return HOME.carry(truss.home, motion.pose(time))

    np.testing.assert_array_equal(nodes(0.0), truss.home)
    for pose in POSES:
        turn = Rotation.from_rotvec(pose["rotation_vector"]).as_matrix()
        np.testing.assert_allclose(nodes(pose["time"]), truss.home @ turn.T + pose["position"], atol=1e-14)
        np.testing.assert_allclose(motion.pose(pose["time"]).rotation, turn, atol=1e-14)
    np.testing.assert_array_equal(nodes(9.0), nodes(5.0))
    lengths = [np.linalg.norm(np.diff(nodes(t), axis=0), axis=1) for t in (0.0, 0.7, 3.1)]
    np.testing.assert_allclose(lengths[1:], [lengths[0]] * 2, atol=1e-14)
    halfway = 0.5 * np.array(POSES[0]["position"])
    np.testing.assert_allclose(nodes(1.0)[:3].mean(axis=0), halfway, atol=1e-14)
    rate = central_differences(lambda t: nodes(float(t[0])), np.array([1.3]))
    assert np.abs(rate).max() > 0.1


def test_clearance_rows_take_a_known_displacement_out(rng):
    nodes, coefficients = rng.integers(6, size=(4, 4)), rng.normal(size=(4, 4, 3))
    rows = ClearanceRows(nodes, coefficients, rng.normal(size=4))
    known, rest = rng.normal(size=(2, 6, 3))
    known[3:], rest[:3] = 0.0, 0.0

    def slack(these, displacement):
        return np.einsum("rsc,rsc->r", coefficients, displacement[nodes]) - these.lower

    np.testing.assert_allclose(slack(rows.after(known), rest), slack(rows, known + rest), atol=1e-14)


@pytest.mark.parametrize("solver", ["daqp", "piqp"])
@pytest.mark.parametrize("joint_offset", [0.0, 0.05])
def test_a_maneuver_on_a_moving_base_is_certified(solver, joint_offset):
    problem = arm_problem(
        (1.0, 0.2, 2.2),
        bays=4,
        time=5.0,
        steps=15,
        truss={"base_motion": POSES, "joint_offset": joint_offset},
        obstacle=[{"name": "cube", "shape": "box", "center": [1.35, 0.0, 1.3], "size": 0.6}],
        method={"solver": solver},
    )
    maneuver = vq.solve(problem)
    assert maneuver.status == "solved", maneuver.manifest["blocked_by"]
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    base, home = base_motion(problem.truss.base_motion), modules.octahedral(4).home[:3]
    for time, nodes, vertices in zip(maneuver.time, maneuver.nodes, maneuver.control_vertices, strict=True):
        wanted = HOME.carry(home, base.pose(time))
        np.testing.assert_allclose(nodes[:3], wanted, atol=1e-12)
        np.testing.assert_allclose(vertices[0], wanted.mean(axis=0), atol=1e-9)
        along = vertices[1] - vertices[0]
        assert np.linalg.norm(np.cross(along, base.pose(time).rotation[:, 2])) < 1e-6
    np.testing.assert_allclose(maneuver.tip_position[-1], [1.0, 0.2, 2.2], atol=1e-6)
    altered = maneuver.nodes.copy()
    altered[7, :3] += 1e-6
    assert not vq.verify(type(maneuver)(**{**vars(maneuver), "nodes": altered})).base_error.ok
    late = {**maneuver.manifest, "problem": problem.to_dict()}
    late["problem"]["truss"]["base_motion"][0]["position"][1] += 1e-3
    assert not vq.verify(type(maneuver)(**{**vars(maneuver), "manifest": late})).base_error.ok


def locked_problem(locked, **more):
    truss = {"locked": locked, "acceleration": 2.0, **more}
    return arm_problem((0.8, 0.2, 2.2), bays=4, time=4.0, steps=12, truss=truss)


@pytest.mark.parametrize("solver", ["daqp", "piqp"])
def test_an_actuator_that_jams_keeps_its_length_from_then_on(solver):
    problem = locked_problem([{"member": "B2-1", "time": 1.9}, "B3-2"]).replace({"method.solver": solver})
    maneuver = vq.solve(problem)
    assert maneuver.status == "solved", maneuver.manifest["blocked_by"]
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    names = list(maneuver.member_names)
    lengths = maneuver.member_lengths[:, names.index("B2-1")]
    at = int(np.argmin(np.abs(maneuver.time - 1.9)))
    assert maneuver.time[at] == pytest.approx(1.9, abs=1e-12)
    np.testing.assert_allclose(lengths[at:], lengths[at], atol=1e-10)
    assert abs(lengths[at] - lengths[0]) > 1e-3
    np.testing.assert_allclose(maneuver.member_lengths[:, names.index("B3-2")], 1.0, atol=1e-10)


def test_a_jam_that_was_not_kept_is_found():
    free = vq.solve(locked_problem([]), verify=False)
    manifest = {**free.manifest, "problem": locked_problem([{"member": "B2-1", "time": 2.0}]).to_dict()}
    certificate = vq.verify(type(free)(**{**vars(free), "manifest": manifest}))
    assert not certificate.member_error.ok
    manifest = {**free.manifest, "problem": locked_problem([{"member": "B2-1", "time": 1.9}]).to_dict()}
    certificate = vq.verify(type(free)(**{**vars(free), "manifest": manifest}))
    assert any("B2-1 locks at 1.9 s" in text for text in certificate.contradictions)


def test_lock_at_run_time_holds_and_is_named():
    problem = arm_problem((0.8, 0.2, 2.2), bays=3)
    resolver, other = Resolver(problem), None
    start = resolver.tip()[0]
    resolver.step(position=start + STRIDE)
    kept = resolver.state
    for name in ("B1-1", "B2-2"):
        resolver.lock(name)
    assert resolver.locked == {"B1-1", "B2-2"}
    assert resolver.state is kept
    other = Resolver(resolver.setup)
    assert other.locked == frozenset()
    index = [truss_of(resolver.setup.arm).member(name) for name in ("B1-1", "B2-2")]
    active = set()
    for k in range(2, 8):
        step = resolver.step(position=start + STRIDE * k)
        assert step.status is StepStatus.REACHED
        active.update(step.active)
        np.testing.assert_allclose(step.state.quantities[index], kept.quantities[index], atol=1e-10)
    assert {"locked: B1-1", "locked: B2-2"} <= active
    with pytest.raises(GoalError, match=r"L1-1.*is fixed"):
        resolver.lock("L1-1")
    with pytest.raises(GoalError, match='did you mean "B1-2"'):
        resolver.lock("B1_2")


def test_an_arm_with_every_actuator_locked_stays_and_says_so():
    problem = arm_problem((0.8, 0.2, 1.2), bays=2)
    resolver = Resolver(problem)
    for name in [f"B{i}-{j}" for i in (1, 2) for j in (1, 2, 3)]:
        resolver.lock(name)
    step = resolver.step(position=resolver.tip()[0] + [0.1, 0.0, 0.0])
    assert step.progress < 1e-6
    np.testing.assert_allclose(resolver.state.nodes, resolver.setup.arm.home, atol=1e-9)


@pytest.mark.parametrize("build", [Resolver, vq.solve])
@pytest.mark.parametrize("track", [["orientation"], ["position", "orientation"], ["x", "orientation"]])
def test_roll_of_a_straight_octahedral_arm_is_refused_with_rank_and_reason(build, track):
    point = {"rotation_vector": [0.0, 0.0, 0.2], "position": [0.2, 0.0, 3.5]}
    point = point if len(track) > 1 else {**point, "position": None}
    problem = arm_problem(bays=5, waypoint=point, end_effector={"track": track})
    rows = 3 + {"orientation": 0, "position": 3, "x": 1}[track[0]]
    with pytest.raises(
        ProblemError, match=rf"end_effector\.track.*rank {rows - 1} of {rows}.*roll.*fixed longeron"
    ):
        build(problem)


def test_two_octahedral_bays_have_three_coordinates_at_home():
    point = {"pointing": [0.2, 0.0, 1.0]}
    problem = arm_problem(bays=2, waypoint=point, end_effector={"track": ["position", "pointing"]})
    with pytest.raises(ProblemError, match="rank 3 of 5"):
        Resolver(problem)
    assert Resolver(arm_problem(bays=2)).setup.task.row_names == ("tip x", "tip y", "tip z")


@pytest.mark.parametrize(
    ("module", "bays"), [("hexapod", 3), ("longeron", 6), ("tetrahedral", 3)], ids=lambda x: str(x)
)
@pytest.mark.parametrize(
    "track", [["orientation"], ["position", "orientation"], ["x", "z", "pointing"]], ids="+".join
)
def test_arms_that_can_turn_their_tip_do(module, bays, track):
    turn = Rotation.from_rotvec([0.1, -0.15, 0.2])
    home = Resolver(arm_problem(bays=bays, truss={"module": module, "stroke": None})).tip()[0]
    point = {"position": (home + WAY).tolist()} if len(track) > 1 else {"position": None}
    if "pointing" in track:
        point["pointing"] = turn.as_matrix()[:, 2].tolist()
    else:
        point["rotation_vector"] = turn.as_rotvec().tolist()
    problem = arm_problem(
        bays=bays,
        steps=8,
        truss={"module": module, "stroke": None},
        waypoint=point,
        end_effector={"track": track},
    )
    maneuver = vq.solve(problem)
    assert maneuver.status == "solved", maneuver.manifest["blocked_by"]
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    rotation = maneuver.tip_rotation[-1]
    if "pointing" in track:
        np.testing.assert_allclose(rotation[:, 2], turn.as_matrix()[:, 2], atol=1e-6)
        np.testing.assert_allclose(maneuver.tip_position[-1][[0, 2]], (home + WAY)[[0, 2]], atol=1e-6)
    else:
        np.testing.assert_allclose(rotation, turn.as_matrix(), atol=1e-6)
