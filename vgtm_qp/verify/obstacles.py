"""The obstacles of a stored problem as convex pieces that move along straight lines without turning."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array, Index
from vgtm_qp.result.poses import rotation_matrix
from vgtm_qp.verify.convex import hull_distance
from vgtm_qp.verify.distance import (
    DistanceAndNormal,
    segment_ball,
    segment_box,
    segment_cylinder,
    segment_triangle,
)

_GREATEST = 1e6
"""Greatest coordinate of a mesh, in its file's unit: squares of such numbers are exact enough."""


@dataclass(frozen=True)
class Shape:
    """K convex pieces of one kind about the origin, along their own axes."""

    corners: Array
    """(K, C, 3) points whose convex hulls hold the pieces, m."""
    sizes: Array
    """(K, ...) the sizes of each piece, m, for the functions below."""
    distance: Callable[[Array, Array, Array], DistanceAndNormal]
    """Distances and normals of P segments, from start to end (P, 3), against pieces of sizes (P, ...)."""
    furthest: Callable[[Array, Array], Array]
    """The points (P, 3) of pieces of sizes (P, ...) that are furthest along normals (P, 3), m."""
    closed: bool | None = None
    """Whether the pieces are a closed surface, with an inside; None if they are solid themselves."""

    def reach(self, normal: Array, sizes: Array) -> Array:
        """Return the greatest ``normal . x`` (P,) over the points x of pieces of `sizes` for normals (P, 3), m."""
        return np.asarray(np.einsum("pc,pc->p", normal, self.furthest(normal, sizes)))

    def hull_distance(
        self,
        vertices: Array,
        sizes: Array,
        near: Array | None = None,
        enough: Array | float = np.inf,
        *,
        decides: bool = False,
    ) -> DistanceAndNormal:
        """Return distances (P,) and normals (P, 3) of hulls of `vertices` (P, V, 3) against pieces of `sizes`.

        See :func:`~vgtm_qp.verify.convex.hull_distance` for `near`, `enough` and `decides`.
        """
        if self.furthest is _ball_furthest:
            distance, normal = hull_distance(
                vertices, lambda normal, _: np.zeros_like(normal), near, enough + sizes, decides=decides
            )
            return distance - sizes, normal

        def furthest(normal: Array, rows: Index) -> Array:
            return self.furthest(normal, sizes[rows])

        return hull_distance(vertices, furthest, near, enough, decides=decides)


_BOX_CORNERS: Array = np.array([list(itertools.product((-1.0, 1.0), repeat=3))])


def box(half: Array) -> Shape:
    """Return a solid box of half edges `half` (3,), m."""
    return Shape(_BOX_CORNERS * half, np.array([half], dtype=float), segment_box, _box_furthest)


def ball(radius: float) -> Shape:
    """Return a solid sphere of radius `radius`, m."""
    return Shape(_BOX_CORNERS * radius, np.array([radius]), segment_ball, _ball_furthest)


def cylinder(radius: float, half_height: float) -> Shape:
    """Return a solid cylinder round the z axis, of radius `radius` and height 2 `half_height`, m."""
    corners = _BOX_CORNERS * np.array([radius, radius, half_height])
    return Shape(corners, np.array([[radius, half_height]]), _cylinder_distance, _cylinder_furthest)


def mesh(triangles: Array, closed: bool) -> Shape:
    """Return a surface of `triangles` (F, 3, 3), m; that of a solid if `closed`."""
    return Shape(triangles, triangles, segment_triangle, _triangle_furthest, closed)


def _box_furthest(normal: Array, half: Array) -> Array:
    return np.sign(normal) * half


def _ball_furthest(normal: Array, radius: Array) -> Array:
    return radius[:, None] * _unit(normal)


