"""What an attempt asks of the QP: one displacement, and members back to their lengths. Two engines, one answer.

The fused engine compiles everything between node positions and QP into one call; the plain engine linearises in NumPy,
serves every truss and every solver by name, and is what the fused one is tested against.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

from vgtm_qp.errors import SolverError
from vgtm_qp.qp.fused import Closed, FusedSolver, Taken, TipGoal
from vgtm_qp.qp.fused_graph import NEAR, SETTLING_STEPS
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.lengths import LengthSolver
from vgtm_qp.qp.long.staged import StagedSolver
from vgtm_qp.qp.numbers import ClearanceRows, StepNumbers, StepSolution
from vgtm_qp.qp.settle import held, settling_gain
from vgtm_qp.qp.solvers import StepSolver
from vgtm_qp.step.linearise import Linearisation, Target, base_frame
from vgtm_qp.step.path import PathPoint

Array = NDArray[np.float64]

_SETTLED = 1e-3
"""A tip this much nearer to its goal than it must be gains nothing by another iteration."""

_ON_PATH = 1e-6
"""Solvers leave slacks of this size, m or rad, where the answer's are zero."""


@dataclass(frozen=True)
class Accuracy:
    """How exactly members, m, and tip, m or rad, are settled, and from how far off the tip may be brought there."""

    member: float
    tip: float
    start: float


class Engine(Protocol):
    """Solves the QP of a step and closes the lengths."""

    def solve(
        self,
        X: Array,
        Y: Array,
        vertices: Array,
        target: Target,
        goal: PathPoint,
        progress: float,
        rows: ClearanceRows,
        *,
        motion: bool,
        torsion: Array | None = None,
    ) -> StepSolution:
        """Return the QP's answer at `X` (N, 3) with Jacobians at `Y`; raise ``SolverError`` instead of a wrong one."""
        ...

    def settle(self, X: Array, target: Target, goal: PathPoint, accuracy: Accuracy) -> Closed | None:
        """Return the configuration near `X` with its lengths closed and the tip at `goal`; None where a QP is due."""
        ...


class PlainEngine:
    """NumPy linearisation and a solver by name."""

    def __init__(self, linearisation: Linearisation, solver: StepSolver) -> None:
        self._linearisation = linearisation
        self._solver = solver
        self._lengths = LengthSolver(linearisation.layout)
        self._last: tuple[StepNumbers, StepSolution] | None = None

    def solve(
        self,
        X: Array,
        Y: Array,
        vertices: Array,
        target: Target,
        goal: PathPoint,  # noqa: ARG002
        progress: float,
        rows: ClearanceRows,
        *,
        motion: bool,
        torsion: Array | None = None,
    ) -> StepSolution:
        """See :class:`Engine`."""
        at = None if Y is X else Y
        numbers = self._linearisation.numbers(
            X, vertices, target, progress, rows, motion=motion, at=at, torsion=torsion
        )
        solution = self._solver.solve(numbers)
        # The kinematics overwrites its gradients at the next configuration.
        self._last = replace(numbers, gradient=numbers.gradient.copy()), solution
        return solution

    def settle(self, X: Array, target: Target, goal: PathPoint, accuracy: Accuracy) -> Closed | None:
        """See :class:`Engine`."""
        gain = self._gain()
        for step in range(SETTLING_STEPS + 1):
            closed = self._close(X, target, accuracy.member)
            task = self._linearisation.task
            error = task.residual(closed.tip_position, closed.tip_rotation, goal)[0]
            off = float(np.abs(error).max())
            if not (closed.error <= accuracy.member and off <= accuracy.start):
                return None
            if gain is None or step == SETTLING_STEPS or off <= _SETTLED * accuracy.tip:
                break
            X = closed.X + gain @ error
        return closed if off <= accuracy.tip else None

    def _gain(self) -> Array | None:
        """Return what settles the tip after the last QP, (N, 3, n_e); None where only another QP does."""
        layout = self._linearisation.layout
        truss, weights = layout.truss, layout.weights
        if layout.hard_tracking or self._last is None:
            return None
        numbers, solution = self._last
        if isinstance(self._solver, StagedSolver):
            return self._solver.gain(held(solution.actuators, numbers.lower, numbers.upper))
        jacobian = layout.length_jacobian(numbers.gradient)
        _, _, response, failed = dgesv(jacobian, np.eye(truss.member_count)[:, truss.actuators])
        if failed:
            return None
        every = np.zeros((truss.node_count, 3, response.shape[1]))
        every[truss.free] = response.reshape(-1, 3, response.shape[1])
        tip = numbers.tip_jacobian @ every[truss.tip].reshape(-1, response.shape[1])
        free = ~held(solution.actuators, numbers.lower, numbers.upper)
        gain = settling_gain(
            response, tip, free, weights.node_rate, weights.actuator_rate + weights.stroke_centring
        )
        return None if gain is None else every @ gain

    def _close(self, X: Array, target: Target, tolerance: float) -> Closed:
        """Return the configuration near `X` whose members have their lengths."""
        layout, kinematics = self._linearisation.layout, self._linearisation.kinematics
        wanted = self._linearisation.home_lengths.copy()
        actuators, free = layout.truss.actuators, layout.truss.free
        X, worst = X.copy(), np.inf
        for _ in range(5):
            kinematics.evaluate_members(X)
            wanted[actuators] = np.clip(kinematics.lengths[actuators], target.lower, target.upper)
            error = wanted - kinematics.lengths
            worst = float(np.max(np.abs(error)))
            # Divided by a short step's duration, once or twice, an error of `tolerance` is a rate that counts.
            if worst <= 1e-3 * tolerance or not worst < 1e-2:
                break
            try:
                X[free] += self._lengths.solve(kinematics.gradient, error)
            except SolverError:
                worst = np.inf
                break
        return Closed(
            X, kinematics.lengths.copy(), worst, kinematics.tip_position(X), kinematics.tip_rotation.copy()
        )


