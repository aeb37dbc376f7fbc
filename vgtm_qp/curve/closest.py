"""Closest points of a curve to a point and to a box: all local minima, from the curve's Bezier segments."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.curve.bernstein import Array, inner_product, split
from vgtm_qp.curve.curve import Curve
from vgtm_qp.curve.families import CurveFamily
from vgtm_qp.curve.roots import Pieces, crossings, minima
from vgtm_qp.errors import CurveError

_SAME_PARAMETER = 1e-9
_SAME_CUT = 1e-12
_ROUNDING = 1e-11


class ClosestPoints(NamedTuple):
    """All local minima of a distance along a curve, the nearest first.

    Attributes
    ----------
    s : (m,)
        Curve parameters.
    position : (m, 3)
        Points on the curve, m.
    witness : (m, 3)
        The points of the obstacle that they are closest to, m.
    distance : (m,)
        Distances, m; negative inside a box.
    """

    s: Array
    position: Array
    witness: Array
    distance: Array


def closest_to_point(curve: Curve, point: ArrayLike) -> ClosestPoints:
    """Find all local minima of |r(s) - q| for a point q (3,), m; ends count where the distance falls to them.

    They are where (r - q) . r' changes from negative to positive: on a segment of degree d a Bernstein
    polynomial of degree 2 d - 1.

    Raises
    ------
    CurveError
        The point is not three finite numbers.
    """
    goal = _vector("the point", point)
    away = curve.family.extraction @ curve.control_vertices - goal
    breaks = curve.family.breaks
    chain = Pieces(inner_product(away, np.diff(away, axis=1)), breaks[:-1], breaks[1:])
    s = _distinct(minima(chain))
    position = curve.position(s)
    distance = np.linalg.norm(position - goal, axis=1)
    return _nearest_first(s, position, np.broadcast_to(goal, position.shape), distance)


def closest_to_box(
    curve: Curve, center: ArrayLike, size: ArrayLike, rotation: ArrayLike | None = None
) -> ClosestPoints:
    """Find all local minima of the signed distance to a box along the curve.

    Outside that is the distance; inside it is minus the depth below the nearest face. The curve is cut
    where it passes a face's plane and where the face nearest to it from inside changes. On each piece the
    distance, or its square, is one polynomial, with minima as in `closest_to_point`. Of a stretch at
    constant distance the end is given.

    Parameters
    ----------
    center : (3,)
        m.
    size : float or (3,)
        Edge, or the three edges, m.
    rotation : (3, 3), optional
        Rotation of the box; none where not given.

    Raises
    ------
    CurveError
        Not finite numbers, or an edge that is not positive.
    """
    middle = _vector("the center", center)
    half = _vector("the size", np.broadcast_to(np.asarray(size, dtype=float), 3)) / 2
    if not np.all(half > 0.0):
        raise CurveError("the edges of a box must be greater than 0")
    turn = np.eye(3) if rotation is None else np.asarray(rotation, dtype=float)
    family = curve.family
    local = (family.extraction @ curve.control_vertices - middle) @ turn
    heights = np.concatenate([local - half, -local - half], axis=-1)
    s = _distinct(minima(_distance_slopes(family, heights)))

    position = curve.position(s)
    inside = (position - middle) @ turn
    excess = np.abs(inside) - half
    deepest = np.argmax(excess, axis=1)
    witness = np.clip(inside, -half, half)
    distance = np.linalg.norm(inside - witness, axis=1)
    for k in np.flatnonzero(np.all(excess < 0.0, axis=1)):
        axis = deepest[k]
        witness[k, axis] = np.copysign(half[axis], inside[k, axis])
        distance[k] = excess[k, axis]
    return _nearest_first(s, position, middle + witness @ turn.T, distance)


def _distance_slopes(family: CurveFamily, heights: Array) -> Pieces:
    """Differentiate the signed distance to a box along the curve, up to a positive factor.

    Parameters
    ----------
    heights : (S, d + 1, 6)
        Bezier coefficients of the curve's heights above the planes of the six faces.
    """
    start, end = _pieces_of_one_kind(family, heights)
    segment = np.searchsorted(family.breaks[1:-1], start, side="right")
    origin, width = family.breaks[segment], np.diff(family.breaks)[segment]
    rows = np.swapaxes(heights, 1, 2)[segment]
    rows, _ = split(rows, ((end - origin) / width)[:, None])
    _, rows = split(rows, ((start - origin) / (end - origin))[:, None])
    pieces = np.swapaxes(rows, 1, 2)

    noise = _ROUNDING * np.abs(heights).max()
    slopes = np.diff(pieces, axis=1)
    slopes[np.abs(slopes) < noise * 1e-4] = 0.0
    # At a cut on a face's plane the height is zero, and rounding must not give it a sign.
    for end_row in (0, -1):
        pieces[:, end_row][np.abs(pieces[:, end_row]) < noise] = 0.0

    middles = split(rows, 0.5)[0][..., -1]
    outside = np.any(middles > 0.0, axis=1)[:, None, None]
    nearest = np.arange(6) == np.argmax(middles, axis=1)[:, None]
    above = (middles > 0.0)[:, None, :]
    factors = np.where(outside, pieces * above, nearest[:, None, :])
    return Pieces(inner_product(factors, slopes), start, end)


def _pieces_of_one_kind(family: CurveFamily, heights: Array) -> tuple[Array, Array]:
    """Cut the curve at the planes of faces and where, inside, the nearest face changes: starts, ends."""
    first, second = np.triu_indices(6, k=1)
    events = np.concatenate([heights, heights[..., first] - heights[..., second]], axis=-1)
    count = events.shape[-1]
    cuts = crossings(
        Pieces(
            np.swapaxes(events, 1, 2).reshape(-1, events.shape[1]),
            np.repeat(family.breaks[:-1], count),
            np.repeat(family.breaks[1:], count),
        )
    )
    cuts = cuts[np.abs(cuts[:, None] - family.breaks).min(axis=1) > _SAME_CUT]
    cuts = np.sort(cuts)
    cuts = cuts[np.diff(cuts, prepend=-1.0) > _SAME_CUT]
    joints = np.sort(np.concatenate([family.breaks, cuts]))
    return joints[:-1], joints[1:]


def _vector(name: str, value: ArrayLike) -> Array:
    vector = np.asarray(value, dtype=float)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise CurveError(f"{name} must be three finite numbers, not {value!r}")
    return vector


def _distinct(s: Array) -> Array:
    s = np.sort(s)
    return np.asarray(s[np.diff(s, prepend=-1.0) > _SAME_PARAMETER])


def _nearest_first(s: Array, position: Array, witness: Array, distance: Array) -> ClosestPoints:
    order = np.argsort(distance, kind="stable")
    return ClosestPoints(s[order], position[order], witness[order], distance[order])
