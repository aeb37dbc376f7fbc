"""An arm as data to draw, for any renderer: member ends, colours, curve, obstacles and a camera."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.curve.families import make_family
from vgtm_qp.geometry.bodies import Hull
from vgtm_qp.problem.urdf import UrdfVisual
from vgtm_qp.result.manifest import scene_problem
from vgtm_qp.result.result import Result
from vgtm_qp.rotation import rotation_from_vector
from vgtm_qp.verify.arm import AnyRecordedArm, arm_of
from vgtm_qp.verify.curve import TRACKING_TOLERANCE, greatest_gaps
from vgtm_qp.view.links import link_surfaces

FIXED_COLOUR = (0.70, 0.72, 0.74)
OBSTACLE_COLOUR = (0.90, 0.62, 0.0)
CARRIED_COLOUR = (0.34, 0.71, 0.91)
CURVE_COLOUR = (0.0, 0.45, 0.34)
POLYGON_COLOUR = (0.35, 0.62, 0.53)
PATH_COLOUR = (0.10, 0.10, 0.12)
_STROKE_COLOURS = np.array([(0.05, 0.30, 0.80), (0.66, 0.48, 0.72), (0.84, 0.10, 0.12)])
"""Colours of shortest, middle and longest; distinct for the colour-blind, and from the grey of fixed ones."""

_CURVE_POINTS = 49
_SURROUNDINGS = 0.25
_FIELD_OF_VIEW, _ELEVATION = float(np.radians(32.0)), float(np.radians(14.0))
_SIDES = np.radians([-62.0, -118.0, 62.0, 118.0])
_STRAIGHT = 1e-6
"""Distance aside, m, up to which a tip has no heading."""


@dataclass(frozen=True, eq=False)
class ObstacleMesh:
    """The surface of an obstacle.

    Its triangles, `vertices` (K, 3), m, and `faces` (F, 3), are relative to its own origin, in directions of
    the base frame. The origin is at `center` (3,), m, at time 0 and has the `velocity` (3,), m/s. The obstacle is there
    from the time `since`, s, to before `until`.
    """

    name: str
    vertices: Array
    faces: Index
    center: Array
    velocity: Array
    since: float = -np.inf
    until: float = np.inf
    colour: tuple[float, float, float] = OBSTACLE_COLOUR

    def is_there(self, time: float) -> bool:
        """Return whether the obstacle is in the scene at `time`, s."""
        return self.since <= time < self.until

    @property
    def moves(self) -> bool:
        """Whether it is elsewhere at another time."""
        return bool(self.velocity.any())

    def position(self, time: float) -> Array:
        """Return (3,) the position of the obstacle's origin at `time`, s, in m."""
        return np.asarray(self.center + time * self.velocity)

    def rotation(self, time: float) -> Array:  # noqa: ARG002
        """Return (3, 3) its rotation at `time`, s."""
        return np.eye(3)


@dataclass(frozen=True, eq=False)
class CarriedMesh(ObstacleMesh):
    """The surface of a body that the arm carries: in the frame of the tip, whose `pose` at a time, s, is known."""

    pose: Callable[[float], tuple[Array, Array]] = field(kw_only=True)

    @property
    def moves(self) -> bool:
        """See :class:`ObstacleMesh`, as for the others."""
        return True

    def position(self, time: float) -> Array:
        """Return (3,) where its origin is."""
        position, rotation = self.pose(time)
        return np.asarray(position + rotation @ self.center)

    def rotation(self, time: float) -> Array:
        """Return (3, 3) that of the tip."""
        return self.pose(time)[1]

    def at(self, time: float) -> ObstacleMesh:
        """Return the surface where it is at `time`, s, at rest."""
        turned = self.vertices @ self.rotation(time).T
        place = self.position(time), np.zeros(3)
        return ObstacleMesh(self.name, turned, self.faces, *place, self.since, self.until, self.colour)


@dataclass(frozen=True, eq=False)
class DrawnHull:
    """The surface of a body that is a convex hull.

    Attributes
    ----------
    body : int
        Its number.
    rows : (K,) int
        The nodes that are its vertices.
    home : (K, 3)
        Where they are at home, about the middle of the hull, m.
    vertices, faces : (V, 3), (F, 3) int
        Its surface there, m.
    """

    body: int
    rows: Index
    home: Array
    vertices: Array
    faces: Index

    @classmethod
    def of(cls, body: int, rows: Index, home: Array) -> DrawnHull:
        """Return the hull of nodes `rows` (K,), which are at `home` (K, 3), m."""
        about = home - home.mean(axis=0)
        hull = Hull.of(about)
        return cls(body, rows, about, hull.vertices, hull.faces)

    def pose(self, nodes: Array) -> tuple[Array, Array]:
        """Return position (3,), m, and rotation (3, 3) of the hull for nodes at `nodes` (N, 3), m."""
        now = nodes[self.rows]
        middle = now.mean(axis=0)
        left, _, right = np.linalg.svd((now - middle).T @ self.home)
        sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
        return middle, np.asarray((left * sign) @ right)

    def placed(self, nodes: Array) -> Array:
        """Return (V, 3) its vertices for nodes at `nodes` (N, 3), m."""
        position, rotation = self.pose(nodes)
        return np.asarray(position + self.vertices @ rotation.T)


