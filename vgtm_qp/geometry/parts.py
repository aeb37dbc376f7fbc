"""Bodies that lie together, as parts of an arm: how parts have moved relative to each other, and which come near.

However far an arm has moved, bodies in one place have moved together. Bounds of their distances hold for as long as
the arm has not bent there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vgtm_qp.geometry.bodies import Bodies

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_BODIES = 32
"""A part has no more bodies than that: some three bays of a truss."""


class Parts:
    """Bodies, divided by where they are at a configuration; parts whose balls are nearer than a horizon are near.

    Parameters
    ----------
    bodies : Bodies
    X : (P, 3)
        Positions of the points, m.
    horizon : float
        m.

    Attributes
    ----------
    of : (B,) int
        The part of each body.
    near : (K, 2) int
        Pairs of parts that are near, among them each part with itself.
    beyond : float
        Lower bound of the distances of parts that are not near, at the positions of :meth:`update_beyond`, m.
    """

    def __init__(self, bodies: Bodies, X: Array, horizon: float) -> None:
        tree = cKDTree(X[bodies.points].mean(axis=1), leafsize=_BODIES)
        self._order = np.asarray(tree.indices, dtype=np.int64)
        leaves = np.array(sorted(_leaves(tree.tree)), dtype=np.int64)
        self._first, self._count = leaves[:, 0], leaves[:, 1] - leaves[:, 0]
        self._thickness = np.maximum.reduceat(bodies.radius[self._order], self._first)
        part = np.empty(len(self._order), dtype=np.int64)
        part[self._order] = np.repeat(np.arange(len(leaves)), self._count)
        # A point is in each part that one of its bodies is in, once.
        codes = np.unique(np.repeat(part, 2) * len(X) + bodies.points.reshape(-1))
        self._part, self._points = codes // len(X), codes % len(X)
        self._start = np.searchsorted(self._part, np.arange(len(leaves)))
        self._size = np.diff(self._start, append=len(codes)).astype(float)
        self.of, self.beyond = part, horizon
        self._horizon = horizon
        pairs, gaps = self._pairs(*self._balls(X))
        every = np.arange(len(leaves))
        self.near = np.concatenate([np.stack([every, every], axis=1), pairs[gaps < horizon]])
        self._codes = self._codes_of(*self.near.T)

    def among(self, chosen: NDArray[np.bool_], first: Index, second: Index) -> NDArray[np.bool_]:
        """Return which pairs of bodies (K,) are in pairs of parts that are `chosen` of the rows of :attr:`near`."""
        return np.isin(self._codes_of(self.of[first], self.of[second]), self._codes[chosen])

    def _codes_of(self, first: Index, second: Index) -> Index:
        """Return a number for each pair of parts (K,), whichever is first."""
        return np.asarray(np.minimum(first, second) * len(self._count) + np.maximum(first, second))

    def inside(self, parts: Index) -> tuple[Index, Index]:
        """Return the bodies of some parts, and the points that span these."""
        return np.flatnonzero(np.isin(self.of, parts)), np.unique(self._points[np.isin(self._part, parts)])

    def _balls(self, vectors: Array) -> tuple[Array, Array]:
        """Return centers (K, 3) and radii (K,) of balls round the vectors (P, 3) of the points of each part."""
        own = vectors.take(self._points, axis=0)
        center = np.add.reduceat(own, self._start, axis=0) / self._size[:, None]
        own -= center.take(self._part, axis=0)
        square = np.maximum.reduceat(np.einsum("kc,kc->k", own, own), self._start)
        return center, np.sqrt(square)

    def _pairs(self, center: Array, radius: Array) -> tuple[Index, Array]:
        """Return pairs of parts (K, 2), among them all nearer than the horizon, and their distances (K,), m."""
        radius = radius + self._thickness
        reach = 2.0 * float(radius.max()) + self._horizon
        pairs = cKDTree(center).query_pairs(reach, output_type="ndarray").astype(np.int64)
        first, second = pairs.T
        apart = np.linalg.norm(center[first] - center[second], axis=1)
        return pairs, apart - radius[first] - radius[second]

    def update_beyond(self, X: Array) -> None:
        """Compute how near parts that are not near may be at `X` (P, 3): see :attr:`beyond`."""
        pairs, gaps = self._pairs(*self._balls(X))
        # Few are so near that their numbers have to be compared.
        close = gaps < self._horizon
        unlisted = ~np.isin(self._codes_of(*pairs[close].T), self._codes)
        self.beyond = min(self._horizon, float(gaps[close][unlisted].min(initial=np.inf)))

    def distance_changes(self, displacement: Array) -> Array:
        """Return by how much the distances of points in near parts have changed at most, m, for each row of `near`.

        A point of a body is displaced by a mean of its ends' displacements, which is in the ball of its part.

        Parameters
        ----------
        displacement : (P, 3)
            Of the points, m.
        """
        center, radius = self._balls(displacement)
        first, second = self.near.T
        between = center.take(first, axis=0) - center.take(second, axis=0)
        apart = np.sqrt(np.einsum("kc,kc->k", between, between))
        return np.asarray(apart + radius.take(first) + radius.take(second))

    def facing(self, X: Array, points: Array, reach: Array) -> tuple[Index, Index]:
        """Return pairs of bodies and `points` (K, 3), among them all that are nearer than `reach` (K,), m, at `X`."""
        center, radius = self._balls(X)
        radius += self._thickness
        found = cKDTree(center).query_ball_point(points, reach + float(radius.max()))
        point = np.repeat(np.arange(len(points)), [len(f) for f in found])
        part = np.concatenate([np.zeros(0, dtype=np.int64), *(np.array(f, dtype=np.int64) for f in found)])
        inside = np.linalg.norm(center[part] - points[point], axis=1) <= radius[part] + reach[point]
        part, point = part[inside], point[inside]
        count = self._count[part]
        # The bodies of a part stand one after the other.
        places = np.arange(int(count.sum())) + np.repeat(
            self._first[part] - (np.cumsum(count) - count), count
        )
        return self._order[places], np.repeat(point, count)


def _leaves(node: Any) -> list[tuple[int, int]]:
    """Return where the leaves of a tree begin and end in its order."""
    found, stack = [], [node]
    while stack:
        node = stack.pop()
        if node.split_dim == -1:
            found.append((node.start_idx, node.end_idx))
        else:
            stack += [node.lesser, node.greater]
    return found
