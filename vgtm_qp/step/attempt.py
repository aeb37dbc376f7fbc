"""One attempt at a step: QPs and their corrections until every constraint holds, then the proof between the states."""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from vgtm_qp.errors import SolverError
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.qp.condensed import InfeasibleStepError
from vgtm_qp.qp.fused import Closed
from vgtm_qp.qp.numbers import ClearanceRows, StepSolution
from vgtm_qp.step.engine import Engine
from vgtm_qp.step.linearise import Target, clearance_rows
from vgtm_qp.step.path import PathPoint
from vgtm_qp.step.state import State
from vgtm_qp.step.task import TipTask

Array = NDArray[np.float64]


_MOTION_MARGIN = 3.0
"""A member may move by so many times what is expected of it before a pair that matters can be missed."""


_SETTLING_STEPS = 4


@dataclass(frozen=True)
class Tolerances:
    """What an accepted state is held against: lengths and tip in m (rad), clearance in m below `safe`.

    They are tighter than the published tolerances of ``verify`` by a decade, so that rounding cannot decide. The QP
    keeps `margin` over the least clearance, m, for what is not linear in its step. A tip that is further off than
    `settling` after a QP calls for another one.
    """

    member: float = 1e-10
    stroke: float = 1e-10
    tip: float = 1e-8
    clearance: float = 1e-10
    between: float = 1e-10
    margin: float = 2e-4
    settling: float = 1e-3


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
    """

    accepted: bool
    closed: Closed | None
    control_vertices: Array
    progress: float
    reason: str
    solution: StepSolution | None = None
    rows: ClearanceRows | None = None
    iterations: int = 0


class Attempt:
    """Tries one piece of path from one state; keeps the workspaces."""

    def __init__(
        self,
        engine: Engine,
        task: TipTask,
        monitor: Clearance,
        safe: float,
        self_safe: float,
        influence: float,
        *,
        tolerances: Tolerances | None = None,
        max_qps: int = 8,
    ) -> None:
        self.engine = engine
        self.task = task
        self.monitor = monitor
        self.safe = safe
        self.self_safe = self_safe
        self.influence = influence
        self.tolerances = tolerances or Tolerances()
        self.max_qps = max_qps
        self.phases = Phases()

    def run(self, state: State, target: Target, share: float = 1.0) -> Outcome:
        """Return the outcome of moving from `state` along the target's piece of path; no state is changed.

        `share` is the length of the piece as a part of the step before: what the motion guessed from it is scaled by.
        """
        tolerance, phases, span = self.tolerances, self.phases, target.end - target.start
        phases.start()
        X, vertices, progress = state.nodes, state.control_vertices, 0.0
        guess = share * state.motion
        Y = X + 0.5 * guess
        reach = _MOTION_MARGIN * self._expected(target, guess)
        stations: list[float] = []
        first: StepSolution | None = None
        first_rows: ClearanceRows | None = None
        closed: Closed | None = None

        def outcome(reason: str, count: int) -> Outcome:
            return Outcome(not reason, closed, vertices, progress, reason, first, first_rows, count)

        for count in range(1, self.max_qps + 1):
            motion = count == 1
            rows = self._rows(state, X, state.time if motion else target.time, stations, reach, motion=motion)
            if motion and target.base is not None:
                rows = rows.after(np.where(self.task.base[:, None], target.base - X, 0.0))
            phases.add("distance")
            goal = target.path.at(target.start + progress * span)
            try:
                solution = self._solve(X, Y if motion else X, vertices, target, goal, progress, rows, motion=motion)
            except InfeasibleStepError:
                return outcome("infeasible", count)
            except SolverError as error:
                return outcome(str(error), count)
            finally:
                phases.add("qp")
            if motion:
                first, first_rows = solution, rows
            X = X + solution.nodes
            if target.base is not None:
                X = np.where(self.task.base[:, None], target.base, X)
            vertices = vertices + solution.vertices
            progress = min(max(progress + solution.progress, 0.0), 1.0)
            moved = float(np.abs(solution.nodes).max())
            if not moved < np.inf:
                return outcome("singular pose", count)
            reach = moved
            settled = self._settle(X, target, target.path.at(target.start + progress * span))
            phases.add("correction")
            if settled is None:
                continue
            closed, X = settled, settled.X
            if not self.monitor.keeps(
                X, target.time, self.safe - tolerance.clearance, self.self_safe - tolerance.clearance
            ):
                phases.add("acceptance")
                continue
            report = self.monitor.between(
                state.nodes,
                X,
                state.time,
                target.time,
                self.safe - tolerance.between,
                max(self.self_safe - tolerance.between, 0.0),
            )
            phases.add("acceptance")
            if report.certified:
                return outcome("", count)
            stations.extend(s for s in report.failing_parameters() if s not in stations)
            if len(stations) > 8:
                return outcome("clearance between the states", count)
        return outcome("no convergence", self.max_qps)

    def _solve(self, *at: Any, motion: bool) -> StepSolution:
        """Return the engine's answer; where even a zero step is forbidden by the margin, without the margin."""
        rows = at[-1]
        try:
            return self.engine.solve(*at, motion=motion)
        except InfeasibleStepError:
            if not motion or not len(rows) or rows.lower.max() <= 0.0:
                raise
        np.minimum(rows.lower, 0.0, out=rows.lower)
        return self.engine.solve(*at, motion=motion)

    def _settle(self, X: Array, target: Target, goal: PathPoint) -> Closed | None:
        """Return the configuration near `X` with its lengths closed and the tip at `goal`; None where another QP is due."""
        tolerance, gain = self.tolerances, None
        for _ in range(_SETTLING_STEPS):
            closed = self.engine.close(X, target, tolerance.member)
            error = self.task.residual(closed.tip_position, closed.tip_rotation, goal)[0]
            off = float(np.abs(error).max())
            if not (closed.error <= tolerance.member and off <= tolerance.settling):
                return None
            if off <= tolerance.tip:
                return closed
            gain = self.engine.gain() if gain is None else gain
            if gain is None:
                return None
            X = closed.X + gain @ error
        return None

    def _expected(self, target: Target, guess: Array) -> float:
        """Return about how far a node moves in the step, m; anything where the arm was at rest."""
        last = float(np.abs(guess).max())
        if last == 0.0 or target.base is not None:
            return self.influence
        way = target.path.at(target.end).position - target.path.at(target.start).position
        return max(last, float(np.abs(way).max()))

    def _rows(
        self, state: State, X: Array, time: float, stations: list[float], reach: float, *, motion: bool
    ) -> ClearanceRows:
        """Return the clearance rows at `X` and, as the end state moves them too, at the `stations` on the way there.

        Pairs that are further from their floor than `reach`, m, cannot become active in the QP. A pair that was
        missed because a member moved further than expected is found by the check of the new state, and corrected.
        """
        margin = self.tolerances.margin
        safe = (self.safe + margin, self.self_safe + margin)
        near = self.monitor.near(
            X,
            time,
            min(self.influence, self.safe + reach),
            use_fcl=motion,
            self_reach=min(self.influence, self.self_safe + 2.0 * reach),
        )
        rows = clearance_rows(self.monitor, near, *safe)
        if motion:
            # A zero step is always allowed, but for the margin that the step before may have used up.
            np.minimum(rows.lower, 2.0 * margin, out=rows.lower)
        for s in stations:
            between = state.nodes + s * (X - state.nodes)
            pairs = self.monitor.near(between, state.time + s * (time - state.time), 1.5 * self.safe)
            rows = rows.joined(clearance_rows(self.monitor, pairs, *safe, s))
        return rows