def _unit(vectors: Array) -> Array:
    """Return vectors (P, C) over their lengths; zero ones stay."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)[:, None])


def _cylinder_distance(start: Array, end: Array, sizes: Array) -> DistanceAndNormal:
    return segment_cylinder(start, end, sizes[:, 0], sizes[:, 1])


def _cylinder_furthest(normal: Array, sizes: Array) -> Array:
    rim = sizes[:, :1] * _unit(normal[:, :2])
    return np.concatenate([rim, sizes[:, 1:] * np.sign(normal[:, 2:])], axis=1)


def _triangle_furthest(normal: Array, triangles: Array) -> Array:
    corner = np.einsum("pkc,pc->pk", triangles, normal).argmax(axis=1)
    return np.asarray(triangles[np.arange(len(triangles)), corner])


@dataclass(frozen=True)
class Body:
    """An obstacle of a `shape`, with `center` (3,), m, at time 0, `velocity` (3,), m/s, and attitude `rotation` (3, 3).

    Its methods take and return positions relative to its centre, in directions of the base frame.
    """

    name: str
    center: Array
    velocity: Array
    rotation: Array
    shape: Shape

    def at(self, time: Array) -> Array:
        """Return (P, 3) the centre at times (P,), s."""
        return np.asarray(self.center + self.velocity * time[:, None])

    def corners(self) -> Array:
        """Return (K, C, 3) points whose convex hulls hold the K convex pieces, m."""
        return np.asarray(self.shape.corners @ self.rotation.T)

    def separation(self, start: Array, end: Array, piece: Index) -> DistanceAndNormal:
        """Return distances and normals of P segments against the pieces (P,) of this body."""
        start, end = start @ self.rotation, end @ self.rotation
        distance, normal = self.shape.distance(start, end, self.shape.sizes[piece])
        return distance, normal @ self.rotation.T

    def hull_separation(
        self,
        vertices: Array,
        piece: Index,
        near: Array | None = None,
        enough: Array | float = np.inf,
        *,
        decides: bool = False,
    ) -> DistanceAndNormal:
        """Return distances and normals of P convex hulls of `vertices` (P, V, 3) against the pieces (P,).

        See :func:`~vgtm_qp.verify.convex.hull_distance` for `near`, `enough` and `decides`.
        """
        near = None if near is None else near @ self.rotation
        own, sizes = vertices @ self.rotation, self.shape.sizes[piece]
        distance, normal = self.shape.hull_distance(own, sizes, near, enough, decides=decides)
        return distance, normal @ self.rotation.T

    def support(self, normal: Array, piece: Index) -> Array:
        """Return (P,) the greatest ``normal . x`` over the points x of the pieces, m."""
        return self.shape.reach(normal @ self.rotation, self.shape.sizes[piece])

    def encloses(self, points: Array) -> NDArray[np.bool_]:
        """Return (Q,) True for points (Q, 3) inside a closed mesh: its winding number round them is not zero.

        For other solids the distance shows whether a point is inside. The solid angle of each triangle is
        that of Van Oosterom and Strackee (1983).
        """
        inside = np.zeros(len(points), dtype=np.bool_)
        if not self.shape.closed:
            return inside
        points, triangles = points @ self.rotation, self.shape.corners
        flat = triangles.reshape(-1, 3)
        near = np.flatnonzero(((points > flat.min(axis=0)) & (points < flat.max(axis=0))).all(axis=1))
        for q in near:
            a, b, c = np.moveaxis(triangles - points[q], 1, 0)
            la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
            numerator = np.sum(a * np.cross(b, c), axis=1)
            denominator = la * lb * lc + np.sum(a * b, axis=1) * lc
            denominator += np.sum(b * c, axis=1) * la + np.sum(c * a, axis=1) * lb
            inside[q] = abs(np.arctan2(numerator, denominator).sum()) > np.pi
        return inside


def read_obstacles(
    problem: Mapping[str, Any], meshes: Mapping[str, Any] | None, directory: Path
) -> tuple[list[Body], list[str], list[str]]:
    """Return the obstacles of `problem`, which is JSON data; contradictions; and what could not be checked.

    `meshes` are the SHA-256 and triangle counts of mesh files that the result recorded, by obstacle; None
    without a result. Paths of the files start in `directory`.
    """
    bodies: list[Body] = []
    contradictions: list[str] = []
    notes: list[str] = []
    for number, entry in enumerate(problem.get("obstacle") or (), start=1):
        name = str(entry.get("name") or f"obstacle {number}")
        vectors = (entry.get(key) or (0.0, 0.0, 0.0) for key in ("center", "velocity", "rotation_vector"))
        center, velocity, turn = (np.asarray(vector, dtype=np.float64) for vector in vectors)
        kind, shape, complaint = entry.get("shape", "box"), None, ""
        if kind == "box":
            shape = box(np.broadcast_to(np.asarray(entry["size"], dtype=float), 3) / 2)
        elif kind == "sphere":
            shape = ball(float(entry["radius"]))
        elif kind == "cylinder":
            shape = cylinder(float(entry["radius"]), float(entry["height"]) / 2)
        elif kind == "mesh":
            shape, complaint = _read_mesh(name, entry, meshes, directory)
        else:
            complaint = f"obstacle {name} has the unknown shape {kind!r}"
        if complaint:
            contradictions.append(complaint)
        if shape is not None:
            bodies.append(Body(name, center, velocity, rotation_matrix(turn), shape))
            if shape.closed is False:
                notes.append(f"mesh {name} is not closed: only its surface is an obstacle")
    return bodies, contradictions, notes


def _read_mesh(
    name: str, entry: Mapping[str, Any], meshes: Mapping[str, Any] | None, directory: Path
) -> tuple[Shape | None, str]:
    """Return the mesh, and the flaw of its file."""
    import trimesh

    path = directory / str(entry.get("file", ""))
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        surface = trimesh.load_mesh(path, process=True)
        triangles = np.asarray(surface.triangles, dtype=np.float64).reshape(-1, 3, 3)
        closed = bool(surface.is_watertight)
        if not 0.0 <= np.abs(triangles).max() <= _GREATEST:
            raise ValueError(f"a coordinate is beyond {_GREATEST:g}")
        if closed and not surface.is_winding_consistent:
            raise ValueError("its triangles are not wound alike, which leaves open what is inside")
    except Exception as error:  # trimesh raises whatever the reader of the format raises
        return None, f"mesh {name}: {path} cannot be read, so its clearance is unknown: {error}"
    record = None if meshes is None else meshes.get(name)
    if meshes is None:
        complaint = ""
    elif record is None:
        complaint = f"mesh {name}: the result does not record its file"
    elif record.get("sha256") != digest:
        complaint = f"mesh {name}: {path} is not the file that the result was made with"
    elif record.get("triangles") != len(triangles):
        complaint = (
            f"mesh {name}: {len(triangles)} triangles; the result was made with {record.get('triangles')}"
        )
    else:
        complaint = ""
    scale = float(entry.get("scale") or 1.0)
    return mesh(triangles * scale, closed=closed), complaint
