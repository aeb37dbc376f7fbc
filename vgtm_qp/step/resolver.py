"""`Resolver`, the class of all methods: what control loops, maneuvers and the live page call."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, NoReturn, Self

from numpy.typing import ArrayLike

from vgtm_qp.arm.arm import Pose
from vgtm_qp.arrays import Array
from vgtm_qp.errors import GoalError, PartError
from vgtm_qp.problem import Problem
from vgtm_qp.problem.problem import check_is_problem
from vgtm_qp.qp.full import StepQP
from vgtm_qp.qp.terms import Inequality, Objective
from vgtm_qp.step.actuation import Actuation
from vgtm_qp.step.attempt import Phases
from vgtm_qp.step.path import Path
from vgtm_qp.step.remedies import Remedy
from vgtm_qp.step.scene import ChangingScene, NamedShortfall
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import Shortfall, State
from vgtm_qp.step.step import Step
from vgtm_qp.step.stops import Stop, StopKind
from vgtm_qp.step.task import duration


class Resolver(ChangingScene):
    """Moves one arm step by step by the method of its problem, from one thread; others may change the scene.

    ``Resolver(problem)`` is an instance of the subclass that serves ``problem.method``. A call that a method cannot
    serve raises GoalError, which names the methods that can.

    Attributes
    ----------
    setup, state
        The arm ready to move, and its state, which may be set to another state of this arm.
    phases : dict of str to float
        Seconds spent so far in each phase.
    solver : str or None
        Name of the QP solver; None where the method solves no QP.
    rank : int or None
        Rank of the Jacobian of eq. (26) in the last step; None where the method does not reveal it.
    listener : callable or None
        Called after each step that moved the arm, with the pose that was asked of the tip at its end, and the step.
    draws_vertices : bool
        Whether control vertices follow goals of their own.

    Raises
    ------
    ProblemError
        The arm cannot be built, or not moved by that method.
    PartError
        An objective or row is none of this arm; or the method has no QP of the whole arm, to which they are added.
    """

    rank: int | None = None
    listener: Callable[[Pose, Step], None] | None = None
    draws_vertices = False
    _setup: Setup
    _actuation: Actuation
    _clock: Phases
    _follow: Callable[[Path, float, float, float, float], Step]
    """Moves along a path from value to value in a duration, s; the last argument is its share of a step."""
    _method = ""
    _served: ClassVar[dict[str, type[Resolver]]] = {}

    def __init_subclass__(cls, *, serves: str = "") -> None:
        if serves:
            cls._method = serves
            Resolver._served[serves] = cls

    def __new__(
        cls,
        problem: Problem | Setup,
        *,
        objectives: Sequence[Objective] = (),
        rows: Sequence[Inequality] = (),
    ) -> Self:
        """Return an instance of the subclass for the problem's method; for a ``Setup`` of ``QPResolver``.

        `objectives` of the user's own are added to those of the QP; each step keeps the `rows` of the user's own.
        """
        chosen: type = cls
        if cls is Resolver:
            if isinstance(problem, Setup):
                chosen = Resolver._served["qp"]
            else:
                check_is_problem(problem)
                chosen = Resolver._served[problem.method.name]
                _check_has_qp(problem, [*objectives, *rows])
        return object.__new__(chosen)

    @property
    def setup(self) -> Setup:
        """The arm ready to move: arm, curve, task, engine and clearance monitor."""
        return self._setup

    @property
    def solver(self) -> str | None:
        """Name of the QP solver."""
        return None

    @property
    def phases(self) -> dict[str, float]:
        """Seconds spent so far in each phase."""
        return self._clock.seconds

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
        if state.shortfall:
            # What was too near then may be gone, and something else be there.
            state = replace(state, shortfall=self.too_near(state) or None)
        self._state = state

    @property
    def locked(self) -> frozenset[str]:
        """Names of the actuators locked so far; members locked from the start are fixed members."""
        return frozenset(self._actuation.locked)

    def lock(self, name: str) -> None:
        """Hold an actuator at its present length or value from now on.

        Raises
        ------
        GoalError
            No actuator has that name, or the method cannot hold one.
        """
        self._actuation.lock(name, self.state)

    @property
    def control_vertex_goals(self) -> dict[int, Array]:
        """Goals of control vertices, m, by index; may be set as a whole if the method draws control vertices."""
        return {}

    @control_vertex_goals.setter
    def control_vertex_goals(self, goals: Mapping[int, ArrayLike]) -> None:
        if goals:
            self._refuse("draw control vertices")

    def set_control_vertex_goal(self, index: int, position: ArrayLike | None) -> None:
        """Draw a control vertex to a position in the null space of the tip's motion; None ends that.

        The arm follows as far as the tip's goal, limits and clearance let it.

        Parameters
        ----------
        index
            Control vertex, 0 at the base; p_0 and the direction of p_1 belong to the base.
        position
            (3,) goal, m, or None.

        Raises
        ------
        GoalError
            There is no such control vertex, the position is not three finite numbers, or the method draws none.
        """
        goals: dict[int, ArrayLike] = dict(self.control_vertex_goals)
        goals.pop(index, None)
        self.control_vertex_goals = goals if position is None else {**goals, index: position}

    def set_control_vertices(self, count: int) -> float:  # noqa: ARG002
        """Give the curve another number of control vertices in its present place; return how far it moved, m.

        More vertices change a Bezier curve or B-spline by rounding only; fewer are fitted. Control-vertex
        goals end.

        Raises
        ------
        GoalError
            The arm has no curve, or the method keeps the number.
        CurveError
            So few control vertices cannot keep both ends and the base tangent, or the family is one of the user's own.
        """
        self._refuse("change the number of control vertices")

    def step(
        self,
        *,
        position: ArrayLike | None = None,
        pointing: ArrayLike | None = None,
        rotation_vector: ArrayLike | None = None,
        dt: float | None = None,
    ) -> Step:
        """Move towards a goal of the end effector in one step and return the step.

        Parameters
        ----------
        position
            (3,) wanted position, m; by default the tip's own.
        pointing
            (3,) wanted direction of the tip's z-axis.
        rotation_vector
            (3,) wanted orientation, rad.
        dt
            Duration of the step, s; the problem's by default.

        Raises
        ------
        GoalError
            The goal is not three finite numbers, has a coordinate that is not tracked or the direction twice,
            or `dt` is not a positive number; the state is unchanged.
        """
        path = self.setup.task.path_to(self.state.tip or self.tip(), position, pointing, rotation_vector)
        return self.follow(path, 0.0, 1.0, dt=dt)

    def build(
        self,
        *,
        position: ArrayLike | None = None,  # noqa: ARG002
        pointing: ArrayLike | None = None,  # noqa: ARG002
        rotation_vector: ArrayLike | None = None,  # noqa: ARG002
        dt: float | None = None,  # noqa: ARG002
    ) -> StepQP:
        """Return the first QP of a step to a goal, to read, to print or to solve elsewhere; nothing moves.

        Rows and columns have names, kinds and units. It is assembled anew for reading, equal to the QP that the step
        solves condensed. Parameters and errors are those of :meth:`step`; GoalError also if the method solves no QP.
        """
        self._refuse("show the QP of a step, since it solves none")

    def tip(self) -> tuple[Array, Array]:
        """Return position (3,), m, and rotation (3, 3) of the end effector in the present state."""
        if (known := self.state.tip) is not None:
            return known.position.copy(), known.rotation.copy()
        with self._lock:
            self.setup.kinematics.evaluate_tip(nodes := self.state.nodes)
            return self.setup.arm.end_effector.position(nodes), self.setup.kinematics.tip_rotation.copy()

    def follow(self, path: Path, start: float, end: float, *, dt: float | None = None) -> Step:
        """Move along `path` from its value `start` towards `end` in one step of `dt`, s, by default the problem's.

        A step in which an actuator jams, see ``Setup.jams``, ends at that time, with the share of the path
        until then.

        Raises
        ------
        GoalError
            `dt` is not a positive number; the state is unchanged.
        """
        dt = duration(self.setup.dt if dt is None else dt)
        with self._lock:
            whole = self._until_jam(dt)
            step = self._follow(path, start, start + whole * (end - start), whole * dt, whole)
            return self._told(step, path, start, end)

    def _told(self, step: Step, path: Path | None, start: float, end: float) -> Step:
        """Tell the listener of a step along a piece of `path`, and return it."""
        if self.listener is not None and step.moved:
            # An arm that brakes is still moving to the goal before.
            asked = None if path is None or step.braked else path.pose(start + step.progress * (end - start))
            self.listener(asked or Pose(*self.tip()), step)
        return step

    def _until_jam(self, dt: float) -> float:
        """Lock actuators that have jammed; return the share of a step of `dt`, s, until the next jam."""
        for name in self._actuation.jammed(self.state.time):
            self.lock(name)
        return self._actuation.until_jam(self.state.time, dt)

    def brake(self, path: Path | None = None, start: float = 0.0, end: float = 1.0) -> Step | None:  # noqa: ARG002
        """Take the next of the braking steps that bring a moving arm with limited accelerations to rest.

        These steps were computed before the last step was accepted, each within the limits and clear of
        obstacles. If the arm is at rest, nothing moves and the result is None. Progress is counted from
        `start` to `end` of a braking `path`.
        """
        return None

    def explain(
        self,
        path: Path,  # noqa: ARG002
        start: float,  # noqa: ARG002
        end: float,  # noqa: ARG002
        *,
        dt: float | None = None,  # noqa: ARG002
        last: Step | None = None,
        state: State | None = None,  # noqa: ARG002
    ) -> Stop:
        """Return why the arm stopped at a state while moving along `path` from the value `start` to `end`.

        Meant for a `last` step that was blocked, hardly moved or braked. The state is the present one by default;
        nothing moves. A method without rows gives the reason of the last step.
        """
        if last is None:
            return Stop(StopKind.NONLINEAR)
        return Stop(StopKind.NONLINEAR, dict.fromkeys(last.blocked_by, 0.0), reason=last.reason)

    def _after_change(self) -> NamedShortfall:
        """See :class:`ChangingScene`; a method without rows reports pairs that are too near, and drives none apart."""
        setup, state = self.setup, self.state
        near = setup.monitor.near(
            setup.carrier.points(state.q), state.time, setup.safe, self_reach=setup.self_safe
        )
        return self._named((near.pair(k), float(near.distance[k])) for k in range(len(near)))

    def too_near(self, state: State) -> Shortfall:  # noqa: ARG002
        """Return the pairs below their clearance in a state, which steps drive apart, with their distances, m."""
        return {}

    def again(self, problem: Problem) -> Resolver | None:  # noqa: ARG002
        """Return a resolver at home for a second try of a maneuver, with other weights of the null space.

        None if the method has no such choice.
        """
        return None

    def relaxed(self, remedy: Remedy) -> Resolver | None:  # noqa: ARG002
        """Return a resolver of the same arm in the same state, with the limits changed by a stop's remedy.

        It shares its workspaces with this resolver. None if the method has no limits.
        """
        return None

    def _refuse(self, what: str, serving: str = '"qp"') -> NoReturn:
        raise GoalError(f'the method "{self._method}" cannot {what}; methods that can: {serving}')


def _check_has_qp(problem: Problem, own: Sequence[object]) -> None:
    """Raise PartError if there are terms of the user's own, and the method has no QP of the whole arm for them."""
    method = problem.method
    if own and (method.name != "qp" or method.goes_by_bays):
        raise PartError(
            f'the method "{method.name}" with tracking "{method.tracking}" has no QP of the whole arm; expected "qp" '
            'with tracking "coupled" or "none" for terms of one\'s own'
        )
