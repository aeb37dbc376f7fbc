"""Which pairs may come near: good until bodies have moved too far, or the arm has bent too much between two."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vgtm_qp.geometry.bodies import Bodies
from vgtm_qp.geometry.groups import Displacement, Displacements, Group, ShapeKernels
from vgtm_qp.geometry.parts import Parts
from vgtm_qp.geometry.shapes import ObstaclePieces

Array = NDArray[np.float64]
Index = NDArray[np.int64]


_MOST_BENDING = 0.5
"""Where a larger share of the near parts than that bends, all bodies are compared again."""


class _PairList:
    """Pairs that share a reference.

    Attributes
    ----------
    reference : (P, 3)
        Where the points were when the pairs were compared, m.
    horizon : float
        Pairs of this kind that are not listed were as far apart there, m.
    groups : list of Group
    unneeded : int
        How many pairs have been evaluated since that turned out to be far.
    """

    def __init__(self, reference: Array, horizon: float = np.inf) -> None:
        self.reference, self.horizon = reference, horizon
        self.groups: list[Group] = []
        self.unneeded = 0

    def renew(self, groups: list[Group], X: Array, time: float, horizon: float) -> None:
        """Keep those pairs of `groups` that are nearer than `horizon`, m, at `X`, the new reference."""
        for group in groups:
            group.keep_near(X, time, horizon)
        self.reference, self.horizon, self.unneeded = X, horizon, 0
        self.groups = [group for group in groups if len(group)]

    def __len__(self) -> int:
        return sum(map(len, self.groups))


class Candidates:
    """All pairs nearer than a horizon at a reference configuration, with their exact distances there.

    There are three lists, each with a reference. One is of bodies and pieces. Two bodies are compared with each other
    again only where the arm has bent: however far two of them have moved, they are as far apart as they were if they
    moved together. Pairs in parts of the arm that were found to bend are in a list of their own, so that the pairs of
    all other parts, which are called rigid here, keep their reference.
    """

    def __init__(
        self,
        bodies: Bodies,
        pieces: ObstaclePieces,
        kernels: ShapeKernels,
        X: Array,
        time: float,
        horizon: float,
        self_horizon: float | None,
    ) -> None:
        self._bodies, self._pieces, self._kernels = bodies, pieces, kernels
        self._has_self = self_horizon is not None
        X = X.copy()
        self._to_pieces, self._rigid, self._bending = _PairList(X), _PairList(X), _PairList(X)
        self._seen, self._bent = X, 0.0
        self._is_bending = np.zeros(0, dtype=bool)
        self._bending_points = np.zeros(0, dtype=np.int64)
        if self_horizon is None:
            self._parts = Parts(bodies, X, 0.0)
        else:
            self.renew_bodies(X, time, self_horizon)
        self.renew_pieces(X, time, horizon)

    @property
    def groups(self) -> list[Group]:
        """The pairs of each shape; no group is empty."""
        return self._to_pieces.groups + self._rigid.groups + self._bending.groups

    def renew_pieces(self, X: Array, time: float, horizon: float) -> None:
        """List the pairs of a body and a piece that are nearer than `horizon`, m, at `X`, the new reference."""
        self.time = time
        pieces, bodies = self._pieces, self._bodies
        groups = []
        if len(pieces):
            body, piece = _near_pieces(X, bodies, self._parts, pieces, time, horizon)
            for shape in np.unique(pieces.shape):
                chosen = pieces.shape[piece] == shape
                groups.append(Group(str(shape), body[chosen], piece[chosen], bodies, pieces, self._kernels))
        self._to_pieces.renew(groups, X.copy(), time, horizon if groups else np.inf)

    def renew_bodies(self, X: Array, time: float, horizon: float) -> None:
        """List the pairs of two bodies that are nearer than `horizon`, m, at `X`, the new reference."""
        self._seen, self._bent = X.copy(), 0.0
        # Twice as far, so that parts may come somewhat nearer before their bodies have to be listed.
        self._parts = Parts(self._bodies, X, 2.0 * horizon)
        self._is_bending = np.zeros(len(self._parts.near), dtype=bool)
        self._bending.renew([], self._seen, time, np.inf)
        pairs = _near_bodies(X, self._bodies, np.arange(len(self._bodies.points)), horizon)
        self._rigid.renew([self._self_group(*pairs)], self._seen, time, horizon)

    def follow_bodies(self, X: Array, time: float, reach: float, travel: float, horizon: float) -> None:
        """List all pairs of bodies that may come nearer than `reach`, m, while no point moves further than `travel`.

        As a rule the arm has moved far but has hardly bent, and then only in a few of its parts, so that this costs
        much less than :meth:`renew_bodies`. Pairs are listed up to `horizon`, m, where they are listed anew.
        """
        parts, rigid, bending = self._parts, self._rigid, self._bending
        change = parts.distance_changes(X - rigid.reference)
        parts.update_beyond(X)
        slack = rigid.horizon - reach - 2.0 * travel
        # At half of the slack: parts that bend further would soon have to be compared again.
        now_bending = ~self._is_bending & (change > 0.5 * slack)
        is_bending = self._is_bending | now_bending
        if (
            slack <= 0.0
            or parts.beyond - 2.0 * travel < reach
            or np.count_nonzero(is_bending) > _MOST_BENDING * len(is_bending)
        ):
            self.renew_bodies(X, time, horizon)
            return
        self._seen, self._is_bending = X.copy(), is_bending
        self._bent = float(change[~is_bending].max(initial=0.0))
        if now_bending.any():
            for group in rigid.groups:
                group.select(~parts.among(now_bending, group.body, group.other))
            rigid.groups = [group for group in rigid.groups if len(group)]
        elif bending.horizon - 2.0 * (self._bending_displacement(X) + travel) >= reach:
            return
        bodies, self._bending_points = parts.inside(np.unique(parts.near[is_bending]))
        first, second = _near_bodies(X, self._bodies, bodies, horizon)
        # Pairs of two of these parts that do not bend relative to each other are in the list of rigid parts.
        own = parts.among(is_bending, first, second)
        pairs = self._self_group(first[own], second[own], is_bending=True)
        bending.renew([pairs], self._seen, time, horizon)

    def _self_group(self, first: Index, second: Index, *, is_bending: bool = False) -> Group:
        arm = (self._bodies, self._pieces, self._kernels)
        return Group("segment", first, second, *arm, is_bending=is_bending)

    def _bending_displacement(self, *states: Array) -> float:
        """Return how far a point of a bending part is from its reference, at most, m."""
        if not self._is_bending.any():
            return 0.0
        points = self._bending_points
        reference = self._bending.reference.take(points, axis=0)
        return float(_moved(tuple(X.take(points, axis=0) for X in states), reference).max())

    def count_unneeded(self, group: Group, count: int) -> None:
        """Count `count` pairs of `group` that were evaluated although they are far."""
        own = self._bending if group.is_bending else self._rigid
        (own if group.is_self else self._to_pieces).unneeded += count

    def refresh_where_due(self, X: Array, time: float) -> None:
        """Move the references of those lists whose unneeded evaluations have cost as much as that does."""
        lists = self._to_pieces, self._bending, self._rigid
        costs = [len(pairs) for pairs in lists]
        # For the last one, how the arm has bent has to be computed as well.
        costs[-1] += len(self._bodies)
        due = tuple(pairs.unneeded > cost for pairs, cost in zip(lists, costs, strict=True))
        if any(due):
            self.refresh(X, time, due)

    def refresh(self, X: Array, time: float, which: tuple[bool, ...] = (True, True, True)) -> None:
        """Move references to `X` without a broad phase: the horizons shrink by the displacement of the bodies.

        `which` lists are moved: that of pieces, that of bending parts, that of rigid parts.
        """
        X = X.copy()
        if which[0]:
            far = self._beyond_pieces(self.motion(X, time))
            self.time = time
            self._to_pieces.renew(self._to_pieces.groups, X, time, far)
        if which[1]:
            far = self._bending.horizon - 2.0 * self._bending_displacement(X)
            self._bending.renew(self._bending.groups, X, time, far)
        if which[2] and self._has_self:
            change = self._parts.distance_changes(X - self._rigid.reference)
            far = self._rigid.horizon - float(change[~self._is_bending].max(initial=0.0))
            self._parts.update_beyond(X)
            self._seen, self._bent = X, 0.0
            self._rigid.renew(self._rigid.groups, X, time, far)

    def motion(
        self, X: Array, time: float, end: Array | None = None, end_time: float | None = None
    ) -> Displacements:
        """Return the displacements from the references; with an `end`, the greatest on the straight path there."""
        states = (X,) if end is None else (X, end)
        elapsed = abs(time - self.time)
        if end_time is not None:
            elapsed = max(elapsed, abs(end_time - self.time))
        moved = _moved(states, self._to_pieces.reference)
        greatest = float(moved.max(initial=0.0))
        to_pieces = Displacement(states, self._to_pieces.reference, moved, greatest)
        if not self._has_self:
            return Displacements(to_pieces, to_pieces, to_pieces, elapsed)
        if self._seen is not self._to_pieces.reference:
            moved = _moved(states, self._seen)
            greatest = float(moved.max(initial=0.0))
        rigid = Displacement(states, self._rigid.reference, moved, self._bent + 2.0 * greatest)
        bending = Displacement(
            states, self._bending.reference, moved, 2.0 * self._bending_displacement(*states)
        )
        return Displacements(to_pieces, rigid, bending, elapsed)

    def beyond(self, motion: Displacements) -> tuple[float, float]:
        """Return lower bounds, m, of the distances of the pairs not listed: to pieces, and between bodies."""
        if not self._has_self:
            return self._beyond_pieces(motion), np.inf
        # Pairs in near parts came nearer by no more than the arm bent there; pairs in other parts are bounded by those.
        since = motion.rigid.greatest - self._bent
        far = min(self._rigid.horizon - self._bent, self._parts.beyond) - since
        return self._beyond_pieces(motion), min(far, self._bending.horizon - motion.bending.greatest)

    def _beyond_pieces(self, motion: Displacements) -> float:
        return self._to_pieces.horizon - motion.to_pieces.greatest - self._pieces.fastest * motion.elapsed


def _moved(states: tuple[Array, ...], reference: Array) -> Array:
    """Return how far each point (P,) is from its reference (P, 3), at most, m, in one or more states (P, 3)."""
    shift = states[0] - reference
    square = np.einsum("ic,ic->i", shift, shift)
    for state in states[1:]:
        np.subtract(state, reference, out=shift)
        np.maximum(square, np.einsum("ic,ic->i", shift, shift), out=square)
    return np.asarray(np.sqrt(square))


def _near_pieces(
    X: Array, bodies: Bodies, parts: Parts, pieces: ObstaclePieces, time: float, horizon: float
) -> tuple[Index, Index]:
    """Return the pairs of a body and a piece that the plane between body and bounding sphere does not separate."""
    centers = pieces.center + time * pieces.velocity
    body, piece = parts.facing(X, centers, pieces.radius + horizon)
    if np.isinf(horizon):
        return body, piece
    ends = X[bodies.points[body]]
    apart = 0.5 * (ends[:, 0] + ends[:, 1]) - centers[piece]
    distance = np.sqrt(np.einsum("kc,kc->k", apart, apart))
    span = 0.5 * np.abs(np.einsum("kc,kc->k", apart, ends[:, 1] - ends[:, 0]))
    # Multiplied by the distance of the centers, which may be zero.
    near = distance * (distance - bodies.radius[body] - pieces.radius[piece] - horizon) <= span
    return body[near], piece[near]


def _near_bodies(X: Array, bodies: Bodies, among: Index, horizon: float) -> tuple[Index, Index]:
    """Return pairs of some bodies that are not neighbours and that the plane between them does not separate."""
    ends = X[bodies.points[among]]
    middle, half = ends.mean(axis=1), 0.5 * (ends[:, 1] - ends[:, 0])
    joints, radius = bodies.joints[among], bodies.radius[among]
    longest = float(np.max(np.linalg.norm(half, axis=1) + radius))
    pairs = cKDTree(middle).query_pairs(2.0 * longest + horizon, output_type="ndarray").astype(np.int64)
    first, second = pairs[:, 0], pairs[:, 1]
    if not np.isinf(horizon):
        apart = middle[first] - middle[second]
        distance = np.sqrt(np.einsum("kc,kc->k", apart, apart))
        span = np.abs(np.einsum("kc,kc->k", apart, half[first]))
        span += np.abs(np.einsum("kc,kc->k", apart, half[second]))
        near = distance * (distance - radius[first] - radius[second] - horizon) <= span
        first, second = first[near], second[near]
    a, b, c, d = joints[first, 0], joints[first, 1], joints[second, 0], joints[second, 1]
    strangers = (a != c) & (a != d) & (b != c) & (b != d)
    return among[first[strangers]], among[second[strangers]]
