"""Members that lie together, as parts of an arm: how parts have moved against each other, and which come near.

However far an arm has moved, members in one place have moved together. What is known of their distances holds for as
long as the arm has not bent there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vgtm_qp.geometry.groups import Members

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_MEMBERS = 32
"""A part has no more members than that: some three bays."""


class Parts:
    """Members, parted by where they are at a configuration; parts whose balls are nearer than a horizon are near.

    Parameters
    ----------
    members : Members
    X : (N, 3)
        Positions of the points that members end at, m.
    horizon : float
        m.

    Attributes
    ----------
    of : (M,) int
        The part of each member.
    near : (K, 2) int
        Pairs of parts that are near, each part with itself among them.
    beyond : float
        No two parts that are not near were nearer to each other when that was looked at last, m.
    """

    def __init__(self, members: Members, X: Array, horizon: float) -> None:
        tree = cKDTree(X[members.nodes].mean(axis=1), leafsize=_MEMBERS)
        self._order = np.asarray(tree.indices, dtype=np.int64)
        leaves = np.array(sorted(_leaves(tree.tree)), dtype=np.int64)
        self._first, self._count = leaves[:, 0], leaves[:, 1] - leaves[:, 0]
        self._thickness = np.maximum.reduceat(members.radius[self._order], self._first)
        part = np.empty(len(self._order), dtype=np.int64)
        part[self._order] = np.repeat(np.arange(len(leaves)), self._count)
        # A node is in each part that one of its members is in, once.
        codes = np.unique(np.repeat(part, 2) * len(X) + members.nodes.reshape(-1))
        self._part, self._nodes = codes // len(X), codes % len(X)
        self._start = np.searchsorted(self._part, np.arange(len(leaves)))
        self._size = np.diff(self._start, append=len(codes)).astype(float)
        self.of, self.beyond = part, horizon
        self._horizon = horizon
        pairs, gaps = self._pairs(*self._balls(X))
        every = np.arange(len(leaves))
        self.near = np.concatenate([np.stack([every, every], axis=1), pairs[gaps < horizon]])
        self._codes = self._codes_of(*self.near.T)

    def among(self, chosen: NDArray[np.bool_], first: Index, second: Index) -> NDArray[np.bool_]:
        """Return which pairs of members (K,) are in pairs of parts that are `chosen` of the rows of :attr:`near`."""
        return np.isin(self._codes_of(self.of[first], self.of[second]), self._codes[chosen])

    def _codes_of(self, first: Index, second: Index) -> Index:
        """Return a number for each pair of parts (K,), whichever is first."""
        return np.asarray(np.minimum(first, second) * len(self._count) + np.maximum(first, second))

    def inside(self, parts: Index) -> tuple[Index, Index]:
        """Return the members of some parts, and the points these end at."""
        return np.flatnonzero(np.isin(self.of, parts)), np.unique(self._nodes[np.isin(self._part, parts)])

    def _balls(self, vectors: Array) -> tuple[Array, Array]:
        """Return centers (P, 3) and radii (P,) of balls round the vectors (N, 3) of the nodes of each part."""
        own = vectors.take(self._nodes, axis=0)
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

    def look(self, X: Array) -> None:
        """Find anew how near parts that are not near may have come at `X` (N, 3): see :attr:`beyond`."""
        pairs, gaps = self._pairs(*self._balls(X))
        # Few are so near that they have to be looked up.
        close = gaps < self._horizon
        unlisted = ~np.isin(self._codes_of(*pairs[close].T), self._codes)
        self.beyond = min(self._horizon, float(gaps[close][unlisted].min(initial=np.inf)))

    def strain(self, shift: Array) -> Array:
        """Return by how much the distances of points in near parts have changed at most, m, for each row of `near`.

        A point of a member moves by a mean of what the member's ends move by, so that it is in the ball of its part.

        Parameters
        ----------
        shift : (N, 3)
            What the points that members end at have moved by, m.
        """
        center, radius = self._balls(shift)
        first, second = self.near.T
        way = center.take(first, axis=0) - center.take(second, axis=0)
        apart = np.sqrt(np.einsum("kc,kc->k", way, way))
        return np.asarray(apart + radius.take(first) + radius.take(second))

    def facing(self, X: Array, points: Array, reach: Array) -> tuple[Index, Index]:
        """Return pairs of members and `points` (K, 3), among them all that are nearer than `reach` (K,), m, at `X`."""
        center, radius = self._balls(X)
        radius += self._thickness
        found = cKDTree(center).query_ball_point(points, reach + float(radius.max()))
        point = np.repeat(np.arange(len(points)), [len(f) for f in found])
        part = np.concatenate([np.zeros(0, dtype=np.int64), *(np.array(f, dtype=np.int64) for f in found)])
        inside = np.linalg.norm(center[part] - points[point], axis=1) <= radius[part] + reach[point]
        part, point = part[inside], point[inside]
        count = self._count[part]
        # Members of a part stand one after the other.
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
