"""Engines: from a configuration through the QP's answer to the next, quantities closed, the tip at its goal.

The fused engine compiles everything between configuration and QP into one call. The general engine linearises
by one compiled call, and serves every arm and solver; the fused engine is tested against it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from functools import cache, cached_property, partial

import numpy as np

from vgtm_qp.arm.arm import Kinematics
from vgtm_qp.arm.symbols import Constants
from vgtm_qp.arrays import Array
from vgtm_qp.compiled import Kernel
from vgtm_qp.errors import EvaluationError, SolverError
from vgtm_qp.qp.answer import Accuracy, Closed, CurvePoint, Move, Settled, StepSolution
from vgtm_qp.qp.condensed import CondensedSolver
from vgtm_qp.qp.full import FullBuilder, StepQP
from vgtm_qp.qp.fused import FusedSolver
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.linearise import Linearisation
from vgtm_qp.qp.numbers import StepNumbers, norm
from vgtm_qp.qp.residual import AnswerError, FailedStepError, InfeasibleStepError
from vgtm_qp.qp.settle import (
    LEFT,
    MOST_STEPS,
    ON_PATH,
    SETTLING_STEPS,
    Gain,
    enough_tip_error,
    held,
    missing_function,
)
from vgtm_qp.qp.solvers import StepSolver
from vgtm_qp.qp.stepper import Stepper
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.closing import Closing
from vgtm_qp.step.target import QPInput, Target
from vgtm_qp.step.task import TipTask

Spent = Callable[[str], None]
"""Adds the time since the last call to a phase."""


class Engine(ABC):
    """Solves the QP of a step and settles where its answer leads."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout

    @property
    def stepper(self) -> Stepper | None:
        """What solves its QPs in whole steps by C, if anything does."""
        return None

    def qp(self, asked: QPInput) -> StepQP:
        """Return the whole QP of an input, every row and column with a name, in new arrays."""
        numbers = self._linearisation.numbers(asked.linear(self.layout), asked.rows)
        qp = self._builder.build(numbers)
        return replace(qp, P=qp.P.copy(), A=qp.A.copy())

    @cached_property
    def _builder(self) -> FullBuilder:
        return FullBuilder(self.layout)

    @cached_property
    def _linearisation(self) -> Linearisation:
        # It is evaluated seldom, for people to read: compiling would take longer.
        return Linearisation(self.layout, compiled=False)

    def move(self, asked: QPInput, accuracy: Accuracy, spent: Spent) -> Move:
        """Return where the answer of a QP leads; ``asked.rows`` then hold the bounds that it was solved with.

        Raises
        ------
        InfeasibleStepError, AnswerError, SolverError
            The QP has no answer, or no accurate one; the first two carry the QP.
        """
        try:
            solution = self._least(asked)
        except EvaluationError:
            raise
        except SolverError as error:
            failed = error if isinstance(error, FailedStepError) else FailedStepError(str(error))
            failed.build = lambda: self.qp(asked)
            raise failed from error.__cause__
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
            if left <= LEFT * arm.fineness:
                # Interior-point solvers stop just short of the end; the arm would need one more step.
                progress = 1.0
        furthest = float(np.abs(solution.nodes).max())
        curve, closed = CurvePoint(asked.vertices, asked.torsion).after(solution), None
        if furthest < np.inf:
            settled = self.settle(q, curve, target, target.goal(progress), accuracy)
            if settled is not None:
                closed, curve = settled
        return Move(solution, q, *curve, progress, furthest, closed)

    def _least(self, asked: QPInput) -> StepSolution:
        """Return the QP's answer; if the margin forbids even a zero step, the answer without the margin.

        Then the bounds in ``asked.rows`` are overwritten by those of the QP that was solved.
        """
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
    def settle(
        self, q: Array, curve: CurvePoint, target: Target, goal: TipGoal, accuracy: Accuracy
    ) -> Settled | None:
        """Return the configuration near `q`, quantities closed and the tip at `goal`, and the curve near `curve`.

        None if another QP is needed.
        """

    def drawn(self, layout: Layout) -> Engine | None:  # noqa: ARG002
        """Return the engine for a layout that differs only in its vertex goals; None if one must be built."""
        return None


Missing = Callable[[Closed, CurvePoint], tuple[Array, float]]
"""Returns the errors of the equalities that are settled, and their norm, m."""

Correction = Callable[[Array, CurvePoint, Array], tuple[Array, CurvePoint] | None]
"""Returns configuration and curve corrected by errors; None where nothing can correct these."""


def settled(
    q: Array,
    curve: CurvePoint,
    accuracy: Accuracy,
    close: Callable[[Array], Closed],
    missing: Missing,
    correct: Correction,
    most: int,
) -> Settled | None:
    """Return where a configuration and its curve are led by closing and by at most that many corrections, in turn."""
    for count in range(most + 1):
        closed = close(q)
        errors, off = missing(closed, curve)
        if not (closed.error <= accuracy.member and off <= accuracy.start):
            return None
        if count == most or off <= enough_tip_error(closed.q, accuracy.tip):
            break
        corrected = correct(closed.q, curve, errors)
        if corrected is None:
            break
        q, curve = corrected
    return Settled(closed, curve) if off <= accuracy.tip else None


