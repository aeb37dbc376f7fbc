"""Distances of convex hulls from other convex bodies in plain NumPy, many pairs at once.

The point nearest to the origin in the difference of two bodies, by simplices (Gilbert, Johnson and Keerthi, "A fast
procedure for computing the distance between complex objects", IEEE J. Robot. Autom. 4, 1988). What is returned is
the gap between two supporting planes: no distance is less, and it is the distance once that is found.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from vgtm_qp.arrays import Array, Index
from vgtm_qp.verify.distance import DistanceAndNormal

Furthest = Callable[[Array, Index], Array]
"""From normals (Q, 3) and the numbers (Q,) of pairs to the furthest points of the other bodies along them (Q, 3), m."""

_MOST = 100
_EXACT = 1e-13
"""Gap between upper and lower bound of a distance that ends the search, over the size of what is far from what."""
_TOUCHING = 1e-12
"""Distance, over the same size, below which two bodies overlap."""
_FINISHED, _MOST_MORE = 1e-12, 30
"""The same gap up to which, and the number of normals along which, a pair is finished one by one."""
_OTHERS = ((1, 2), (0, 2), (0, 1))
_SUBSETS: NDArray[np.bool_] = np.array(
    [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1], [1, 0, 1], [1, 1, 0], [1, 1, 1]], dtype=np.bool_
)
"""Subsets of three corners besides a fourth."""
_WAYS: Array = np.array([way for way in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(way)])
"""Directions in which the depth of overlapping bodies is measured."""


def of_each(
    hull: NDArray[np.bool_],
    axes: Callable[[Index], DistanceAndNormal],
    hulls: Callable[[Index], DistanceAndNormal],
) -> DistanceAndNormal:
    """Return distances (P,) and normals (P, 3): `hulls` of the rows that have a `hull` (P,), `axes` of the others."""
    rows = np.flatnonzero(~hull)
    if len(rows) == len(hull):
        return axes(rows)
    distance, normal = np.empty(len(hull)), np.empty((len(hull), 3))
    if len(rows):
        distance[rows], normal[rows] = axes(rows)
    rows = np.flatnonzero(hull)
    distance[rows], normal[rows] = hulls(rows)
    return distance, normal


def hull_distance(
    vertices: Array,
    furthest: Furthest,
    near: Array | None = None,
    enough: Array | float = np.inf,
    *,
    decides: bool = False,
) -> DistanceAndNormal:
    """Return the distances (P,), m, of hulls with `vertices` (P, V, 3) from other bodies, and normals (P, 3).

    The search is short where it begins `near` (P, 3) the normals; zero where these are unknown. It ends where a gap is
    `enough`, one or (P,), and not below zero, and if it only `decides` whether there is one, where there is none: gaps
    are returned then, which are lower bounds of distances.
    Where they overlap, the distance is minus a bound of the least translation that parts them, and the normal its way.
    """
    count = len(vertices)
    every, enough = np.arange(count), np.broadcast_to(np.maximum(enough, 0.0), count)
    lower, best = np.full(count, -np.inf), np.zeros((count, 3))
    overlap = np.zeros(count, dtype=np.bool_)
    direction = np.zeros((count, 3)) if near is None else near.copy()
    unknown = np.flatnonzero(~direction.any(axis=1))
    upwards = np.tile([0.0, 0.0, 1.0], (len(unknown), 1))
    direction[unknown] = vertices[unknown].mean(axis=1) - furthest(upwards, unknown)
    length = np.linalg.norm(direction, axis=1)
    normal = np.where(length[:, None] > 0.0, direction / np.maximum(length, 1e-300)[:, None], [0.0, 0.0, 1.0])
    rows, upper = every, np.full(count, np.inf)
    reached, sizes = np.full((2, count), np.inf)
    corners, used = np.zeros((count, 3, 3)), np.zeros((count, 3), dtype=np.bool_)

    def look(along: Array, rows: Index) -> Array:
        """Return the differences (Q, 3) of the supporting points along normals (Q, 3), and keep the best gaps."""
        near = np.einsum("pvc,pc->pv", vertices[rows], along).argmin(axis=1)
        apart = vertices[rows, near] - furthest(along, rows)
        gap = np.einsum("pc,pc->p", apart, along)
        better = gap > lower[rows]
        lower[rows[better]], best[rows[better]] = gap[better], along[better]
        return np.asarray(apart)

    for _ in range(_MOST):
        if not len(rows):
            break
        apart = look(normal, rows)
        size = np.abs(apart).max(axis=1)
        going = ~(upper - lower[rows] <= _EXACT * size) & ~(lower[rows] >= enough[rows])
        if decides:
            going &= upper >= enough[rows]
        rows, corners, used, apart, size, upper = (
            x[going] for x in (rows, corners, used, apart, size, upper)
        )
        weights, point = _nearest(apart, corners, used)
        distance = np.linalg.norm(point, axis=1)
        reached[rows], sizes[rows] = np.minimum(distance, upper), size
        kept = weights > 0.0
        inside = (distance <= _TOUCHING * size) | kept.all(axis=1)
        overlap[rows[inside]] = True
        going = ~inside & (distance < upper)
        # Rounding can hide in which subset the nearest point is: the normals of all are tried.
        stalled = np.flatnonzero(~inside & ~going)
        for along in _normals(apart[stalled], corners[stalled]) if len(stalled) else ():
            length = np.linalg.norm(along, axis=1)
            usable = length > 0.0
            look(along[usable] / length[usable, None], rows[stalled[usable]])
        rows, upper, kept = rows[going], distance[going], kept[going]
        normal = point[going] / upper[:, None]
        order = np.argsort(~kept, axis=1, kind="stable")[:, :3]
        every_corner = np.concatenate([apart[:, None], corners], axis=1)[going]
        corners = np.take_along_axis(every_corner, order[..., None], axis=1)
        used = np.take_along_axis(kept, order, axis=1)
    if decides:
        return lower, best
    overlap &= lower <= 0.0
    for k in np.flatnonzero(~overlap & (lower < enough) & (reached - lower > _FINISHED * sizes)).tolist():
        _finish(look, best[k], every[k : k + 1])
    lower[overlap], best[overlap] = _way_out(vertices[overlap], furthest, every[overlap])
    return lower, best


def _finish(look: Callable[[Array, Index], Array], normal: Array, row: Index) -> None:
    """Look along normals of one pair, from its best one (3,) on, until the gap along one of them is its distance.

    Where a simplex has corners close together, as on a rim, the distance is known with the square of the error of
    the normal, and the simplices end before the gap is as good. Least squares without negative weights do not.
    """
    along, corners = normal.copy(), np.zeros((0, 3))
    for _ in range(_MOST_MORE):
        corners = np.concatenate([corners, look(along[None], row)])
        size = max(float(np.abs(corners).max()), 1e-300)
        system = np.concatenate([corners.T / size, np.ones((1, len(corners)))])
        try:
            weights, _ = nnls(system, np.array([0.0, 0.0, 0.0, 1.0]))
        except RuntimeError:  # it gives up; the gap so far is a bound all the same
            return
        corners, weights = corners[weights > 0.0], weights[weights > 0.0]
        point = weights @ corners / weights.sum()
        distance = float(np.linalg.norm(point))
        if distance <= _TOUCHING * size or distance - float((corners @ along).min()) <= _FINISHED * size:
            return
        along = point / distance


def _way_out(vertices: Array, furthest: Furthest, rows: Index) -> DistanceAndNormal:
    """Return the gaps (Q,), m, of overlapping bodies along the best (Q, 3) of some directions."""
    found, best = np.full(len(rows), -np.inf), np.zeros((len(rows), 3))
    for way in _WAYS / np.linalg.norm(_WAYS, axis=1)[:, None] if len(rows) else ():
        normal = np.tile(way, (len(rows), 1))
        near = np.einsum("pvc,pc->pv", vertices, normal).min(axis=1)
        gap = near - np.einsum("pc,pc->p", furthest(normal, rows), normal)
        better = gap > found
        found[better], best[better] = gap[better], way
    return np.minimum(found, 0.0), best


def _nearest(new: Array, corners: Array, used: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return weights (P, 4) and place (P, 3) of the point nearest to the origin in simplices.

    Its corners are `new` (P, 3), which has a share in that point, and those `used` (P, 3) of `corners` (P, 3, 3). For
    each subset of these the point nearest in its plane counts if it is within the subset: new + sum of share . edge,
    with shares by Cramer's rule.
    """
    edges = corners - new[:, None]
    gram, right = np.einsum("pkc,plc->pkl", edges, edges), -np.einsum("pkc,pc->pk", edges, new)
    square = np.einsum("pkk->pk", gram)
    shares, whole = np.zeros((len(new), 8, 3)), np.ones((len(new), 8))
    for k in range(3):
        shares[:, 1 + k, k], whole[:, 1 + k] = right[:, k], square[:, k]
        i, j = _OTHERS[k]
        product = gram[:, i, j]
        shares[:, 4 + k, i] = right[:, i] * square[:, j] - right[:, j] * product
        shares[:, 4 + k, j] = right[:, j] * square[:, i] - right[:, i] * product
        whole[:, 4 + k] = square[:, i] * square[:, j] - product * product
    a, d, f = square.T
    b, c, e = gram[:, 0, 1], gram[:, 0, 2], gram[:, 1, 2]
    cofactors = np.array(
        [[d * f - e * e, c * e - b * f, b * e - c * d], [c * e - b * f, a * f - c * c, b * c - a * e]]
    )
    last = np.array([cofactors[0, 2], cofactors[1, 2], a * d - b * b])
    adjugate = np.concatenate([cofactors, last[None]])
    shares[:, 7] = np.einsum("klp,pl->pk", adjugate, right)
    whole[:, 7] = a * adjugate[0, 0] + b * adjugate[0, 1] + c * adjugate[0, 2]
    fits = (used[:, None, :] | ~_SUBSETS).all(axis=2) & (whole > 0.0)
    shares /= np.where(fits, whole, 1.0)[..., None]
    fits &= ((shares > 0.0) | ~_SUBSETS).all(axis=2) & (shares.sum(axis=2) < 1.0)
    chosen = np.where(fits, -np.einsum("psk,pk->ps", shares, right), np.inf).argmin(axis=1)
    share = shares[np.arange(len(new)), chosen]
    weights = np.concatenate([1.0 - share.sum(axis=1, keepdims=True), share], axis=1)
    return weights, new + np.einsum("pk,pkc->pc", share, edges)


def _normals(new: Array, corners: Array) -> Iterator[Array]:
    """Yield normals (P, 3), of any length, of the planes, lines and points that corners with `new` span."""
    edges = corners - new[:, None]
    yield new
    for k in range(3):
        edge = edges[:, k]
        yield np.cross(np.cross(edge, new), edge)
        normal = np.cross(edges[:, k - 1], edge)
        yield normal * np.sign(np.einsum("pc,pc->p", normal, new))[:, None]
