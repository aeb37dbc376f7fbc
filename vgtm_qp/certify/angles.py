"""Least angles between bodies that share an end, at every instant."""

from __future__ import annotations

import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.certify.decide import Decision
from vgtm_qp.certify.motion import GivenMotion
from vgtm_qp.certify.verdict import Finding
from vgtm_qp.verify.path import DIRECTION_TOLERANCE, angles
from vgtm_qp.verify.scenes import joined_ends

_GREATEST_DEPTH = 24
_GREATEST_COUNT = 200_000


def keep_angles(motion: GivenMotion, least: float) -> Decision:
    """Return whether bodies that share an end keep an angle of `least`, rad.

    The direction of a vector turns no faster than its ends move, over its length. An angle that is a at one
    end of an interval and b at the other is therefore at least (a + b - t) / 2 between, where t is the sum of
    both turns.
    """
    decision, pairs = Decision(), joined_ends(motion.arm.members)
    names, floor = motion.arm.member_names, least - DIRECTION_TOLERANCE
    count = len(motion.time) - 1
    segment, corner = (grid.reshape(-1) for grid in np.indices((count, len(pairs))))
    start, width = np.zeros(len(segment)), 1.0
    worst: dict[int, tuple[float, float, float, float]] = {}
    for depth in range(_GREATEST_DEPTH):
        first, last = (_leaving(motion, segment, pairs[corner], start + share) for share in (0.0, width))
        found = [angles(edge[:, 0], edge[:, 1]) for edge in (first, last)]
        for share, values in zip((0.0, width), found, strict=True):
            near = np.flatnonzero(values < floor)
            times = motion.times_at(segment[near], start[near] + share)
            for k, value, time in zip(
                corner[near].tolist(), values[near].tolist(), times.tolist(), strict=True
            ):
                before = worst.get(k, (time, time, np.inf, time))
                at = time if value < before[2] else before[3]
                worst[k] = min(before[0], time), max(before[1], time), min(before[2], value), at
        proven = 0.5 * (found[0] + found[1] - _turned(motion, segment, pairs[corner], first, last, width))
        open_ = ~(proven >= floor) & ~np.isin(corner, list(worst))
        if not open_.any():
            break
        if depth == _GREATEST_DEPTH - 1 or 2 * open_.sum() > _GREATEST_COUNT:
            for k in np.unique(corner[open_]).tolist():
                own = np.flatnonzero(open_ & (corner == k))
                low, high = (motion.times_at(segment[own], start[own] + share) for share in (0.0, width))
                span, value = (float(low.min()), float(high.max())), float(proven[own].min())
                both = (names[pairs[k, 0] // 2], names[pairs[k, 1] // 2])
                decision.undecided.append(Finding(*span, "angle", both, max(value, 0.0), least))
            break
        width /= 2.0
        segment, corner = np.tile(segment[open_], 2), np.tile(corner[open_], 2)
        start = np.concatenate([start[open_], start[open_] + width])
    for k, (begin, end, value, at) in worst.items():
        both = names[pairs[k, 0] // 2], names[pairs[k, 1] // 2]
        decision.violations.append(Finding(begin, end, "angle", both, value, least, at))
    return decision


def _leaving(motion: GivenMotion, segment: Index, pair: Index, share: Array) -> Array:
    """Return (P, 2, 3) the vectors along both bodies of pairs of ends (P, 2), away from the shared end, m."""
    instants, which = np.unique(segment + share, return_inverse=True)
    number = np.minimum(instants.astype(np.int64), len(motion.time) - 2)
    ends = motion.ends_at(number, instants - number)
    along = np.stack([ends[which, pair[:, k] // 2] for k in (0, 1)], axis=1)
    away = np.where(pair % 2 == 0, 1.0, -1.0)[:, :, None]
    return np.asarray(away * (along[:, :, 1] - along[:, :, 0]))


def _turned(
    motion: GivenMotion, segment: Index, pair: Index, first: Array, last: Array, width: float
) -> Array:
    """Return (P,) bounds of the sum of both directions' turns, rad; infinite where a vector may vanish."""
    # Both ends of a body may leave their chords.
    bend = 2.0 * motion.bends[segment[:, None], pair // 2] * width**2
    path = np.linalg.norm(last - first, axis=2) + bend / 2.0
    short = np.minimum(np.linalg.norm(first, axis=2), np.linalg.norm(last, axis=2)) - path
    with np.errstate(divide="ignore"):
        turned = np.where(short > 0.0, path / np.maximum(short, 1e-300), np.inf)
    return np.asarray(turned.sum(axis=1))
