"""Braking: how an arm with limited accelerations comes to rest, proven before each step is accepted.

A moving arm with limited accelerations cannot stop at once. A step into a state is accepted only if braking
steps are known that bring the arm from there to rest, each within the limits and clear of obstacles. If no
other step is found later, the arm takes the first braking step. A tip that has to stay on its path brakes
along it. An elastic tip, or one whose base moves on, may leave the path: then every actuator brakes by
itself, which strokes always allow.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from vgtm_qp.step.actuation import INSTANT, Actuation, Bounds
from vgtm_qp.step.attempt import Attempt
from vgtm_qp.step.closing import Closing
from vgtm_qp.step.path import Path
from vgtm_qp.step.shaping import Shaping
from vgtm_qp.step.state import State
from vgtm_qp.step.step import Step, StepStatus

BrakingSteps = list[tuple[State, float]]
"""States, each with the value of the path reached there."""

ANY_RANK = 2
"""The greatest rank of braking."""

_MOST_STEPS = 60
_SPARE_STEPS = 4
"""Greatest number of braking steps in all, and beyond those that the fastest actuator needs by itself."""

_GENTLER = (0.5, 0.75)
"""Shares of the previous step's displacement that a step aims at if braking as hard as possible fails."""

_MOST_RIDING = 500
"""Greatest number of braking steps on a moving base."""


@dataclass(frozen=True, eq=False)
class Braking:
    """Steps on a `path` that bring an arm to rest from `origin`.

    Attributes
    ----------
    on_path : int
        Number of steps, from the first, in which the tip stays on the path.
    rank : int
        0 if the tip stays on its path to the end or need not; 1 if it comes to rest on the path and leaves it
        later, because the base moves on; 2 if it leaves the path at once. Lower is better.
    """

    origin: State
    path: Path
    steps: BrakingSteps
    on_path: int
    rank: int = 0

    @property
    def rest(self) -> Braking:
        """The steps after the first."""
        steps, on_path = self.steps[1:], max(self.on_path - 1, 0)
        return replace(self, origin=self.steps[0][0], steps=steps, on_path=on_path)

    def first(self, path: Path | None, start: float, end: float, blocked: Step) -> Step:
        """Return the first step, in place of the `blocked` one, with its progress on a piece of `path`."""
        (state, value), on_path = self.steps[0], self.on_path > 0
        progress = (value - start) / (end - start) if on_path and path is self.path else 0.0
        return replace(
            blocked,
            status=StepStatus.SLOWED,
            progress=progress,
            state=state,
            braked=True,
            left_path=not on_path,
        )

    def changed(self, origin: State, change: Callable[[State], State]) -> Braking:
        """Return these steps from the state `origin`, with `change` applied to all further states."""
        return replace(self, origin=origin, steps=[(change(state), value) for state, value in self.steps])


