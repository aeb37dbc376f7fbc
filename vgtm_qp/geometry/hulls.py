"""Pairs of which at least one body is a convex hull: contacts, proven by planes, and proofs over a motion.

A separating plane proves a distance: it is at least the gap between the supporting planes of both bodies along any
normal. So a contact's distance here is that gap, along the normal that C finds, or that FCL claims where there is no C.
Where FCL's answer and the gap disagree, the normal is computed from convex combinations of points of both bodies
instead.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from scipy.optimize import nnls

from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.geometry.bodies import Bodies, Hull
from vgtm_qp.geometry.exact import (
    NORMAL_FROM,
    PROOF,
    SECOND_CONTACT,
    WIDTH,
    distance_function,
    support_function,
    turning_function,
)
from vgtm_qp.geometry.formulas import FAR, PARALLEL
from vgtm_qp.geometry.groups import Group, Scene

_POINTS = 12
"""Numbers of the four points that span a body."""
_AT_ONCE = 200_000
"""Number of vertices of pairs that are in the memory at a time."""
_MOST = 60
"""Greatest number of points of each body in the convex combinations of :func:`_nearest`."""
_EXACT = 1e-12
"""Gain of a further point, over the unit of length and the distance, below which :func:`_nearest` ends."""
_OVERLAP = 1e-9
"""Distance, over the unit of length, up to which surfaces count as overlapping."""

Support = Callable[[Array], Array]
"""From a unit normal (3,) to the furthest point along it (3,), m."""


def groups_of(scene: Scene, shape: str, body: Index, other: Index, *, place: int = 0) -> list[Group]:
    """Return the pairs of bodies (C,) and others (C,) of one shape as groups; none is empty."""
    return [group for group, _ in groups_by_kind(scene, shape, body, other, place=place)]


def groups_by_kind(
    scene: Scene, shape: str, body: Index, other: Index, *, place: int = 0
) -> Iterator[tuple[Group, Mask]]:
    """Yield the groups of :func:`groups_of`, and which of the pairs (C,) each has."""
    with_hull = scene.bodies.is_hull[body]
    if shape == "segment":
        with_hull = with_hull | scene.bodies.is_hull[other]
    kinds: list[tuple[type[Group], Mask]] = [(Group, ~with_hull), (HullGroup, with_hull)]
    for kind, own in kinds:
        if own.any():
            yield kind(scene, shape, body[own], other[own], place=place), own


class HullGroup(Group):
    """See ``Group``. A pair is the points of its body (12), the piece or the other's points (15), radius and row."""

    own = _POINTS
    at_once = 2

    def at(self, X: Array, time: float, rows: Index) -> Array:
        """Return some pairs (k, 29): points of the body, piece or points of the other, radius, and row."""
        numbers = self.numbers.take(rows, axis=0)
        pairs = np.zeros((len(rows), _POINTS + WIDTH + 2))
        points = X.take(numbers[:, :-4], axis=0).reshape(len(rows), -1)
        pairs[:, :_POINTS], pairs[:, -2], pairs[:, -1] = points[:, :_POINTS], self.radius[rows], rows
        if self.is_self:
            pairs[:, _POINTS : 2 * _POINTS] = points[:, _POINTS:]
        else:
            pairs[:, _POINTS:-2] = self.scene.pieces.at(time).take(numbers[:, -3], axis=0)
        return pairs

    def evaluate(self, pairs: Array) -> Array:
        """Return up to three contacts (k, 3, 2 E + 5) of each of `pairs`; the last number is 1 where FCL supplied them.

        Further contacts are vertices of a hull that are almost as near; their distances are ``FAR`` without any.
        """
        return self._in_parts(self._contacts, pairs)

    def _contacts(self, pairs: Array) -> Array:
        sides = _Sides(self, pairs)
        x, y, normal, proven = self._witnesses(pairs, sides)
        low, high = sides.heights(normal)
        gap = low.min(axis=1) - high
        found, span = np.zeros((len(pairs), self.scene.each, self.scene.size)), self.scene.span
        found[:, 0, 0], found[:, 1:, 0] = gap, FAR
        found[:, :, -4:-1], found[:, :, -1] = normal[:, None], proven[:, None]
        found[:, 0, 1 : 1 + span] = sides.weights_of(x)
        if self.is_self:
            found[:, :, 1 + span : -4] = -sides.weights_of_other(y)[:, None]
        self._further(sides, low - high[:, None], x, found)
        found[:, :, 0] -= np.where(found[:, :, 0] < FAR, pairs[:, -2, None], 0.0)
        return found

    def distances(self, X: Array, time: float, rows: Index, enough: float = np.inf) -> Array:
        """Return surface distances (k,) of some pairs, m; below zero where they overlap.

        The least one is exact if it is below `enough`. Others are those along FCL's normals, and may be too small by as
        much as a proven answer may be wrong, see ``PROOF``.
        """
        return self._in_parts(partial(self._distances_of, enough), self.at(X, time, rows))

    def _distances_of(self, enough: float, pairs: Array) -> Array:
        sides = _Sides(self, pairs)
        _, _, normal, proven = self._witnesses(pairs, sides)
        found = sides.gaps(normal) - pairs[:, -2]
        nearest = found <= min(found.min(initial=np.inf) + 2.0 * PROOF * self.scene.unit, enough)
        for k in np.flatnonzero(proven & nearest).tolist():
            normal[k] = self._computed(sides, k, normal[k])[2]
        return np.asarray(sides.gaps(normal) - pairs[:, -2])

    def contacts(self, X: Array, time: float, rows: Index, found: Array, by_fcl: bool) -> tuple[Index, Array]:  # noqa: ARG002
        """See ``Group.contacts``: they are FCL's already where these are proven."""
        numbers = self.numbers.take(rows, axis=0)
        numbers[:, -1] = found[:, -1] > 0.0
        return numbers, found

    def sweep(self, start: Array, end: Array) -> Array:
        """Return bounds (k, 3) as ``exact.sweep_function``, by a plane that turns from one contact to the next."""
        return self._in_parts(self._bounds, start, end)

    def _bounds(self, start: Array, end: Array) -> Array:
        sides = [_Sides(self, pairs) for pairs in (start, end)]
        normals = [self._witnesses(*both)[2] for both in zip((start, end), sides, strict=True)]
        (low, high), (low_after, high_after) = (
            side.heights(normal) for side, normal in zip(sides, normals, strict=True)
        )
        gaps = np.minimum(low - high[:, None], low_after - high_after[:, None])
        turn, moved = normals[1] - normals[0], sides[1].vertices - sides[0].vertices
        bend, travel = np.einsum("kvc,kc->kv", moved, turn), np.linalg.norm(moved, axis=2).max(axis=1)
        if self.is_self:
            others = sides[1].others - sides[0].others
            bend += -np.einsum("kvc,kc->kv", others, turn).min(axis=1)[:, None]
            travel += np.linalg.norm(others, axis=2).max(axis=1)
        square = np.einsum("kc,kc->k", turn, turn)
        known = np.stack([gaps, bend, np.broadcast_to(square[:, None], gaps.shape)], axis=2).reshape(-1, 3)
        turning = self.scene.batch(turning_function, "")(known).reshape(gaps.shape).min(axis=1)
        distances = low.min(axis=1) - high, low_after.min(axis=1) - high_after
        bound = np.maximum(turning, 0.5 * (distances[0] + distances[1] - travel))
        return np.stack([bound, *distances], axis=1) - start[:, -2, None]

    def _deepest(self, rows: Index) -> Array:
        return np.full(len(rows), -np.inf)

    def _in_parts(self, function: Callable[..., Array], *pairs: Array) -> Array:
        """Return the rows of a `function` of pairs; of many vertices by parts, pairs with as many of them together."""
        rows = pairs[0][:, -1].astype(np.int64)
        counts = self.scene.bodies.counts[self.body[rows]]
        if self.is_self:
            counts = np.maximum(counts, self.scene.bodies.counts[self.other[rows]])
        if len(rows) * int(counts.max(initial=0)) <= _AT_ONCE:
            return function(*pairs)
        order = np.argsort(counts, kind="stable")
        found, first = [], 0
        while first < len(order):
            fits = np.arange(1, len(order) - first + 1) * counts[order[first:]] <= _AT_ONCE
            last = first + max(1, int(fits.argmin()) if not fits.all() else len(fits))
            found.append(function(*(own[order[first:last]] for own in pairs)))
            first = last
        return np.concatenate(found)[np.argsort(order)]

    def _witnesses(self, pairs: Array, sides: _Sides) -> tuple[Array, Array, Array, Mask]:
        """Return nearest points (k, 3) of body and other, m, normals (k, 3), and which of them FCL supplied (k,).

        C finds them, or FCL where there is no C.
        """
        rows, fcl, unit = pairs[:, -1].astype(np.int64), self.scene.of_hulls, self.scene.unit
        proven = known = np.zeros(len(pairs), dtype=bool)
        x, y, normal = np.zeros((3, len(pairs), 3))
        if (search := self.scene.search(self.shape)) is not None:
            x, y, normal, known = search(self.body[rows], self.other[rows], pairs)
        elif fcl is not None:
            own = pairs[:, :_POINTS].reshape(-1, 4, 3)
            other = pairs[:, _POINTS:-2]
            other = other[:, :_POINTS].reshape(-1, 4, 3) if self.is_self else other
            answers = fcl.answers_of_hulls(
                self.body[rows].tolist(), own, self.other[rows].tolist(), other, is_self=self.is_self
            )
            x, y = answers[:, 1:4], answers[:, 4:]
            apart = np.linalg.norm(x - y, axis=1)
            with np.errstate(invalid="ignore", divide="ignore"):
                normal = (x - y) / apart[:, None]
                gap = sides.gaps(normal)
                # NaN fails the comparisons.
                known = proven = (np.abs(answers[:, 0] - gap) + np.abs(apart - gap) <= PROOF * unit) & (
                    gap > NORMAL_FROM * unit
                )
            fcl.refused += len(pairs) - int(np.count_nonzero(proven))
        for k in np.flatnonzero(~known).tolist():
            x[k], y[k], normal[k] = _way_out(sides, k) if search else self._computed(sides, k)
        return x, y, normal, proven

    def _computed(self, sides: _Sides, k: int, normal: Array | None = None) -> tuple[Array, Array, Array]:
        """Return nearest points (3,) and normal (3,) of one pair, without FCL, from a `normal` near it if given."""
        found = _nearest(sides.vertices[k], sides.support(k), self.scene.unit, normal)
        return _way_out(sides, k) if found is None else found

    def _further(self, sides: _Sides, heights: Array, x: Array, found: Array) -> None:
        """Add further contacts to `found`: vertices of the hull, far from `x` (k, 3), that are almost as near."""
        size = sides.size
        near = heights <= (found[:, 0, 0] + PARALLEL * size)[:, None]
        aside, span = sides.vertices - x[:, None], self.scene.span
        away, every = np.linalg.norm(aside, axis=2), np.arange(len(x))
        for contact in range(1, self.scene.each):
            distance = np.where(near, away, -1.0)
            k = distance.argmax(axis=1)
            chosen = (distance[every, k] > SECOND_CONTACT * size).nonzero()[0]
            if not len(chosen):
                return
            vertex = k[chosen]
            apart = sides.apart(chosen, vertex, heights[chosen, vertex])
            kept = apart <= found[chosen, 0, 0] + PARALLEL * size[chosen]
            chosen, vertex = chosen[kept], vertex[kept]
            found[chosen, contact, 0] = apart[kept]
            found[chosen, contact, 1 : 1 + span] = sides.weights[chosen, vertex]
            # The next one is far from the line through both.
            along = aside[every, k] / np.maximum(away[every, k], _EXACT)[:, None]
            across = aside - np.einsum("kvc,kc->kv", aside, along)[..., None] * along[:, None]
            away = np.linalg.norm(across, axis=2)


