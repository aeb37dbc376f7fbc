"""Parallel projection of a scene onto paper, and the order of drawing."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array, Index
from vgtm_qp.view.drawing import CarriedMesh, ObstacleMesh, direction

_MANY_FACES = 4000
_SHARP = np.radians(20.0)


class Projection:
    """The parallel projection from `azimuth` about +z and `elevation` above the x-y plane, rad; +z is up."""

    def __init__(self, azimuth: float, elevation: float) -> None:
        toward = direction(azimuth, elevation)
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        self.axes = np.stack([right, np.cross(toward, right), toward])
        """(3, 3), rows: to the right on paper, up on paper, and towards the viewer."""

    def flat(self, points: Array) -> Array:
        """Return (..., 2) the places on paper of points (..., 3), m."""
        return np.asarray(points @ self.axes[:2].T)

    def depth(self, points: Array) -> Array:
        """Return (...,) how near to the viewer points (..., 3) are, m."""
        return np.asarray(points @ self.axes[2])


class ProjectedMesh:
    """An obstacle's surface on paper: outline, seen and hidden edges, and which points are in front of it."""

    def __init__(self, mesh: ObstacleMesh, projection: Projection) -> None:
        import trimesh

        self.mesh, self.projection = mesh, projection
        self._solid = solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
        self.vertices = np.asarray(solid.vertices, dtype=float)
        self.faces = np.asarray(solid.faces)
        self.normals = np.asarray(solid.face_normals, dtype=float)
        self.facing = self.normals @ projection.axes[2] > 0.0
        sharp = np.asarray(solid.face_adjacency_angles) > _SHARP
        self._sharp_edges = np.asarray(solid.face_adjacency_edges)[sharp]
        self._beside = np.asarray(solid.face_adjacency)[sharp]

    def at(self, time: float) -> ProjectedMesh:
        """Return the surface as it is turned at `time`, s."""
        mesh = self.mesh
        return ProjectedMesh(mesh.at(time), self.projection) if isinstance(mesh, CarriedMesh) else self

    @cached_property
    def is_convex(self) -> bool:
        """Whether every vertex is on the inner side of every face; a large mesh counts as not convex."""
        return len(self.faces) <= _MANY_FACES and bool(self._solid.is_convex)

    def depth(self, time: float) -> float:
        """Return how near to the viewer its middle is at `time`, m."""
        middle = (self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2
        return float(self.projection.depth(middle + self.mesh.position(time)))

    def polygons(self, time: float) -> list[Array]:
        """Return the polygons (K, 2) that fill its shape on paper."""
        flat = self.projection.flat(self.vertices + self.mesh.position(time))
        if self.is_convex:
            from scipy.spatial import ConvexHull

            return [flat[ConvexHull(flat).vertices]]
        return list(flat[self.faces[self.facing]])

    def edges(self, time: float, *, seen: bool) -> Array:
        """Return (K, 2, 2) its sharp edges on paper: the visible ones, or those that it hides itself."""
        flat = self.projection.flat(self.vertices + self.mesh.position(time))
        return np.asarray(flat[self._sharp_edges[self.facing[self._beside].any(axis=1) == seen]])

    def is_before(self, points: Array, time: float) -> NDArray[np.bool_]:
        """Return (K,) whether points (K, 3) are drawn over it: not inside or behind it for the viewer.

        A point with a convex body in its line of sight is before the body if and only if it is outside one of
        the planes of the faces that the viewer sees.
        """
        if not self.is_convex:
            return self.projection.depth(points) > self.depth(time)
        corners, normals = self.vertices[self.faces[self.facing, 0]], self.normals[self.facing]
        heights = (points - self.mesh.position(time)) @ normals.T
        return np.asarray((heights > np.einsum("fc,fc->f", normals, corners)).any(axis=1))


def layers(points: Array, surfaces: list[ProjectedMesh], time: float) -> Index:
    """Return (K,) the number of surfaces, farthest first, that are drawn before each point (K, 3)."""
    order = np.zeros(len(points), dtype=np.int64)
    for k, surface in enumerate(surfaces, start=1):
        order[surface.is_before(points, time)] = k
    return order


def pieces(ends: Array, count: int, overlap: float = 0.1) -> Array:
    """Return (M * count, 2, 3) members (M, 2, 3) in `count` pieces, which overlap by so much of one, to hide seams."""
    share = np.linspace(0.0, 1.0, count + 1)
    shares = np.clip(np.stack([share[:-1] - overlap / count, share[1:] + overlap / count], axis=1), 0.0, 1.0)
    along = ends[:, 1] - ends[:, 0]
    return np.asarray(ends[:, None, None, 0] + shares[..., None] * along[:, None, None]).reshape(-1, 2, 3)
