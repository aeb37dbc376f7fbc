"""The proof for a trajectory of a serial arm, from its joint values alone."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vgtm_qp.arrays import Array
from vgtm_qp.certify.trajectory import read_trajectory
from vgtm_qp.certify.verdict import Finding, Verdict
from vgtm_qp.errors import Mistake, ProblemError
from vgtm_qp.problem.fields import GREATEST_LENGTH
from vgtm_qp.problem.problem import check_is_problem
from vgtm_qp.problem.table import shown
from vgtm_qp.result.chain import RecordedChain
from vgtm_qp.result.poses import base_poses

if TYPE_CHECKING:
    from vgtm_qp.problem import Problem
    from vgtm_qp.verify.obstacles import Body

_INSTANT = 1e-9
"""Times that differ by less are the same, s."""
_STRAIGHT = 1e-9
"""How far the base's rotation vector may be from the straight way between two rows, rad."""


def certify_file(problem: Problem, file: str | Path) -> Verdict:
    """Read a trajectory, as :func:`~vgtm_qp.certify.trajectory.read_trajectory` does, and certify it."""
    certifier = Certifier(problem)
    return certifier.certify(*read_trajectory(file, certifier.chain.quantity_names))


def certify(problem: Problem, times: ArrayLike, joints: ArrayLike) -> Verdict:
    """Prove or refute a trajectory of the problem's serial arm over the whole time, from its joint values alone.

    Joints move linearly between rows. What has to hold are limits, rates and accelerations of joints, the locks of the
    problem, and its clearances between bodies and to obstacles, moving ones and those of a moving base as well. A rate
    is the mean over a step, an acceleration the change of the rate over the time between the middles of two steps.

    Parameters
    ----------
    problem : Problem
        Of a serial arm; of its keys only those of the arm, of obstacles and of clearances count.
    times : (T,) array
        Increasing, from 0 or later, s. One row alone is a pose.
    joints : (T, J) array
        Values of all joints in the order of the problem, rad or m.

    Raises
    ------
    ProblemError
        The problem has a truss, a mesh of it cannot be read, or the arrays are no trajectory.
    """
    return Certifier(problem).certify(*_arrays(times, joints, problem))


class Certifier:
    """An arm and what it has to keep to, ready for any number of trajectories.

    ProblemError where the arm is a truss or a mesh cannot be read.
    """

    def __init__(self, problem: Problem) -> None:
        from vgtm_qp.arm.build import make_arm
        from vgtm_qp.verify.obstacles import read_obstacles

        check_is_problem(problem)
        if problem.arm is None:
            expected = "a serial arm, [arm]: certify takes serial arms in this version"
            raise problem.error([Mistake("truss", "a truss", expected)])
        self.chain = RecordedChain(make_arm(problem).record())
        self.table: dict[str, Any] = problem.to_dict()
        self.rules = problem.clearance
        self.bodies: list[Body]
        self.bodies, wrong, _ = read_obstacles(self.table, None, Path())
        if wrong:
            raise problem.error([Mistake("obstacle", said, "a mesh that can be read") for said in wrong])
        names = self.chain.quantity_names
        self.locks = [(names.index(lock.joint), lock.time) for lock in problem.arm.locked]

    def certify(self, times: Array, joints: Array) -> Verdict:
        """Return what is proven of values (T, J) at times (T,), s, which were checked to be a trajectory."""
        from vgtm_qp.certify.decide import DecidedBody, DecidedLinks, Way

        began = time.perf_counter()
        instants, states = self._states(times, joints)
        way = Way(self.chain, instants, states)
        violated, undecided = list(self._beyond_limits(times, joints)), list(self._in_doubt(instants, states))
        bounds = {"clearance": np.inf, "self-clearance": np.inf}
        kept: list[tuple[str, DecidedBody | DecidedLinks, float]] = [
            ("clearance", DecidedBody(way, body), self.rules.safe) for body in self.bodies
        ]
        if self.rules.self_collision:
            kept.append(("self-clearance", DecidedLinks(way), self.rules.between_members))
        for kind, pairs, floor in kept:
            decision = pairs.decide(floor)
            bounds[kind] = min(bounds[kind], decision.bound)
            for found, ranges in ((violated, decision.violated), (undecided, decision.undecided)):
                for low, high, names, value in ranges:
                    start, end = way.time(np.array([low, high], dtype=np.float64)).tolist()
                    found.append(Finding(start, end, kind, names, float(value), floor))
        return Verdict(
            clearance=float(bounds["clearance"]),
            self_clearance=float(bounds["self-clearance"]),
            violations=tuple(sorted(violated, key=_order)),
            undecided=tuple(sorted(undecided, key=_order)),
            time=time.perf_counter() - began,
        )

    def _states(self, times: Array, joints: Array) -> tuple[Array, Array]:
        """Return times (R,) and configurations (R, J + 6), with rows where the base comes to a pose of its motion."""
        poses = self.table["arm"].get("base_motion") or ()
        knots = np.array([pose["time"] for pose in poses], dtype=np.float64)
        inner = knots[(knots > times[0]) & (knots < times[-1])]
        instants = np.union1d(times, inner)
        values = np.stack([np.interp(instants, times, column) for column in joints.T], axis=1)
        return instants, np.concatenate([values, base_poses(self.table, instants)], axis=1)

    def _in_doubt(self, instants: Array, states: Array) -> Iterator[Finding]:
        """Yield what this proof does not cover: a base that changes its axis, and least angles between links."""
        for share in (0.25, 0.5, 0.8):
            poses = base_poses(self.table, instants[:-1] + share * np.diff(instants))
            straight = states[:-1, -6:] + share * np.diff(states[:, -6:], axis=0)
            off = np.abs(poses - straight).max(axis=1, initial=0.0)
            k = int(np.argmax(off)) if len(off) else -1
            if k >= 0 and off[k] > _STRAIGHT:
                yield Finding(
                    float(instants[k]), float(instants[k + 1]), "base", ("base",), float(off[k]), _STRAIGHT
                )
                break
        if self.rules.minimum_angle > 0.0:
            angle = float(self.rules.minimum_angle)
            yield Finding(float(instants[0]), float(instants[-1]), "angle", ("links",), 0.0, angle)

    def _beyond_limits(self, times: Array, values: Array) -> Iterator[Finding]:
        """Yield limits, rates and accelerations that are exceeded, and locked joints that move.

        A value that moves linearly is between those of its rows, and its rate is the mean one.
        """
        from vgtm_qp.verify.check import LIMIT_TOLERANCE, MEMBER_TOLERANCE, changes

        chain, ends = self.chain, np.stack([times, times], axis=1)
        rates, accelerations, rounding, its_rounding = changes(times, values, float(np.abs(values).max()))
        for k, since in self.locks:
            accelerations[np.abs(times[1:-1] - since) <= _INSTANT, k] = 0.0
        steps = np.stack([times[:-1], times[1:]], axis=1)
        middles = np.stack([times[:-2], times[2:]], axis=1)
        low, high = chain.stroke.T
        speed, change = np.abs(rates), np.abs(accelerations)
        free = chain.actuated
        yield from self._findings("limit", ends, values, low, free & (values < low - LIMIT_TOLERANCE))
        yield from self._findings("limit", ends, values, high, free & (values > high + LIMIT_TOLERANCE))
        beyond = free & (speed - rounding > chain.rate + LIMIT_TOLERANCE)
        yield from self._findings("rate", steps, speed, chain.rate, beyond)
        beyond = free & (change - its_rounding > chain.acceleration + LIMIT_TOLERANCE)
        yield from self._findings("acceleration", middles, change, chain.acceleration, beyond)
        held = np.where(free, 0.0, np.abs(values - chain.home_quantities))
        for k, since in self.locks:
            # A lock between two rows holds on the way to the later one.
            rows = slice(max(int(np.searchsorted(times, since + _INSTANT, side="right")) - 1, 0), None)
            held[rows, k] = np.maximum(held[rows, k], np.abs(values[rows, k] - values[rows, k][:1]))
        yield from self._findings("lock", ends, held, np.zeros(len(low)), held > MEMBER_TOLERANCE)

    def _findings(
        self, kind: str, spans: Array, values: Array, bound: Array, wrong: NDArray[np.bool_]
    ) -> Iterator[Finding]:
        """Yield one finding for each run of rows (K, J) in which the value of a joint is wrong.

        The rows are from times to times, `spans` (K, 2), s. `bound` (J,) are the joints' limits.
        """
        for j in np.flatnonzero(wrong.any(axis=0)).tolist():
            rows = np.flatnonzero(wrong[:, j])
            for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
                worst = values[run, j][int(np.argmax(np.abs(values[run, j] - bound[j])))]
                start, end = float(spans[run[0], 0]), float(spans[run[-1], 1])
                name = self.chain.quantity_names[j]
                yield Finding(start, end, kind, (name,), float(worst), float(bound[j]))


