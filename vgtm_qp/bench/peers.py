"""Other packages that move arms by one QP a step: mink, on MuJoCo, and pink, on Pinocchio.

Both get the serial arm of a problem with its limits and rates, its links as capsules, its boxes, and the
tip's position with a slight pull to the home pose. Distances enter as rows at the state where a step begins.
Neither package checks the new state, or the motion to it.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from itertools import combinations
from types import ModuleType
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from vgtm_qp.arm.serial.arm import SerialArm
from vgtm_qp.arrays import Array
from vgtm_qp.bench.tour import Goal
from vgtm_qp.errors import SolverError
from vgtm_qp.problem import Problem
from vgtm_qp.rotation import rotation_from_vector
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State

_TIP_COST, _POSTURE_COST = 50.0, 1e-3
"""Weights that pink's examples give a tip and a posture."""
_APPROACH = 0.85
"""Largest share of its distance that a pair may lose in one step: mink's own choice."""


class Link(NamedTuple):
    """A capsule from the origin of a joint's frame to a point (3,) in that frame, m; `joint` counts from 0."""

    name: str
    joint: int
    end: Array
    radius: float


class JointScene(NamedTuple):
    """What a peer's model is made of: the arm of a setup, its links, and pairs of links that keep apart."""

    setup: Setup
    arm: SerialArm
    links: list[Link]
    pairs: list[tuple[int, int]]
    problem: Problem

    @classmethod
    def of(cls, problem: Problem) -> JointScene:
        """Return the scene of a problem.

        Raises
        ------
        SolverError
            The problem has parts that these models lack.
        """
        setup = build_arm(problem.replace({"method.solver": "piqp"}))
        arm = setup.arm
        if not isinstance(arm, SerialArm) or not arm.revolute.all() or not arm.actuated.all():
            raise SolverError("a model of serial arms whose joints all turn, and none is locked")
        if setup.task.track != ("position",) or any(cube.shape != "box" for cube in problem.obstacle):
            raise SolverError("a model whose tip tracks its position, among boxes alone")
        ends = np.vstack([arm.chain.position, arm.chain.tip])[1:]
        bodies = arm.bodies
        # A link lies between node 1 + j, the origin of joint j, and the node after it.
        joints = (bodies.points[:, 0] - 1).tolist()
        links = [
            Link(name, j, ends[j], float(radius))
            for name, j, radius in zip(bodies.names, joints, bodies.radius, strict=True)
        ]
        apart = problem.clearance.self_collision
        pairs = [
            (a, b)
            for a, b in combinations(range(len(links)), 2)
            if apart and not set(bodies.joints[a].tolist()) & set(bodies.joints[b].tolist())
        ]
        return cls(setup, arm, links, pairs, problem)


class _JointStep:
    """A peer whose joint values are in a configuration of its own package."""

    _configuration: Any

    @property
    def reached(self) -> Array:
        """Joint values (J,) after the step, rad."""
        return np.array(self._configuration.q)

    @property
    def configuration(self) -> Array:
        """See :class:`~vgtm_qp.bench.between.Walker`."""
        return np.append(self.reached, np.zeros(6))

    def place(self, state: State) -> None:
        """See :class:`~vgtm_qp.bench.contestants.Contestant`."""
        self._configuration.update(state.quantities)


