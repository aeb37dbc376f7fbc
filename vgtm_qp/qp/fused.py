"""The fast path of a step: one compiled call linearises and condenses, one BLAS call squares, DAQP solves.

It answers the same QP as :mod:`vgtm_qp.qp.condensed`, in 10 to 20 times less time for short arms.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import daqp
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.compiled import Kernel
from vgtm_qp.qp.condensed import FEASIBILITY, UNBOUNDED, InfeasibleStepError, check_answer
from vgtm_qp.qp.fused_graph import Bound, row_function, settle_function
from vgtm_qp.qp.graph import Stage
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import ClearanceRows, StepSolution, progress_scale
from vgtm_qp.qp.settle import held, settling_gain
from vgtm_qp.qp.shape import CurveRows

Array = NDArray[np.float64]

_EQUALITY = 5
"""DAQP's mark for a row that is always active."""


@dataclass(frozen=True)
class TipGoal:
    """The end effector's rows: which of the six tip rows, combined how, move at which rate towards which error.

    Attributes
    ----------
    rate, error : (n_e,)
        m or rad per unit of progress, and goal minus value, m or rad.
    across : (r, 3) or None
        Combines the three angular-velocity rows into those that are tracked; None where no orientation is.
    """

    rate: Array
    error: Array
    across: Array | None


@dataclass(frozen=True, eq=False)
class Closed:
    """A configuration whose members have their lengths.

    Attributes
    ----------
    X : (N, 3)
        m.
    lengths : (M,)
        m.
    error : float
        Greatest deviation of a length from what it should be, m.
    tip_position, tip_rotation : (3,), (3, 3)
    """

    X: Array
    lengths: Array
    error: float
    tip_position: Array
    tip_rotation: Array


def _bound_kernel(bound: Bound) -> Kernel:
    kernel = Kernel(bound.function)
    first = len(kernel.inputs) - len(bound.constants)
    for k, values in enumerate(bound.constants):
        kernel.bind_input(first + k, values)
    return kernel


