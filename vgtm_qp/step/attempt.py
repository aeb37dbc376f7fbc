"""One attempt at a step: QPs and their corrections until every constraint holds, then the proof between the states."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import EvaluationError, SolverError
from vgtm_qp.qp.answer import Accuracy, Closed, Move, StepSolution
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.qp.residual import AnswerError, FailedStepError, InfeasibleStepError
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.acceptance import Acceptance, TrackingError
from vgtm_qp.step.actuation import Actuation
from vgtm_qp.step.engine import Engine
from vgtm_qp.step.separation import RECOVERY, Separation
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import Shortfall, State
from vgtm_qp.step.step import WHOLE, Step, StepStatus
from vgtm_qp.step.target import QPInput, Target

_MOST_QPS = 8

_MOST_FRACTIONS = 8
"""Times between two states for which a QP has rows, at most."""

_MOTION_MARGIN = 2.5
"""A body may move by so many times what is expected of it before a pair that matters can be missed."""

_TOO_FAR = 1e3
"""No answer of a QP that moves a node by so many times the arm's length means anything: the pose is singular."""

_DEVIATION = 0.1
"""An arm whose points may leave their chords by more than this turns too far in one step, m."""

_SETTLING = 5e-3
"""A tip that is further off than this share of the arm's length after a QP calls for another one."""

_FURTHER = 1e-6
"""Stations leave the curve for so much progress more, at least."""

_ROUNDING = float(np.finfo(float).eps)


class Phases:
    """Seconds spent in each of the phases of a step, by their names."""

    def __init__(self, *names: str) -> None:
        self.seconds = dict.fromkeys(names, 0.0)
        self.start()

    def start(self) -> None:
        """Begin to count."""
        self._mark = perf_counter()

    def add(self, phase: str) -> None:
        """Add the time since the last call to `phase`."""
        now = perf_counter()
        self.seconds[phase] += now - self._mark
        self._mark = now


