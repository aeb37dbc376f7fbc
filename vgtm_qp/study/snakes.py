"""Success of the methods that move serial arms: snakes of universal joints in scenes of growing density."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vgtm_qp.arm.build import make_arm
from vgtm_qp.geometry import shapes
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.problem import Problem
from vgtm_qp.problem.snake import snake
from vgtm_qp.study.clutter import SEED, crossed, draw, successes
from vgtm_qp.study.workers import Row, Task

__all__ = ["draw", "run", "scene", "tasks", "text"]

_METHODS = ("qp", "qp-none", "pseudoinverse-corrected", "pseudoinverse-obstacles")
_JOINTS = 15
_SAFE, _ROOM = 0.08, 0.02
_REACH, _TRIES = 0.9, 400
"""Greatest distance of a goal from the base, as a share of the length; tries of a place for a cube."""


def tasks(short: bool) -> list[Task]:
    """Return one task a scene; all methods meet the same scenes."""
    densities = (0, 4) if short else (0, 4, 8, 12, 16)
    count, steps = (2, 20) if short else (24, 40)
    return [
        {"seed": SEED, "cubes": density, "number": k, "steps": steps, "methods": list(_METHODS)}
        for density in densities
        for k in range(count)
    ]


def scene(seed: int, cubes: int, number: int, steps: int, *, joints: int = _JOINTS) -> Problem:
    """Return scene `number` of a snake of universal `joints` with that many cubes: always the same.

    The goal is 0.15 to 0.4 of the snake's length from the tip; the cubes, 0.2 to 0.5 m, stand about the snake, clear of
    its home pose and of the goal. A scene need not have a solution.
    """
    random = np.random.default_rng([seed, cubes, number, joints])
    data: dict[str, Any] = {
        "name": f"snakes {seed}-{cubes}-{number}",
        "arm": snake(joints),
        "curve": {"family": "bezier", "control_vertices": 6},
        "end_effector": {"track": ["position"]},
        "maneuver": {"steps": steps, "waypoint": [{"time": 10.0, "position": [0.0, 0.0, 1.0]}]},
        "clearance": {"safe": _SAFE, "influence": 0.5},
    }
    arm = make_arm(Problem.from_dict(data))
    tip, points = arm.end_effector.position(arm.home), arm.points(arm.home_configuration)
    goal = np.full(3, np.inf)
    while np.linalg.norm(goal) > _REACH * arm.height:
        way = random.normal(size=3)
        goal = tip + way * (random.uniform(0.15, 0.4) * arm.height / np.linalg.norm(way))
    data["maneuver"]["waypoint"][0]["position"] = goal.tolist()
    found: list[dict[str, Any]] = []
    for _ in range(_TRIES):
        if len(found) == cubes:
            break
        edge, near = (
            float(random.uniform(0.2, 0.5)),
            points[arm.bodies.points[random.integers(len(arm.bodies))]],
        )
        center = near.mean(axis=0) + random.normal(scale=0.5, size=3)
        if np.linalg.norm(np.maximum(np.abs(goal - center) - edge / 2.0, 0.0)) < 0.3:
            continue
        cube = shapes.box("cube", center, edge)
        monitor = Clearance(arm.bodies, [cube], safe=_SAFE, influence=0.5, self_collision=False, by_fcl=False)
        if monitor.least(points)[0] >= _SAFE + _ROOM:
            name = f"cube {len(found) + 1}"
            found.append({"name": name, "shape": "box", "center": center.tolist(), "size": edge})
    return Problem.from_dict({**data, "obstacle": found})


def run(seed: int, cubes: int, number: int, steps: int, methods: list[str]) -> Row:
    """Return the row of a scene, as in ``clutter``."""
    return successes(scene(seed, cubes, number, steps), methods)


def text(rows: Sequence[Row]) -> str:
    """Give successes with their intervals."""
    return crossed(f"A snake of {_JOINTS} universal joints, 4 m long", rows)
