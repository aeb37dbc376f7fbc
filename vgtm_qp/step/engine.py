"""Engines: from a configuration through the QP's answer to the next one, quantities closed and the tip at its goal.

The fused engine compiles everything between configuration and QP into one call. The general one linearises by one
compiled call and serves every arm and solver; the fused engine is tested against it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property

import numpy as np

from vgtm_qp.arm.arm import Kinematics
from vgtm_qp.arm.symbols import Constants
from vgtm_qp.arrays import Array
from vgtm_qp.errors import EvaluationError, SolverError
from vgtm_qp.qp.answer import Accuracy, Closed, Move, StepSolution
from vgtm_qp.qp.full import FullBuilder, StepQP
from vgtm_qp.qp.fused import FusedSolver
from vgtm_qp.qp.fused_settle import NEAR
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.linearise import Linearisation
from vgtm_qp.qp.numbers import StepNumbers
from vgtm_qp.qp.residual import FailedStepError, InfeasibleStepError
from vgtm_qp.qp.settle import LEFT, SETTLING_STEPS, held, settling_gain
from vgtm_qp.qp.solvers import StepSolver
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.closing import MOST_STEPS, Closing
from vgtm_qp.step.target import QPInput, Target
from vgtm_qp.step.task import TipTask, over_all_nodes, tip_response

_SETTLED = 1e-3
"""Ratio of tip error to tolerance below which settling stops."""

_ROUNDING = float(np.finfo(float).eps)

_ON_PATH = 1e-6
"""Slack, m or rad, that counts as zero: solvers leave so much."""


Spent = Callable[[str], None]
"""Adds the time since the last call to a phase."""


class Engine(ABC):
    """Solves the QP of a step and settles where its answer leads."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout

    def qp(self, asked: QPInput) -> StepQP:
        """Return the whole QP of an input, every row and column with a name, in new arrays."""
        numbers = self._linearisation.numbers(asked.linear(self.layout), asked.rows)
        return self._builder.build(numbers)

    @cached_property
    def _builder(self) -> FullBuilder:
        return FullBuilder(self.layout)

    @cached_property
    def _linearisation(self) -> Linearisation:
        # Built once to be read: compiling would take longer.
        return Linearisation(self.layout, compiled=False)

    def move(self, asked: QPInput, accuracy: Accuracy, spent: Spent) -> Move:
        """Return where the answer of a QP leads.

        Raises
        ------
        InfeasibleStepError, AnswerError, SolverError
            The QP has no answer, or no accurate one; the first two carry the QP.
        """
        try:
            solution = self._least(asked)
        except FailedStepError as error:
            error.build = lambda: self.qp(asked)
            raise
        finally:
            spent("qp")
        arm, target = self.layout.arm, asked.target
        q = arm.advanced(asked.q, solution.nodes, solution.actuators)
        if target.base is not None:
            q = arm.based(q, target.base)
        progress = min(max(asked.progress + solution.progress, 0.0), 1.0)
        if progress < 1.0:
            span, goal = target.end - target.start, asked.goal
            left = (1.0 - progress) * abs(span) * float(np.abs([goal.velocity, goal.spin]).max())
            if left <= LEFT:
                # Interior-point solvers stop just short of the end; the arm would need one more step.
                progress = 1.0
        furthest = float(np.abs(solution.nodes).max())
        closed = None
        if furthest < np.inf:
            closed = self.settle(q, target, target.goal(progress), accuracy)
        curve = asked.vertices + solution.vertices, asked.torsion + solution.torsion
        return Move(solution, q, *curve, progress, furthest, closed)

    def _least(self, asked: QPInput) -> StepSolution:
        """Return the QP's answer; if the margin forbids even a zero step, the answer without the margin."""
        rows = asked.rows
        try:
            return self.solve(asked)
        except InfeasibleStepError:
            if not asked.motion or not len(rows) or rows.lower.max() <= 0.0:
                raise
        np.minimum(rows.lower, 0.0, out=rows.lower)
        return self.solve(asked)

    @abstractmethod
    def solve(self, asked: QPInput) -> StepSolution:
        """Return the QP's answer; raise ``SolverError`` instead of a wrong one."""

    @abstractmethod
    def settle(self, q: Array, target: Target, goal: TipGoal, accuracy: Accuracy) -> Closed | None:
        """Return the configuration near `q`, quantities closed and the tip at `goal`; None if it takes another QP."""

    def drawn(self, layout: Layout) -> Engine | None:  # noqa: ARG002
        """Return the engine for a layout that differs only in its vertex goals; None if one must be built."""
        return None


def enough_tip_error(q: Array, tolerance: float) -> float:
    """Return the tip error, m or rad, at which settling stops; see ``closing.enough_length``."""
    return max(_SETTLED * tolerance, 1e3 * _ROUNDING * float(np.abs(q).max()))


