"""Proof of clearance over a straight motion: bounds over it, then over halves of it for remaining pairs."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.geometry.groups import Group

_DEPTH = 12
_SAMPLES = np.linspace(0.0, 1.0, 33)[1:-1]


class SweepResult(NamedTuple):
    """Which pairs of a group were certified over a motion.

    Attributes
    ----------
    lowest : float
        Least lower bound of the pairs that were certified, or least distance found of the others, m.
    rows : (F,) int
        Rows of the group that were not certified.
    fraction : (F,)
        Place on the motion, 0 < s <= 1, of each such pair's least distance found.
    contacts : (F, 2 E + 5)
        Their contacts there.
    """

    lowest: float
    rows: Index
    fraction: Array
    contacts: Array


class _Sweep:
    """Some pairs over a motion, each in the frame of its obstacle, where the obstacle is at rest."""

    def __init__(
        self, group: Group, rows: Index, start: Array, end: Array, start_time: float, end_time: float
    ) -> None:
        self.group = group
        self._start = group.at(start, start_time, rows)
        self._change = group.at(end, start_time, rows) - self._start
        if group.moving:
            velocity = group.scene.pieces.velocity[group.other[rows]]
            shift = (end_time - start_time) * velocity
            self._change[:, : group.own] -= np.tile(shift, group.own // 3)

    def at(self, k: Index, fraction: Array) -> Array:
        """Return the pairs `k` at their `fraction` of the motion."""
        return np.asarray(self._start[k] + fraction[:, None] * self._change[k])

    def bounds(self, k: Index, left: Array, right: Array) -> Array:
        """Return ``sweep_function`` (len(k), 3) of the pairs `k` between the fractions `left` and `right`."""
        return self.group.sweep(self.at(k, left), self.at(k, right))

    def nearest(self, chosen: Index, worst: Array, fraction: Array) -> Array:
        """Return where the `chosen` pairs are nearest: at the known place, or at one of even samples."""
        pairs = self.at(np.repeat(chosen, len(_SAMPLES)), np.tile(_SAMPLES, len(chosen)))
        distance = self.group.evaluate(pairs)[:, 0, 0].reshape(len(chosen), -1)
        best = distance.argmin(axis=1)
        better = distance[np.arange(len(chosen)), best] < worst
        return np.asarray(np.maximum(np.where(better, _SAMPLES[best], fraction), _SAMPLES[0]))


def sweep_group(
    group: Group,
    rows: Index,
    start: Array,
    end: Array,
    start_time: float,
    end_time: float,
    floor: float | Array,
) -> SweepResult:
    """Return which of the pairs `rows` (R,) are proven to stay above `floor`, one or (R,), over the motion."""
    sweep = _Sweep(group, rows, start, end, start_time, end_time)
    count = len(rows)
    floor = np.broadcast_to(floor, count)
    # The motion of few pairs is cut at once, as finely as a call allows at no extra cost.
    pieces = max(group.at_once // count, 1)
    k = np.repeat(np.arange(count), pieces)
    cuts = np.arange(pieces + 1) / pieces
    left, right = np.tile(cuts[:-1], count), np.tile(cuts[1:], count)
    bounds = sweep.bounds(k, left, right)
    nothing = group.scene.nothing_found
    if (bounds[:, 0] >= floor[k]).all():
        return SweepResult(float(bounds[:, 0].min()), rows[:0], left[:0], nothing)
    failed = np.zeros(count, dtype=bool)
    worst, proven = np.full(count, np.inf), np.full(count, np.inf)
    fraction = np.full(count, 0.5)
    for depth in range(_DEPTH + 1):
        if depth:
            bounds = sweep.bounds(k, left, right)
        # A negated comparison is true for NaN.
        open_ = ~(bounds[:, 0] >= floor[k])
        np.minimum.at(proven, k[~open_], bounds[~open_, 0])
        for distance, where in ((bounds[:, 1], left), (bounds[:, 2], right)):
            np.minimum.at(worst, k, distance)
            here = distance == worst[k]
            fraction[k[here]] = where[here]
            failed[k[~(distance >= floor[k])]] = True
        if depth == _DEPTH:
            failed[k[open_]] = True
        split = open_ & ~failed[k]
        if not split.any():
            break
        middle = 0.5 * (left[split] + right[split])
        left, right = np.concatenate([left[split], middle]), np.concatenate([middle, right[split]])
        k = np.concatenate([k[split], k[split]])
    chosen = np.flatnonzero(failed)
    lowest = float(np.where(failed, worst, proven).min())
    if not len(chosen):
        return SweepResult(lowest, rows[:0], left[:0], nothing)
    fraction = sweep.nearest(chosen, worst[chosen], fraction[chosen])
    contacts = group.evaluate(sweep.at(chosen, fraction))[:, 0]
    return SweepResult(lowest, rows[chosen], fraction, contacts)
