"""The path of a maneuver and the marks on it at which its steps end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.problem import Problem, read_path
from vgtm_qp.problem.goal import PathManeuver, WaypointManeuver
from vgtm_qp.rotation import rotation_from_vector, turn_between
from vgtm_qp.step.path import Path

_SMALL_REST = 0.05
"""Share of an interval between marks below which it is joined to the next."""


@dataclass(frozen=True, eq=False)
class Plan:
    """The path of the tip, and the marks at which steps end."""

    path: Path
    """Poses over time, from the home pose at time 0, s."""
    marks: Array
    """(S,) times at which the steps end if nothing slows them, s."""

    def next_mark(self, value: float, *, keeps_moving: bool = False) -> tuple[float, float]:
        """Return the target of the step from `value` of the path, and the step's duration, s.

        The target is the next mark, or the one after if the next is very near: marks are preferred times, not
        constraints. An arm with limited accelerations (`keeps_moving`) has a target a whole interval ahead.
        """
        marks = self.marks
        k = int(np.searchsorted(marks, value, side="right"))
        dt = float(marks[k] - (marks[k - 1] if k else self.path.start))
        if marks[k] - value < _SMALL_REST * dt and k + 1 < len(marks):
            k, dt = k + 1, float(marks[k + 1] - marks[k])
        aim = float(marks[k])
        return (max(aim, min(value + dt, float(marks[-1]))) if keeps_moving else aim), dt


def make_plan(problem: Problem, position: Array, rotation: Array) -> Plan:
    """Return the plan of a problem's maneuver from the home pose of the tip, `position` (3,) and `rotation` (3, 3).

    ProblemError where the path file is wrong.
    """
    maneuver = problem.maneuver
    if isinstance(maneuver, WaypointManeuver):
        return _through_waypoints(maneuver, position, rotation)
    with problem.blaming(
        ("maneuver", "path"), "rows whose times still differ after the run to the first of them"
    ):
        return _along_file(maneuver, position, rotation)


def _through_waypoints(maneuver: WaypointManeuver, position: Array, rotation: Array) -> Plan:
    times, positions, rotations = [0.0], [position], [rotation]
    for waypoint in maneuver.waypoint:
        if waypoint.position is not None:
            position = np.asarray(waypoint.position, dtype=float)
        if waypoint.pointing is not None:
            wanted = np.asarray(waypoint.pointing, dtype=float)
            turn = turn_between(rotation[:, 2], wanted / np.linalg.norm(wanted))
            rotation = rotation_from_vector(turn) @ rotation
        elif waypoint.rotation_vector is not None:
            rotation = rotation_from_vector(waypoint.rotation_vector)
        times.append(waypoint.time)
        positions.append(position)
        rotations.append(rotation)
    marks = np.linspace(0.0, times[-1], maneuver.steps + 1)[1:]
    return Plan(Path(np.array(times), np.stack(positions), np.stack(rotations)), marks)


def _along_file(maneuver: PathManeuver, position: Array, rotation: Array) -> Plan:
    table = read_path(maneuver.path)
    interval = float(np.mean(np.diff(table.time))) if len(table.time) > 1 else 1.0
    approach = max(maneuver.approach_steps, 1)
    duration = maneuver.approach_time or approach * interval
    if not maneuver.approach_steps and table.time[0] > 0.0:
        duration = float(table.time[0])
    rows = duration + (table.time - table.time[0])
    rotations = np.broadcast_to(rotation, (len(rows), 3, 3))
    if table.rotation_vector is not None:
        rotations = np.stack([rotation_from_vector(vector) for vector in table.rotation_vector])
    path = Path(
        np.concatenate([[0.0], rows]),
        np.vstack([position, table.position]),
        np.concatenate([rotation[None], rotations]),
    )
    return Plan(path, np.concatenate([duration * np.arange(1, approach) / approach, rows]))
