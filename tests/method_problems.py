"""Small free maneuvers of every module, for the tests of the methods."""

from __future__ import annotations

from typing import Any

import numpy as np

from vgtm_qp.arm.truss.build import build_truss
from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.methods import Resolver
from vgtm_qp.problem import Problem

MODULES: dict[str, dict[str, Any]] = {
    "octahedral": {"module": "octahedral", "bays": 5},
    "octahedral with offset joints": {"module": "octahedral", "bays": 4, "joint_offset": 0.1},
    "double-octahedral": {"module": "double-octahedral", "bays": 3},
    "hexapod": {"module": "hexapod", "bays": 4},
    "longeron": {"module": "longeron", "bays": 5},
    "tetrahedral": {"module": "tetrahedral", "bays": 4},
    "tetrahedral, two actuated": {"module": "tetrahedral", "bays": 4, "actuated": [2, 3]},
    "tetrahedral, one actuated": {"module": "tetrahedral", "bays": 4, "actuated": [1]},
}


def free_problem(module: str, *, steps: int = 20, **method: Any) -> Problem:
    """A maneuver that bends the arm a little, with no obstacle and no limit that is met."""
    if method.get("name") == "pseudoinverse":
        method.pop("tracking", None)
    truss = {"stroke": [0.2, 3.0], **MODULES[module]}
    data: dict[str, Any] = {
        "truss": truss,
        "curve": {"family": "bezier", "control_vertices": 5},
        "clearance": {"self_collision": False},
        "method": method,
        "maneuver": {"steps": steps, "waypoint": [{"time": 1.0, "position": [0.0, 0.0, 1.0]}]},
    }
    built = build_truss(Problem.from_dict(data).truss)
    tip = built.tip_weights @ built.home[built.tip]
    goal = tip + np.array([0.12, 0.07, -0.05]) * built.height
    data["maneuver"]["waypoint"][0]["position"] = goal.tolist()
    return Problem.from_dict(data)


def run(resolver: Resolver, problem: Problem, steps: int | None = None) -> list[np.ndarray]:
    """Move along the problem's path; return the node positions after each step."""
    plan = make_plan(problem, *resolver.tip())
    value, states = plan.path.start, []
    for mark in plan.marks[:steps]:
        step = resolver.follow(plan.path, value, float(mark))
        assert step.progress == 1.0, step.reason
        value = float(mark)
        states.append(np.array(resolver.state.nodes))
    return states
