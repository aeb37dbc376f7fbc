"""A state is held once more against what it must be, by other means than those that made it.

What settles a configuration also measures it. If that measure is wrong for any reason, the state is: so the
configuration is the only thing used of it here, and quantities and tip are found from that anew.
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
"""What was settled to a tolerance is refused from so many times that on.

Rounding never decides then, and what is published of a state still holds.
"""

_ROUNDING = 64.0 * float(np.finfo(float).eps)
"""Of the configuration's norm: quantities found in two ways differ by no more."""


class Acceptance:
    """Holds states of one arm, settled to an accuracy, against its quantities, limits and goals."""

    def __init__(self, setup: Setup, accuracy: Accuracy) -> None:
        self._arm, self._kinematics, self._task = setup.arm, setup.kinematics, setup.task
        base, self._actuators = np.flatnonzero(setup.arm.base), setup.arm.actuators
        # A slice costs less than a choice of rows, and base nodes come first as a rule.
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
        that of the tip, None for one that need not be anywhere. A tip with a direction overwrites the kinematics.
        """
        arm, q, base = self._arm, closed.q, target.base
        # NaN passes no comparison with `<=`, and is in every norm.
        size = norm(q.reshape(-1))
        curve = norm(vertices.reshape(-1)) + (norm(torsion) if len(torsion) else 0.0)
        if not size + curve < math.inf:
            return "the new state is not finite"
        rounding = _ROUNDING * size
        X, at = arm.nodes(q), arm.nodes(before if base is None else arm.based(q, base))
        # A base that rests is left alone by everything, so that it cannot drift either.
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
                return f"the new state has its tip {off:.3g} m or rad from its goal"
        return ""

    def _worst(self, errors: Array) -> str:
        """Return which quantity is furthest off, and how far; of NaN the first."""
        k = int(np.argmax(np.abs(errors)))
        return f"{self._arm.quantity_names[k]} {abs(errors[k]):.3g} m or rad"

    def _tip_error(self, q: Array, X: Array, goal: TipGoal) -> float:
        """Return the norm of the tip's error, m and rad."""
        if self._task.turns is not None:
            self._kinematics.evaluate_quantities(q)
        position = self._arm.end_effector.position(X)
        return norm(self._task.error(position, self._kinematics.tip_rotation, goal))


class TrackingError:
    """Measures how far stations that are to stay on the curve exactly are from it; for a layout with hard rows.

    A linear row leaves a gap, a step must not.
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
        """Return the greatest gap, m, or turn, rad, at a configuration and its curve (V, 3), m, and (T,), rad."""
        layout, arm, shape = self._layout, self._layout.arm, self._layout.general
        points, frames = layout.curve_weights @ vertices, None
        if shape is not None and (layout.hard_turns or shape.by_arc_length):
            rows = shape.rows(vertices, torsion, base_frame(arm, base))
            points, frames = rows.position, rows.frame
        worst = float(np.abs(arm.stations.centres(arm.nodes(q))[layout.tracked] - points).max())
        return max(worst, self._greatest_turn(q, vertices, frames)) if layout.hard_turns else worst

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
