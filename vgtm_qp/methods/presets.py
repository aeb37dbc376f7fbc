"""Methods by name for comparisons: each is a set of changes to a problem's ``[method]`` table."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from types import MappingProxyType
from typing import Any

from vgtm_qp.errors import GoalError, ProblemError, nearest
from vgtm_qp.problem import Problem

_OBSTACLES = {
    "method.null_space": ["actuator_rate", "stroke_centring", "obstacle_potential"],
    "method.weights.obstacle_potential": 1e-5,
    "method.weights.stroke_centring": 2e-3,
}
_DENSE = {
    "method.name": "pseudoinverse",
    "method.algebra": "dense",
    "method.null_space": ["actuator_rate"],
    "method.correct": False,
}
_SPARSE = {**_DENSE, "method.algebra": "sparse"}
_CURVE = {
    "method.name": "curve-pseudoinverse",
    "method.tracking": "recursive",
    "method.null_space": ["curve_rate", "spacing", "smoothness"],
    "method.correct": False,
}
_CORRECTED = {"method.correct": True}
_CURVE_OBSTACLES = {
    "method.tracking": "parallel",
    "method.null_space": ["curve_rate", "spacing", "smoothness", "obstacle_potential"],
    "method.gains.obstacle_potential": 1e-4,
}

_CHANGES: dict[str, dict[str, Any]] = {
    "qp": {"method.name": "qp", "method.tracking": "coupled"},
    "qp-osqp": {"method.name": "qp", "method.tracking": "coupled", "method.solver": "osqp"},
    "qp-none": {"method.name": "qp", "method.tracking": "none"},
    "qp-recursive": {"method.name": "qp", "method.tracking": "recursive"},
    "qp-parallel": {"method.name": "qp", "method.tracking": "parallel"},
    "pseudoinverse": _DENSE,
    "pseudoinverse-plain": {**_DENSE, "method.null_space": []},
    "pseudoinverse-weighted": {**_DENSE, "method.variant": "weighted"},
    "pseudoinverse-damped": {**_DENSE, "method.variant": "damped"},
    "pseudoinverse-truncated": {**_DENSE, "method.variant": "truncated"},
    "pseudoinverse-sparse": _SPARSE,
    "pseudoinverse-corrected": {**_SPARSE, **_CORRECTED},
    "pseudoinverse-obstacles": {**_SPARSE, **_CORRECTED, **_OBSTACLES},
    "curve-pseudoinverse": _CURVE,
    "curve-pseudoinverse-plain": {**_CURVE, "method.null_space": []},
    "curve-pseudoinverse-parallel": {**_CURVE, "method.tracking": "parallel"},
    "curve-pseudoinverse-corrected": {**_CURVE, **_CORRECTED},
    "curve-pseudoinverse-obstacles": {**_CURVE, **_CORRECTED, **_CURVE_OBSTACLES},
}
_PLAIN = {
    "method.tracking": "coupled",
    "method.variant": "moore-penrose",
    "method.algebra": "dense",
    "method.correct": False,
    "method.null_space": None,
}

PRESETS = MappingProxyType({name: {**_PLAIN, **changes} for name, changes in _CHANGES.items()})
"""Changes by name. ``-plain`` has no null-space vector; ``-corrected`` and ``-obstacles`` correct the drift.

All solve their QPs by the problem's own solver, ``-osqp`` excepted."""

DEFAULT_METHODS = (
    "qp",
    "qp-osqp",
    "qp-none",
    "qp-recursive",
    "pseudoinverse",
    "pseudoinverse-corrected",
    "pseudoinverse-obstacles",
    "curve-pseudoinverse",
    "curve-pseudoinverse-corrected",
    "curve-pseudoinverse-obstacles",
)


def with_method(problem: Problem, name: str) -> Problem:
    """Return the problem with the method `name`; weights, gains and keys stay if that method has them.

    Raises
    ------
    GoalError
        There is no method of that name.
    ProblemError
        The problem contradicts it.
    """
    check_methods([name])
    changes = PRESETS[name]
    kept = problem.method.kept_by(changes["method.name"], changes.get("method.tracking", "coupled"))
    return problem.replace({"method": kept, **changes})


def methods_for(problem: Problem) -> dict[str, Problem]:
    """Return the methods that can move the arm of a problem, by name, each with the problem that asks for it."""
    found = {}
    for name in PRESETS:
        with suppress(ProblemError):
            found[name] = with_method(problem, name)
    return found


def method_name(problem: Problem) -> str:
    """Return the preset with the keys of a problem's method, or ``method.name`` if there is none."""
    own = problem.method
    same = [name for name, other in methods_for(problem).items() if other.method == own]
    return next(reversed(same), own.name)


def check_methods(names: Sequence[str]) -> None:
    """Raise GoalError if `names` is empty, is one text and not a list, or has a name that no method has."""
    if isinstance(names, str):
        raise GoalError(f'methods must be a list of names, not one text: ["{names}"]')
    if not names:
        raise GoalError(f"methods must name at least one method; choices: {', '.join(PRESETS)}")
    for name in names:
        if name not in PRESETS:
            raise GoalError(f'no method "{name}"{nearest(name, PRESETS)}; choices: {", ".join(PRESETS)}')
