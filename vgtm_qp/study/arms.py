"""Arms and maneuvers that the studies share."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np

from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.arm.truss.build import build_truss
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.arrays import Array
from vgtm_qp.errors import SolverError
from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.methods.curve_first import CurveFirstResolver
from vgtm_qp.problem import Problem
from vgtm_qp.step.setup import Setup

_TOLERANCE = 1e-11


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

    `cubes` asks for two beside the arm, at the same parts of its height as in the five-bay example. `truss`
    has further keys of the ``[truss]`` table.
    """
    data: dict[str, Any] = {
        "name": f"{bays} bays, {module}",
        "truss": {"module": module, "bays": bays, **truss},
        "curve": {"family": "bezier", "control_vertices": vertices},
        "maneuver": {"steps": steps, "waypoint": [{"time": 10.0, "position": [0.0, 0.0, 1.0]}]},
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


def moving_curve(problem: Problem) -> Iterator[CurveFirstResolver]:
    """Yield a resolver that moves its curve first, at home and after each step, with kinematics evaluated.

    Raises
    ------
    SolverError
        A step was refused; the message is the reason.
    """
    resolver = CurveFirstResolver(problem)
    plan = make_plan(problem, *resolver.tip())
    yield resolver
    for start, end in pairwise([plan.path.start, *plan.marks.tolist()]):
        if reason := resolver.follow(plan.path, start, end).reason:
            raise SolverError(reason)
        resolver.setup.kinematics.evaluate(resolver.state.nodes)
        yield resolver


def furthest(points: Array, line: Array) -> float:
    """Return the greatest distance of points (P, d) from a polygonal line (L, d), m."""
    least = np.full(len(points), np.inf)
    for start, leg in zip(line, np.diff(line, axis=0), strict=False):
        share = np.clip((points - start) @ leg / (leg @ leg), 0.0, 1.0)
        least = np.minimum(least, np.linalg.norm(points - start - share[:, None] * leg, axis=1))
    return float(least.max())


def bring_lengths(
    setup: Setup, X: Array, lengths: Array, *, tries: int, longest: float = np.inf, singular: float = 0.0
) -> bool:
    """Move the nodes `X` (N, 3) in place until all members have `lengths` (M,), m, by Newton's method.

    An iteration changes lengths by at most `longest`. Return False if the lengths are not reached after
    `tries` iterations, or if a pose in between has a least singular value below `singular`.
    """
    for _ in range(tries):
        setup.kinematics.evaluate(X)
        error = lengths - setup.kinematics.quantities
        worst = float(np.abs(error).max())
        if worst < _TOLERANCE:
            return True
        if singular and least_singular_value(setup) < singular:
            return False
        jacobian = truss_of(setup.arm).scatter.dense(setup.kinematics.gradient)
        X[setup.arm.free] += min(1.0, longest / worst) * np.linalg.solve(jacobian, error).reshape(-1, 3)
    return False


def least_singular_value(setup: Setup) -> float:
    """Return the least singular value of the length Jacobian evaluated last; 0 if that is not finite."""
    jacobian = truss_of(setup.arm).scatter.dense(setup.kinematics.gradient)
    if not np.all(np.isfinite(jacobian)):
        return 0.0
    return float(np.linalg.svd(jacobian, compute_uv=False)[-1])