class MinkStep(_JointStep):
    """Steps by mink 1.x: frame and posture task, limits of joints, speeds and collisions, solved by DAQP."""

    def __init__(self, problem: Problem) -> None:
        scene = JointScene.of(problem)
        self._mink = mink = _installed("mink", "mink")
        model = _installed("mujoco", "mujoco").MjModel.from_xml_string(mjcf(scene))
        arm, setup = scene.arm, scene.setup
        self._configuration = mink.Configuration(model, arm.home_quantities)
        self._tip = mink.FrameTask("tip", "site", position_cost=_TIP_COST, orientation_cost=0.0)
        posture = mink.PostureTask(model, cost=_POSTURE_COST)
        posture.set_target_from_configuration(self._configuration)
        self._tasks, self._dt = [self._tip, posture], setup.dt
        speeds = {
            name: rate for name, rate in zip(arm.quantity_names, arm.rate, strict=True) if rate < np.inf
        }
        self._limits = [mink.ConfigurationLimit(model), mink.VelocityLimit(model, speeds)]
        links, cubes = ([f"{kind} {k}" for k in range(n)] for kind, n in _counts(scene))
        beside = [([links[a]], [links[b]]) for a, b in scene.pairs]
        for pairs, least, reach in (
            ([(links, cubes)], setup.safe, setup.influence),
            (beside, setup.self_safe, setup.monitor.self_influence),
        ):
            limit = mink.CollisionAvoidanceLimit(
                model,
                pairs,
                gain=_APPROACH,
                minimum_distance_from_collisions=least + setup.margin,
                collision_detection_distance=reach,
            )
            self._limits.append(limit)

    @property
    def tip(self) -> Array:
        """(3,) Position of the tip by the peer's own kinematics, m."""
        return np.array(self._configuration.get_transform_frame_to_world("tip", "site").translation())

    def step(self, goal: Goal) -> bool:
        """See :class:`~vgtm_qp.bench.contestants.Contestant`."""
        mink = self._mink
        self._tip.set_target(mink.SE3.from_translation(goal.pose.position))
        try:
            velocity = mink.solve_ik(
                self._configuration, self._tasks, self._dt, solver="daqp", limits=self._limits
            )
        except mink.MinkError:
            return False
        self._configuration.integrate_inplace(velocity, self._dt)
        return True


class PinkStep(_JointStep):
    """Steps by pink 4.x: frame and posture task, limits of joints and speeds, a barrier of distances, by DAQP."""

    def __init__(self, problem: Problem) -> None:
        scene = JointScene.of(problem)
        self._pink = pink = _installed("pink", "pin-pink")
        pin, coal = _installed("pinocchio", "pin"), _installed("coal", "coal")
        model, shapes = pinocchio_model(scene, pin, coal)
        self._configuration = pink.Configuration(
            model, model.createData(), scene.arm.home_quantities, collision_model=shapes
        )
        self._tip = pink.tasks.FrameTask("tip", position_cost=_TIP_COST, orientation_cost=0.0)
        posture = pink.tasks.PostureTask(cost=_POSTURE_COST)
        for task in (self._tip, posture):
            task.set_target_from_configuration(self._configuration)
        self._tasks, self._dt, self._barriers = [self._tip, posture], scene.setup.dt, []
        if pairs := len(shapes.collisionPairs):
            # pink's barrier has one least distance for all pairs: here the greater of the two.
            least = max(scene.setup.safe, scene.setup.self_safe) + scene.setup.margin
            barrier = pink.barriers.SelfCollisionBarrier(
                pairs, gain=_APPROACH / self._dt, safe_displacement_gain=0.0, d_min=least
            )
            self._barriers.append(barrier)

    @property
    def tip(self) -> Array:
        """(3,) Position of the tip by the peer's own kinematics, m."""
        return np.array(self._configuration.get_transform_frame_to_world("tip").translation)

    def step(self, goal: Goal) -> bool:
        """See :class:`~vgtm_qp.bench.contestants.Contestant`."""
        pink = self._pink
        self._tip.transform_target_to_world.translation = goal.pose.position
        try:
            velocity = pink.solve_ik(
                self._configuration, self._tasks, self._dt, solver="daqp", barriers=self._barriers
            )
        except pink.exceptions.PinkError:
            return False
        self._configuration.integrate_inplace(velocity, self._dt)
        return True


