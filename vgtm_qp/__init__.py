"""Moves highly redundant arms through clutter: one quadratic program a step, every step certified."""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from vgtm_qp.errors import (
    CurveError,
    ExportError,
    GoalError,
    MissingExtraError,
    Mistake,
    PartError,
    ProblemError,
    ResultError,
    SolverError,
    TrussError,
    VgtmError,
)

if TYPE_CHECKING:
    from vgtm_qp.arm.truss.build import build_truss
    from vgtm_qp.arm.truss.mobility import describe
    from vgtm_qp.arm.truss.truss import Truss
    from vgtm_qp.certify.certify import Certifier, certify
    from vgtm_qp.certify.verdict import Finding, Verdict
    from vgtm_qp.comparison.compare import Report, compare
    from vgtm_qp.export import export_maneuver
    from vgtm_qp.maneuver.maneuver import Maneuver, load_result
    from vgtm_qp.maneuver.recording import Recording
    from vgtm_qp.maneuver.solve import solve, solve_many
    from vgtm_qp.methods import Resolver
    from vgtm_qp.parts import register
    from vgtm_qp.problem import Problem, bundled_problems, load_problem, problem_schema
    from vgtm_qp.problem.obstacle import Box, Cylinder, Mesh, Sphere, obstacles
    from vgtm_qp.qp.terms import Inequality, Objective
    from vgtm_qp.result.certificate import Certificate, Measure
    from vgtm_qp.step.step import Step, StepStatus
    from vgtm_qp.verify import verify, verify_file

_HOMES = {
    "vgtm_qp.certify.certify": ("Certifier", "certify"),
    "vgtm_qp.certify.verdict": ("Finding", "Verdict"),
    "vgtm_qp.export": ("export_maneuver",),
    "vgtm_qp.qp.terms": ("Inequality", "Objective"),
    "vgtm_qp.result.certificate": ("Certificate", "Measure"),
    "vgtm_qp.maneuver.maneuver": ("Maneuver", "load_result"),
    "vgtm_qp.maneuver.recording": ("Recording",),
    "vgtm_qp.maneuver.solve": ("solve", "solve_many"),
    "vgtm_qp.comparison.compare": ("Report", "compare"),
    "vgtm_qp.problem": ("Problem", "bundled_problems", "load_problem", "problem_schema"),
    "vgtm_qp.problem.obstacle": ("Box", "Cylinder", "Mesh", "Sphere", "obstacles"),
    "vgtm_qp.methods": ("Resolver",),
    "vgtm_qp.parts": ("register",),
    "vgtm_qp.step.step": ("Step", "StepStatus"),
    "vgtm_qp.arm.truss.build": ("build_truss",),
    "vgtm_qp.arm.truss.mobility": ("describe",),
    "vgtm_qp.arm.truss.truss": ("Truss",),
    "vgtm_qp.verify": ("verify", "verify_file"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "Box",
    "Certificate",
    "Certifier",
    "CurveError",
    "Cylinder",
    "ExportError",
    "Finding",
    "GoalError",
    "Inequality",
    "Maneuver",
    "Measure",
    "Mesh",
    "MissingExtraError",
    "Mistake",
    "Objective",
    "PartError",
    "Problem",
    "ProblemError",
    "Recording",
    "Report",
    "Resolver",
    "ResultError",
    "SolverError",
    "Sphere",
    "Step",
    "StepStatus",
    "Truss",
    "TrussError",
    "Verdict",
    "VgtmError",
    "build_truss",
    "bundled_problems",
    "certify",
    "compare",
    "describe",
    "export_maneuver",
    "load_problem",
    "load_result",
    "obstacles",
    "problem_schema",
    "register",
    "solve",
    "solve_many",
    "verify",
    "verify_file",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that ``vgtm --help`` pays for none of them (PEP 562)."""
    if name == "__version__":
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("vgtm-qp")
        except PackageNotFoundError:
            # A source tree that was never installed.
            return "0+unknown"
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it has {', '.join(__all__)}")
    value = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]


class _Package(ModuleType):
    """Keeps the function ``vgtm_qp.verify`` where the import system would put the package of that name."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name in _HOME_OF and isinstance(value, ModuleType):
            return
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
