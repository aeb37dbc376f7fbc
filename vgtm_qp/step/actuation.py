"""The actuators of an arm on its way: their boxes, what binds them, and those that jam."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Arm
from vgtm_qp.errors import GoalError, nearest
from vgtm_qp.rows.limits import actuator_box, binding
from vgtm_qp.step.state import State
from vgtm_qp.step.stops import Limits, StopKind

Array = NDArray[np.float64]
Box = tuple[Array, Array]
"""Least and greatest values (n_a,) of the actuators after a step."""

_APPROACH, _LEAST_APPROACH = 0.3, 2e-3
"""Largest share of the room to the end of its stroke that an actuator may use in one step, or this much, m."""

_INSTANT = 1e-9
"""Times that differ by less are the same, s."""


class Actuation:
    """Limits, locks and jams of the actuators of one arm; changed by :meth:`lock` alone.

    Parameters
    ----------
    arm : Arm
    jams
        Actuators that lock on the way, and when, s.
    slows_down
        Whether actuators slow down before the ends of their strokes.

    Attributes
    ----------
    names : tuple of str
        Length n_a.
    stroke, rate, acceleration : (n_a, 2), (n_a,), (n_a,)
    locked : set of str
        Names of those that are stuck by now.
    starts_at_once : bool
        Whether no acceleration is limited.
    """

    def __init__(self, arm: Arm, jams: Iterable[tuple[str, float]], *, slows_down: bool) -> None:
        self._arm, self._slows_down = arm, slows_down
        self._actuators = arm.actuators
        self.names = tuple(arm.quantity_names[k] for k in arm.actuators)
        self.stroke, self.rate = arm.stroke[arm.actuators], arm.rate[arm.actuators]
        self.acceleration = arm.acceleration[arm.actuators]
        self.starts_at_once = bool(np.isinf(self.acceleration).all())
        self.locked: set[str] = set()
        self._held = np.zeros(len(self.names), dtype=bool)
        self._jams = sorted(jams, key=lambda jam: -jam[1])

    def values(self, state: State) -> Array:
        """Return (n_a,) the actuators' values in a state."""
        return np.asarray(state.quantities[self._actuators])

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
        self.stroke[k] = state.quantities[self._actuators[k]]
        self._held[k] = True
        self.locked.add(name)

    def jammed(self, time: float) -> list[str]:
        """Return the names of the actuators that jam by `time`, s, each once."""
        found = []
        while self._jams and self._jams[-1][1] <= time + _INSTANT:
            found.append(self._jams.pop()[0])
        return found

    def until_jam(self, time: float, dt: float) -> float:
        """Return the share of a step of `dt` from `time`, s, that ends at the next jam, 1 where none is due."""
        left = self._jams[-1][1] - time if self._jams else np.inf
        return left / dt if left < dt - _INSTANT else 1.0

    def box(self, state: State, dt: float) -> Box:
        """Return the least and greatest values of the actuators after a step of `dt`, s, from `state`."""
        value, rate = state.quantities[self._actuators], state.rates[self._actuators]
        limits = self.stroke, self.rate, self.acceleration
        return actuator_box(value, rate, *limits, dt, state.duration or None)

    def slowing(self, state: State, box: Box) -> Box:
        """Return the part of a box within which actuators slow down before the ends of their strokes."""
        if not self._slows_down or not self.starts_at_once:
            return box
        value = self.values(state)
        lower, upper = box
        down, up = _approach(value - self.stroke[:, 0]), _approach(self.stroke[:, 1] - value)
        slow_lower, slow_upper = np.minimum(value - down, upper), np.maximum(value + up, lower)
        return np.maximum(lower, slow_lower), np.minimum(upper, slow_upper)

    def creeping(self, state: State, box: Box, dt: float) -> Box | None:
        """Return the part of a box after which every actuator may rest; None where there is none."""
        value, reach = self.values(state), (1.0 - 1e-9) * self.acceleration * dt * dt
        lower, upper = np.maximum(box[0], value - reach), np.minimum(box[1], value + reach)
        return (lower, upper) if np.all(lower <= upper) else None

    def limit_name(self, state: State, dt: float, box: Box) -> Callable[[int, bool], str]:
        """Return what names the limit at the lower (False) or upper side of an actuator's box, by its number."""
        stroke, held = self.stroke.copy(), self._held.copy()

        def name(k: int, upper: bool) -> str:
            side, one, way = int(upper), slice(k, k + 1), self.rate[k] * dt
            fastest = state.quantities[self._actuators[one]] + (way if upper else -way)
            kinds = binding(box[side][one], stroke[one, side], fastest, self.acceleration[one], held[one])
            return f"{kinds[0]}: {self.names[k]}"

        return name

    def limits(self, state: State, dt: float) -> Limits:
        """Return the boxes of a step of `dt`, s, from `state`, and what sets each of their sides."""
        box, value, way = self.box(state, dt), self.values(state), self.rate * dt
        rest = self.acceleration, self._held | (self.stroke[:, 0] == self.stroke[:, 1])
        low = binding(box[0], self.stroke[:, 0], value - way, *rest)
        high = binding(box[1], self.stroke[:, 1], value + way, *rest)
        return Limits(*box, self.names, [StopKind(kind) for kind in low], [StopKind(kind) for kind in high])


def _approach(room: Array) -> Array:
    """Return how far actuators that slow down move in one step with so much room (n_a,) before them."""
    room = np.maximum(room, 0.0)
    return np.asarray(np.maximum(_APPROACH * room, np.minimum(room, _LEAST_APPROACH)))
