"""One attempt at a step: QPs and their corrections until every constraint holds, then the proof between the states."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import EvaluationError, SolverError
from vgtm_qp.qp.condensed import AnswerError, InfeasibleStepError
from vgtm_qp.qp.fused import Closed
from vgtm_qp.qp.numbers import ClearanceRows, StepSolution
from vgtm_qp.qp.settle import LEFT
from vgtm_qp.step.acceptance import Acceptance
from vgtm_qp.step.engine import Accuracy, ElasticEngine, Engine, FusedEngine
from vgtm_qp.step.linearise import QPInput, Target
from vgtm_qp.step.path import PathPoint
from vgtm_qp.step.separation import Separation, Shortfall
from vgtm_qp.step.state import State, sealed
from vgtm_qp.step.task import TipTask
from vgtm_qp.step.tracking import HardTracking

Array = NDArray[np.float64]


_MOTION_MARGIN = 2.5
"""A member may move by so many times what is expected of it before a pair that matters can be missed."""

_TOO_FAR = 1e3
"""No answer of a QP that moves a node by so many times the arm's length means anything: the pose is singular."""

_DEVIATION = 0.1
"""An offset joint that may take a member's end further from its chord turns too far in one step, m."""


@dataclass(frozen=True)
class Tolerances:
    """What an accepted state is held against: lengths, tip and, where faces track hard, tracking in m (rad).

    They are tighter than the published tolerances of ``verify`` by a decade, so that rounding cannot decide. A tip
    that is further off than `settling` of the arm's length after a QP calls for another one.
    """

    member: float = 1e-10
    stroke: float = 1e-10
    tip: float = 1e-8
    settling: float = 5e-3
    tracking: float = 1e-7


