"""A live page: play a maneuver back, drag tip or control vertices, and see what holds it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from html import escape
from queue import SimpleQueue
from threading import Event
from time import perf_counter
from typing import Any

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import VgtmError
from vgtm_qp.live.session import Reading, Session
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.maneuver.solve import solve
from vgtm_qp.methods import method_name, methods_for
from vgtm_qp.problem import Problem
from vgtm_qp.result.manifest import stored_problem
from vgtm_qp.verify.arm import arm_of
from vgtm_qp.view.drawing import CURVE_COLOUR, camera_for, resampled, stroke_colours
from vgtm_qp.view.scene import ArmScene
from vgtm_qp.view.server import LOOPBACK, is_loopback, is_unspecified, viser_server

_LOG = logging.getLogger(__name__)

_PERIOD = 1.0 / 30.0
_READ_OUT_PERIOD = 0.1
_LEAST_EXPONENT = -4.0
_HINT = "Drag the red ball: the tip follows. Hold a green one: the curve is drawn there, the tip stays."
_TARGET_COLOUR = (214, 39, 40)
_SLIDERS = (
    "node_rate",
    "actuator_rate",
    "stroke_centring",
    "curve_rate",
    "tracking",
    "tangent",
    "smoothness",
)
_COLOURS = {"at rest": "#6b7280", "moving": "#0b7a5b", "slowed": "#b45309", "blocked": "#b91c1c"}
_MOST_ACTIVE = 6


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
    """Widgets and loop. Callbacks only put actions into the inbox; the loop alone touches the session.

    Attributes
    ----------
    session : Session
    moment : float
        Time up to which a solved maneuver was played, s.
    message : str
        The last message of the page; errors of its widgets are messages too.
    """

    def __init__(self, server: Any, session: Session, maneuver: Maneuver | None) -> None:
        self._server, self.session, self._maneuver = server, session, maneuver
        self._inbox: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._settings: dict[str, Any] = {}
        self._playing, self.moment, self.message = False, 0.0, ""
        state = session.state
        self._scene = ArmScene(server, session.drawing, session.nodes, session.control_vertices)
        path = make_plan(session.problem, *session.pose()).path.positions
        self._scene.add_path("/path", path)
        nodes = maneuver.nodes if maneuver else session.nodes[None]
        self._scene.look(camera_for(session.drawing, nodes, path))
        self._target = self._add_handle(
            "/tip target", session.target, 0.085, _TARGET_COLOUR, lambda place, _: session.want_tip(place)
        )
        colour = tuple(round(255 * channel) for channel in CURVE_COLOUR)
        # The first vertex belongs to the base; the last one has the ball of the tip.
        inner = range(1, len(state.control_vertices) - 1) if session.vertices_can_be_wanted else ()
        self._vertices = {
            i: self._add_handle(
                f"/control vertex {i}", state.control_vertices[i], 0.06, colour, partial(self._drag_vertex, i)
            )
            for i in inner
        }
        self._add_widgets()
        if maneuver:
            self._show(maneuver)

    def run(self, stop: Event) -> None:
        """Step, draw and wait for the rest of the frame, until `stop` is set."""
        read_at = 0.0
        self.draw()
        while not stop.is_set():
            started = perf_counter()
            changed = self.read_inbox()
            if self._playing:
                self._survive(lambda: self.play(_PERIOD))
            else:
                self._survive(partial(self._advance, changed))
            if started - read_at > _READ_OUT_PERIOD:
                self._survive(self._tell)
                read_at = started
            stop.wait(max(0.0, _PERIOD - (perf_counter() - started)))

    def _tell(self) -> None:
        """Show the instruments as they are now."""
        self._read_out.content = read_out(self.session, self.message)

    def _advance(self, changed: bool) -> None:
        """Step towards what is wanted, and draw the arm if it moved or something else `changed`."""
        if self.session.advance(_PERIOD) or changed:
            self.draw()

    def post(self, action: Callable[[], None]) -> None:
        """Put an action into the inbox, for the loop to do."""
        self._inbox.put(action)

    def set(self, key: str, value: Any) -> None:
        """Put a change of a key of the problem into the inbox."""
        self._settings[key] = value

    def read_inbox(self) -> bool:
        """Do what was posted and set since the last call; return whether anything was posted."""
        found = not self._inbox.empty()
        while not self._inbox.empty():
            self._survive(self._inbox.get())
        if self._settings:
            settings, self._settings = self._settings, {}
            self._try(lambda: self.session.change(settings))
        return found

    def _try(self, action: Callable[[], None]) -> None:
        self.message = ""
        self._survive(action)

    def _survive(self, action: Callable[[], None]) -> None:
        """Run the action of a widget; any error is shown, and the page goes on."""
        try:
            action()
        except VgtmError as error:
            self.message = str(error)
        except Exception as error:
            said = f"internal error, {type(error).__name__}: {error}; this is a bug in vgtm, please report it"
            if said != self.message:
                # The traceback is told once, not thirty times a second.
                _LOG.exception(said)
            self._pause()
            self.message = said

    def draw(self) -> None:
        """Draw arm, tip target and control vertices where they are."""
        session = self.session
        self._scene.move(session.nodes, session.control_vertices, session.state.time)
        self._target.position = session.target
        for i, handle in self._vertices.items():
            handle.position = session.vertex_goals.get(i, session.control_vertices[i])

    def _add_handle(self, name: str, position: Array, radius: float, colour: Any, moved: Any) -> Any:
        """Draw a ball; `moved` is called with the place it is dragged to, and whether it was released."""
        handle = self._server.scene.add_icosphere(name, radius=radius, color=colour, position=position)

        def dragged(event: Any) -> None:
            self._pause()
            moved(np.array(event.end_position), event.phase == "end")

        self._on(handle.on_drag("left"), dragged)
        return handle

    def _drag_vertex(self, index: int, position: Array, released: bool) -> None:
        if self.session.vertices_can_be_wanted:
            self.session.want_vertex(index, None if released else position)
        else:
            method = method_name(self.session.problem)
            self.message = f"the method {method} takes no goals of control vertices"

    def _add_widgets(self) -> None:
        gui, session = self._server.gui, self.session
        gui.configure_theme(control_width="large", show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.set_panel_label(session.drawing.name or "vgtm")
        self._read_out = gui.add_html(read_out(session, ""))
        with gui.add_folder("Maneuver"):
            self._play_button = gui.add_button("Play")
            self._slider = gui.add_slider(
                "time [s]", min=0.0, max=1.0, step=0.01, initial_value=0.0, disabled=True
            )
            again = gui.add_button("Solve and play", hint="from home, with the method and weights set below")
        with gui.add_folder("By hand"):
            gui.add_markdown(_HINT)
            home = gui.add_button("Home")
            shown = method_name(session.problem)
            method = gui.add_dropdown("method", tuple(methods_for(session.problem)), initial_value=shown)
            least = min(0.3, session.problem.clearance.safe)
            safe = gui.add_slider("safe [m]", min=0.0, max=0.3, step=0.005, initial_value=least)
        with gui.add_folder("Weights, powers of ten", expand_by_default=False):
            for name in _SLIDERS:
                self._add_weight(name)
        self._on(self._play_button.on_click, lambda _: self._toggle())
        self._on(self._slider.on_update, self._scrub)
        self._on(again.on_click, lambda _: self.solve())
        self._on(home.on_click, lambda _: self._go_home())
        self._on(method.on_update, lambda _: self._try(lambda: session.use_method(method.value)))
        self._set_by(safe, "clearance.safe", float)

    def _add_weight(self, name: str) -> None:
        weights = self.session.problem.method.weights
        exponent = max(_LEAST_EXPONENT, np.log10(max(float(getattr(weights, name)), 1e-12)))
        slider = self._server.gui.add_slider(
            name.replace("_", " "),
            min=_LEAST_EXPONENT,
            max=2.0,
            step=0.1,
            initial_value=round(exponent, 1),
            hint=f"{type(weights).model_fields[name].description}; the least value switches it off",
        )
        self._set_by(slider, f"method.weights.{name}", lambda x: 10.0**x if x > _LEAST_EXPONENT else 0.0)

    def _set_by(self, widget: Any, key: str, meaning: Callable[[Any], Any]) -> None:
        """Set a key of the problem to the `meaning` of a widget's value."""
        self._on(widget.on_update, lambda _: self.set(key, meaning(widget.value)))

    def _on(self, register: Any, act: Callable[[Any], Any]) -> None:
        """Let `act` run in the loop whenever the event comes."""

        async def callback(event: Any) -> None:
            self.post(lambda: act(event))

        register(callback)

    def _show(self, maneuver: Maneuver) -> None:
        """Make `maneuver` the one that is played back."""
        self._maneuver, self.moment = maneuver, 0.0
        self._slider.max, self._slider.disabled = max(float(maneuver.time[-1]), 0.01), False
        if len(maneuver.time) > 1:
            self._scene.add_path("/tip path", maneuver.tip_position, thickness=0.02)

    def solve(self) -> None:
        """Solve the session's problem from home, and play the maneuver."""
        self._pause()
        self.message = "solving ..."
        self._tell()

        def run() -> None:
            maneuver = solve(self.session.problem)
            self._show(maneuver)
            self._toggle()
            if maneuver.status != "solved":
                self.message = (
                    f"{maneuver.status} at {100 * maneuver.reached:.0f} % of the path: {maneuver.why_not}"
                )

        self._try(run)

    def _toggle(self) -> None:
        if self._playing:
            self._pause()
        elif self._maneuver is not None:
            if self.moment >= self._maneuver.time[-1]:
                self.moment = 0.0
            self._playing, self._play_button.label = True, "Pause"
        else:
            self.message = "nothing to play yet: press Solve and play"

    def _go_home(self) -> None:
        self._pause()
        self.session.go_home()

    def _pause(self) -> None:
        self._playing, self._play_button.label = False, "Play"

    def play(self, duration: float) -> None:
        """Show the maneuver as it is `duration`, s, later; at its end playing stops."""
        self._put(self.moment + duration)
        self._slider.value = round(self.moment, 2)
        if self._maneuver is None or self.moment >= self._maneuver.time[-1]:
            self._pause()

    def _scrub(self, event: Any) -> None:
        """Follow the mouse on the slider; a value set by the page itself has no client."""
        if event.client is not None:
            self._pause()
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
        self.session.put_at(self.moment, q, vertices)
        self.draw()


