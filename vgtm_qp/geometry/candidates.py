"""Which pairs may come near: good until members have moved too far, or the arm has bent too much between two."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vgtm_qp.geometry.groups import Group, Kernels, Members, Motion, Way
from vgtm_qp.geometry.parts import Parts
from vgtm_qp.geometry.shapes import Pieces

Array = NDArray[np.float64]
Index = NDArray[np.int64]


_MOST_SOFT = 0.5
"""Where more of the near parts have bent than that, all members are compared again."""


class _Tier:
    """Pairs that share a reference.

    Attributes
    ----------
    reference : (N, 3)
        Where the points that members end at were when the pairs were compared, m.
    horizon : float
        Pairs of this kind that are not listed were as far apart there, m.
    groups : list of Group
    wasted : int
        How many pairs were evaluated for nothing since.
    """

    def __init__(self, reference: Array, horizon: float = np.inf) -> None:
        self.reference, self.horizon = reference, horizon
        self.groups: list[Group] = []
        self.wasted = 0

    def renew(self, groups: list[Group], X: Array, time: float, horizon: float) -> None:
        """Keep those pairs of `groups` that are nearer than `horizon`, m, at `X`, the new reference."""
        for group in groups:
            group.keep_near(X, time, horizon)
        self.reference, self.horizon, self.wasted = X, horizon, 0
        self.groups = [group for group in groups if len(group)]

    def __len__(self) -> int:
        return sum(map(len, self.groups))


class Candidates:
    """All pairs nearer than a horizon at a reference configuration, with their exact distances there.

    There are three references. One is for members and pieces. Two members are compared with each other anew only where
    the arm has bent: however far two of them have moved, they are as far apart as they were if they moved together.
    Pairs in soft parts of the arm, which were found to bend, have a reference of their own, and all others keep theirs.
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
        self._members, self._pieces, self._kernels = members, pieces, kernels
        self._has_self = self_horizon is not None
        X = X.copy()
        self._to_pieces, self._stiff, self._soft = _Tier(X), _Tier(X), _Tier(X)
        self._seen, self._bent = X, 0.0
        self._is_soft = np.zeros(0, dtype=bool)
        self._soft_nodes = np.zeros(0, dtype=np.int64)
        if self_horizon is None:
            self._parts = Parts(members, X, 0.0)
        else:
            self.renew_members(X, time, self_horizon)
        self.renew_pieces(X, time, horizon)

    @property
    def groups(self) -> list[Group]:
        """The pairs of each shape; no group is empty."""
        return self._to_pieces.groups + self._stiff.groups + self._soft.groups

    def renew_pieces(self, X: Array, time: float, horizon: float) -> None:
        """List the pairs of a member and a piece that are nearer than `horizon`, m, at `X`, the new reference."""
        self.time = time
        pieces, members = self._pieces, self._members
        groups = []
        if len(pieces):
            member, piece = _near_pieces(X, members, self._parts, pieces, time, horizon)
            for shape in np.unique(pieces.shape):
                chosen = pieces.shape[piece] == shape
                groups.append(
                    Group(str(shape), member[chosen], piece[chosen], members, pieces, self._kernels)
                )
        self._to_pieces.renew(groups, X.copy(), time, horizon if groups else np.inf)

    def renew_members(self, X: Array, time: float, horizon: float) -> None:
        """List the pairs of two members that are nearer than `horizon`, m, at `X`, the new reference."""
        self._seen, self._bent = X.copy(), 0.0
        # Twice as far, so that parts may come somewhat nearer before their members have to be listed.
        self._parts = Parts(self._members, X, 2.0 * horizon)
        self._is_soft = np.zeros(len(self._parts.near), dtype=bool)
        self._soft.renew([], self._seen, time, np.inf)
        pairs = _near_members(X, self._members, np.arange(len(self._members.nodes)), horizon)
        self._stiff.renew([self._self_group(*pairs)], self._seen, time, horizon)

    def follow_members(self, X: Array, time: float, reach: float, travel: float, horizon: float) -> None:
        """Make sure that no two members are nearer than `reach`, m, and not listed, while no point goes `travel` far.

        As a rule the arm has moved far but has hardly bent, and then only in a few of its parts, so that this costs a
        small part of what :meth:`renew_members` does. Pairs are listed up to `horizon`, m, where they are at all.
        """
        parts, stiff, soft = self._parts, self._stiff, self._soft
        strain = parts.strain(X - stiff.reference)
        parts.look(X)
        spare = stiff.horizon - reach - 2.0 * travel
        # At half of what is to spare: parts that bend further would soon have to be looked at again.
        bending = ~self._is_soft & (strain > 0.5 * spare)
        is_soft = self._is_soft | bending
        if (
            spare <= 0.0
            or parts.beyond - 2.0 * travel < reach
            or np.count_nonzero(is_soft) > _MOST_SOFT * len(is_soft)
        ):
            self.renew_members(X, time, horizon)
            return
        self._seen, self._is_soft = X.copy(), is_soft
        self._bent = float(strain[~is_soft].max(initial=0.0))
        if bending.any():
            for group in stiff.groups:
                group.select(~parts.among(bending, group.member, group.other))
            stiff.groups = [group for group in stiff.groups if len(group)]
        elif soft.horizon - 2.0 * (self._soft_motion(X) + travel) >= reach:
            return
        members, self._soft_nodes = parts.inside(np.unique(parts.near[is_soft]))
        first, second = _near_members(X, self._members, members, horizon)
        # Of two soft parts that are not soft together, it is the others that know.
        own = parts.among(is_soft, first, second)
        soft.renew([self._self_group(first[own], second[own], is_soft=True)], self._seen, time, horizon)

    def _self_group(self, first: Index, second: Index, *, is_soft: bool = False) -> Group:
        arm = (self._members, self._pieces, self._kernels)
        return Group("segment", first, second, *arm, is_soft=is_soft)

    def _soft_motion(self, *states: Array) -> float:
        """Return how far a point of a soft part is from where it was, at most, m."""
        if not self._is_soft.any():
            return 0.0
        nodes = self._soft_nodes
        reference = self._soft.reference.take(nodes, axis=0)
        return float(_moved(tuple(X.take(nodes, axis=0) for X in states), reference).max())

    def waste(self, group: Group, count: int) -> None:
        """Note that `count` pairs of `group` were evaluated for nothing."""
        self._tier(group).wasted += count

    def _tier(self, group: Group) -> _Tier:
        if not group.is_self:
            return self._to_pieces
        return self._soft if group.is_soft else self._stiff

    def tire(self, X: Array, time: float) -> None:
        """Renew the references of which the pairs evaluated for nothing have cost as much as that does."""
        tiers = self._to_pieces, self._soft, self._stiff
        # How the arm has bent is to be found for the last, which takes time as well.
        costs = [len(tier) for tier in tiers]
        costs[-1] += len(self._members.nodes)
        if any(tier.wasted > cost for tier, cost in zip(tiers, costs, strict=True)):
            self.refresh(X, time, tuple(tier.wasted > cost for tier, cost in zip(tiers, costs, strict=True)))

    def refresh(self, X: Array, time: float, which: tuple[bool, ...] = (True, True, True)) -> None:
        """Move references to `X` without a broad phase: the horizons shrink by what the members moved.

        `which` are that of pieces, of soft parts, and of all others.
        """
        X = X.copy()
        if which[0]:
            far = self._beyond_pieces(self.motion(X, time))
            self.time = time
            self._to_pieces.renew(self._to_pieces.groups, X, time, far)
        if which[1]:
            far = self._soft.horizon - 2.0 * self._soft_motion(X)
            self._soft.renew(self._soft.groups, X, time, far)
        if which[2] and self._has_self:
            strain = self._parts.strain(X - self._stiff.reference)
            far = self._stiff.horizon - float(strain[~self._is_soft].max(initial=0.0))
            self._parts.look(X)
            self._seen, self._bent = X, 0.0
            self._stiff.renew(self._stiff.groups, X, time, far)

    def motion(
        self, X: Array, time: float, end: Array | None = None, end_time: float | None = None
    ) -> Motion:
        """Return the motion since the references, the greatest on the straight way to `end` if given."""
        states = (X,) if end is None else (X, end)
        elapsed = abs(time - self.time)
        if end_time is not None:
            elapsed = max(elapsed, abs(end_time - self.time))
        moved = _moved(states, self._to_pieces.reference)
        greatest = float(moved.max(initial=0.0))
        to_pieces = Way(states, self._to_pieces.reference, moved, greatest)
        if not self._has_self:
            return Motion(to_pieces, to_pieces, to_pieces, elapsed)
        if self._seen is not self._to_pieces.reference:
            moved = _moved(states, self._seen)
            greatest = float(moved.max(initial=0.0))
        stiff = Way(states, self._stiff.reference, moved, self._bent + 2.0 * greatest)
        soft = Way(states, self._soft.reference, moved, 2.0 * self._soft_motion(*states))
        return Motion(to_pieces, stiff, soft, elapsed)

    def beyond(self, motion: Motion) -> tuple[float, float]:
        """Return lower bounds of the distances of the pairs not listed: to pieces, and between members."""
        if not self._has_self:
            return self._beyond_pieces(motion), np.inf
        # Those of near parts came nearer by no more than these bent; those of other parts were as far apart as these.
        since = motion.stiff.greatest - self._bent
        far = min(self._stiff.horizon - self._bent, self._parts.beyond) - since
        return self._beyond_pieces(motion), min(far, self._soft.horizon - motion.soft.greatest)

    def _beyond_pieces(self, motion: Motion) -> float:
        return self._to_pieces.horizon - motion.to_pieces.greatest - self._pieces.fastest * motion.elapsed