@dataclass
class Phases:
    """Seconds spent in each phase of a step."""

    seconds: dict[str, float] = field(
        default_factory=lambda: dict.fromkeys(("distance", "qp", "correction", "acceptance"), 0.0)
    )
    _mark: float = field(default_factory=perf_counter)

    def start(self) -> None:
        """Begin to count."""
        self._mark = perf_counter()

    def add(self, phase: str) -> None:
        """Give the time since the last call to `phase`."""
        now = perf_counter()
        self.seconds[phase] += now - self._mark
        self._mark = now


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of an attempt.

    Attributes
    ----------
    accepted : bool
    closed : Closed or None
        The new configuration, valid where accepted.
    control_vertices : (V, 3)
        The new curve, m.
    progress : float
        How much of the target's piece of path was covered, 0 to 1.
    reason : str
        Why it was refused; empty where accepted.
    solution : StepSolution or None
        Of the motion QP.
    rows : ClearanceRows or None
        Its clearance rows.
    iterations : int
        QPs solved.
    shortfall : Shortfall or None
        What is still too near in the new configuration; None where that was not looked at.
    torsion : (T,)
        The new torsion coordinates, rad.
    solver_failed : bool
        Whether it was refused only because the QP solver gave no good answer.
    time : float
        At the end of the step, s.
    """

    accepted: bool
    closed: Closed | None
    control_vertices: Array
    progress: float
    reason: str
    solution: StepSolution | None = None
    rows: ClearanceRows | None = None
    iterations: int = 0
    shortfall: Shortfall | None = None
    torsion: Array = field(default_factory=lambda: np.zeros(0))
    solver_failed: bool = False
    time: float = 0.0

    def state_after(self, before: State) -> State:
        """Return the state that an accepted attempt leads to from the state `before`."""
        assert self.accepted
        assert self.closed is not None
        duration = self.time - before.time
        return State(
            time=self.time,
            nodes=sealed(self.closed.X),
            control_vertices=sealed(self.control_vertices),
            torsion=sealed(self.torsion),
            lengths=sealed(self.closed.lengths),
            length_rates=sealed((self.closed.lengths - before.lengths) / duration),
            motion=sealed(self.closed.X - before.nodes),
            duration=duration,
            shortfall=self.shortfall,
        )


class _Move(NamedTuple):
    """Where the answer of one QP leads.

    Attributes
    ----------
    solution : StepSolution
    X, vertices, torsion, progress
        Node positions (N, 3) and the curve (V, 3), m, and (T,), rad, by the answer, and the progress along the path.
    furthest : float
        Greatest displacement of a coordinate, m.
    closed : Closed or None
        The configuration with its lengths closed and its tip at its goal; None where only another QP leads there.
    """

    solution: StepSolution
    X: Array
    vertices: Array
    torsion: Array
    progress: float
    furthest: float
    closed: Closed | None


class Attempt:
    """Tries one piece of path from one state; keeps the workspaces."""

    def __init__(
        self,
        engine: Engine,
        task: TipTask,
        separation: Separation,
        acceptance: Acceptance,
        *,
        tracking: HardTracking | None = None,
        tolerances: Tolerances | None = None,
        max_qps: int = 8,
    ) -> None:
        self.engine = engine
        self.tracking = tracking
        self.task = task
        self.separation = separation
        self.acceptance = acceptance
        self.tolerances = tolerances or Tolerances()
        self.max_qps = max_qps
        self.phases = Phases()
        kept = self.tolerances
        self._too_far = _TOO_FAR * separation.truss.height
        self._accuracy = Accuracy(kept.member, kept.tip, kept.settling * separation.truss.height)

    def run(self, state: State, target: Target, share: float = 1.0, *, progress: float = 0.0) -> Outcome:
        """Return the outcome of moving from `state` along the target's piece of path; no state is changed.

        `share` is the length of the piece as a part of the step before: what the motion guessed from it is scaled by.
        `progress` is how much of the piece lies behind the tip at the start.
        """
        self.phases.start()
        short = state.shortfall
        if short is None:
            short = self.separation.shortfall(state.nodes, state.time)
        if short:
            outcome = self._run(state, target, share, progress, short, self.separation.distances.recovery)
            if outcome.accepted:
                return outcome
        return self._run(state, target, share, progress, short, 0.0)

    def _run(
        self, state: State, target: Target, share: float, progress: float, short: Shortfall, gain: float
    ) -> Outcome:
        """Do it, with pairs that are too `short` of their clearance driven apart by `gain`, m."""
        phases, span, separation = self.phases, target.end - target.start, self.separation
        duration = target.time - state.time
        X, vertices, torsion = state.nodes, state.control_vertices, state.torsion
        guess = share * state.motion
        Y = X + 0.5 * guess
        goal = target.path.at(target.start + progress * span)
        reach = separation.distances.influence
        if share >= 1.0:
            reach = _MOTION_MARGIN * self._expected(target, goal, guess)
        stations: list[float] = []
        first: StepSolution | None = None
        first_rows: ClearanceRows | None = None
        closed: Closed | None = None
        after: Shortfall | None = None

        def outcome(reason: str, count: int) -> Outcome:
            told = (first, first_rows, count, after, torsion)
            return Outcome(not reason, closed, vertices, progress, reason, *told, time=target.time)

        for count in range(1, self.max_qps + 1):
            motion = count == 1
            if motion:
                rows = separation.rows(X, state.time, duration, reach, short, gain)
            else:
                rows = separation.rows(X, target.time, 0.0, reach, short, gain)
            for more in separation.rows_between(state.nodes, X, state.time, target.time, stations):
                rows = rows.joined(more)
            if motion and target.base is not None:
                rows = rows.after(np.where(self.task.base[:, None], target.base - X, 0.0))
            phases.add("distance")
            if not motion:
                goal = target.path.at(target.start + progress * span)
            try:
                at = Y if motion else X
                move = self._move(QPInput(X, at, vertices, torsion, target, goal, progress, rows, motion))
            except (AnswerError, EvaluationError) as error:
                return replace(outcome(str(error), count), solver_failed=True)
            except InfeasibleStepError:
                return outcome("no displacement keeps all limits and clearances", count)
            except SolverError as error:
                return outcome(str(error), count)
            finally:
                phases.add("correction")
            if motion:
                first, first_rows = move.solution, rows
            X, vertices, torsion, progress = move.X, move.vertices, move.torsion, move.progress
            if not move.furthest < self._too_far:
                return outcome("singular pose", count)
            # A pair that one correction pushes away must still be there in the next, or two of them take turns.
            reach = max(reach, move.furthest)
            if move.closed is None:
                if not np.isfinite(X).all():
                    return outcome("singular pose", count)
                continue
            flaw = self._flaw(state, target, move)
            if flaw:
                return replace(outcome(flaw, count), solver_failed=True)
            closed, X = move.closed, move.closed.X
            if self.tracking is not None:
                gap = self.tracking.error(X, vertices, torsion, target.base_rotation)
                if not gap <= self.tolerances.tracking:
                    continue
            report = separation.between(state.nodes, X, state.time, target.time, short)
            after = separation.holds(X, target.time, short, proven=report.certified)
            phases.add("acceptance")
            if after is None:
                continue
            if not separation.deviation(state.nodes, X) < _DEVIATION:
                return outcome("an offset joint turns too far in one step", count)
            if report.certified:
                return outcome("", count)
            stations.extend(s for s in report.failing_parameters() if s not in stations)
            if len(stations) > 8:
                return outcome("clearance between the states", count)
        return outcome("no convergence", self.max_qps)

    def _flaw(self, state: State, target: Target, move: _Move) -> str:
        """Return what is wrong with where a `move` leads from `state`, found anew; empty where nothing is."""
        assert move.closed is not None
        goal: PathPoint | None = None
        # An elastic tip that had to leave its path is where the QP put it.
        if not (isinstance(self.engine, ElasticEngine) and move.solution.tip_slack > self.tolerances.tip):
            goal = target.path.at(target.start + move.progress * (target.end - target.start))
        return self.acceptance.flaw(
            move.closed,
            state.nodes,
            target.base,
            target.lower,
            target.upper,
            goal,
            move.vertices,
            move.torsion,
        )

    def _move(self, asked: QPInput) -> _Move:
        """Return where the answer of a QP leads, settled where that needs no other one."""
        if isinstance(self.engine, FusedEngine):
            move = self._move_at_once(self.engine, asked)
            if move is not None:
                return move
        try:
            solution = self._solve(asked)
        finally:
            self.phases.add("qp")
        target, goal, span = asked.target, asked.goal, asked.target.end - asked.target.start
        X = asked.X + solution.nodes
        if target.base is not None:
            X = np.where(self.task.base[:, None], target.base, X)
        progress = min(max(asked.progress + solution.progress, 0.0), 1.0)
        if progress < 1.0:
            left = (1.0 - progress) * abs(span) * float(np.abs([goal.velocity, goal.spin]).max())
            if left <= LEFT:
                # Interior-point solvers stop just short of the end, and so would the arm, for one more step.
                progress = 1.0
        furthest = float(np.abs(solution.nodes).max())
        closed = None
        if furthest < np.inf:
            then = target.path.at(target.start + progress * span)
            closed = self.engine.settle(X, target, then, self._accuracy)
        curve = asked.vertices + solution.vertices, asked.torsion + solution.torsion
        return _Move(solution, X, *curve, progress, furthest, closed)

    def _move_at_once(self, engine: FusedEngine, asked: QPInput) -> _Move | None:
        """Return the same by one call after the QP; None where that does not serve."""
        try:
            take = engine.ask(asked)
        except InfeasibleStepError:
            # Whether that is for the margin alone is found out where it can be left out.
            return None
        self.phases.add("qp")
        if take is None:
            return None
        try:
            taken, accuracy = take(), self._accuracy
        except EvaluationError:
            # The answer may still be good, and be settled by other steps.
            return None
        closed: Closed | None = taken.closed
        if not (
            taken.closed.error <= accuracy.member
            and taken.before <= accuracy.start
            and taken.after <= accuracy.tip
        ):
            closed = None
        solution, torsion = taken.solution, asked.torsion
        turned = torsion + solution.torsion if len(torsion) else torsion
        curve = taken.vertices, turned
        return _Move(solution, solution.nodes, *curve, taken.progress, taken.moved, closed)

    def _solve(self, asked: QPInput) -> StepSolution:
        """Return the engine's answer; where even a zero step is forbidden by the margin, without the margin."""
        rows = asked.rows
        try:
            return self.engine.solve(asked)
        except InfeasibleStepError:
            if not asked.motion or not len(rows) or rows.lower.max() <= 0.0:
                raise
        np.minimum(rows.lower, 0.0, out=rows.lower)
        return self.engine.solve(asked)

    def _expected(self, target: Target, goal: PathPoint, guess: Array) -> float:
        """Return about how far a node moves in the step, m; anything where the arm was at rest."""
        last = float(np.abs(guess).max())
        if last == 0.0 or target.base is not None:
            return self.separation.distances.influence
        return max(last, abs(target.end - target.start) * float(np.abs(goal.velocity).max()))
