"""Acceptance of a new state: its constraints are checked again, by other code than the code that made it.

The engine that settles a configuration also measures it, and an error in that measure would go unnoticed. Here only
the configuration is used: quantities and tip are computed from it again.
"""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Kinematics, Pose
from vgtm_qp.arrays import Array
from vgtm_qp.compiled import Kernel
from vgtm_qp.qp.answer import Accuracy, Closed
from vgtm_qp.qp.graph import StationSymbols
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import beyond, norm
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.target import Target, base_frame

_LOOSER = 10.0
"""A state is refused from this many times the tolerance of settling on.

Rounding then never decides, and the published tolerances still hold.
"""

_ROUNDING = 64.0 * float(np.finfo(float).eps)
"""Greatest rounding difference between two computations of a quantity, relative to the configuration's norm."""


class Acceptance:
    """Checks states of one arm, settled to an accuracy, for their quantities, limits and goals."""

    def __init__(self, setup: Setup, accuracy: Accuracy) -> None:
        self._arm, self._kinematics, self._task = setup.arm, setup.kinematics, setup.task
        base, self._actuators = np.flatnonzero(setup.arm.base), setup.arm.actuators
        # Base nodes usually come first, and a slice is cheaper than an index array.
        is_first = np.array_equal(base, np.arange(len(base)))
        self._base: slice | NDArray[np.int64] = slice(len(base)) if is_first else base
        self._least, self._greatest = setup.arm.home_quantities.copy(), setup.arm.home_quantities.copy()
        self._member, self._tip = _LOOSER * accuracy.member, _LOOSER * accuracy.tip

    def flaw(
        self,
        closed: Closed,
        before: Array,
        target: Target,
        goal: TipGoal | None,
        vertices: Array,
        torsion: Array,
    ) -> str:
        """Return what is wrong with a configuration and its curve (V, 3), m, and (T,), rad, or an empty string.

        `before` is the configuration of the state before; the limits and the base are those of the `target`. `goal` is
        that of the tip, None for a free tip. A tip with a direction overwrites the kinematics.
        """
        arm, q, base = self._arm, closed.q, target.base
        # NaN fails every comparison with `<=`, and makes every norm NaN.
        size = norm(q.reshape(-1))
        curve = norm(vertices.reshape(-1)) + (norm(torsion) if len(torsion) else 0.0)
        if not size + curve < math.inf:
            return "the new state is not finite"
        rounding = _ROUNDING * size
        X, at = arm.nodes(q), arm.nodes(before if base is None else arm.based(q, base))
        # Nothing moves a base at rest, so that its nodes must be equal, without a tolerance.
        spare = 0.0 if base is None else self._member + rounding
        off = norm((X[self._base] - at[self._base]).reshape(-1))
        if not off <= spare:
            return f"the new state has its base {off:.3g} m from where it is"
        values, enough = arm.measured(q), self._member + rounding
        self._least[self._actuators], self._greatest[self._actuators] = target.lower, target.upper
        out = beyond(values, self._least, self._greatest)
        if not norm(out) <= enough:
            return f"the new state has {self._worst(out)} from the values it may have"
        wrong = values - closed.quantities
        if not norm(wrong) <= enough:
            return f"the new state has {self._worst(wrong)} from the value that it is said to have"
        if goal is not None:
            off = self._tip_error(q, X, goal)
            if not off <= self._tip + rounding:
                return f"the new state has its tip {off:.3g} m from its goal"
        return ""

    def _worst(self, errors: Array) -> str:
        """Return the name and error of the quantity with the greatest error, or of the first NaN."""
        k = int(np.argmax(np.abs(errors)))
        return f"{self._arm.quantity_names[k]} {abs(errors[k]):.3g} m or rad"

    def _tip_error(self, q: Array, X: Array, goal: TipGoal) -> float:
        """Return the norm of the tip's error, m: angles times the arm's unit."""
        if self._task.turns is not None:
            self._kinematics.evaluate_quantities(q)
        position = self._arm.end_effector.position(X)
        return self._task.off(position, self._kinematics.tip_rotation, goal)


class TrackingError:
    """Measures how far stations with hard tracking rows are from the curve.

    A linear row leaves a gap after the step; an accepted state must have none.
    """

    def __init__(self, layout: Layout, kinematics: Kinematics) -> None:
        self._layout, self._kinematics = layout, kinematics
        if not layout.hard_turns:
            return
        station, count = StationSymbols(layout), len(layout.tracked)
        _, rotation, _, _, *curve = station.inputs
        # The slope of a plain curve says its direction, the frame of any other one all.
        curve = curve[:3] if layout.general is None else [curve[2]]
        function = ca.Function("turns", [rotation, *curve], [ca.densify(station.turn)])
        self._turns = Kernel(function.map(count), compiled=False)
        if layout.general is None:
            self._turns.inputs[2][:] = layout.curve_weights.reshape(-1)
            self._turns.inputs[3][:] = layout.curve_slopes.reshape(-1)

    def greatest(self, q: Array, vertices: Array, torsion: Array, base: Pose | None) -> float:
        """Return the greatest gap, or turn times the arm's unit, m.

        It is that of a configuration and its curve: control vertices (V, 3), m, and torsion (T,), rad.
        """
        layout, arm, shape = self._layout, self._layout.arm, self._layout.general
        points, frames = layout.curve_weights @ vertices, None
        if shape is not None and (layout.hard_turns or shape.by_arc_length):
            rows = shape.at(vertices, torsion, base_frame(arm, base))
            points, frames = rows.position, rows.frame
        worst = float(np.abs(arm.stations.centres(arm.nodes(q))[layout.tracked] - points).max())
        return max(worst, arm.unit * self._greatest_turn(q, vertices, frames)) if layout.hard_turns else worst

    def _greatest_turn(self, q: Array, vertices: Array, frames: Array | None) -> float:
        tracked, inputs = self._layout.tracked, self._turns.inputs
        self._kinematics.evaluate(q)
        inputs[0][:] = self._kinematics.station_rotation[tracked].transpose(0, 2, 1).reshape(-1)
        if frames is None:
            inputs[1].reshape(len(tracked), -1)[:] = vertices.reshape(-1)
        else:
            inputs[1][:] = frames.reshape(-1)
        self._turns()
        return float(np.abs(self._turns.outputs[0]).max())
