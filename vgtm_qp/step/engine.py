"""What an attempt asks of the QP: one displacement, and members back to their lengths. Two engines, one answer.

The fused engine compiles everything between node positions and QP into one call; the plain engine linearises in NumPy,
serves every truss and every solver by name, and is what the fused one is tested against.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.qp.fused import Closed, FusedSolver, TipGoal
from vgtm_qp.qp.numbers import ClearanceRows, StepSolution
from vgtm_qp.qp.solvers import StepSolver
from vgtm_qp.step.linearise import Linearisation, Target
from vgtm_qp.step.path import PathPoint
from vgtm_qp.step.task import TipTask

Array = NDArray[np.float64]


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
    ) -> StepSolution:
        """Return the QP's answer at `X` (N, 3) with Jacobians at `Y`; raise ``SolverError`` instead of a wrong one."""
        ...

    def close(self, X: Array, target: Target, tolerance: float) -> Closed:
        """Return the configuration near `X` whose members have their lengths."""
        ...


class PlainEngine:
    """NumPy linearisation and a solver by name."""

    def __init__(self, linearisation: Linearisation, solver: StepSolver) -> None:
        self._linearisation = linearisation
        self._solver = solver
        layout = linearisation.layout
        self._jacobian = np.zeros((layout.node_columns, layout.node_columns))

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
    ) -> StepSolution:
        """See :class:`Engine`."""
        at = None if Y is X else Y
        numbers = self._linearisation.numbers(X, vertices, target, progress, rows, motion=motion, at=at)
        return self._solver.solve(numbers)

    def close(self, X: Array, target: Target, tolerance: float) -> Closed:
        """See :class:`Engine`."""
        layout, kinematics = self._linearisation.layout, self._linearisation.kinematics
        wanted = self._linearisation.home_lengths.copy()
        actuators, free = layout.truss.actuators, layout.truss.free
        X, worst = X.copy(), np.inf
        for _ in range(5):
            kinematics.evaluate(X)
            wanted[actuators] = np.clip(kinematics.lengths[actuators], target.lower, target.upper)
            error = wanted - kinematics.lengths
            worst = float(np.max(np.abs(error)))
            if worst <= tolerance or not worst < 1e-2:
                break
            layout.length_jacobian(kinematics.gradient, self._jacobian)
            X[free] += np.linalg.solve(self._jacobian, error).reshape(-1, 3)
        return Closed(X, kinematics.lengths.copy(), worst, kinematics.tip_position(X), kinematics.tip_rotation.copy())


class FusedEngine:
    """One compiled call from positions to QP, for trusses whose bays can be eliminated one after another."""

    def __init__(self, solver: FusedSolver, task: TipTask) -> None:
        self._solver = solver
        self._task = task

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
    ) -> StepSolution:
        """See :class:`Engine`."""
        solver = self._solver
        solver.load(
            X, Y, X if target.base is None else target.base, vertices, target.lower, target.upper, motion=motion
        )
        error, rate, across = self._task.residual(solver.tip_position, solver.tip_rotation, goal)
        return solver.solve(TipGoal(rate * (target.end - target.start), error, across), progress, rows)

    def close(self, X: Array, target: Target, tolerance: float) -> Closed:
        """See :class:`Engine`."""
        return self._solver.close(X, target.lower, target.upper, tolerance)
