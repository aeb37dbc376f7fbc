"""The arm as a MuJoCo model: a truss of point masses and tendons, or joints and links; every state a keyframe."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import ExportError
from vgtm_qp.result.chain import RecordedChain
from vgtm_qp.result.result import Result
from vgtm_qp.rotation import quaternion
from vgtm_qp.verify.arm import AnyRecordedArm, RecordedArm, arm_of
from vgtm_qp.view.drawing import (
    FIXED_COLOUR,
    OBSTACLE_COLOUR,
    Drawing,
    ObstacleMesh,
    camera_for,
    drawing_of_maneuver,
    stroke_colours,
)

XmlElement = ElementTree.Element

MASS_PER_LENGTH = 1.0
"""Mass of a member, kg/m of its home length, half of it at each end."""
TIME_STEP = 0.001
"""s; the constraints' time constant is twice this, the least that MuJoCo holds stable."""
ACTUATOR_GROUP = 1
"""Group of the position actuators, so that a replay through equality constraints can switch them off."""

_STIFFNESS, _TURNING = 2.0e5, 2.0e4
"""Of the position actuators of members, N/m, and of joints, N m/rad or N/m."""
_AWAY = 1.5
"""Distance of MuJoCo's own camera from the centre, as a share of the extent."""
_LIGHT = (0.5, 0.5, 0.5)
_WIDEST = (1280, 960)
"""Greatest size of a picture that is rendered without a window, pixels."""
_LEAST_MASS = 1e-6
"""kg and kg m^2 of bodies between joints in one place."""
_STIFF = {"solref": (2.0 * TIME_STEP, 1.0), "solimp": (0.9999, 0.9999, 0.001)}
"""Stiffness of the equality constraints that hold lengths and joints."""
_UNSEEN = {"contype": 0, "conaffinity": 0, "rgba": "0 0 0 0"}
"""Look of what only weighs."""
_BALL = 0.1
"""Radius of these, over the mean length of a link."""
_THINNEST = 1e-6
"""Least radius of what is drawn, m: MuJoCo refuses a radius of zero."""


def mjcf(maneuver: Result) -> str:
    """Return the MuJoCo model of a maneuver as XML, which opens in MuJoCo's own viewer.

    Free nodes of a truss are bodies with three slide joints, so that ``qpos`` is their displacement from the
    home pose. Each member is a tendon of the same name. Members have mass but do not collide; nodes collide
    with obstacles. For a serial arm ``qpos`` holds the joints' values, and the links are capsules that
    collide with obstacles.

    Base and moving obstacles are mocap bodies; meshes are replaced by their convex hulls. Every member and
    joint has an equality constraint of the same name that holds its length or value. The constraints of
    actuated ones are off, since position actuators drive them: ``ctrl`` is a length, m, or a joint's value,
    rad or m.

    Raises
    ------
    ExportError
        A truss has offset joints, which point masses cannot orient, or a link of a serial arm stretches.
    """
    arm = modelled_arm(maneuver)
    name = str(maneuver.manifest["problem"].get("name", "arm"))
    root = XmlElement("mujoco", model=name)
    _add(root, "compiler", angle="radian", autolimits="true", boundmass=_LEAST_MASS, boundinertia=_LEAST_MASS)
    _add(root, "option", timestep=TIME_STEP, integrator="implicitfast", gravity=(0.0, 0.0, -9.81))
    drawing = drawing_of_maneuver(maneuver)
    asset, world = _add_view(root, maneuver, drawing), _add(root, "worldbody")
    _add(world, "light", pos=(0.0, 0.0, 0.0), dir=(-0.3, 0.5, -0.8), directional="true", diffuse=_LIGHT)
    if isinstance(arm, RecordedChain):
        _add_joints(asset, world, arm, maneuver.manifest["problem"]["arm"]["joint"])
        _add_drives(root, arm)
    else:
        _add_nodes(world, arm)
        _add_members(root, arm)
    obstacles = drawing.obstacles
    tables = {entry["name"]: entry for entry in maneuver.manifest["problem"].get("obstacle") or ()}
    for mesh in obstacles:
        _add_obstacle(asset, world, mesh, tables[mesh.name], float(maneuver.time[0]))
    _add_keyframes(root, maneuver, arm, [mesh for mesh in obstacles if mesh.velocity.any()])
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_view(root: XmlElement, maneuver: Result, drawing: Drawing) -> XmlElement:
    """Add camera and light, with which a viewer opens: the arm in all states, its tip and obstacles are in the picture.

    Return the element of the assets, with a bright sky.
    """
    camera = camera_for(drawing, maneuver.nodes, maneuver.tip_position)
    away, ahead = np.linalg.norm(camera.target - camera.position), camera.target - camera.position
    turn, tilt = np.arctan2(ahead[1], ahead[0]), np.arcsin(ahead[2] / away)
    _add(root, "statistic", extent=away / _AWAY, center=camera.target)
    visual = _add(root, "visual")
    view = {
        "azimuth": np.degrees(turn),
        "elevation": np.degrees(tilt),
        "fovy": np.degrees(camera.field_of_view),
    }
    _add(visual, "global", **view, offwidth=_WIDEST[0], offheight=_WIDEST[1])
    _add(
        visual, "headlight", ambient=(0.45, 0.45, 0.45), diffuse=(0.35, 0.35, 0.35), specular=(0.0, 0.0, 0.0)
    )
    asset = _add(root, "asset")
    sky: dict[str, Any] = {"type": "skybox", "builtin": "gradient", "width": 64, "height": 384}
    _add(asset, "texture", name="sky", **sky, rgb1=(1.0, 1.0, 1.0), rgb2=(0.82, 0.85, 0.89))
    return asset


