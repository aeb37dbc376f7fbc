"""The scenes that are measured: bundled maneuvers, and the one between two cubes for any number of bays."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, get_args

from vgtm_qp.bench import SceneKind, TrackingName
from vgtm_qp.problem import Problem, load_problem

KINDS: tuple[SceneKind, ...] = get_args(SceneKind)
TRACKINGS: tuple[TrackingName, ...] = ("exact", "elastic")
BAYS = (5, 10, 20, 50, 100, 200, 500, 1000)
CLUTTERED_BAYS = 50
CLUTTER = 100

_BUNDLED: dict[SceneKind, str] = {
    "free": "five_bay_free",
    "cubes": "five_bay_two_cubes",
    "pointing": "five_bay_two_cubes_pointing",
    "clutter": "five_bay_two_cubes",
    "tetrahedral": "tetrahedral_truss_circle",
}
_BUNDLED_BAYS = 5
_BAY = math.sqrt(2.0 / 3.0)
"""Height of an octahedral bay whose members are all 1 m long, m."""
_SHIFT, _SINK = 1.6, 0.78
"""What the tip is moved by sideways, and down for five bays, m."""
_EDGE = 0.9
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


class BenchScene(NamedTuple):
    """A problem to be measured; `tracking` is its mode, "none" where there is no curve."""

    name: str
    kind: SceneKind
    bays: int
    tracking: str
    problem: Problem


def make_scenes(
    kinds: Iterable[SceneKind] = KINDS,
    bays: Sequence[int] = BAYS,
    trackings: Sequence[TrackingName] = TRACKINGS,
) -> list[BenchScene]:
    """Return the scenes of these kinds; `bays` are those of the arms between two cubes.

    A direction of the tip cannot be held with hard tracking, so that ``pointing`` is elastic alone.
    """
    scenes = []
    for kind in dict.fromkeys(kinds):
        if kind == "tetrahedral":
            scenes.append(BenchScene("tetrahedral", kind, 14, "none", load_problem(_BUNDLED[kind])))
            continue
        counts = bays if kind == "cubes" else [CLUTTERED_BAYS if kind == "clutter" else _BUNDLED_BAYS]
        for count in dict.fromkeys(counts):
            problem = _problem(kind, count)
            for tracking in ("elastic",) if kind == "pointing" else dict.fromkeys(trackings):
                name = f"{kind}-{count}" + ("" if tracking == "exact" else f"-{tracking}")
                changed = problem.replace({"method.tracking_mode": tracking})
                scenes.append(BenchScene(name, kind, count, tracking, changed))
    return scenes


def _problem(kind: SceneKind, bays: int) -> Problem:
    problem = load_problem(_BUNDLED[kind])
    if bays != _BUNDLED_BAYS:
        problem = _scaled(problem, bays)
    if kind == "clutter":
        cubes = [*problem.to_dict()["obstacle"], *_clutter(bays, CLUTTER - len(problem.obstacle))]
        problem = problem.replace({"obstacle": cubes, "name": f"{bays}-bay arm among {CLUTTER} cubes"})
    return problem


def _scaled(problem: Problem, bays: int) -> Problem:
    """Return the maneuver of the five-bay arm for another one, with steps of the same length.

    The cubes keep their distance from the arm and stand at the same parts of its height, so that it has to
    bend round them; the tip goes sideways by as much, and down by what an arm of that height loses.
    """
    height, stretch = bays * _BAY, bays / _BUNDLED_BAYS
    cubes = problem.to_dict()["obstacle"]
    for cube in cubes:
        cube["center"] = [*cube["center"][:2], stretch * cube["center"][2]]
    return problem.replace(
        {
            "name": f"{bays}-bay arm between two cubes",
            "truss.bays": bays,
            "curve.control_vertices": min(bays + 1, 8),
            "maneuver.waypoint": [{"time": 10.0, "position": [_SHIFT, 0.0, height - _SINK / stretch]}],
            "obstacle": cubes,
        }
    )


def _clutter(bays: int, count: int) -> list[dict[str, Any]]:
    """Return cubes in a spiral round the arm, near it below and as far away above as the tip will go."""
    height = bays * _BAY
    cubes: list[dict[str, Any]] = []
    for k in range(count):
        part = (k + 1.0) / (count + 1.0)
        angle = k * _GOLDEN_ANGLE
        # Half a diagonal of the cube and the nodes' circle of 0.58 m stay apart whichever way the cube lies.
        distance = 1.45 + 1.2 * _SHIFT * part**1.5
        center = [distance * math.cos(angle), distance * math.sin(angle), part * height]
        pose = {"center": center, "rotation_vector": [0.0, 0.0, angle]}
        cubes.append({"name": f"cube {k + 3}", "shape": "box", "size": _EDGE} | pose)
    return cubes