class Equalities:
    """Settles configurations and their curves by all equalities of a step."""

    def __init__(self, layout: Layout, kinematics: Kinematics) -> None:
        self._layout, self._closing = layout, Closing(layout, kinematics)

    @cached_property
    def _missing(self) -> Kernel:
        return missing_function(self._layout).kernel(compiled=False)

    def settle(
        self,
        q: Array,
        curve: CurvePoint,
        asked: QPInput,
        goal: TipGoal,
        accuracy: Accuracy,
        first_gain: Callable[[], Gain | None],
    ) -> Settled | None:
        """Return the configuration near `q` and the curve that satisfy all equalities, by Newton steps.

        The Newton steps start with the Jacobian of the QP that was `asked`; their metric is that of its
        objective.
        """
        target, layout, arm = asked.target, self._layout, self._layout.arm
        gain: Gain | None = None
        x = before = np.zeros(0)

        def close(q: Array) -> Closed:
            return self._closing.close(q, target.lower, target.upper, accuracy.member)

        def missing(closed: Closed, curve: CurvePoint) -> tuple[Array, float]:
            errors = self._missing_at(closed.q, curve, asked, goal)
            return errors, norm(layout.levers * errors)

        def correct(q: Array, curve: CurvePoint, errors: Array) -> tuple[Array, CurvePoint] | None:
            nonlocal gain, x, before
            gain = first_gain() if gain is None else gain.updated(x, before - errors)
            if gain is None:
                return None
            x, before = gain.per_missing @ errors, errors
            change = gain.solution(x)
            return arm.advanced(q, change.nodes, change.actuators), curve.after(change)

        return settled(q, curve, accuracy, close, missing, correct, SETTLING_STEPS)

    def _missing_at(self, q: Array, curve: CurvePoint, asked: QPInput, goal: TipGoal) -> Array:
        """Return the errors of the equalities, see ``missing_function``."""
        here = asked._replace(
            q=q, at=q, vertices=curve.vertices, torsion=curve.torsion, goal=goal, motion=False
        )
        here.linear(self._layout, rows=False).load(self._missing)
        self._missing()
        return self._missing.outputs[0].copy()


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
        self._closing, self.equalities = Closing(layout, kinematics), Equalities(layout, kinematics)
        # With hard tracking, stations and fixed quantities may determine the configuration.
        is_plain = layout.hard_tracking and layout.general is None and not layout.hard_turns
        tracked = layout.tracked.tolist()
        self._on_curve = is_plain and layout.arm.symbols(Constants()).follows(tracked)
        self._last: tuple[QPInput, StepNumbers, StepSolution] | None = None
        self._strokes: Array = np.zeros(0)

    @cached_property
    def _condensed(self) -> CondensedSolver:
        return CondensedSolver(self.layout)

    def solve(self, asked: QPInput) -> StepSolution:
        """See :class:`Engine`."""
        numbers = self._linearisation.numbers(asked.linear(self.layout), asked.rows)
        solution = self._solver.solve(numbers)
        self._strokes = self._linearisation.quantities[self.layout.arm.actuators] + solution.actuators
        self._last = asked, numbers, solution
        return solution

    def settle(
        self, q: Array, curve: CurvePoint, target: Target, goal: TipGoal, accuracy: Accuracy
    ) -> Settled | None:
        """See :class:`Engine`; an elastic tip with a slack is not moved."""
        assert self._last is not None
        slack, settled = self._last[2].tip_slack, None
        if slack <= ON_PATH * self.layout.arm.fineness:
            ways = {
                "equalities": self._by_equalities,
                "curve": self._on_its_curve,
                "strokes": self._by_strokes,
            }
            settled = ways[self._solver.settles](q, curve, target, goal, accuracy)
        if settled is not None or slack <= accuracy.tip:
            return settled
        closed = self._closing.close(q, target.lower, target.upper, accuracy.member)
        return Settled(closed, curve) if closed.error <= accuracy.member else None

    def _by_equalities(
        self,
        q: Array,
        curve: CurvePoint,
        _: Target,
        goal: TipGoal,
        accuracy: Accuracy,
    ) -> Settled | None:
        assert self._last is not None
        asked, numbers, solution = self._last
        at_bound = held(solution.actuators, numbers.lower, numbers.upper, self.layout.arm.fineness)
        gain = partial(self._condensed.gain_of, numbers, at_bound)
        return self.equalities.settle(q, curve, asked, goal, accuracy, gain)

    def _on_its_curve(
        self, q: Array, curve: CurvePoint, target: Target, goal: TipGoal, accuracy: Accuracy
    ) -> Settled | None:
        """Return the configuration near `q` with its stations on the curve, if they determine the nodes."""
        bounds = target.lower, target.upper
        closed = None
        if self._on_curve:
            points = self.layout.curve_weights @ curve.vertices
            closed = self._closing.close_on_curve(q, points, *bounds, accuracy.member)
        if closed is None or not closed.error <= accuracy.member:
            closed = self._closing.close(q, *bounds, accuracy.member)
        is_there = self._off(closed, goal) <= accuracy.tip and closed.error <= accuracy.member
        return Settled(closed, curve) if is_there else None

    def _by_strokes(
        self, q: Array, curve: CurvePoint, target: Target, goal: TipGoal, accuracy: Accuracy
    ) -> Settled | None:
        """Return the configuration near `q` with the tip at `goal`: actuators correct the QP's answer."""
        bounds, task, gain = (target.lower, target.upper), self._task, cache(self._gain)
        strokes = np.clip(self._strokes, *bounds)

        def close(q: Array) -> Closed:
            return self._closing.close(q, *(np.clip(strokes, *bounds),) * 2, accuracy.member)

        def missing(closed: Closed, _: CurvePoint) -> tuple[Array, float]:
            tip = closed.tip_position, closed.tip_rotation
            return task.error(*tip, goal), task.off(*tip, goal)

        def correct(q: Array, curve: CurvePoint, error: Array) -> tuple[Array, CurvePoint] | None:
            nonlocal strokes
            if (by_error := gain()) is None:
                return None
            strokes = strokes + by_error @ error
            return q, curve

        return settled(q, curve, accuracy, close, missing, correct, MOST_STEPS)

    def _gain(self) -> Array | None:
        """Return the actuators' changes (n_a, n_e) per tip error after the last QP; None if they cannot settle it."""
        assert self._last is not None
        _, numbers, solution = self._last
        return self._solver.gain(
            held(solution.actuators, numbers.lower, numbers.upper, self.layout.arm.fineness)
        )

    def _off(self, closed: Closed, goal: TipGoal) -> float:
        """Return the norm of the tip's error, m."""
        return self._task.off(closed.tip_position, closed.tip_rotation, goal)


