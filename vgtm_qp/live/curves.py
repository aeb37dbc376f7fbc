"""Live curves of the step time and of the clearance."""

from __future__ import annotations

from collections import deque
from time import perf_counter
from typing import Any

import numpy as np

from vgtm_qp.live.session import Session

_LENGTH = 300
_HEIGHT = 112
_REST = 0.3
"""Time between two points, s, from which the arm rested meanwhile."""
_GREY = "#6b7280"


class Curves:
    """Two small diagrams over the seconds of the page: of the steps' computing times, and of the clearance.

    Where the installed viser draws no diagrams there are none.
    """

    def __init__(self, gui: Any) -> None:
        self._started = perf_counter()
        self._points: deque[tuple[float, float, float, float]] = deque(maxlen=_LENGTH)
        self._plots: list[Any] = []
        if hasattr(gui, "add_uplot"):
            self._plots = [
                _diagram(gui, "step [ms]", [("step", "#1f77b4")]),
                _diagram(gui, "clearance [mm]", [("clearance", "#0b7a5b"), ("safe", "#b91c1c")]),
            ]

    def clear(self) -> None:
        """Forget all points, for another session."""
        self._points.clear()

    def add(self, session: Session) -> None:
        """Add the present moment of a session, and draw."""
        now, clearance = perf_counter() - self._started, session.clearance
        has_obstacles = np.isfinite(clearance)
        shown = (
            1000.0 * session.step_time,
            1000.0 * clearance if has_obstacles else 0.0,
            1000.0 * session.safe if has_obstacles else 0.0,
        )
        if self._points and now - self._points[-1][0] > _REST:
            # Nothing happened since: the curve is level until now.
            self._points.append((now - _REST, *self._points[-1][1:]))
        self._points.append((now, *shown))
        if not self._plots:
            return
        time, step, clear, safe = np.array(self._points, dtype=float).T.copy()
        self._plots[0].data = (time, step)
        self._plots[1].data = (time, clear, safe)


def _diagram(gui: Any, title: str, curves: list[tuple[str, str]]) -> Any:
    """Add a diagram with `curves`, each a name and a colour."""
    nothing = np.zeros(1)
    axis = {"stroke": _GREY, "font": "10px sans-serif", "labelFont": "10px sans-serif"}
    return gui.add_uplot(
        data=tuple(nothing for _ in range(1 + len(curves))),
        series=(
            {"label": "time"},
            *(
                {"label": name, "stroke": colour, "width": 1.5, "points": {"show": False}}
                for name, colour in curves
            ),
        ),
        scales={"x": {"time": False}, "y": {"auto": True}},
        axes=(
            {**axis, "size": 26, "show": True},
            {**axis, "size": 42, "label": title, "labelSize": 16},
        ),
        legend={"show": False},
        height=_HEIGHT,
        padding=(8, 14, 0, 0),
    )
