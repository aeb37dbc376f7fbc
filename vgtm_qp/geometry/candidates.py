"""Which pairs may come near: one broad phase, good for as long as nothing has moved too far."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vgtm_qp.geometry.groups import Group, Kernels, Members, Motion
from vgtm_qp.geometry.shapes import Pieces

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Candidates:
    """All pairs nearer than a horizon at a reference configuration, with their exact distances there.

    Pairs that are not listed were at least ``horizon`` (``self_horizon`` for two members) apart.
    """

    def __init__(
        self,
        members: Members,
        pieces: Pieces,
        kernels: Kernels,
        X: Array,
        time: float,
        horizon: float,
        self_horizon: float | None,
    ) -> None:
        self.reference, self.time = X.copy(), time
        self.horizon = horizon if len(pieces) else np.inf
        self.self_horizon = np.inf if self_horizon is None else self_horizon
        self._members, self._fastest = members, pieces.fastest
        self.groups: list[Group] = []
        ends = X[members.nodes]
        middle, half = ends.mean(axis=1), 0.5 * (ends[:, 1] - ends[:, 0])
        if len(pieces):
            member, piece = _near_pieces(middle, half, members.radius, pieces, time, horizon)
            for shape in np.unique(pieces.shape):
                chosen = pieces.shape[piece] == shape
                self.groups.append(Group(str(shape), member[chosen], piece[chosen], members, pieces, kernels))
        if self_horizon is not None:
            first, second = _near_members(middle, half, members, self_horizon)
            self.groups.append(Group("segment", first, second, members, pieces, kernels))
        self.groups = [group for group in self.groups if len(group)]
        self._sort()

    def _sort(self) -> None:
        for group in self.groups:
            group.keep_near(self.reference, self.time, self.self_horizon if group.is_self else self.horizon)
        self.groups = [group for group in self.groups if len(group)]

    def refresh(self, X: Array, time: float) -> None:
        """Move the reference to `X` without a broad phase: the horizons shrink by what the members moved."""
        self.horizon, self.self_horizon = self.beyond(self.motion(X, time))
        self.reference, self.time = X.copy(), time
        self._sort()

    def motion(
        self, X: Array, time: float, end: Array | None = None, end_time: float | None = None
    ) -> Motion:
        """Return the motion since the reference, the greatest on the straight way to `end` if given."""
        moved = self._members.moved(X, self.reference)
        elapsed = abs(time - self.time)
        if end is not None:
            np.maximum(moved, self._members.moved(end, self.reference), out=moved)
        if end_time is not None:
            elapsed = max(elapsed, abs(end_time - self.time))
        return Motion(moved, float(moved.max(initial=0.0)), elapsed)

    def beyond(self, motion: Motion) -> tuple[float, float]:
        """Return lower bounds of the distances of the pairs not listed: to pieces, and between members."""
        drift = self._fastest * motion.elapsed
        return self.horizon - motion.greatest - drift, self.self_horizon - 2.0 * motion.greatest


def _near_pieces(
    middle: Array, half: Array, radius: Array, pieces: Pieces, time: float, horizon: float
) -> tuple[Index, Index]:
    """Return pairs that the plane between member and bounding sphere does not keep apart."""
    centers = pieces.center + time * pieces.velocity
    longest = float(np.max(np.linalg.norm(half, axis=1) + radius))
    found = cKDTree(middle).query_ball_point(centers, pieces.radius + (longest + horizon))
    counts = np.fromiter((len(f) for f in found), dtype=np.int64, count=len(found))
    piece = np.repeat(np.arange(len(found)), counts)
    member = np.fromiter((m for f in found for m in f), dtype=np.int64, count=int(counts.sum()))
    if np.isinf(horizon):
        return member, piece
    way = middle[member] - centers[piece]
    apart = np.sqrt(np.einsum("kc,kc->k", way, way))
    span = np.abs(np.einsum("kc,kc->k", way, half[member]))
    # Multiplied by the distance of the centers, which may be zero.
    near = apart * (apart - radius[member] - pieces.radius[piece] - horizon) <= span
    return member[near], piece[near]


def _near_members(middle: Array, half: Array, members: Members, horizon: float) -> tuple[Index, Index]:
    """Return pairs of members without a common node that the plane between them does not keep apart."""
    nodes, radius = members.joined, members.radius
    longest = float(np.max(np.linalg.norm(half, axis=1) + radius))
    pairs = cKDTree(middle).query_pairs(2.0 * longest + horizon, output_type="ndarray").astype(np.int64)
    first, second = pairs[:, 0], pairs[:, 1]
    if not np.isinf(horizon):
        way = middle[first] - middle[second]
        apart = np.sqrt(np.einsum("kc,kc->k", way, way))
        span = np.abs(np.einsum("kc,kc->k", way, half[first]))
        span += np.abs(np.einsum("kc,kc->k", way, half[second]))
        near = apart * (apart - radius[first] - radius[second] - horizon) <= span
        first, second = first[near], second[near]
    a, b, c, d = nodes[first, 0], nodes[first, 1], nodes[second, 0], nodes[second, 1]
    strangers = (a != c) & (a != d) & (b != c) & (b != d)
    return first[strangers], second[strangers]
