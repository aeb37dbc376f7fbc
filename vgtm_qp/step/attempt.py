"""One attempt at a step: QPs and their corrections until every constraint holds, then the proof between the states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import Enum
from time import perf_counter

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import CurveError, SolverError
from vgtm_qp.qp.answer import Accuracy, Closed, Move
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.acceptance import Acceptance
from vgtm_qp.step.actuation import Actuation
from vgtm_qp.step.driver import (
    FREE_QPS,
    MOST_QPS,
    NO_CONVERGENCE,
    PHASES,
    Begun,
    Driver,
    can_drive,
    is_cut_short,
)
from vgtm_qp.step.engine import Engine
from vgtm_qp.step.separation import RECOVERY, Separation
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import Shortfall, State
from vgtm_qp.step.step import WHOLE, Step
from vgtm_qp.step.step_data import DEVIATION, LEAP, MOTION_MARGIN, SINGULAR
from vgtm_qp.step.target import QPInput, Target

_MOST_FRACTIONS = 8
"""Greatest number of times between two states for which a QP has rows."""

_SETTLING = 5e-3
"""Tip error after a QP, over the arm's length, above which another QP is solved."""

FURTHER = 1.25
"""Least progress off the curve, over that on the curve, for which stations leave it."""


class Tracking(Enum):
    """Whether stations stay on the curve, are free to leave it, or leave it only if the arm gets further."""

    HARD = "hard"
    ELASTIC = "elastic"
    EITHER = "either"


