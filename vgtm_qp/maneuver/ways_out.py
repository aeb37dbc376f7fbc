"""Ways out of a dead end: the same maneuver once more from home, its redundancy resolved otherwise.

A path that is blocked for one shape of the arm may be open for another, and the null-space terms decide which shape it
takes. The ways stand in the order of what they bought over random scenes (``vgtm study robustness``).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from vgtm_qp.errors import ProblemError
from vgtm_qp.problem import Problem
from vgtm_qp.problem.goal import WaypointManeuver
from vgtm_qp.step.stops import Stop, StopKind

_HOPELESS = (StopKind.INTERRUPTED, StopKind.SINGULAR, StopKind.OUT_OF_REACH, StopKind.LOCKED)


def ways_out(problem: Problem, stop: Stop) -> Iterator[tuple[str, Problem]]:
    """Yield name and problem of each way that is worth trying after a `stop`; none where retries are off."""
    method = problem.method
    if not method.retries or stop.kind in _HOPELESS:
        return
    weights = method.weights
    ways: dict[str, dict[str, Any]] = {
        "actuators drawn to their home lengths": {
            "method.weights.stroke_centring": 10.0 * max(weights.stroke_centring, 0.02)
        },
        "shorter steps": {"maneuver.steps": 3 * getattr(problem.maneuver, "steps", 0)},
        "actuator rates as the metric": {
            "method.weights.actuator_rate": 50.0 * max(weights.actuator_rate, 0.02)
        },
        "no curve": {"method.tracking": "none", "method.hard_tracking": False},
    }
    for name, changes in ways.items():
        if name == "shorter steps" and not isinstance(problem.maneuver, WaypointManeuver):
            continue
        if name == "no curve" and method.tracking == "none":
            continue
        try:
            yield name, problem.replace(changes)
        except ProblemError:
            continue
