"""Lengths, limits, clearances and tip errors of a maneuver, from its nodes alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.result.certificate import Certificate, Measure
from vgtm_qp.result.poses import arm_table, base_poses, rotations
from vgtm_qp.result.result import Result
from vgtm_qp.verify.arm import AnyRecordedArm, arm_of
from vgtm_qp.verify.clearance import RecordedMotion
from vgtm_qp.verify.curve import curve_contradictions, curve_measures
from vgtm_qp.verify.held import held_against
from vgtm_qp.verify.path import (
    DIRECTION_TOLERANCE,
    TIP_TOLERANCE,
    check_path,
    direction_error,
    tip_error,
)
from vgtm_qp.verify.scenes import clearances_of

if TYPE_CHECKING:
    from vgtm_qp.problem import Problem

MEMBER_TOLERANCE = 1e-9
"""Tolerance of fixed and locked members and of base nodes, m."""
LIMIT_TOLERANCE = 1e-9
"""Tolerance of strokes, rates and accelerations, m, m/s, m/s^2."""
ARRAY_TOLERANCE = 1e-9
"""Tolerance of stored arrays against recomputed ones, m."""

INSTANT = 1e-9
"""Times that differ by less are the same, s."""
_ROUNDING = 4.0 * float(np.finfo(float).eps)
"""Relative rounding of a length and of the duration between two times of a large clock."""
_MANY_UNKNOWNS = 2000
_FEW_STATES = 21


def verify_file(path: str | Path, *, problem: Problem | None = None) -> Certificate:
    """Load a result file and verify it; ResultError if it cannot be loaded or its arm record is malformed."""
    return verify(Result.load(path), problem=problem)


def verify(maneuver: Result, *, problem: Problem | None = None) -> Certificate:
    """Return the certificate of `maneuver`, recomputed from its nodes and a problem.

    The problem is that of its manifest, or `problem` instead. Then the certificate names every value in which
    the two differ; values that only say how the maneuver was solved are in its notes.

    Raises
    ------
    ResultError
        The arm record in the manifest is malformed, or describes another number of nodes.
    """
    maneuver, foreign, differing = held_against(maneuver, problem)
    arm = arm_of(maneuver)
    motion = RecordedMotion(arm, maneuver.time, maneuver.configurations)
    clearances, clearance, self_clearance, wrong, notes = clearances_of(maneuver, arm, motion)
    values = _singular_values(arm, motion.states)
    if len(motion.states) > _FEW_STATES and 3 * len(arm.free) > _MANY_UNKNOWNS:
        notes.append(f"singular values are those of {_FEW_STATES} states")
    tip, rotation = arm.tip_position(motion.states), arm.tip_rotations(motion.states)
    at_tip = TIP_TOLERANCE * arm.size
    target_error, astray, remarks = check_path(maneuver, tip, at_tip)
    effector = maneuver.manifest["problem"].get("end_effector") or {}
    is_elastic = effector.get("mode") == "elastic"
    differences = {
        "tip_position": np.abs(maneuver.tip_position - tip),
        "tip_rotation": np.abs(maneuver.tip_rotation - rotation),
        "clearance": _difference(maneuver.clearance, clearance),
        "self_clearance": _difference(maneuver.self_clearance, self_clearance),
    }
    if maneuver.joints is None:
        differences["member_lengths"] = np.abs(maneuver.member_lengths - arm.quantities(motion.states))
    furthest = max(differences, key=lambda name: float(np.max(differences[name], initial=0.0)))
    reported = maneuver.manifest.get("clearance_rows") or {}
    return Certificate(
        **_limits(maneuver, arm, arm.quantities(motion.states)),
        **clearances,
        tip_error=_worst(tip_error(maneuver, tip), "m", None if is_elastic else at_tip),
        tip_direction_error=_worst(
            direction_error(maneuver, rotation), "rad", None if is_elastic else DIRECTION_TOLERANCE
        ),
        target_error=_worst(target_error, "m", at_tip),
        array_error=_worst(differences[furthest], "m", ARRAY_TOLERANCE, array=furthest),
        length_singular_value=_least_of(values[:, 0], ""),
        tip_singular_value=_least_of(values[:, 1], "m/m"),
        **curve_measures(maneuver, rotation, arm.size),
        tip_error_per_millimetre=_worst(values[:, 2] if len(values) else None, "mm", None),
        fcl_rows=Measure(reported.get("fcl"), ""),
        exact_rows=Measure(reported.get("exact"), ""),
        contradictions=(
            *foreign,
            *wrong,
            *astray,
            *curve_contradictions(maneuver),
            *arm.contradictions(maneuver.manifest["problem"], maneuver.arrays),
            *_jams_between_rows(maneuver),
            *_outcome_contradictions(maneuver),
        ),
        notes=(
            *differing,
            *notes,
            *remarks,
            *([f"stopped by {stop}"] if (stop := maneuver.stopped_by) else []),
        ),
    )


def _limits(maneuver: Result, arm: AnyRecordedArm, lengths: Array) -> dict[str, Measure]:
    """Return errors of fixed lengths or joint values (T, M) and of the base, and violations of limits.

    A rate is the mean over a step. An acceleration is the change of the rate from step to step over the time
    between their middles; that of a member that stops because it locks does not count. The rounding of
    positions and times over a short step is allowed beyond both limits.
    """
    time, unit, names = maneuver.time, arm.unit, arm.quantity_names
    per = f"({unit})" if " " in unit else unit
    locks = [
        (names.index(name), since) for name, since in locks_of(maneuver.manifest["problem"]) if name in names
    ]
    held = np.where(arm.actuated, 0.0, np.abs(lengths - arm.home_quantities))
    for k, since in locks:
        rows = np.flatnonzero(time >= since - INSTANT)
        held[rows, k] = np.maximum(held[rows, k], np.abs(lengths[rows, k] - lengths[rows[:1], k]))
    size = float(np.abs(maneuver.nodes).max())
    rates, accelerations, rounding, its_rounding = changes(time, lengths, size, locks)
    poses = base_poses(maneuver.manifest["problem"], time)
    placed = arm.home[arm.base] @ np.swapaxes(rotations(poses[:, 3:]), 1, 2) + poses[:, None, :3]
    moved = np.linalg.norm(maneuver.nodes[:, arm.base] - placed, axis=2)

    def beyond(excess: Array, unit: str) -> Measure:
        return _worst(np.where(arm.actuated, np.maximum(excess, 0.0), 0.0), unit, LIMIT_TOLERANCE, names)

    return {
        "member_error": _worst(held, unit, MEMBER_TOLERANCE, names),
        "base_error": _worst(moved, "m", MEMBER_TOLERANCE, [f"node {k}" for k in arm.base]),
        "stroke_violation": beyond(np.maximum(arm.stroke[:, 0] - lengths, lengths - arm.stroke[:, 1]), unit),
        "rate_violation": beyond(np.abs(rates) - rounding - arm.rate, f"{per}/s"),
        "acceleration_violation": beyond(
            np.abs(accelerations) - its_rounding - arm.acceleration, f"{per}/s^2"
        ),
    }


def changes(
    time: Array, values: Array, size: float, locks: Sequence[tuple[int, float]]
) -> tuple[Array, Array, Array, Array]:
    """Return rates (T - 1, M), accelerations (T - 2, M) of values (T, M) at times (T,), and their rounding.

    Times are in s. A rate that ends because its actuator locks does not count as an acceleration: `locks` are numbers
    of actuators and times. The last two results are bounds of the errors of a rate and of an acceleration by the
    rounding of times, and of values as large as `size`.
    """
    durations = np.diff(time)[:, None]
    between = 0.5 * (durations[1:] + durations[:-1])
    rates = np.diff(values, axis=0) / durations
    accelerations = np.diff(rates, axis=0) / between
    for k, since in locks:
        accelerations[np.abs(time[1:-1] - since) <= INSTANT, k] = 0.0
    rounding = _ROUNDING * (size + np.abs(rates) * np.abs(time[1:, None])) / durations
    return rates, accelerations, rounding, (rounding[1:] + rounding[:-1]) / between


def _difference(stored: Array, found: Array) -> Array:
    """Return (T,) differences of clearances, which may be infinite."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(stored == found, 0.0, np.abs(stored - found)))