@dataclass(frozen=True, eq=False)
class Brakes:
    """How one arm brakes in steps of `dt`, s."""

    shaping: Shaping
    attempt: Attempt
    actuation: Actuation
    dt: float

    def find(self, state: State, path: Path, value: float, piece: float) -> Braking | None:
        """Return the steps that bring the arm from `state` to rest; None if none were found.

        The tip is at `value` of `path`; while on the path it moves on by at most `piece` in each step.
        """
        setup, until = self.shaping.setup, self._until_the_base_rests()
        if setup.tip_mode == "elastic":
            steps = self._let_go(state, value) or self._yielding(state, value)
            return None if steps is None else Braking(state, path, steps, 0)
        along = self._along(state, path, value, piece, until)
        if along is not None:
            return Braking(state, path, along, len(along))
        if setup.base_motion is None:
            return None
        along = self._along(state, path, value, piece, -np.inf)
        if along is not None:
            ride = self._let_go(*(along[-1] if along else (state, value)))
            if ride is not None:
                return Braking(state, path, along + ride, len(along), 1)
        return self.letting_go(state, path, value)

    def letting_go(self, state: State, path: Path, value: float) -> Braking | None:
        """Return the steps in which every actuator brakes by itself; None if none were found."""
        steps = self._let_go(state, value)
        return None if steps is None else Braking(state, path, steps, 0, ANY_RANK)

    def _until_the_base_rests(self) -> float:
        """Return the time from which the base rests, s."""
        base = self.shaping.setup.base_motion
        return -np.inf if base is None else base.end - INSTANT

    def _done(self, state: State, path: Path, start: float, end: float, box: Bounds, progress: float) -> Step:
        """Return the attempt at a piece of path of which the tip has already covered `progress`."""
        target = self.shaping.target(state, self.dt, path, start, end, box)
        return self.attempt.run(state, target, progress=progress, enough=0.0)

    def _along(
        self, state: State, path: Path, value: float, piece: float, until: float
    ) -> BrakingSteps | None:
        """Brake on the path, and stay on it until a time, s.

        Each step aims back at the tip's present place, so that it makes as little progress as limits allow. Many
        limits are active there, and corrections may cycle; then a step aims at a share of the previous one's progress.
        """
        covered = 0.5 * piece

        def step(now: State, limits: Bounds) -> tuple[State, float] | None:
            nonlocal covered, value
            gentler = [(value, min(value + share * covered, path.end), 0.0) for share in _GENTLER]
            for start, end, behind in [(min(value + piece, path.end), value, 1.0), *gentler]:
                done = self._done(now, path, start, end, limits, behind)
                if done.moved:
                    reached = start + done.progress * (end - start)
                    covered, value = reached - value, reached
                    return done.state, value
            return None

        return self._follow(state, step, until)

    def _yielding(self, state: State, value: float) -> BrakingSteps | None:
        """Brake an elastic tip: its goal moves along a line, ever more slowly; its slack keeps the limits."""
        arm, kinematics = self.shaping.setup.arm, self.shaping.setup.kinematics
        kinematics.evaluate(state.q)
        here, rotation = arm.end_effector.position(state.nodes), kinematics.tip_rotation.copy()
        count = max(self._count(state, self.actuation.box(state, self.dt)), 1)
        before = arm.end_effector.position(arm.nodes(state.q - state.motion))
        there = here + 0.5 * count * (here - before)
        line = Path(np.array([0.0, 1.0]), np.stack([here, there]), np.stack([rotation] * 2))
        number = 0

        def step(now: State, limits: Bounds) -> tuple[State, float] | None:
            nonlocal number
            start, end = (1.0 - max(1.0 - k / count, 0.0) ** 2 for k in (number, number + 1))
            number += 1
            done = self._done(now, line, start, end, limits, 1.0)
            return (done.state, value) if done.moved else None

        return self._follow(state, step, self._until_the_base_rests())

    def _let_go(self, state: State, value: float) -> BrakingSteps | None:
        """Brake every actuator by itself, wherever the tip goes; None if stations must stay on the curve."""
        setup = self.shaping.setup
        if setup.layout.hard_tracking and setup.elastic is None:
            return None
        closing = Closing(setup.layout, setup.kinematics)

        def step(now: State, limits: Bounds) -> tuple[State, float] | None:
            then = self._released(now, limits, closing)
            return None if then is None else (then, value)

        return self._follow(state, step, self._until_the_base_rests())

    def _follow(
        self, state: State, step: Callable[[State, Bounds], tuple[State, float] | None], until: float
    ) -> BrakingSteps | None:
        """Return the steps until a time, s, and until the arm can stay; None if one fails or too many."""
        found: BrakingSteps = []
        most = _MOST_STEPS
        for count in range(_MOST_STEPS + _MOST_RIDING):
            limits, values = self.actuation.box(state, self.dt), self.actuation.values(state)
            if np.all(limits[0] <= values) and np.all(values <= limits[1]) and state.time >= until:
                return found
            if not count:
                most = min(_MOST_STEPS, self._count(state, limits) + _SPARE_STEPS)
                if until > state.time:
                    most += min(int(np.ceil((until - state.time) / self.dt)), _MOST_RIDING)
            done = step(state, limits) if count < most else None
            if done is None:
                return None
            found.append(done)
            state = done[0]
        return None

    def _count(self, state: State, limits: Bounds) -> int:
        """Return the number of steps that the fastest actuator needs by itself.

        Each step reduces its speed by half the width of its box.
        """
        finite = np.isfinite(limits[0]) & np.isfinite(limits[1])
        lower, upper = limits[0][finite], limits[1][finite]
        speed = np.abs(0.5 * (lower + upper) - self.actuation.values(state)[finite])
        width = np.maximum(0.5 * (upper - lower), 1e-12)
        return int(np.ceil(min(float((speed / width).max(initial=0.0)), float(_MOST_STEPS))))

    def _released(self, state: State, limits: Bounds, closing: Closing) -> State | None:
        """Return the state after the least allowed motion of every actuator; None if it is not clear."""
        setup, attempt = self.shaping.setup, self.attempt
        arm, base, separation = setup.arm, setup.base_motion, attempt.separation
        strokes = np.clip(self.actuation.values(state), *limits)
        q, vertices, then = state.q, state.control_vertices, state.after(self.dt)[0]
        if base is not None:
            before, after = base.pose(state.time), base.pose(then)
            q = arm.based(arm.carried(q, before, after), after)
            vertices = before.carry(vertices, after)
        tolerance = attempt.accuracy.member
        closed = closing.close(q, strokes, strokes, tolerance, too_far=np.inf)
        if not closed.error <= tolerance or not separation.deviation(state.q, closed.q) < np.inf:
            return None
        report, found = separation.proof(state, closed.q, then, separation.shortfall_of(state))
        if found is None or not report.certified:
            return None
        vertices, _ = setup.arrival.ended(vertices, closed.tip_position, closed.tip_rotation)
        still = self.shaping.target(state, self.dt, _NOWHERE, 0.0, 1.0, limits)
        flaw = attempt.acceptance.flaw(closed, state.q, still, None, vertices, state.torsion)
        if flaw or setup.too_long(arm.nodes(closed.q) - state.nodes):
            return None
        return state.next(arm, self.dt, closed, vertices, state.torsion, found)


_NOWHERE = Path(np.array([0.0, 1.0]), np.zeros((2, 3)), np.stack([np.eye(3)] * 2))
"""The path of a free tip."""
