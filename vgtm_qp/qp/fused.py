"""The fast path of a step: one compiled call linearises and condenses, BLAS makes the Hessian, a dense solver solves.

It answers the same QP as :mod:`vgtm_qp.qp.condensed`, in 10 to 20 times less time for short arms.
"""

from __future__ import annotations

import copy

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from vgtm_qp.arrays import Array
from vgtm_qp.qp.answer import Accuracy, Closed, Move, StepSolution
from vgtm_qp.qp.daqp import DAQP
from vgtm_qp.qp.dense import EQUALITY, DenseAnswer, DenseSolver, check
from vgtm_qp.qp.fused_rows import row_function
from vgtm_qp.qp.fused_settle import NEAR, settle_function
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.linearise import StepInput
from vgtm_qp.qp.numbers import UNBOUNDED, ClearanceRows, Legs
from vgtm_qp.qp.residual import refuse_large
from vgtm_qp.rows.curve import free_basis
from vgtm_qp.rows.tip import TipGoal

_AXES = np.arange(3)
_NOWHERE: Array = np.zeros((0, 3))


class _Room:
    """Rows and bounds of the QP that compiled functions write and read; solvers with the same functions share them."""

    constraint: Array
    lower: Array
    upper: Array
    sense: NDArray[np.int32]
    row_start: NDArray[np.int64]
    used: int


