"""Retries after a dead end: the same maneuver once more from home, with the redundancy resolved differently.

A path that is blocked for one shape of the arm may be open for another, and the null-space terms decide the shape. The
order of the retries is that of their success over random scenes (``vgtm study robustness``).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import ProblemError
from vgtm_qp.problem import Problem
from vgtm_qp.problem.goal import WaypointManeuver
from vgtm_qp.step.stops import Stop, StopKind

_HOPELESS = (StopKind.INTERRUPTED, StopKind.SINGULAR, StopKind.OUT_OF_REACH, StopKind.LOCKED)

_BULGE = 0.3
"""Sideways displacement of the middle of a bulged curve, as a share of the arm's height."""
_BULGES = (
    ("curve bulged to its left", 1, _BULGE),
    ("curve bulged to its right", 3, _BULGE),
    ("curve bulged away from what blocks it", 0, _BULGE),
    ("curve bulged towards it", 2, _BULGE),
    ("curve bulged a little away from what blocks it", 0, 0.1),
)
"""Name, side and size: sides in quarter turns about the arm, from the direction away from the obstacle."""
_FIRM_TRACKING = 1.0
"""Least weight of tracking in a retry with a bulged curve."""
_MORE_VERTICES = "more control vertices"
_MORE = 3
"""Number of control vertices that are added."""


@dataclass(frozen=True, eq=False)
class DeadEnd:
    """Where an arm stopped."""

    stop: Stop
    control_vertices: Array
    """(V, 3) of the curve where the arm stopped, m; V = 0 without one."""
    height: float
    """Of the arm at home, m."""
    heading: Array
    """(3,) direction of the path beyond that place."""


def retries(problem: Problem, dead_end: DeadEnd) -> Iterator[tuple[str, Problem]]:
    """Yield name and changed problem of each retry that applies; nothing if retries are off.

    If stations could give way and that was not enough, there are two retries: a more flexible curve, then
    tracking that is elastic from the start. The retries of the elastic problem follow where it stops in turn,
    so that no path is lost that elastic tracking finds. Hard tracking and a solver by bays have no elastic
    tracking.
    """
    if not problem.method.retries or dead_end.stop.kind in _HOPELESS:
        return
    if problem.method.gives_way:
        if len(dead_end.control_vertices):
            yield _MORE_VERTICES, problem.replace(_more_vertices(problem))
        yield "elastic tracking", problem.replace({"method.tracking_mode": "elastic"})
        return
    for name, changes in _changes(problem, dead_end):
        with suppress(ProblemError):
            yield name, problem.replace(changes)


def _changes(problem: Problem, dead_end: DeadEnd) -> Iterator[tuple[str, dict[str, Any]]]:
    method, weights, curve = problem.method, problem.method.weights, problem.curve
    vertices = len(dead_end.control_vertices)
    centring, rate = 10.0 * max(weights.stroke_centring, 0.02), 50.0 * max(weights.actuator_rate, 0.02)
    yield "actuators drawn to their home lengths", {"method.weights.stroke_centring": centring}
    if not curve.control_vertex_goals and vertices >= 4:
        firm = {"method.weights.tracking": max(weights.tracking, _FIRM_TRACKING)}
        for name, quarter, size in _BULGES:
            bulged = bulge(dead_end, quarter, size)
            goals = [{"index": i, "position": bulged[i].tolist()} for i in range(2, vertices - 1)]
            yield name, {"curve.control_vertex_goals": goals, **firm}
    if method.slow_approach and problem.end_effector.mode == "scaled":
        yield "no slowing down before contacts", {"method.slow_approach": False}
    if isinstance(problem.maneuver, WaypointManeuver):
        yield "shorter steps", {"maneuver.steps": 3 * problem.maneuver.steps}
    yield "actuator rates as the metric", {"method.weights.actuator_rate": rate}
    # Hard tracking needs the curve, and so has no retry without one.
    if method.tracking == "coupled" and method.tracking_mode != "hard":
        yield "no curve", {"method": method.kept_by("qp", "none"), "curve.control_vertex_goals": []}
    if vertices:
        yield _MORE_VERTICES, _more_vertices(problem)


def _more_vertices(problem: Problem) -> dict[str, Any]:
    return {"curve.control_vertices": problem.curve.control_vertices + _MORE}


def bulge(dead_end: DeadEnd, quarter: int, size: float = _BULGE) -> Array:
    """Return (V, 3) the control vertices where the arm stopped, displaced sideways by half a sine wave, m.

    The middle moves by about `size` times the arm's height. `quarter` counts right angles about the chord from the
    direction away from the blocking obstacle; without one, from the direction of the path.
    """
    vertices = dead_end.control_vertices
    chord = vertices[-1] - vertices[0]
    chord = chord / np.linalg.norm(chord)
    aside = _across(chord, np.array(dead_end.stop.away), dead_end.heading)
    sides = (aside, np.cross(chord, aside), -aside, -np.cross(chord, aside))
    wave = np.sin(np.pi * np.arange(len(vertices)) / (len(vertices) - 1))
    return np.asarray(vertices + size * dead_end.height * wave[:, None] * sides[quarter])


def _across(axis: Array, *wanted: Array) -> Array:
    """Return (3,) the unit vector across `axis` nearest to the first of `wanted` that is not along `axis`."""
    for direction in (*wanted, *np.eye(3)):
        across = direction - axis * (axis @ direction)
        length = float(np.linalg.norm(across))
        if length > 1e-6 * max(float(np.linalg.norm(direction)), 1e-6):
            return np.asarray(across / length)
    raise AssertionError("no axis is along all of x, y and z")
