"""The obstacles on the page: choose one, drag it, let the arm carry it, add others clear of the arm, delete them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import GoalError
from vgtm_qp.live.session import Session
from vgtm_qp.live.stage import PageStage
from vgtm_qp.problem.obstacle import Box, Cylinder, Sphere

NONE = "(none)"
"""What the drop-down shows while no obstacle is chosen."""

_SIZE = 0.5
"""Diameter or edge of a new obstacle, over the size of the arm's parts; it is larger beside a thick arm."""
_ROOM = 0.1
"""Distance from the arm that a new obstacle has over the least one, over the size of the arm's parts."""
_ANGLES = np.radians(np.arange(-90.0, 270.0, 15.0))


class ObstacleTools:
    """The drop-down of obstacles, the gizmo at the chosen one, and the buttons that add and delete.

    Attributes
    ----------
    chosen : str
        Name of the chosen obstacle; empty if none is.
    """

    def __init__(self, stage: PageStage) -> None:
        self._stage, self.chosen, self._is_dragged = stage, "", False
        gui, inbox = stage.server.gui, stage.inbox
        self._list = gui.add_dropdown("obstacle", (NONE,), initial_value=NONE)
        self._place = gui.add_vector3("center [m]", (0.0, 0.0, 0.0), step=0.01, disabled=True)
        makers = {"box": self._box, "sphere": self._sphere, "cylinder": self._cylinder}
        for shape, make in makers.items():
            button = gui.add_button(f"Add {shape}", hint="beside the arm, clear of everything")
            inbox.on(button.on_click, partial(self._add, shape, make))
        self._delete = gui.add_button("Delete", color="red", disabled=True)
        inbox.on(self._list.on_update, lambda _: self.choose(self._list.value))
        inbox.on(self._place.on_update, lambda _: self._type(), newest="center")
        self._carry = gui.add_button(
            "Carry", disabled=True, hint="fix the chosen obstacle to the tip, where it is now"
        )
        self._drop = gui.add_button("Let go", disabled=True, hint="of what the arm carries")
        inbox.on(self._delete.on_click, lambda _: self.delete())
        inbox.on(self._carry.on_click, lambda _: self.carry())
        inbox.on(self._drop.on_click, lambda _: self.let_go())
        stage.draws.append(self.draw)
        self.rebuild()

    def rebuild(self) -> None:
        """Put the gizmo into the scene of another session, at no obstacle."""
        stage = self._stage
        scale = max(0.6 * stage.scene.unit, 5.0 * stage.scene.ball)
        self._gizmo = gizmo = stage.server.scene.add_transform_controls(
            "/chosen obstacle", scale=scale, depth_test=False, visible=False
        )
        stage.inbox.on(gizmo.on_update, self._grip)
        stage.inbox.on(gizmo.on_update, lambda _: self._drag(), newest="obstacle")
        self.choose("")

    def choose(self, name: str) -> None:
        """Choose the obstacle called `name`; none for an empty name or `NONE`."""
        names = [table.name for table in self._stage.session.obstacles]
        self.chosen = name if name in names else ""
        options = (NONE, *names)
        if tuple(self._list.options) != options:
            self._list.options = options
        self._list.value = self.chosen or NONE
        self._delete.disabled = self._place.disabled = self._carry.disabled = not self.chosen
        self._drop.disabled = not self._stage.session.carried
        self._gizmo.visible, self._is_dragged = bool(self.chosen), False
        if self.chosen:
            table = self._stage.session.obstacle(self.chosen)
            self._gizmo.disable_rotations = table.shape == "sphere"
            self._follow()

    def draw(self) -> None:
        """Let the gizmo follow an obstacle that moves by itself."""
        if self.chosen and not self._is_dragged and any(self._table.velocity):
            self._follow()

    @property
    def _table(self) -> Any:
        return self._stage.session.obstacle(self.chosen)

    def _follow(self) -> None:
        """Put gizmo and coordinates where the chosen obstacle is."""
        table = self._table
        self._gizmo.position = np.array(table.center)
        self._gizmo.wxyz = _quaternion(table.rotation_vector)
        self._place.value = tuple(np.round(table.center, 3).tolist())

    def _grip(self, event: Any) -> None:
        """Note that a hand has taken hold of the gizmo, or let it go."""
        self._is_dragged = event.phase != "end"

    def _drag(self) -> None:
        """Put the chosen obstacle where the gizmo is."""
        if self.chosen:
            place = np.array(self._gizmo.position)
            self._stage.session.move_obstacle(
                self.chosen, center=place, rotation_vector=_vector(np.array(self._gizmo.wxyz))
            )
            self._place.value = tuple(np.round(place, 3).tolist())

    def _type(self) -> None:
        """Put the chosen obstacle where its coordinates say."""
        if self.chosen:
            self._stage.session.move_obstacle(
                self.chosen, center=self._place.value, rotation_vector=self._table.rotation_vector
            )
            self._follow()

    def _add(self, shape: str, make: Callable[[str, float], Any], _event: Any) -> None:
        """Add an obstacle of a shape beside the arm, and choose it."""
        session = self._stage.session
        names = {*(table.name for table in session.obstacles), *session.carried}
        name = next(name for k in range(1, len(names) + 2) if (name := f"{shape} {k}") not in names)
        session.add_obstacle(make(name, max(_SIZE * self._stage.scene.unit, 4.0 * self._stage.scene.ball)))
        self.choose(name)

    def _box(self, name: str, size: float) -> Box:
        return Box(name=name, center=self._free(0.87 * size), size=(size, size, size))

    def _sphere(self, name: str, size: float) -> Sphere:
        return Sphere(name=name, center=self._free(size / 2), radius=size / 2)

    def _cylinder(self, name: str, size: float) -> Cylinder:
        return Cylinder(name=name, center=self._free(0.71 * size), radius=size / 2, height=size)

    def _free(self, radius: float) -> Any:
        session = self._stage.session
        return tuple(free_place(session, radius, _ROOM * self._stage.scene.unit).tolist())

    def delete(self) -> None:
        """Take the chosen obstacle away; GoalError if none is chosen."""
        if not self.chosen:
            raise GoalError("no obstacle is chosen; choose one in the list, or add one")
        self._stage.session.remove_obstacle(self.chosen)
        self.choose("")

    def carry(self) -> None:
        """Fix the chosen obstacle to the tip; GoalError if none is chosen or the tip has no attitude."""
        self._stage.session.attach(self.chosen)
        self.choose("")

    def let_go(self) -> None:
        """Let go of what was taken up last, and choose it; GoalError if nothing is carried."""
        held = self._stage.session.carried
        if not held:
            raise GoalError("the arm carries nothing; choose an obstacle and press Carry")
        self._stage.session.release(held[-1])
        self.choose(held[-1])


