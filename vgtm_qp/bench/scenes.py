"""The scenes that are measured: bundled maneuvers, and the one between two cubes for any number of bays."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import product
from typing import Any, NamedTuple, get_args

import numpy as np

from vgtm_qp.arm.serial.chain import SerialChain
from vgtm_qp.arrays import Array
from vgtm_qp.bench import DistanceName, SceneKind, TrackingName
from vgtm_qp.problem import Problem, load_problem
from vgtm_qp.problem.arm import ArmTable
from vgtm_qp.problem.snake import snake

KINDS: tuple[SceneKind, ...] = get_args(SceneKind)
BAYS = (5, 20, 50, 200, 1000)
_SNAKES = (30, 100)
"""Joints of the snakes."""
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
"""Displacement of the tip, m: sideways, and downwards for five bays."""
_EDGE = 0.9
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))

Variant = tuple[TrackingName, DistanceName]
VARIANTS: dict[SceneKind, tuple[Variant, ...]] = {
    "free": (("exact", "fcl"),),
    "cubes": (("exact", "fcl"), ("elastic", "fcl")),
    "pointing": (("elastic", "fcl"), ("elastic", "exact")),
    "clutter": (("exact", "fcl"),),
    "tetrahedral": (("exact", "fcl"),),
    "serial": (("exact", "fcl"), ("exact", "exact")),
    "snake": (("exact", "fcl"),),
}
"""Modes of tracking, and sources of distances, with which each kind is measured by default.

