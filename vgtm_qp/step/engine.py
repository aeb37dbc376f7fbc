"""What an attempt asks of the QP: where its answer leads, with quantities closed and the tip at its goal.

The fused engine compiles everything between configuration and QP into one call; the general one linearises by one
compiled call, serves every arm and every solver by name, and is what the fused one is tested against.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Kinematics
from vgtm_qp.arm.symbols import Constants
from vgtm_qp.errors import EvaluationError, SolverError
from vgtm_qp.qp.full import FullBuilder, StepQP
from vgtm_qp.qp.fused import Closed, FusedSolver
from vgtm_qp.qp.fused_settle import NEAR
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.linearise import Linearisation
from vgtm_qp.qp.long.sweep import MOST_STEPS
from vgtm_qp.qp.numbers import StepNumbers, StepSolution
from vgtm_qp.qp.residual import FailedStepError, InfeasibleStepError
from vgtm_qp.qp.settle import LEFT, SETTLING_STEPS, held, settling_gain
from vgtm_qp.qp.solvers import StepSolver
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.closing import Closing
from vgtm_qp.step.target import QPInput, Target
from vgtm_qp.step.task import TipTask

Array = NDArray[np.float64]

_SETTLED = 1e-3
"""A tip this much nearer to its goal than it must be gains nothing by another iteration."""

_ROUNDING = float(np.finfo(float).eps)

_ON_PATH = 1e-6
"""Solvers leave slacks of this size, m or rad, where the answer's are zero."""


@dataclass(frozen=True)
class Accuracy:
    """How exactly quantities, and the tip, m or rad, are settled, and from how far off the tip may be brought there."""

    member: float
    tip: float
    start: float


class Move(NamedTuple):
    """Where the answer of one QP leads.

    Attributes
    ----------
    solution : StepSolution
    q : configuration
        By the answer.
    vertices, torsion, progress
        The curve (V, 3), m, and (T,), rad, and the progress along the path.
    furthest : float
        Greatest displacement of a node's coordinate, m.
    closed : Closed or None
        The configuration with its quantities closed and its tip at its goal; None where only another QP leads there.
    """

    solution: StepSolution
    q: Array
    vertices: Array
    torsion: Array
    progress: float
    furthest: float
    closed: Closed | None


Spent = Callable[[str], None]
"""Gives the time since the last call to a phase."""


class Engine(ABC):
    """Solves the QP of a step and settles where its answer leads."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        self._linearisation: Linearisation | None = None
        self._builder: FullBuilder | None = None

    def qp(self, asked: QPInput) -> StepQP:
        """Return the whole QP that an input asks for, every row and column with a name, in arrays of its own."""
        if self._builder is None:
            self._builder = FullBuilder(self.layout)
        return self._builder.build(self._linear.numbers(asked.linear(self.layout), asked.rows))

    @property
    def _linear(self) -> Linearisation:
        if self._linearisation is None:
            # To be looked at, not to be run: no compiler is kept waiting.
            self._linearisation = Linearisation(self.layout, compiled=False)
        return self._linearisation

    def move(self, asked: QPInput, accuracy: Accuracy, spent: Spent) -> Move:
        """Return where the answer of a QP leads.

        Raises
        ------
        InfeasibleStepError, AnswerError, SolverError
            The QP has no answer, or none that is good enough; the first two carry it.
        """
        try:
            try:
                solution = self._least(asked)
            finally:
                spent("qp")
        except FailedStepError as error:
            error.build = lambda: self.qp(asked)
            raise
        arm, target = self.layout.arm, asked.target
        q = arm.advanced(asked.q, solution.nodes, solution.actuators)
        if target.base is not None:
            q = arm.based(q, target.base)
        progress = min(max(asked.progress + solution.progress, 0.0), 1.0)
        if progress < 1.0:
            span, goal = target.end - target.start, asked.goal
            left = (1.0 - progress) * abs(span) * float(np.abs([goal.velocity, goal.spin]).max())
            if left <= LEFT:
                # Interior-point solvers stop just short of the end, and so would the arm, for one more step.
                progress = 1.0
        furthest = float(np.abs(solution.nodes).max())
        closed = None
        if furthest < np.inf:
            closed = self.settle(q, target, target.goal(progress), accuracy)
        curve = asked.vertices + solution.vertices, asked.torsion + solution.torsion
        return Move(solution, q, *curve, progress, furthest, closed)

    def _least(self, asked: QPInput) -> StepSolution:
        """Return the QP's answer; where even a zero step is forbidden by the margin, without the margin."""
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
        """Return the configuration near `q`, its quantities closed and the tip at `goal`; None where a QP is due."""

    def drawn(self, layout: Layout) -> Engine | None:  # noqa: ARG002
        """Return the engine for a layout that differs in its vertex goals alone; None if it is made anew."""
        return None


