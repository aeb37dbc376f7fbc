"""The resolver of the QP: each call is one certified step, or a stop with its reason."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace

from numpy.typing import ArrayLike

from vgtm_qp.arrays import Array
from vgtm_qp.errors import VgtmError
from vgtm_qp.problem import Problem
from vgtm_qp.qp.full import StepQP
from vgtm_qp.qp.terms import Inequality, Objective
from vgtm_qp.step.actuation import Actuation
from vgtm_qp.step.advance import SMALLEST, Advancer
from vgtm_qp.step.attempt import Attempt
from vgtm_qp.step.braking import ANY_RANK, Braking
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.checks import checked_arm
from vgtm_qp.step.path import Path
from vgtm_qp.step.remedies import Remedy, relaxed
from vgtm_qp.step.resolver import Resolver
from vgtm_qp.step.scene import NamedShortfall
from vgtm_qp.step.separation import Separation
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.shaping import Shaping
from vgtm_qp.step.state import Shortfall, State, frozen
from vgtm_qp.step.step import Step
from vgtm_qp.step.stops import Stop, explain, struck
from vgtm_qp.step.task import duration

_SMALLEST_MOVING = 0.25
"""Least share of a piece of path that a moving arm tries, which can brake instead; see ``advance.SMALLEST``."""


class QPResolver(Resolver, serves="qp"):
    """Moves one arm by the QP of a step; see :class:`vgtm_qp.step.resolver.Resolver`.

    Raises
    ------
    ProblemError
        The end effector is asked for coordinates that no actuator can start to change.
    """

    draws_vertices = True

    def __init__(
        self,
        problem: Problem | Setup,
        *,
        objectives: Sequence[Objective] = (),
        rows: Sequence[Inequality] = (),
    ) -> None:
        super().__init__()
        setup = problem if isinstance(problem, Setup) else checked_arm(problem, objectives, rows)
        self._separation = Separation(setup)
        self._actuation = Actuation(setup)
        self._shaping = Shaping(setup)
        self._attempt = Attempt(setup, self._separation, self._actuation)
        self._clock = self._attempt.phases
        self._advancer = Advancer(self._attempt, self._actuation, self._shaping)
        self._state = setup.home_state()
        self._braking: Braking | None = None
        self._rehearse()

    def _rehearse(self) -> None:
        """Try a step that stays at home, so that what steps make on first use is made now."""
        if self.setup.elastic is not None:
            self.setup.elastic()
        state, path = self._state, self.setup.task.path_to(self.tip(), None, None, None)
        limits = self._actuation.limits(state, self.setup.dt, slowing=True)
        with suppress(VgtmError):
            self._attempt.run(state, self._shaping.target(state, self.setup.dt, path, 0.0, 1.0, limits[:2]))
        self._clock.seconds.update(dict.fromkeys(self._clock.seconds, 0.0))

    @property
    def setup(self) -> Setup:
        """The arm ready to move: arm, curve, task, engine and clearance monitor."""
        return self._shaping.setup

    @property
    def solver(self) -> str | None:
        """Name of the QP solver."""
        return self.setup.solver

    def lock(self, name: str) -> None:
        """See :class:`Resolver`.

        The QP keeps its columns: a locked actuator has a box of width zero.
        """
        super().lock(name)
        before, self._braking = self._known_braking(), None
        if before is not None:
            # A jammed actuator stops at once; the others brake, each by itself.
            state, value = before.steps[0]
            self._braking = self._advancer.brakes(state.duration).letting_go(self.state, before.path, value)

    @property
    def control_vertex_goals(self) -> dict[int, Array]:
        """Goals of control vertices, m, by index; may be set as a whole."""
        return self._shaping.goals

    @control_vertex_goals.setter
    def control_vertex_goals(self, goals: Mapping[int, ArrayLike]) -> None:
        self._shaping.draw(goals)
        self._attempt.use(self.setup)

    def set_control_vertices(self, count: int) -> float:
        """See :class:`Resolver`."""
        state, braking, family = self.state, self._known_braking(), self.setup.layout.family
        more = count - len(state.control_vertices)
        change = self._shaping.change(state, more)
        self._attempt.use(self.setup)
        if more:
            self.state = replace(state, control_vertices=frozen(change.curve.control_vertices))
            if braking is not None and family is not None:
                self._braking = braking.changed(
                    self.state, lambda then: self._shaping.with_vertices(then, family, more)
                )
        return change.change

    def build(
        self,
        *,
        position: ArrayLike | None = None,
        pointing: ArrayLike | None = None,
        rotation_vector: ArrayLike | None = None,
        dt: float | None = None,
    ) -> StepQP:
        """See :class:`Resolver`."""
        path = self.setup.task.path_to(self.tip(), position, pointing, rotation_vector)
        dt = duration(self.setup.dt if dt is None else dt)
        with self._lock:
            share = self._until_jam(dt)
            limits = self._actuation.limits(self.state, share * dt, slowing=True)
            target = self._shaping.target(self.state, share * dt, path, 0.0, share, limits[:2])
            first = self._advancer.first_share(target)
            target = target if first == 1.0 else target.part(first)
            return self.setup.engine.qp(self._attempt.first_input(self.state, target, first))

    def _follow(self, path: Path, start: float, end: float, dt: float, whole: float) -> Step:
        """See :class:`Resolver`; pieces are halved until one is safe."""
        state, limits = self._state, self._actuation.limits(self._state, dt, slowing=True)
        brake, smallest, worst = None, SMALLEST, ANY_RANK
        if (brake := self._braking_until_jam()) is not None:
            smallest, worst = _SMALLEST_MOVING, brake.rank
        target = self._shaping.target(state, dt, path, start, end, limits[:2])
        step, braking = self._advancer.first_accepted(state, target, dt, smallest, worst)
        if step.moved:
            self._state, self._braking = step.state, braking
            return step.over(whole, limits)
        step = self._attempt.with_gap(step.over(0.0, limits))
        return step if brake is None else self._brake(brake, path, start, end, step)

    def brake(self, path: Path | None = None, start: float = 0.0, end: float = 1.0) -> Step | None:
        """See :class:`Resolver`."""
        with self._lock:
            braking = self._known_braking()
            if braking is None:
                return None
            step = self._brake(braking, path, start, end, Step.stopped(self.state, "", 0))
            return self._told(step, path, start, end)

    def _braking_until_jam(self) -> Braking | None:
        """Return the known braking if its first step, which has a duration of its own, ends before the next jam."""
        braking, now = self._known_braking(), self._state.time
        if braking is None or self._actuation.until_jam(now, braking.steps[0][0].time - now) < 1.0:
            return None
        return braking

    def _known_braking(self) -> Braking | None:
        """Return the steps that bring the arm to rest; None if it is at rest."""
        braking = self._braking
        return braking if braking is not None and braking.origin is self._state and braking.steps else None

    def _brake(self, braking: Braking, path: Path | None, start: float, end: float, blocked: Step) -> Step:
        """Take the first step of `braking`, instead of the `blocked` one, and return it."""
        step = braking.first(path, start, end, blocked)
        self.state, self._braking = step.state, braking.rest
        return self._attempt.with_gap(step)

    def explain(
        self,
        path: Path,
        start: float,
        end: float,
        *,
        dt: float | None = None,
        last: Step | None = None,
        state: State | None = None,
    ) -> Stop:
        """See :class:`Resolver`."""
        with self._lock:
            state, dt = state or self.state, self.setup.dt if dt is None else dt
            limits = self._actuation.limits(state, dt).of_stop()
            goal = path.at(start).over(end - start)
            stop = explain(self.setup, self._separation, state, goal, limits, last)
            return struck(stop, self.setup, self._separation, state, dt)

    def _after_change(self) -> NamedShortfall:
        """See :class:`ChangingScene`; braking steps stay as they were, since the arm cannot stop sooner.

        Pairs that come too near while the arm brakes are too near as well.
        """
        braking, state = self._known_braking(), self._state
        short = self._separation.shortfall(state.q, state.time, tracked=True)
        self._state, near = replace(state, shortfall=short), self._named(short.items())
        if braking is not None:
            self._braking = braking.changed(self._state, lambda then: replace(then, shortfall=None))
            for then, _ in self._braking.steps:
                failing = self._separation.between(state.q, then.q, state.time, then.time, short).failing
                found = ((failing.pair(k), float(failing.distance[k])) for k in range(len(failing)))
                near, state = self._named(found, near), then
        return near

    def too_near(self, state: State) -> Shortfall:
        """Return the pairs below their clearance in a state, which steps drive apart, with their distances, m."""
        return self._separation.shortfall(state.q, state.time)

    def relaxed(self, remedy: Remedy) -> QPResolver:
        """See :class:`Resolver`."""
        other = QPResolver(relaxed(self.setup, remedy.changes))
        # The state comes first: a lock holds an actuator at the value it has.
        other.state = replace(self.state, shortfall=None)
        for name in self._actuation.locked:
            other.lock(name)
        return other

    def again(self, problem: Problem) -> QPResolver:
        """See :class:`Resolver`."""
        own = self.setup.layout.own
        if own is None:
            return QPResolver(build_arm(problem))
        return QPResolver(build_arm(problem, objectives=own.objectives, rows=own.rows))
