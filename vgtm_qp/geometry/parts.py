"""Parts of an arm, groups of neighbouring bodies: relative motion of parts, and pairs of parts that come near.

However far an arm has moved, neighbouring bodies have moved together. Bounds of their distances hold as long
as the arm has not bent near them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.geometry.bodies import Bodies

BODIES = 32
"""Greatest number of bodies of a part: about three bays of a truss."""


class Division:
    """Bodies, divided by their positions at `X` (P, 3).

    Attributes
    ----------
    bodies, bodies_at : (B,) int, (parts + 1,) int
        The bodies of each part, part after part, and where these begin.
    points, points_at : 1-D int, (parts + 1,) int
        The points of each part, and where these begin.
    thickness : (parts,)
        Greatest radius of a body of each, m.
    of, part : (B,) int, 1-D int
        The part of each body, and of each of the `points`.
    """

    def __init__(self, bodies: Bodies, X: Array) -> None:
        tree = cKDTree(X[bodies.points].mean(axis=1), leafsize=BODIES)
        self.bodies, self.bodies_at = tree.indices, np.array([*_leaves(tree.tree), len(bodies)])
        self.of = np.empty(len(bodies), dtype=np.int64)
        self.of[self.bodies] = np.repeat(np.arange(len(self)), np.diff(self.bodies_at))
        self.thickness = np.maximum.reduceat(bodies.radius[self.bodies], self.bodies_at[:-1])
        # A point is in each part that has one of its bodies, once.
        span = bodies.points.shape[1]
        points = np.unique(np.repeat(self.of, span) * len(X) + bodies.points.reshape(-1))
        self.part, self.points = np.divmod(points, len(X))
        self.points_at = np.searchsorted(self.part, np.arange(len(self) + 1))

    def __len__(self) -> int:
        return len(self.bodies_at) - 1


class Parts:
    """The :class:`Division` of bodies at `X` (P, 3); parts whose balls are nearer than a horizon, m, are near.

    Attributes
    ----------
    near : (K, 2) int
        Pairs of parts that are near, among them each part with itself.
    beyond : float
        Lower bound of the distances of parts that are not near, at the positions of :meth:`update_beyond`, m.
    """

    def __init__(self, bodies: Bodies, X: Array, horizon: float) -> None:
        self._division = Division(bodies, X)
        self._horizon = self.beyond = horizon
        pairs, gaps = self._pairs(X)
        every = np.arange(len(self._division))
        self.near = np.concatenate([np.stack([every, every], axis=1), pairs[gaps < horizon]])
        self._codes = self._codes_of(*self.near.T)

    def among(self, chosen: Mask, first: Index, second: Index) -> Mask:
        """Return (K,) which pairs of bodies are in the pairs of parts that `chosen` picks from `near`."""
        return np.isin(
            self._codes_of(self._division.of[first], self._division.of[second]), self._codes[chosen]
        )

    def _codes_of(self, first: Index, second: Index) -> Index:
        """Return (K,) a number for each pair of parts, the same in either order."""
        return np.asarray(np.minimum(first, second) * len(self._division) + np.maximum(first, second))

    def inside(self, parts: Index) -> tuple[Index, Index]:
        """Return the bodies of some parts, and the points that span these."""
        division = self._division
        return np.flatnonzero(np.isin(division.of, parts)), np.unique(
            division.points[np.isin(division.part, parts)]
        )

    def _balls(self, vectors: Array) -> tuple[Array, Array]:
        """Return centers (K, 3) and radii (K,) of balls round the vectors (P, 3) of the points of each part."""
        division = self._division
        own, starts = vectors.take(division.points, axis=0), division.points_at[:-1]
        center = np.add.reduceat(own, starts, axis=0) / np.diff(division.points_at)[:, None]
        own -= center.take(division.part, axis=0)
        square = np.maximum.reduceat(np.einsum("kc,kc->k", own, own), starts)
        return center, np.sqrt(square)

    def _pairs(self, X: Array) -> tuple[Index, Array]:
        """Return pairs of parts (K, 2), among them all nearer than the horizon at `X`, and their distances (K,), m."""
        center, radius = self._balls(X)
        radius += self._division.thickness
        reach = 2.0 * float(radius.max()) + self._horizon
        pairs = cKDTree(center).query_pairs(reach, output_type="ndarray").astype(np.int64)
        first, second = pairs.T
        apart = np.linalg.norm(center[first] - center[second], axis=1)
        return pairs, apart - radius[first] - radius[second]

    def update_beyond(self, X: Array) -> None:
        """Compute :attr:`beyond` at `X` (P, 3)."""
        pairs, gaps = self._pairs(X)
        # Only few parts are so near that their codes must be compared.
        close = gaps < self._horizon
        unlisted = ~np.isin(self._codes_of(*pairs[close].T), self._codes)
        self.beyond = min(self._horizon, float(gaps[close][unlisted].min(initial=np.inf)))

    def distance_changes(self, displacement: Array) -> Array:
        """Return (K,) bounds of the change of distances between points of near parts, m, one a row of `near`.

        The displacement of a point is a mean of its body's ends' displacements (P, 3), m, and so in the
        part's ball.
        """
        center, radius = self._balls(displacement)
        first, second = self.near.T
        between = center.take(first, axis=0) - center.take(second, axis=0)
        apart = np.sqrt(np.einsum("kc,kc->k", between, between))
        return np.asarray(apart + radius.take(first) + radius.take(second))


def _leaves(node: Any) -> list[int]:
    """Return where the leaves below a node of a tree begin, in the tree's order."""
    return [node.start_idx] if node.split_dim < 0 else [*_leaves(node.lesser), *_leaves(node.greater)]
