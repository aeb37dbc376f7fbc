"""The obstacles of a stored problem as convex pieces that move along straight lines without turning."""

from __future__ import annotations

import hashlib
import itertools
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.result.rotation import rotation_matrix
from vgtm_qp.verify.distance import (
    Separation,
    segment_ball,
    segment_box,
    segment_cylinder,
    segment_triangle,
)

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class Body(ABC):
    """An obstacle; positions it takes and gives are relative to its centre, in directions of the base frame.

    Methods with an underscore are those of its shape, in directions of its own axes.

    Attributes
    ----------
    name : str
        Its name in the problem.
    center, velocity : (3,)
        Position at time 0, m, and its rate, m/s.
    rotation : (3, 3)
        Its attitude.
    """

    name: str
    center: Array
    velocity: Array
    rotation: Array

    def at(self, time: Array) -> Array:
        """Return (P, 3) the centre at times (P,), s."""
        return np.asarray(self.center + self.velocity * time[:, None])

    @property
    def corners(self) -> Array:
        """(K, C, 3) points whose convex hulls hold the K convex pieces, m."""
        return np.asarray(self._corners() @ self.rotation.T)

    def separation(self, start: Array, end: Array, piece: Index) -> Separation:
        """Return distances and normals of P segments against the pieces (P,) of this body."""
        distance, normal = self._separation(start @ self.rotation, end @ self.rotation, piece)
        return distance, normal @ self.rotation.T

    def support(self, normal: Array, piece: Index) -> Array:
        """Return (P,) the greatest ``normal . x`` over the points x of the pieces, m."""
        return np.asarray(self._support(normal @ self.rotation, piece))

    def encloses(self, points: Array) -> NDArray[np.bool_]:
        """Return (Q,) True for points (Q, 3) inside without a surface near, as only a closed mesh has."""
        return np.zeros(len(points), dtype=np.bool_)

    @abstractmethod
    def _corners(self) -> Array: ...

    @abstractmethod
    def _separation(self, start: Array, end: Array, piece: Index) -> Separation: ...

    @abstractmethod
    def _support(self, normal: Array, piece: Index) -> Array: ...


_BOX_CORNERS: Array = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))[None]


@dataclass(frozen=True)
class BoxBody(Body):
    """A solid box of half edges `half` (3,), m."""

    half: Array

    def _corners(self) -> Array:
        return np.asarray(_BOX_CORNERS * self.half)

    def _separation(self, start: Array, end: Array, piece: Index) -> Separation:  # noqa: ARG002
        return segment_box(start, end, self.half)

    def _support(self, normal: Array, piece: Index) -> Array:  # noqa: ARG002
        return np.asarray(np.abs(normal) @ self.half)


@dataclass(frozen=True)
class BallBody(Body):
    """A solid sphere of radius `radius`, m."""

    radius: float

    def _corners(self) -> Array:
        return _BOX_CORNERS * self.radius

    def _separation(self, start: Array, end: Array, piece: Index) -> Separation:  # noqa: ARG002
        return segment_ball(start, end, self.radius)

    def _support(self, normal: Array, piece: Index) -> Array:  # noqa: ARG002
        return np.asarray(self.radius * np.linalg.norm(normal, axis=1))


@dataclass(frozen=True)
class CylinderBody(Body):
    """A solid cylinder round its own z axis, of radius `radius` and height 2 `half_height`, m."""

    radius: float
    half_height: float

    def _corners(self) -> Array:
        return _BOX_CORNERS * np.array([self.radius, self.radius, self.half_height])

    def _separation(self, start: Array, end: Array, piece: Index) -> Separation:  # noqa: ARG002
        return segment_cylinder(start, end, self.radius, self.half_height)

    def _support(self, normal: Array, piece: Index) -> Array:  # noqa: ARG002
        radial = np.linalg.norm(normal[:, :2], axis=1)
        return np.asarray(self.radius * radial + self.half_height * np.abs(normal[:, 2]))


