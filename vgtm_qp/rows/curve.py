"""The base of the reference curve, the counterpart of eq. (37) there, and its free coordinates."""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.curve.families import difference

_TINY = 1e-300
_STRAIGHTENS = 1e-6
"""Weight of the straightness of a fitted curve, small beside its points."""
_KEEPS = 1e3
"""Weight of the direction in which a fitted curve ends, beside its points."""
_LEAST_FIRST = 0.1
"""Least length of the first leg of a fitted curve, as a share of a leg of a straight one."""


def base_offset(centre: Any, rotation: Any, vertices: Any) -> Any:
    """Return (3, V) the displacements of the control vertices (3, V) that bring the curve back to its base, m.

    p_0 goes to the `centre` (3,) of the base, p_1 with it and onto the normal of the base's frame, `rotation` (3, 3).
    """
    across = rotation[:, :2]
    offset = ca.MX.zeros(*vertices.shape)
    offset[:, 0] = centre - vertices[:, 0]
    offset[:, 1] = offset[:, 0] - across @ (across.T @ (vertices[:, 1] - vertices[:, 0]))
    return offset


def legs(vertices: Any, normal: Any, least: Any, *, both: bool) -> tuple[Any, Any]:
    """Return rows (3 V, G) of the first leg of the control polygon (3, V), and of the last, and bounds (G,).

    A leg must not shrink to zero length: it would reverse, and the curve with it. So the displacement of its
    end less that of its start, along its axis, is at least the bound, m: the leg then keeps the `least`
    length, or its own if that is less. The axis of the first leg is the base's `normal` (3,), that of the
    last its own direction.
    """
    others = ca.MX.zeros(vertices.numel() - 6)
    rows, lengths = [ca.vertcat(-normal, normal, others)], [ca.dot(vertices[:, 1] - vertices[:, 0], normal)]
    if both:
        last = vertices[:, -1] - vertices[:, -2]
        lengths.append(ca.norm_2(last))
        axis = last / ca.fmax(lengths[1], _TINY)
        rows.append(ca.vertcat(others, -axis, axis))
    return ca.horzcat(*rows), ca.fmin(least - ca.vertcat(*lengths), 0.0)


@cache
def polygon_bending(vertices: int) -> Array:
    """Return (V, V) D'D with D the second difference of the control vertices."""
    second = difference(vertices, 2)
    return np.asarray(second.T @ second)


def spacing(chord: Any, change: Any) -> tuple[Any, Any]:
    """Return the distance of two points, m, and its row: of symbols, or of arrays for many pairs at once.

    Three components of the `chord` from one to the other, m, and three rows by which it changes.
    """
    distance = sum(component**2 for component in chord) ** 0.5
    return distance, sum(row * (component / distance) for row, component in zip(change, chord, strict=True))


def spacings(points: Array, rows: Array) -> tuple[Array, Array]:
    """Return the distances (K - 1,) of successive points (K, 3), m, and their rows (K - 1, D) from those (K, 3, D)."""
    distance, changes = spacing(np.diff(points, axis=0).T[..., None], np.diff(rows, axis=0).swapaxes(0, 1))
    return distance[:, 0], changes


def fitted(
    weights: Array, points: Array, start: Array, normal: Array, end: tuple[Array, Array] | None = None
) -> Array:
    """Return (V, 3) the vertices of the straightest curve from `start` (3,), along `normal` (3,), through `points`.

    The points are (K, 3), m. The curve nodes with `weights` (K, V) meet them as well as possible. The `end`
    gives the direction in which the curve ends: weights (V,) of the slope there, and an axis (3,).
    """
    vertices = weights.shape[1]
    basis = free_basis(normal, 3 * vertices)
    second = difference(vertices, 2)
    rows = np.kron(np.vstack([weights, _STRAIGHTENS * second]), np.eye(3)) @ basis
    away = np.vstack([points - start, np.zeros((len(second), 3))]).ravel()
    if end is not None:
        slope, axis = end
        aside = np.kron(slope, np.eye(3) - np.outer(axis, axis)) @ basis
        rows, away = np.vstack([rows, _KEEPS * aside]), np.concatenate([away, np.zeros(3)])
    free = np.linalg.lstsq(rows, away, rcond=None)[0]
    least = _LEAST_FIRST * float(np.linalg.norm(points[-1] - start)) / max(vertices - 1, 1)
    if free[0] < least:
        # The curve must not begin backwards.
        rest = np.linalg.lstsq(rows[:, 1:], away - least * rows[:, 0], rcond=None)[0]
        free = np.concatenate([[least], rest])
    return np.asarray(start + (basis @ free).reshape(-1, 3))


def free_basis(normal: Array, size: int) -> Array:
    """Return (D, q) the derivative of all D coordinates by the q that the base leaves free; q = 0 without a curve."""
    basis = np.eye(size)[:, 5:]
    basis[:6] = 0.0
    if size:
        basis[3:6, 0] = normal
    return basis


def weighted_columns(weights: Any, normal: Any, factor: Any) -> Any:
    """Return (R, q) the derivative of factor (R, 3) @ sum_i w_i p_i by the free coordinates, eq. (35)."""
    return ca.horzcat(weights[1] * (factor @ normal), ca.kron(weights[2:].T, factor))
