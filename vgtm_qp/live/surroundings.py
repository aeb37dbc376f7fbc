"""What stands around the arm of a session and what it carries: changed by a hand, and drawn."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.arrays import Array
from vgtm_qp.errors import GoalError
from vgtm_qp.methods import Resolver
from vgtm_qp.problem.obstacle import Box, Cylinder, Mesh, Sphere
from vgtm_qp.step.state import State
from vgtm_qp.view.drawing import Drawing, carried_mesh, obstacle_meshes


class Surroundings(ABC):
    """The obstacles of a session, and what its arm carries.

    Attributes
    ----------
    drawing : Drawing
        The arm and the obstacles as they are now.
    """

    drawing: Drawing
    _resolver: Resolver
    _directory: Path
    _scene_changed: bool

    @property
    @abstractmethod
    def state(self) -> State:
        """Where the arm is."""

    @abstractmethod
    def pose(self) -> tuple[Array, Array]:
        """Return position (3,), m, and rotation (3, 3) of the tip."""

    @abstractmethod
    def _wake(self) -> None:
        """Let the arm try again at once."""

    @property
    def obstacles(self) -> tuple[Box | Sphere | Cylinder | Mesh, ...]:
        """The obstacles of the scene; their centers are those at time 0."""
        return self._resolver.obstacles

    def obstacle(self, name: str) -> Box | Sphere | Cylinder | Mesh:
        """Return the obstacle called `name`, its center where it is now.

        GoalError if there is none.
        """
        for table in self.obstacles:
            if table.name == name:
                now = np.add(table.center, np.multiply(self.state.time, table.velocity))
                return table.model_copy(update={"center": tuple(now.tolist())})
        raise GoalError(f"there is no obstacle {name!r}; {len(self.obstacles)} others are there")

    def add_obstacle(self, obstacle: Box | Sphere | Cylinder | Mesh) -> None:
        """Put an obstacle into the scene, its center where it is now; GoalError if its name is taken."""
        self._resolver.add_obstacle(obstacle)
        self._redraw(obstacle.name)

    def move_obstacle(self, name: str, *, center: ArrayLike, rotation_vector: ArrayLike) -> None:
        """Put an obstacle at `center` (3,), m, in an attitude `rotation_vector` (3,), rad.

        GoalError, and no change, if there is none of that name.
        """
        self._resolver.move_obstacle(name, center=center, rotation_vector=rotation_vector)
        self._redraw(name)

    def remove_obstacle(self, name: str) -> None:
        """Take an obstacle out of the scene; GoalError if there is none of that name."""
        self._resolver.remove_obstacle(name)
        self._redraw(name)

    @property
    def carried(self) -> tuple[str, ...]:
        """Names of the bodies that the arm carries."""
        return tuple(table.name for table in self._resolver.carried)

    def attach(self, name: str) -> None:
        """Carry an obstacle at the tip; GoalError, and no change, if there is none of that name."""
        self._resolver.attach(name)
        self._redraw(name)

    def release(self, name: str) -> None:
        """Let go of a body that is carried; GoalError if there is none of that name."""
        self._resolver.release(name)
        self._redraw(name)

    def _redraw(self, name: str) -> None:
        """Let problem and drawing follow a change of the obstacle called `name`."""
        self._scene_changed = True
        self._wake()
        there = {table.name: table for table in self.obstacles}
        known = {mesh.name: mesh for mesh in self.drawing.obstacles}
        fresh = [there[name].model_dump(mode="json", exclude_none=True)] if name in there else []
        known |= {mesh.name: mesh for mesh in obstacle_meshes(fresh, self._directory)}
        shown = [mesh for key, mesh in known.items() if key in there]
        for body in self._resolver.setup.carrier.carried:
            mesh = carried_mesh(body.record()["body"], self._directory, lambda _: self.pose())
            shown += [mesh] if mesh is not None else []
        self.drawing = replace(self.drawing, obstacles=tuple(shown))