def modelled_arm(maneuver: Result) -> AnyRecordedArm:
    """Return the arm of a maneuver; ExportError if a MuJoCo model would differ from it or from its scene."""
    arm = arm_of(maneuver)
    if maneuver.manifest.get("scenes"):
        raise ExportError("a MuJoCo model has one scene; this one changed while the arm ran")
    if isinstance(arm, RecordedArm) and not arm.has_pin_joints:
        raise ExportError("a MuJoCo model needs pin joints; this truss has joint_offset > 0")
    return arm


def node_masses(arm: RecordedArm) -> Array:
    """Return (N,) the mass at each node, kg: half of every member that ends there."""
    half = 0.5 * MASS_PER_LENGTH * arm.length
    return np.bincount(arm.members.reshape(-1), np.repeat(half, 2), minlength=len(arm.home)).astype(float)


def _add_nodes(world: XmlElement, arm: RecordedArm) -> None:
    masses, radius = node_masses(arm), max(float(np.median(arm.radius)), _THINNEST)
    for k, name in enumerate(arm.node_names):
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


def _add_joints(
    asset: XmlElement, world: XmlElement, arm: RecordedChain, table: Sequence[Mapping[str, Any]]
) -> None:
    """Add the joints of a serial arm, each a body in the one before, with the links that move with them.

    The masses are those of the problem's `table` of joints, as balls round their centres, since there are no
    moments of inertia. If the table has none, links have the mass of their length.
    """
    masses = [float(joint.get("mass") or 0.0) for joint in table]
    parent = _add(world, "body", name="base", mocap="true", pos=(0.0, 0.0, 0.0))
    bodies = [parent]
    for j, name in enumerate(arm.quantity_names):
        parent = _add(parent, "body", name=name, pos=arm.position[j], quat=quaternion(arm.rotation[j]))
        kind = "hinge" if arm.revolute[j] else "slide"
        joint = _add(parent, "joint", name=name, type=kind, axis=arm.axis[j])
        if np.isfinite(arm.stroke[j]).all():
            joint.set("range", _text(arm.stroke[j]))
        bodies.append(parent)
        if masses[j]:
            ball = {"size": _BALL * arm.size, "pos": table[j].get("center_of_mass") or (0.0, 0.0, 0.0)}
            _add(parent, "geom", type="sphere", mass=masses[j], **ball, **_UNSEEN)
    _add(parent, "site", name="tip", pos=arm.tip, size=max(float(np.median(arm.radius)), _THINNEST))
    for k, name in enumerate(arm.member_names):
        carrier, ends = _carried(arm, k)
        look: dict[str, Any] = {"rgba": (*FIXED_COLOUR, 1.0), "contype": 1, "conaffinity": 2}
        length = max(float(arm.length[k]), 2.0 * float(arm.radius[k]))
        look["mass"] = 0.0 if any(masses) else MASS_PER_LENGTH * length
        if arm.is_hull[k]:
            _add(asset, "mesh", name=f"link {name}", vertex=ends)
            look |= {"type": "mesh", "mesh": f"link {name}"}
        else:
            look |= {"type": "capsule", "fromto": ends, "size": max(arm.radius[k], _THINNEST)}
        _add(bodies[carrier], "geom", name=name, **look)


def _carried(arm: RecordedChain, link: int) -> tuple[int, Array]:
    """Return the number of the joint that moves a link, 0 for the base, and its points (K, 3) in that frame, m."""
    count, places = len(arm.quantity_names), np.vstack([arm.position, arm.tip])
    if arm.is_hull[link]:
        vertices = np.unique(arm.links[link]) - count - 2
        return int(arm.carriers[vertices[0]]), arm.points[vertices]
    # Each point is fixed in one frame, or in two: the origin of a revolute joint in those before and after
    # it.
    known: list[dict[int, Array]] = []
    for point in arm.links[link, :2].tolist():
        if point > count + 1:
            known.append({int(arm.carriers[point - count - 2]): arm.points[point - count - 2]})
        elif point == 0:
            known.append({0: np.zeros(3)})
        else:
            own = {point: np.zeros(3)} if point <= count and arm.revolute[point - 1] else {}
            known.append({point - 1: places[point - 1], **own})
    common = sorted(known[0].keys() & known[1].keys())
    if not common:
        raise ExportError(f"link {arm.member_names[link]} stretches; a MuJoCo model needs links that do not")
    return common[-1], np.array([known[0][common[-1]], known[1][common[-1]]])