class _Sides:
    """The vertices of both sides of pairs.

    Attributes
    ----------
    vertices, others : (k, V, 3)
        Of the bodies and of the other bodies, m; some of them several times. No others for pieces.
    weights : (k, V, 4)
        Of the bodies' points in their vertices.
    size : (k,)
        Sizes of the bodies, m.
    """

    def __init__(self, group: HullGroup, pairs: Array) -> None:
        rows, scene = pairs[:, -1].astype(np.int64), group.scene
        self._scene, self._shape, self._bodies = scene, group.shape, scene.bodies
        self._body, self._other = group.body[rows], group.other[rows]
        self._points, self._pieces = pairs[:, :_POINTS].reshape(-1, 4, 3), pairs[:, _POINTS:-2]
        self.weights, self.size = self._bodies.weights_of(self._body), self._bodies.sizes[self._body]
        self.vertices = self.weights @ self._points
        self.is_self = group.is_self
        if self.is_self:
            self._of_other = self._pieces[:, :_POINTS].reshape(-1, 4, 3)
            self.others = self._bodies.weights_of(self._other) @ self._of_other

    def heights(self, normal: Array) -> tuple[Array, Array]:
        """Return heights (k, V) of the vertices along normals (k, 3), and the greatest height (k,) of the others."""
        low = np.einsum("kvc,kc->kv", self.vertices, normal)
        if self.is_self:
            return low, np.einsum("kvc,kc->kv", self.others, normal).max(axis=1)
        furthest = self._scene.batch(support_function, self._shape)(self._pieces, normal)
        return low, np.einsum("kc,kc->k", furthest, normal)

    def gaps(self, normal: Array) -> Array:
        """Return the gaps (k,) between the supporting planes of both sides along normals (k, 3), m."""
        low, high = self.heights(normal)
        return np.asarray(low.min(axis=1) - high)

    def weights_of(self, x: Array) -> Array:
        """Return (k, 4) the weights of the bodies' points in points `x` (k, 3) of these."""
        return _weights(self._points, x, self._bodies.is_hull[self._body])

    def weights_of_other(self, y: Array) -> Array:
        """Return (k, 4) the weights of the other bodies' points in points `y` (k, 3) of these."""
        return _weights(self._of_other, y, self._bodies.is_hull[self._other])

    def apart(self, chosen: Index, vertex: Index, heights: Array) -> Array:
        """Return distances (K,) of vertices of `chosen` pairs from the pieces, m; from planes for two bodies."""
        if self.is_self:
            return heights
        x = self.vertices[chosen, vertex]
        pairs = np.column_stack([x, x, self._pieces[chosen], np.zeros(len(x))])
        return self._scene.batch(distance_function, self._shape)(pairs)[:, 0]

    def support(self, k: int) -> Support:
        """Return the support function of the other of one pair."""
        if self.is_self:
            others = self.others[k]
            return lambda normal: others[int((others @ normal).argmax())]
        batch, piece = self._scene.batch(support_function, self._shape), self._pieces[k : k + 1]
        return lambda normal: batch(piece, normal[None])[0]

    def ways_out(self, k: int) -> Array:
        """Return unit normals (K, 3), among them those of the faces of both sides of one pair, out of the other."""
        sides = [_normals(self._bodies, int(self._body[k]), self._points[k])]
        middle = self.vertices[k].mean(axis=0)
        if self.is_self:
            sides.append(_normals(self._bodies, int(self._other[k]), self._of_other[k]))
            middle = middle - self.others[k].mean(axis=0)
        elif self._shape == "triangle":
            a, b, c = self._pieces[k, :9].reshape(3, 3)
            sides.append(np.cross(b - a, c - a)[None])
            middle = middle - (a + b + c) / 3.0
        else:
            middle = middle - self._pieces[k, :3]
            sides.append(self._pieces[k, 3:12].reshape(3, 3).T)
            if self._shape == "cylinder":
                axis = sides[-1][2]
                sides.append((middle - (middle @ axis) * axis)[None])
        normals = np.concatenate([*sides, middle[None]])
        length = np.linalg.norm(normals, axis=1)
        normals = normals[length > 0.0] / length[length > 0.0, None]
        return np.concatenate([normals, -normals])


