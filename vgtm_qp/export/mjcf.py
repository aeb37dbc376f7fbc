"""The truss as a MuJoCo model: nodes as point masses, members as tendons, every state a keyframe."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import ExportError
from vgtm_qp.result.result import Result
from vgtm_qp.verify.arm import RecordedArm, arm_of
from vgtm_qp.view.drawing import (
    FIXED_COLOUR,
    OBSTACLE_COLOUR,
    ObstacleMesh,
    drawing_of_maneuver,
    stroke_colours,
)

Element = ElementTree.Element

MASS_PER_LENGTH = 1.0
"""Mass of a member, kg/m of its home length, half of it at each end."""
TIME_STEP = 0.001
"""s; the constraints' time constant is twice this, the least that MuJoCo holds stable."""
ACTUATOR_GROUP = 1
"""Group of the position actuators, so that a replay through equality constraints can switch them off."""

_STIFFNESS = 2.0e5
_THINNEST = 1e-6
"""Least radius of what is drawn, m: MuJoCo takes none that is zero."""


def mjcf(maneuver: Result) -> str:
    """Return the MuJoCo model of a maneuver as XML, which opens in MuJoCo's own viewer.

    Free nodes are bodies with three slide joints, so ``qpos`` is their displacement from the home pose; base
    nodes and moving obstacles are mocap bodies. Each member is a tendon called by its name with an equality
    constraint of the same name; those of actuated members are off, since position actuators drive them:
    ``ctrl`` is a length, m. Members have mass but do not collide; nodes collide with obstacles, meshes
    as their convex hulls.

    Raises
    ------
    ExportError
        The arm is no truss, or has offset joints, whose attitude point masses cannot have.
    """
    record, arm = maneuver.manifest["arm"], pinned_truss(maneuver)
    name = str(maneuver.manifest["problem"].get("name", "truss"))
    root = Element("mujoco", model=name)
    _add(root, "compiler", angle="radian", autolimits="true")
    _add(root, "option", timestep=TIME_STEP, integrator="implicitfast", gravity=(0.0, 0.0, -9.81))
    extent = float(np.ptp(maneuver.nodes.reshape(-1, 3), axis=0).max())
    _add(root, "statistic", extent=extent, center=maneuver.nodes.reshape(-1, 3).mean(axis=0))
    visual = _add(root, "visual")
    _add(visual, "headlight", ambient=(0.4, 0.4, 0.4), diffuse=(0.5, 0.5, 0.5))
    asset, world = _add(root, "asset"), _add(root, "worldbody")
    _add(world, "light", pos=(0.0, 0.0, 3.0 * extent), dir=(0.2, 0.3, -1.0), directional="true")
    names = [str(node) for node in record["node_names"]]
    _add_nodes(world, arm, names)
    obstacles = drawing_of_maneuver(maneuver).obstacles
    tables = {entry["name"]: entry for entry in maneuver.manifest["problem"].get("obstacle") or ()}
    for mesh in obstacles:
        _add_obstacle(asset, world, mesh, tables[mesh.name], float(maneuver.time[0]))
    _add_members(root, arm, names)
    _add_keyframes(root, maneuver, arm, [mesh for mesh in obstacles if mesh.velocity.any()])
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def pinned_truss(maneuver: Result) -> RecordedArm:
    """Return the truss of a maneuver; ExportError where a MuJoCo model of it would not be the same."""
    arm = arm_of(maneuver)
    if not isinstance(arm, RecordedArm):
        raise ExportError(f"this is the result of a {arm.kind} arm; expected that of a truss")
    if not arm.has_pin_joints:
        raise ExportError("a MuJoCo model needs pin joints; this truss has joint_offset > 0")
    return arm


def node_masses(arm: RecordedArm) -> Array:
    """Return (N,) the mass at each node, kg: half of every member that ends there."""
    half = 0.5 * MASS_PER_LENGTH * arm.length
    return np.bincount(arm.members.reshape(-1), np.repeat(half, 2), minlength=len(arm.home)).astype(float)


