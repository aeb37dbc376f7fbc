"""Random scenes of all that a problem file may contain: shapes, motions, limits, jams, curves, modes."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh

from vgtm_qp.arm.build import make_arm
from vgtm_qp.problem import Problem
from vgtm_qp.study.scenes import random_scene
from vgtm_qp.study.serial_scenes import random_serial_scene

Arms = Literal["trusses", "serial"]

_FASTEST = 0.05
"""Greatest coordinate of an obstacle's velocity, m/s."""


def varied_scene(seed: int, number: int, *, steps: int = 30, arms: Arms = "trusses") -> Problem:
    """Return scene `number` of a `seed`: always the same, whatever scenes were made before it.

    The arm, its goal and the places of the obstacles are those of ``random_scene``, or for serial `arms` of
    ``random_serial_scene``. Obstacles at rest are clear of the arm at home. The goal need not be reachable.
    """
    random = np.random.default_rng([seed, number, 1])
    if arms == "serial":
        plain = random_serial_scene(seed, number, steps=steps)
    else:
        plain = random_scene(seed, number, steps=steps).problem
    problem, arm = plain.to_dict(), make_arm(plain)
    actuators = [arm.quantity_names[k] for k in arm.actuators]
    table, key = (problem["truss"], "member") if plain.truss else (problem["arm"], "joint")

    def happens(share: float) -> bool:
        return bool(random.random() < share)

    method: dict[str, Any] = {"name": "qp"}
    problem["obstacle"] = [_obstacle(cube, random) for cube in problem["obstacle"]]
    if happens(0.25):
        limit = {"acceleration": float(random.uniform(0.2, 1.0))}
        if plain.truss:
            table |= limit
        else:
            table["joint"] = [joint | limit for joint in table["joint"]]
    if happens(0.2):
        jammed = random.choice(actuators, int(random.integers(1, 4)), replace=False)
        table["locked"] = [
            {key: str(name), "time": float(random.choice([0.0, random.uniform(0.5, 9.0)]))} for name in jammed
        ]
    if happens(0.15):
        drift, turn = random.uniform(-0.2, 0.2, 3), random.uniform(-0.2, 0.2, 3)
        table["base_motion"] = [{"time": 10.0, "position": drift.tolist(), "rotation_vector": turn.tolist()}]
    problem["curve"] = _curve(problem["curve"]["control_vertices"], random)
    problem["end_effector"]["mode"] = str(random.choice(["scaled", "hard", "elastic"], p=[0.7, 0.15, 0.15]))
    method["tracking"] = str(random.choice(["coupled", "none"], p=[0.8, 0.2]))
    strictness = str(random.choice(["exact", "hard", "elastic"], p=[0.7, 0.15, 0.15]))
    if method["tracking"] == "coupled":
        method["tracking_mode"] = strictness
    method["slow_approach"] = not happens(0.2)
    if happens(0.1):
        method["step_limit"] = float(random.uniform(0.05, 0.2))
    clearance = problem["clearance"]
    clearance["self_collision"] = not happens(0.1)
    clearance["distance"] = "exact" if happens(0.1) else "fcl"
    if happens(0.1) and table.get("body") is None:
        clearance["minimum_angle"] = float(random.uniform(0.05, 0.2))
    return Problem.from_dict({**problem, "method": method})


def _obstacle(cube: dict[str, Any], random: np.random.Generator) -> dict[str, Any]:
    """Return a cube, or a body inside it, at rest or in motion."""
    edge = float(np.max(cube["size"]))
    pose = {key: cube[key] for key in ("name", "center", "rotation_vector")}
    if random.random() < 0.2:
        pose["velocity"] = random.uniform(-_FASTEST, _FASTEST, 3).tolist()
    shape = str(random.choice(["box", "sphere", "cylinder", "mesh"]))
    sizes: dict[str, dict[str, Any]] = {
        "box": {"size": cube["size"]},
        "sphere": {"radius": edge / 2.0},
        "cylinder": {"radius": edge / 2.0, "height": edge},
        "mesh": {"file": str(_octahedron()), "scale": edge / 2.0},
    }
    return {**pose, "shape": shape, **sizes[shape]}


@cache
def _octahedron() -> Path:
    """Return a file with a mesh inside the cube of edge 2 round the origin."""
    file = Path(tempfile.mkdtemp(prefix="vgtm-")) / "octahedron.stl"
    corners = np.concatenate([np.eye(3), -np.eye(3)])
    trimesh.convex.convex_hull(corners).export(file)
    return file


def _curve(vertices: int, random: np.random.Generator) -> dict[str, Any]:
    family = str(random.choice(["bezier", "b-spline", "beta-spline"], p=[0.6, 0.2, 0.2]))
    curve: dict[str, Any] = {"family": family, "control_vertices": max(vertices, 5)}
    if family == "beta-spline":
        curve |= {"bias": float(random.uniform(0.8, 1.3)), "tension": float(random.uniform(0.0, 2.0))}
    if random.random() < 0.1:
        curve["nodes"] = "arc-length"
    if random.random() < 0.1:
        curve["torsion_vertices"] = 2
    return curve