class FusedSolver:
    """Linearises, condenses and solves; for arms with `elimination_stages`."""

    def __init__(self, layout: Layout, stages: list[Stage], position_axes: NDArray[np.int64]) -> None:
        self.layout = layout
        truss = layout.truss
        self._rows = _bound_kernel(row_function(layout, stages))
        self._settled = _bound_kernel(settle_function(layout, stages))
        self._position_axes = position_axes
        nodes, actuators = layout.node_columns, len(truss.actuators)
        self._actuators = actuators
        self._free_curve = layout.free_curve
        self._size = actuators + self._free_curve + 1
        self._torsion = self._size - 1 - layout.torsion
        out = self._rows.outputs
        self._stack = out[0].reshape(self._size, -1)
        self._response = self._stack[:, :nodes]
        self._tip = out[1].reshape(actuators + 1, 6).T
        self._box = out[2].reshape(3, actuators)
        self.tip_position, self.tip_rotation = out[3], out[4].reshape(3, 3).T
        self._curve_gradient, self._offset, self._normal = out[5], out[6].reshape(layout.vertices, 3), out[7]
        self._gram = np.zeros((self._size, self._size))
        self._hessian = np.zeros((self._size, self._size))
        self._gradient = np.zeros(self._size)
        self._scale = 1.0 / np.sqrt(layout.weights.node_rate)
        self._spread = np.zeros((0, len(truss.free) + 1, 3))
        self._place = np.where(truss.base, len(truss.free), layout.node_column // 3)
        self._constant = np.zeros((self._size - 1, self._size - 1))
        self._hard = layout.hard_rows
        self._draw(layout)
        self._settling = np.zeros((0, actuators)), np.ones(actuators, dtype=bool)
        self._reserve(self._size + 64)
        if self._hard:
            self._soft = np.ones(self._stack.shape[1])
            self._soft[nodes : nodes + self._hard] = 0.0

    def drawn(self, layout: Layout) -> FusedSolver:
        """Return the solver of a layout that differs in the control vertices with goals alone; buffers are shared."""
        other = copy.copy(self)
        other._draw(layout)
        return other

    def _draw(self, layout: Layout) -> None:
        self.layout = layout
        self._goal_pull = np.zeros((layout.vertices, 3))
        self._goal_weight = (
            np.isin(np.arange(layout.vertices), layout.vertex_goals) * layout.weights.vertex_goal
        )
        self._constant_normal = np.full(3, np.nan)

    def load(
        self,
        X: Array,
        Y: Array,
        base: Array,
        vertices: Array,
        lower: Array,
        upper: Array,
        *,
        motion: bool,
        curve: CurveRows | None = None,
        goals: Array | None = None,
    ) -> None:
        """Linearise: residuals at `X` (N, 3), Jacobians at `Y`; see `row_function`. Sets tip_position and tip_rotation.

        `curve` are the rows of a curve that is more than its tables, `goals` (V, 3) those of the control vertices.
        """
        inputs = self._rows.inputs
        inputs[0][:] = X.reshape(-1)
        inputs[1][:] = Y.reshape(-1)
        inputs[2][:] = base.reshape(-1)
        inputs[3][:] = vertices.reshape(-1)
        inputs[4][:] = lower
        inputs[5][:] = upper
        inputs[6][0] = 1.0 if motion else 0.0
        for k, table in enumerate(curve or (), start=7):
            inputs[k][:] = table.reshape(-1)
        self._rows()
        if self.layout.vertex_goals:
            self._goal_pull = self._goal_weight[:, None] * self._offset
            if motion:
                self._goal_pull += self.layout.goal_pull(vertices, goals)

    def solve(self, goal: TipGoal, progress: float, clearance: ClearanceRows) -> StepSolution:
        """Solve the QP at the configuration loaded last.

        Raises
        ------
        InfeasibleStepError, SolverError
            As ``CondensedSolver.solve``.
        """
        size, count, weights = self._size, self._actuators, self.layout.weights
        hessian, gradient = self._assemble()
        rate = goal.rate
        curvature = weights.progress * progress_scale(rate)
        hessian[-1, -1] = curvature
        gradient[-1] = curvature * (progress - 2.0)

        tip, hard, near = len(rate), self._hard, len(clearance)
        rows = tip + hard + near
        if size + rows > len(self._lower):
            self._reserve(2 * (size + rows))
        constraint = self._constraint[:rows]
        lower, upper, sense = (
            self._lower[: size + rows],
            self._upper[: size + rows],
            self._sense[: size + rows],
        )
        lower[:count], upper[:count] = self._box[0], self._box[1]
        lower[size - 1], upper[size - 1] = -progress, 1.0 - progress
        tip_rows = self._tip[self._position_axes]
        if goal.across is not None:
            tip_rows = np.concatenate([tip_rows, goal.across @ self._tip[3:]])
        constraint[:tip, :count] = tip_rows[:, :-1]
        constraint[:tip, -1] = -rate
        lower[size : size + tip] = goal.error - tip_rows[:, -1]
        equal = size + tip + hard
        if hard:
            block = self._stack[:, self.layout.node_columns : self.layout.node_columns + hard]
            constraint[tip : tip + hard, :-1] = block[:-1].T
            lower[size + tip : equal] = -block[-1]
        upper[size:equal] = lower[size:equal]
        sense[size:equal] = _EQUALITY
        if near:
            spread = self._spread_rows(clearance)
            answer = spread @ self._response.T
            answer *= self._scale
            constraint[tip + hard :, :count] = answer[:, :count]
            constraint[tip + hard :, count:] = 0.0
            np.subtract(clearance.lower, answer[:, -1], out=lower[equal:])
            upper[equal:] = UNBOUNDED
            sense[equal:] = 0
        x, _, flag, info = daqp.solve(
            hessian, gradient, constraint, upper, lower, sense, primal_tol=FEASIBILITY, eps_prox=0.0
        )
        if flag == -1:
            raise InfeasibleStepError("the hard rows of the step contradict one another")
        multipliers = info["lam"]
        check_answer(x, multipliers, flag, hessian, gradient, constraint, lower, upper)
        self._settling = tip_rows[:, :-1], ~held(x[:count], self._box[0], self._box[1])

        truss = self.layout.truss
        nodes = np.zeros((truss.node_count, 3))
        moved = x[:count] @ self._response[:count] + self._response[-1]
        moved *= self._scale
        nodes[truss.free] = moved.reshape(-1, 3)
        vertices = np.array(self._offset)
        if self._free_curve:
            vertices[1] += self._normal * x[count]
            vertices[2:] += x[count + 1 : self._torsion].reshape(-1, 3)
        return StepSolution(
            nodes=nodes,
            actuators=x[:count],
            vertices=vertices,
            progress=float(x[-1]),
            actuator_multipliers=multipliers[:count],
            clearance_multipliers=-multipliers[len(multipliers) - near :],
            iterations=int(info["iterations"]),
            torsion=x[self._torsion : -1],
        )

    def settle(
        self, X: Array, lower: Array, upper: Array, position: Array, rotation: Array
    ) -> tuple[Closed, Array]:
        """Return `X` (N, 3) with its lengths closed, actuators in their boxes (n_a,), m, and its tip at a pose.

        Beside it stand the tip's errors before and after settling, (2, n_e).
        """
        kernel, gain = self._settled, self.gain()
        inputs, out = kernel.inputs, kernel.outputs
        inputs[0][:] = X.reshape(-1)
        inputs[1][:] = lower
        inputs[2][:] = upper
        inputs[3][:] = position
        inputs[4][:] = rotation.T.reshape(-1)
        if gain is None:
            inputs[5][:] = 0.0
        else:
            inputs[5].reshape(-1, len(self._place), 3)[:] = gain
        kernel()
        closed = Closed(
            out[0].reshape(-1, 3).copy(),
            out[1].copy(),
            float(out[2][0]),
            out[3].copy(),
            out[4].reshape(3, 3).T.copy(),
        )
        return closed, out[5].reshape(2, -1)

    def gain(self) -> Array | None:
        """Return the node displacements (n_e, N, 3) per unit of tip error that leave actuators at their bounds.

        None where they cannot; see :mod:`vgtm_qp.qp.settle`.
        """
        if self._hard:
            return None
        weights, truss = self.layout.weights, self.layout.truss
        response = self._response[: self._actuators].T * self._scale
        gain = settling_gain(
            response, *self._settling, weights.node_rate, weights.actuator_rate + weights.stroke_centring
        )
        if gain is None:
            return None
        nodes = np.zeros((gain.shape[1], truss.node_count, 3))
        nodes[:, truss.free] = (gain.T @ response.T).reshape(gain.shape[1], -1, 3)
        return nodes

    def _reserve(self, rows: int) -> None:
        """Make room for bounds of all unknowns and `rows` less so many constraints."""
        self._constraint = np.zeros((rows - self._size, self._size))
        self._lower, self._upper = np.full(rows, -UNBOUNDED), np.full(rows, UNBOUNDED)
        self._sense = np.zeros(rows, dtype=np.int32)

    def _assemble(self) -> tuple[Array, Array]:
        """Return Hessian and gradient of the objective but for the progress along the path."""
        count, size = self._actuators, self._size
        stack = self._stack
        np.dot(stack * self._soft if self._hard else stack, stack.T, out=self._gram)
        if self._free_curve and not np.array_equal(self._normal, self._constant_normal):
            self._constant = self._constant_hessian()
            self._constant_normal = self._normal.copy()
        elif not self._free_curve and not self._constant[0, 0]:
            self._constant = self._constant_hessian()
        hessian, gradient = self._hessian, self._gradient
        np.add(self._gram[:-1, :-1], self._constant, out=hessian[: size - 1, : size - 1])
        gradient[:-1] = self._gram[-1, :-1]
        gradient[:count] += self._box[2]
        gradient[count:-1] += self._curve_gradient
        if self.layout.vertex_goals:
            gradient[count] += self._goal_pull[1] @ self._normal
            gradient[count + 1 : self._torsion] += self._goal_pull[2:].reshape(-1)
        return hessian, gradient

    def _constant_hessian(self) -> Array:
        """Return the part of the Hessian that only a turning base changes."""
        count, weights = self._actuators, self.layout.weights
        constant = np.zeros((self._size - 1, self._size - 1))
        index = np.arange(count)
        constant[index, index] = weights.actuator_rate + weights.stroke_centring
        if self._free_curve:
            bending, end = self.layout.vertex_hessian, self._torsion
            constant[count, count] = bending[1, 1]
            constant[count, count + 1 : end] = np.kron(bending[1, 2:], self._normal)
            constant[count + 1 :, count] = constant[count, count + 1 :]
            constant[count + 1 : end, count + 1 : end] = np.kron(bending[2:, 2:], np.eye(3))
            constant[end:, end:] = weights.curve_rate * np.eye(self.layout.torsion)
        return constant

    def _spread_rows(self, clearance: ClearanceRows) -> Array:
        """Return the clearance rows (R, 3 (N - N_c)) over the free nodes' displacements."""
        near = len(clearance)
        if len(self._spread) < near:
            self._spread = np.zeros((2 * near, len(self.layout.truss.free) + 1, 3))
        spread = self._spread[:near]
        spread[:] = 0.0
        place, index = self._place[clearance.nodes], np.arange(near)
        for slot in range(place.shape[1]):
            spread[index, place[:, slot]] += clearance.coefficients[:, slot]
        return spread[:, :-1].reshape(near, -1)