def mjcf(scene: JointScene) -> str:
    """Return the scene as a MuJoCo model: geoms ``link 0``... and ``cube 0``..., site ``tip``."""
    arm, chain = scene.arm, scene.arm.chain
    root = ElementTree.Element("mujoco")
    ElementTree.SubElement(root, "compiler", angle="radian", inertiafromgeom="true")
    world = ElementTree.SubElement(root, "worldbody")
    for k, (center, rotation, size) in enumerate(_cubes(scene.problem)):
        place = _mjcf_place(center, rotation) | {"size": _numbers(size / 2.0)}
        ElementTree.SubElement(world, "geom", {"name": f"cube {k}", "type": "box"} | place)
    parent = world
    for j, name in enumerate(arm.quantity_names):
        place = _mjcf_place(chain.position[j], chain.rotation[j])
        parent = ElementTree.SubElement(parent, "body", {"name": name} | place)
        # A body needs a mass, although no forces are computed.
        ElementTree.SubElement(parent, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
        joint = {"name": name, "type": "hinge", "axis": _numbers(chain.axis[j])}
        if np.isfinite(arm.stroke[j]).all():
            joint |= {"limited": "true", "range": _numbers(arm.stroke[j])}
        ElementTree.SubElement(parent, "joint", joint)
        for k, link in enumerate(scene.links):
            if link.joint == j:
                shape = {"type": "capsule", "size": _numbers([link.radius])}
                span = {"name": f"link {k}", "fromto": _numbers([0.0, 0.0, 0.0, *link.end])}
                ElementTree.SubElement(parent, "geom", shape | span)
    ElementTree.SubElement(parent, "site", name="tip", pos=_numbers(chain.tip))
    return ElementTree.tostring(root, encoding="unicode")


def pinocchio_model(scene: JointScene, pin: ModuleType, coal: ModuleType) -> tuple[Any, Any]:
    """Return the scene as a Pinocchio model with frame ``tip``, and its shapes with the pairs that keep apart."""
    arm, chain = scene.arm, scene.arm.chain
    model, shapes = pin.Model(), pin.GeometryModel()
    parent = 0
    for j, name in enumerate(arm.quantity_names):
        place = pin.SE3(chain.rotation[j], chain.position[j])
        kind = pin.JointModelRevoluteUnaligned(chain.axis[j])
        low, high = (np.array([limit]) for limit in arm.stroke[j])
        effort, speed = np.array([np.inf]), np.array([arm.rate[j]])
        parent = model.addJoint(parent, kind, place, name, effort, speed, low, high)
    model.addFrame(
        pin.Frame("tip", parent, 0, pin.SE3(np.eye(3), np.array(chain.tip)), pin.FrameType.OP_FRAME)
    )

    def add(name: str, joint: int, place: Any, shape: Any) -> int:
        return int(shapes.addGeometryObject(pin.GeometryObject(name, joint, place, shape)))

    links = []
    for link in scene.links:
        length = float(np.linalg.norm(link.end))
        along = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), link.end).toRotationMatrix()
        # Capsules lie about the origin, along z.
        place = pin.SE3(along, link.end / 2.0)
        links.append(add(link.name, link.joint + 1, place, coal.Capsule(link.radius, length)))
    cubes = [
        add(f"cube {k}", 0, pin.SE3(rotation, center), coal.Box(*size.tolist()))
        for k, (center, rotation, size) in enumerate(_cubes(scene.problem))
    ]
    pairs = [(link, cube) for link in links for cube in cubes]
    for pair in pairs + [(links[a], links[b]) for a, b in scene.pairs]:
        shapes.addCollisionPair(pin.CollisionPair(*pair))
    return model, shapes


def _counts(scene: JointScene) -> tuple[tuple[str, int], tuple[str, int]]:
    return ("link", len(scene.links)), ("cube", len(scene.problem.obstacle))


def _cubes(problem: Problem) -> Iterator[tuple[Array, Array, Array]]:
    """Yield centre (3,), rotation (3, 3) and edges (3,), m, of each box."""
    for cube in problem.to_dict()["obstacle"]:
        size = np.broadcast_to(np.asarray(cube["size"], dtype=float), 3)
        yield np.array(cube["center"], dtype=float), rotation_from_vector(cube["rotation_vector"]), size


def _mjcf_place(position: Array, rotation: Array) -> dict[str, str]:
    x, y = rotation.T[:2]
    return {"pos": _numbers(position), "xyaxes": _numbers([*x, *y])}


def _numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)


def _installed(name: str, package: str) -> ModuleType:
    """Import a package that the peers need.

    Raises
    ------
    SolverError
        It is not installed.
    """
    try:
        return import_module(name)
    except ImportError:
        raise SolverError(f"{name} is not installed: pip install {package}") from None
