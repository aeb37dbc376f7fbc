"""Proof of clearance over a straight motion: swept bounds, then halves of the time for the pairs that are left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.geometry.groups import Group

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_DEPTH = 12
_PIECES = 16
_SAMPLES = np.linspace(0.0, 1.0, 33)[1:-1]


@dataclass(frozen=True, eq=False)
class SweepResult:
    """Which pairs of a group were certified over a motion.

    Attributes
    ----------
    proven : float
        Least lower bound of the pairs that were certified, m.
    rows : (F,) int
        Rows of the group that were not certified.
    fraction : (F,)
        Where on the motion each of those was found nearest, 0 < s <= 1.
    worst : float
        Least distance found of the pairs that were not certified, m.
    """

    proven: float
    rows: Index
    fraction: Array
    worst: float = np.inf

    def placed(
        self, group: Group, start: Array, end: Array, start_time: float, end_time: float
    ) -> tuple[Array, Array]:
        """Return segments and parameters of the failing pairs at their fractions, in the base frame."""
        motion = _RelativeMotion(group, self.rows, start, end, start_time, end_time)
        segments, others = motion.at(np.arange(len(self.rows)), self.fraction)
        if group.is_self:
            return segments, others
        shift = group.obstacle_displacement(end_time - start_time, self.rows) * self.fraction[:, None]
        corners = _corners(group.shape)
        others = others.copy()
        others[:, : 3 * corners] += np.tile(shift, corners)
        return segments + np.tile(shift, 2), others


def _corners(shape: str) -> int:
    return 3 if shape == "triangle" else 1


class _RelativeMotion:
    """The segments of some pairs over a motion, in the frame of the obstacle, which rests there."""

    def __init__(
        self, group: Group, rows: Index, start: Array, end: Array, start_time: float, end_time: float
    ) -> None:
        self._is_self = group.is_self
        self.segments = group.segments(start, rows)
        self.change = group.segments(end, rows) - self.segments
        self.others = group.others(start, start_time, rows)
        if group.is_self:
            self.other_change = group.others(end, end_time, rows) - self.others
        elif group.moving:
            self.change -= np.tile(group.obstacle_displacement(end_time - start_time, rows), 2)

    def at(self, k: Index, fraction: Array) -> tuple[Array, Array]:
        """Return segments and parameters of the pairs `k` at their `fraction`."""
        s = fraction[:, None]
        others = self.others[k]
        if self._is_self:
            others = others + s * self.other_change[k]
        return self.segments[k] + s * self.change[k], others


def sweep_group(
    group: Group, rows: Index, start: Array, end: Array, start_time: float, end_time: float, floor: float
) -> SweepResult:
    """Return which of the pairs `rows` stay above `floor` over the motion, provably."""
    motion = _RelativeMotion(group, rows, start, end, start_time, end_time)
    count = len(rows)
    # The motion of few pairs is cut at once, as finely as a call costs no more: one call instead of several.
    pieces = max(_PIECES // count, 1)
    k = np.repeat(np.arange(count), pieces)
    cuts = np.arange(pieces + 1) / pieces
    left, right = np.tile(cuts[:-1], count), np.tile(cuts[1:], count)
    answer = _swept(group, motion, rows, k, left, right)
    if (answer[:, 0] >= floor).all():
        return SweepResult(float(answer[:, 0].min()), rows[:0], left[:0])
    failed = np.zeros(count, dtype=bool)
    worst, proven = np.full(count, np.inf), np.full(count, np.inf)
    fraction = np.full(count, 0.5)
    for depth in range(_DEPTH + 1):
        if depth:
            answer = _swept(group, motion, rows, k, left, right)
        # A negated comparison is true for NaN.
        open_ = ~(answer[:, 0] >= floor)
        np.minimum.at(proven, k[~open_], answer[~open_, 0])
        for distance, where in ((answer[:, 1], left), (answer[:, 2], right)):
            np.minimum.at(worst, k, distance)
            here = distance == worst[k]
            fraction[k[here]] = where[here]
            failed[k[~(distance >= floor)]] = True
        if depth == _DEPTH:
            failed[k[open_]] = True
        split = open_ & ~failed[k]
        if not split.any():
            break
        middle = 0.5 * (left[split] + right[split])
        left, right = np.concatenate([left[split], middle]), np.concatenate([middle, right[split]])
        k = np.concatenate([k[split], k[split]])
    chosen = np.flatnonzero(failed)
    kept = float(proven[~failed].min(initial=np.inf))
    if len(chosen):
        fraction[chosen] = _nearest_fraction(group, motion, rows, chosen, worst[chosen], fraction[chosen])
    return SweepResult(kept, rows[chosen], fraction[chosen], float(worst[chosen].min(initial=np.inf)))


def _swept(group: Group, motion: _RelativeMotion, rows: Index, k: Index, left: Array, right: Array) -> Array:
    """Return the sweep of the pairs `k` between the fractions `left` and `right` of the motion, (len(k), 3)."""
    a, other_a = motion.at(k, left)
    b, other_b = motion.at(k, right)
    return group.sweep(a, b, other_a, other_b, rows[k])


def _nearest_fraction(
    group: Group, motion: _RelativeMotion, rows: Index, chosen: Index, worst: Array, fraction: Array
) -> Array:
    """Return where the `chosen` pairs are nearest: the better of the point known and of even samples."""
    k = np.repeat(chosen, len(_SAMPLES))
    segments, others = motion.at(k, np.tile(_SAMPLES, len(chosen)))
    distance = group.distances_of(segments, others, rows[k]).distance.reshape(len(chosen), -1)
    best = distance.argmin(axis=1)
    better = distance[np.arange(len(chosen)), best] < worst
    return np.asarray(np.maximum(np.where(better, _SAMPLES[best], fraction), _SAMPLES[0]))
