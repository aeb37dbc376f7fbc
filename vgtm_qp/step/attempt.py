"""One attempt at a step: QPs and their corrections until every constraint holds, then the proof between the states."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Arm
from vgtm_qp.errors import EvaluationError, SolverError
from vgtm_qp.qp.fused import Closed
from vgtm_qp.qp.numbers import ClearanceRows, StepSolution
from vgtm_qp.qp.residual import AnswerError, FailedStepError, InfeasibleStepError
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.acceptance import Acceptance
from vgtm_qp.step.engine import Accuracy, Engine, Move
from vgtm_qp.step.separation import Separation, Shortfall
from vgtm_qp.step.state import State, sealed
from vgtm_qp.step.target import QPInput, Target
from vgtm_qp.step.tracking import TrackingError

Array = NDArray[np.float64]


_MOTION_MARGIN = 2.5
"""A member may move by so many times what is expected of it before a pair that matters can be missed."""

_TOO_FAR = 1e3
"""No answer of a QP that moves a node by so many times the arm's length means anything: the pose is singular."""

_DEVIATION = 0.1
"""An arm whose points may leave their chords by more than this turns too far in one step, m."""


@dataclass(frozen=True)
class Tolerances:
    """What an accepted state is held against: quantities, tip and, where stations track hard, tracking in m (rad).

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
    failure : FailedStepError or None
        What refused it where that was a QP without an answer; it carries the QP.
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
    failure: FailedStepError | None = None

    def state_after(self, arm: Arm, before: State) -> State:
        """Return the state of an arm that an accepted attempt leads to from the state `before`."""
        assert self.accepted
        assert self.closed is not None
        duration = self.time - before.time
        return State(
            time=self.time,
            q=(q := sealed(self.closed.q)),
            nodes=sealed(arm.nodes(q)),
            control_vertices=sealed(self.control_vertices),
            torsion=sealed(self.torsion),
            quantities=sealed(self.closed.quantities),
            rates=sealed((self.closed.quantities - before.quantities) / duration),
            motion=sealed(q - before.q),
            duration=duration,
            shortfall=self.shortfall,
        )


class Attempt:
    """Tries one piece of path from one state; keeps the workspaces."""

    def __init__(
        self,
        arm: Arm,
        engine: Engine,
        separation: Separation,
        acceptance: Acceptance,
        *,
        tracking: TrackingError | None = None,
        tolerances: Tolerances | None = None,
        max_qps: int = 8,
    ) -> None:
        self.arm = arm
        self.engine = engine
        self.tracking = tracking
        self.separation = separation
        self.acceptance = acceptance
        self.tolerances = tolerances or Tolerances()
        self.max_qps = max_qps
        self.phases = Phases()
        kept = self.tolerances
        self._accuracy = Accuracy(kept.member, kept.tip, kept.settling * arm.height)

    def run(self, state: State, target: Target, share: float = 1.0, *, progress: float = 0.0) -> Outcome:
        """Return the outcome of moving from `state` along the target's piece of path; no state is changed.

        `share` is the length of the piece as a part of the step before: what the motion guessed from it is scaled by.
        `progress` is how much of the piece lies behind the tip at the start.
        """
        self.phases.start()
        short = state.shortfall
        if short is None:
            short = self.separation.shortfall(state.q, state.time)
        if short:
            outcome = self._run(state, target, share, progress, short, self.separation.distances.recovery)
            if outcome.accepted:
                return outcome
        return self._run(state, target, share, progress, short, 0.0)

    def first_input(self, state: State, target: Target) -> QPInput:
        """Return what the first QP of a step from `state` is linearised at."""
        short = state.shortfall
        if short is None:
            short = self.separation.shortfall(state.q, state.time)
        gain = self.separation.distances.recovery if short else 0.0
        return self._first(state, target, 1.0, 0.0, short, gain)[0]

    def _first(
        self, state: State, target: Target, share: float, progress: float, short: Shortfall, gain: float
    ) -> tuple[QPInput, float]:
        """Return that, and from which distance on no pair can become active, m."""
        q, goal, guess = state.q, target.goal(progress), share * state.motion
        reach = self.separation.distances.influence
        if share >= 1.0:
            reach = _MOTION_MARGIN * self._expected(target, goal, guess)
        rows = self.separation.rows(q, state.time, target.time - state.time, reach, short, gain)
        if target.base is not None:
            # What the base's own motion does to the rows is known.
            rows = rows.after(self.arm.nodes(self.arm.based(q, target.base)) - self.arm.nodes(q))
        curve = state.control_vertices, state.torsion
        return QPInput(q, q + 0.5 * guess, *curve, target, goal, progress, rows, True), reach

    def _run(
        self, state: State, target: Target, share: float, progress: float, short: Shortfall, gain: float
    ) -> Outcome:
        """Do it, with pairs that are too `short` of their clearance driven apart by `gain`, m."""
        phases, separation = self.phases, self.separation
        asked, reach = self._first(state, target, share, progress, short, gain)
        q, vertices, torsion = state.q, state.control_vertices, state.torsion
        fractions: list[float] = []
        first: StepSolution | None = None
        first_rows: ClearanceRows | None = None
        closed: Closed | None = None
        after: Shortfall | None = None

        def outcome(reason: str, count: int) -> Outcome:
            details = (first, first_rows, count, after, torsion)
            return Outcome(not reason, closed, vertices, progress, reason, *details, time=target.time)

        for count in range(1, self.max_qps + 1):
            if count > 1:
                rows = separation.rows(q, target.time, 0.0, reach, short, gain)
                for more in separation.rows_between(state.q, q, state.time, target.time, fractions):
                    rows = rows.joined(more)
                goal = target.goal(progress)
                asked = QPInput(q, q, vertices, torsion, target, goal, progress, rows, False)
            phases.add("distance")
            try:
                move = self.engine.move(asked, self._accuracy, phases.add)
            except AnswerError as error:
                return replace(outcome(str(error), count), solver_failed=True, failure=error)
            except EvaluationError as error:
                return replace(outcome(str(error), count), solver_failed=True)
            except InfeasibleStepError as error:
                return replace(
                    outcome("no displacement keeps all limits and clearances", count), failure=error
                )
            except SolverError as error:
                return outcome(str(error), count)
            finally:
                phases.add("correction")
            if count == 1:
                first, first_rows = move.solution, asked.rows
            q, vertices, torsion, progress = move.q, move.vertices, move.torsion, move.progress
            if not move.furthest < _TOO_FAR * self.arm.height or not np.isfinite(q).all():
                return outcome("singular pose", count)
            # A pair that one correction pushes away must still be there in the next, or two of them take turns.
            reach = max(reach, move.furthest)
            if move.closed is None:
                continue
            flaw = self._flaw(state, target, move)
            if flaw:
                return replace(outcome(flaw, count), solver_failed=True)
            closed, q = move.closed, move.closed.q
            if self.tracking is not None:
                gap = self.tracking.greatest(q, vertices, torsion, target.base)
                if not gap <= self.tolerances.tracking:
                    continue
            report = separation.between(state.q, q, state.time, target.time, short)
            after = separation.holds(q, target.time, short, proven=report.certified)
            phases.add("acceptance")
            if after is None:
                continue
            if not separation.deviation(state.q, q) < _DEVIATION:
                return outcome("the arm turns too far in one step", count)
            if report.certified:
                return outcome("", count)
            fractions.extend(s for s in report.failing_parameters() if s not in fractions)
            if len(fractions) > 8:
                return outcome("clearance between the states", count)
        return outcome("no convergence", self.max_qps)

    def _flaw(self, state: State, target: Target, move: Move) -> str:
        """Return what is wrong with where a `move` leads from `state`, found anew; empty where nothing is."""
        assert move.closed is not None
        # An elastic tip that had to leave its path is where the QP put it.
        on_path = move.solution.tip_slack <= self.tolerances.tip
        goal = target.goal(move.progress) if on_path else None
        box, curve = (target.lower, target.upper), (move.vertices, move.torsion)
        return self.acceptance.flaw(move.closed, state.q, target.base, *box, goal, *curve)

    def _expected(self, target: Target, goal: TipGoal, guess: Array) -> float:
        """Return about how far a node moves in the step, m; anything where the arm was at rest."""
        last = self.arm.travel(guess)
        if last == 0.0 or target.base is not None:
            return self.separation.distances.influence
        return max(last, abs(target.end - target.start) * float(np.abs(goal.velocity).max()))