class Attempt:
    """Tries one piece of path from one state; keeps the workspaces."""

    def __init__(self, setup: Setup, separation: Separation, actuation: Actuation) -> None:
        self._arm, self._influence = setup.arm, setup.influence
        self._has_limit, self._too_long = setup.step_limit < np.inf, setup.too_long
        self.separation = separation
        self.phases = Phases("distance", "qp", "correction", "acceptance")
        # Divided by the time twice, what is left of a length is an acceleration; but no less than rounding leaves.
        exact = max(1e-12, 32.0 * _ROUNDING * setup.arm.height)
        member = 1e-10 if actuation.starts_at_once else exact
        self.accuracy = Accuracy(member, tip=1e-8, start=_SETTLING * setup.arm.height)
        self.acceptance = Acceptance(setup, self.accuracy)
        self.use(setup)

    def use(self, setup: Setup) -> None:
        """Go on with the curve of another `setup` of the arm."""
        layout = setup.layout
        self._setup = setup
        self._tracking = TrackingError(layout, setup.kinematics) if layout.hard_tracking else None

    def run(self, state: State, target: Target, share: float = 1.0, *, progress: float = 0.0) -> Step:
        """Return what a step from `state` along the target's piece of path does, with its progress on that.

        `share` is the length of the piece as a part of the step before: it scales the motion guessed from that.
        `progress` is how much of the piece lies behind the tip at the start. Where stations that are to be on the curve
        hold the arm back they give way, if they may, and if it comes further then.
        """
        self.phases.start()
        step = self._separated(state, target, share, progress, self._setup.engine, self._tracking)
        if self._setup.elastic is None or (step.moved and step.progress >= WHOLE):
            return step
        other = self._separated(state, target, share, progress, self._setup.elastic(), None)
        return other if not step.moved or other.progress > step.progress + _FURTHER else step

    def _separated(
        self,
        state: State,
        target: Target,
        share: float,
        progress: float,
        engine: Engine,
        tracking: TrackingError | None,
    ) -> Step:
        """Return the step of an engine, which drives pairs apart that are too near; without that where it fails."""
        short = self.separation.shortfall_of(state)
        for gain in (RECOVERY, 0.0) if short else (0.0,):
            asked, reach = self._first(state, target, share, progress, short, gain)
            step = self._run(state, asked, reach, short, gain, engine, tracking)
            if step.moved:
                break
        return step

    def first_input(self, state: State, target: Target) -> QPInput:
        """Return what the first QP of a step from `state` is linearised at."""
        short = self.separation.shortfall_of(state)
        return self._first(state, target, 1.0, 0.0, short, RECOVERY if short else 0.0)[0]

    def _first(
        self, state: State, target: Target, share: float, progress: float, short: Shortfall, gain: float
    ) -> tuple[QPInput, float]:
        """Return the first input, and the distance, m, from which on no pair can become active."""
        q, arm, goal, guess = state.q, self._arm, target.goal(progress), share * state.motion
        reach = self._influence
        if share >= 1.0:
            reach = _MOTION_MARGIN * self._expected(target, goal, guess)
        rows = self.separation.rows(q, state.time, target.time - state.time, reach, short, gain)
        if target.base is not None:
            # What the base's own motion does to the rows is known.
            rows = rows.after(arm.nodes(arm.based(q, target.base)) - arm.nodes(q))
        curve = state.control_vertices, state.torsion
        return QPInput(q, q + 0.5 * guess, *curve, target, goal, progress, rows, True), reach

    def _run(
        self,
        state: State,
        asked: QPInput,
        reach: float,
        short: Shortfall,
        gain: float,
        engine: Engine,
        tracking: TrackingError | None,
    ) -> Step:
        """Run it from its first input; pairs that are too near at the start, `short`, are driven apart by `gain`, m."""
        phases, separation, target = self.phases, self.separation, asked.target
        q, fractions = state.q, list[float]()
        solution: StepSolution | None = None
        rows: ClearanceRows | None = None
        move: Move | None = None

        def blocked(
            reason: str, failure: FailedStepError | None = None, *, solver_failed: bool = False
        ) -> Step:
            kept = Step(StepStatus.BLOCKED, 0.0, state, reason, count, solver_failed)
            return replace(kept, solution=solution, rows=rows, failure=failure)

        for count in range(1, _MOST_QPS + 1):
            if move is not None:
                near = separation.rows(q, target.time, 0.0, reach, short, gain)
                near = separation.with_rows_between(near, state, q, target.time, fractions)
                at = q, q, move.vertices, move.torsion
                asked = QPInput(*at, target, target.goal(move.progress), move.progress, near, False)
            phases.add("distance")
            try:
                move = engine.move(asked, self.accuracy, phases.add)
            except AnswerError as error:
                return blocked(str(error), error, solver_failed=True)
            except EvaluationError as error:
                return blocked(str(error), solver_failed=True)
            except InfeasibleStepError as error:
                return blocked("no displacement keeps all limits and clearances", error)
            except SolverError as error:
                return blocked(str(error))
            finally:
                phases.add("correction")
            if solution is None:
                solution, rows = move.solution, asked.rows
            q = move.q
            is_finite = move.closed is not None or np.isfinite(q).all()
            if not move.furthest < _TOO_FAR * self._arm.height or not is_finite:
                return blocked("singular pose")
            # A pair that one correction pushes away must still be there in the next, or two of them alternate.
            reach = max(reach, move.furthest)
            if move.closed is None:
                continue
            flaw = self._flaw(state, target, move, move.closed)
            if flaw:
                return blocked(flaw, solver_failed=True)
            q, closed = move.closed.q, move.closed
            # The linear rows leave a little between the curve's end and the tip.
            vertices = engine.layout.ended(move.vertices, closed.tip_position, closed.tip_rotation)
            if tracking is not None:
                gap = tracking.greatest(q, vertices, move.torsion, target.base)
                if not gap <= self.accuracy.tracking:
                    continue
            report, after = separation.proof(state, q, target.time, short)
            phases.add("acceptance")
            if after is None:
                continue
            if not separation.deviation(state.q, q) < _DEVIATION:
                return blocked("the arm turns too far in one step")
            if self._has_limit and (too_long := self._too_long(self._arm.nodes(q) - state.nodes)):
                return blocked(too_long)
            if report.certified:
                then = state.next(self._arm, target.time, closed, vertices, move.torsion, after)
                status = StepStatus.REACHED if move.progress >= WHOLE else StepStatus.SLOWED
                gave_way = tracking is None and self._tracking is not None
                return Step(
                    status, move.progress, then, "", count, gave_way=gave_way, solution=solution, rows=rows
                )
            fractions.extend(s for s in report.failing_parameters() if s not in fractions)
            if len(fractions) > _MOST_FRACTIONS:
                return blocked("clearance between the states")
        return blocked("no convergence")

    def _flaw(self, state: State, target: Target, move: Move, closed: Closed) -> str:
        """Return what is wrong with where a `move` leads from `state`, found anew; empty where nothing is."""
        # An elastic tip that had to leave its path is where the QP put it.
        on_path = move.solution.tip_slack <= self.accuracy.tip
        goal = target.goal(move.progress) if on_path else None
        return self.acceptance.flaw(closed, state.q, target, goal, move.vertices, move.torsion)

    def _expected(self, target: Target, goal: TipGoal, guess: Array) -> float:
        """Return about how far a node moves in the step, m; the influence if the motion before does not show it."""
        last = self._arm.travel(guess)
        if last == 0.0 or target.base is not None:
            return self._influence
        return max(last, abs(target.end - target.start) * float(np.abs(goal.velocity).max()))
