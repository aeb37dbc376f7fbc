"""Closest points of a curve to a point and to a box, section 4.7: all local minima, from roots of polynomials."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike

from vgtm_qp.arrays import Array
from vgtm_qp.curve.curve import Curve
from vgtm_qp.errors import CurveError

_ROUNDING = 1e-14
_NEARLY_REAL = 1e-2
"""Imaginary part up to which a root counts as real: multiple roots are rounded; extra roots do no harm."""
_LEVEL = 1e-13
"""Distances that differ by less, relative to the curve's size, are the same."""


class ClosestPoints(NamedTuple):
    """All local minima of a distance along a curve, the nearest first.

    They are parameters (n,) and points (n, 3) of the curve, m, nearest points (n, 3) of the obstacle, m, and the
    distances (n,), m, which are negative inside a box.
    """

    s: Array
    position: Array
    witness: Array
    distance: Array


def closest_to_point(curve: Curve, point: ArrayLike) -> ClosestPoints:
    """Find all local minima of |r(s) - q| for a point q (3,), m; ends count where the distance falls to them.

    CurveError where the point is not three finite numbers.
    """
    goal = _vector("the point", point)
    return _closest(curve, curve.family.breaks, lambda r: (np.broadcast_to(goal, r.shape), np.ones(len(r))))


def closest_to_box(
    curve: Curve, center: ArrayLike, size: ArrayLike, rotation: ArrayLike | None = None
) -> ClosestPoints:
    """Find all local minima of the signed distance along the curve to a box, turned by `rotation` (3, 3) if given.

    The box has its `center` (3,), m, and one or three edges, `size`, m. Outside the signed distance is the
    distance; inside it is minus the depth below the nearest face. The curve is cut where it passes a face's
    plane, and where inside the box the nearest face changes. On each piece the distance, or its square, is
    one polynomial. Of a stretch at constant distance one end is returned. CurveError for a number that is not
    finite or an edge not positive.
    """
    middle = _vector("the center", center)
    half = _vector("the size", np.broadcast_to(np.asarray(size, dtype=float), 3)) / 2
    if not np.all(half > 0.0):
        raise CurveError("the edges of a box must be greater than 0")
    turn = np.eye(3) if rotation is None else np.asarray(rotation, dtype=float)
    first, second = np.triu_indices(6, k=1)

    def heights(s: Array) -> Array:
        local = (curve.position(s) - middle) @ turn
        above = np.concatenate([local - half, -local - half], axis=1)
        return np.concatenate([above, above[:, first] - above[:, second]], axis=1)

    def nearest(r: Array) -> tuple[Array, Array]:
        local = (r - middle) @ turn
        excess = np.abs(local) - half
        is_deepest = np.arange(3) == np.argmax(excess, axis=1)[:, None]
        is_outside = np.any(excess > 0.0, axis=1)
        away = np.where(is_outside[:, None], np.maximum(excess, 0.0), is_deepest * excess)
        return r - (np.copysign(1.0, local) * away) @ turn.T, np.where(is_outside, 1.0, -1.0)

    return _closest(curve, _with_roots(heights, curve.family.breaks, curve.family.degree), nearest)


def _closest(curve: Curve, joints: Array, nearest: Callable[[Array], tuple[Array, Array]]) -> ClosestPoints:
    """Return all local minima of a distance that is one polynomial between two joints, or the root of one.

    `nearest` returns the witnesses of points r (n, 3) and the signs (n,) of their distances.
    """

    def slope(s: Array) -> Array:
        r = curve.position(s)
        return np.asarray(np.sum((r - nearest(r)[0]) * curve.derivative(s), axis=1))

    s = _with_roots(slope, joints, 2 * curve.family.degree - 1)
    position = curve.position(s)
    witness, sign = nearest(position)
    distance = sign * np.linalg.norm(position - witness, axis=1)
    # From one of these points to the next the distance is monotonic.
    level = np.abs(np.diff(distance)) <= _LEVEL * max(1.0, float(np.abs(position).max()))
    last = np.flatnonzero(np.append(~level, True))
    rises = np.diff(distance[last]) > 0.0
    chosen = last[np.append(True, ~rises) & np.append(rises, True)]
    order = chosen[np.argsort(distance[chosen], kind="stable")]
    return ClosestPoints(s[order], position[order], witness[order], distance[order])


def _with_roots(function: Callable[[Array], Array], joints: Array, degree: int) -> Array:
    """Return `joints`, and between them where a function (n, ...) of s (n,) vanishes, in order.

    It is a polynomial of `degree` between two joints.
    """
    nodes, found = chebyshev.chebpts1(degree + 1), [joints]
    for start, end in pairwise(joints):
        half = (end - start) / 2.0
        values = function(start + half * (nodes + 1.0)).reshape(degree + 1, -1)
        for row in chebyshev.chebfit(nodes, values, degree).T:
            roots = chebyshev.chebroots(chebyshev.chebtrim(row, _ROUNDING * np.abs(row).max()))
            kept = roots.real[(np.abs(roots.imag) < _NEARLY_REAL) & (np.abs(roots.real) < 1.0)]
            found.append(start + half * (kept + 1.0))
    return np.unique(np.concatenate(found))


def _vector(name: str, value: ArrayLike) -> Array:
    vector = np.asarray(value, dtype=float)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise CurveError(f"{name} must be three finite numbers, not {value!r}")
    return vector