class Phases:
    """Seconds spent in each phase of a step, by name."""

    def __init__(self, *names: str) -> None:
        self._seconds = dict.fromkeys(names, 0.0)
        self._others: list[tuple[Sequence[str], Array]] = []
        self.start()

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds so far by name; may be changed in place."""
        for phases, spent in self._others:
            for phase, seconds in zip(phases, spent.tolist(), strict=True):
                self._seconds[phase] += seconds
            spent[:] = 0.0
        return self._seconds

    def join(self, phases: Sequence[str], spent: Array) -> None:
        """Count from now on the seconds that others add to `spent` for some phases, too."""
        self._others.append((phases, spent))

    def start(self) -> None:
        """Begin to count."""
        self._mark = perf_counter()

    def add(self, phase: str) -> None:
        """Add the time since the last call to `phase`."""
        now = perf_counter()
        self._seconds[phase] += now - self._mark
        self._mark = now


class Attempt:
    """Tries one piece of path from one state; keeps the workspaces.

    Attributes
    ----------
    qps : int
        QPs solved so far.
    """

    def __init__(self, setup: Setup, separation: Separation, actuation: Actuation) -> None:
        self._arm, self._influence = setup.arm, setup.influence
        self._has_limit, self._too_long = setup.step_limit < np.inf, setup.too_long
        self.separation = separation
        self.phases = Phases("distance", "qp", "correction", "acceptance")
        self.qps = 0
        arm = setup.arm
        self.accuracy = Accuracy(
            actuation.tolerance, tip=1e-8 * arm.unit, start=_SETTLING * arm.height, tracking=1e-7 * arm.unit
        )
        self.acceptance = Acceptance(setup, self.accuracy)
        # Each curve has engines of its own, which are kept as well: see ``Shaping``.
        self._drivers: dict[Engine, Driver] = {}
        self._tried: tuple[State, Target, Step | Begun | None] | None = None
        self.use(setup)

    def use(self, setup: Setup) -> None:
        """Go on with the curve of another `setup` of the arm."""
        self._setup, self._can_drive = setup, can_drive(setup)

    def usual(self, state: State, target: Target) -> Step | None:
        """Return the step of :meth:`run` if it is a usual one, in one call; what was found out is kept for ``run``."""
        engine, self._tried = self._setup.engine, None
        if not self._can_drive or self.separation.shortfall_of(state) or engine.stepper is None:
            return None
        driven = self._driven(state, target, 1.0, engine)
        self._tried = state, target, driven
        return driven if isinstance(driven, Step) and driven.moved else None

    def run(
        self,
        state: State,
        target: Target,
        share: float = 1.0,
        *,
        progress: float = 0.0,
        tracking: Tracking = Tracking.EITHER,
        enough: float = WHOLE,
    ) -> Step:
        """Return the step from `state` along the target's piece of path, with its progress on that piece.

        The motion of the step before, times `share`, predicts the motion of this one. `progress` is the part
        of the piece that is covered at the start. Stations that may leave the curve do so only if the
        progress on it is less than `enough`.
        """
        self.phases.start()
        elastic, piece = self._setup.elastic, (state, target, share, progress)
        if elastic is not None and tracking is Tracking.ELASTIC:
            return self._separated(*piece, elastic())
        step = self._separated(*piece, self._setup.engine)
        if elastic is None or tracking is Tracking.HARD or (step.moved and step.progress >= enough):
            return step
        other = self._separated(*piece, elastic())
        return other if not step.moved or other.progress > FURTHER * step.progress else step

    def _separated(
        self,
        state: State,
        target: Target,
        share: float,
        progress: float,
        engine: Engine,
    ) -> Step:
        """Return an engine's step that drives apart pairs too near, or if that fails keeps their distance."""
        short = self.separation.shortfall_of(state)
        tried, self._tried = self._tried, None
        driven: Step | Begun | None = None
        if tried is not None and tried[:2] == (state, target) and engine is self._setup.engine:
            driven = tried[2]
        elif self._can_drive and not short and progress == 0.0 and engine.stepper is not None:
            driven = self._driven(state, target, share, engine)
        if isinstance(driven, Step):
            return driven
        for gain in (self._recovery(short), 0.0) if short else (0.0,):
            try:
                if driven is not None:
                    step = self._run(state, target, driven, driven.reach, short, gain, engine)
                else:
                    asked, reach = self._first(state, target, share, progress, short, gain)
                    step = self._run(state, target, asked, reach, short, gain, engine)
            except CurveError as error:
                # A trial curve may have no frame; that of a shorter piece may have one.
                step = Step.stopped(state, str(error), 1, solver_failed=True)
            if step.moved:
                break
        return step

    def _driven(self, state: State, target: Target, share: float, engine: Engine) -> Step | Begun | None:
        """Return the step in one call, or its beginning if it needs further QPs; None if it is no usual one."""
        driver = self._drivers.get(engine)
        if driver is None:
            driver = self._drivers[engine] = Driver(self._setup, engine, self.acceptance, self.separation)
            self.phases.join(PHASES, driver.spent)
        driven = driver.take(state, target, share)
        if isinstance(driven, Step):
            self.qps += driven.qps
        else:
            self.phases.start()
        return driven

    def _recovery(self, short: Shortfall) -> float:
        """Return the distance by which pairs that are too near are driven apart, m."""
        return RECOVERY * self._arm.unit if short else 0.0

    def with_gap(self, step: Step) -> Step:
        """Return a step with the gap between curve and stations in its state."""
        gap = self._setup.gap_of(step.state)
        return replace(step, gap=gap, gave_way=self.acceptance.gave_way(gap))

    def first_input(self, state: State, target: Target, share: float) -> QPInput:
        """Return the input of the first QP of a step from `state`; see :meth:`run`."""
        short = self.separation.shortfall_of(state)
        return self._first(state, target, share, 0.0, short, self._recovery(short))[0]

    def _first(
        self, state: State, target: Target, share: float, progress: float, short: Shortfall, gain: float
    ) -> tuple[QPInput, float]:
        """Return the first input, and the distance, m, beyond which no pair can become active."""
        q, arm, goal, guess = state.q, self._arm, target.goal(progress), share * state.motion
        reach, expected = self._influence, None
        if share >= 1.0:
            reach = MOTION_MARGIN * self._expected(target, goal, guess)
        if share >= 1.0 and target.base is None and (last := arm.travel(guess)) > 0.0:
            expected = reach / last * guess
        elif (furthest := self._furthest(q, target)) is not None:
            expected = MOTION_MARGIN * furthest
        rows = self.separation.rows(q, state.time, target.duration, reach, short, gain, expected=expected)
        if target.base is not None:
            # The displacement of its own nodes is known; the QP knows what it does to the others.
            moved = arm.nodes(arm.based(q, target.base)) - arm.nodes(q)
            rows = rows.after(np.where(arm.base[:, None], moved, 0.0))
        curve = state.control_vertices, state.torsion
        return QPInput(q, q + 0.5 * guess, *curve, target, goal, progress, rows, True), reach

    def _run(
        self,
        state: State,
        target: Target,
        begin: QPInput | Begun,
        reach: float,
        short: Shortfall,
        gain: float,
        engine: Engine,
    ) -> Step:
        """Run the attempt from its first input or its beginning; `short` pairs are driven apart by `gain`, m."""
        phases, separation = self.phases, self.separation
        q, fractions = state.q, list[float]()
        first, rows, covered, target, begun = _beginning(begin, target)
        move: Move | None = None
        self.qps += begun - 1

        def blocked(reason: str, *, solver_failed: bool = False) -> Step:
            of_qps = count, first and first.solution, rows
            return Step.stopped(state, reason, *of_qps, solver_failed=solver_failed)

        for count in range(begun, MOST_QPS + 1):
            if count > FREE_QPS and covered == 1.0 and first is not None and is_cut_short(self._setup, first):
                # Corrections towards the end of the piece would leave what the first QP allowed, and not
                # converge.
                covered = first.progress
                q, target, move = first.q, target.part(covered), first._replace(progress=1.0)
            if move is not None:
                furthest = self._furthest(q, target)
                near = separation.rows(q, target.time, 0.0, reach, short, gain, expected=furthest)
                near = separation.with_rows_between(near, state, q, target.time, fractions)
                at = q, q, move.vertices, move.torsion
                begin = QPInput(*at, target, target.goal(move.progress), move.progress, near, False)
            phases.add("distance")
            self.qps += 1
            try:
                move = (
                    begin.move if isinstance(begin, Begun) else engine.move(begin, self.accuracy, phases.add)
                )
            except SolverError as error:
                return Step.failed(state, error, count, first and first.solution, rows)
            finally:
                phases.add("correction")
            if first is None:
                first, rows = move, begin.rows
            q = move.q
            beyond = self._leap(state, move)
            if beyond:
                return blocked(beyond)
            # A pair that one correction pushed apart must stay listed for the next, or two corrections alternate.
            reach = max(reach, move.furthest)
            if move.closed is None:
                continue
            flaw = self._flaw(state, target, move, move.closed)
            if flaw:
                return blocked(flaw, solver_failed=True)
            q, closed = move.closed.q, move.closed
            # Linearised rows leave a small gap between the curve's end and the tip, which is closed here.
            tip = closed.tip_position, closed.tip_rotation
            vertices, reverses = self._setup.arrival.ended(move.vertices, *tip, target.base)
            if reverses:
                return blocked("the curve would reverse where it begins or ends")
            gap = self._setup.arrival.gap(q, vertices, move.torsion, target.base)
            if engine.layout.hard_tracking and not gap <= self.accuracy.tracking:
                continue
            report, after = separation.proof(state, q, target.time, short)
            phases.add("acceptance")
            if after is None:
                continue
            beyond = self._stride(state, q)
            if beyond:
                return blocked(beyond)
            if report.certified:
                then = state.next(self._arm, target.duration, closed, vertices, move.torsion, after)
                progress = covered * move.progress
                return self.acceptance.passed(then, progress, gap, count, first.solution, rows)
            fractions.extend(s for s in report.failing_parameters() if s not in fractions)
            if len(fractions) > _MOST_FRACTIONS:
                return blocked("clearance between the states")
        return blocked(NO_CONVERGENCE)

    def _furthest(self, q: Array, target: Target) -> Array | None:
        """Return ``Arm.furthest`` within the boxes of a target; None if the base moves."""
        return None if target.base is not None else self._arm.furthest(q, target.lower, target.upper)

    def _leap(self, state: State, move: Move) -> str:
        """Return why the QP's answer leads too far from `state` for its rows; empty if it does not."""
        height = self._arm.height
        is_finite = move.closed is not None or np.isfinite(move.q).all()
        if not move.furthest < SINGULAR * height or not is_finite:
            return "singular pose"
        leap = np.abs(move.vertices - state.control_vertices).max(initial=0.0)
        return "" if leap < LEAP * height else "the curve moves too far in one step"

    def _stride(self, state: State, q: Array) -> str:
        """Return why the motion from `state` to `q` is too long for one step; empty if it is not."""
        if not self.separation.deviation(state.q, q) < DEVIATION * self._arm.height:
            return "the arm turns too far in one step"
        return self._too_long(self._arm.nodes(q) - state.nodes) if self._has_limit else ""

    def _flaw(self, state: State, target: Target, move: Move, closed: Closed) -> str:
        """Return the flaw of the configuration of a `move` from `state`, computed again, or nothing."""
        # An elastic tip with a slack need not be at its goal.
        on_path = move.solution.tip_slack <= self.accuracy.tip
        goal = target.goal(move.progress) if on_path else None
        return self.acceptance.flaw(closed, state.q, target, goal, move.vertices, move.torsion)

    def _expected(self, target: Target, goal: TipGoal, guess: Array) -> float:
        """Return the expected displacement of a node in the step, m; the influence without a prediction."""
        last = self._arm.travel(guess)
        if last == 0.0 or target.base is not None:
            return self._influence
        return max(last, abs(target.end - target.start) * float(np.abs(goal.velocity).max()))


def _beginning(
    begin: QPInput | Begun, target: Target
) -> tuple[Move | None, ClearanceRows | None, float, Target, int]:
    """Return the first answer and its rows, or None, and of the next QP the share of the piece, the target and number.

    After a ``Begun`` step the next QP is its last one, whose answer is known: it is not solved again.
    """
    if not isinstance(begin, Begun):
        return None, None, 1.0, target, 1
    covered = begin.covered
    return begin.first, begin.rows, covered, target if covered == 1.0 else target.part(covered), begin.qps
