"""A resolver for a control loop: one call, one certified step, or a stop that says why."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vgtm_qp.errors import GoalError, ProblemError
from vgtm_qp.problem import Problem
from vgtm_qp.qp.full import StepQP
from vgtm_qp.step.acceptance import Acceptance
from vgtm_qp.step.actuation import Actuation, Box
from vgtm_qp.step.advance import ANY_RANK, Advance, Advancer, Piece
from vgtm_qp.step.attempt import Attempt, Tolerances
from vgtm_qp.step.braking import Brakes, Braking
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.checks import excess_of_freedom, unreachable_tip
from vgtm_qp.step.goals import duration, path_to
from vgtm_qp.step.path import Path
from vgtm_qp.step.separation import Distances, Separation, Shortfall
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.shaping import Shaping
from vgtm_qp.step.state import State, frozen
from vgtm_qp.step.step import Step, StepStatus
from vgtm_qp.step.stops import BASE_MOVES_ON, Stop, explain
from vgtm_qp.step.target import Target
from vgtm_qp.step.tracking import TrackingError

__all__ = ["Resolver", "Step", "StepStatus"]

Array = NDArray[np.float64]

_APPROACH = 0.4
"""Largest share of the room to its least clearance that a pair may use in one step."""

_SMALLEST_MOVING = 0.25
"""The least share of a piece of path that is tried by an arm that can brake instead."""

_ROUNDING = float(np.finfo(float).eps)


class Resolver:
    """Moves one arm step by step, see ``step.mover.Mover``. Not to be shared by threads: use one per thread.

    Raises
    ------
    ProblemError
        The end effector is asked for coordinates that no actuator can start to change.
    """

    rank: int | None = None
    """None: a QP does not reveal the rank of a Jacobian."""
    draws_vertices = True
    """Whether control vertices follow goals of their own."""

    def __init__(self, problem: Problem | Setup) -> None:
        setup = problem if isinstance(problem, Setup) else build_arm(problem)
        if isinstance(problem, Problem):
            mistakes = list(unreachable_tip(problem, setup))
            if mistakes:
                raise ProblemError(str(problem.source or problem.name), mistakes)
            for excess in excess_of_freedom(problem, setup):
                warnings.warn(f"{excess.key} = {excess.value}: {excess.expected}", stacklevel=2)
        # Only a tip that may be late lets pairs and actuators slow down before contacts and strokes.
        slows_down = setup.slow_approach and setup.tip_mode == "scaled"
        distances = Distances(
            setup.safe,
            setup.self_safe,
            setup.influence,
            setup.margin,
            setup.minimum_angle,
            approach=_APPROACH if slows_down else 1.0,
        )
        self._separation = Separation(setup.arm, setup.monitor, distances)
        self._actuation = Actuation(setup.arm, setup.jams, slows_down=slows_down)
        self._shaping = Shaping(setup)
        # Divided by the time twice, what is left of a length is an acceleration; but no less than rounding leaves.
        exact = max(1e-12, 32.0 * _ROUNDING * setup.arm.height)
        kept = Tolerances(member=1e-10 if self._actuation.starts_at_once else exact)
        self._attempt = Attempt(
            setup.arm,
            setup.engine,
            self._separation,
            Acceptance(setup.arm, setup.kinematics, setup.task, member=kept.member, tip=kept.tip),
            tracking=_tracking_error(setup),
            tolerances=kept,
        )
        self._advancer = Advancer(self._attempt, self._actuation, self._brakes, self._target, setup.tip_mode)
        self._state = setup.home_state()
        self._braking: Braking | None = None

    @property
    def setup(self) -> Setup:
        """What was built for the problem: arm, curve, task, engine and clearance monitor."""
        return self._shaping.setup

    @property
    def solver(self) -> str | None:
        """Name of the QP solver."""
        return self.setup.solver

    @property
    def phases(self) -> dict[str, float]:
        """Seconds spent so far in each phase."""
        return self._attempt.phases.seconds

    @property
    def state(self) -> State:
        """Where the arm is; may be set to another state of this arm."""
        return self._state

    @state.setter
    def state(self, state: State) -> None:
        vertices, nodes = self.setup.layout.vertices, len(self.setup.arm.node_names)
        if len(state.control_vertices) != vertices or len(state.nodes) != nodes:
            raise GoalError(
                f"this state has {len(state.nodes)} nodes and {len(state.control_vertices)} control vertices; the arm "
                f"has {nodes} and its curve {vertices}"
            )
        self._state = state

    @property
    def locked(self) -> frozenset[str]:
        """Names of the actuators that are stuck by now; members stuck from the start are fixed ones."""
        return frozenset(self._actuation.locked)

    def lock(self, name: str) -> None:
        """Hold an actuator at its present length or value from now on.

        The QP keeps its shape: an actuator whose least and greatest values are one is fixed.

        Raises
        ------
        GoalError
            No actuator has that name.
        """
        self._actuation.lock(name, self.state)
        before, self._braking = self._braking, None
        if before is not None and before.origin is self.state and before.steps:
            # What jams stops at once, as it will; the others brake, each by itself.
            brakes = self._brakes(before.steps[0][0].duration)
            self._braking = brakes.letting_go(self.state, before.path, before.steps[0][1])

    @property
    def control_vertex_goals(self) -> dict[int, Array]:
        """Where control vertices are drawn to, m, by their index; may be set as a whole."""
        return self._shaping.goals

    @control_vertex_goals.setter
    def control_vertex_goals(self, goals: Mapping[int, ArrayLike]) -> None:
        self._shaping.draw(goals)
        self._use_curve()

    def set_control_vertex_goal(self, index: int, position: ArrayLike | None) -> None:
        """Draw a control vertex to a place in the null space of the tip's motion; None lets it go.

        The arm follows as far as the tip's goal, limits and clearance let it.

        Parameters
        ----------
        index
            Control vertex, 0 at the base; p_0 and the direction of p_1 belong to the base.
        position
            (3,) where it should go, m, or None.

        Raises
        ------
        GoalError
            There is no such control vertex, or the position is not three finite numbers.
        """
        goals: dict[int, ArrayLike] = dict(self.control_vertex_goals)
        goals.pop(index, None)
        self.control_vertex_goals = goals if position is None else {**goals, index: position}

    def set_control_vertices(self, count: int) -> float:
        """Give the curve another number of control vertices where it is; return how far it moved, m.

        More of them move a Bezier curve or B-spline by rounding only; fewer are fitted. Goals of control vertices end.

        Raises
        ------
        GoalError
            The arm has no curve.
        CurveError
            So few control vertices cannot keep both ends and the base tangent.
        """
        state, braking, family = self.state, self._braking, self.setup.layout.family
        more = count - len(state.control_vertices)
        change = self._shaping.change(state, more)
        self._use_curve()
        if more:
            self.state = replace(state, control_vertices=frozen(change.curve.control_vertices))
            if braking is not None and braking.origin is state and family is not None:
                steps = [
                    (self._shaping.with_vertices(then, family, more), value) for then, value in braking.steps
                ]
                self._braking = replace(braking, origin=self.state, steps=steps)
        return change.change

    def _use_curve(self) -> None:
        """Go on with the present curve's engine."""
        self._attempt.engine = self.setup.engine
        self._attempt.tracking = _tracking_error(self.setup)

    def step(
        self,
        *,
        position: ArrayLike | None = None,
        pointing: ArrayLike | None = None,
        rotation_vector: ArrayLike | None = None,
        dt: float | None = None,
    ) -> Step:
        """Move towards a goal of the end effector in one step and return what was done.

        Parameters
        ----------
        position
            (3,) wanted position, m; where the tip is, by default.
        pointing
            (3,) wanted direction of the tip's z-axis.
        rotation_vector
            (3,) wanted orientation, rad.
        dt
            Duration of the step, s; the problem's by default.

        Raises
        ------
        GoalError
            The goal is not three finite numbers, names a coordinate that is not tracked or the direction twice, or
            `dt` is not a positive number; the state is unchanged.
        """
        path = path_to(self.setup.task, self.tip(), position, pointing, rotation_vector)
        return self.follow(path, 0.0, 1.0, dt=dt)

    def build(
        self,
        *,
        position: ArrayLike | None = None,
        pointing: ArrayLike | None = None,
        rotation_vector: ArrayLike | None = None,
        dt: float | None = None,
    ) -> StepQP:
        """Return the QP that a step to a goal starts with, to read, to print or to solve elsewhere; nothing moves.

        Every row and column has a name, a kind and a unit. It is the QP that the step solves, whatever smaller one
        with the same answer the solver is given.

        Parameters
        ----------
        position, pointing, rotation_vector, dt
            As :meth:`step` takes them.

        Raises
        ------
        GoalError
            As :meth:`step` raises it.
        """
        path = path_to(self.setup.task, self.tip(), position, pointing, rotation_vector)
        seconds = duration(self.setup.dt if dt is None else dt)
        box = self._actuation.slowing(self.state, self._actuation.box(self.state, seconds))
        target = self._target(self.state, seconds, path, 0.0, 1.0, box)
        return self.setup.engine.qp(self._attempt.first_input(self.state, target))

    def tip(self) -> tuple[Array, Array]:
        """Return position (3,), m, and rotation (3, 3) of the end effector in the present state."""
        kinematics = self.setup.kinematics
        kinematics.evaluate(self.state.q)
        return self.setup.arm.end_effector.position(self.state.nodes), kinematics.tip_rotation.copy()

    def follow(
        self, path: Path, start: float, end: float, *, dt: float | None = None, smallest: float = 1 / 64
    ) -> Step:
        """Move along `path` from its value `start` towards `end` in one step; pieces are halved until one is safe.

        A step in which an actuator of the problem jams ends at that time, with the part of the way until then.

        Raises
        ------
        GoalError
            `dt` is not a positive number; the state is unchanged.
        """
        dt = duration(self.setup.dt if dt is None else dt)
        for name in self._actuation.jammed(self.state.time):
            self.lock(name)
        whole = self._actuation.until_jam(self.state.time, dt)
        dt *= whole
        state = self.state
        box = self._actuation.slowing(state, self._actuation.box(state, dt))
        braking = self._braking if self._braking is not None and self._braking.origin is state else None
        brake = braking if braking is not None and braking.steps and whole == 1.0 else None
        if brake is not None:
            smallest = max(smallest, _SMALLEST_MOVING)
        piece = Piece(path, start, start + whole * (end - start), dt, smallest)
        found = self._advancer.first_accepted(state, piece, box, ANY_RANK if brake is None else brake.rank)
        if found.outcome.accepted:
            self._state = found.outcome.state_after(self.setup.arm, state)
            after = found.braking
            self._braking = None if after is None else replace(after, origin=self.state)
            return self._told(found, box, dt, state, whole * found.share * found.outcome.progress)
        if brake is not None:
            step = self._told(found, box, dt, state, 0.0)
            return self._brake(brake, path, start, end, step)
        return self._told(found, box, dt, state, 0.0)

    def _told(self, found: Advance, box: Box, dt: float, before: State, progress: float) -> Step:
        """Return the step that an advance from the state `before` was."""
        outcome = found.outcome
        status = StepStatus.REACHED if progress >= 1.0 - 1e-9 else StepStatus.SLOWED
        return Step(
            status=status if outcome.accepted else StepStatus.BLOCKED,
            progress=progress,
            state=self.state,
            reason="" if outcome.accepted else outcome.reason,
            qps=outcome.iterations,
            solver_failed=outcome.solver_failed,
            _limit_name=self._actuation.limit_name(before, dt, box),
            _solution=outcome.solution,
            _rows=outcome.rows,
            _failure=outcome.failure,
        )

    def brake(self, path: Path | None = None, start: float = 0.0, end: float = 1.0) -> Step | None:
        """Take the next of the steps that bring a moving arm with limited accelerations to rest.

        They were known before the last step was taken, each within the limits and clear. None where the arm may stay
        as it is; nothing moves then. Progress is counted from `start` to `end` of a `path` that it brakes on.
        """
        braking = self._braking
        if braking is None or braking.origin is not self.state or not braking.steps:
            return None
        return self._brake(braking, path, start, end, Step(StepStatus.SLOWED, 0.0, self.state, "", 0))

    def _brake(self, braking: Braking, path: Path | None, start: float, end: float, step: Step) -> Step:
        """Take the first step of `braking` and return it, in the place of a `step` that was not found."""
        self.state, value = braking.steps[0]
        self._braking = braking.rest
        on_path = braking.on_path > 0
        progress = (value - start) / (end - start) if on_path and path is braking.path else 0.0
        return replace(
            step,
            status=StepStatus.SLOWED,
            progress=progress,
            state=self.state,
            braked=True,
            left_path=not on_path,
        )

    def _brakes(self, dt: float) -> Brakes:
        return Brakes(self.setup, self._attempt, self._actuation, self._target, dt)

    def _target(self, state: State, dt: float, path: Path, start: float, end: float, box: Box) -> Target:
        then = state.time + dt
        return Target(path, start, end, *box, then, self.setup.base_at(then), self._shaping.places)

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
        """Return why the arm does not get on from a state along `path` from its value `start` to `end`.

        Worth asking after a `last` step that was blocked, hardly moved or braked. The state is the present one by
        default; nothing moves.
        """
        dt, state = self.setup.dt if dt is None else dt, state or self.state
        reason, pressing, failed = ("", {}, False)
        if last is not None:
            reason, pressing, failed = last.reason, last.multipliers, last.solver_failed
            if last.left_path:
                reason, failed = BASE_MOVES_ON, False
        limits = self._actuation.limits(state, dt)
        return explain(
            self.setup, self._separation, state, path, start, end, limits, reason, pressing, failed
        )

    def too_near(self, state: State) -> Shortfall:
        """Return the pairs below their clearance in a state, which steps drive apart, with their distances, m."""
        return self._separation.shortfall(state.q, state.time)

    def again(self, problem: Problem) -> Resolver:
        """Return what tries a maneuver once more from home, for a problem that resolves the redundancy differently."""
        # A kernel takes longer to compile than a maneuver to solve without it.
        return Resolver(build_arm(problem, compiled=False))


def _tracking_error(setup: Setup) -> TrackingError | None:
    return TrackingError(setup.layout, setup.kinematics) if setup.layout.hard_tracking else None
