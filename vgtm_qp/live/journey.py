"""A goal that is dropped somewhere, and the way there, step by step, until it is reached or something stops it."""

from __future__ import annotations

from typing import Any

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.live.session import Session
from vgtm_qp.live.stage import PageStage

_GOAL_COLOUR = (31, 119, 180)
_LEAST_GAIN = 1e-3
_PATIENCE = 45
"""Frames within which the tip must come `_LEAST_GAIN`, m, nearer to its goal, or it counts as stopped."""


class Journey:
    """The way of a session's tip to a goal (3,), m.

    Attributes
    ----------
    goal : (3,)
    said : str
        In words, how it goes.
    is_over : bool
    """

    def __init__(self, session: Session, goal: Array) -> None:
        self.goal, self.said, self.is_over = np.array(goal, dtype=float), "on the way to the goal", False
        self._nearest, self._idle = np.inf, 0
        session.want_tip(self.goal)

    def watch(self, session: Session) -> None:
        """Take note of a frame: see whether the tip has arrived, or comes no nearer, and then let it rest."""
        if self.is_over:
            return
        if not np.array_equal(session.target, self.goal):
            self.said, self.is_over = "", True
            return
        distance = float(np.linalg.norm(self.goal - session.tip))
        if distance < self._nearest - _LEAST_GAIN:
            self._nearest, self._idle = distance, 0
        else:
            self._idle += 1
        reading = session.reading().outcome if self._idle else ""
        if reading == "at rest":
            self.said, self.is_over = "arrived at the goal", True
        elif self._idle > _PATIENCE:
            session.halt()
            self.said, self.is_over = f"{1000.0 * distance:.0f} mm from the goal", True


class GoalTools:
    """The goal in the scene with its gizmo, its coordinates, and the buttons that send the tip there.

    Attributes
    ----------
    journey : Journey or None
        The last way to the goal.
    """

    def __init__(self, stage: PageStage, pause: Any) -> None:
        self._stage, self._pause = stage, pause
        gui, inbox = stage.server.gui, stage.inbox
        self.journey: Journey | None = None
        self._place = gui.add_vector3("goal [m]", (0.0, 0.0, 0.0), step=0.01)
        go = gui.add_button("Go there", hint="by steps, until the tip arrives or something stops it")
        stop = gui.add_button("Stop", color="gray", hint="let the arm rest where it is")
        inbox.on(self._place.on_update, lambda _: self._drop(self._place.value), newest="goal")
        inbox.on(go.on_click, lambda _: self.go())
        inbox.on(stop.on_click, lambda _: self.stop())
        self.rebuild()

    def rebuild(self) -> None:
        """Put the goal of another session into its scene: where the path of its maneuver ends."""
        stage = self._stage
        scene, goal = stage.server.scene, np.asarray(stage.path[-1], dtype=float)
        unit, ball = stage.scene.unit, stage.scene.ball
        self._gizmo = scene.add_transform_controls(
            "/goal",
            scale=max(0.45 * unit, 3.5 * ball),
            disable_rotations=True,
            disable_sliders=True,
            depth_test=False,
            position=goal,
        )
        scene.add_icosphere("/goal/ball", radius=0.8 * ball, color=_GOAL_COLOUR, opacity=0.8)
        gizmo = self._gizmo
        stage.inbox.on(gizmo.on_update, lambda _: self._drop(gizmo.position), newest="goal")
        self.journey = None
        self._drop(goal)

    def _drop(self, position: Any) -> None:
        """Put the goal elsewhere; a tip on its way goes on to the old one."""
        self.goal = np.array(position, dtype=float)
        self._place.value = tuple(np.round(self.goal, 3).tolist())
        if not np.array_equal(self._gizmo.position, self.goal):
            self._gizmo.position = self.goal

    def go(self) -> None:
        """Send the tip to the goal."""
        self._pause()
        self.journey = Journey(self._stage.session, self.goal)

    def stop(self) -> None:
        """Let the arm rest where it is."""
        self._pause()
        self.journey = None
        self._stage.session.halt()

    def watch(self) -> None:
        """Take note of a frame."""
        if self.journey is not None:
            self.journey.watch(self._stage.session)

    @property
    def said(self) -> str:
        """In words, how the way to the goal goes; empty if the tip is not on one."""
        return "" if self.journey is None else self.journey.said