@dataclass(frozen=True)
class MeshBody(Body):
    """A surface of `triangles` (F, 3, 3), m, along its own axes; solid where `closed`."""

    triangles: Array
    closed: bool

    def _corners(self) -> Array:
        return self.triangles

    def _separation(self, start: Array, end: Array, piece: Index) -> Separation:
        return segment_triangle(start, end, self.triangles[piece])

    def _support(self, normal: Array, piece: Index) -> Array:
        return np.asarray(np.einsum("pkc,pc->pk", self.triangles[piece], normal).max(axis=1))

    def encloses(self, points: Array) -> NDArray[np.bool_]:
        """Return (Q,) True where the winding number of the closed surface round a point is not zero.

        The solid angle of each triangle is that of Van Oosterom and Strackee (1983).
        """
        inside = np.zeros(len(points), dtype=np.bool_)
        if not self.closed:
            return inside
        points = points @ self.rotation
        flat = self.triangles.reshape(-1, 3)
        near = np.flatnonzero(((points > flat.min(axis=0)) & (points < flat.max(axis=0))).all(axis=1))
        for q in near:
            a, b, c = np.moveaxis(self.triangles - points[q], 1, 0)
            la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
            numerator = np.sum(a * np.cross(b, c), axis=1)
            denominator = la * lb * lc + np.sum(a * b, axis=1) * lc
            denominator += np.sum(b * c, axis=1) * la + np.sum(c * a, axis=1) * lb
            inside[q] = abs(np.arctan2(numerator, denominator).sum()) > np.pi
        return inside


def read_obstacles(
    problem: Mapping[str, Any], meshes: Mapping[str, Any], directory: Path
) -> tuple[list[Body], list[str], list[str]]:
    """Return the obstacles of `problem`, what contradicts the problem, and what could not be checked.

    Parameters
    ----------
    problem : mapping
        A problem as JSON data.
    meshes : mapping
        The SHA-256 and triangle count of each mesh file by its obstacle's name, as the result recorded them.
    directory : Path
        Where relative paths of mesh files start.
    """
    bodies: list[Body] = []
    contradictions: list[str] = []
    notes: list[str] = []
    for number, entry in enumerate(problem.get("obstacle") or (), start=1):
        name = str(entry.get("name") or f"obstacle {number}")
        vectors = (entry.get(key) or (0.0, 0.0, 0.0) for key in ("center", "velocity", "rotation_vector"))
        center, velocity, turn = (np.asarray(vector, dtype=np.float64) for vector in vectors)
        placed = (name, center, velocity, rotation_matrix(turn))
        shape = entry.get("shape", "box")
        if shape == "box":
            bodies.append(
                BoxBody(*placed, half=np.broadcast_to(np.asarray(entry["size"], dtype=float), 3) / 2)
            )
        elif shape == "sphere":
            bodies.append(BallBody(*placed, radius=float(entry["radius"])))
        elif shape == "cylinder":
            bodies.append(CylinderBody(*placed, float(entry["radius"]), float(entry["height"]) / 2))
        elif shape == "mesh":
            body, complaint = _read_mesh(placed, entry, meshes.get(name), directory)
            if complaint:
                contradictions.append(complaint)
            if body is not None:
                bodies.append(body)
                if not body.closed:
                    notes.append(f"mesh {name} is not closed: only its surface is an obstacle")
        else:
            contradictions.append(f"obstacle {name} has the unknown shape {shape!r}")
    return bodies, contradictions, notes


def _read_mesh(
    placed: tuple[str, Array, Array, Array],
    entry: Mapping[str, Any],
    record: Mapping[str, Any] | None,
    directory: Path,
) -> tuple[MeshBody | None, str]:
    """Return the mesh, and what is wrong with its file."""
    import trimesh

    name = placed[0]
    path = directory / str(entry.get("file", ""))
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        surface = trimesh.load_mesh(path, process=True)
        triangles = np.asarray(surface.triangles, dtype=np.float64)
    except Exception as error:  # trimesh raises whatever the reader of the format raises
        return None, f"mesh {name}: {path} cannot be read, so its clearance is unknown: {error}"
    if record is None:
        complaint = f"mesh {name}: the result does not record its file"
    elif record.get("sha256") != digest:
        complaint = f"mesh {name}: {path} is not the file that the result was made with"
    elif record.get("triangles") != len(triangles):
        complaint = (
            f"mesh {name}: {len(triangles)} triangles; the result was made with {record.get('triangles')}"
        )
    else:
        complaint = ""
    scaled = triangles * float(entry.get("scale") or 1.0)
    return MeshBody(*placed, triangles=scaled, closed=bool(surface.is_watertight)), complaint
