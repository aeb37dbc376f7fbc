"""Solving the problem on the page, and playing maneuvers back."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from vgtm_qp.live.stage import PageStage
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.maneuver.solve import solve
from vgtm_qp.view.drawing import resampled


class Player:
    """The widgets that solve and play, and the maneuver that is played.

    Attributes
    ----------
    moment : float
        Time up to which the maneuver was played, s.
    is_playing : bool
    """

    def __init__(self, stage: PageStage, tell: Callable[[], None]) -> None:
        self._stage, self._tell = stage, tell
        self._maneuver: Maneuver | None = None
        self.moment, self.is_playing = 0.0, False
        gui, inbox = stage.server.gui, stage.inbox
        self._button = gui.add_button("Play")
        self._slider = gui.add_slider(
            "time [s]", min=0.0, max=1.0, step=0.01, initial_value=0.0, disabled=True
        )
        again = gui.add_button("Solve and play", hint="from home, with the method and weights that are set")
        inbox.on(self._button.on_click, lambda _: self.toggle())
        inbox.on(self._slider.on_update, lambda _: self._scrub(), newest="time")
        inbox.on(again.on_click, lambda _: self.solve())

    def show(self, maneuver: Maneuver) -> None:
        """Make `maneuver` the one that is played back."""
        self._maneuver, self.moment = maneuver, 0.0
        self._slider.max, self._slider.disabled = max(float(maneuver.time[-1]), 0.01), False
        if len(maneuver.time) > 1:
            self._stage.scene.add_path("/tip path", maneuver.tip_position, thickness=0.02)

    def clear(self) -> None:
        """Forget the maneuver, for another session."""
        self.pause()
        self._maneuver, self.moment = None, 0.0
        self._slider.value, self._slider.disabled = 0.0, True

    def solve(self) -> None:
        """Solve the session's problem from home, and play the maneuver."""
        inbox = self._stage.inbox
        self.pause()
        inbox.message = "solving ..."
        self._tell()
        inbox.message = ""
        maneuver = solve(self._stage.session.problem)
        self.show(maneuver)
        self.toggle()
        if maneuver.status != "solved":
            inbox.message = (
                f"{maneuver.status} at {100 * maneuver.reached:.0f} % of the path: {maneuver.why_not}"
            )

    def toggle(self) -> None:
        """Play the maneuver, from its beginning if it is at its end, or pause."""
        if self.is_playing:
            self.pause()
        elif self._maneuver is not None:
            if self.moment >= self._maneuver.time[-1]:
                self.moment = 0.0
            self.is_playing, self._button.label = True, "Pause"
        else:
            self._stage.inbox.message = "nothing to play yet: press Solve and play"

    def pause(self) -> None:
        """Play no further."""
        self.is_playing, self._button.label = False, "Play"

    def play(self, duration: float) -> None:
        """Show the maneuver as it is `duration`, s, later; at its end playing stops."""
        self._put(self.moment + duration)
        self._slider.value = round(self.moment, 2)
        if self._maneuver is None or self.moment >= self._maneuver.time[-1]:
            self.pause()

    def _scrub(self) -> None:
        """Follow the hand on the slider."""
        self.pause()
        self._put(float(self._slider.value))

    def _put(self, moment: float) -> None:
        """Show the arm at `moment`, on the straight line between two states; it can be dragged from there."""
        maneuver = self._maneuver
        if maneuver is None:
            return
        self.moment = min(moment, float(maneuver.time[-1]))
        at = np.array([self.moment])
        q = resampled(maneuver.time, maneuver.configurations, at)[0]
        vertices = resampled(maneuver.time, maneuver.control_vertices, at)[0]
        self._stage.session.put_at(self.moment, q, vertices)
        self._stage.draw()
