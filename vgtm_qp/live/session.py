"""An arm that follows the mouse: goals of its tip and control vertices, and steps towards these."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path as FilePath
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.arm.arm import GRAVITY, Arm
from vgtm_qp.arrays import Array
from vgtm_qp.live.holding import hold_of, pairs_too_near
from vgtm_qp.live.reading import OUTCOMES, Reading
from vgtm_qp.live.surroundings import Surroundings
from vgtm_qp.methods import Resolver, method_name
from vgtm_qp.methods.presets import with_method
from vgtm_qp.problem import Problem
from vgtm_qp.rows.curve import fitted
from vgtm_qp.step.path import Path
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State, frozen
from vgtm_qp.step.step import Step, StepStatus
from vgtm_qp.verify.arm import recorded_arm
from vgtm_qp.view.drawing import make_drawing

_REACHED = 1e-4
_STRIDE = 0.06
_RETRY_AFTER = 10
_CRAWL = 1e-3
"""Share of a step below which an arm counts as held, so that the page says what would let it go on."""


class Session(Surroundings):
    """One arm, its resolver, and its goals. Threads must not share a session.

    Attributes
    ----------
    drawing : Drawing
        The arm and the obstacles as they are now.
    target : (3,)
        Where the tip is wanted, m.
    vertex_goals : dict
        Where control vertices are wanted, m, by index.
    method : str
        Name of the method.
    steps : int
        Number of steps tried so far.
    """

    target: Array
    vertex_goals: dict[int, Array]

    def __init__(self, problem: Problem) -> None:
        self._problem = self._given = problem
        self._scene_changed = False
        self._resolver = Resolver(problem)
        arm = self._resolver.setup.arm
        self._directory = problem.source.parent if problem.source else FilePath()
        recorded = recorded_arm(arm.record(), arm.bodies.joints)
        vertices = len(self.state.control_vertices)
        self._drawn = self._resolver.setup
        self.drawing = make_drawing(problem.to_dict(), recorded, vertices, self._directory)
        self.method = method_name(problem)
        self._step_time, self._dt, self.steps = 0.0, 1.0, 0
        self._put(self.state)

    @property
    def problem(self) -> Problem:
        """The problem with the method, weights, clearance and obstacles of now."""
        if self._scene_changed:
            there = [table.model_dump(mode="json", exclude_none=True) for table in self.obstacles]
            self._problem, self._scene_changed = self._problem.replace({"obstacle": there}), False
        return self._problem

    @property
    def nodes(self) -> Array:
        """(N, 3) the nodes that are drawn, m: of a serial arm those of its record, with all vertices of its hulls."""
        return np.asarray(self.drawing.arm.nodes_at(self.state.q[None])[0])

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
        self._wake()

    def want_vertex(self, index: int, position: Array | None) -> None:
        """Ask for control vertex `index` at `position` (3,), m; None lets it go."""
        if position is None:
            self.vertex_goals.pop(index, None)
        else:
            self.vertex_goals[index] = np.array(position, dtype=float)
        self._wake()

    def _wake(self) -> None:
        """Let the arm try again at once, and forget why it stopped."""
        self._waiting, self._why = 0, ""

    def halt(self) -> str:
        """Drop all goals where the arm is; return what held it back, or an empty text."""
        why = self.explained()
        self.target, self.vertex_goals = self.tip, {}
        self._halted = bool(why)
        return why

    def go_home(self) -> None:
        """Put the arm into its home pose, at rest, and drop all goals."""
        self._put(self._aware(self._resolver.setup.home_state()))

    def _aware(self, state: State) -> State:
        """Return a state that knows what is too near, so that the arm keeps away from it even at rest."""
        return replace(state, shortfall=self._resolver.too_near(state) or None)

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
        self.vertex_goals = {}
        self._held_by: tuple[str, ...] = ()
        self._last: Step | None = None
        self._halted = False
        self._wake()

    def change(self, settings: Mapping[str, Any]) -> None:
        """Change values of the problem, by key path, and go on from the same state.

        VgtmError, and no change, if a value is wrong or the method cannot serve this problem.
        """
        problem = self.problem.replace(settings)
        if set(settings) == {"clearance.safe"}:
            clearance = problem.clearance
            self._resolver.set_clearance(safe=clearance.safe, self_safe=clearance.between_members)
            self._problem = problem
            self._wake()
        else:
            self._use(problem)

    def _use(self, problem: Problem) -> None:
        """Go on with another problem from the same state."""
        resolver, short = Resolver(problem), bool(self.state.shortfall)
        if held := self._resolver.setup.carrier.carried:
            resolver.setup.put(resolver.setup.monitor.obstacles, held)
        resolver.state = replace(_with_curve(self.state, resolver.setup), shortfall=None)
        self._problem, self._resolver, self._scene_changed = problem, resolver, False
        if short:
            resolver.state = self._aware(resolver.state)
        self.method, self._held_by, self._last = method_name(problem), (), None
        self._wake()

    def use_method(self, name: str) -> None:
        """Change to the method called `name`, with those keys of the original problem that it has.

        VgtmError, and no change, if the method cannot move this arm.
        """
        given = self._given.to_dict()["method"]
        self._use(with_method(self.problem.replace({"method": given}), name))

    def forces(self, load: ArrayLike) -> Array:
        """Return (M,) what members or joints bear where a force (3,), N, pulls at the tip, and of the arm's weight.

        See ``Arm.forces``; SolverError in a singular pose.
        """
        return self.arm.forces(self.state.q, np.asarray(load, dtype=float), gravity=GRAVITY)

    @property
    def arm(self) -> Arm:
        """The arm that is moved."""
        return self._resolver.setup.arm

    def advance(self, dt: float) -> bool:
        """Make one step of duration `dt`, s, towards the goals; return whether the arm moved.

        An arm that is nearer to something than it should be drives away from it. A blocked arm tries again after a
        moment, since obstacles may have moved away.
        """
        distance = float(np.linalg.norm(self.target - self.tip))
        if distance <= _REACHED and not self.vertex_goals and not self.state.shortfall:
            if not self._halted:
                self._last, self._held_by = None, ()
            return False
        self._halted = False
        if self._waiting > 0:
            self._waiting -= 1
            return False
        if self.vertices_can_be_wanted:
            self._resolver.control_vertex_goals = dict(self.vertex_goals)
        started, before = perf_counter(), self.state.nodes
        self._dt = dt
        step = self._resolver.follow(self._piece(), 0.0, 1.0, dt=dt)
        self._step_time = perf_counter() - started
        self._last, self.steps = step, self.steps + 1
        if step.status is StepStatus.REACHED:
            self._held_by = ()
        elif step.active or not self._held_by:
            self._held_by = step.blocked_by
        if step.progress > _CRAWL:
            self._why = ""
        if step.status is StepStatus.BLOCKED:
            self._waiting = _RETRY_AFTER
            return False
        return bool(np.max(np.abs(self.state.nodes - before)) > 1e-9)

    def _piece(self) -> Path:
        """Return the next piece of the straight way to the target."""
        position, rotation = self.pose()
        away = self.target - position
        share = min(1.0, _STRIDE / max(float(np.linalg.norm(away)), _REACHED))
        ends = np.stack([position, position + share * away])
        return Path(np.array([0.0, 1.0]), ends, np.stack([rotation, rotation]))

    def explained(self) -> str:
        """Return in a sentence what holds the arm and what would let it go on; empty if nothing does.

        It takes some ten milliseconds the first time after the arm has moved, and nothing afterwards.
        """
        last = self._last
        if last is None or last.status is StepStatus.REACHED or last.progress > _CRAWL:
            return ""
        if not self._why:
            self._why = str(self._resolver.explain(self._piece(), 0.0, 1.0, dt=self._dt, last=last))
        return self._why

    @property
    def safe(self) -> float:
        """Least distance from an obstacle that is kept, m."""
        return self._resolver.setup.safe

    @property
    def step_time(self) -> float:
        """Computing time of the last step, s."""
        return self._step_time

    @property
    def clearance(self) -> float:
        """Least distance to an obstacle, m; infinite without one."""
        setup, state = self._resolver.setup, self.state
        return setup.monitor.least(setup.carrier.points(state.q), state.time, among="obstacles")[0]

    def reading(self) -> Reading:
        """Return the readings of the present state."""
        setup, state = self._resolver.setup, self.state
        monitor, points = setup.monitor, setup.carrier.points(state.q)
        clearance, pair = monitor.least(points, state.time, among="obstacles")
        last = self._last
        outcome = "at rest" if last is None else "stopped" if self._halted else OUTCOMES[last.status]
        too_near = pairs_too_near(self._resolver)
        holding = [name for name in self._held_by if name.startswith("clearance: ")]
        is_held = outcome in ("slowed", "blocked", "stopped")
        wanted = holding if is_held else [f"clearance: {name}" for name, *_ in too_near]
        return Reading(
            outcome=outcome,
            stopped_by=self._held_by,
            why=self.explained(),
            active=() if last is None else last.active,
            clearance=clearance,
            self_clearance=monitor.least(points, state.time, among="members")[0],
            nearest="" if pair is None else monitor.names.called(pair),
            too_near=too_near,
            hold=hold_of(setup, state, wanted) if wanted else None,
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
