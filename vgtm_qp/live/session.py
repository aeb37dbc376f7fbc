"""An arm that follows the mouse: goals of its tip and control vertices, and steps towards these."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.methods import Resolver
from vgtm_qp.methods.presets import with_method
from vgtm_qp.problem import Problem
from vgtm_qp.rows.curve import fitted
from vgtm_qp.step.path import Path
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State, frozen
from vgtm_qp.step.step import Step, StepStatus
from vgtm_qp.verify.arm import recorded_arm
from vgtm_qp.view.drawing import make_drawing

OUTCOMES = {StepStatus.REACHED: "moving", StepStatus.SLOWED: "slowed", StepStatus.BLOCKED: "blocked"}

_REACHED = 1e-4
_STRIDE = 0.06
_RETRY_AFTER = 10


class Reading(NamedTuple):
    """What the page shows: one of `OUTCOMES` or ``"at rest"``, and what holds the arm back, most decisive first.

    Then all active rows of the last QP; the least distances to obstacles and between members that share no
    node, m; the pair nearest to an obstacle; the greatest gap between stations and curve, m, NaN without a
    curve; whether exact tracking gave way in the last step; and the computing time of that step, s.
    """

    outcome: str
    stopped_by: tuple[str, ...]
    active: tuple[str, ...]
    clearance: float
    self_clearance: float
    nearest: str
    gap: float
    gave_way: bool
    step_time: float


class Session:
    """One arm, its resolver, and its goals. Threads must not share a session."""

    def __init__(self, problem: Problem) -> None:
        self.problem = self._given = problem
        self._resolver = Resolver(problem)
        arm = self._resolver.setup.arm
        directory = problem.source.parent if problem.source else "."
        recorded = recorded_arm(arm.record(), arm.bodies.joints)
        vertices = len(self.state.control_vertices)
        self._drawn = self._resolver.setup
        self.drawing = make_drawing(problem.to_dict(), recorded, vertices, directory)
        self._step_time = 0.0
        self._put(self.state)

    @property
    def nodes(self) -> Array:
        """(N, 3) the nodes that are drawn, m: without those beside the stations of a serial arm."""
        return self.state.nodes[: len(self.drawing.arm.home)]

    @property
    def state(self) -> State:
        """Where the arm is."""
        return self._resolver.state

    @property
    def control_vertices(self) -> Array:
        """(V, 3) the drawn control vertices, m: fitted to the stations if the method has no curve."""
        return _with_curve(self.state, self._drawn).control_vertices

    @property
    def tip(self) -> Array:
        """(3,) position of the tip, m."""
        return self.pose()[0]

    def pose(self) -> tuple[Array, Array]:
        """Return position (3,), m, and rotation (3, 3) of the tip."""
        return self._resolver.tip()

    @property
    def vertices_can_be_wanted(self) -> bool:
        """True where the method follows goals of control vertices."""
        return self._resolver.draws_vertices and bool(len(self.state.control_vertices))

    def want_tip(self, position: Array) -> None:
        """Ask for the tip at `position` (3,), m."""
        self.target = np.array(position, dtype=float)
        self._waiting = 0

    def want_vertex(self, index: int, position: Array | None) -> None:
        """Ask for control vertex `index` at `position` (3,), m; None lets it go."""
        if position is None:
            self.vertex_goals.pop(index, None)
        else:
            self.vertex_goals[index] = np.array(position, dtype=float)
        self._waiting = 0

    def go_home(self) -> None:
        """Put the arm into its home pose, at rest, and drop all goals."""
        self._put(self._resolver.setup.home_state())

    def put_at(self, time: float, q: Array, control_vertices: Array) -> None:
        """Put the arm at rest in configuration `q` with `control_vertices` (V, 3), m, and drop all goals."""
        arm = self._resolver.setup.arm
        state = replace(
            self._resolver.setup.home_state(),
            time=float(time),
            q=frozen(q),
            nodes=frozen(arm.nodes(q)),
            control_vertices=frozen(control_vertices),
            quantities=frozen(arm.measured(q)),
        )
        self._put(state)

    def _put(self, state: State) -> None:
        self._resolver.state = _with_curve(state, self._resolver.setup)
        self.target = self.tip
        self.vertex_goals: dict[int, Array] = {}
        self._waiting = 0
        self._held_by: tuple[str, ...] = ()
        self._last: Step | None = None

    def change(self, settings: Mapping[str, Any]) -> None:
        """Change values of the problem, by key path, and go on from the same state.

        VgtmError, and no change, if a value is wrong or the method cannot serve this problem.
        """
        self._use(self.problem.replace(settings))

    def _use(self, problem: Problem) -> None:
        """Go on with another problem from the same state."""
        resolver = Resolver(problem)
        resolver.state = _with_curve(self.state, resolver.setup)
        self.problem, self._resolver = problem, resolver
        self._waiting, self._held_by = 0, ()

    def use_method(self, name: str) -> None:
        """Change to the method called `name`, with those keys of the original problem that it has.

        VgtmError, and no change, if the method cannot move this arm.
        """
        given = self._given.to_dict()["method"]
        self._use(with_method(self.problem.replace({"method": given}), name))

    def advance(self, dt: float) -> bool:
        """Make one step of duration `dt`, s, towards the goals; return whether the arm moved.

        A blocked arm tries again after a moment, since obstacles may have moved away.
        """
        away = self.target - self.tip
        distance = float(np.linalg.norm(away))
        if distance <= _REACHED and not self.vertex_goals:
            self._last, self._held_by = None, ()
            return False
        if self._waiting > 0:
            self._waiting -= 1
            return False
        if self.vertices_can_be_wanted:
            self._resolver.control_vertex_goals = dict(self.vertex_goals)
        position, rotation = self.pose()
        ends = np.stack([position, position + away * min(1.0, _STRIDE / max(distance, _REACHED))])
        path = Path(np.array([0.0, 1.0]), ends, np.stack([rotation, rotation]))
        started, before = perf_counter(), self.state.nodes
        step = self._resolver.follow(path, 0.0, 1.0, dt=dt)
        self._step_time = perf_counter() - started
        self._last = step
        if step.status is StepStatus.REACHED:
            self._held_by = ()
        elif step.active or not self._held_by:
            self._held_by = step.blocked_by
        if step.status is StepStatus.BLOCKED:
            self._waiting = _RETRY_AFTER
            return False
        return bool(np.max(np.abs(self.state.nodes - before)) > 1e-9)

    def reading(self) -> Reading:
        """Return the readings of the present state."""
        setup, state = self._resolver.setup, self.state
        monitor, points = setup.monitor, setup.arm.points(state.q)
        clearance, pair = monitor.least(points, state.time, among="obstacles")
        last = self._last
        return Reading(
            outcome="at rest" if last is None else OUTCOMES[last.status],
            stopped_by=self._held_by,
            active=() if last is None else last.active,
            clearance=clearance,
            self_clearance=monitor.least(points, state.time, among="members")[0],
            nearest="" if pair is None else monitor.names.clearance(pair).removeprefix("clearance: "),
            gap=setup.gap_of(state),
            gave_way=last is not None and last.gave_way,
            step_time=self._step_time,
        )


def _with_curve(state: State, setup: Setup) -> State:
    """Return a state with a setup's number of control vertices, fitted to the stations if that differs."""
    layout, stations = setup.layout, setup.arm.stations
    if len(state.control_vertices) == layout.vertices:
        return state
    if not layout.vertices:
        return replace(state, control_vertices=np.zeros((0, 3)), torsion=np.zeros(0))
    centres = stations.centres(state.nodes)
    normal = stations.frames[0][:, 2]
    vertices = fitted(layout.curve_weights, centres[layout.tracked], centres[0], normal)
    return replace(state, control_vertices=frozen(vertices), torsion=frozen(setup.torsion))
