"""Arms and maneuvers that the studies share."""

from __future__ import annotations

from typing import Any

import numpy as np

from vgtm_qp.arm.truss.build import build_truss
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.problem import Problem

DURATION = 10.0


def bending_problem(
    bays: int,
    *,
    steps: int = 50,
    goal: tuple[float, float, float] = (0.45, 0.2, -0.3),
    module: str = "octahedral",
    vertices: int = 6,
    cubes: bool = False,
    **truss: Any,
) -> Problem:
    """Return a maneuver that takes the tip from straight up by `goal` times the arm's height.

    Parameters
    ----------
    cubes
        Two cubes beside the arm, as in the five-bay example, at the same parts of its height.
    **truss
        Further keys of the ``[truss]`` table.
    """
    data: dict[str, Any] = {
        "name": f"{bays} bays, {module}",
        "truss": {"module": module, "bays": bays, **truss},
        "curve": {"family": "bezier", "control_vertices": vertices},
        "maneuver": {"steps": steps, "waypoint": [{"time": DURATION, "position": [0.0, 0.0, 1.0]}]},
        "clearance": {"safe": 0.08, "influence": 0.5},
    }
    built = built_truss(Problem.from_dict(data))
    tip = built.tip_weights @ built.home[built.tip]
    data["maneuver"]["waypoint"][0]["position"] = (tip + built.height * np.array(goal)).tolist()
    if cubes:
        data["obstacle"] = [
            {"name": name, "shape": "box", "center": [x, 0.0, part * built.height], "size": 0.9}
            for name, x, part in (("right cube", 1.15, 0.539), ("left cube", -1.15, 0.637))
        ]
    return Problem.from_dict(data)


def built_truss(problem: Problem) -> Truss:
    """Return the truss of a problem that has one."""
    assert problem.truss is not None, "a serial arm"
    return build_truss(problem.truss)