def _way_out(sides: _Sides, k: int) -> tuple[Array, Array, Array]:
    """Return points (3,) of one pair that overlaps, and the normal (3,) of the shortest way out that is known.

    The normal is that of a face, or an axis of the other.
    """
    support = sides.support(k)
    best, least = None, -np.inf
    for way in sides.ways_out(k):
        below = sides.vertices[k] @ way
        gap = float(below.min() - support(way) @ way)
        if gap > least:
            best, least = (sides.vertices[k][int(below.argmin())], support(way), way), gap
    assert best is not None
    return best


def _weights(points: Array, x: Array, is_hull: Mask) -> Array:
    """Return (k, 4) the weights of `points` (k, 4, 3) in points `x` (k, 3): of four, or of the ends of an axis."""
    weights = np.zeros((len(x), 4))
    capsule = ~is_hull
    if capsule.any():
        first, along = points[capsule, 0], points[capsule, 1] - points[capsule, 0]
        square = np.maximum(np.einsum("kc,kc->k", along, along), np.finfo(float).tiny)
        share = np.clip(np.einsum("kc,kc->k", x[capsule] - first, along) / square, 0.0, 1.0)
        weights[capsule, 0], weights[capsule, 1] = 1.0 - share, share
    if is_hull.any():
        corners = np.concatenate([points[is_hull], np.ones((int(is_hull.sum()), 4, 1))], axis=2)
        right = np.concatenate([x[is_hull], np.ones((int(is_hull.sum()), 1))], axis=1)
        weights[is_hull] = np.linalg.solve(np.swapaxes(corners, 1, 2), right[..., None])[..., 0]
    return weights