class ElasticEngine(PlainEngine):
    """A tip that may leave its path at an exact penalty: there it is where the QP puts it."""

    def settle(self, X: Array, target: Target, goal: PathPoint, accuracy: Accuracy) -> Closed | None:
        """See :class:`Engine`; a tip that had to leave its path is not moved."""
        slack = 0.0 if self._last is None else self._last[1].tip_slack
        closed = super().settle(X, target, goal, accuracy) if slack <= _ON_PATH else None
        if closed is not None or slack <= accuracy.tip:
            return closed
        closed = self._close(X, target, accuracy.member)
        return closed if closed.error <= accuracy.member else None


class FusedEngine:
    """One compiled call from positions to QP, for trusses whose bays can be eliminated one after another."""

    def __init__(self, solver: FusedSolver) -> None:
        self._solver = solver

    def drawn(self, layout: Layout) -> FusedEngine:
        """Return the engine for a layout that differs in the control vertices with goals alone."""
        return FusedEngine(self._solver.drawn(layout))

    def solve(
        self,
        X: Array,
        Y: Array,
        vertices: Array,
        target: Target,
        goal: PathPoint,
        progress: float,
        rows: ClearanceRows,
        *,
        motion: bool,
        torsion: Array | None = None,
    ) -> StepSolution:
        """See :class:`Engine`."""
        self._load(X, Y, vertices, target, goal, progress, torsion, motion=motion)
        return self._solver.solve(rows)

    def _load(
        self,
        X: Array,
        Y: Array,
        vertices: Array,
        target: Target,
        goal: PathPoint,
        progress: float,
        torsion: Array | None,
        *,
        motion: bool,
    ) -> None:
        solver, shape = self._solver, self._solver.layout.general
        curve, span = None, target.end - target.start
        if shape is not None:
            frame = base_frame(solver.layout.truss, target.base_rotation)
            curve = shape.rows(vertices, np.zeros(0) if torsion is None else torsion, frame)
        solver.load(
            X,
            Y,
            vertices,
            target.lower,
            target.upper,
            TipGoal(goal.position, goal.rotation, goal.velocity * span, goal.spin * span),
            progress,
            motion=motion,
            base=target.base,
            curve=curve,
            goals=target.vertex_goals,
        )

    def ask(
        self,
        X: Array,
        Y: Array,
        vertices: Array,
        target: Target,
        goal: PathPoint,
        progress: float,
        rows: ClearanceRows,
        *,
        motion: bool,
        torsion: Array | None = None,
    ) -> Callable[[], Taken] | None:
        """Solve the QP as :meth:`solve` does; return what checks the answer and settles where it leads.

        None where that is not one call: the path turns within the step, the base moves, or too many rows are near.
        """
        near = len(rows)
        if near > NEAR or target.base is not None or not target.path.is_straight(target.start, target.end):
            return None
        self._load(X, Y, vertices, target, goal, progress, torsion, motion=motion)
        answer = self._solver.ask(rows)
        return lambda: self._solver.take(answer, near)

    def settle(self, X: Array, target: Target, goal: PathPoint, accuracy: Accuracy) -> Closed | None:
        """See :class:`Engine`."""
        closed, before, after = self._solver.settle(
            X, target.lower, target.upper, goal.position, goal.rotation
        )
        if closed.error <= accuracy.member and before <= accuracy.start and after <= accuracy.tip:
            return closed
        return None
