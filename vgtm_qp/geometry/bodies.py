"""The bodies of an arm, and what it carries: capsules and convex hulls, each spanned by points of the arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array

from vgtm_qp.arrays import Array, Index, Mask

_CAPSULE, _HULL = 2, 4
"""Numbers of points that span a capsule and a hull."""

_ROOM = 1e-6
"""Share of its size by which a simplex is larger than what it encloses."""

_LEAST_AXIS = 1e-3
"""Least length of the axis of a capsule, over its radius."""


def lengthened(ends: Array, radius: Array) -> Array:
    """Return the ends (C, 2, 3) of the axes of capsules of those radii (C,), m, far enough apart for a direction.

    The axis of a ball is along z; short ones grow along their own.
    """
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1, keepdims=True)
    unit = np.where(length > 0.0, along / np.maximum(length, np.finfo(float).tiny), [0.0, 0.0, 1.0])
    more = np.maximum(_LEAST_AXIS * radius[:, None] - length, 0.0) / 2.0
    return np.asarray(ends + np.array([[-1.0], [1.0]]) * (more * unit)[:, None])


@dataclass(frozen=True, eq=False)
class Hull:
    """A convex polytope that moves with four points of an arm, the corners of a simplex that encloses it.

    Each of its points is a mean of the four with weights of at least zero, so that no point of it moves further
    than one of them.

    Attributes
    ----------
    simplex : (4, 3)
        Places of the four points, m, in any frame.
    vertices : (V, 3)
        In that frame, m.
    weights : (V, 4)
        Of the four points in each vertex; a row's sum is 1.
    faces : (F, 3) int
        Triangles of its surface, counter-clockwise seen from outside.
    normals : (K, 3)
        Outward unit normals of its faces.
    size : float
        Length of the diagonal of a box round it, m.
    """

    simplex: Array
    vertices: Array
    weights: Array
    faces: Index
    normals: Array
    size: float

    @classmethod
    def of(cls, points: ArrayLike) -> Hull:
        """Return the hull of points (K, 3), m.

        Raises
        ------
        ValueError
            All points are nearly in one plane.
        """
        from scipy.spatial import ConvexHull, QhullError

        given = np.asarray(points, dtype=float)
        try:
            found = ConvexHull(given)
        except (QhullError, ValueError) as error:
            raise ValueError("the points do not span a volume") from error
        vertices = given[found.vertices]
        number = np.empty(len(given), dtype=np.int64)
        number[found.vertices] = np.arange(len(vertices))
        faces, outward = number[found.simplices], found.equations[:, :3]
        a, b, c = np.moveaxis(vertices[faces], 1, 0)
        inward = np.einsum("fc,fc->f", np.cross(b - a, c - a), outward) < 0.0
        faces[inward] = faces[inward][:, [0, 2, 1]]
        normals = outward[np.unique(np.round(outward, 9), axis=0, return_index=True)[1]]
        simplex = _simplex(vertices)
        corners = np.concatenate([simplex.T, np.ones((1, _HULL))])
        weights = np.linalg.solve(corners, np.concatenate([vertices.T, np.ones((1, len(vertices)))])).T
        size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
        return cls(simplex, vertices, weights, faces, normals, size)

    @cached_property
    def inverse(self) -> Array:
        """(3, 3) inverse of the edges of the simplex, columns, from its first corner: a rotation is edges @ inverse."""
        return np.linalg.inv((self.simplex[1:] - self.simplex[0]).T)


def _simplex(points: Array) -> Array:
    """Return the corners (4, 3) of a simplex that encloses points (K, 3), along their principal axes, m."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    own = points @ axes.T
    low, size = own.min(axis=0), np.ptp(own, axis=0)
    room = _ROOM * float(size.max())
    corners = low - room + np.vstack([np.zeros(3), np.diag(3.0 * size + 9.0 * room)])
    return np.asarray(corners @ axes)


