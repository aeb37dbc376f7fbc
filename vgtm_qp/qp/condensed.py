"""The step's QP condensed onto the actuators.

Its equalities give every unknown of the full QP as z = Z x + z_0: nodes move by K d_a + r, so that fixed quantities
hold by construction, the curve begins at the base, and gaps are what rows leave. The unknowns x are the actuator
displacements, the free coordinates of the curve, the progress along the path, and the slacks of an elastic tip.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array
from vgtm_qp.qp import daqp
from vgtm_qp.qp.answer import StepSolution
from vgtm_qp.qp.full import FullBuilder, StepQP
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import UNBOUNDED, StepNumbers
from vgtm_qp.rows.curve import free_basis


class CondensedSolver:
    """Solves the QP of a step in the unknowns x with DAQP."""

    knows_gain = False

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self.builder = builder = FullBuilder(layout)
        actuators, slack = builder.column["actuators"], builder.column["slack"]
        # The columns that are unknowns of the condensed QP themselves, around the free coordinates of the curve.
        self._before = np.arange(actuators.start, actuators.stop)
        self._after = np.array([builder.size - 1, *range(slack.start, slack.stop)])
        self._size = len(self._before) + layout.free_curve + len(self._after)

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
        with np.errstate(invalid="ignore"):  # What is infinite becomes NaN, and is refused with the answer.
            gradient = Z.T @ (qp.P @ start + qp.q)
        bounded = np.arange(builder.fixed_rows, len(qp.row_lower))
        rows = np.concatenate([builder.tip_rows, builder.leg_rows, bounded])
        hard = builder.hard_gaps
        constraint = np.concatenate([Z[hard], (qp.A @ Z)[rows]])
        known = np.concatenate([start[hard], (qp.A @ start)[rows]])
        bounds = []
        for columns, own in ((qp.column_lower, qp.row_lower), (qp.column_upper, qp.row_upper)):
            of_rows = np.concatenate([columns[hard], own[rows]]) - known
            bounds.append(np.concatenate([self._own(columns), of_rows]))
        lower, upper = np.maximum(bounds[0], -UNBOUNDED), np.minimum(bounds[1], UNBOUNDED)
        sense = np.zeros(len(lower), dtype=np.int32)
        sense[self._size : self._size + len(hard) + len(builder.tip_rows)] = daqp.EQUALITY
        answer = daqp.ask(hessian, gradient, constraint, lower, upper, sense)
        daqp.check(answer, hessian, gradient, constraint, lower, upper)
        y, w = np.zeros(len(qp.row_lower)), np.zeros(builder.size)
        y[rows] = answer.multipliers[self._size + len(hard) :]
        w[self._before] = answer.multipliers[: len(self._before)]
        return builder.solution(Z @ answer.x + start, y, w, answer.iterations)

    def gain(self, held: NDArray[np.bool_]) -> Array | None:  # noqa: ARG002
        """See ``solvers.StepSolver``."""
        return None

    def _own(self, bounds: Array) -> Array:
        """Return the bounds of the unknowns x, from those of all columns; free coordinates of the curve have none."""
        free = np.full(self.layout.free_curve, bounds[0])
        return np.concatenate([bounds[self._before], free, bounds[self._after]])

    def _reduction(self, numbers: StepNumbers, qp: StepQP) -> tuple[Array, Array]:
        """Return Z (n, size) and z_0 (n,) of the unknowns of the full QP."""
        layout, builder, column = self.layout, self.builder, self.builder.column
        count, size = len(self._before), self._size
        Z, start = np.zeros((builder.size, size)), np.zeros(builder.size)
        Z[column["nodes"], :count], start[column["nodes"]] = numbers.motion.response()
        Z[self._before, np.arange(count)] = 1.0
        Z[self._after, np.arange(size - len(self._after), size)] = 1.0
        if layout.vertices:
            first = column["vertices"].start
            axes, shift = numbers.base_axes, numbers.base_displacement
            start[first : first + 3] = shift
            start[first + 3 : first + 6] = shift + numbers.base_rhs @ axes
            curve = slice(first, column["torsion"].stop)
            basis = free_basis(np.cross(axes[0], axes[1]), curve.stop - first)
            Z[curve, count : count + layout.free_curve] = basis
            gaps, rows = builder.gaps, builder.gap_rows
            Z[gaps] = (qp.A @ Z)[rows]
            start[gaps] = (qp.A @ start)[rows] - qp.row_lower[rows]
        return Z, start
