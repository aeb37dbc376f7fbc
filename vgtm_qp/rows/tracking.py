"""Tracking of the reference curve, eqs. (32) and (39): gaps and turns between stations and their curve nodes."""

from __future__ import annotations

from typing import Any

import casadi as ca


def gap(centre: Any, point: Any) -> Any:
    """Return (3,) the station's position less the curve's, m: eq. (39) for r(s, p)."""
    return centre - point


def turns(rotation: Any, frame: Any, count: int) -> tuple[Any, Any]:
    """Return the turns (R,) between a station's and the curve's frame (3, 3), and c (R, 3).

    They are eq. (39) for theta(s, p). The first two are :func:`tilts`, the third the sine of the roll. Each depends on
    the relative rotation alone: its rate is c . (angular velocity of the station less that of the curve's frame).
    """
    tilt, c = tilts(rotation, frame[:, 2])
    if count == 2:
        return tilt, c
    x, y, first, second = rotation[:, 0], rotation[:, 1], frame[:, 0], frame[:, 1]
    roll = (ca.dot(x, second) - ca.dot(y, first)) / 2
    return ca.vertcat(tilt, roll), ca.vertcat(c, ((ca.cross(x, second) - ca.cross(y, first)) / 2).T)


def tilts(rotation: Any, tangent: Any) -> tuple[Any, Any]:
    """Return the cosines (2,) between a station's x- and y-axes and the tangent (3,), and c (2, 3) of :func:`turns`."""
    axes = rotation[:, :2]
    return axes.T @ tangent, ca.horzcat(*(ca.cross(axis, tangent) for axis in ca.horzsplit(axes))).T


def within(error: Any, reach: float) -> Any:
    """Return an error, shortened to the length `reach`: the part that one step is to correct."""
    square = ca.dot(error, error)
    return error * ca.fmin(1.0, reach / ca.sqrt(ca.fmax(square, (1e-3 * reach) ** 2)))


def slope_rows(rotation: Any, slope: Any) -> tuple[Any, Any, Any]:
    """Return :func:`tilts` (2,), their c (2, 3), and the tilts' rows (2, 3) over the slope r' (3,).

    A curve without roll turns with its tangent alone: dt = (1 - t t') dr' / |r'|, and c . (t x dt) = -axis . dt.
    """
    slowness = 1.0 / ca.norm_2(slope)
    tangent = slope * slowness
    tilt, c = tilts(rotation, tangent)
    return tilt, c, (rotation[:, :2].T - tilt @ tangent.T) * slowness
