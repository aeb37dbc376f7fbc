"""The balls that a hand drags: one at the tip, and one at each control vertex that can follow."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import GoalError
from vgtm_qp.live.stage import PageStage
from vgtm_qp.view.drawing import CURVE_COLOUR

_TARGET_COLOUR = (214, 39, 40)


class Handles:
    """The balls at tip and control vertices."""

    def __init__(self, stage: PageStage, pause: Callable[[], None]) -> None:
        self._stage, self._pause = stage, pause
        self.rebuild()
        stage.draws.append(self.draw)

    def rebuild(self) -> None:
        """Put the balls of another session into its scene."""
        session = self._stage.session
        vertices, ball = session.control_vertices, self._stage.scene.ball
        self._target = self._add("/tip target", session.target, ball, _TARGET_COLOUR, self._drag_tip)
        colour = tuple(round(255 * channel) for channel in CURVE_COLOUR)
        # The first vertex belongs to the base; the last one has the ball of the tip.
        inner = range(1, len(vertices) - 1) if session.vertices_can_be_wanted else ()
        self._vertices = {
            i: self._add(
                f"/control vertex {i}", vertices[i], 0.7 * ball, colour, partial(self._drag_vertex, i)
            )
            for i in inner
        }

    def draw(self) -> None:
        """Draw the balls where the goals are."""
        session = self._stage.session
        self._target.position = session.target
        vertices = session.control_vertices
        for i, handle in self._vertices.items():
            if i < len(vertices):
                handle.position = session.vertex_goals.get(i, vertices[i])

    def _add(self, name: str, position: Array, radius: float, colour: Any, moved: Any) -> Any:
        """Draw a ball; `moved` is called with the place it is dragged to, and whether it was released."""
        handle = self._stage.server.scene.add_icosphere(name, radius=radius, color=colour, position=position)

        def dragged(event: Any) -> None:
            self._pause()
            moved(np.array(event.end_position), event.phase == "end")

        self._stage.inbox.on(handle.on_drag("left"), dragged)
        return handle

    def _drag_tip(self, position: Array, _released: bool) -> None:
        self._stage.session.want_tip(position)

    def _drag_vertex(self, index: int, position: Array, released: bool) -> None:
        session = self._stage.session
        if not session.vertices_can_be_wanted:
            raise GoalError(f"the method {session.method} takes no goals of control vertices")
        session.want_vertex(index, None if released else position)