def read_out(session: Session, message: str) -> str:
    """Return the instruments of `session` as HTML, under `message` where there is one."""
    reading = session.reading()
    safe = session.problem.clearance.safe
    step_time = f"{1000 * reading.step_time:.2f} ms" if reading.step_time else "-"
    rows = [
        ("clearance", _distance(reading.clearance, safe), reading.nearest),
        (f"{session.drawing.arm.body}s apart", _distance(reading.self_clearance, -np.inf), ""),
        ("off the curve", _distance(reading.gap, -np.inf), _why_off(reading)),
        ("tip to target", f"{1000 * float(np.linalg.norm(session.target - session.tip)):.1f} mm", ""),
        ("step", step_time, method_name(session.problem)),
    ]
    cells = "".join(
        f"<tr><td style='color:#6b7280;padding-right:0.8em'>{name}</td>"
        f"<td style='text-align:right;white-space:nowrap'><b>{value}</b></td>"
        f"<td style='color:#6b7280;padding-left:0.8em'>{escape(more)}</td></tr>"
        for name, value, more in rows
    )
    stopped = ", ".join(reading.stopped_by[:3]) if reading.outcome in ("slowed", "blocked") else ""
    outcome = f"<b style='color:{_COLOURS[reading.outcome]}'>{reading.outcome}</b>"
    if stopped:
        outcome += f" <span id='stopped-by'>by {escape(stopped)}</span>"
    active = "".join(f"<li>{escape(name)}</li>" for name in reading.active[:_MOST_ACTIVE]) or "<li>none</li>"
    if len(reading.active) > _MOST_ACTIVE:
        active += f"<li>and {len(reading.active) - _MOST_ACTIVE} more</li>"
    notice = f"<div style='color:#b91c1c'>{escape(message)}</div>" if message else ""
    return (
        "<div style='font-size:0.8rem;line-height:1.35;padding:0.2em 0.8em'>"
        f"{notice}<div style='min-height:2.7em'>{outcome}</div><table>{cells}</table>"
        f"<div style='color:#6b7280;margin-top:0.4em'>strokes, least to greatest</div>{_strokes(session)}"
        f"<div style='color:#6b7280;margin-top:0.4em'>active constraints</div>"
        f"<ul style='margin:0;padding-left:1.2em;min-height:5.4em'>{active}</ul></div>"
    )


