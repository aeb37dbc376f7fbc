"""Limits, rates, accelerations and locks of a trajectory, whose values move linearly between its rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array
from vgtm_qp.certify.verdict import Finding
from vgtm_qp.verify.arm import AnyRecordedArm
from vgtm_qp.verify.check import INSTANT, LIMIT_TOLERANCE, MEMBER_TOLERANCE, changes, locks_of


def beyond_limits(
    arm: AnyRecordedArm, problem: Mapping[str, Any], time: Array, values: Array
) -> Iterator[Finding]:
    """Yield what is wrong with the values (T, M) of the arm's quantities at times (T,), s.

    Rates and accelerations are those of ``verify``: the mean over a step, and the change of the rate from
    step to step over the time between their middles. Rounding is allowed beyond both limits. A rate that ends
    because its actuator locks does not count as an acceleration.
    """
    names, free = arm.quantity_names, arm.actuated
    locks = [(names.index(name), since) for name, since in locks_of(problem) if name in names]
    yield from _out_of_range(arm, time, values)
    rates, accelerations, rounding, its_rounding = changes(time, values, float(np.abs(values).max()), locks)
    faster = free & (np.abs(rates) - rounding > arm.rate + LIMIT_TOLERANCE)
    for k, run in _runs(faster):
        worst = run[int(np.argmax(np.abs(rates[run, k])))]
        span, at = (time[run[0]], time[run[-1] + 1]), time[worst]
        yield _finding(span, "rate", names[k], abs(rates[worst, k]), arm.rate[k], at)
    faster = free & (np.abs(accelerations) - its_rounding > arm.acceleration + LIMIT_TOLERANCE)
    for k, run in _runs(faster):
        worst = run[int(np.argmax(np.abs(accelerations[run, k])))]
        span, found = (time[run[0]], time[run[-1] + 2]), abs(accelerations[worst, k])
        yield _finding(span, "acceleration", names[k], found, arm.acceleration[k], time[worst + 1])
    yield from _moved(arm, locks, time, values)


def _out_of_range(arm: AnyRecordedArm, time: Array, values: Array) -> Iterator[Finding]:
    for bound, side in ((arm.stroke[:, 0], -1.0), (arm.stroke[:, 1], 1.0)):
        excess = side * (values - bound)
        for k, run in _runs(arm.actuated & (excess > LIMIT_TOLERANCE)):
            worst = run[int(np.argmax(excess[run, k]))]
            span = _crossing(time, excess[:, k], run[0], -1), _crossing(time, excess[:, k], run[-1], 1)
            yield _finding(span, "limit", arm.quantity_names[k], values[worst, k], bound[k], time[worst])


def _crossing(time: Array, excess: Array, row: int, step: int) -> float:
    """Return the time, s, before or after a row at which its excess has come back to zero."""
    other = row + step
    if not 0 <= other < len(time):
        return float(time[row])
    share = excess[row] / (excess[row] - min(float(excess[other]), 0.0))
    return float(time[row] + share * (time[other] - time[row]))


def _moved(
    arm: AnyRecordedArm, locks: list[tuple[int, float]], time: Array, values: Array
) -> Iterator[Finding]:
    """Yield locked quantities that move, and those locked from the start that are not at home."""
    # Quantities without an actuator are locked from the start.
    kept = [(k, -np.inf, float(arm.home_quantities[k])) for k in np.flatnonzero(~arm.actuated).tolist()]
    kept += [(k, t, float(np.interp(t, time, values[:, k]))) for k, t in locks if arm.actuated[k]]
    for k, since, value in kept:
        moved = np.abs(values[:, k] - value) * (time >= since - INSTANT)
        for _, run in _runs((moved > MEMBER_TOLERANCE)[:, None]):
            worst = run[int(np.argmax(moved[run]))]
            span = _crossing(time, moved, run[0], -1), _crossing(time, moved, run[-1], 1)
            span = max(span[0], min(since, span[1])), span[1]
            yield _finding(span, "lock", arm.quantity_names[k], values[worst, k], value, time[worst])


def _runs(wrong: NDArray[np.bool_]) -> Iterator[tuple[int, NDArray[np.int64]]]:
    """Yield the columns of `wrong` (K, M), each with runs (R,) of successive rows in which it is True."""
    for k in np.flatnonzero(wrong.any(axis=0)).tolist():
        rows = np.flatnonzero(wrong[:, k])
        for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
            yield k, run


def _finding(
    span: tuple[float, float], kind: str, name: str, value: float, bound: float, at: float
) -> Finding:
    return Finding(float(span[0]), float(span[1]), kind, (name,), float(value), float(bound), float(at))
