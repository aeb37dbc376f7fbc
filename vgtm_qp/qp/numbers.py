"""The numbers of one step's QP in the arm's terms, from which its full and condensed forms are filled."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from vgtm_qp.arm.arm import MotionRows
from vgtm_qp.arrays import Array, Index
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.shape import CurveRows
from vgtm_qp.qp.terms import Curvature


@dataclass
class ClearanceRows:
    """Linearised clearances: sum over slots of coefficients . d rho[nodes] >= lower, in m.

    ``nodes`` (R, 4) are node indices: the two ends of the member or link, then those of the other one in a self
    pair (otherwise the same again with zero coefficients), or the four nodes of a hull; with offset joints, or two
    hulls, there are more. ``coefficients`` is (R, S, 3) for S nodes. Base nodes may occur; their displacement is
    already part of ``lower``. ``by_fcl`` and ``by_formula`` count the rows that FCL and closed forms supplied; the
    other rows are of angles, or of the user's own.
    """

    nodes: Index = field(default_factory=lambda: np.zeros((0, 4), dtype=np.int64))
    coefficients: Array = field(default_factory=lambda: np.zeros((0, 4, 3)))
    lower: Array = field(default_factory=lambda: np.zeros(0))
    name: Callable[[int], str] = str
    by_fcl: int = 0
    by_formula: int = 0

    def __len__(self) -> int:
        return len(self.lower)

    def after(self, displacement: Array) -> ClearanceRows:
        """Return the rows over the displacements that remain after a known `displacement` (N, 3), m, of the nodes."""
        known = np.einsum("rsc,rsc->r", self.coefficients, displacement[self.nodes])
        return replace(self, lower=self.lower - known)

    def _widened(self, width: int) -> ClearanceRows:
        """Return the rows with `width` slots, the new ones with zero coefficients."""
        more = ((0, 0), (0, width - self.nodes.shape[1]))
        return replace(
            self,
            nodes=np.pad(self.nodes, more, mode="edge"),
            coefficients=np.pad(self.coefficients, (*more, (0, 0))),
        )

    def joined(self, other: ClearanceRows) -> ClearanceRows:
        """Return these rows followed by `other`'s."""
        count, first, second = len(self), self.name, other.name
        width = max(self.nodes.shape[1], other.nodes.shape[1])
        parts = [rows._widened(width) for rows in (self, other)]
        return ClearanceRows(
            np.concatenate([rows.nodes for rows in parts]),
            np.concatenate([rows.coefficients for rows in parts]),
            np.concatenate([self.lower, other.lower]),
            lambda k: first(k) if k < count else second(k - count),
            self.by_fcl + other.by_fcl,
            self.by_formula + other.by_formula,
        )


class Legs(NamedTuple):
    """The legs of the control polygon that must not reverse: rows . (displacements of its vertices) >= lower, in m.

    Attributes
    ----------
    rows, lower : (G, 3 V), (G,)
        Of the legs of ``Layout.legs``.
    """

    rows: Array
    lower: Array


@dataclass
class RowNumbers:
    """Numbers of the rows with bounds of one QP, and of its progress; see :class:`StepNumbers`.

    Attributes
    ----------
    lower, upper, actuator_gradient : (n_a,)
        Box on d_a and the objective's gradient there.
    tip_jacobian : (n_e, 3 K_tip)
    tip_rate, tip_rhs : (n_e,)
    progress_lower, progress_upper, progress_gradient, progress_curvature : float
    clearance : ClearanceRows
    legs : Legs
    """

    lower: Array
    upper: Array
    actuator_gradient: Array
    tip_jacobian: Array
    tip_rate: Array
    tip_rhs: Array
    progress_lower: float
    progress_upper: float
    progress_gradient: float
    progress_curvature: float
    clearance: ClearanceRows
    legs: Legs


@dataclass
class StepNumbers(RowNumbers):
    """Numbers of one QP at one configuration; displacements d over the step are the unknowns.

    With W and W' the curve weights, and d_c = (d_p, torsion) the D = 3 V + T coordinates of the curve::

        the arm's rows: d_rho = K d_a + r                          m
        lower <= d_a <= upper                                      m
        tip_jacobian d_rho[tip] - tip_rate d_alpha = tip_rhs       m or rad
        progress_lower <= d_alpha <= progress_upper                1
        gap     = C d_rho - W d_p + position_rhs                   m
        tangent = tangent_face d_rho[face] + tangent_curve . (W' d_p) + tangent_rhs   rad
        stretch = spacing rows d_c + spacing_rhs                   m
        d_p[0]  = base_displacement, base_axes (d_p[1] - d_p[0]) = base_rhs            m
        first and last leg of the control polygon; clearance rows

    Attributes
    ----------
    motion : MotionRows
        How the free nodes move with the actuators.
    position_rhs : (K, 3)
    tangent_face : (K, R, 9)
    tangent_curve : (K, 2, 3)
        Or (K, R, D) over d_c, for curves that constant tables do not describe.
    tangent_rhs : (K, R)
    vertex_gradient : (V, 3)
    base_displacement : (3,)
    base_axes : (2, 3)
    base_rhs : (2,)
    spacing_rhs : (S,)
    curve : CurveRows or None
        Replaces the curve's tables if ``Layout.general`` is given.
    own : Curvature or None
        Objectives of the user's own, over d_rho.
    """

    motion: MotionRows
    position_rhs: Array
    tangent_face: Array
    tangent_curve: Array
    tangent_rhs: Array
    vertex_gradient: Array
    base_displacement: Array
    base_axes: Array
    base_rhs: Array
    spacing_rhs: Array = field(default_factory=lambda: np.zeros(0))
    curve: CurveRows | None = None
    own: Curvature | None = None

    def curve_rows(self, layout: Layout) -> tuple[Array, Array]:
        """Return the rows of points (3 K, D) and turns (R K, D) at the curve's nodes over d_c."""
        if self.curve is not None:
            position, turn = self.curve.position_rows, self.tangent_curve
        else:
            position = layout.curve_weights[:, None, :, None] * np.eye(3)[:, None, :]
            turn = self.tangent_curve[:, :, None, :] * layout.curve_slopes[:, None, :, None]
        size = 3 * layout.vertices + layout.torsion
        return position.reshape(-1, size), turn.reshape(-1, size)


UNBOUNDED = 1e30
"""Infinity in DAQP's bounds."""


def infinite(bounds: Array) -> Array:
    """Return DAQP's bounds with infinities where there are none."""
    return np.where(np.abs(bounds) < UNBOUNDED, bounds, np.copysign(np.inf, bounds))


def norm(vector: Array) -> float:
    """Return the Euclidean norm; NaN where an entry is."""
    return math.sqrt(vector @ vector)


def beyond(values: Array, lower: Array, upper: Array) -> Array:
    """Return the signed violations of the bounds by `values`."""
    return np.asarray(values - np.minimum(np.maximum(values, lower), upper))