def enough_tip_error(q: Array, tolerance: float) -> float:
    """Return the tip error, m or rad, that nothing is gained by making smaller; see ``closing.enough_length``."""
    return max(_SETTLED * tolerance, 1e3 * _ROUNDING * float(np.abs(q).max()))


def settle_strokes(
    closed: Closed,
    actuators: NDArray[np.int64],
    close: Callable[[Array, Array, Array], Closed],
    tip_error: Callable[[Closed], Array],
    find_gain: Callable[[], Array | None],
    bounds: tuple[Array, Array],
    accuracy: Accuracy,
) -> Closed | None:
    """Return a configuration near `closed` with the tip at its goal; None where another QP is due.

    Parameters
    ----------
    close
        Closes the quantities near a configuration, with actuators between bounds (n_a,).
    tip_error
        (n_e,) goal minus value, m or rad.
    find_gain
        Asked at most once: (n_a, n_e) changes of the actuators per tip error, or None.
    bounds
        Least and greatest values (n_a,) of the actuators.
    """
    gain: Array | None = None
    wanted = closed.quantities[actuators]
    enough = enough_tip_error(closed.q, accuracy.tip)
    for step in range(MOST_STEPS + 1):
        error = tip_error(closed)
        off = float(np.abs(error).max())
        if not (closed.error <= accuracy.member and off <= accuracy.start):
            return None
        if step == MOST_STEPS or off <= enough:
            break
        gain = find_gain() if gain is None else gain
        if gain is None:
            break
        wanted = wanted + gain @ error
        strokes = np.clip(wanted, *bounds)
        closed = close(closed.q, strokes, strokes)
    return closed if off <= accuracy.tip else None


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
        self._on_curve = _holds_stations(layout)
        self._last: tuple[StepNumbers, StepSolution] | None = None
        self._vertices: Array = np.zeros((0, 3))
        self._strokes: Array = np.zeros(0)

    def solve(self, asked: QPInput) -> StepSolution:
        """See :class:`Engine`."""
        numbers = self._linear.numbers(asked.linear(self.layout), asked.rows)
        solution = self._solver.solve(numbers)
        self._strokes = self._linear.quantities[self.layout.arm.actuators] + solution.actuators
        self._last = numbers, solution
        self._vertices = asked.vertices + solution.vertices
        return solution

    def settle(self, q: Array, target: Target, goal: TipGoal, accuracy: Accuracy) -> Closed | None:
        """See :class:`Engine`; an elastic tip that had to leave its path is not moved."""
        if not self.layout.elastic_tip or self._last is None:
            return self._settled(q, target, goal, accuracy)
        slack = self._last[1].tip_slack
        closed = self._settled(q, target, goal, accuracy) if slack <= _ON_PATH else None
        if closed is not None or slack <= accuracy.tip:
            return closed
        closed = self._closing.close(q, target.lower, target.upper, accuracy.member)
        return closed if closed.error <= accuracy.member else None

    def _settled(self, q: Array, target: Target, goal: TipGoal, accuracy: Accuracy) -> Closed | None:
        bounds = target.lower, target.upper

        def tip_error(closed: Closed) -> Array:
            return self._task.residual(closed.tip_position, closed.tip_rotation, goal)[0]

        def close(q: Array, lower: Array, upper: Array) -> Closed:
            return self._closing.close(q, lower, upper, accuracy.member)

        if self._on_curve:
            points = self.layout.curve_weights @ self._vertices
            on_curve = self._closing.close_on_curve(q, points, *bounds, accuracy.member)
            if on_curve is not None and on_curve.error <= accuracy.member:
                return on_curve if float(np.abs(tip_error(on_curve)).max()) <= accuracy.tip else None
        assert self._last is not None
        numbers, solution = self._last
        at_bound = held(solution.actuators, numbers.lower, numbers.upper)
        if self._solver.knows_gain:
            strokes = np.clip(self._strokes, *bounds)
            first = close(q, strokes, strokes)
            actuators, find_gain = self.layout.arm.actuators, partial(self._solver.gain, at_bound)
            return settle_strokes(first, actuators, close, tip_error, find_gain, bounds, accuracy)
        return self._settled_by_motion(q, goal, bounds, accuracy, ~at_bound)

    def _settled_by_motion(
        self,
        q: Array,
        goal: TipGoal,
        bounds: tuple[Array, Array],
        accuracy: Accuracy,
        free: NDArray[np.bool_],
    ) -> Closed | None:
        """Return the configuration that the least motion brings to the goal, `free` (n_a,) actuators moving."""
        gain = self._gain(free)
        for step in range(SETTLING_STEPS + 1):
            closed = self._closing.close(q, *bounds, accuracy.member)
            error = self._task.residual(closed.tip_position, closed.tip_rotation, goal)[0]
            off = float(np.abs(error).max())
            if not (closed.error <= accuracy.member and off <= accuracy.start):
                return None
            if gain is None or step == SETTLING_STEPS or off <= _SETTLED * accuracy.tip:
                break
            nodes, strokes = gain
            q = self.layout.arm.advanced(closed.q, nodes @ error, strokes @ error)
        return closed if off <= accuracy.tip else None

    def _gain(self, free: NDArray[np.bool_]) -> tuple[Array, Array] | None:
        """Return what settles the tip after the last QP, (N, 3, n_e) and (n_a, n_e); None where another QP has to."""
        layout, arm, weights = self.layout, self.layout.arm, self.layout.weights
        if layout.hard_tracking or self._last is None:
            return None
        numbers, _ = self._last
        try:
            response, _ = numbers.motion.response()
        except SolverError:
            return None
        every = np.zeros((len(arm.node_names), 3, response.shape[1]))
        every[arm.free] = response.reshape(-1, 3, response.shape[1])
        tip = numbers.tip_jacobian @ every[arm.end_effector.nodes].reshape(-1, response.shape[1])
        gain = settling_gain(
            response, tip, free, weights.node_rate, weights.actuator_rate + weights.stroke_centring
        )
        return None if gain is None else (every @ gain, gain)


