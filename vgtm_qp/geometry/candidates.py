"""Lists of pairs that may come near, which hold until bodies moved too far or the arm bent too much."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.geometry.bodies import Bodies
from vgtm_qp.geometry.formulas import FAR, FURTHEST
from vgtm_qp.geometry.groups import Displacement, Group, Scene
from vgtm_qp.geometry.hulls import groups_of
from vgtm_qp.geometry.parts import BODIES, Parts
from vgtm_qp.geometry.shapes import GeometryError

Motion = tuple[Displacement, Displacement, Displacement]
"""Displacements from the references of the three lists."""

_TO_PIECES, _RIGID, _BENDING = range(3)

_LISTED_ONCE = 40_000
"""Greatest number of bodies, times that of bodies and pieces, of a scene whose pairs are all listed.

Ten times that of ``watch``: C lists pairs again at less cost.
"""

_MOST_BENDING = 0.5
"""Share of bending pairs of parts above which all bodies are compared again."""


class _PairList:
    """Pairs that share a reference: the positions (P, 3), m, and the time, s, at which they were compared.

    Pairs of the same kind that are not listed were at least the horizon, m, apart at the reference.
    `unneeded` counts the pairs that have been evaluated since and were far.
    """

    def __init__(self, reference: Array, time: float) -> None:
        self.groups: list[Group] = []
        self.renew([], reference, time, np.inf)

    def renew(self, groups: list[Group], X: Array, time: float, horizon: float) -> None:
        """Keep those pairs of `groups` that are nearer than `horizon`, m, at `X`, the new reference."""
        for group in groups:
            group.keep_near(X, time, horizon)
        self.reference, self.time, self.horizon, self.unneeded = X, time, horizon, 0
        self.groups = [group for group in groups if len(group)]

    def __len__(self) -> int:
        return sum(map(len, self.groups))


class Candidates:
    """All pairs nearer than a horizon at a reference configuration, with their exact distances there.

    There are three lists, each with a reference: pairs of a body and a piece, pairs of bodies in rigid parts
    of the arm, and pairs of bodies in bending parts. Bodies that moved together keep their distance, however
    far they moved, and are compared again only if the arm has bent. Pairs nearer than `influence` to
    obstacles, or than `self_influence` to other bodies, m, are listed by default.
    """

    def __init__(self, scene: Scene, influence: float, self_influence: float) -> None:
        self._scene, self._influence, self._self_influence = scene, influence, self_influence
        self._lists: tuple[_PairList, ...] = ()

    @property
    def groups(self) -> list[Group]:
        """The pairs of each shape; no group is empty."""
        return [group for pairs in self._lists for group in pairs.groups]

    def forget_pieces(self) -> None:
        """Forget the pairs with pieces, because the pieces are others now; pairs of bodies are kept."""
        if self._lists:
            pairs = self._lists[_TO_PIECES]
            pairs.renew([], pairs.reference, pairs.time, -np.inf)

    def cover(
        self,
        X: Array,
        time: float,
        reach: float,
        self_reach: float,
        end: Array | None = None,
        end_time: float | None = None,
    ) -> Motion:
        """List every pair nearer than the reaches, and return the displacements from the references.

        With an `end`, list and displacements hold on the whole straight path from `X` to there.

        Raises
        ------
        GeometryError
            A position is not finite.
        """
        far = far_self = np.nan
        if self._lists:
            motion = self.motion(X, time, end, end_time)
            far, far_self = self.beyond(motion)
            if far >= reach and far_self >= self_reach:
                return motion
        # NaN fails the comparisons above and comes here.
        if not all(np.abs(at).max(initial=0.0) < FURTHEST for at in (X, X if end is None else end)):
            raise GeometryError("node positions must be finite numbers")
        X = X.copy()
        bodies, pieces = self._scene.bodies, self._scene.pieces
        travel = 0.0 if end is None else float(np.sqrt(((end - X) ** 2).sum(axis=1).max(initial=0.0)))
        drift = 0.0 if end_time is None else pieces.fastest * abs(end_time - time)
        horizon = max(reach, self._influence) + self._influence + travel + drift
        self_horizon = max(self_reach, self._self_influence) + self._influence + 2.0 * travel
        if len(bodies) * (len(bodies) + len(pieces)) <= _LISTED_ONCE:
            # A list of all pairs never needs another broad phase, which would cost more than its far pairs.
            horizon = self_horizon = FAR
        if not self._lists:
            self._lists = _PairList(X, time), _PairList(X, time), _PairList(X, time)
            if self._scene.has_self:
                self.renew_bodies(X, time, self_horizon)
        elif not far_self >= self_reach:
            self._follow_bodies(X, time, self_reach, travel, self_horizon)
        if not far >= reach:
            self._renew_pieces(X, time, horizon)
        return self.motion(X, time, end, end_time)

    def _renew_pieces(self, X: Array, time: float, horizon: float) -> None:
        """List the pairs of a body and a piece that are nearer than `horizon`, m, at `X`, the new reference."""
        groups = _groups_with_pieces(X, self._scene, time, horizon)
        self._lists[_TO_PIECES].renew(groups, X, time, horizon if len(self._scene.pieces) else np.inf)

    def renew_bodies(self, X: Array, time: float, horizon: float) -> None:
        """List the pairs of two bodies that are nearer than `horizon`, m, at `X`, the new reference."""
        bodies = self._scene.bodies
        self._seen, self._bent = X, 0.0
        # Twice the horizon, so that parts may come nearer before their bodies must be listed.
        self._parts = Parts(bodies, X, 2.0 * horizon)
        self._is_bending = np.zeros(len(self._parts.near), dtype=bool)
        self._bending_points = np.zeros(0, dtype=np.int64)
        self._lists[_BENDING].renew([], X, time, np.inf)
        pairs = _near_bodies(X, bodies, np.arange(len(bodies)), horizon)
        self._lists[_RIGID].renew(groups_of(self._scene, "segment", *pairs, place=_RIGID), X, time, horizon)

    def _follow_bodies(self, X: Array, time: float, reach: float, travel: float, horizon: float) -> None:
        """List all pairs of bodies that may come nearer than `reach`, m, while no point moves further than `travel`.

        Usually the arm has moved far but bent only in a few parts, so that this costs much less than
        :meth:`renew_bodies`. Pairs that are listed anew are listed up to `horizon`, m.
        """
        parts, (_, rigid, bending) = self._parts, self._lists
        change = parts.distance_changes(X - rigid.reference)
        parts.update_beyond(X)
        slack = rigid.horizon - reach - 2.0 * travel
        # Half of the slack: parts that bend further would soon have to be compared again.
        now_bending = ~self._is_bending & (change > 0.5 * slack)
        is_bending = self._is_bending | now_bending
        if (
            slack <= 0.0
            or parts.beyond - 2.0 * travel < reach
            or np.count_nonzero(is_bending) > _MOST_BENDING * len(is_bending)
        ):
            self.renew_bodies(X, time, horizon)
            return
        self._seen, self._is_bending = X, is_bending
        self._bent = float(change[~is_bending].max(initial=0.0))
        if now_bending.any():
            for group in rigid.groups:
                group.select(~parts.among(now_bending, group.body, group.other))
            rigid.groups = [group for group in rigid.groups if len(group)]
        elif bending.horizon - 2.0 * (self._bending_displacement(X) + travel) >= reach:
            return
        bodies, self._bending_points = parts.inside(np.unique(parts.near[is_bending]))
        first, second = _near_bodies(X, self._scene.bodies, bodies, horizon)
        # Pairs of two of these parts that do not bend relative to each other are in the list of rigid parts.
        own = parts.among(is_bending, first, second)
        pairs = groups_of(self._scene, "segment", first[own], second[own], place=_BENDING)
        bending.renew(pairs, X, time, horizon)

    def _bending_displacement(self, *states: Array) -> float:
        """Return the greatest distance of a point of a bending part from its reference, m."""
        if not self._is_bending.any():
            return 0.0
        points = self._bending_points
        reference = self._lists[_BENDING].reference.take(points, axis=0)
        return float(_moved(tuple(X.take(points, axis=0) for X in states), reference).max())

    def count_unneeded(self, group: Group, count: int) -> None:
        """Add `count` pairs of `group` that were evaluated although they are far."""
        self._lists[group.place].unneeded += count

    def refresh_where_due(self, X: Array, time: float) -> None:
        """Move the references of lists to `X` once their unneeded evaluations have cost as much as moving does.

        There is no broad phase: the horizons shrink by the displacement of the bodies.
        """
        for place, pairs in enumerate(self._lists):
            # For rigid parts the bending of the arm has to be computed too.
            if pairs.unneeded > len(pairs) + (len(self._scene.bodies) if place == _RIGID else 0):
                self._refresh(place, X.copy(), time)

    def _refresh(self, place: int, X: Array, time: float) -> None:
        pairs = self._lists[place]
        if place == _RIGID:
            change = self._parts.distance_changes(X - pairs.reference)
            self._parts.update_beyond(X)
            self._seen, self._bent, change_since = X, 0.0, float(change[~self._is_bending].max(initial=0.0))
        else:
            change_since = self.motion(X, time)[place].greatest
        pairs.renew(pairs.groups, X, time, pairs.horizon - change_since)

    def motion(
        self, X: Array, time: float, end: Array | None = None, end_time: float | None = None
    ) -> Motion:
        """Return the displacements from the references; with an `end`, the greatest on the straight path there."""
        states = (X,) if end is None else (X, end)
        to_pieces, rigid, bending = self._lists
        elapsed = max(abs(at - to_pieces.time) for at in (time, time if end_time is None else end_time))
        moved = _moved(states, to_pieces.reference)
        greatest = float(moved.max(initial=0.0))
        drift = self._scene.pieces.fastest * elapsed
        first = Displacement(states, to_pieces.reference, moved, greatest + drift, elapsed)
        if not self._scene.has_self:
            return first, first, first
        if self._seen is not to_pieces.reference:
            moved = _moved(states, self._seen)
            greatest = float(moved.max(initial=0.0))
        bent = 2.0 * self._bending_displacement(*states)
        return (
            first,
            Displacement(states, rigid.reference, moved, self._bent + 2.0 * greatest, 0.0),
            Displacement(states, bending.reference, moved, bent, 0.0),
        )

    def beyond(self, motion: Motion) -> tuple[float, float]:
        """Return lower bounds, m, of the distances of the pairs not listed: to pieces, and between bodies."""
        to_pieces, rigid, bending = self._lists
        far = to_pieces.horizon - motion[_TO_PIECES].greatest
        if not self._scene.has_self:
            return far, np.inf
        # Pairs in near parts came nearer by no more than these bent; all other pairs are bounded by their
        # parts.
        since = motion[_RIGID].greatest - self._bent
        near = min(rigid.horizon - self._bent - since, bending.horizon - motion[_BENDING].greatest)
        return far, min(near, self._parts.beyond - since)


def _groups_with_pieces(X: Array, scene: Scene, time: float, horizon: float) -> list[Group]:
    """Return groups, one a shape, of the pairs of a body and a piece that may be nearer than `horizon`, m."""
    pieces = scene.pieces
    if not len(pieces):
        return []
    body, piece = _near_pieces(X, scene, time, horizon)
    kinds = pieces.shape[piece]
    shapes = np.unique(pieces.shape).tolist()
    parts = [(shape, body[kinds == shape], piece[kinds == shape]) for shape in shapes]
    return [group for part in parts for group in groups_of(scene, *part)]


def _moved(states: tuple[Array, ...], reference: Array) -> Array:
    """Return (P,) the greatest distance, m, of each point from its reference in one or more states (P, 3)."""
    shift = states[0] - reference
    square = np.einsum("ic,ic->i", shift, shift)
    for state in states[1:]:
        np.subtract(state, reference, out=shift)
        np.maximum(square, np.einsum("ic,ic->i", shift, shift), out=square)
    return np.asarray(np.sqrt(square))


def _near_pieces(X: Array, scene: Scene, time: float, horizon: float) -> tuple[Index, Index]:
    """Return the pairs of a body and a piece that the plane between body and bounding sphere does not separate."""
    pieces, radius = scene.pieces, scene.bodies.radius
    centers = pieces.center + time * pieces.velocity
    middle, half, radius, longest = _axes(X, scene.bodies.points, radius)
    tree = cKDTree(middle, leafsize=BODIES)
    # In the tree's order, so that pairs at equal distances keep that order.
    found = tree.query_ball_point(centers, pieces.radius + longest + horizon, return_sorted=False)
    piece = np.repeat(np.arange(len(pieces)), [len(bodies) for bodies in found])
    body = np.concatenate([np.zeros(0), *found]).astype(np.int64)
    apart = middle[body] - centers[piece]
    span = np.abs(np.einsum("kc,kc->k", apart, half[body]))
    near = _inseparable(apart, span, radius[body] + pieces.radius[piece] + horizon)
    return body[near], piece[near]


def _near_bodies(X: Array, bodies: Bodies, among: Index, horizon: float) -> tuple[Index, Index]:
    """Return pairs of some bodies that are not neighbours and that the plane between them does not separate."""
    radius = bodies.radius[among]
    middle, half, radius, longest = _axes(X, bodies.points[among], radius)
    first, second = (
        cKDTree(middle).query_pairs(2.0 * longest + horizon, output_type="ndarray").astype(np.int64).T
    )
    apart = middle[first] - middle[second]
    span = np.abs(np.einsum("kc,kc->k", apart, half[first])) + np.abs(
        np.einsum("kc,kc->k", apart, half[second])
    )
    near = _inseparable(apart, span, radius[first] + radius[second] + horizon)
    first, second = among[first[near]], among[second[near]]
    strangers = ~bodies.may_touch(first, second)
    return first[strangers], second[strangers]


def _axes(X: Array, points: Index, radius: Array) -> tuple[Array, Array, Array, float]:
    """Return middles (B, 3) and halves (B, 3) of the axes of bodies, radii, and a bound of a body's reach, m.

    Bodies that four points span are balls: their axes are points.
    """
    ends = X[points]
    middle, half = ends.mean(axis=1), 0.5 * (ends[:, 1] - ends[:, 0])
    if points.shape[1] > 2:
        radius = radius + np.linalg.norm(ends - middle[:, None], axis=2).max(axis=1)
        half = np.zeros_like(half)
    return middle, half, radius, float(np.max(np.linalg.norm(half, axis=1) + radius))


def _inseparable(apart: Array, span: Array, room: Array) -> Mask:
    """Return (K,) which pairs may be nearer than `room` (K,), m, from one center line to the other.

    `apart` (K, 3) leads from center to center; `span` (K,) is the reach of both along it, times its length.
    The length may be zero.
    """
    distance = np.sqrt(np.einsum("kc,kc->k", apart, apart))
    return np.asarray(distance * (distance - np.minimum(room, FAR)) <= span)
