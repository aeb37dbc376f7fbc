"""What a quadratic program takes from a curve: constant tables at its nodes, end conditions linear in p."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.curve.bernstein import Array
from vgtm_qp.curve.families import CurveFamily


class NodeTables(NamedTuple):
    """Constants of curve nodes at fixed parameters s (K,): r = W p, r' = W' p, r'' = W'' p; each (K, V)."""

    position: Array
    first: Array
    second: Array


class Conditions(NamedTuple):
    """Linear conditions ``matrix @ p = value`` on p = col[p_i], eq. (33): (R, 3 V) and (R,)."""

    matrix: Array
    value: Array


def node_tables(family: CurveFamily, s: ArrayLike) -> NodeTables:
    """Tabulate w, w' and w'' at the curve nodes s (K,); they stay the same for all control vertices."""
    return NodeTables(family.weights(s), family.weights(s, 1), family.weights(s, 2))


def base_conditions(control_vertices: int, center: ArrayLike, frame: ArrayLike) -> Conditions:
    """Hold the curve at its base: p_0 at the center (three rows), p_1 on the base normal (two rows).

    Parameters
    ----------
    center : (3,)
        Center of the base face, m.
    frame : (3, 3)
        Rotation of the base face; its third column is the base normal.

    Notes
    -----
    Eq. (37) holds the tip only. These five rows say that the curve begins at the base, along its normal. That
    p_1 is on the outer side is no equation: a curve that starts so keeps it in small steps.
    """
    center, across = np.asarray(center, dtype=float), np.asarray(frame, dtype=float)[:, :2].T
    matrix = np.zeros((5, 3 * control_vertices))
    matrix[:3, :3] = np.eye(3)
    matrix[3:, 3:6] = across
    return Conditions(matrix, np.concatenate([center, across @ center]))


def tip_condition(control_vertices: int, position: ArrayLike) -> Conditions:
    """End the curve at the tip's position (3,), m: eq. (37) for r(1) = p_N."""
    matrix = np.zeros((3, 3 * control_vertices))
    matrix[:, -3:] = np.eye(3)
    return Conditions(matrix, np.asarray(position, dtype=float))
