"""The step's QP condensed onto the actuators.

The equalities give every unknown of the full QP as z = Z x + z_0. Nodes move by K d_a + r, so that fixed quantities
hold by construction; the curve begins at the base; gaps follow from nodes and curve. The unknowns x are the actuator
displacements, the free coordinates of the curve, the progress along the path, and the slacks of an elastic tip.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array
from vgtm_qp.qp.answer import StepSolution
from vgtm_qp.qp.daqp import DAQP, fitted
from vgtm_qp.qp.dense import EQUALITY, DenseQP, DenseSolver, answered
from vgtm_qp.qp.full import FullBuilder, StepQP
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import UNBOUNDED, StepNumbers
from vgtm_qp.qp.settle import Gain, settling_gain
from vgtm_qp.rows.curve import free_basis


class CondensedSolver:
    """Solves the QP of a step in the unknowns x."""

    settles = "equalities"

    def __init__(self, layout: Layout, solver: DenseSolver = DAQP) -> None:
        self.layout, self._solver = layout, fitted(solver, layout.arm.fineness)
        self.builder = builder = FullBuilder(layout)
        actuators, slack = builder.column["actuators"], builder.column["slack"]
        # The columns that the condensed QP keeps, before and after the free coordinates of the curve.
        self._before = np.arange(actuators.start, actuators.stop)
        self._after = np.array([builder.size - 1, *range(slack.start, slack.stop)])
        # The column of the full QP that each unknown is; -1 for free coordinates of the curve.
        self._unknown = np.concatenate([self._before, np.full(layout.free_curve, -1), self._after])
        # Eliminated columns that have bounds; the first `_equal` of them are equalities.
        self._bounded, self._equal = builder.hard_gaps, len(builder.hard_gaps)

    def solve(self, numbers: StepNumbers) -> StepSolution:
        """Solve one QP.

        Raises
        ------
        InfeasibleStepError
            The hard rows contradict one another.
        SolverError
            The arm is in a singular pose, or the answer failed the residual check.
        """
        qp, builder = self.builder.build(numbers), self.builder
        Z, start = self._reduction(numbers, qp)
        hessian = Z.T @ (qp.P @ Z)
        with np.errstate(invalid="ignore"):  # Infinity becomes NaN, and the check of the answer refuses it.
            gradient = Z.T @ (qp.P @ start + qp.q)
        rows = np.concatenate(
            [builder.tip_rows, builder.leg_rows, np.arange(builder.fixed_rows, len(qp.row_lower))]
        )
        bounded, size = self._bounded, len(self._unknown)
        constraint = np.concatenate([Z[bounded], (qp.A @ Z)[rows]])
        known = np.concatenate([start[bounded], (qp.A @ start)[rows]])
        bounds = []
        for columns, own in ((qp.column_lower, qp.row_lower), (qp.column_upper, qp.row_upper)):
            of_rows = np.concatenate([columns[bounded], own[rows]]) - known
            bounds.append(np.concatenate([self._own(columns), of_rows]))
        lower, upper = np.maximum(bounds[0], -UNBOUNDED), np.minimum(bounds[1], UNBOUNDED)
        sense = np.zeros(len(lower), dtype=np.int32)
        sense[size : size + self._equal] = EQUALITY
        tips = size + len(bounded)
        sense[tips : tips + len(builder.tip_rows)] = EQUALITY
        dense = DenseQP(hessian, gradient, constraint, lower, upper, sense)
        answer = answered(self._solver, dense)
        y, w = np.zeros(len(qp.row_lower)), np.zeros(builder.size)
        y[rows] = answer.multipliers[tips:]
        w[bounded] = answer.multipliers[size:tips]
        is_column = self._unknown >= 0
        w[self._unknown[is_column]] = answer.multipliers[:size][is_column]
        return builder.solution(Z @ answer.x + start, y, w, answer.iterations)

    def gain_of(self, numbers: StepNumbers, at_bound: NDArray[np.bool_]) -> Gain | None:
        """Return the least changes that correct the equalities' errors, see ``settle.missing_function``.

        Actuators `at_bound` (n_a,) and the progress do not change. None if there are no such changes.
        """
        builder = self.builder
        qp = builder.build(numbers)
        Z, _ = self._reduction(numbers, qp)
        free = np.ones(len(self._unknown), dtype=bool)
        free[: len(at_bound)], free[-len(self._after) :] = ~at_bound, False
        # A gap is the station less the curve.
        rows = np.concatenate([(qp.A @ Z)[builder.tip_rows], Z[builder.hard_gaps]])
        gain = settling_gain(Z.T @ (qp.P @ Z), rows, self.layout.levers, free)
        nothing = np.zeros(len(qp.row_lower)), np.zeros(builder.size), 0
        levers, end = np.ones(len(free)), len(at_bound) + self.layout.free_curve
        levers[end - self.layout.torsion : end] = self.layout.arm.unit
        return None if gain is None else Gain(gain, lambda x: builder.solution(Z @ x, *nothing), levers)

    def gain(self, held: NDArray[np.bool_]) -> Array | None:  # noqa: ARG002
        """See ``solvers.StepSolver``."""
        return None

    def _own(self, bounds: Array) -> Array:
        """Return the bounds of the unknowns x from those of all columns; infinite for the curve's."""
        return np.asarray(np.where(self._unknown >= 0, bounds[self._unknown], bounds[0]))

    def _reduction(self, numbers: StepNumbers, qp: StepQP) -> tuple[Array, Array]:
        """Return Z (n, size) and z_0 (n,) of the unknowns of the full QP."""
        layout, builder, column = self.layout, self.builder, self.builder.column
        count, size = len(self._before), len(self._unknown)
        Z, start = np.zeros((builder.size, size)), np.zeros(builder.size)
        Z[column["nodes"], :count], start[column["nodes"]] = numbers.motion.response()
        Z[self._before, np.arange(count)] = 1.0
        Z[self._after, np.arange(size - len(self._after), size)] = 1.0
        if layout.vertices:
            curve, basis, start[curve] = self._on_base(numbers)
            Z[curve, count : count + layout.free_curve] = basis
            gaps, rows = builder.gaps, builder.gap_rows
            Z[gaps] = (qp.A @ Z)[rows]
            start[gaps] = (qp.A @ start)[rows] - qp.row_lower[rows]
        return Z, start

    def _on_base(self, numbers: StepNumbers) -> tuple[slice, Array, Array]:
        """Return the curve's columns (D) and their displacements by free coordinates (D, q) and base (D,)."""
        column, axes, shift = self.builder.column, numbers.base_axes, numbers.base_displacement
        curve = slice(column["vertices"].start, column["torsion"].stop)
        start = np.zeros(curve.stop - curve.start)
        start[:3] = shift
        start[3:6] = shift + numbers.base_rhs @ axes
        return curve, free_basis(np.cross(axes[0], axes[1]), len(start)), start
