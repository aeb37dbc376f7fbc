"""Distances of convex hulls from other convex bodies in plain NumPy, many pairs at once.

The point nearest to the origin in the difference of two bodies, by simplices (Gilbert, Johnson and Keerthi, "A fast
procedure for computing the distance between complex objects", IEEE J. Robot. Autom. 4, 1988). What is returned is
the gap between two supporting planes: no distance is less, and it is the distance once that is found.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array, Index
from vgtm_qp.verify.distance import Separation

Furthest = Callable[[Array, Index], Array]
"""From normals (Q, 3) and the numbers (Q,) of pairs to the furthest points of the other bodies along them (Q, 3), m."""

_MOST = 100
_EXACT = 1e-13
"""Gap between upper and lower bound of a distance that ends the search, over the size of what is far from what."""
_TOUCHING = 1e-12
"""Distance, over the same size, below which two bodies overlap."""
_SUBSETS = [list(s) for count in (1, 2, 3, 4) for s in itertools.combinations(range(4), count)]
_WAYS: Array = np.array([way for way in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(way)])
"""Directions in which the depth of overlapping bodies is measured."""


def hull_distance(vertices: Array, furthest: Furthest) -> Separation:
    """Return the distances (P,), m, of hulls with `vertices` (P, V, 3) from other bodies, and normals (P, 3).

    Where they overlap, the distance is minus a bound of the least translation that parts them, and the normal its way.
    """
    count = len(vertices)
    every = np.arange(count)
    lower, best = np.full(count, -np.inf), np.zeros((count, 3))
    overlap = np.zeros(count, dtype=np.bool_)
    direction = vertices.mean(axis=1) - furthest(np.tile([0.0, 0.0, 1.0], (count, 1)), every)
    length = np.linalg.norm(direction, axis=1)
    normal = np.where(length[:, None] > 0.0, direction / np.maximum(length, 1e-300)[:, None], [0.0, 0.0, 1.0])
    rows, upper = every, np.full(count, np.inf)
    simplex, used = np.zeros((count, 4, 3)), np.zeros((count, 4), dtype=np.bool_)
    for _ in range(_MOST):
        if not len(rows):
            break
        near = np.einsum("pvc,pc->pv", vertices[rows], normal).argmin(axis=1)
        apart = vertices[rows, near] - furthest(normal, rows)
        gap = np.einsum("pc,pc->p", apart, normal)
        better = gap > lower[rows]
        lower[rows[better]], best[rows[better]] = gap[better], normal[better]
        size = np.abs(apart).max(axis=1) + np.where(np.isfinite(upper), upper, 0.0)
        going = upper - lower[rows] > _EXACT * size
        rows, simplex, used, apart, size, upper = (
            x[going] for x in (rows, simplex, used, apart, size, upper)
        )
        slot = np.argmin(used, axis=1)
        simplex[np.arange(len(rows)), slot], used[np.arange(len(rows)), slot] = apart, True
        weights = _nearest_weights(simplex, used)
        point = np.einsum("pk,pkc->pc", weights, simplex)
        distance = np.linalg.norm(point, axis=1)
        used = weights > 0.0
        inside = (distance <= _TOUCHING * size) | used.all(axis=1)
        overlap[rows[inside]] = True
        # Without progress rounding has the last word: the lower bound stands.
        going = ~inside & (distance < upper)
        rows, simplex, used, upper = rows[going], simplex[going], used[going], distance[going]
        normal = point[going] / upper[:, None]
    overlap &= lower <= 0.0
    lower[overlap], best[overlap] = _way_out(vertices[overlap], furthest, every[overlap])
    return lower, best


def _way_out(vertices: Array, furthest: Furthest, rows: Index) -> Separation:
    """Return the gaps (Q,), m, of overlapping bodies, which are below zero, along the best of some directions (Q, 3)."""
    found, best = np.full(len(rows), -np.inf), np.zeros((len(rows), 3))
    for way in _WAYS / np.linalg.norm(_WAYS, axis=1)[:, None] if len(rows) else ():
        normal = np.tile(way, (len(rows), 1))
        near = np.einsum("pvc,pc->pv", vertices, normal).min(axis=1)
        gap = near - np.einsum("pc,pc->p", furthest(normal, rows), normal)
        better = gap > found
        found[better], best[better] = gap[better], way
    return np.minimum(found, 0.0), best


def _nearest_weights(simplex: Array, used: NDArray[np.bool_]) -> Array:
    """Return the weights (P, 4) of the point nearest to the origin among means of the used corners (P, 4, 3).

    For each subset of corners the cofactors of Johnson's recursion are the weights of the point nearest in its plane,
    if all are above zero.
    """
    product = np.einsum("pkc,plc->pkl", simplex, simplex)
    cofactors: dict[tuple[int, ...], Array] = {}
    least, best = np.full(len(simplex), np.inf), np.zeros((len(simplex), 4))
    for subset in _SUBSETS:
        found = np.zeros((len(simplex), 4))
        for corner in subset:
            rest = tuple(k for k in subset if k != corner)
            found[:, corner] = (
                1.0
                if not rest
                else sum(
                    cofactors[rest][:, i] * (product[:, i, rest[0]] - product[:, i, corner]) for i in rest
                )
            )
        cofactors[tuple(subset)] = found
        total = found.sum(axis=1)
        valid = used[:, subset].all(axis=1) & (found[:, subset] > 0.0).all(axis=1)
        weights = found / np.where(valid, total, 1.0)[:, None]
        square = np.einsum("pkc,pk->pc", simplex, weights)
        square = np.einsum("pc,pc->p", square, square)
        better = valid & (square < least)
        least[better], best[better] = square[better], weights[better]
    return best