class GeneralEngine(Engine):
    """One compiled linearisation, and a solver by name."""

    def __init__(
        self,
        layout: Layout,
        kinematics: Kinematics,
        task: TipTask,
        solver: StepSolver,
        *,
        compiled: bool = True,
    ) -> None:
        super().__init__(layout)
        self._linearisation = Linearisation(layout, compiled=compiled)
        self._solver, self._task = solver, task
        self._closing = Closing(layout, kinematics)
        # With hard tracking, stations and fixed quantities may determine the configuration.
        is_plain = layout.hard_tracking and layout.general is None and not layout.hard_turns
        tracked = layout.tracked.tolist()
        self._on_curve = is_plain and layout.arm.symbols(Constants()).held(tracked) is not None
        self._last: tuple[StepNumbers, StepSolution] | None = None
        self._vertices: Array = np.zeros((0, 3))
        self._strokes: Array = np.zeros(0)

    def solve(self, asked: QPInput) -> StepSolution:
        """See :class:`Engine`."""
        numbers = self._linearisation.numbers(asked.linear(self.layout), asked.rows)
        solution = self._solver.solve(numbers)
        self._strokes = self._linearisation.quantities[self.layout.arm.actuators] + solution.actuators
        self._last = numbers, solution
        self._vertices = asked.vertices + solution.vertices
        return solution

    def settle(self, q: Array, target: Target, goal: TipGoal, accuracy: Accuracy) -> Closed | None:
        """See :class:`Engine`; an elastic tip with a slack is not moved."""
        assert self._last is not None
        slack = self._last[1].tip_slack
        closed = self._settled(q, target, goal, accuracy) if slack <= _ON_PATH else None
        if closed is not None or slack <= accuracy.tip:
            return closed
        closed = self._closing.close(q, target.lower, target.upper, accuracy.member)
        return closed if closed.error <= accuracy.member else None

    def _settled(self, q: Array, target: Target, goal: TipGoal, accuracy: Accuracy) -> Closed | None:
        """Return the configuration near `q` with the tip at `goal`, by Newton steps with a constant Jacobian.

        If the solver has a gain, actuators start from its answer and correct the tip by the gain. Otherwise they follow
        the least motion of the nodes that moves the tip.
        """
        arm, bounds = self.layout.arm, (target.lower, target.upper)
        if self._on_curve:
            points = self.layout.curve_weights @ self._vertices
            on_curve = self._closing.close_on_curve(q, points, *bounds, accuracy.member)
            if on_curve is not None and on_curve.error <= accuracy.member:
                error = self._task.error(on_curve.tip_position, on_curve.tip_rotation, goal)
                return on_curve if float(np.abs(error).max()) <= accuracy.tip else None
        by_strokes, gain, box = self._solver.knows_gain, None, bounds
        most = MOST_STEPS if by_strokes else SETTLING_STEPS
        strokes = np.clip(self._strokes, *bounds)
        for step in range(most + 1):
            if by_strokes:
                box = (np.clip(strokes, *bounds),) * 2
            closed = self._closing.close(q, *box, accuracy.member)
            error = self._task.error(closed.tip_position, closed.tip_rotation, goal)
            off = float(np.abs(error).max())
            if not (closed.error <= accuracy.member and off <= accuracy.start):
                return None
            if step == most or off <= enough_tip_error(closed.q, accuracy.tip):
                break
            gain = self._gain() if gain is None else gain
            if gain is None:
                break
            nodes, per_error = gain
            strokes, q = strokes + per_error @ error, closed.q
            if nodes is not None:
                q = arm.advanced(q, nodes @ error, per_error @ error)
        return closed if off <= accuracy.tip else None

    def _gain(self) -> tuple[Array | None, Array] | None:
        """Return displacements per tip error after the last QP; None if another QP has to settle the tip.

        Those of the nodes (N, 3, n_e), None if only the solver's gain is known, and those of the actuators (n_a, n_e).
        """
        assert self._last is not None
        layout, arm, weights, (numbers, solution) = (
            self.layout,
            self.layout.arm,
            self.layout.weights,
            self._last,
        )
        at_bound = held(solution.actuators, numbers.lower, numbers.upper)
        if self._solver.knows_gain:
            gain = self._solver.gain(at_bound)
            return None if gain is None else (None, gain)
        if layout.hard_tracking:
            return None
        try:
            response, _ = numbers.motion.response()
        except SolverError:
            return None
        every = over_all_nodes(arm, response)
        tip = tip_response(arm, numbers.tip_jacobian, every)
        stiffness = weights.actuator_rate + weights.stroke_centring
        gain = settling_gain(response, tip, ~at_bound, weights.node_rate, stiffness)
        return None if gain is None else (every @ gain, gain)


class FusedEngine(Engine):
    """One compiled call from configuration to QP, for arms whose coordinates can be eliminated one after another."""

    def __init__(self, layout: Layout, solver: FusedSolver | None = None) -> None:
        super().__init__(layout)
        self._solver = FusedSolver(layout) if solver is None else solver
        self._vertices = np.zeros((layout.vertices, 3))

    def drawn(self, layout: Layout) -> FusedEngine:
        """See :class:`Engine`."""
        return FusedEngine(layout, self._solver.drawn(layout))

    def move(self, asked: QPInput, accuracy: Accuracy, spent: Spent) -> Move:
        """See :class:`Engine`; one compiled call after the QP settles its answer, if it applies.

        It does not apply if the path turns within the step, the base moves, or too many rows are near.
        """
        near, target = len(asked.rows.lower), asked.target
        if near > NEAR or target.base is not None or not target.path.is_straight(target.start, target.end):
            return super().move(asked, accuracy, spent)
        try:
            self._solver.load(asked.linear(self.layout))
            answer = self._solver.ask(asked.rows)
            spent("qp")
            return self._solver.move(answer, near, asked.torsion, accuracy)
        except (InfeasibleStepError, EvaluationError):
            # The general way may find an answer without the margin, or settle this one by more steps.
            return super().move(asked, accuracy, spent)
        except FailedStepError as error:
            error.build = lambda: self.qp(asked)
            raise

    def solve(self, asked: QPInput) -> StepSolution:
        """See :class:`Engine`."""
        self._solver.load(asked.linear(self.layout))
        solution = self._solver.solve(asked.rows)
        self._vertices = asked.vertices + solution.vertices
        return solution

    def settle(self, q: Array, target: Target, goal: TipGoal, accuracy: Accuracy) -> Closed | None:
        """See :class:`Engine`."""
        return self._solver.settle(q, self._vertices, target.lower, target.upper, goal, accuracy)
