"""Changes of an arm's curve during its motion: goals and number of control vertices (section 4.7)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.arrays import Array, record
from vgtm_qp.curve.curve import Curve
from vgtm_qp.curve.families import CurveFamily
from vgtm_qp.curve.redundancy import Refit, add_control_vertices, remove_control_vertices
from vgtm_qp.errors import GoalError
from vgtm_qp.qp.layout import Layout
from vgtm_qp.step.actuation import Bounds
from vgtm_qp.step.build import elastic_engine, make_engine
from vgtm_qp.step.path import Path
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State, frozen
from vgtm_qp.step.target import Target, base_frame
from vgtm_qp.step.task import vector


class Shaping:
    """Keeps the setup of each curve that an arm has had, and the goals of control vertices; makes targets of both.

    Attributes
    ----------
    setup : Setup
        With the present curve.
    """

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self._places = setup.vertex_goals
        self._built: dict[tuple[object, ...], Setup] = {}

    def target(self, state: State, dt: float, path: Path, start: float, end: float, box: Bounds) -> Target:
        """Return the target of a step of `dt`, s, from `state` over the values `start` to `end` of a path."""
        then, _ = state.after(dt)
        return record(
            Target,
            path=path,
            start=start,
            end=end,
            lower=box[0],
            upper=box[1],
            time=then,
            duration=dt,
            base=self.setup.base_at(then),
            vertex_goals=self._places,
        )

    @property
    def goals(self) -> dict[int, Array]:
        """Goals of control vertices, m, by index."""
        drawn = self.setup.layout.vertex_goals
        return {i: np.array(self._places[i]) for i in drawn} if self._places is not None else {}

    def draw(self, goals: Mapping[int, ArrayLike]) -> None:
        """Draw control vertices to `goals`, m, and no others; see ``Resolver.control_vertex_goals``."""
        layout = self.setup.layout
        places = np.full((layout.vertices, 3), np.nan)
        for index, position in goals.items():
            if index not in range(layout.vertices):
                last = f"0 to {layout.vertices - 1}" if layout.vertices else "none: there is no curve"
                raise GoalError(f"{index!r} is not a control vertex; they are {last}")
            places[index] = vector(position, f"the goal of control vertex {index}")
        drawn = tuple(sorted(int(index) for index in goals))
        if drawn != layout.vertex_goals:
            self._reshape(replace(layout, vertex_goals=drawn))
        self._places = places if drawn else None

    def change(self, state: State, more: int) -> Refit:
        """Add `more` control vertices to the curve of `state`, or remove them if negative; their goals end.

        Raises
        ------
        GoalError, CurveError
            See ``Resolver.set_control_vertices``.
        """
        shape, family = self.setup.layout.shape, self.setup.layout.family
        if shape is None or family is None:
            raise GoalError("this arm has no curve whose control vertices could change")
        self.draw({})
        change = self._changed(family, state, more)
        if more:
            family, s = change.curve.family, shape.parameters
            layout = replace(self.setup.layout, shape=replace(shape, family=family))
            self._reshape(replace(layout, curve_weights=family.weights(s), curve_slopes=family.weights(s, 1)))
        return change

    def with_vertices(self, state: State, family: CurveFamily, more: int) -> State:
        """Return `state` with `more` control vertices, or fewer if negative, on a curve of `family`."""
        change = self._changed(family, state, more)
        return replace(state, control_vertices=frozen(change.curve.control_vertices))

    def _changed(self, family: CurveFamily, state: State, more: int) -> Refit:
        frame = base_frame(self.setup.arm, self.setup.base_at(state.time))
        curve = Curve(family, state.control_vertices, state.torsion, frame)
        return add_control_vertices(curve, more) if more >= 0 else remove_control_vertices(curve, -more)

    def _reshape(self, layout: Layout) -> None:
        """Use another curve; the setup of each curve is kept for later use."""
        setup = self.setup
        self._built[_key(setup.layout)] = setup
        if _key(layout) not in self._built:
            engine = setup.engine.drawn(layout) if layout.family is setup.layout.family else None
            if engine is None:
                engine = make_engine(setup.solver, layout, setup.kinematics, setup.task, setup.tracking)
            elastic = setup.elastic
            if elastic is not None:
                elastic = elastic_engine(setup.solver, layout, setup.kinematics, setup.task)
            self._built[_key(layout)] = replace(setup, layout=layout, engine=engine, elastic=elastic)
        self.setup = self._built[_key(layout)]


def _key(layout: Layout) -> tuple[object, ...]:
    """Return what distinguishes the curves of one arm."""
    family, goals = layout.family, layout.vertex_goals
    if family is None:
        return goals
    return family.name, family.degree, family.control_vertices, tuple(family.knots.tolist()), goals
