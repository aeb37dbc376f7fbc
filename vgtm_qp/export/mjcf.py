"""The truss as a MuJoCo model: nodes as point masses, members as tendons, every state a keyframe."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import ExportError
from vgtm_qp.result.result import Result
from vgtm_qp.verify.arm import RecordedArm
from vgtm_qp.view.drawing import FIXED_COLOUR, OBSTACLE_COLOUR, obstacle_meshes, stroke_colours

Array = NDArray[np.float64]
Element = ElementTree.Element

MASS_PER_LENGTH = 1.0
"""Mass of a member, kg/m of its home length, half of it at each end."""
TIME_STEP = 0.001
"""s; the constraints' time constant is twice this, the least that MuJoCo holds stable."""
ACTUATOR_GROUP = 1
"""Group of the position actuators, so that a replay through equality constraints can switch them off."""

_STIFFNESS = 2.0e5


def write_mjcf(maneuver: Result, path: str | Path) -> Path:
    """Write the MuJoCo model of a maneuver and return its path; opens in MuJoCo's own viewer.

    Raises
    ------
    ExportError
        The truss has offset joints.
    """
    path = Path(path)
    path.write_text(mjcf(maneuver), encoding="utf-8")
    return path


def mjcf(maneuver: Result) -> str:
    """Return the MuJoCo model of a maneuver as XML.

    Free nodes are bodies with three slide joints, so ``qpos`` is their displacement from the home pose; base
    nodes and moving obstacles are mocap bodies. Each member is a tendon called by its name with an equality
    constraint of the same name; those of actuated members are off, since position actuators drive them:
    ``ctrl`` is a length, m. Members have mass but do not collide; nodes collide with obstacles, meshes
    as their convex hulls.

    Raises
    ------
    ExportError
        The truss has offset joints, whose attitude point masses cannot have.
    """
    record = maneuver.manifest["arm"]
    arm = RecordedArm(record, maneuver.members)
    if not arm.has_pin_joints:
        raise ExportError("a MuJoCo model needs pin joints; this truss has joint_offset > 0")
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
    _add_obstacles(asset, world, maneuver)
    _add_members(root, arm, names)
    _add_keyframes(root, maneuver, arm)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def node_masses(arm: RecordedArm) -> Array:
    """Return (N,) the mass at each node, kg: half of every member that ends there."""
    half = 0.5 * MASS_PER_LENGTH * arm.length
    return np.bincount(arm.members.reshape(-1), np.repeat(half, 2), minlength=len(arm.home)).astype(float)


def _add_nodes(world: Element, arm: RecordedArm, names: list[str]) -> None:
    masses, radius = node_masses(arm), float(np.median(arm.radius))
    base = set(arm.base.tolist())
    for k, name in enumerate(names):
        body = _add(world, "body", name=name, pos=arm.home[k])
        if k in base:
            body.set("mocap", "true")
            _add(
                body,
                "geom",
                type="sphere",
                size=1.5 * radius,
                rgba="0.25 0.26 0.28 1",
                contype=0,
                conaffinity=0,
            )
        else:
            for axis, direction in zip("xyz", np.eye(3), strict=True):
                _add(body, "joint", name=f"{name} {axis}", type="slide", axis=direction)
            _add(
                body,
                "geom",
                type="sphere",
                size=radius,
                mass=masses[k],
                rgba="0.4 0.41 0.43 1",
                contype=1,
                conaffinity=2,
            )
        _add(body, "site", name=name, size=0.5 * radius)


def _add_obstacles(asset: Element, world: Element, maneuver: Result) -> None:
    directory = Path(maneuver.manifest.get("directory") or ".")
    entries = {str(entry["name"]): entry for entry in maneuver.manifest["problem"].get("obstacle") or ()}
    for mesh in obstacle_meshes(list(entries.values()), directory):
        entry = entries[mesh.name]
        body = _add(world, "body", name=f"obstacle {mesh.name}", pos=mesh.position(float(maneuver.time[0])))
        if mesh.velocity.any():
            body.set("mocap", "true")
        geom = _add(body, "geom", name=f"obstacle {mesh.name}", contype=2, conaffinity=1)
        geom.set("rgba", _text((*OBSTACLE_COLOUR, 0.45)))
        turn = np.asarray(entry.get("rotation_vector") or (0.0, 0.0, 0.0), dtype=float)
        angle = float(np.linalg.norm(turn))
        if angle > 0.0 and entry["shape"] != "mesh":
            geom.set("axisangle", _text((*(turn / angle), angle)))
        if entry["shape"] == "box":
            size = 0.5 * np.broadcast_to(np.asarray(entry["size"], dtype=float), 3)
        elif entry["shape"] == "sphere":
            size = np.array([entry["radius"]], dtype=float)
        elif entry["shape"] == "cylinder":
            size = np.array([entry["radius"], 0.5 * entry["height"]], dtype=float)
        else:
            _add(asset, "mesh", name=mesh.name, vertex=mesh.vertices, face=mesh.faces)
            geom.set("type", "mesh")
            geom.set("mesh", mesh.name)
            continue
        geom.set("type", str(entry["shape"]))
        geom.set("size", _text(size))


def _add_members(root: Element, arm: RecordedArm, names: list[str]) -> None:
    tendons, equalities, actuators = (_add(root, kind) for kind in ("tendon", "equality", "actuator"))
    for k, member in enumerate(arm.member_names):
        colour = stroke_colours(np.array(0.5)) if arm.actuated[k] else np.array(FIXED_COLOUR)
        tendon = _add(tendons, "spatial", name=member, width=arm.radius[k], rgba=(*colour, 1.0))
        for node in arm.members[k]:
            _add(tendon, "site", site=names[node])
        stiff = {"solref": (2.0 * TIME_STEP, 1.0), "solimp": (0.9999, 0.9999, 0.001)}
        active = "false" if arm.actuated[k] else "true"
        _add(equalities, "tendon", name=member, tendon1=member, active=active, **stiff)
        if arm.actuated[k]:
            _add(
                actuators,
                "position",
                name=member,
                tendon=member,
                kp=_STIFFNESS,
                dampratio=1.0,
                ctrlrange=arm.stroke[k],
                group=ACTUATOR_GROUP,
            )


def _add_keyframes(root: Element, maneuver: Result, arm: RecordedArm) -> None:
    keyframes = _add(root, "keyframe")
    moving = [
        mesh
        for mesh in obstacle_meshes(
            maneuver.manifest["problem"].get("obstacle") or (),
            Path(maneuver.manifest.get("directory") or "."),
        )
        if mesh.velocity.any()
    ]
    free = np.setdiff1d(np.arange(len(arm.home)), arm.base)
    lengths = maneuver.member_lengths[:, arm.actuated]
    for k, time in enumerate(maneuver.time):
        mocap = [*maneuver.nodes[k, np.sort(arm.base)], *(mesh.position(float(time)) for mesh in moving)]
        key = _add(keyframes, "key", name=f"state {k}", time=float(time))
        key.set("qpos", _text((maneuver.nodes[k] - arm.home)[free]))
        key.set("ctrl", _text(lengths[k]))
        if mocap:
            key.set("mpos", _text(np.array(mocap)))


def _add(parent: Element, tag: str, **attributes: object) -> Element:
    return ElementTree.SubElement(parent, tag, {key: _text(value) for key, value in attributes.items()})


def _text(value: object) -> str:
    """Return an attribute as MuJoCo reads it: numbers with all their digits."""
    if isinstance(value, str):
        return value
    if isinstance(value, Iterable):
        return " ".join(_text(item) for item in np.asarray(value).ravel().tolist())
    return repr(np.asarray(value).item())