def _holds_stations(layout: Layout) -> bool:
    """Whether stations that are held on the curve determine the configuration with the fixed quantities."""
    is_plain = layout.hard_tracking and layout.general is None and not layout.hard_turns
    return is_plain and layout.arm.symbols(Constants()).held(layout.tracked.tolist()) is not None


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
        """See :class:`Engine`: by one call after the QP, where that serves.

        It does not where the path turns within the step, the base moves, or too many rows are near.
        """
        near, target = len(asked.rows), asked.target
        if near > NEAR or target.base is not None or not target.path.is_straight(target.start, target.end):
            return super().move(asked, accuracy, spent)
        try:
            self._solver.load(asked.linear(self.layout))
            answer = self._solver.ask(asked.rows)
        except InfeasibleStepError:
            # Whether that is for the margin alone is found out where it can be left out.
            return super().move(asked, accuracy, spent)
        spent("qp")
        try:
            taken = self._solver.take(answer, near)
        except EvaluationError:
            # The answer may still be good, and be settled by other steps.
            return super().move(asked, accuracy, spent)
        except FailedStepError as error:
            error.build = lambda: self.qp(asked)
            raise
        is_settled = (
            taken.closed.error <= accuracy.member
            and taken.before <= accuracy.start
            and taken.after <= accuracy.tip
        )
        torsion = asked.torsion + taken.solution.torsion if len(asked.torsion) else asked.torsion
        closed = taken.closed if is_settled else None
        return Move(taken.solution, taken.q, taken.vertices, torsion, taken.progress, taken.moved, closed)

    def solve(self, asked: QPInput) -> StepSolution:
        """See :class:`Engine`."""
        self._solver.load(asked.linear(self.layout))
        solution = self._solver.solve(asked.rows)
        self._vertices = asked.vertices + solution.vertices
        return solution

    def settle(self, q: Array, target: Target, goal: TipGoal, accuracy: Accuracy) -> Closed | None:
        """See :class:`Engine`."""
        closed, before, after = self._solver.settle(
            q, self._vertices, target.lower, target.upper, goal.position, goal.rotation
        )
        if closed.error <= accuracy.member and before <= accuracy.start and after <= accuracy.tip:
            return closed
        return None
