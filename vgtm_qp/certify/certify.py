"""The proof for anybody's trajectory of a problem's arm."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.arrays import Array
from vgtm_qp.certify.trajectory import Columns, Trajectory, given_trajectory, read_trajectory
from vgtm_qp.certify.verdict import Finding, Verdict
from vgtm_qp.errors import Mistake
from vgtm_qp.result.chain import RecordedChain
from vgtm_qp.result.poses import arm_table

if TYPE_CHECKING:
    from vgtm_qp.certify.motion import GivenMotion
    from vgtm_qp.certify.pairs import Kept
    from vgtm_qp.problem import Problem
    from vgtm_qp.verify.obstacles import Body


def certify(problem: Problem, times: ArrayLike, joints: ArrayLike | Mapping[str, ArrayLike]) -> Verdict:
    """Prove or refute a trajectory for the problem's arm and scene, over the whole time and not at its rows alone.

    Joints, or the lengths of a truss's actuators, move linearly between rows. At every instant their limits,
    rates, accelerations and locks have to hold, and the clearances of the problem. A moving base and moving
    obstacles are taken into account. The trajectory may start anywhere.

    Parameters
    ----------
    problem
        Only its keys of the arm, the obstacles and ``[clearance]`` are used.
    times
        (T,) s, increasing, from 0 or later. One row alone is a pose.
    joints
        (T, J) values of all joints, or (T, n_a) lengths of a truss's actuators, in the problem's order, rad or m; or
        (T,) values by name, in any order. Those that are locked from the start may be left out.

    Raises
    ------
    ProblemError
        The arm cannot be made, a mesh cannot be read, or the arrays do not form a trajectory.
    """
    return Certifier(problem).certify(times, joints)


class Certifier:
    """A problem's arm and scene, ready for any number of trajectories; raises as `certify` does."""

    def __init__(self, problem: Problem) -> None:
        from vgtm_qp.arm.build import make_arm
        from vgtm_qp.problem.problem import check_is_problem
        from vgtm_qp.verify.arm import recorded_arm
        from vgtm_qp.verify.obstacles import read_obstacles

        check_is_problem(problem)
        made = make_arm(problem)
        members = np.zeros((0, 2), dtype=np.int64) if problem.truss is None else made.bodies.joints
        self.arm = recorded_arm(made.record(), members)
        self.columns = Columns.of(self.arm, problem)
        self._table: dict[str, Any] = problem.to_dict()
        self._rules = problem.clearance
        self._bodies, wrong, self._notes = read_obstacles(self._table, None, Path())
        if wrong:
            raise problem.error([Mistake("obstacle", said, "a mesh that can be read") for said in wrong])

    def certify(self, times: ArrayLike, joints: ArrayLike | Mapping[str, ArrayLike]) -> Verdict:
        """Prove or refute a trajectory; arguments and errors are as of :func:`certify`."""
        return self._prove(given_trajectory(times, joints, self.columns))

    def certify_file(self, file: str | Path) -> Verdict:
        """Prove or refute the trajectory in a file, see :func:`~vgtm_qp.certify.trajectory.read_trajectory`."""
        return self._prove(read_trajectory(file, self.columns))

    def _prove(self, trajectory: Trajectory) -> Verdict:
        from vgtm_qp.certify.angles import keep_angles
        from vgtm_qp.certify.decide import decide
        from vgtm_qp.certify.limits import beyond_limits

        began = time.perf_counter()
        values = self._quantities(trajectory)
        wrong = list(beyond_limits(self.arm, self._table, trajectory.time, values))
        motion, doubt = self._motion(trajectory.time, values)
        decided = {} if motion is None else decide(motion, self.kept(motion))
        if motion is not None and self._rules.minimum_angle > 0.0:
            decided["angle"] = keep_angles(motion, self._rules.minimum_angle)
        for decision in decided.values():
            wrong += decision.violations
            doubt += decision.undecided
        doubt += () if motion is None else motion.doubts()
        # Where the motion is unknown, bodies may be anywhere.
        least = -np.inf if any(finding.kind == "motion" for finding in doubt) else np.inf
        bounds = {kind: min(decision.bound, least) for kind, decision in decided.items()}
        return Verdict(
            clearance=bounds.get("clearance", least),
            self_clearance=bounds.get("self-clearance", least),
            violations=tuple(sorted(wrong, key=_order)),
            undecided=tuple(sorted(doubt, key=_order)),
            time=time.perf_counter() - began,
            notes=tuple(self._notes),
        )

    def _quantities(self, trajectory: Trajectory) -> Array:
        """Return (T, M) the arm's quantities at the rows; joints that follow others need not be given."""
        values = trajectory.filled(self.arm.home_quantities)
        given = np.intersect1d(self.arm.followers[:, 0], trajectory.quantities)
        values[:, given] = self.arm.of_values(values)[:, given]
        return values

    def _motion(self, instants: Array, values: Array) -> tuple[GivenMotion | None, list[Finding]]:
        """Return the motion through all rows and changes of the base, and findings where it is unknown."""
        from vgtm_qp.certify.motion import JointMotion

        base_motion = arm_table(self._table).get("base_motion") or ()
        corners = np.array([0.0, *(pose["time"] for pose in base_motion)])
        inner = corners[(corners > instants[0]) & (corners < instants[-1])]
        knots = np.union1d(instants, inner)
        at_knots = np.stack([np.interp(knots, instants, column) for column in values.T], axis=1)
        if len(knots) == 1:
            knots, at_knots = np.repeat(knots, 2), np.repeat(at_knots, 2, axis=0)
        if isinstance(self.arm, RecordedChain):
            return JointMotion(self.arm, knots, self.arm.joints(at_knots), self._table), []
        from vgtm_qp.certify.truss_motion import truss_motion

        return truss_motion(self.arm, knots, at_knots, self._table)

    def kept(self, motion: GivenMotion) -> list[Kept]:
        """Return the pairs that have to keep their clearances along a motion of the arm."""
        from vgtm_qp.certify.pairs import KeptBodies, KeptMembers

        kinds: dict[Any, list[Body]] = {}
        for body in self._bodies:
            kinds.setdefault(body.shape.distance, []).append(body)
        kept: list[Kept] = [KeptBodies(motion, self._rules.safe, bodies) for bodies in kinds.values()]
        if self._rules.self_collision:
            kept.append(KeptMembers(motion, self._rules.between_members))
        return kept


def _order(finding: Finding) -> tuple[float, str, tuple[str, ...]]:
    return finding.start, finding.kind, finding.names
