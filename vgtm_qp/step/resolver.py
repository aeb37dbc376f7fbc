"""A resolver for a control loop: one call, one certified step, or a stop that says why."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vgtm_qp.curve.curve import Curve
from vgtm_qp.curve.families import CurveFamily
from vgtm_qp.curve.redundancy import add_control_vertices, remove_control_vertices
from vgtm_qp.errors import GoalError, ProblemError, nearest
from vgtm_qp.problem import Problem
from vgtm_qp.qp.full import StepQP
from vgtm_qp.qp.lengths import LengthSolver
from vgtm_qp.step.acceptance import Acceptance
from vgtm_qp.step.arm import Arm, build_arm, reshaped
from vgtm_qp.step.attempt import Attempt, Outcome, Tolerances
from vgtm_qp.step.braking import Brakes, Braking
from vgtm_qp.step.checks import excess_of_freedom, unreachable_tip
from vgtm_qp.step.curve import curve_key, with_curve
from vgtm_qp.step.limits import length_box
from vgtm_qp.step.linearise import Target, base_frame
from vgtm_qp.step.path import Path, rotation_from_vector, turn_between
from vgtm_qp.step.separation import Distances, Separation
from vgtm_qp.step.state import State, frozen
from vgtm_qp.step.step import Step, StepStatus
from vgtm_qp.step.stops import BASE_MOVES_ON, CANNOT_BRAKE, Limits, Stop, StopKind, explain
from vgtm_qp.step.tracking import HardTracking
from vgtm_qp.step.whole import whole_qp

__all__ = ["Resolver", "Step", "StepStatus"]

Array = NDArray[np.float64]

_TRUST = 0.2
"""An actuator moves by no more than this times the part of the step that is tried, m, where the whole one failed."""

_APPROACH, _STROKE_APPROACH, _LEAST_APPROACH = 0.4, 0.3, 2e-3
"""Of the room to its least clearance a pair, and to the end of its stroke an actuator, may use this part in one step,
or so much, m."""

_SMALLEST_MOVING = 0.25
"""The least part of a piece of path that is tried by an arm that can brake instead."""

_BEYOND = 60.0
"""An arm that is at the end of its path may brake beyond it, within so many times its last piece."""

_OFF_PATH = "the arm could brake after it only off its path"

_ANY_RANK = 2
"""The rank of braking in any way at all."""

_INSTANT = 1e-9
"""Times that differ by less are the same, s."""

_ROUNDING = float(np.finfo(float).eps)

_SHORTEST, _LONGEST = 1e-8, 1e8
"""Durations of a step, s: shorter ones are lost in the rounding of the time and of the rates."""


class Resolver:
    """Moves one arm step by step. Not to be shared by threads: use one per thread.

    Raises
    ------
    ProblemError
        The end effector is asked for coordinates that no actuator can start to change.
    """

    def __init__(self, problem: Problem | Arm) -> None:
        self.arm = arm = problem if isinstance(problem, Arm) else build_arm(problem)
        if isinstance(problem, Problem):
            mistakes = list(unreachable_tip(problem, arm))
            if mistakes:
                raise ProblemError(str(problem.source or problem.name), mistakes)
            for excess in excess_of_freedom(problem, arm):
                warnings.warn(f"{excess.key} = {excess.value}: {excess.expected}", stacklevel=2)
        distances = Distances(
            arm.safe,
            arm.self_safe,
            arm.influence,
            arm.margin,
            arm.minimum_angle,
            approach=_APPROACH if self._slows_down else 1.0,
        )
        self._separation = Separation(arm.truss, arm.monitor, distances)
        truss = arm.truss
        self._starts_at_once = bool(np.isinf(truss.acceleration[truss.actuators]).all())
        # Divided by the time twice, what is left of a length is an acceleration; but no less than rounding leaves.
        member = 1e-10 if self._starts_at_once else max(1e-12, 32.0 * _ROUNDING * truss.height)
        tolerances = Tolerances(member=member)
        self._attempt = Attempt(
            arm.engine,
            arm.task,
            self._separation,
            Acceptance(
                arm.kinematics, arm.home_lengths, arm.task, member=tolerances.member, tip=tolerances.tip
            ),
            tracking=_hard_tracking(arm),
            tolerances=tolerances,
        )
        self._state = arm.home_state()
        self._actuator_names = tuple(truss.member_names[k] for k in truss.actuators)
        self._limits = (
            truss.stroke[truss.actuators],
            truss.rate[truss.actuators],
            truss.acceleration[truss.actuators],
        )
        self._vertex_goals = arm.vertex_goals
        self._braking: Braking | None = None
        self._arms: dict[tuple[object, ...], Arm] = {}
        self._row_names = [f"stroke: {name}" for name in self._actuator_names]
        self._locked: set[str] = set()
        self._jams = sorted(arm.jams, key=lambda jam: -jam[1])

    @property
    def phases(self) -> dict[str, float]:
        """Seconds spent so far in each phase."""
        return self._attempt.phases.seconds

    @property
    def _slows_down(self) -> bool:
        """Whether pairs and actuators slow down before contacts and strokes: only a tip that may be late lets them."""
        return self.arm.slow_approach and self.arm.tip_mode == "scaled"

    @property
    def state(self) -> State:
        """Where the arm is; may be set to another state of this arm."""
        return self._state

    @state.setter
    def state(self, state: State) -> None:
        vertices = self.arm.layout.vertices
        if len(state.control_vertices) != vertices or len(state.nodes) != self.arm.truss.node_count:
            raise GoalError(
                f"this state has {len(state.nodes)} nodes and {len(state.control_vertices)} control vertices; the arm "
                f"has {self.arm.truss.node_count} and its curve {vertices}"
            )
        self._state = state

    @property
    def locked(self) -> frozenset[str]:
        """Names of the actuated members that are stuck by now; those stuck from the start are fixed members."""
        return frozenset(self._locked)

    def lock(self, name: str) -> None:
        """Hold an actuated member at its present length from now on.

        The QP keeps its shape: an actuator whose least and greatest lengths are one is a fixed member.

        Raises
        ------
        GoalError
            No actuated member has that name.
        """
        if name not in self._actuator_names:
            what = "has a fixed length" if name in self.arm.truss.member_names else "is no member"
            names = ", ".join(self._actuator_names[:6]) + (", ..." if len(self._actuator_names) > 6 else "")
            raise GoalError(
                f'cannot lock "{name}", which {what}; actuated members are {names}{nearest(name, self._actuator_names)}'
            )
        k = self._actuator_names.index(name)
        self._limits[0][k] = self.state.lengths[self.arm.truss.actuators[k]]
        self._row_names[k] = f"locked: {name}"
        self._locked.add(name)
        before, self._braking = self._braking, None
        if before is not None and before.origin is self.state and before.steps:
            # What jams stops at once, as it will; the others brake, each by itself.
            brakes = self._brakes(before.steps[0][0].duration)
            self._braking = brakes.letting_go(self.state, before.path, before.steps[0][1])

    @property
    def control_vertex_goals(self) -> dict[int, Array]:
        """Where control vertices are drawn to, m, by their index; may be set as a whole."""
        drawn = self.arm.layout.vertex_goals
        return {i: np.array(self._vertex_goals[i]) for i in drawn} if self._vertex_goals is not None else {}

    @control_vertex_goals.setter
    def control_vertex_goals(self, goals: Mapping[int, ArrayLike]) -> None:
        vertices = len(self.state.control_vertices)
        places = np.full((vertices, 3), np.nan)
        for index, position in goals.items():
            if index not in range(vertices):
                last = f"0 to {vertices - 1}" if vertices else "none: there is no curve"
                raise GoalError(f"{index!r} is not a control vertex; they are {last}")
            places[index] = _vector(position, f"the goal of control vertex {index}")
        drawn = tuple(sorted(int(index) for index in goals))
        if drawn != self.arm.layout.vertex_goals:
            self._reshape(self.arm.layout.family, drawn)
        self._vertex_goals = places if drawn else None

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
        shape = self.arm.layout.shape
        if shape is None:
            raise GoalError("this arm has no curve whose control vertices could change")
        self.control_vertex_goals = {}
        state = self.state
        frame = base_frame(self.arm.truss, self.arm.base_at(state.time)[1])
        curve = Curve(shape.family, state.control_vertices, state.torsion, frame)
        more = count - len(state.control_vertices)
        change = add_control_vertices(curve, more) if more >= 0 else remove_control_vertices(curve, -more)
        if more:
            braking = self._braking
            self._reshape(change.curve.family, ())
            self.state = replace(state, control_vertices=frozen(change.curve.control_vertices))
            if braking is not None and braking.origin is state:
                steps = [
                    (self._with_vertices(then, shape.family, more), value) for then, value in braking.steps
                ]
                self._braking = replace(braking, origin=self.state, steps=steps)
        return change.change

    def _with_vertices(self, state: State, family: CurveFamily, more: int) -> State:
        """Return a state whose curve of a `family` has so many control vertices more, or fewer."""
        frame = base_frame(self.arm.truss, self.arm.base_at(state.time)[1])
        curve = Curve(family, state.control_vertices, state.torsion, frame)
        change = add_control_vertices(curve, more) if more >= 0 else remove_control_vertices(curve, -more)
        return replace(state, control_vertices=frozen(change.curve.control_vertices))

    def _reshape(self, family: CurveFamily | None, vertex_goals: tuple[int, ...]) -> None:
        """Go on with another curve; what was built for one is kept for the next time."""
        self._arms[curve_key(self.arm.layout)] = self.arm
        wanted = with_curve(self.arm.layout, family, vertex_goals)
        key = curve_key(wanted)
        if key not in self._arms:
            self._arms[key] = reshaped(self.arm, wanted)
        self.arm = self._arms[key]
        self._attempt.engine, self._attempt.tracking = self.arm.engine, _hard_tracking(self.arm)

    def _until_jam(self, dt: float) -> float:
        """Lock what jams by now; return the part of a step of `dt` that ends at the next jam, 1 where none is due."""
        while self._jams and self._jams[-1][1] <= self.state.time + _INSTANT:
            self.lock(self._jams.pop()[0])
        left = self._jams[-1][1] - self.state.time if self._jams else np.inf
        return left / dt if left < dt - _INSTANT else 1.0

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
        return self.follow(self._path_to(position, pointing, rotation_vector), 0.0, 1.0, dt=dt)

    def build(
        self,
        *,
        position: ArrayLike | None = None,
        pointing: ArrayLike | None = None,
        rotation_vector: ArrayLike | None = None,
        dt: float | None = None,
    ) -> StepQP:
        """Return the QP that a step to a goal starts with, to read, to print or to solve elsewhere; nothing moves.

        Every row and column has a name, a kind and a unit. It is the whole QP, whatever smaller one with the same
        answer the solver is given, and holds every pair within influence.

        Parameters
        ----------
        position, pointing, rotation_vector, dt
            As :meth:`step` takes them.

        Raises
        ------
        GoalError
            As :meth:`step` raises it.
        """
        path, dt = self._path_to(position, pointing, rotation_vector), self._duration(dt)
        return whole_qp(
            self.arm, self._separation, self.state, self._target(path, 0.0, 1.0, dt, self._box(dt))
        )

    def _path_to(
        self, position: ArrayLike | None, pointing: ArrayLike | None, rotation_vector: ArrayLike | None
    ) -> Path:
        """Return the straight way from the tip's present pose to a goal."""
        self._check_tracked(position=position, pointing=pointing, rotation_vector=rotation_vector)
        here, rotation = self.tip()
        there = here if position is None else _vector(position, "position")
        if pointing is not None:
            wanted = _vector(pointing, "pointing")
            norm = float(np.linalg.norm(wanted))
            if norm < 1e-9:
                raise GoalError("pointing must not be the zero vector; the state of the arm is unchanged")
            turned = rotation_from_vector(turn_between(rotation[:, 2], wanted / norm)) @ rotation
        elif rotation_vector is not None:
            turned = rotation_from_vector(_vector(rotation_vector, "rotation_vector"))
        else:
            turned = rotation
        return Path(np.array([0.0, 1.0]), np.stack([here, there]), np.stack([rotation, turned]))

    def _check_tracked(self, **goal: ArrayLike | None) -> None:
        """Refuse a goal for coordinates that no row of the QP steers, and two goals for one."""
        task = self.arm.task
        served = {
            "position": bool(len(task.axes)),
            "pointing": bool(task.turns),
            "rotation_vector": bool(task.turns),
        }
        for name, value in goal.items():
            if value is not None and not served[name]:
                tracked = ", ".join(task.track)
                raise GoalError(f"{name} is not tracked, only {tracked}; the state of the arm is unchanged")
        if goal["pointing"] is not None and goal["rotation_vector"] is not None:
            raise GoalError("give pointing or rotation_vector, not both; the state of the arm is unchanged")

    def tip(self) -> tuple[Array, Array]:
        """Return position (3,), m, and rotation (3, 3) of the end effector in the present state."""
        kinematics = self.arm.kinematics
        kinematics.evaluate(self.state.nodes)
        return kinematics.tip_position(self.state.nodes), kinematics.tip_rotation.copy()

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
        dt = self._duration(dt)
        whole = self._until_jam(dt)
        dt *= whole
        state, box = self.state, self._slowing(self._box(dt))
        braking = self._braking if self._braking is not None and self._braking.origin is state else None
        can_brake = braking is not None and bool(braking.steps) and whole == 1.0
        if can_brake:
            smallest = max(smallest, _SMALLEST_MOVING)
        share, outcome, after = self._first_accepted(
            path,
            start,
            start + whole * (end - start),
            box,
            dt,
            smallest,
            braking.rank if can_brake and braking is not None else _ANY_RANK,
        )
        told = (self._limit_names(state, dt, box), outcome.solution, outcome.rows, outcome.solver_failed)
        if not outcome.accepted and braking is not None and can_brake:
            return self._brake(braking, path, start, end, outcome.reason, outcome.iterations, *told)
        if not outcome.accepted:
            return Step(StepStatus.BLOCKED, 0.0, state, outcome.reason, outcome.iterations, *told)
        progress = share * whole * outcome.progress
        self.state, self._braking = outcome.state_after(state), None
        if after is not None:
            self._braking = replace(after, origin=self.state)
        status = StepStatus.REACHED if progress >= 1.0 - 1e-9 else StepStatus.SLOWED
        return Step(status, progress, self.state, "", outcome.iterations, *told)

    def _first_accepted(
        self,
        path: Path,
        start: float,
        end: float,
        box: tuple[Array, Array],
        dt: float,
        smallest: float,
        worst: int,
    ) -> tuple[float, Outcome, Braking | None]:
        """Return the first attempt at a piece of path or a part of it that is accepted, or else the last.

        Beside it stand the part that was tried and how the arm brakes after it. An attempt after which the arm brakes
        in a better way comes before others, and one of a rank beyond the `worst`, as good as the arm could brake now,
        is none.
        """
        best: tuple[float, Outcome, Braking | None] | None = None
        for share, outcome, after in self._attempts(path, start, end, box, dt, smallest):
            found = share, outcome, after
            rank = 0 if after is None else after.rank
            if outcome.accepted and rank <= worst:
                best, worst = found, rank - 1
                if not rank:
                    break
        if best is not None:
            return best
        share, outcome, _ = found
        return share, replace(outcome, accepted=False, reason=outcome.reason or _OFF_PATH), None

    def _attempts(
        self, path: Path, start: float, end: float, box: tuple[Array, Array], dt: float, smallest: float
    ) -> Iterator[tuple[float, Outcome, Braking | None]]:
        """Yield the attempts at a piece of path: the whole, halves of it where the tip may be slow, and creeping."""
        share, lengths = 1.0, self.state.lengths[self.arm.truss.actuators]
        yield share, *self._try(path, start, end, box, dt)
        while share > smallest and self.arm.tip_mode == "scaled":
            share /= 2
            near = _within(lengths, share * _TRUST, *box)
            yield share, *self._try(path, start, start + share * (end - start), near, dt, share)
        if self._must_brake:
            slow = _creeping(lengths, self._limits[2] * dt * dt, *box)
            if slow is not None:
                yield 1.0, *self._try(path, start, end, slow, dt)

    def _try(
        self, path: Path, start: float, reach: float, box: tuple[Array, Array], dt: float, share: float = 1.0
    ) -> tuple[Outcome, Braking | None]:
        """Return what comes of a step from `start` to `reach` on a path, and how the arm brakes after it if it must."""
        state, braking = self.state, None
        outcome = self._attempt.run(state, self._target(path, start, reach, dt, box), share)
        if outcome.accepted and outcome.progress < 1.0 - 1e-9 and self.arm.tip_mode != "scaled":
            # The tip stays on time: no part of the path will do.
            outcome = replace(outcome, accepted=False, reason="the tip cannot stay on time")
        if outcome.accepted and self._must_brake:
            covered = outcome.progress * (reach - start)
            if start + covered >= path.end - _INSTANT:
                # Where a path goes on from its end, or whether, is not known yet.
                path = path.continued(_BEYOND)
            braking = self._find_braking(outcome.state_after(state), path, start + covered, 2.0 * covered, dt)
            if braking is None:
                # A step may be too short to rest in what the longer one before it allowed.
                shorter = dt < (1.0 - 1e-9) * state.duration
                why = f"{CANNOT_BRAKE} in {dt:g} s, less than the last step took" if shorter else CANNOT_BRAKE
                outcome = replace(outcome, accepted=False, reason=why)
        return outcome, braking

    def brake(self, path: Path | None = None, start: float = 0.0, end: float = 1.0) -> Step | None:
        """Take the next of the steps that bring a moving arm with limited accelerations to rest.

        They were known before the last step was taken, each within the limits and clear. None where the arm may stay
        as it is; nothing moves then. Progress is counted from `start` to `end` of a `path` that it brakes on.
        """
        braking = self._braking
        if braking is None or braking.origin is not self.state or not braking.steps:
            return None
        return self._brake(braking, path, start, end, "", 0, str)

    def _brake(
        self, braking: Braking, path: Path | None, start: float, end: float, reason: str, qps: int, *told: Any
    ) -> Step:
        """Take the first step of `braking`; `told` is what the step says besides."""
        self.state, value = braking.steps[0]
        self._braking = braking.rest
        on_path = braking.on_path > 0
        progress = (value - start) / (end - start) if on_path and path is braking.path else 0.0
        step = Step(StepStatus.SLOWED, progress, self.state, reason, qps, *told)
        return replace(step, braked=True, left_path=not on_path)

    @cached_property
    def _length_solver(self) -> LengthSolver:
        return LengthSolver(self.arm.layout)

    @property
    def _must_brake(self) -> bool:
        """Whether a moving arm cannot simply stay where it is: accelerations are limited."""
        return not self._starts_at_once

    def _find_braking(
        self, state: State, path: Path, value: float, piece: float, dt: float
    ) -> Braking | None:
        """Return how the arm comes to rest from `state`, at `value` of `path`, in steps of `dt`, s."""
        return self._brakes(dt).find(state, path, value, piece)

    def _brakes(self, dt: float) -> Brakes:
        return Brakes(
            self.arm,
            self._attempt,
            dt,
            lambda now: self._box(dt, now),
            lambda now, *piece_and_box: self._target_from(now, dt, *piece_and_box),
            lambda: self._length_solver,
        )

    def _duration(self, dt: float | None) -> float:
        dt = self.arm.dt if dt is None else dt
        try:
            duration = float(dt)
        except (TypeError, ValueError):
            duration = math.nan
        if not _SHORTEST <= duration <= _LONGEST:
            raise GoalError(
                f"dt must be a positive number of seconds, from {_SHORTEST:g} to {_LONGEST:g}, not {dt!r}; the state "
                "of the arm is unchanged"
            )
        return duration

    def _box(self, dt: float, state: State | None = None) -> tuple[Array, Array]:
        """Return the least and greatest lengths of the actuators, m, after a step of `dt`, s."""
        state, actuators = state or self.state, self.arm.truss.actuators
        length, rate = state.lengths[actuators], state.length_rates[actuators]
        return length_box(length, rate, *self._limits, dt, state.duration or None)

    def _slowing(self, box: tuple[Array, Array]) -> tuple[Array, Array]:
        """Return the part of the boxes (n_a,) within which actuators slow down before the ends of their strokes, m."""
        if not self._slows_down or self._must_brake:
            return box
        length, stroke = self.state.lengths[self.arm.truss.actuators], self._limits[0]
        down, up = (
            np.maximum(_STROKE_APPROACH * room, np.minimum(room, _LEAST_APPROACH))
            for room in (np.maximum(length - stroke[:, 0], 0.0), np.maximum(stroke[:, 1] - length, 0.0))
        )
        return np.maximum(box[0], np.minimum(length - down, box[1])), np.minimum(
            box[1], np.maximum(length + up, box[0])
        )

    def _target(self, path: Path, start: float, end: float, dt: float, box: tuple[Array, Array]) -> Target:
        return self._target_from(self.state, dt, path, start, end, box)

    def _target_from(
        self, state: State, dt: float, path: Path, start: float, end: float, box: tuple[Array, Array]
    ) -> Target:
        then = state.time + dt
        return Target(path, start, end, *box, then, *self.arm.base_at(then), self._vertex_goals)

    def _limit_names(self, state: State, dt: float, box: tuple[Array, Array]) -> Callable[[int, bool], str]:
        """Return what names the limit at the lower (False) or upper side of an actuator's box, by its number."""
        (stroke, rate, acceleration), rows = self._limits, tuple(self._row_names)
        ends, names, actuators = stroke.copy(), self._actuator_names, self.arm.truss.actuators

        def name(k: int, upper: bool) -> str:
            bound, way = float(box[upper][k]), rate[k] * dt
            if rows[k].startswith("locked") or abs(bound - ends[k, int(upper)]) < _INSTANT:
                return rows[k]
            length = float(state.lengths[actuators[k]])
            if abs(bound - (length + way if upper else length - way)) < _INSTANT:
                return f"rate: {names[k]}"
            return rows[k] if math.isinf(acceleration[k]) else f"acceleration: {names[k]}"

        return name

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
        dt, state = self.arm.dt if dt is None else dt, state or self.state
        told = ("", {}, False) if last is None else (last.reason, last.multipliers, last.solver_failed)
        if last is not None and last.left_path:
            told = (BASE_MOVES_ON, last.multipliers, False)
        return explain(self.arm, self._separation, state, path, start, end, self._limits_at(state, dt), *told)

    def _limits_at(self, state: State, dt: float) -> Limits:
        """Return the boxes of a step of `dt`, s, from `state`, and what sets each of their sides."""
        actuators = self.arm.truss.actuators
        stroke, rate, _ = self._limits
        length = state.lengths[actuators]
        lower, upper = self._box(dt, state)

        def kinds(bound: Array, end: Array, fastest: Array) -> list[StopKind]:
            kind = np.where(np.abs(bound - fastest) < 1e-9, StopKind.RATE, StopKind.ACCELERATION)
            kind = np.where(np.abs(bound - end) < 1e-9, StopKind.STROKE, kind)
            kind = np.where(stroke[:, 0] == stroke[:, 1], StopKind.LOCKED, kind)
            return [StopKind(name) for name in kind.tolist()]

        low = kinds(lower, stroke[:, 0], length - rate * dt)
        high = kinds(upper, stroke[:, 1], length + rate * dt)
        return Limits(lower, upper, self._actuator_names, low, high)


def _hard_tracking(arm: Arm) -> HardTracking | None:
    return HardTracking(arm.layout, arm.kinematics) if arm.layout.hard_tracking else None


def _within(length: Array, trust: float, lower: Array, upper: Array) -> tuple[Array, Array]:
    """Return the part of the boxes (n_a,) that is no further than `trust` from the present lengths, m."""
    return np.minimum(np.maximum(lower, length - trust), upper), np.maximum(
        np.minimum(upper, length + trust), lower
    )


def _creeping(length: Array, reach: Array, lower: Array, upper: Array) -> tuple[Array, Array] | None:
    """Return the part of the boxes (n_a,) after which an actuator may rest: no further than `reach` (n_a,), m, away."""
    reach = (1.0 - 1e-9) * reach
    lower, upper = np.maximum(lower, length - reach), np.minimum(upper, length + reach)
    return (lower, upper) if np.all(lower <= upper) else None


def _vector(value: ArrayLike, name: str) -> Array:
    try:
        vector = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        vector = np.zeros(0)
    if vector.shape != (3,) or not np.all(np.isfinite(vector)):
        raise GoalError(
            f"{name} must be three finite numbers, not {value!r}; the state of the arm is unchanged"
        )
    return vector