@dataclass(frozen=True, eq=False)
class Drawing:
    """An arm and its surroundings, ready to be drawn at any configuration.

    `curve_weights` (K, V) are those of points along the curve; K = 0 without a curve. `directory` is that of the files
    which the problem, the table `problem`, names.
    """

    name: str
    arm: AnyRecordedArm
    curve_weights: Array
    obstacles: tuple[ObstacleMesh, ...]
    problem: Mapping[str, Any]
    directory: Path

    def links(self) -> tuple[UrdfVisual, ...]:
        """Return the surfaces of the arm's links that its URDF file draws; none without it."""
        return link_surfaces(self.problem, self.arm, self.directory)

    @cached_property
    def hulls(self) -> tuple[DrawnHull, ...]:
        """The bodies that are convex hulls; all others are drawn from end to end."""
        links, home = self.arm.links, self.arm.home
        own = [(body, np.unique(links[body])) for body in np.flatnonzero(self.arm.is_hull).tolist()]
        return tuple(DrawnHull.of(body, rows, home[rows]) for body, rows in own)

    @cached_property
    def marks(self) -> Index:
        """The nodes that are drawn: all but the vertices of hulls."""
        rows = np.concatenate([np.zeros(0, dtype=np.int64), *(hull.rows for hull in self.hulls)])
        return np.setdiff1d(np.arange(len(self.arm.home)), rows)

    def surfaces(self) -> list[Array]:
        """Return (K, 3) the vertices of each obstacle at time 0, or where it is later taken up, m."""
        times = [max(mesh.since, 0.0) for mesh in self.obstacles]
        return [
            mesh.vertices @ mesh.rotation(time).T + mesh.position(time) - time * mesh.velocity
            for mesh, time in zip(self.obstacles, times, strict=True)
        ]

    def curve(self, control_vertices: Array) -> Array:
        """Return (K, 3) points along the curve with `control_vertices` (V, 3), m; K = 0 without a curve."""
        return np.asarray(self.curve_weights @ control_vertices)

    def stroke_share(self, lengths: Array) -> Array:
        """Return (M,) lengths or joint values (M,) as shares of the stroke, 0 to 1.

        NaN for quantities that are fixed or have no limits.
        """
        low, high = self.arm.stroke.T
        share = np.full(len(low), np.nan)
        moving = self.arm.actuated & (high > low) & np.isfinite(high - low)
        share[moving] = np.clip((lengths - low)[moving] / (high - low)[moving], 0.0, 1.0)
        return share

    def colours(self, lengths: Array) -> Array:
        """Return (M, 3) colours, 0 to 1: blue for short to red for long, grey for fixed members and links."""
        if not self.arm.stretches.any():
            return np.tile(FIXED_COLOUR, (len(lengths), 1))
        share = self.stroke_share(lengths)
        colours = stroke_colours(np.nan_to_num(share, nan=0.5))
        colours[np.isnan(share)] = FIXED_COLOUR
        return colours


def stroke_colours(share: Array) -> Array:
    """Return (..., 3) colours, 0 to 1, of shares (...,) of a stroke."""
    knots = np.linspace(0.0, 1.0, len(_STROKE_COLOURS))
    return np.stack([np.interp(share, knots, channel) for channel in _STROKE_COLOURS.T], axis=-1)


def force_colours(forces: Array) -> Array:
    """Return (M, 3) colours of forces (M,): from grey without force to red for the greatest push, blue for pulls."""
    share = forces / max(float(np.abs(forces).max(initial=0.0)), np.finfo(float).tiny)
    extreme = np.where(share[:, None] < 0.0, _STROKE_COLOURS[2], _STROKE_COLOURS[0])
    return np.asarray(FIXED_COLOUR + np.abs(share)[:, None] * (extreme - FIXED_COLOUR))