def _normals(bodies: Bodies, body: int, points: Array) -> Array:
    """Return the normals (K, 3) of a body's faces at its points (4, 3), m; of a capsule the axis."""
    hull: Hull | None = bodies.hulls[body]
    if hull is None:
        return np.asarray(points[1:2] - points[:1])
    turn = (points[1:] - points[0]).T @ hull.inverse
    return np.asarray(hull.normals @ turn.T)


def _nearest(
    vertices: Array, support: Support, unit: float, normal: Array | None = None
) -> tuple[Array, Array, Array] | None:
    """Return nearest points (3,) of a hull and of another convex body, m, and the normal (3,); None if they overlap.

    The point nearest to the origin among convex combinations of differences of points, to which the difference that
    is furthest towards it is added until none is further, first along `normal` (P. Wolfe, "Finding the nearest point
    in a polytope", Math. Program. 11, 1976). The combination is a least-squares problem without negative weights.
    """
    if normal is None:
        normal = vertices.mean(axis=0) - support(np.array([0.0, 0.0, 1.0]))
        length = float(np.linalg.norm(normal))
        normal = normal / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    own, others = np.zeros((2, 0, 3))
    x, y, distance = normal, normal, np.inf
    for _ in range(_MOST):
        a, b = vertices[int((vertices @ normal).argmin())], support(normal)
        if normal @ (a - b) >= distance - _EXACT * (unit + distance):
            break
        own, others = np.vstack([own, a]), np.vstack([others, b])
        apart = own - others
        scale = max(float(np.abs(apart).max()), np.finfo(float).tiny)
        try:
            weights, _ = nnls(
                np.vstack([apart.T / scale, np.ones(len(apart))]), np.array([0.0, 0.0, 0.0, 1.0])
            )
        except RuntimeError:  # it gives up; the normal so far proves a distance all the same
            break
        kept = weights > 0.0
        own, others, weights = own[kept], others[kept], weights[kept] / weights.sum()
        x, y = weights @ own, weights @ others
        distance = float(np.linalg.norm(x - y))
        if distance <= _OVERLAP * unit:
            return None
        normal = (x - y) / distance
    return x, y, normal