def _why_off(reading: Reading) -> str:
    """Return the page's text on stations that left the curve although tracking is exact."""
    return "the curve gave way" if reading.gave_way else ""


def _distance(distance: float, least: float) -> str:
    if not np.isfinite(distance):
        return "-"
    colour = "#b91c1c" if distance < least - 1e-6 else "inherit"
    return f"<span style='color:{colour}'>{1000 * distance:.1f} mm</span>"


def _strokes(session: Session) -> str:
    """Return a bar for each actuator: how much of its stroke is out."""
    share = session.drawing.stroke_share(session.state.quantities)
    colours = np.round(255 * stroke_colours(np.nan_to_num(share))).astype(int)
    bars = "".join(
        f"<div title='{escape(name)}' style='flex:1;height:{max(2.0, 100.0 * part):.1f}%;"
        f"background:rgb({red},{green},{blue})'></div>"
        for name, part, (red, green, blue) in zip(
            session.drawing.arm.quantity_names, share.tolist(), colours.tolist(), strict=True
        )
        if not np.isnan(part)
    )
    return (
        "<div style='display:flex;align-items:flex-end;gap:1px;height:2.6em;"
        f"border-top:1px dashed #9ca3af;border-bottom:1px solid #9ca3af'>{bars}</div>"
    )
