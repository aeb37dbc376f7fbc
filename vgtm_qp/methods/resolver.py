"""Base class of the resolvers of all other methods: state, phases of time, and the reason of a failure."""

from __future__ import annotations

from abc import ABC, abstractmethod
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import CurveError, SolverError
from vgtm_qp.problem import Problem
from vgtm_qp.rotation import vector_from_rotation
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.path import Path, PathPoint
from vgtm_qp.step.resolver import Step, StepStatus
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State, frozen

Array = NDArray[np.float64]

_COLLAPSED = 1e-3
LENGTH_TOLERANCE = 1e-11
TIP_TOLERANCE = 1e-10
MAX_CORRECTIONS = 30


class MethodResolver(ABC):
    """Moves an arm step by step, as :class:`vgtm_qp.step.resolver.Resolver` does, by one of the other methods."""

    def __init__(self, setup: Setup, step_limit: float | None) -> None:
        self.setup = setup
        self.state = setup.home_state()
        self.phases = dict.fromkeys(("kinematics", "solve", "correction", "acceptance"), 0.0)
        self.rank: int | None = None
        """Rank of the Jacobian in the last step, None where the method does not reveal it."""
        self.solver: str | None = None
        """Name of the QP solver, None where the method solves no QP."""
        self._limit = step_limit
        self._steps = 0
        self._mark = 0.0

    def tip(self) -> tuple[Array, Array]:
        """Return position (3,), m, and rotation (3, 3) of the end effector in the present state."""
        kinematics = self.setup.kinematics
        kinematics.evaluate(self.state.nodes)
        return self.setup.arm.end_effector.position(self.state.nodes), kinematics.tip_rotation.copy()

    def follow(self, path: Path, start: float, end: float, *, dt: float | None = None) -> Step:
        """Move along `path` from its value `start` to `end` in one step; a blocked step has its reason."""
        dt = self.setup.dt if dt is None else dt
        self._steps += 1
        self._mark = perf_counter()
        try:
            nodes, vertices, progress = self._move(path, start, end, dt)
            self._refuse_breakdown(nodes, path, start, end)
        except (SolverError, CurveError, np.linalg.LinAlgError) as error:
            reason = f"step {self._steps}: {error}"
            return _step(StepStatus.BLOCKED, 0.0, self.state, reason)
        kinematics = self.setup.kinematics
        kinematics.evaluate(nodes)
        lengths = frozen(kinematics.quantities)
        before = self.state
        self.state = State(
            time=before.time + dt,
            q=(q := frozen(nodes)),
            nodes=q,
            control_vertices=frozen(vertices),
            quantities=lengths,
            rates=frozen((lengths - before.quantities) / dt),
            motion=frozen(nodes - before.nodes),
            duration=dt,
        )
        self.spend("kinematics")
        status = StepStatus.REACHED if progress >= 1.0 - 1e-9 else StepStatus.SLOWED
        return _step(status, progress, self.state, "")

    def spend(self, phase: str) -> None:
        """Add the time since the last call to `phase`."""
        now = perf_counter()
        self.phases[phase] += now - self._mark
        self._mark = now

    @abstractmethod
    def _move(self, path: Path, start: float, end: float, dt: float) -> tuple[Array, Array, float]:
        """Return node positions, control vertices and progress after the step, or raise SolverError."""

    def _refuse_breakdown(self, nodes: Array, path: Path, start: float, end: float) -> None:
        truss, lengths = self.setup.truss, self.setup.arm.home_quantities
        asked = float(np.linalg.norm(path.at(end).position - path.at(start).position))
        limit = self._limit or 0.5 * float(lengths.min()) + 3.0 * asked
        moved = float(np.max(np.abs(nodes - self.state.nodes)))
        if not moved <= limit:
            raise SolverError(
                f"a node would move by {moved:.3g} m, more than {limit:.3g} m: the pose is nearly singular"
            )
        ratio = np.linalg.norm(nodes[truss.members[:, 0]] - nodes[truss.members[:, 1]], axis=1) / lengths
        if float(ratio.min()) < _COLLAPSED:
            raise SolverError(f"member {truss.member_names[int(np.argmin(ratio))]} collapsed to a point")


def arm_without_curve(problem: Problem) -> Setup:
    """Return the arm of a problem without its curve, for methods that solve no QP of this package.

    Raises
    ------
    ProblemError, TrussError
        The arm cannot be built.
    """
    # The solver is never called; this one compiles no kernels.
    changes = {"method.tracking": "none", "method.hard_tracking": False, "method.solver": "piqp"}
    return build_arm(problem.replace(changes))


def pose_displacement(start: PathPoint, end: PathPoint) -> tuple[Array, Array]:
    """Return the displacement (3,), m, and the rotation vector (3,), rad, from one pose to another."""
    return end.position - start.position, vector_from_rotation(end.rotation @ start.rotation.T)


def _step(status: StepStatus, progress: float, state: State, reason: str) -> Step:
    return Step(status, progress, state, reason, 0)
