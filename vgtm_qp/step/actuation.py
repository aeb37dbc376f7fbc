"""The actuators of an arm: their boxes, what limits them, and those that jam."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array
from vgtm_qp.compiled import Kernel
from vgtm_qp.errors import GoalError, nearest
from vgtm_qp.qp.settle import enough_length
from vgtm_qp.rows.limits import LEAST_APPROACH, actuator_box, binding, resting_box
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State

Bounds = tuple[Array, Array]
"""Least and greatest values (n_a,) of the actuators after a step."""

_SPARE_RATE = 1e-6
"""Greatest share of a rate that is kept in reserve for the errors of settling."""

_ROUNDING = float(np.finfo(float).eps)

INSTANT = 1e-9
"""Times that differ by less are the same, s."""


def within(box: Bounds, values: Array, trust: Array) -> Bounds:
    """Return the part of a box that is no further than `trust` from the values (n_a,), or else its nearest sides."""
    lower, upper = box
    return (
        np.minimum(np.maximum(lower, values - trust), upper),
        np.maximum(np.minimum(upper, values + trust), lower),
    )


class Limits(NamedTuple):
    """The box of the actuators after a step, and the limits that set its sides.

    Attributes
    ----------
    lower, upper : (n_a,)
        The box.
    names : tuple of str
        Of the actuators.
    value : (n_a,)
        Values before the step.
    travel : (n_a,)
        Greatest changes by the rate.
    stroke : (n_a, 2)
        Least and greatest values.
    acceleration : (n_a,)
        Greatest accelerations.
    held : (n_a,) bool
        Whether an actuator is locked.
    """

    lower: Array
    upper: Array
    names: tuple[str, ...]
    value: Array
    travel: Array
    stroke: Array
    acceleration: Array
    held: NDArray[np.bool_]

    def name(self, k: int, *, upper: bool) -> str:
        """Return the limit that sets one side of the box of actuator `k`, see ``rows.limits.binding``, and its name."""
        one, travel = slice(k, k + 1), self.travel if upper else -self.travel
        bound, fastest = (self.upper if upper else self.lower)[one], (self.value + travel)[one]
        end, rest = self.stroke[one, int(upper)], (self.acceleration[one], self.held[one])
        return f"{binding(bound, end, fastest, *rest)[0]}: {self.names[k]}"

    def of_stop(self) -> Limits:
        """Return these limits for the explanation of a stop: an actuator with a stroke of length zero is locked."""
        return self._replace(held=self.held | (self.stroke[:, 0] == self.stroke[:, 1]))


class Actuation:
    """Limits, locks and jams of the actuators of one arm; changed by :meth:`lock` and :meth:`jammed` alone.

    Attributes
    ----------
    names, locked
        Names of all actuators (n_a,), and of those locked so far.
    starts_at_once : bool
        Whether no acceleration is limited.
    tolerance : float
        Of the values to which quantities are settled, m or rad.
    """

    def __init__(self, setup: Setup) -> None:
        arm = setup.arm
        self._arm, self._actuators = arm, arm.actuators
        self.names = tuple(arm.quantity_names[k] for k in arm.actuators)
        self._resting = Kernel(resting_box(len(arm.actuators)), compiled=False)
        self._set_stroke(arm.stroke[arm.actuators])
        self._rate, self._acceleration = arm.rate[arm.actuators], arm.acceleration[arm.actuators]
        self.starts_at_once = bool(np.isinf(self._acceleration).all())
        # An error of a length, divided twice by the time, is an error of an acceleration: so it is kept near
        # rounding.
        exact = max(1e-12 * arm.fineness, 32.0 * _ROUNDING * arm.height)
        self.tolerance = 1e-10 * arm.fineness if self.starts_at_once else exact
        self._settled = enough_length(arm.home_configuration, self.tolerance)
        self._slows_down = setup.slows_down and self.starts_at_once
        self._least_approach = LEAST_APPROACH * arm.unit / arm.levers
        self._pace: tuple[float, Array, Array] = 0.0, self._rate, self._rate
        self.locked: set[str] = set()
        self._held = np.zeros(len(self.names), dtype=bool)
        self._jams = sorted(setup.jams, key=lambda jam: -jam[1])

    def values(self, state: State) -> Array:
        """Return (n_a,) the actuators' values in a state."""
        return state.quantities.take(self._actuators)

    def lock(self, name: str, state: State) -> None:
        """Hold an actuator at its value in `state` from now on.

        Raises
        ------
        GoalError
            No actuator has that name.
        """
        if name not in self.names:
            what = "is fixed" if name in self._arm.quantity_names else "there is not"
            names = ", ".join(self.names[:6]) + (", ..." if len(self.names) > 6 else "")
            hint = nearest(name, self.names)
            raise GoalError(f'cannot lock "{name}", which {what}; actuators are {names}{hint}')
        k = self.names.index(name)
        # New arrays: the limits of earlier steps keep theirs.
        stroke, self._held = self._stroke.copy(), self._held.copy()
        stroke[k] = self.values(state)[k]
        self._set_stroke(stroke)
        self._held[k] = True
        self.locked.add(name)

    def jammed(self, time: float) -> list[str]:
        """Return the names of the actuators that jam by `time`, s, each once."""
        found = []
        while self._jams and self._jams[-1][1] <= time + INSTANT:
            found.append(self._jams.pop()[0])
        return found

    def until_jam(self, time: float, dt: float) -> float:
        """Return the share of a step of `dt` from `time`, s, that ends at the next jam; 1 without a jam."""
        left = self._jams[-1][1] - time if self._jams else np.inf
        return left / dt if left < dt - INSTANT else 1.0

    def box(self, state: State, dt: float) -> Bounds:
        """Return the least and greatest values of the actuators after a step of `dt`, s, from `state`."""
        limits = self.limits(state, dt)
        return limits.lower, limits.upper

    def limits(self, state: State, dt: float, *, slowing: bool = False) -> Limits:
        """Return the box of a step of `dt`, s, from `state`, and the limits that set it.

        With `slowing`, actuators slow down before the ends of their strokes, if the problem asks for it.
        """
        value, stroke, (_, rate, travel) = self.values(state), self._stroke, self._paced(dt)
        if self.starts_at_once:
            approach = self._least_approach if slowing and self._slows_down else np.inf
            lower, upper = self._resting_box(value, travel, approach)
        else:
            limits = stroke, rate, self._acceleration, dt, state.duration or None
            lower, upper = actuator_box(value, state.rates.take(self._actuators), *limits)
        return Limits(lower, upper, self.names, value, travel, stroke, self._acceleration, self._held)

    def creeping(self, state: State, box: Bounds, dt: float) -> Bounds | None:
        """Return the part of a box from which every actuator can stop at once; None if there is none."""
        value, reach = self.values(state), (1.0 - 1e-9) * self._acceleration * dt * dt
        lower, upper = np.maximum(box[0], value - reach), np.minimum(box[1], value + reach)
        return (lower, upper) if np.all(lower <= upper) else None

    def _set_stroke(self, stroke: Array) -> None:
        self._stroke = stroke
        self._resting.inputs[1][:], self._resting.inputs[2][:] = stroke[:, 0], stroke[:, 1]

    def _resting_box(self, value: Array, travel: Array, approach: Array | float) -> Bounds:
        inputs = self._resting.inputs
        inputs[0][:], inputs[3][:], inputs[4][:] = value, travel, approach
        self._resting()
        lower, upper = self._resting.outputs
        return lower.copy(), upper.copy()

    def _paced(self, dt: float) -> tuple[float, Array, Array]:
        """Return `dt`, s, the greatest rates (n_a,) of such a step, less what settling may add, and their changes."""
        if dt != self._pace[0]:
            # The error that settling may leave, over the duration, is a rate. In a very short step less is left.
            spare = np.minimum(self.tolerance / dt, _SPARE_RATE * self._rate)
            rate = np.maximum(self._rate - np.maximum(spare, self._settled / dt), 0.0)
            self._pace = dt, rate, rate * dt
        return self._pace