def _add_nodes(world: Element, arm: RecordedArm, names: list[str]) -> None:
    masses, radius = node_masses(arm), max(float(np.median(arm.radius)), _THINNEST)
    for k, name in enumerate(names):
        body = _add(world, "body", name=name, pos=arm.home[k])
        if k in arm.base:
            body.set("mocap", "true")
            look = {"size": 1.5 * radius, "rgba": "0.25 0.26 0.28 1", "contype": 0, "conaffinity": 0}
        else:
            for axis, direction in zip("xyz", np.eye(3), strict=True):
                _add(body, "joint", name=f"{name} {axis}", type="slide", axis=direction)
            look = {"size": radius, "rgba": "0.4 0.41 0.43 1", "contype": 1, "conaffinity": 2}
            look["mass"] = masses[k]
        _add(body, "geom", type="sphere", **look)
        _add(body, "site", name=name, size=0.5 * radius)


def _add_obstacle(
    asset: Element, world: Element, mesh: ObstacleMesh, table: Mapping[str, Any], time: float
) -> None:
    """Add an obstacle by its ``[[obstacle]]`` table, where it is at `time`, s."""
    name, shape = f"obstacle {mesh.name}", str(table["shape"])
    body = _add(world, "body", name=name, pos=mesh.position(time))
    if mesh.velocity.any():
        body.set("mocap", "true")
    geom = _add(body, "geom", name=name, contype=2, conaffinity=1, rgba=(*OBSTACLE_COLOUR, 0.45), type=shape)
    if shape == "mesh":
        _add(asset, "mesh", name=mesh.name, vertex=mesh.vertices, face=mesh.faces)
        geom.set("mesh", mesh.name)
        return
    if shape == "box":
        size = 0.5 * np.broadcast_to(np.asarray(table["size"], dtype=float), 3)
    else:
        height = [0.5 * float(table["height"])] if shape == "cylinder" else []
        size = np.array([float(table["radius"]), *height])
    geom.set("size", _text(size))
    turn = np.asarray(table.get("rotation_vector") or (0.0, 0.0, 0.0), dtype=float)
    angle = float(np.linalg.norm(turn))
    if angle > 0.0:
        geom.set("axisangle", _text((*(turn / angle), angle)))


def _add_members(root: Element, arm: RecordedArm, names: list[str]) -> None:
    tendons, equalities, actuators = (_add(root, kind) for kind in ("tendon", "equality", "actuator"))
    for k, member in enumerate(arm.member_names):
        colour = stroke_colours(np.array(0.5)) if arm.actuated[k] else np.array(FIXED_COLOUR)
        tendon = _add(
            tendons, "spatial", name=member, width=max(arm.radius[k], _THINNEST), rgba=(*colour, 1.0)
        )
        for node in arm.members[k]:
            _add(tendon, "site", site=names[node])
        stiff = {"solref": (2.0 * TIME_STEP, 1.0), "solimp": (0.9999, 0.9999, 0.001)}
        active = "false" if arm.actuated[k] else "true"
        _add(equalities, "tendon", name=member, tendon1=member, active=active, **stiff)
        if arm.actuated[k]:
            drive = {"kp": _STIFFNESS, "dampratio": 1.0, "ctrlrange": arm.stroke[k], "group": ACTUATOR_GROUP}
            _add(actuators, "position", name=member, tendon=member, **drive)


def _add_keyframes(root: Element, maneuver: Result, arm: RecordedArm, moving: Sequence[ObstacleMesh]) -> None:
    keyframes = _add(root, "keyframe")
    lengths = maneuver.member_lengths[:, arm.actuated]
    for k, time in enumerate(maneuver.time):
        mocap = [*maneuver.nodes[k, np.sort(arm.base)], *(mesh.position(float(time)) for mesh in moving)]
        displacement = (maneuver.nodes[k] - arm.home)[arm.free]
        key = _add(keyframes, "key", name=f"state {k}", time=time, qpos=displacement, ctrl=lengths[k])
        if mocap:
            key.set("mpos", _text(mocap))


def _add(parent: Element, tag: str, **attributes: object) -> Element:
    return ElementTree.SubElement(parent, tag, {key: _text(value) for key, value in attributes.items()})


def _text(value: object) -> str:
    """Return an attribute as MuJoCo reads it: numbers with all their digits."""
    if isinstance(value, str):
        return value
    if isinstance(value, Iterable):
        return " ".join(_text(item) for item in np.asarray(value).ravel().tolist())
    return repr(np.asarray(value).item())
