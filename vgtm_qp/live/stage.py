"""What all parts of the page share: the server, the inbox, the session that is shown, and its picture."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from vgtm_qp.live.inbox import Inbox
from vgtm_qp.live.reading import Hold
from vgtm_qp.live.session import Session
from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.view.drawing import camera_for
from vgtm_qp.view.scene import ArmScene


class PageStage:
    """The session that is shown, and its picture.

    Attributes
    ----------
    server
        The viser server of the page.
    inbox : Inbox
    session : Session
    scene : ArmScene
    path : (K, 3)
        The path of the tip in the problem's maneuver, m.
    prepares : list of callable
        Called before the arm is drawn, by the parts that say how.
    draws : list of callable
        Called after the arm is drawn, by the parts that have something of their own in the scene.
    """

    def __init__(self, server: Any, session: Session) -> None:
        self.server, self.inbox, self.session = server, Inbox(), session
        self.draws: list[Callable[[], None]] = []
        self.prepares: list[Callable[[], None]] = []
        self.scene, self.path = self._picture()

    def open(self, session: Session) -> None:
        """Show another session in the place of the present one; the other parts put theirs into the scene again."""
        self.session = session
        self.server.scene.reset()
        self.scene, self.path = self._picture()

    def _picture(self) -> tuple[ArmScene, Any]:
        """Draw the arm, its surroundings and its path."""
        session = self.session
        scene = ArmScene(self.server, session.drawing, session.nodes, session.control_vertices)
        path = make_plan(session.problem, *session.pose()).path.positions
        scene.add_path("/path", path)
        self._shown = session.drawing.obstacles
        return scene, path

    def look(self, nodes: Any) -> None:
        """Let all pages look at the arm with its nodes (T, N, 3), m, and its path."""
        camera = camera_for(self.session.drawing, nodes, self.path)
        self.scene.look(camera)
        for client in self.server.get_clients().values():
            client.camera.position, client.camera.look_at = camera.position, camera.target
            client.camera.fov = camera.field_of_view

    def mark(self, hold: Hold | None) -> None:
        """Highlight the pair that holds the arm; None if nothing does."""
        if hold is None:
            self.scene.mark((), (), None, "")
        else:
            said = f"{hold.name}: {1000.0 * hold.distance:.0f} mm"
            self.scene.mark(hold.bodies, (hold.obstacle,), np.asarray(hold.line), said)

    def draw(self) -> None:
        """Draw arm, obstacles and all that moves with them where they are."""
        session = self.session
        if session.drawing.obstacles is not self._shown:
            self._shown = session.drawing.obstacles
            self.scene.put(self._shown, session.state.time)
        for prepare in self.prepares:
            prepare()
        state = session.state
        self.scene.move(session.nodes, session.control_vertices, state.time, q=state.q)
        for draw in self.draws:
            draw()