def drawing_of_maneuver(maneuver: Result) -> Drawing:
    """Return the drawing of a result, from its manifest; ResultError if its record of the arm is wrong."""
    manifest = maneuver.manifest
    arm = arm_of(maneuver)
    vertices, directory = maneuver.control_vertices.shape[1], Path(manifest.get("directory") or ".")
    drawing = make_drawing(manifest["problem"], arm, vertices, directory)
    if not manifest.get("scenes"):
        return drawing
    for scene in manifest["scenes"]:
        scene_problem(manifest["problem"], scene)
    scenes, at_first = manifest["scenes"], manifest["problem"].get("obstacle") or ()
    there = [
        replace(mesh, since=since, until=until)
        for entry, since, until in _lifetimes(maneuver, at_first, [scene["obstacle"] for scene in scenes])
        for mesh in obstacle_meshes([entry], directory)
    ]
    at_tip = [[held["body"] for held in scene.get("carried", ())] for scene in scenes]
    pose = _pose_of_tip(maneuver)
    carried = [
        carried_mesh(entry, directory, pose, since, until)
        for entry, since, until in _lifetimes(maneuver, (), at_tip)
    ]
    return replace(drawing, obstacles=(*there, *(mesh for mesh in carried if mesh is not None)))


def _pose_of_tip(maneuver: Result) -> Callable[[float], tuple[Array, Array]]:
    """Return the tip's pose in a maneuver as a function of the time, s."""
    from scipy.spatial.transform import Rotation, Slerp

    turns = Slerp(maneuver.time, Rotation.from_matrix(maneuver.tip_rotation))
    first, last = float(maneuver.time[0]), float(maneuver.time[-1])

    def pose(time: float) -> tuple[Array, Array]:
        position = resampled(maneuver.time, maneuver.tip_position, np.array([time]))[0]
        return np.asarray(position), np.asarray(turns(min(max(time, first), last)).as_matrix())

    return pose


def _lifetimes(
    maneuver: Result, at_first: Sequence[Mapping[str, Any]], later: Sequence[Sequence[Mapping[str, Any]]]
) -> list[tuple[Mapping[str, Any], float, float]]:
    """Return each table that was ever in the scenes of a maneuver, `at_first` or `later`, and from when to when, s."""
    found: list[tuple[Mapping[str, Any], float, float]] = []
    there: list[tuple[Mapping[str, Any], float]] = [(entry, -np.inf) for entry in at_first]
    for scene, entries in zip(maneuver.manifest["scenes"], later, strict=True):
        time = float(maneuver.time[scene["row"]])
        found += [(entry, since, time) for entry, since in there if entry not in entries]
        there = [(entry, since) for entry, since in there if entry in entries]
        known = [entry for entry, _ in there]
        there += [(entry, time) for entry in entries if entry not in known]
    return [*found, *((entry, since, np.inf) for entry, since in there)]


def make_drawing(
    problem: Mapping[str, Any], arm: AnyRecordedArm, vertices: int, directory: str | Path
) -> Drawing:
    """Return the drawing of an arm, with `vertices` control vertices, among the obstacles of a problem."""
    weights = np.zeros((0, vertices))
    spec = problem.get("curve")
    if vertices and spec:
        options = {key: spec[key] for key in ("degree", "bias", "tension") if key in spec}
        family = make_family(spec.get("family", "bezier"), vertices, **options)
        weights = family.weights(np.linspace(0.0, 1.0, _CURVE_POINTS))
    obstacles = obstacle_meshes(problem.get("obstacle") or (), Path(directory))
    return Drawing(str(problem.get("name", "")), arm, weights, obstacles, problem, Path(directory))


def obstacle_meshes(entries: Sequence[Mapping[str, Any]], directory: Path) -> tuple[ObstacleMesh, ...]:
    """Return the surfaces of ``[[obstacle]]`` tables; a mesh whose file is gone or damaged is left out."""
    found = []
    for entry in entries:
        surface = _surface(entry, directory)
        if surface is None:
            continue
        turn = rotation_from_vector(entry.get("rotation_vector") or (0.0, 0.0, 0.0))
        found.append(
            ObstacleMesh(
                name=str(entry["name"]),
                vertices=np.asarray(surface.vertices, dtype=float) @ turn.T,
                faces=np.asarray(surface.faces, dtype=np.int64),
                center=np.asarray(entry.get("center") or (0.0, 0.0, 0.0), dtype=float),
                velocity=np.asarray(entry.get("velocity") or (0.0, 0.0, 0.0), dtype=float),
            )
        )
    return tuple(found)


def carried_mesh(
    entry: Mapping[str, Any],
    directory: Path,
    pose: Callable[[float], tuple[Array, Array]],
    since: float = -np.inf,
    until: float = np.inf,
) -> CarriedMesh | None:
    """Return the surface of a body whose table is in the frame of the tip; None if its file is gone or damaged."""
    for mesh in obstacle_meshes([entry], directory):
        own = mesh.vertices, mesh.faces, mesh.center, np.zeros(3)
        return CarriedMesh(mesh.name, *own, since, until, CARRIED_COLOUR, pose=pose)
    return None


