"""Braking: how an arm with limited accelerations comes to rest, proven before each step is taken.

A moving arm with limited accelerations cannot stay where it is. It is let into a state only if steps are known that
bring it from there to rest, each within the limits and clear, so that what lies ahead can never trap it: where no
other step is found the arm takes the first of those. A tip that is held to its path brakes along it. An elastic tip,
and one whose base moves on, may leave it: then every actuator brakes by itself, which strokes always allow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import SolverError
from vgtm_qp.qp.fused import Closed
from vgtm_qp.qp.lengths import LengthSolver
from vgtm_qp.step.arm import Arm
from vgtm_qp.step.attempt import Attempt, Outcome
from vgtm_qp.step.linearise import Target
from vgtm_qp.step.path import Path
from vgtm_qp.step.state import State

Array = NDArray[np.float64]
Box = tuple[Array, Array]

_MOST_STEPS = 60
_SPARE_STEPS = 4
"""Steps that braking may take, at most, and beyond those that the fastest actuator needs by itself."""

_GENTLER = (0.5, 0.75)
"""Parts of the way of the step before that a step aims at where braking as hard as possible fails."""

_MOST_RIDING = 500
"""Steps, at most, that an arm is followed on a base that moves on."""

_NEWTON_STEPS = 8

_INSTANT = 1e-9
"""Times that differ by less are the same, s."""


@dataclass(frozen=True, eq=False)
class Braking:
    """Steps that bring an arm to rest from `origin`: states, and the values of `path` there.

    Attributes
    ----------
    on_path : int
        In so many steps the tip stays on the path; in the others it does not.
    rank : int
        0 where the tip stays on its path to the end or need not, 1 where it comes to rest on it and leaves it
        afterwards, since the base goes on, 2 where it leaves it at once. The lower the better.
    """

    origin: State
    path: Path
    steps: list[tuple[State, float]]
    on_path: int
    rank: int = 0

    @property
    def rest(self) -> Braking:
        """What is left after the first step."""
        steps, on_path = self.steps[1:], max(self.on_path - 1, 0)
        return replace(self, origin=self.steps[0][0], steps=steps, on_path=on_path)


@dataclass(frozen=True, eq=False)
class Brakes:
    """How one arm brakes in steps of `dt`.

    Attributes
    ----------
    arm : Arm
    attempt : Attempt
        Of the same arm.
    dt : float
        Duration of a step, s.
    box
        Least and greatest lengths of the actuators, m, after a step from a state.
    target
        What a step is asked for: from a state along a path, from one of its values to another, within a box.
    lengths
        What closes the arm's lengths; it takes its time to be made, and few arms ever need it.
    """

    arm: Arm
    attempt: Attempt
    dt: float
    box: Callable[[State], Box]
    target: Callable[[State, Path, float, float, Box], Target]
    lengths: Callable[[], LengthSolver]

    def find(self, state: State, path: Path, value: float, piece: float) -> Braking | None:
        """Return the steps that bring the arm from `state` to where it may stay, or None where they were not found.

        The tip is at `value` of `path`, and goes on by at most `piece` in each step where it stays on it.
        """
        if self.arm.tip_mode == "elastic":
            found = self._let_go(state) or self._yielding(state)
            return None if found is None else Braking(state, path, [(now, value) for now in found], 0)
        ends = self._until_the_base_rests()
        along = self._along(state, path, value, piece, ends)
        if along is not None:
            return Braking(state, path, along, len(along))
        if self.arm.base_motion is None:
            return None
        along = self._along(state, path, value, piece, -np.inf)
        if along is not None:
            last, value = along[-1] if along else (state, value)
            ride = self._let_go(last)
            if ride is not None:
                return Braking(state, path, [*along, *((now, value) for now in ride)], len(along), 1)
        return self.letting_go(state, path, value)

    def letting_go(self, state: State, path: Path, value: float) -> Braking | None:
        """Return the steps in which every actuator brakes by itself, or None where they were not found."""
        found = self._let_go(state)
        return None if found is None else Braking(state, path, [(now, value) for now in found], 0, 2)

    def _until_the_base_rests(self) -> float:
        """Return the time from which the base rests, s."""
        base = self.arm.base_motion
        return -np.inf if base is None else base.end - _INSTANT

    def _along(
        self, state: State, path: Path, value: float, piece: float, until: float
    ) -> list[tuple[State, float]] | None:
        """Brake on the path, and stay on it until a time, s; return states and the path's values.

        The steps aim at where the tip is, from further along the path: progress along it is what they avoid. That is
        where many limits meet, and corrections may run in circles round such a corner; then they aim at a part of
        what the step before covered.
        """
        covered = 0.5 * piece

        values: list[float] = []

        def step(now: State, limits: Box) -> Outcome:
            nonlocal covered, value
            ahead = min(value + piece, path.end)
            outcome = self.attempt.run(now, self.target(now, path, ahead, value, limits), progress=1.0)
            start, end = ahead, value
            for share in _GENTLER:
                if outcome.accepted:
                    break
                start, end = value, min(value + share * covered, path.end)
                outcome = self.attempt.run(now, self.target(now, path, start, end, limits))
            reached = start + outcome.progress * (end - start)
            covered, value = reached - value, reached
            values.append(value)
            return outcome

        found = self._follow(state, step, until)
        return None if found is None else list(zip(found, values, strict=True))

    def _yielding(self, state: State) -> list[State] | None:
        """Brake an elastic tip: it is drawn along a way of its own, ever more slowly, and gives way to the limits."""
        truss = self.arm.truss
        self.arm.kinematics.evaluate(state.nodes)
        here, rotation = (
            self.arm.kinematics.tip_position(state.nodes),
            self.arm.kinematics.tip_rotation.copy(),
        )
        count = max(self._count(state, self.box(state)), 1)
        there = here + 0.5 * count * (truss.tip_weights @ state.motion[truss.tip])
        way = Path(np.array([0.0, 1.0]), np.stack([here, there]), np.stack([rotation] * 2))
        taken = 0

        def step(now: State, limits: Box) -> Outcome:
            nonlocal taken
            start, end = (1.0 - max(1.0 - k / count, 0.0) ** 2 for k in (taken, taken + 1))
            taken += 1
            target = self.target(now, way, start, end, limits)
            return self.attempt.run(now, target, progress=1.0)

        return self._follow(state, step, self._until_the_base_rests())

    def _let_go(self, state: State) -> list[State] | None:
        """Brake every actuator by itself, whatever becomes of the tip; none where faces must stay on the curve."""
        if self.arm.layout.hard_tracking:
            return None
        solver = self.lengths()
        return self._follow(
            state,
            lambda now, limits: self._released(now, limits, solver),
            self._until_the_base_rests(),
        )

    def _follow(
        self, state: State, step: Callable[[State, Box], Outcome | None], until: float
    ) -> list[State] | None:
        """Take steps until a time, s, and until the arm may stay; None where one fails, or they are too many."""
        found: list[State] = []
        most = _MOST_STEPS
        for count in range(_MOST_STEPS + _MOST_RIDING):
            limits = self.box(state)
            if not self._beyond(state, limits).max() > 0.0 and state.time >= until:
                return found
            if not count:
                most = min(_MOST_STEPS, self._count(state, limits) + _SPARE_STEPS)
                if until > state.time:
                    most += min(int(np.ceil((until - state.time) / self.dt)), _MOST_RIDING)
            if count >= most:
                return None
            outcome = step(state, limits)
            if outcome is None or not outcome.accepted:
                return None
            state = outcome.state_after(state)
            found.append(state)
        return None

    def _beyond(self, state: State, limits: Box) -> Array:
        """Return (n_a,) how far each actuator has to move at least, m."""
        lengths = state.lengths[self.arm.truss.actuators]
        return np.asarray(np.maximum(np.maximum(limits[0] - lengths, lengths - limits[1]), 0.0))

    def _count(self, state: State, limits: Box) -> int:
        """Return how many steps the fastest actuator needs by itself.

        Each takes as much off it as its box is wide on either side of its middle.
        """
        lengths = state.lengths[self.arm.truss.actuators]
        speed = np.abs(0.5 * (limits[0] + limits[1]) - lengths)
        width = np.maximum(0.5 * (limits[1] - limits[0]), 1e-12)
        return int(np.ceil(min(float((speed / width).max(initial=0.0)), float(_MOST_STEPS))))

    def _released(self, state: State, limits: Box, solver: LengthSolver) -> Outcome | None:
        """Return the step in which every actuator moves as little as it may; None where that is not clear."""
        arm, separation = self.arm, self.attempt.separation
        actuators, base = arm.truss.actuators, arm.base_motion
        wanted = arm.home_lengths.copy()
        wanted[actuators] = np.clip(state.lengths[actuators], *limits)
        X, vertices, then = state.nodes, state.control_vertices, state.time + self.dt
        if base is not None:
            X, vertices = (base.carried(points, state.time, then) for points in (X, vertices))
        closed = self._closed(np.array(X), wanted, solver)
        if closed is None:
            return None
        short = state.shortfall
        if short is None:
            short = separation.shortfall(state.nodes, state.time)
        if not separation.deviation(state.nodes, closed.X) < np.inf:
            return None
        report = separation.between(state.nodes, closed.X, state.time, then, short)
        after = separation.holds(closed.X, then, short, proven=report.certified)
        if after is None or not report.certified:
            return None
        moved, _ = arm.base_at(then)
        if self.attempt.acceptance.flaw(closed, state.nodes, moved, *limits, None, vertices, state.torsion):
            return None
        return Outcome(True, closed, vertices, 1.0, "", shortfall=after, torsion=state.torsion, time=then)

    def _closed(self, X: Array, wanted: Array, solver: LengthSolver) -> Closed | None:
        """Return the configuration near `X` (N, 3), changed in place, with all lengths as `wanted` (M,), m."""
        kinematics, tolerance = self.arm.kinematics, self.attempt.tolerances.member
        for _ in range(_NEWTON_STEPS):
            kinematics.evaluate_members(X)
            error = wanted - kinematics.lengths
            worst = float(np.abs(error).max())
            if worst <= 1e-3 * tolerance or not worst < np.inf:
                break
            try:
                X[self.arm.truss.free] += solver.solve(kinematics.gradient, error)
            except SolverError:
                return None
        kinematics.evaluate(X)
        worst = float(np.abs(wanted - kinematics.lengths).max())
        if not worst <= tolerance:
            return None
        lengths = kinematics.lengths.copy()
        return Closed(X, lengths, worst, kinematics.tip_position(X), kinematics.tip_rotation.copy())