def _moved(states: tuple[Array, ...], reference: Array) -> Array:
    """Return how far each point (N,) is from where it was, at most, m, in one or more states (N, 3)."""
    shift = states[0] - reference
    square = np.einsum("ic,ic->i", shift, shift)
    for state in states[1:]:
        np.subtract(state, reference, out=shift)
        np.maximum(square, np.einsum("ic,ic->i", shift, shift), out=square)
    return np.asarray(np.sqrt(square))


def _near_pieces(
    X: Array, members: Members, parts: Parts, pieces: Pieces, time: float, horizon: float
) -> tuple[Index, Index]:
    """Return pairs that the plane between member and bounding sphere does not keep apart."""
    centers = pieces.center + time * pieces.velocity
    member, piece = parts.facing(X, centers, pieces.radius + horizon)
    if np.isinf(horizon):
        return member, piece
    ends = X[members.nodes[member]]
    way = 0.5 * (ends[:, 0] + ends[:, 1]) - centers[piece]
    apart = np.sqrt(np.einsum("kc,kc->k", way, way))
    span = 0.5 * np.abs(np.einsum("kc,kc->k", way, ends[:, 1] - ends[:, 0]))
    # Multiplied by the distance of the centers, which may be zero.
    near = apart * (apart - members.radius[member] - pieces.radius[piece] - horizon) <= span
    return member[near], piece[near]


def _near_members(X: Array, members: Members, among: Index, horizon: float) -> tuple[Index, Index]:
    """Return pairs of some members without a common node that the plane between them does not keep apart."""
    ends = X[members.nodes[among]]
    middle, half = ends.mean(axis=1), 0.5 * (ends[:, 1] - ends[:, 0])
    nodes, radius = members.joined[among], members.radius[among]
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
    return among[first[strangers]], among[second[strangers]]
