"""What stands around an arm and what it carries, and how that changes while the arm runs."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import replace
from threading import RLock
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.arm.carrying import Carried, carried
from vgtm_qp.arrays import Array
from vgtm_qp.errors import GoalError, ProblemError, nearest
from vgtm_qp.geometry.clearance import Pair
from vgtm_qp.geometry.shapes import GeometryError, Obstacle
from vgtm_qp.problem.fields import quoted
from vgtm_qp.problem.obstacle import Box, Cylinder, Mesh, Sphere
from vgtm_qp.rotation import rotation_from_vector, vector_from_rotation
from vgtm_qp.step.build import make_obstacle
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State

NamedShortfall = dict[str, float]
"""Pairs that are below their clearance, or will be while the arm brakes, by name, with their distances, m."""


class ChangingScene(ABC):
    """The obstacles of one arm, what it carries, and the clearances that it keeps; all may change between two steps.

    Each change takes effect with the next step, and costs about as much as one. A shape that the scene has not had yet
    costs more the first time, up to 0.2 s: a loop that cannot wait adds one of each before it starts. A body that is
    taken up or let go costs about as much as four steps of five bays. Other threads may call these methods: a change
    waits for the step that runs. An arm that is nearer than it should be afterwards does not come nearer, and the next
    steps drive it away.
    """

    def __init__(self) -> None:
        self._lock = RLock()
        self._changes = 0

    @property
    @abstractmethod
    def setup(self) -> Setup:
        """The arm ready to move."""

    @property
    @abstractmethod
    def state(self) -> State:
        """Where the arm is."""

    @abstractmethod
    def tip(self) -> tuple[Array, Array]:
        """Return position (3,), m, and rotation (3, 3) of the end effector."""

    @abstractmethod
    def _after_change(self) -> NamedShortfall:
        """Take note that the scene has changed; return the pairs that are too near now."""

    @property
    def obstacles(self) -> tuple[Box | Sphere | Cylinder | Mesh, ...]:
        """The obstacles of the scene; their centers are those at time 0."""
        return tuple(obstacle.table for obstacle in self.setup.monitor.obstacles)

    @property
    def carried(self) -> tuple[Box | Sphere | Cylinder | Mesh, ...]:
        """The bodies that the arm carries, where they are now."""
        with self._lock:
            return tuple(self._at_rest(body).table for body in self.setup.carrier.carried)

    def _at_rest(self, body: Carried) -> Obstacle:
        """Return a body that is carried as an obstacle where it is now."""
        position, rotation = self.tip()
        table = body.obstacle.table
        turn = rotation @ rotation_from_vector(table.rotation_vector)
        return _placed(body.obstacle, position + rotation @ table.center, turn)

    @property
    def scene_changes(self) -> int:
        """Number of changes of the scene so far."""
        return self._changes

    def add_obstacle(self, obstacle: Box | Sphere | Cylinder | Mesh) -> NamedShortfall:
        """Put an obstacle into the scene, its `center` where it is now; return the pairs that are too near now.

        Raises
        ------
        GoalError
            Another obstacle has its name, or its mesh cannot be read; the scene is unchanged.
        """
        with self._lock:
            self._check_is_new(obstacle)
            made = _made(self._at_time_0(obstacle, {"center": obstacle.center}))
            return self._put([*self.setup.monitor.obstacles, made])

    def move_obstacle(
        self,
        name: str,
        *,
        center: ArrayLike | None = None,
        rotation_vector: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
    ) -> NamedShortfall:
        """Put an obstacle elsewhere, or let it move otherwise; return the pairs that are too near now.

        Parameters
        ----------
        name
            Its name.
        center, rotation_vector
            (3,) where it is now, m, and its attitude, rad; as they are by default.
        velocity
            (3,) its velocity from now on, m/s, on which steps and their proofs count; as it is by default.

        Raises
        ------
        GoalError
            There is no such obstacle, or a value is not three finite numbers; the scene is unchanged.
        """
        with self._lock:
            there = list(self.setup.monitor.obstacles)
            k = self._number(name)
            before = there[k].table
            wanted = {"center": center, "rotation_vector": rotation_vector, "velocity": velocity}
            changes = {key: value for key, value in wanted.items() if value is not None}
            changes.setdefault("center", self._center(before))
            table = self._at_time_0(before, changes)
            place = before.center, rotation_from_vector(before.rotation_vector)
            rotation = rotation_from_vector(table.rotation_vector)
            there[k] = replace(there[k].placed(place, table.center, rotation, table.velocity), table=table)
            return self._put(there)

    def remove_obstacle(self, name: str) -> None:
        """Take an obstacle out of the scene.

        Raises
        ------
        GoalError
            There is no obstacle of that name.
        """
        with self._lock:
            there = list(self.setup.monitor.obstacles)
            del there[self._number(name)]
            self._put(there)

    def attach(self, body: Box | Sphere | Cylinder | Mesh | str) -> NamedShortfall:
        """Carry a body at the tip from now on; return the pairs that are too near now.

        The body keeps its present place relative to the end effector. Steps and their proofs keep it clear of obstacles
        and of the arm, except of the bodies that end at the tip, by capsules that enclose it: a sphere is kept as it
        is; up to nine capsules stick out of a box by an eighth of the edge of a cube, or less of flatter boxes; one
        capsule holds a cylinder or a mesh.

        Parameters
        ----------
        body
            With its `center` and attitude where they are now; or the name of an obstacle, which is none from now on.

        Raises
        ------
        GoalError
            There is no such obstacle, its name is taken, its mesh cannot be read, or the tip has fewer than three
            nodes and so no attitude; the scene is unchanged.
        """
        with self._lock:
            if not self.setup.arm.end_effector.has_frame:
                raise GoalError(
                    "this arm carries nothing: its tip has fewer than three nodes, and so no attitude"
                )
            there = list(self.setup.monitor.obstacles)
            if isinstance(body, str):
                made = there.pop(self._number(body))
            else:
                self._check_is_new(body)
                made = _made(self._at_time_0(body, {"velocity": (0.0, 0.0, 0.0)}))
            if made.name in self.setup.arm.bodies.names:
                raise GoalError(f'a {self.setup.arm.bodies.kind} of the arm is called "{made.name}", too')
            position, rotation = self.tip()
            turn = rotation.T @ rotation_from_vector(made.table.rotation_vector)
            held = carried(_placed(made, rotation.T @ (self._center(made.table) - position), turn))
            return self._put(there, [*self.setup.carrier.carried, held])

    def release(self, name: str, *, keep: bool = True) -> NamedShortfall:
        """Let go of a body that is carried; return the pairs that are too near now.

        It rests where it is as an obstacle, which the arm then leaves like any that is too near, or is gone if it is
        not to `keep`.

        Raises
        ------
        GoalError
            No body of that name is carried.
        """
        with self._lock:
            held = self.setup.carrier.carried
            names = [body.name for body in held]
            if (name := str(name)) not in names:
                raise GoalError(f"{name!r} is not carried; {_known(name, names)}")
            k, there = names.index(name), list(self.setup.monitor.obstacles)
            if keep:
                there.append(self._at_rest(held[k]))
            return self._put(there, [*held[:k], *held[k + 1 :]])

    def set_clearance(self, *, safe: float | None = None, self_safe: float | None = None) -> NamedShortfall:
        """Change the least clearances that are kept; return the pairs that are too near now.

        Parameters
        ----------
        safe, self_safe
            Surface distance from obstacles and between bodies, m; as it is by default.

        Raises
        ------
        GoalError
            A distance is not a number from 0 to below ``clearance.influence``; nothing is changed.
        """
        with self._lock:
            monitor = self.setup.monitor
            given = {"safe": safe, "self_safe": self_safe}
            for name, value in given.items():
                if value is not None and not 0.0 <= float(value) < monitor.influence:
                    limit = f"{monitor.influence:g} m, the influence of this problem"
                    raise GoalError(f"{name} = {value!r}: expected a distance from 0 to below {limit}")
            monitor.safe = monitor.safe if safe is None else float(safe)
            monitor.self_safe = monitor.self_safe if self_safe is None else float(self_safe)
            self._changes += 1
            return self._after_change()

    def _number(self, name: str) -> int:
        names = [obstacle.name for obstacle in self.setup.monitor.obstacles]
        if (name := str(name)) not in names:
            raise GoalError(f"there is no obstacle {name!r}; {_known(name, names)}")
        return names.index(name)

    def _named(
        self, found: Iterable[tuple[Pair, float]], known: NamedShortfall | None = None
    ) -> NamedShortfall:
        """Return the least distance of each name: of pairs that are `found`, and of those that are `known`."""
        names, near = self.setup.monitor.names, dict(known or {})
        for pair, distance in found:
            name = names.called(pair)
            near[name] = min(near.get(name, math.inf), distance)
        return near

    def _check_is_new(self, body: Any) -> None:
        if not isinstance(body, Box | Sphere | Cylinder | Mesh):
            raise GoalError(f"{body!r} is no obstacle; expected Box, Sphere, Cylinder or Mesh")
        if any(other.name == body.name for other in self.setup.monitor.obstacles):
            raise GoalError(f'there is an obstacle "{body.name}" already; move_obstacle moves it')
        if any(other.name == body.name for other in self.setup.carrier.carried):
            raise GoalError(f'"{body.name}" is carried already; release lets go of it')

    def _center(self, table: Any) -> Array:
        """Return (3,) where the center of an obstacle is now, m."""
        return np.asarray(np.add(table.center, np.multiply(self.state.time, table.velocity)))

    def _at_time_0(self, table: Any, changes: dict[str, Any]) -> Any:
        """Return an obstacle's table with `changes`; its center, which is given for now, becomes that at time 0."""
        try:
            now = type(table)(**{**table.model_dump(), **changes})
            if not any(now.velocity):
                return now
            start = np.subtract(now.center, np.multiply(self.state.time, now.velocity))
            return type(table)(**{**now.model_dump(), "center": start})
        except ProblemError as error:
            raise GoalError("; ".join(map(str, error.mistakes))) from None

    def _put(self, obstacles: Sequence[Obstacle], carried: Sequence[Carried] | None = None) -> NamedShortfall:
        self.setup.put(obstacles, carried)
        self._changes += 1
        return self._after_change()


def _made(table: Any) -> Obstacle:
    """Return the obstacle of a table; GoalError where its mesh cannot be read."""
    try:
        return make_obstacle(table)
    except GeometryError as error:
        raise GoalError(str(error)) from None


def _placed(obstacle: Obstacle, center: Array, rotation: Array) -> Obstacle:
    """Return an obstacle at rest elsewhere; nothing is read again of a mesh."""
    table = obstacle.table
    place = {
        "center": tuple(center.tolist()),
        "rotation_vector": tuple(vector_from_rotation(rotation).tolist()),
        "velocity": (0.0, 0.0, 0.0),
    }
    moved = table.model_copy(update=place)
    before = np.asarray(table.center), rotation_from_vector(table.rotation_vector)
    return replace(obstacle.placed(before, center, rotation, np.zeros(3)), table=moved)


def _known(name: object, names: Sequence[str]) -> str:
    """Say which names there are."""
    return f"they are {quoted(names)}{nearest(str(name), names)}" if names else "there are none"
