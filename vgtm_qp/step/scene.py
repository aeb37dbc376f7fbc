"""What stands around an arm and what it carries, and how that changes while the arm runs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from threading import RLock
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.arm.carrying import Carried, carried
from vgtm_qp.arrays import Array
from vgtm_qp.errors import GoalError, ProblemError, nearest
from vgtm_qp.geometry.shapes import GeometryError, Obstacle
from vgtm_qp.problem.fields import quoted
from vgtm_qp.problem.obstacle import Box, Cylinder, Mesh, Sphere
from vgtm_qp.rotation import rotation_from_vector, vector_from_rotation
from vgtm_qp.step.build import make_obstacle
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State

Near = dict[str, float]
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
    def _after_change(self) -> Near:
        """Take note that the scene has changed; return the pairs that are too near now."""

    @property
    def obstacles(self) -> tuple[Box | Sphere | Cylinder | Mesh, ...]:
        """The obstacles of the scene; their centers are those at time 0."""
        return tuple(obstacle.table for obstacle in self.setup.monitor.obstacles)

    @property
    def carried(self) -> tuple[Box | Sphere | Cylinder | Mesh, ...]:
        """The bodies that the arm carries, where they are now."""
        if not (held := self.setup.carrier.carried):
            return ()
        position, rotation = self.tip()
        return tuple(
            _placed(
                body.table,
                position + rotation @ body.table.center,
                rotation @ rotation_from_vector(body.table.rotation_vector),
            )
            for body in held
        )

    @property
    def scene_changes(self) -> int:
        """Number of changes of the scene so far."""
        return self._changes

    def add_obstacle(self, obstacle: Box | Sphere | Cylinder | Mesh) -> Near:
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
    ) -> Near:
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
            changes.setdefault("center", np.add(before.center, np.multiply(self.state.time, before.velocity)))
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

    def attach(self, body: Box | Sphere | Cylinder | Mesh | str) -> Near:
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
                table = there.pop(self._number(body)).table
                centre = np.add(table.center, np.multiply(self.state.time, table.velocity))
            else:
                self._check_is_new(body)
                table, centre = body, np.array(body.center)
            position, rotation = self.tip()
            turn = rotation.T @ rotation_from_vector(table.rotation_vector)
            own = _placed(table, rotation.T @ (centre - position), turn)
            return self._put(there, [*self.setup.carrier.carried, carried(_made(own))])

    def release(self, name: str, *, keep: bool = True) -> Near:
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
            if name not in names:
                raise GoalError(f"{name!r} is not carried; {_known(name, names)}")
            k, there = names.index(name), list(self.setup.monitor.obstacles)
            if keep:
                there.append(_made(self.carried[k]))
            return self._put(there, [*held[:k], *held[k + 1 :]])

    def set_clearance(self, *, safe: float | None = None, self_safe: float | None = None) -> Near:
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
        if name not in names:
            raise GoalError(f"there is no obstacle {name!r}; {_known(name, names)}")
        return names.index(name)

    def _check_is_new(self, body: Any) -> None:
        if not isinstance(body, Box | Sphere | Cylinder | Mesh):
            raise GoalError(f"{body!r} is no obstacle; expected Box, Sphere, Cylinder or Mesh")
        if any(other.name == body.name for other in self.setup.monitor.obstacles):
            raise GoalError(f'there is an obstacle "{body.name}" already; move_obstacle moves it')
        if any(other.name == body.name for other in self.setup.carrier.carried):
            raise GoalError(f'"{body.name}" is carried already; release lets go of it')

    def _at_time_0(self, table: Any, changes: dict[str, Any]) -> Any:
        """Return an obstacle's table with `changes`, its center, given for now, that of time 0."""
        try:
            now = type(table)(**{**table.model_dump(), **changes})
            if not any(now.velocity):
                return now
            start = np.subtract(now.center, np.multiply(self.state.time, now.velocity))
            return type(table)(**{**now.model_dump(), "center": start})
        except ProblemError as error:
            raise GoalError("; ".join(map(str, error.mistakes))) from None

    def _put(self, obstacles: Sequence[Obstacle], carried: Sequence[Carried] | None = None) -> Near:
        self.setup.put(obstacles, carried)
        self._changes += 1
        return self._after_change()


def _made(table: Any) -> Obstacle:
    """Return the obstacle of a table; GoalError where its mesh cannot be read."""
    try:
        return make_obstacle(table)
    except GeometryError as error:
        raise GoalError(str(error)) from None


def _placed(table: Any, center: Array, rotation: Array) -> Any:
    """Return an obstacle's table at rest elsewhere."""
    place = {"center": center, "rotation_vector": vector_from_rotation(rotation), "velocity": (0.0, 0.0, 0.0)}
    return type(table)(**{**table.model_dump(), **place})


def _known(name: object, names: Sequence[str]) -> str:
    """Say which names there are."""
    return f"they are {quoted(names)}{nearest(str(name), names)}" if names else "there are none"