@dataclass(frozen=True, eq=False)
class Bodies:
    """B bodies spanned by points of an arm; make them by :func:`capsules` or :func:`convex_bodies`.

    A body is the set of all points within its radius of the convex hull of its vertices: those of its hull, or the
    two ends of the axis of a capsule.

    Attributes
    ----------
    points : (B, E) int
        The points that span each body, rows of the positions (P, 3): the two ends of capsules if all are capsules;
        else four, those of the hull's simplex, or the ends of a capsule twice.
    radius : (B,)
        m.
    joints : (B, 2) int
        The joints at the two ends. Two bodies with a joint in common are neighbours, and may touch.
    names : tuple of str
    kind : str
        Word for such a body in names, as in ``"member L3-2"``.
    touching : (K, 2) int
        Further pairs that may touch.
    carried : int
        Number of the last ones that belong to what the arm carries.
    hulls : tuple of Hull or None
        The hulls of bodies, None for capsules; empty if all are capsules.
    """

    points: Index
    radius: Array
    joints: Index
    names: tuple[str, ...]
    kind: str
    touching: Index = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    carried: int = 0
    hulls: tuple[Hull | None, ...] = ()

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def is_hull(self) -> Mask:
        """(B,) bool, False for capsules."""
        return np.asarray(self.counts > _CAPSULE)

    @cached_property
    def counts(self) -> Index:
        """(B,) numbers of vertices: two for capsules."""
        hulls = self.hulls or (None,) * len(self)
        return np.array([_CAPSULE if hull is None else len(hull.vertices) for hull in hulls], dtype=np.int64)

    @cached_property
    def _weights(self) -> Array:
        every = np.arange(self.counts.max(initial=_CAPSULE))
        weights = np.tile(np.eye(_HULL)[every % _CAPSULE], (len(self), 1, 1))
        for body, hull in enumerate(self.hulls):
            if hull is not None:
                weights[body] = hull.weights[every % len(hull.vertices)]
        return weights

    def weights_of(self, body: Index) -> Array:
        """Return (k, V, 4) weights of the four points of bodies (k,) in their vertices, some of which are repeated."""
        return self._weights[body, : self.counts[body].max(initial=_CAPSULE)]

    @cached_property
    def sizes(self) -> Array:
        """(B,) sizes of the hulls, m; zero for capsules."""
        sizes = np.zeros(len(self))
        for body, hull in enumerate(self.hulls):
            sizes[body] = 0.0 if hull is None else hull.size
        return sizes

    def may_touch(self, first: Index, second: Index) -> Mask:
        """Return (P,) which pairs of bodies are neighbours or :attr:`touching`."""
        a, b = self.joints[first], self.joints[second]
        allowed = (a[:, :, None] == b[:, None, :]).any(axis=(1, 2))
        if len(self.touching):
            count = len(self)
            pairs = np.minimum(first, second) * count + np.maximum(first, second)
            allowed |= np.isin(pairs, self.touching.min(axis=1) * count + self.touching.max(axis=1))
        return np.asarray(allowed)

    @cached_property
    def neighbours(self) -> tuple[Index, Index]:
        """All bodies that each one may touch, itself among them, body after body, and (B + 1,) where these begin."""
        ends = np.unique(self.joints, return_inverse=True)[1].reshape(-1)
        every, (first, second) = np.arange(len(self)), self.touching.reshape(-1, 2).T
        at = csr_array((np.ones(len(ends)), (np.repeat(every, 2), ends)))
        pairs = csr_array((np.ones(len(first)), (first, second)), shape=(len(self), len(self)))
        found = csr_array(at @ at.T + pairs + pairs.T)
        return np.asarray(found.indices), np.asarray(found.indptr)

    def called(self, body: int) -> str:
        """Return kind and name of a body: ``"member L3-2"``, ``"carried crate"``."""
        kind = self.kind if body < len(self) - self.carried else "carried"
        return f"{kind} {self.names[body]}"

    def some(self, X: Array) -> Array:
        """Return (B, 2, 3) two points of each body without its radius, for points at `X` (P, 3), m."""
        ends = X[self.points[:, :_CAPSULE]]
        for body in np.flatnonzero(self.is_hull).tolist():
            hull = self.hulls[body]
            assert hull is not None
            ends[body] = hull.weights[:_CAPSULE] @ X[self.points[body]]
        return np.asarray(ends)

    def joined(self, ends: Index, radius: Array, joints: Index, names: Sequence[str]) -> Bodies:
        """Return the bodies and the capsules between `ends` (C, 2) that the arm carries, with their joints (C, 2)."""
        width = self.points.shape[1]
        return replace(
            self,
            points=np.concatenate([self.points, np.tile(ends, width // _CAPSULE)]),
            radius=np.concatenate([self.radius, radius]),
            joints=np.concatenate([self.joints, joints]),
            names=(*self.names, *names),
            carried=len(ends),
            hulls=(*self.hulls, *[None] * len(ends)) if self.hulls else (),
        )


def capsules(
    points: ArrayLike,
    radius: ArrayLike,
    names: Sequence[str] | None = None,
    *,
    joints: ArrayLike | None = None,
    kind: str = "member",
) -> Bodies:
    """Return capsules (B) between `points` (B, 2).

    The radius, m, may be one for all. Names are by default ``"0"``, ``"1"``..., and the joints (B, 2) the points:
    bodies that share a point are neighbours.
    """
    span = np.asarray(points, dtype=np.int64).reshape(-1, _CAPSULE)
    return Bodies(
        points=span,
        radius=np.broadcast_to(np.asarray(radius, dtype=float), len(span)).copy(),
        joints=span if joints is None else np.asarray(joints, dtype=np.int64).reshape(-1, 2),
        names=tuple(map(str, range(len(span)))) if names is None else tuple(names),
        kind=kind,
    )


def convex_bodies(
    points: Sequence[Sequence[int]],
    hulls: Sequence[Hull | None],
    radius: ArrayLike,
    names: Sequence[str],
    *,
    joints: ArrayLike,
    kind: str = "link",
) -> Bodies:
    """Return bodies with `hulls`, or capsules where these are None.

    The points are four for a hull, the corners of its simplex in their order, and two for a capsule.
    """
    if all(hull is None for hull in hulls):
        return capsules(np.array(points), radius, names, joints=joints, kind=kind)
    span = np.array([list(own) * (_HULL // len(own)) for own in points], dtype=np.int64)
    ends = capsules(span[:, :_CAPSULE], radius, names, joints=joints, kind=kind)
    return replace(ends, points=span, hulls=tuple(hulls))