Between the cubes a direction of the tip needs elastic tracking all along: with exact tracking the arm is
blocked half way.
"""
MORE_BETWEEN_CUBES: dict[int, tuple[Variant, ...]] = {
    5: (("hard", "fcl"), ("exact", "exact")),
    1000: (("hard", "fcl"),),
}
"""Further variants of ``cubes`` by the number of bays."""

_WITHOUT_CURVE = ("tetrahedral", "serial")
_JOINTS = 7
_JOINT_AXES = ((0, 0, 1), (0, 1, 0), (0, 0, 1), (0, -1, 0), (0, 0, 1), (0, 1, 0), (0, 0, 1))
_JOINT_HEIGHTS = (0.36, 0.0, 0.0, 0.42, 0.0, 0.4, 0.0)
"""Of a KUKA LBR iiwa 14: heights of the joints, m, each above the one before; limits, deg; speeds, deg/s."""
_JOINT_LIMITS = (170, 120, 170, 120, 170, 120, 175)
_JOINT_SPEEDS = (85, 85, 100, 75, 130, 135, 135)
_JOINT_HOME = (0.0, 0.4, 0.0, -1.4, 0.0, 0.6, 0.0)


class BenchScene(NamedTuple):
    """A problem to be measured.

    `tracking` is its mode, "none" without a curve; `bays` are the joints of a serial arm.
    """

    name: str
    kind: SceneKind
    bays: int
    tracking: str
    distance: DistanceName
    problem: Problem


def make_scenes(
    kinds: Iterable[SceneKind] = KINDS,
    bays: Sequence[int] = BAYS,
    trackings: Sequence[TrackingName] | None = None,
    distances: Sequence[DistanceName] | None = None,
) -> list[BenchScene]:
    """Return the scenes of these kinds; `bays` are those of the arms between two cubes.

    Without `trackings` and `distances` each kind has its `VARIANTS`. Otherwise every mode is combined with
    every source of distances; the default of either is exact tracking, and FCL.
    """
    scenes = []
    for kind in dict.fromkeys(kinds):
        several: dict[SceneKind, Sequence[int]] = {"cubes": bays, "snake": _SNAKES}
        for count in dict.fromkeys(several.get(kind, [_count(kind)])):
            variants: Iterable[Variant] = VARIANTS[kind]
            if kind == "cubes":
                variants = (*variants, *MORE_BETWEEN_CUBES.get(count, ()))
            if trackings or distances:
                variants = product(trackings or ("exact",), distances or ("fcl",))
            if kind in _WITHOUT_CURVE:
                variants = (("exact", distance) for _, distance in variants)
            problem = _problem(kind, count)
            scenes += [_scene(problem, kind, count, *variant) for variant in dict.fromkeys(variants)]
    return scenes


def _scene(
    problem: Problem, kind: SceneKind, bays: int, tracking: TrackingName, distance: DistanceName
) -> BenchScene:
    changes: dict[str, Any] = {"clearance.distance": distance}
    words = [kind, str(bays)]
    if kind not in _WITHOUT_CURVE:
        changes["method.tracking_mode"] = tracking
        words += [tracking] if tracking != "exact" else []
    words += ["exact-distance"] if distance == "exact" else []
    mode = "none" if kind in _WITHOUT_CURVE else tracking
    return BenchScene("-".join(words), kind, bays, mode, distance, problem.replace(changes))


def _count(kind: SceneKind) -> int:
    """Return the number of bays, or of joints, of a kind whose number is fixed."""
    fixed: dict[SceneKind, int] = {
        "clutter": CLUTTERED_BAYS,
        "tetrahedral": 14,
        "serial": _JOINTS,
    }
    return fixed.get(kind, _BUNDLED_BAYS)


def _serial() -> Problem:
    """Return an arm of seven joints, as mink and pink are made for; its elbow has to avoid a cube."""
    numbers = zip(_JOINT_AXES, _JOINT_HEIGHTS, _JOINT_LIMITS, _JOINT_SPEEDS, _JOINT_HOME, strict=True)
    joints = [
        {
            "name": f"joint {k}",
            "axis": axis,
            "position": [0.0, 0.0, height],
            "limits": [-math.radians(limit), math.radians(limit)],
            "rate": math.radians(speed),
            "home": home,
        }
        for k, (axis, height, limit, speed, home) in enumerate(numbers, start=1)
    ]
    return Problem.from_dict(
        {
            "schema_version": 1,
            "name": "arm of seven joints beside a cube",
            "arm": {"joint": joints, "tip": [0.0, 0.0, 0.2], "link_radius": 0.06},
            "end_effector": {"track": ["position"]},
            "maneuver": {"steps": 50, "waypoint": [{"time": 5.0, "position": [0.3, 0.5, 0.6]}]},
            "obstacle": [{"name": "cube", "shape": "box", "center": [0.35, 0.36, 0.88], "size": 0.25}],
            "clearance": {"safe": 0.03, "influence": 0.3},
            "method": {"tracking": "none"},
        }
    )


def _snake(joints: int) -> Problem:
    """Return a snake of universal joints that leans over between three cubes; that of 30 joints is 4 m long.

    Links of longer ones are as long, and every tenth joint is a station. Cubes stand beside the same parts of their
    length, and the tip moves as far.
    """
    cubes = (((1.3, -0.2, 1.7), 0.6, 0.7), ((-0.7, -0.6, 1.5), 0.5, 0.33), ((0.3, 1.2, 3.0), 0.5, 0.56))
    short, home = _snake_at_home(_SNAKES[0]), _snake_at_home(joints)

    def beside(part: float, place: Sequence[float]) -> list[float]:
        return [float(value) for value in place + (_along(home, part) - _along(short, part))]

    return Problem.from_dict(
        {
            "name": f"snake of {joints} joints between three cubes",
            "arm": _snake_table(joints),
            "curve": {"control_vertices": 6},
            "maneuver": {
                "steps": 100,
                "waypoint": [{"time": 10.0, "position": beside(1.0, (2.6, -0.9, 2.2))}],
            },
            "obstacle": [
                {"name": f"cube {k}", "shape": "box", "center": beside(part, center), "size": size}
                for k, (center, size, part) in enumerate(cubes, start=1)
            ],
            "clearance": {"safe": 0.08, "influence": 0.5},
        }
    )


def _snake_table(joints: int) -> dict[str, Any]:
    short = _SNAKES[0]
    return snake(joints // 2, length=4.0 * joints / short) | ({} if joints == short else {"every": 10})


def _along(points: Array, part: float) -> Array:
    """Return the point (3,) at a part, 0 to 1, of a polyline of equal legs (K, 3)."""
    return np.array([np.interp(part, np.linspace(0.0, 1.0, len(points)), axis) for axis in points.T])


def _snake_at_home(joints: int) -> Array:
    """Return (J / 2 + 1, 3) universal joints and tip of a snake at home, m."""
    table = ArmTable.model_validate(_snake_table(joints))
    return SerialChain.of(table, []).at(np.array([*table.home_values(), *[0.0] * 6]))[0][1 : joints + 2 : 2]


def _problem(kind: SceneKind, bays: int) -> Problem:
    if kind == "serial":
        return _serial()
    if kind == "snake":
        return _snake(bays)
    if kind == "tetrahedral":
        return load_problem(_BUNDLED[kind])
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
    bend round them. The tip goes sideways as far as that of the five-bay arm, and down by less in proportion
    to the bays.
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
    """Return cubes in a spiral round the arm; their distance grows upwards, with the motion of the arm."""
    height = bays * _BAY
    cubes: list[dict[str, Any]] = []
    for k in range(count):
        part = (k + 1.0) / (count + 1.0)
        angle = k * _GOLDEN_ANGLE
        # Beyond half a cube's diagonal plus the nodes' circle of 0.58 m, so that cube and arm are apart
        # however it is turned.
        distance = 1.45 + 1.2 * _SHIFT * part**1.5
        center = [distance * math.cos(angle), distance * math.sin(angle), part * height]
        pose = {"center": center, "rotation_vector": [0.0, 0.0, angle]}
        cubes.append({"name": f"cube {k + 3}", "shape": "box", "size": _EDGE} | pose)
    return cubes
