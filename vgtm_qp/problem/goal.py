"""``[end_effector]`` and ``[maneuver]``: which coordinates of the tip are steered, and where to."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

from pydantic import Field

from vgtm_qp.problem.fields import (
    LONGEST_STEP,
    SHORTEST_STEP,
    ByKey,
    Direction,
    File,
    Seconds,
    Vector,
    count,
    entry,
)
from vgtm_qp.problem.table import Place, Table, increasing

Coordinates = Literal["position", "pointing", "orientation", "x", "y", "z"]
StepCount = Annotated[int, count(1, 1_000_000)]


class EndEffector(Table, called="an end effector"):
    """Which coordinates of the end effector follow the path, and how strictly."""

    track: tuple[Coordinates, ...] = Field(
        default=("position",),
        min_length=1,
        description="position, pointing (two angles), orientation (three), or x, y, z",
    )
    mode: Literal["scaled", "hard", "elastic"] = Field(
        default="scaled",
        description="scaled: slows down along the path; hard: stays on time or stops; elastic: may leave the "
        "path, at the price of the weight end_effector",
    )

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        for i, name in enumerate(self.track):
            earlier = self.track[:i]
            if name in earlier:
                yield ("track", i), "each coordinate once"
            elif (name in "xyz" and "position" in earlier) or (
                name == "position" and {"x", "y", "z"} & set(earlier)
            ):
                yield ("track", i), "position, or single axes of it, not both"
            elif {name, *earlier} >= {"pointing", "orientation"} and name in ("pointing", "orientation"):
                yield ("track", i), "pointing or orientation, not both"


class Waypoint(Table, called="a waypoint"):
    """A pose that the end effector passes at a time."""

    time: Seconds = Field(description="time since the start at the home pose, s")
    position: Vector | None = Field(default=None, description="position in the base frame, m")
    pointing: Direction | None = Field(
        default=None, description="direction of the tip's z axis; need not be a unit vector"
    )
    rotation_vector: Vector | None = Field(
        default=None, description="orientation relative to the base frame, rad"
    )

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        if self.pointing is not None and self.rotation_vector is not None:
            yield ("pointing",), "pointing or rotation_vector, not both"


class WaypointManeuver(Table, called="a maneuver through waypoints"):
    """From the home pose through waypoints, in equal steps of time."""

    kind: Literal["path"] = "path"
    steps: StepCount = Field(default=50, description="number of steps")
    waypoint: tuple[Waypoint, ...] = Field(min_length=1, description="the waypoints, in the order of time")

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        yield from increasing("waypoint", [waypoint.time for waypoint in self.waypoint])
        yield from _step_durations(
            ("waypoint", len(self.waypoint) - 1, "time"), self.waypoint[-1].time, self.steps
        )


class PathManeuver(Table, called="a maneuver along a path file"):
    """Along a path from a file, one step a row."""

    kind: Literal["path"] = "path"
    path: File = Field(description="CSV file with the columns t,x,y,z and, if wanted, rx,ry,rz (s, m, rad)")
    approach_steps: Annotated[int, count(0, 1_000_000)] = Field(
        default=0, description="steps of the straight run from the home tip to the first row"
    )
    approach_time: Seconds | None = Field(
        default=None, description="duration of that run, s; approach_steps mean row intervals where absent"
    )

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        if self.approach_time is not None:
            yield from _step_durations(("approach_time",), self.approach_time, max(self.approach_steps, 1))


def _step_durations(place: Place, whole: float, steps: int) -> Iterator[tuple[Place, str]]:
    """Yield the place of a time, s, if `steps` steps of it are shorter or longer than a step can be."""
    if not SHORTEST_STEP <= whole / steps <= LONGEST_STEP:
        yield (
            place,
            f"from {SHORTEST_STEP:g} to {LONGEST_STEP:g} s a step: these {steps} take {whole / steps:g} s each",
        )


def _pick(value: Any) -> type[Table] | None:
    if entry(value, "kind") not in (None, "path") or not isinstance(value, Mapping | Table):
        return None
    has_path = entry(value, "path") is not None and entry(value, "waypoint") is None
    return PathManeuver if has_path else WaypointManeuver


ManeuverTable = Annotated[
    WaypointManeuver | PathManeuver,
    ByKey("kind", _pick, later=("goal", "deployment", "follow-the-leader", "shape")),
]
