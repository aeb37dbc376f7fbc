"""One attempt at a step: QPs and their corrections until every constraint holds, then the proof between the states."""

from __future__ import annotations

from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

from vgtm_qp.errors import SolverError
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.qp.condensed import InfeasibleStepError
from vgtm_qp.qp.numbers import ClearanceRows, StepSolution
from vgtm_qp.qp.solvers import StepSolver
from vgtm_qp.step.linearise import Linearisation, Target, clearance_rows
from vgtm_qp.step.state import State

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Tolerances:
    """What an accepted state is held against: lengths and tip in m (rad), clearance in m below `safe`.

    They are tighter than the published tolerances of ``verify`` by a decade, so that rounding cannot decide.
    """

    member: float = 1e-10
    stroke: float = 1e-10
    tip: float = 1e-8
    clearance: float = 1e-10
    between: float = 5e-5
    margin: float = 1e-8


@dataclass
class Phases:
    """Seconds spent in each phase of a step."""

    seconds: dict[str, float] = field(
        default_factory=lambda: dict.fromkeys(("kinematics", "distance", "qp", "correction", "acceptance"), 0.0)
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
    nodes, control_vertices : arrays
        The new configuration, valid where accepted.
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
    nodes: Array
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
        linearisation: Linearisation,
        solver: StepSolver,
        monitor: Clearance,
        safe: float,
        influence: float,
        *,
        tolerances: Tolerances | None = None,
        max_qps: int = 8,
    ) -> None:
        self.linearisation = linearisation
        self.solver = solver
        self.monitor = monitor
        self.safe = safe
        self.influence = influence
        self.tolerances = tolerances or Tolerances()
        self.max_qps = max_qps
        self.phases = Phases()
        layout = linearisation.layout
        self._jacobian = np.zeros((layout.node_columns, layout.node_columns))

    def run(self, state: State, target: Target) -> Outcome:
        """Return the outcome of moving from `state` along the target's piece of path; no state is changed."""
        tolerance, phases = self.tolerances, self.phases
        phases.start()
        X, vertices, progress = np.array(state.nodes), np.array(state.control_vertices), 0.0
        stations: list[float] = []
        motion_solution: StepSolution | None = None
        motion_rows: ClearanceRows | None = None

        def outcome(reason: str, count: int) -> Outcome:
            return Outcome(not reason, X, vertices, progress, reason, motion_solution, motion_rows, count)

        for count in range(1, self.max_qps + 1):
            rows = self._rows(state, X, target.time if count > 1 else state.time, stations, motion=count == 1)
            phases.add("distance")
            numbers = self.linearisation.numbers(X, vertices, target, progress, rows, motion=count == 1)
            phases.add("kinematics")
            try:
                solution = self.solver.solve(numbers)
            except InfeasibleStepError:
                return outcome("infeasible", count)
            except SolverError as error:
                return outcome(str(error), count)
            finally:
                phases.add("qp")
            if count == 1:
                motion_solution, motion_rows = solution, rows
            X = X + solution.nodes
            if target.base is not None:
                base = self.linearisation.layout.truss.base
                X[base] = target.base[base]
            vertices = vertices + solution.vertices
            progress = min(max(progress + solution.progress, 0.0), 1.0)
            if not np.all(np.isfinite(X)):
                return outcome("singular pose", count)
            if count == 1 and float(np.max(np.abs(solution.nodes))) > 1e-3:
                continue
            if not self._close_lengths(X, target):
                phases.add("correction")
                continue
            error = self._tip_error(X, target, progress)
            phases.add("correction")
            if error > tolerance.tip:
                continue
            least = self.monitor.least(X, target.time)[0]
            if least < self.safe - tolerance.clearance:
                phases.add("acceptance")
                continue
            report = self.monitor.between(state.nodes, X, state.time, target.time, self.safe - tolerance.between)
            phases.add("acceptance")
            if report.certified:
                return outcome("", count)
            stations.extend(s for s in report.failing_parameters() if s not in stations)
            if len(stations) > 8:
                return outcome("clearance between the states", count)
        return outcome("no convergence", self.max_qps)

    def _rows(self, state: State, X: Array, time: float, stations: list[float], *, motion: bool) -> ClearanceRows:
        """Return the clearance rows at `X` and, as the end state moves them too, at the `stations` on the way there."""
        safe = self.safe + self.tolerances.margin
        rows = clearance_rows(self.monitor, self.monitor.near(X, time, self.influence), safe)
        if motion:
            np.minimum(rows.lower, 0.0, out=rows.lower)
        for s in stations:
            between = state.nodes + s * (X - state.nodes)
            pairs = self.monitor.near(between, state.time + s * (time - state.time), 1.5 * self.safe)
            rows = rows.joined(clearance_rows(self.monitor, pairs, safe, s))
        return rows

    def _tip_error(self, X: Array, target: Target, progress: float) -> float:
        goal = target.path.at(target.start + progress * (target.end - target.start))
        return float(np.max(np.abs(self.linearisation.task.rows(X, goal).error), initial=0.0))

    def _close_lengths(self, X: Array, target: Target) -> bool:
        """Newton on the lengths alone: fixed members to their length, actuators into their box; `X` is corrected."""
        layout, kinematics = self.linearisation.layout, self.linearisation.kinematics
        wanted = self.linearisation.home_lengths.copy()
        actuators, free = layout.truss.actuators, layout.truss.free
        for _ in range(4):
            kinematics.evaluate(X)
            wanted[actuators] = np.clip(kinematics.lengths[actuators], target.lower, target.upper)
            error = wanted - kinematics.lengths
            worst = float(np.max(np.abs(error)))
            if worst <= self.tolerances.member:
                return True
            if not worst < 1e-2:
                return False
            layout.length_jacobian(kinematics.gradient, self._jacobian)
            _, _, step, info = dgesv(self._jacobian, error)
            if info != 0:
                return False
            X[free] += step.reshape(-1, 3)
        return False