def _surface(entry: Mapping[str, Any], directory: Path) -> Any:
    import trimesh

    shape = entry["shape"]
    if shape == "box":
        return trimesh.creation.box(extents=np.broadcast_to(np.asarray(entry["size"], dtype=float), 3))
    if shape == "sphere":
        return trimesh.creation.icosphere(subdivisions=3, radius=float(entry["radius"]))
    if shape == "cylinder":
        radius, height = float(entry["radius"]), float(entry["height"])
        return trimesh.creation.cylinder(radius=radius, height=height, sections=48)
    try:
        surface = trimesh.load_mesh(directory / str(entry["file"]))
        surface.apply_scale(float(entry.get("scale") or 1.0))
        is_drawn = surface.triangles.shape[1:] == (3, 3) and np.isfinite(surface.triangles).all()
    except Exception:  # trimesh raises whatever the reader of the format raises
        return None
    return surface if is_drawn and len(surface.triangles) else None


class Camera(NamedTuple):
    """Where to look from: `position` and `target` (3,), m, and the vertical field of view, rad."""

    position: Array
    target: Array
    field_of_view: float


def camera_for(drawing: Drawing, nodes: Array, tip: Array) -> Camera:
    """Return a camera on the arm in all states (T, N, 3) and its surroundings, across the tip's path (T, 3).

    Of four sides the camera is on the one from which obstacles hide least of the arm.
    """
    points = nodes.reshape(-1, 3)
    reach = float(np.linalg.norm(np.ptp(points, axis=0)))
    low, high = with_surroundings(points, drawing.surfaces(), _SURROUNDINGS * reach)
    target = (low + high) / 2
    distance = 0.6 * float(np.linalg.norm(high - low)) / np.tan(_FIELD_OF_VIEW / 2)
    positions = [target + distance * direction(heading(tip) + side, _ELEVATION) for side in _SIDES]
    hidden = [_hidden(drawing.obstacles, position, nodes[[0, -1]].reshape(-1, 3)) for position in positions]
    return Camera(positions[int(np.argmin(hidden))], target, _FIELD_OF_VIEW)


def with_surroundings(points: Array, surroundings: Iterable[Array], room: float) -> Array:
    """Return least and greatest coordinates (2, D) of points (K, D) and of surroundings within `room`, m."""
    box = np.stack([points.min(axis=0), points.max(axis=0)])
    near = [np.clip(others, box[0] - room, box[1] + room) for others in surroundings]
    seen = np.concatenate([box, *near])
    return np.stack([seen.min(axis=0), seen.max(axis=0)])


def heading(tip: Array) -> float:
    """Return the azimuth, rad, in which a tip (T, 3) gets farthest aside from its first place, or 0."""
    aside = (tip - tip[0])[:, :2]
    x, y = aside[int(np.argmax(np.linalg.norm(aside, axis=1)))]
    return float(np.arctan2(y, x)) if np.hypot(x, y) > _STRAIGHT else 0.0


def direction(azimuth: float, elevation: float) -> Array:
    """Return (3,) the unit vector at `azimuth` about +z and `elevation` above the x-y plane, rad."""
    flat = np.cos(elevation)
    return np.array([np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)])


def _hidden(obstacles: Sequence[ObstacleMesh], eye: Array, points: Array) -> int:
    """Return the number of points (K, 3) behind the box round an obstacle, seen from `eye` (3,)."""
    rays = points - eye
    rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    behind = np.zeros(len(points), dtype=bool)
    for mesh in obstacles:
        time = max(mesh.since, 0.0)
        corners = mesh.vertices @ mesh.rotation(time).T
        walls = np.stack([corners.min(axis=0), corners.max(axis=0)]) + mesh.position(time) - eye
        crossings = np.sort(walls[:, None] / rays, axis=0)
        enters, leaves = crossings[0].max(axis=1), crossings[1].min(axis=1)
        behind |= (enters < leaves) & (enters < 1.0) & (leaves > 0.0)
    return int(behind.sum())


def off_curve(maneuver: Result) -> list[str]:
    """Return the distance of stations from the reference curve in each state, as text; empty on the curve."""
    gaps = greatest_gaps(maneuver)
    if gaps is None:
        return [""] * len(maneuver.time)
    limit = TRACKING_TOLERANCE * arm_of(maneuver).size
    return [f"{1000.0 * gap:.3g} mm off the curve" if gap > limit else "" for gap in gaps]


def resampled(time: Array, values: Array, at: Array) -> Array:
    """Return `values` (T, ...) at times `at`, on straight lines between the states as in the certificate."""
    flat = values.reshape(len(time), -1)
    found = np.empty((len(at), flat.shape[1]))
    for k, column in enumerate(flat.T):
        found[:, k] = np.interp(at, time, column)
    return found.reshape(len(at), *values.shape[1:])
