"""A live page: play a maneuver back, drag the arm and the obstacles, send the tip somewhere, and see what holds it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from threading import Event
from time import perf_counter
from typing import Any

from vgtm_qp.arrays import Array
from vgtm_qp.live.curves import Curves
from vgtm_qp.live.forces import ForceTools
from vgtm_qp.live.handles import Handles
from vgtm_qp.live.journey import GoalTools
from vgtm_qp.live.looks import Looks
from vgtm_qp.live.obstacles import ObstacleTools
from vgtm_qp.live.player import Player
from vgtm_qp.live.readout import read_out
from vgtm_qp.live.session import Session
from vgtm_qp.live.settings import ProblemChoice, Settings
from vgtm_qp.live.stage import PageStage
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.problem import Problem
from vgtm_qp.result.manifest import stored_problem
from vgtm_qp.verify.arm import arm_of
from vgtm_qp.view.server import LOOPBACK, is_loopback, is_unspecified, viser_server

_LOG = logging.getLogger(__name__)

_PERIOD = 1.0 / 30.0
_READ_OUT_PERIOD = 0.1
_HINT = "Drag the red ball: the tip follows. Hold a green one: the curve is drawn there, the tip stays."


def view(
    shown: Problem | Maneuver,
    *,
    port: int = 8080,
    host: str = LOOPBACK,
    ready: Callable[[str], None] | None = None,
    stop: Event | None = None,
) -> None:
    """Serve the live page of a problem or a result until interrupted, by default to this machine alone.

    The page uses the first free port from `port` on, any port for 0. Whoever reaches a `host` other than the
    default can move the arm; a page of another origin cannot. `ready` is called with the page's address once
    it can be opened; `stop` ends the page when it is set. MissingExtraError if viser is not installed,
    GoalError if host or port cannot be used.
    """
    if not is_loopback(host):
        _LOG.warning(
            "the page is served at %s: whoever reaches this machine can move the arm, without a password",
            host,
        )
    maneuver = shown if isinstance(shown, Maneuver) else None
    if maneuver:
        # Refuse a maneuver that the page could not show before it is opened.
        arm_of(maneuver)
    problem = stored_problem(maneuver.manifest["problem"]) if maneuver else shown
    assert isinstance(problem, Problem)
    with viser_server(port, host) as server:
        page = Page(server, Session(problem), maneuver)
        if ready is not None:
            name = LOOPBACK if is_unspecified(host) else f"[{host}]" if ":" in host else host
            ready(f"http://{name}:{server.get_port()}")
        page.run(stop or Event())


class Page:
    """Widgets and loop. Callbacks only put actions into the inbox; the loop alone touches the session."""

    _player: Player
    _goal: GoalTools
    _looks: Looks
    _obstacles: ObstacleTools
    _forces: ForceTools
    _settings: Settings
    _curves: Curves
    _read_out: Any
    _told: Any = None
    """What the curves show of the last moment; a rest adds nothing to them."""

    def __init__(self, server: Any, session: Session, maneuver: Maneuver | None) -> None:
        self._stage = PageStage(server, session)
        self._inbox = self._stage.inbox
        self._add_widgets(bool(maneuver))
        self._handles = Handles(self._stage, self._player.pause)
        self._inbox.after_fault = self._player.pause
        self._stage.look(maneuver.nodes if maneuver else session.nodes[None])
        if maneuver:
            self._player.show(maneuver)

    @property
    def session(self) -> Session:
        """The session that is shown."""
        return self._stage.session

    @property
    def moment(self) -> float:
        """Time up to which a solved maneuver was played, s."""
        return self._player.moment

    @property
    def goal(self) -> Array:
        """(3,) where the goal was dropped, m."""
        return self._goal.goal

    @property
    def message(self) -> str:
        """The notice on the page; errors of its widgets are notices too."""
        return self._inbox.message

    def run(self, stop: Event) -> None:
        """Step, draw and wait for the rest of the frame, until `stop` is set."""
        read_at = 0.0
        survive = self._inbox.survive
        survive(self.draw)
        while not stop.is_set():
            started = perf_counter()
            changed = self.read_inbox()
            if self._player.is_playing:
                survive(lambda: self.play(_PERIOD))
            else:
                survive(partial(self._advance, changed))
            if started - read_at > _READ_OUT_PERIOD:
                survive(self._tell)
                read_at = started
            stop.wait(max(0.0, _PERIOD - (perf_counter() - started)))

    def _tell(self) -> None:
        """Show the instruments as they are now."""
        session, reading = self.session, self.session.reading()
        self._read_out.content = read_out(session, self.message, self._goal.said, reading)
        held = None if reading.hold is None else reading.hold.name
        now = (session.steps, len(session.obstacles), reading.clearance, session.safe, held)
        if now != self._told:
            self._told = now
            self._curves.add(session)
            self._stage.mark(reading.hold)
            self.draw()

    def _advance(self, changed: bool) -> None:
        """Step towards what is wanted, and draw the arm if it moved or something else `changed`."""
        moved = self.session.advance(_PERIOD)
        self._goal.watch()
        if moved or changed:
            self.draw()

    def post(self, action: Callable[[], None]) -> None:
        """Put an action into the inbox, for the loop to do."""
        self._inbox.post(action)

    def set(self, key: str, value: Any) -> None:
        """Put a change of a key of the problem into the inbox."""
        self._settings.set(key, value)

    def read_inbox(self) -> bool:
        """Do what was posted and set since the last call; return whether there was anything."""
        return self._inbox.read()

    def draw(self) -> None:
        """Draw arm, obstacles, tip target and control vertices where they are."""
        self._stage.draw()

    def solve(self) -> None:
        """Solve the session's problem from home, and play the maneuver."""
        self._player.solve()

    def play(self, duration: float) -> None:
        """Show the maneuver as it is `duration`, s, later; at its end playing stops."""
        self._player.play(duration)

    def load(self, problem: Problem) -> None:
        """Show another problem; VgtmError, and no change, if its arm cannot be built."""
        self._player.pause()
        self._inbox.message = "loading ..."
        self._tell()
        self._inbox.message = ""
        session = Session(problem)
        self._stage.open(session)
        self._player.clear()
        for part in (self._handles, self._obstacles, self._goal, self._looks):
            part.rebuild()
        self._settings.follow()
        self._curves.clear()
        self._stage.server.gui.set_panel_label(session.drawing.name or "vgtm")
        self._stage.look(session.nodes[None])
        self._told = None
        self.draw()

    def _add_widgets(self, has_maneuver: bool) -> None:
        gui, session = self._stage.server.gui, self.session
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.set_panel_label(session.drawing.name or "vgtm")
        self._read_out = gui.add_html(read_out(session, ""))
        self._curves = Curves(gui)
        self._looks = Looks(self._stage)
        tabs = gui.add_tab_group()
        names = ("Move", "Obstacles", "Forces", "Maneuver", "Method")
        # A result is there to be played first of all.
        order = sorted(names, key=lambda name: name != "Maneuver") if has_maneuver else names
        tab = {name: tabs.add_tab(name) for name in order}
        with tab["Maneuver"]:
            self._player = Player(self._stage, self._tell)
        with tab["Move"]:
            gui.add_markdown(_HINT)
            home = gui.add_button("Home")
            self._goal = GoalTools(self._stage, self._player.pause)
        with tab["Obstacles"]:
            self._obstacles = ObstacleTools(self._stage)
        with tab["Forces"]:
            self._forces = ForceTools(self._stage)
        with tab["Method"]:
            self._problems = ProblemChoice(self._stage, self.load)
            self._settings = Settings(self._stage)
        self._inbox.on(home.on_click, lambda _: self._go_home())

    def _go_home(self) -> None:
        self._player.pause()
        self.session.go_home()
        self._goal.journey = None
