"""Problem, method, least clearance and weights on the page."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from vgtm_qp.live.stage import PageStage
from vgtm_qp.methods import method_name, methods_for
from vgtm_qp.problem import Problem, bundled_problems, load_problem

_LEAST_EXPONENT = -4.0
_MOST_SAFE = 0.3
_SLIDERS = (
    "node_rate",
    "actuator_rate",
    "stroke_centring",
    "curve_rate",
    "tracking",
    "tangent",
    "smoothness",
)


class ProblemChoice:
    """The drop-down of problems: the one that the page was opened with, and those of the package."""

    def __init__(self, stage: PageStage, load: Callable[[Problem], None]) -> None:
        self._given, self._load = stage.session.problem, load
        source, bundled = self._given.source, bundled_problems()
        name = source.stem if source is not None else self._given.name or "as given"
        is_bundled = name in bundled and source is not None and source.resolve() == bundled[name].resolve()
        self._own = name if is_bundled or name not in bundled else f"{name} (as given)"
        options = (self._own, *(other for other in bundled if other != self._own))
        self.list = stage.server.gui.add_dropdown("problem", options, initial_value=self._own)
        stage.inbox.on(self.list.on_update, lambda _: self._choose(self.list.value))

    def _choose(self, name: str) -> None:
        self._load(self._given if name == self._own else load_problem(name))


class Settings:
    """Method, least clearance and weights of the session that is shown."""

    def __init__(self, stage: PageStage) -> None:
        self._stage = stage
        self._changes: dict[str, Any] = {}
        gui, inbox, problem = stage.server.gui, stage.inbox, stage.session.problem
        self._method = gui.add_dropdown(
            "method", tuple(methods_for(problem)), initial_value=method_name(problem)
        )
        self._safe = gui.add_slider(
            "safe [m]",
            min=0.0,
            max=_MOST_SAFE,
            step=0.005,
            initial_value=min(_MOST_SAFE, problem.clearance.safe),
            hint="least distance from an obstacle",
        )
        inbox.on(self._method.on_update, lambda _: self._use_method())
        self._set_by(self._safe, "clearance.safe", float)
        with gui.add_folder("Weights, powers of ten", expand_by_default=False):
            self._weights = {name: self._add_weight(name) for name in _SLIDERS}

    def _use_method(self) -> None:
        stage = self._stage
        try:
            stage.session.use_method(self._method.value)
        finally:
            self.follow()

    def follow(self) -> None:
        """Show the values of the session's problem."""
        problem = self._stage.session.problem
        options = tuple(methods_for(problem))
        if tuple(self._method.options) != options:
            self._method.options = options
        name = method_name(problem)
        if name in options:
            self._method.value = name
        self._safe.max = min(_MOST_SAFE, 0.9 * problem.clearance.influence)
        self._safe.value = min(self._safe.max, problem.clearance.safe)
        for name, slider in self._weights.items():
            slider.value = _exponent(problem, name)

    def set(self, key: str, value: Any) -> None:
        """Put a change of a key of the problem into the inbox; changes that come together are made at once."""
        self._changes[key] = value
        self._stage.inbox.post_newest("settings", self._apply)

    def _apply(self) -> None:
        changes, self._changes = self._changes, {}
        self._stage.inbox.message = ""
        if changes:
            self._stage.session.change(changes)

    def _add_weight(self, name: str) -> Any:
        weights = self._stage.session.problem.method.weights
        slider = self._stage.server.gui.add_slider(
            name.replace("_", " "),
            min=_LEAST_EXPONENT,
            max=2.0,
            step=0.1,
            initial_value=_exponent(self._stage.session.problem, name),
            hint=f"{type(weights).model_fields[name].description}; the least value switches it off",
        )
        self._set_by(slider, f"method.weights.{name}", lambda x: 10.0**x if x > _LEAST_EXPONENT else 0.0)
        return slider

    def _set_by(self, widget: Any, key: str, meaning: Callable[[Any], Any]) -> None:
        """Set a key of the problem to the `meaning` of a widget's value."""
        self._stage.inbox.on(widget.on_update, lambda _: self.set(key, meaning(widget.value)))


def _exponent(problem: Problem, name: str) -> float:
    """Return the power of ten of a weight, within the range of its slider."""
    weight = float(getattr(problem.method.weights, name))
    return round(float(np.clip(np.log10(max(weight, 1e-12)), _LEAST_EXPONENT, 2.0)), 1)