class FusedEngine(Engine):
    """One compiled call, for arms whose coordinates can be eliminated one after another.

    Until the call is compiled, and without a compiler, an interpreted engine gives the same answers.

    Attributes
    ----------
    solver : FusedSolver
    """

    def __init__(self, layout: Layout, kinematics: Kinematics, task: TipTask, solver: FusedSolver) -> None:
        super().__init__(layout)
        self._kinematics, self._task = kinematics, task
        self.solver = solver

    @cached_property
    def _plain(self) -> GeneralEngine:
        solver = CondensedSolver(self.layout, self.solver.solver)
        return GeneralEngine(self.layout, self._kinematics, self._task, solver, compiled=False)

    @property
    def stepper(self) -> Stepper:
        """See :class:`Engine`."""
        return self.solver

    @property
    def is_ready(self) -> bool:
        """Whether the compiled call is there."""
        return self.solver.is_ready

    def drawn(self, layout: Layout) -> FusedEngine:
        """See :class:`Engine`."""
        return FusedEngine(layout, self._kinematics, self._task, self.solver.drawn(layout))

    def move(self, asked: QPInput, accuracy: Accuracy, spent: Spent) -> Move:
        """See :class:`Engine`; one compiled call also settles the answer, if it applies.

        It does not apply if the path bends within the step, or the base moves.
        """
        if not self.solver.is_ready:
            return self._plain.move(asked, accuracy, spent)
        try:
            return self._quick(asked, accuracy, spent)
        except (EvaluationError, AnswerError):
            # The plain engine may have an answer: it uses another version of DAQP, and rounds differently.
            return self._plain.move(asked, accuracy, spent)

    def _quick(self, asked: QPInput, accuracy: Accuracy, spent: Spent) -> Move:
        """Return the move by the compiled call."""
        target, solver = asked.target, self.solver
        solver.aim(accuracy)
        is_straight = target.base is None and target.path.is_straight(target.start, target.end)
        if not is_straight:
            return super().move(asked, accuracy, spent)
        try:
            solver.load(asked.linear(self.layout, nodes=False))
            return solver.move(asked.rows)
        except InfeasibleStepError:
            # The general move may find an answer without the margin.
            return super().move(asked, accuracy, spent)
        finally:
            spent("qp")

    def solve(self, asked: QPInput) -> StepSolution:
        """See :class:`Engine`."""
        self.solver.load(asked.linear(self.layout, nodes=False))
        return self.solver.solve(asked.rows)

    def settle(
        self, q: Array, curve: CurvePoint, target: Target, goal: TipGoal, accuracy: Accuracy
    ) -> Settled | None:
        """See :class:`Engine`."""
        self.solver.aim(accuracy)
        return self.solver.settle(q, curve, target.lower, target.upper, goal)
