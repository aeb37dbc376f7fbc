"""Pairs below their clearance at home: they must not come nearer, and must keep clear once they are clear."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import ResultError
from vgtm_qp.verify.clearance import BETWEEN_TOLERANCE, CLEARANCE_TOLERANCE, Encounters, Least, Pairs


def excuse_recovering(
    record: Any, encounters: Iterable[tuple[Encounters, float]]
) -> tuple[list[str], list[str]]:
    """Return the faults of recovering pairs, one line each, and a note that sums them up.

    The `record` of the manifest has entries of ``pair``, as encounters name it, and ``distance`` at home, m.
    The `encounters` come with the clearances that their pairs have to keep, m; afterwards they ignore a
    recovering pair until it has reached its clearance. Until then its distance may not decrease from one
    state to the next. ResultError if the record is malformed.
    """
    try:
        wanted = {str(entry["pair"]): float(entry["distance"]) for entry in record}
    except (TypeError, KeyError, ValueError) as error:
        raise ResultError(f"manifest.recovered is malformed: {error}") from None
    wrong: list[str] = []
    until, found, note = 0, 0, ""
    for group, floor in encounters:
        for name in sorted(wanted):
            pairs = group.pairs_named(name)
            if not pairs:
                continue
            found += 1
            index = (np.array([pair[0] for pair in pairs]), np.array([pair[1] for pair in pairs]))
            # However deep an axis or a hull is inside, its distance here is minus the radius.
            deepest = float(group.deepest(index).min())
            states = np.repeat(np.arange(len(group.motion.time)), len(pairs))
            every = group.distances(
                states, (np.resize(index[0], len(states)), np.resize(index[1], len(states)))
            )
            distance = np.maximum(every.reshape(-1, len(pairs)).min(axis=1), deepest)
            kept = np.flatnonzero(distance >= floor - CLEARANCE_TOLERANCE)
            since = int(kept[0]) if len(kept) else len(distance)
            off = distance[0] - max(wanted[name], deepest)
            if since == 0 or abs(off) > CLEARANCE_TOLERANCE:
                wrong.append(
                    f"recovered: {name} is {distance[0]:.9g} m apart {_at_first(group)}, not {wanted[name]:.9g} m"
                )
                continue
            wrong += _nearer(group, index, name, distance[: since + 1], floor)
            group.held_from.update(dict.fromkeys(pairs, since))
            until = max(until, since)
            note = _note(wanted, group, until)
    if found < len(wanted):
        wrong.append("manifest.recovered names pairs that this arm and its obstacles do not have")
    return wrong, [note] if note else []


def _at_first(group: Encounters) -> str:
    """Say where a scene begins."""
    return "at home" if group.motion.first == 0 else f"at {group.motion.name(0)}"


def _note(distance: Mapping[str, float], group: Encounters, until: int) -> str:
    nearest, motion = min(distance, key=lambda name: distance[name]), group.motion
    is_over = until < len(motion.time)
    end = f"all keep their distances from {motion.name(until)} on" if is_over else "some still are at the end"
    return (
        f"recovered: pairs too near {_at_first(group)}: {len(distance)}, the nearest {distance[nearest]:.6g} m apart "
        f"({nearest}); they came no nearer, and {end}"
    )


def _nearer(group: Encounters, pairs: Pairs, name: str, distance: Array, floor: float) -> list[str]:
    """Return a line for each state up to the last of `distance` (K,) before which a pair comes nearer."""
    wrong = []
    for state in range(len(distance) - 1):
        least = min(float(distance[state]), floor)
        if distance[state + 1] < least - CLEARANCE_TOLERANCE:
            where = group.motion.name(state + 1)
            wrong.append(
                f"recovered: {name} is {distance[state + 1]:.9g} m apart at {where} after {least:.9g} m"
            )
        limit, bound = group.divide(np.full(len(pairs[0]), state), pairs, Least(), Least())
        least_between = max(min(limit.value, bound.value), float(group.deepest(pairs).min()))
        if least_between < least - BETWEEN_TOLERANCE * group.motion.arm.size:
            step = group.motion.first + state + 1
            wrong.append(
                f"recovered: {name} comes as near as {least_between:.9g} m in step {step} from {least:.9g} m"
            )
    return wrong
