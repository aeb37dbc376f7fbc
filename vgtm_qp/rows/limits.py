"""Stroke, rate and acceleration of each actuator as one box that is never empty, and the limits that set it."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array


def braking_speed(distance: Array, acceleration: Array, dt: float) -> Array:
    """Return the greatest speed of a step of `dt` after which further ones stop within `distance`, m/s.

    Let the speed fall at the `acceleration` a throughout. Then the mean speed v of the step is the speed in
    its middle, the speed at its end is v - a dt / 2, and the distance to rest from there is half the square
    of that over a. If this motion is divided into steps of any durations, their mean speeds change by a times
    the time between their middles, or by less in the last. So a speed that was allowed once can be braked
    within the limits, even if steps become longer or shorter.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        gap, lost = np.maximum(distance, 0.0), 0.5 * acceleration * dt
        speed = np.where(gap <= lost * dt, gap / dt, np.sqrt(2.0 * acceleration * gap) - lost)
    # A joint without limits has an infinite distance.
    return np.asarray(np.where(np.isfinite(acceleration) & np.isfinite(gap), speed, np.inf))


APPROACH = 0.3
"""Largest share of the distance to the end of its stroke that an actuator that slows down uses in one step."""

LEAST_APPROACH = 2e-3
"""Approach, of an actuator to that end or of a pair, that is always allowed in one step: rad, or over the arm's unit.
"""


def resting_box(count: int) -> ca.Function:
    """Return :func:`actuator_box` of actuators without limits of their acceleration, all (n_a,).

    Arguments: values, least and greatest ones of the strokes, greatest changes by the rate, and the approach to an end
    of the stroke that is always allowed: before that the actuators slow down; inf if they do not.
    """
    names = "value", "least", "greatest", "travel", "approach"
    value, least, greatest, travel, approach = arguments = [ca.MX.sym(name, count) for name in names]

    def change(left: ca.MX) -> ca.MX:
        left = ca.fmax(left, 0.0)
        return ca.fmin(ca.fmax(APPROACH * left, ca.fmin(left, approach)), travel)

    box = [value - change(value - least), value + change(greatest - value)]
    return ca.Function("resting_box", arguments, box, list(names), ["lower", "upper"])


def actuator_box(
    value: Array,
    speed: Array,
    stroke: Array,
    rate: Array,
    acceleration: Array,
    dt: float,
    last_dt: float | None = None,
) -> tuple[Array, Array]:
    """Return the least and greatest values (n_a,) after a step of `dt` from `value`: lengths, m, or joint values.

    The box is the intersection of three ranges: by the rate, by the acceleration, and by the speed from which
    the actuator still brakes before the end of its stroke. If they contradict one another, at a start outside
    a limit, the acceleration gives way first, then the rate. An actuator outside its stroke may only come
    back.

    Parameters
    ----------
    speed : (n_a,)
        Mean speed over the step before, per second.
    acceleration : (n_a,)
        Limits; inf without one.
    last_dt
        Duration of that step, s; `dt` by default. An acceleration is a change of mean speed over the time between
        the middles of two steps.
    """
    low, high = np.minimum(stroke[:, 0], value), np.maximum(stroke[:, 1], value)
    interval = dt if last_dt is None else 0.5 * (dt + last_dt)
    fastest = np.minimum(rate, braking_speed(high - value, acceleration, dt))
    slowest = -np.minimum(rate, braking_speed(value - low, acceleration, dt))
    with np.errstate(invalid="ignore"):
        least, greatest = speed - acceleration * interval, speed + acceleration * interval
    lower = np.maximum(low, value + np.clip(least, slowest, fastest) * dt)
    upper = np.minimum(high, value + np.clip(greatest, slowest, fastest) * dt)
    # If both bounds are the same value, rounding must not swap them.
    return lower, np.maximum(lower, upper)


_SAME = 1e-9
"""Bounds that differ by less are equal."""

LOCKED, STROKE, RATE, ACCELERATION = "locked", "stroke", "rate", "acceleration"


def binding(
    bound: Array, end: Array, fastest: Array, acceleration: Array, locked: NDArray[np.bool_]
) -> list[str]:
    """Return the limit that sets a side of each actuator's box: "locked", "stroke", "rate" or "acceleration".

    Parameters
    ----------
    bound, end, fastest : (n_a,)
        The side of the box, the end of the stroke there, and the value that the greatest rate reaches.
    acceleration : (n_a,)
        Limits; inf without one.
    locked : (n_a,) bool
        Actuators that are locked.
    """
    # Without a limited acceleration, only slowing before the end of the stroke gives a smaller bound.
    other = np.where(np.isinf(acceleration), STROKE, ACCELERATION)
    # Infinite bounds belong to no limit.
    with np.errstate(invalid="ignore"):
        kind = np.where(np.abs(bound - fastest) < _SAME, RATE, other)
        kind = np.where(np.abs(bound - end) < _SAME, STROKE, kind)
    return [str(name) for name in np.where(locked, LOCKED, kind)]