def _order(finding: Finding) -> tuple[float, str, Sequence[str]]:
    return finding.start, finding.kind, finding.names


def _arrays(times: ArrayLike, joints: ArrayLike, problem: Problem) -> tuple[Array, Array]:
    """Return times (T,) and values (T, J) as arrays; ProblemError with what makes them no trajectory."""
    mistakes: list[Mistake] = []
    found: dict[str, Array] = {}
    for name, given in (("times", times), ("joints", joints)):
        try:
            found[name] = np.array(given, dtype=np.float64)
        except (TypeError, ValueError):
            mistakes.append(Mistake(name, type(given).__name__, "an array of numbers"))
    if not mistakes:
        mistakes = list(_mistaken(found["times"], found["joints"], problem))
    if mistakes:
        raise ProblemError("certify", mistakes)
    return found["times"], found["joints"]


def _mistaken(times: Array, joints: Array, problem: Problem) -> Iterator[Mistake]:
    if times.ndim != 1 or not len(times):
        yield Mistake("times", f"an array of shape {times.shape}", "times (T,), at least one")
        return
    count = len(problem.arm.joint) if problem.arm else joints.shape[-1] if joints.ndim else 0
    if joints.shape != (len(times), count):
        expected = f"values ({len(times)}, {count}): a row for each time, a column for each joint"
        yield Mistake("joints", f"an array of shape {joints.shape}", expected)
        return
    for name, values in (("times", times), ("joints", joints)):
        wrong = np.argwhere(~(np.abs(values) <= GREATEST_LENGTH))
        if len(wrong):
            place = f"{name}[{', '.join(map(str, wrong[0].tolist()))}]"
            expected = f"a finite number between -{GREATEST_LENGTH:g} and {GREATEST_LENGTH:g}"
            yield Mistake(place, shown(float(values[tuple(wrong[0])])), expected)
            return
    if times[0] < 0:
        yield Mistake("times[0]", f"{times[0]:g}", "a time in seconds, 0 or more")
    back = np.flatnonzero(np.diff(times) <= 0.0)
    if len(back):
        k = int(back[0]) + 1
        expected = f"a time after that of the row before, {times[k - 1]:.9g} s"
        yield Mistake(f"times[{k}]", f"{times[k]:.9g}", expected)
