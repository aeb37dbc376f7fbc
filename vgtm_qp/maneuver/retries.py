"""Retries after a dead end: the same maneuver once more from home, with the redundancy resolved differently.

A path that is blocked for one shape of the arm may be open for another, and the null-space terms decide which shape it
takes. The retries stand in the order of their success over random scenes (``vgtm study robustness``; README, section
Robustness).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import ProblemError
from vgtm_qp.problem import Problem
from vgtm_qp.problem.goal import WaypointManeuver
from vgtm_qp.step.stops import Stop, StopKind

Array = NDArray[np.float64]

_HOPELESS = (StopKind.INTERRUPTED, StopKind.SINGULAR, StopKind.OUT_OF_REACH, StopKind.LOCKED)

_BULGE, _SLIGHT_BULGE = 0.3, 0.1
"""Sideways displacement of the middle of a bulged curve, as a share of the arm's height."""
_FIRM_TRACKING = 1.0
"""Least weight of tracking in a retry with a bulged curve."""
_MORE_VERTICES = 3

_SIDES = {"to its left": 1, "to its right": 3, "away from what blocks it": 0, "towards it": 2}
"""Quarters of a turn about the arm, as seen along it, from the direction away from what blocks it."""


@dataclass(frozen=True, eq=False)
class DeadEnd:
    """Where an arm stopped."""

    stop: Stop
    control_vertices: Array
    """(V, 3) those of the curve there, m; V = 0 without one."""
    height: float
    """Of the arm at home, m."""
    heading: Array
    """(3,) direction of the path from there on."""


Changes = dict[str, Any]
Change = Callable[[Problem, DeadEnd], Changes]


def retries(problem: Problem, dead_end: DeadEnd) -> Iterator[tuple[str, Problem]]:
    """Yield name and changed problem of each retry that applies; nothing if retries are off."""
    if not problem.method.retries or dead_end.stop.kind in _HOPELESS:
        return
    for name, change in _CHANGES.items():
        changes = change(problem, dead_end)
        if not changes:
            continue
        try:
            yield name, problem.replace(changes)
        except ProblemError:
            continue


def _raised(weight: str, factor: float) -> Change:
    """Return the change that multiplies a weight of the null space."""
    return lambda problem, _: {
        f"method.weights.{weight}": factor * max(getattr(problem.method.weights, weight), 0.02)
    }


def _at_full_speed(problem: Problem, _: DeadEnd) -> Changes:
    slows = problem.method.slow_approach and problem.end_effector.mode == "scaled"
    return {"method.slow_approach": False} if slows else {}


def _shorter_steps(problem: Problem, _: DeadEnd) -> Changes:
    maneuver = problem.maneuver
    return {"maneuver.steps": 3 * maneuver.steps} if isinstance(maneuver, WaypointManeuver) else {}


def _no_curve(problem: Problem, _: DeadEnd) -> Changes:
    # Hard tracking asks for the curve, so there is no retry without it.
    if problem.method.tracking == "none" or problem.method.hard_tracking:
        return {}
    return {"method.tracking": "none"}


def _more_vertices(problem: Problem, dead_end: DeadEnd) -> Changes:
    if problem.curve is None or not len(dead_end.control_vertices):
        return {}
    return {"curve.control_vertices": problem.curve.control_vertices + _MORE_VERTICES}


def _bulged(quarter: int, size: float = _BULGE) -> Change:
    """Return the change that bulges the curve to one of its four sides."""

    def change(problem: Problem, dead_end: DeadEnd) -> Changes:
        vertices = len(dead_end.control_vertices)
        if problem.curve is None or problem.curve.control_vertex_goals or vertices < 4:
            return {}
        goals = bulge(dead_end, quarter, size)
        return {
            "curve.control_vertex_goals": [
                {"index": i, "position": goals[i].tolist()} for i in range(2, vertices - 1)
            ],
            "method.weights.tracking": max(problem.method.weights.tracking, _FIRM_TRACKING),
        }

    return change


def bulge(dead_end: DeadEnd, quarter: int, size: float = _BULGE) -> Array:
    """Return (V, 3) the control vertices where the arm stopped, displaced sideways by half a sine wave, m.

    The middle moves by about `size` times the arm's height. `quarter` counts right angles about the chord from the
    direction away from what blocks the arm; if no obstacle does, from the direction of the path.
    """
    vertices = dead_end.control_vertices
    chord = vertices[-1] - vertices[0]
    chord = chord / np.linalg.norm(chord)
    aside = _across(chord, np.array(dead_end.stop.away), dead_end.heading)
    sides = (aside, np.cross(chord, aside), -aside, -np.cross(chord, aside))
    wave = np.sin(np.pi * np.arange(len(vertices)) / (len(vertices) - 1))
    return np.asarray(vertices + size * dead_end.height * wave[:, None] * sides[quarter])


def _across(axis: Array, *wanted: Array) -> Array:
    """Return (3,) the unit vector across `axis` next to the first direction that is not along it."""
    for direction in (*wanted, *np.eye(3)):
        across = direction - axis * (axis @ direction)
        length = float(np.linalg.norm(across))
        if length > 1e-6 * max(float(np.linalg.norm(direction)), 1e-6):
            return np.asarray(across / length)
    raise AssertionError("no axis is along all of x, y and z")


_CHANGES: dict[str, Change] = {
    "actuators drawn to their home lengths": _raised("stroke_centring", 10.0),
    **{f"curve bulged {side}": _bulged(quarter) for side, quarter in _SIDES.items()},
    "curve bulged a little away from what blocks it": _bulged(0, _SLIGHT_BULGE),
    "no slowing down before contacts": _at_full_speed,
    "shorter steps": _shorter_steps,
    "actuator rates as the metric": _raised("actuator_rate", 50.0),
    "no curve": _no_curve,
    "more control vertices": _more_vertices,
}
