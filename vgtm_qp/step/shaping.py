"""The curve of an arm on its way: goals of control vertices, and how many of them there are (section 4.7)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vgtm_qp.curve.curve import Curve
from vgtm_qp.curve.families import CurveFamily
from vgtm_qp.curve.redundancy import Refit, add_control_vertices, remove_control_vertices
from vgtm_qp.errors import GoalError
from vgtm_qp.step.build import reshaped
from vgtm_qp.step.curve import curve_key, with_curve
from vgtm_qp.step.goals import vector
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State, frozen
from vgtm_qp.step.target import base_frame

Array = NDArray[np.float64]


class Shaping:
    """Keeps what was built for each curve that an arm has had.

    Attributes
    ----------
    setup : Setup
        With the present curve.
    places : (V, 3) or None
        Where control vertices are drawn to, m; NaN for those that are not.
    """

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self.places = setup.vertex_goals
        self._built: dict[tuple[object, ...], Setup] = {}

    @property
    def goals(self) -> dict[int, Array]:
        """Where control vertices are drawn to, m, by their index."""
        drawn = self.setup.layout.vertex_goals
        return {i: np.array(self.places[i]) for i in drawn} if self.places is not None else {}

    def draw(self, goals: Mapping[int, ArrayLike]) -> None:
        """Draw control vertices to `goals`, m, and let all others go; see ``Resolver.control_vertex_goals``."""
        vertices = self.setup.layout.vertices
        places = np.full((vertices, 3), np.nan)
        for index, position in goals.items():
            if index not in range(vertices):
                last = f"0 to {vertices - 1}" if vertices else "none: there is no curve"
                raise GoalError(f"{index!r} is not a control vertex; they are {last}")
            places[index] = vector(position, f"the goal of control vertex {index}")
        drawn = tuple(sorted(int(index) for index in goals))
        if drawn != self.setup.layout.vertex_goals:
            self._reshape(self.setup.layout.family, drawn)
        self.places = places if drawn else None

    def change(self, state: State, more: int) -> Refit:
        """Give the curve of `state` so many control vertices more, or fewer, where it is; no goal is left.

        Raises
        ------
        GoalError, CurveError
            See ``Resolver.set_control_vertices``.
        """
        if self.setup.layout.shape is None:
            raise GoalError("this arm has no curve whose control vertices could change")
        self.draw({})
        change = self._changed(self._family, state, more)
        if more:
            self._reshape(change.curve.family, ())
        return change

    def with_vertices(self, state: State, family: CurveFamily, more: int) -> State:
        """Return a state whose curve of a `family` has so many control vertices more, or fewer."""
        change = self._changed(family, state, more)
        return replace(state, control_vertices=frozen(change.curve.control_vertices))

    @property
    def _family(self) -> CurveFamily:
        family = self.setup.layout.family
        assert family is not None
        return family

    def _changed(self, family: CurveFamily, state: State, more: int) -> Refit:
        frame = base_frame(self.setup.arm, self.setup.base_at(state.time))
        curve = Curve(family, state.control_vertices, state.torsion, frame)
        return add_control_vertices(curve, more) if more >= 0 else remove_control_vertices(curve, -more)

    def _reshape(self, family: CurveFamily | None, drawn: tuple[int, ...]) -> None:
        """Go on with another curve; what was built for one is kept for the next time."""
        self._built[curve_key(self.setup.layout)] = self.setup
        wanted = with_curve(self.setup.layout, family, drawn)
        key = curve_key(wanted)
        if key not in self._built:
            self._built[key] = reshaped(self.setup, wanted)
        self.setup = self._built[key]