def locks_of(problem: Mapping[str, Any]) -> list[tuple[str, float]]:
    """Return name and time, s, of the actuators that a problem, as JSON data, locks."""
    entries = arm_table(problem).get("locked") or ()
    tables = ({"member": entry} if isinstance(entry, str) else entry for entry in entries)
    return [(table.get("joint") or table["member"], float(table.get("time", 0.0))) for table in tables]


def _jams_between_rows(maneuver: Result) -> list[str]:
    """Return the members that lock between two rows: the lengths at which they lock are unknown."""
    return [
        f"{name} locks at {since:g} s, where there is no state"
        for name, since in locks_of(maneuver.manifest["problem"])
        if since <= maneuver.time[-1] and np.abs(maneuver.time - since).min() > INSTANT
    ]


def _singular_values(arm: AnyRecordedArm, nodes: Array) -> Array:
    """Return (S, 3) least of the length Jacobian, least and greatest of the tip's, at S states."""
    states = np.arange(len(nodes))
    if 3 * len(arm.free) > _MANY_UNKNOWNS:
        states = np.unique(np.linspace(0, len(nodes) - 1, _FEW_STATES).round().astype(int))
    found = [values for state in states if (values := arm.singular_values(nodes[state])) is not None]
    return np.array(found).reshape(-1, 3)


def _worst(
    errors: Array | None, unit: str, bound: float | None, names: Sequence[str] = (), *, array: str = ""
) -> Measure:
    """Return the greatest of errors (T,) or (T, M, ...), with its row and the name in the second axis."""
    if errors is None:
        return Measure(None, unit, bound)
    if not errors.size:
        return Measure(0.0, unit, bound)
    place = np.unravel_index(int(np.argmax(errors)), errors.shape)
    value = float(errors[place])
    parts = [array] if array else []
    if value > 0.0:
        parts.append(f"row {place[0]}")
        if len(names) and len(place) > 1:
            parts.append(names[int(place[1])])
    return Measure(value, unit, bound, "most", ", ".join(parts))


def _least_of(values: Array, unit: str) -> Measure:
    return Measure(float(values.min()) if len(values) else None, unit, None, "least")


def _outcome_contradictions(maneuver: Result) -> list[str]:
    """Return where status, reached and progress disagree."""
    found = []
    if abs(maneuver.progress[-1] - maneuver.reached) > 1e-9:
        found.append(f"reached is {maneuver.reached:.9g}; the last progress is {maneuver.progress[-1]:.9g}")
    if maneuver.status != "infeasible" and (maneuver.status == "solved") != maneuver.arrived:
        found.append(f'status is "{maneuver.status}", but the arm reached {maneuver.reached:.9g} of the path')
    return found