class FusedSolver:
    """Linearises, condenses and solves; for arms whose symbols ``can_eliminate``."""

    def __init__(self, layout: Layout, solver: DenseSolver = DAQP) -> None:
        arm, self._solver = layout.arm, solver
        self._rows = row_function(layout).kernel()
        nodes, actuators = layout.node_columns, len(arm.actuators)
        self._actuators = actuators
        self._free_curve = layout.free_curve
        self._size = size = actuators + self._free_curve + 1
        self._torsion = size - 1 - layout.torsion
        self._shape = arm.home_configuration.shape
        self._tip = len(layout.tip_rows)
        self._hard = len(layout.hard)
        self._equal, self._legs = self._tip + self._hard, len(layout.legs)
        self._hard_at = nodes + layout.hard
        out = self._rows.outputs
        self._stack = out[0].reshape(size, -1)
        self._response = self._stack[:, :nodes]
        self._linear, self._curvature = out[4], out[5]
        self._offset, self._normal = out[6].reshape(layout.vertices, 3), out[7]
        self._hessian = np.zeros((size, size))
        self._gradient = np.zeros(size)
        self._constant = np.zeros((size, size))
        self._scale = 1.0 / np.sqrt(layout.weights.node_rate)
        self._width = nodes + 3
        self._place = 3 * np.where(arm.base, len(arm.free), layout.node_column // 3)
        self._settled = settled = settle_function(layout).kernel()
        for argument, shared in enumerate((0, 4, 5, 8, 9, 10, 11, 7)):
            settled.bind_input(argument, self._rows.inputs[shared])
        for argument, result in ((8, 0), (12, 6), (13, 7)):
            settled.bind_input(argument, out[result])
        settled.bind_input(14, self._rows.inputs[3])
        settled.bind_input(15, self._hessian)
        settled.bind_input(16, self._gradient)
        self._answer, self._multipliers = settled.inputs[17], settled.inputs[18]
        self._gram, self._follows = settled.inputs[19].reshape(actuators, actuators), settled.inputs[20]
        self._room = _Room()
        self._reserve(size + self._equal + self._legs + NEAR)
        self._draw(layout)
        if self._hard:
            self._elastic = np.ones(self._stack.shape[1])
            self._elastic[self._hard_at] = 0.0

    def drawn(self, layout: Layout) -> FusedSolver:
        """Return the solver of a layout in which only other control vertices have goals; buffers are shared."""
        other = copy.copy(self)
        other._draw(layout)
        return other

    def _draw(self, layout: Layout) -> None:
        self.layout = layout
        self._goal_pull = np.zeros((layout.vertices, 3))
        self._goal_weight = (
            np.isin(np.arange(layout.vertices), layout.vertex_goals) * layout.weights.vertex_goal
        )
        self._constant = np.zeros((self._size, self._size))
        self._constant_normal = b""

    def load(self, asked: StepInput) -> None:
        """Linearise and condense."""
        asked.load(self._rows)
        self._vertices = asked.vertices
        self._rows()
        if self.layout.vertex_goals:
            self._goal_pull = self._goal_weight[:, None] * self._offset
            if asked.motion:
                self._goal_pull += self.layout.goal_pull(asked.vertices, asked.vertex_goals)

    def solve(self, clearance: ClearanceRows) -> StepSolution:
        """Solve the QP at the configuration loaded last.

        Raises
        ------
        InfeasibleStepError, SolverError
            As ``CondensedSolver.solve``.
        """
        answer = self.ask(clearance)
        x, rows = answer.x, self._equal + self._legs + len(clearance)
        bounds = self._room.lower[: self._size + rows], self._room.upper[: self._size + rows]
        check(answer, self._hessian, self._gradient, self._room.constraint[:rows], *bounds)
        count = self._actuators
        nodes = np.zeros((len(self.layout.arm.node_names), 3))
        moved = np.dot(x[:count], self._response[:count])
        moved += self._response[-1]
        moved *= self._scale
        nodes[self.layout.arm.free] = moved.reshape(-1, 3)
        vertices = self._offset.copy()
        if self._free_curve:
            vertices[1] += self._normal * x[count]
            vertices[2:] += x[count + 1 : self._torsion].reshape(-1, 3)
        return self._solution(answer, len(clearance), nodes, vertices)

    def _solution(self, answer: DenseAnswer, near: int, nodes: Array, vertices: Array) -> StepSolution:
        x, multipliers, count = answer.x, answer.multipliers, self._actuators
        return StepSolution(
            nodes=nodes,
            actuators=x[:count],
            vertices=vertices,
            progress=float(x[-1]),
            actuator_multipliers=multipliers[:count],
            clearance_multipliers=-multipliers[len(multipliers) - near :],
            iterations=answer.iterations,
            torsion=x[self._torsion : -1],
        )

    def ask(self, clearance: ClearanceRows) -> DenseAnswer:
        """Return the answer to the QP at the configuration loaded last, not checked yet.

        Raises
        ------
        InfeasibleStepError
            The hard rows contradict one another.
        AnswerError
            The solver failed.
        """
        size, count, hard, near = self._size, self._actuators, self._hard, len(clearance.lower)
        hessian, gradient = self._assemble()
        first = self._equal + self._legs
        rows = first + near
        if size + rows > len(self._room.lower):
            self._reserve(2 * (size + rows))
        constraint, lower, upper = self._room.constraint[:rows], self._room.lower, self._room.upper
        if hard:
            block = self._stack[:, self._hard_at]
            constraint[self._tip : self._equal, :-1] = block[:-1].T
            held = slice(size + self._tip, size + self._equal)
            upper[held] = lower[held] = -block[-1]
        if self._legs:
            axes, least = Legs.at(self.layout, self._vertices, self._normal)
            if self._legs > 1:
                # Control vertices come after the leg at the base.
                last = self._torsion - 6
                constraint[self._equal + 1, last : last + 6] = np.concatenate([-axes[1], axes[1]])
            lower[size + self._equal : size + first] = least
        if near:
            moved = np.dot(self._spread_rows(clearance), self._response.T)
            moved *= self._scale
            constraint[first:, :count] = moved[:, :count]
            np.subtract(clearance.lower, moved[:, -1], out=lower[size + first : size + rows])
        self._room.used, before = size + rows, self._room.used
        if before > size + rows:
            lower[size + rows : before] = -UNBOUNDED
        answer = self._solver.ask(
            hessian,
            gradient,
            constraint,
            lower[: size + rows],
            upper[: size + rows],
            self._room.sense[: size + rows],
        )
        self._answer[:] = answer.x
        return answer

    def move(self, answer: DenseAnswer, near: int, torsion: Array, accuracy: Accuracy) -> Move:
        """Return where an answer of :meth:`ask` leads; its QP had `near` clearance rows, at most ``NEAR``.

        The solution's ``nodes`` and ``vertices`` are left empty. `torsion` (T,) is the curve's before the step, rad.

        Raises
        ------
        AnswerError
            The answer's residuals are too large.
        """
        multipliers, count = answer.multipliers, len(answer.multipliers)
        self._multipliers[:count] = multipliers
        self._multipliers[count:] = 0.0
        self._settle(1.0)
        out = self._settled.outputs
        error, before, after, progress, moved, primal, dual = out[5].tolist()
        refuse_large(primal, dual, answer.status)
        solution = self._solution(answer, near, _NOWHERE, _NOWHERE)
        torsion = torsion + solution.torsion if len(torsion) else torsion
        q, vertices = out[6].reshape(self._shape).copy(), out[4].reshape(-1, 3).copy()
        closed = self._closed(error, before, after, accuracy)
        return Move(solution, q, vertices, torsion, progress, moved, closed)

    def settle(
        self, q: Array, vertices: Array, lower: Array, upper: Array, goal: TipGoal, accuracy: Accuracy
    ) -> Closed | None:
        """Return configuration `q` with quantities closed, actuators in their boxes (n_a,) and the tip at `goal`.

        With hard tracking, stations are held on the curve of control vertices `vertices` (V, 3), m. None if the
        iteration does not converge.
        """
        inputs = self._settled.inputs
        inputs[0][:] = q.reshape(-1)
        inputs[1][:] = lower
        inputs[2][:] = upper
        inputs[3][:] = goal.position
        inputs[4][:] = goal.rotation.T.reshape(-1)
        inputs[14][:] = vertices.reshape(-1)
        self._settle(0.0)
        error, before, after = self._settled.outputs[5][:3].tolist()
        return self._closed(error, before, after, accuracy)

    def _settle(self, follows: float) -> None:
        """Settle the configuration after the answer, or with `follows` = 0 the one that was loaded."""
        if not self.layout.hard_tracking:
            response = self._response[: self._actuators]
            np.dot(response, response.T, out=self._gram)
        self._follows[0] = follows
        self._settled()

    def _closed(self, error: float, before: float, after: float, accuracy: Accuracy) -> Closed | None:
        """Return the settled configuration; None if a quantity or the tip is not exact enough, m and rad."""
        if not (error <= accuracy.member and before <= accuracy.start and after <= accuracy.tip):
            return None
        q, quantities, position, rotation = self._settled.outputs[:4]
        return Closed(
            q.reshape(self._shape).copy(),
            quantities.copy(),
            error,
            position.copy(),
            rotation.reshape(3, 3).T.copy(),
        )

    def _reserve(self, rows: int) -> None:
        """Make room for `rows` bounds, those of the unknowns first, and for the constraints behind these."""
        size, equal = self._size, self._size + self._equal
        self._room.constraint = np.zeros((rows - size, size))
        self._room.lower, self._room.upper = np.full(rows, -UNBOUNDED), np.full(rows, UNBOUNDED)
        self._room.sense = np.zeros(rows, dtype=np.int32)
        self._room.row_start = self._width * np.arange(rows - size)[:, None, None]
        self._room.sense[size:equal] = EQUALITY
        if self._legs:
            # The first leg is the first of the curve's free coordinates.
            self._room.constraint[self._equal, self._actuators] = 1.0
        tip_rows = self._room.constraint[: self._tip].reshape(-1)
        bounds = (values[: size + self._tip] for values in (self._room.lower, self._room.upper))
        for result, array in enumerate((tip_rows, *bounds), start=1):
            array[:] = self._rows.outputs[result]
            self._rows.bind_output(result, array)
        checked = equal + self._legs + NEAR
        self._room.used = checked
        for argument, array in (
            (9, self._room.constraint[: checked - size]),
            (10, self._room.lower),
            (11, self._room.upper),
        ):
            self._settled.bind_input(argument, array.reshape(-1)[: self._settled.inputs[argument].size])

    def _assemble(self) -> tuple[Array, Array]:
        """Return Hessian and gradient of the objective."""
        count, stack = self._actuators, self._stack
        hessian, gradient, linear = self._hessian, self._gradient, self._linear
        np.dot(stack * self._elastic if self._hard else stack, stack.T, out=hessian)
        np.add(hessian[-1], linear, out=gradient)
        gradient[-1] = linear[-1]
        if self.layout.vertex_goals:
            gradient[count] += self._goal_pull[1] @ self._normal
            gradient[count + 1 : self._torsion] += self._goal_pull[2:].reshape(-1)
        if self._normal.tobytes() != self._constant_normal:
            self._constant[:-1, :-1] = self._constant_hessian()
            self._constant_normal = self._normal.tobytes()
        hessian[-1] = 0.0
        hessian[:, -1] = 0.0
        self._constant[-1, -1] = self._curvature[0]
        hessian += self._constant
        return hessian, gradient

    def _constant_hessian(self) -> Array:
        """Return the part of the Hessian that changes only when the base turns."""
        layout, weights = self.layout, self.layout.weights
        basis = free_basis(self._normal, 3 * layout.vertices + layout.torsion)
        of_curve = basis.T @ layout.curve_hessian @ basis
        of_actuators = (weights.actuator_rate + weights.stroke_centring) * np.eye(self._actuators)
        return np.asarray(block_diag(of_actuators, of_curve))

    def _spread_rows(self, clearance: ClearanceRows) -> Array:
        """Return the clearance rows (R, 3 (N - N_c)) over the free nodes' displacements."""
        near, width = len(clearance), self._width
        flat = self._place[clearance.nodes][:, :, None] + _AXES
        flat += self._room.row_start[:near]
        # Entries at one place are added up: a row may name a node twice.
        spread = np.bincount(flat.reshape(-1), clearance.coefficients.reshape(-1), near * width)
        return np.asarray(spread.reshape(near, width)[:, :-3], dtype=float)