def _add_drives(root: XmlElement, arm: RecordedChain) -> None:
    equalities, actuators = (_add(root, kind) for kind in ("equality", "actuator"))
    pairs = zip(arm.followers.tolist(), arm.multipliers.tolist(), strict=True)
    followed = {joint: (other, multiplier) for (joint, other), multiplier in pairs}
    for k, name in enumerate(arm.quantity_names):
        other, multiplier = followed.get(k, (None, 0.0))
        held = (float(arm.home_quantities[k]), multiplier, 0.0, 0.0, 0.0)
        beside = {} if other is None else {"joint2": arm.quantity_names[other]}
        active = "false" if arm.actuated[k] else "true"
        _add(equalities, "joint", name=name, joint1=name, **beside, polycoef=held, active=active, **_STIFF)
        if arm.actuated[k]:
            drive = _add(
                actuators, "position", name=name, joint=name, kp=_TURNING, dampratio=1.0, group=ACTUATOR_GROUP
            )
            if np.isfinite(arm.stroke[k]).all():
                drive.set("ctrlrange", _text(arm.stroke[k]))


def _add_obstacle(
    asset: XmlElement, world: XmlElement, mesh: ObstacleMesh, table: Mapping[str, Any], time: float
) -> None:
    """Add an obstacle by its ``[[obstacle]]`` table, at its place at `time`, s."""
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


def _add_members(root: XmlElement, arm: RecordedArm) -> None:
    tendons, equalities, actuators = (_add(root, kind) for kind in ("tendon", "equality", "actuator"))
    for k, member in enumerate(arm.member_names):
        colour = stroke_colours(np.array(0.5)) if arm.actuated[k] else np.array(FIXED_COLOUR)
        tendon = _add(
            tendons, "spatial", name=member, width=max(arm.radius[k], _THINNEST), rgba=(*colour, 1.0)
        )
        for node in arm.members[k]:
            _add(tendon, "site", site=arm.node_names[node])
        active = "false" if arm.actuated[k] else "true"
        _add(equalities, "tendon", name=member, tendon1=member, active=active, **_STIFF)
        if arm.actuated[k]:
            drive = {"kp": _STIFFNESS, "dampratio": 1.0, "ctrlrange": arm.stroke[k], "group": ACTUATOR_GROUP}
            _add(actuators, "position", name=member, tendon=member, **drive)


def _add_keyframes(
    root: XmlElement, maneuver: Result, arm: AnyRecordedArm, moving: Sequence[ObstacleMesh]
) -> None:
    keyframes, given = _add(root, "keyframe"), _GivenPoses.of(maneuver, arm, moving)
    values = maneuver.joints if maneuver.joints is not None else (maneuver.nodes - arm.home)[:, arm.free]
    for k, (time, controls) in enumerate(zip(maneuver.time, maneuver.actuator_values, strict=True)):
        key = _add(keyframes, "key", name=f"state {k}", time=time, qpos=values[k], ctrl=controls)
        if given.position.shape[1]:
            key.set("mpos", _text(given.position[k]))
            key.set("mquat", _text(given.quaternion[k]))


class _GivenPoses(NamedTuple):
    """Positions (T, G, 3), m, and quaternions (T, G, 4) of what has a given motion: base, then obstacles."""

    position: Array
    quaternion: Array

    @classmethod
    def of(cls, maneuver: Result, arm: AnyRecordedArm, moving: Sequence[ObstacleMesh]) -> _GivenPoses:
        """Return the poses at a maneuver's states; a truss has base nodes, which do not turn, as its base."""
        time, base = maneuver.time, maneuver.nodes[:, np.sort(arm.base)]
        paths = np.array([[mesh.position(float(t)) for mesh in moving] for t in time])
        position = np.concatenate([base, paths.reshape(len(time), -1, 3)], axis=1)
        turns = np.tile((1.0, 0.0, 0.0, 0.0), (*position.shape[:2], 1))
        for _, attitude in arm.frames(maneuver.configurations)[:1]:
            turns[:, 0] = quaternion(attitude)
        return cls(position, turns)


def _add(parent: XmlElement, tag: str, **attributes: object) -> XmlElement:
    return ElementTree.SubElement(parent, tag, {key: _text(value) for key, value in attributes.items()})


def _text(value: object) -> str:
    """Return an attribute as MuJoCo reads it: numbers with all their digits."""
    if isinstance(value, str):
        return value
    if isinstance(value, Iterable):
        return " ".join(_text(item) for item in np.asarray(value).ravel().tolist())
    return repr(np.asarray(value).item())
