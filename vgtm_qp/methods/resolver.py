"""Base class of the resolvers of all methods without a QP: state, phases of time, reason of a failure."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np

from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.arrays import Array
from vgtm_qp.errors import CurveError, SolverError
from vgtm_qp.problem import Problem
from vgtm_qp.qp.answer import Closed
from vgtm_qp.rotation import vector_from_rotation
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.actuation import Actuation
from vgtm_qp.step.attempt import Phases
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.path import Path
from vgtm_qp.step.resolver import Resolver
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.step import Step, StepStatus

_COLLAPSED = 1e-3
LENGTH_TOLERANCE = 1e-11
TIP_TOLERANCE = 1e-10
MAX_CORRECTIONS = 30


class Moved(NamedTuple):
    """Where a step leads: the configuration, control vertices (V, 3), m, and torsion (T,), rad."""

    q: Array
    control_vertices: Array
    torsion: Array


class MethodResolver(Resolver, ABC):
    """Moves an arm step by step by a method without a QP.

    Its steps do not brake, drive pairs apart or follow goals of control vertices.
    """

    def __init__(self, setup: Setup) -> None:
        super().__init__()
        self._setup = setup
        self._state = setup.home_state()
        self._actuation = Actuation(setup)
        self._clock = Phases("kinematics", "solve", "correction", "acceptance")
        self._steps = 0

    def _follow(self, path: Path, start: float, end: float, dt: float, whole: float) -> Step:
        """See :class:`Resolver`; a blocked step has its reason."""
        self._steps += 1
        self._clock.start()
        try:
            moved = self._move(path, start, end, dt)
            nodes = self.setup.arm.nodes(moved.q)
            self._refuse_breakdown(nodes, path, start, end)
        except (SolverError, CurveError, np.linalg.LinAlgError) as error:
            return Step.stopped(self.state, f"step {self._steps}: {error}", 0)
        arm, kinematics = self.setup.arm, self.setup.kinematics
        kinematics.evaluate(moved.q)
        tip = arm.end_effector.position(nodes), kinematics.tip_rotation.copy()
        closed = Closed(moved.q, kinematics.quantities.copy(), 0.0, *tip)
        self.state = self.state.next(arm, dt, closed, moved.control_vertices, moved.torsion)
        self._clock.add("kinematics")
        return Step(StepStatus.REACHED, 1.0, self.state, "", 0).over(whole, None)

    @abstractmethod
    def _move(self, path: Path, start: float, end: float, dt: float) -> Moved:
        """Return where the step leads, or raise SolverError."""

    def _refuse_breakdown(self, nodes: Array, path: Path, start: float, end: float) -> None:
        """Raise SolverError if nodes (N, 3), m, have moved too far for a linear step."""
        arm = self.setup.arm
        members = None if arm.bays is None else truss_of(arm).members
        shortest = arm.unit if members is None else float(arm.home_quantities.min())
        if too_long := self.setup.too_long(nodes - self.state.nodes):
            raise SolverError(too_long)
        asked = float(np.linalg.norm(path.at(end).position - path.at(start).position))
        limit = 0.5 * shortest + 3.0 * asked
        moved = float(np.max(np.abs(nodes - self.state.nodes)))
        if not moved <= limit:
            raise SolverError(
                f"a node would move by {moved:.3g} m, more than {limit:.3g} m: the pose is nearly singular"
            )
        if members is None:
            return
        ratio = np.linalg.norm(nodes[members[:, 0]] - nodes[members[:, 1]], axis=1) / arm.home_quantities
        if float(ratio.min()) < _COLLAPSED:
            raise SolverError(f"member {arm.quantity_names[int(np.argmin(ratio))]} collapsed to a point")


def arm_without_curve(problem: Problem) -> Setup:
    """Return the arm of a problem without its curve, for methods that solve no QP of this package.

    Raises
    ------
    ProblemError
        The arm cannot be built.
    """
    return build_arm(problem.replace({"method": problem.method.kept_by("qp", "none")}), solves=False)


def displacement_to(goal: TipGoal, start: TipGoal) -> TipGoal:
    """Return a goal whose rates are the displacement, m, and the rotation vector, rad, to it from the pose `start`."""
    turned = vector_from_rotation(goal.rotation @ start.rotation.T)
    return goal._replace(velocity=goal.position - start.position, spin=turned)