def free_place(session: Session, radius: float, room: float) -> Array:
    """Return the center (3,), m, of a ball of a `radius`, m, that is clear of the arm and of all obstacles.

    It is at half the height of the arm, as near to it as the least clearance, and `room`, m, more, allow.
    """
    arm, nodes = session.drawing.arm, session.nodes
    ends = arm.ends(nodes)
    # A hull is in a ball round one of its vertices.
    reach = np.linalg.norm(ends - ends[:, :1], axis=2).max(axis=1)
    thick = arm.radius + np.where(arm.is_hull, reach, 0.0)
    middle = (nodes.min(axis=0) + nodes.max(axis=0)) / 2
    time = session.state.time
    others = [
        np.stack([corners.min(axis=0), corners.max(axis=0)]) + mesh.position(time)
        for mesh in session.drawing.obstacles
        for corners in [mesh.vertices @ mesh.rotation(time).T]
    ]
    least = radius + session.safe + room
    away = least
    while True:
        for angle in _ANGLES:
            center = middle + away * np.array([np.cos(angle), np.sin(angle), 0.0])
            is_clear = float(np.min(_distances(center, ends[:, :2]) - thick)) >= least
            if is_clear and all(np.linalg.norm(center - np.clip(center, *box)) >= radius for box in others):
                return np.asarray(center)
        away += 0.25 * least


def _distances(point: Array, segments: Array) -> Array:
    """Return the distances (K,) of a point (3,) from segments (K, 2, 3)."""
    start, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    length = np.maximum(np.einsum("kc,kc->k", along, along), 1e-12)
    share = np.clip(np.einsum("kc,kc->k", point - start, along) / length, 0.0, 1.0)
    return np.asarray(np.linalg.norm(start + share[:, None] * along - point, axis=1))


def _quaternion(vector: Any) -> Array:
    """Return the unit quaternion (w, x, y, z) of a rotation vector (3,), rad."""
    half = np.asarray(vector, dtype=float) / 2
    angle = float(np.linalg.norm(half))
    return np.concatenate([[np.cos(angle)], np.sinc(angle / np.pi) * half])


def _vector(wxyz: Array) -> Array:
    """Return the rotation vector (3,), rad, of a unit quaternion (w, x, y, z)."""
    w, axis = (wxyz[0], wxyz[1:]) if wxyz[0] >= 0.0 else (-wxyz[0], -wxyz[1:])
    sine = float(np.linalg.norm(axis))
    return np.asarray(axis * (2.0 * np.arctan2(sine, w) / sine if sine > 1e-9 else 2.0))
