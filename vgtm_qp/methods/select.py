"""From a problem's ``[method]`` to the resolver that moves its arm."""

from __future__ import annotations

from vgtm_qp.methods.conventional import ConventionalResolver
from vgtm_qp.methods.curve_first import CurveFirstResolver
from vgtm_qp.problem import Problem
from vgtm_qp.step.mover import Mover
from vgtm_qp.step.resolver import Resolver


def make_resolver(problem: Problem) -> Mover:
    """Return what moves the arm of a problem by the method that ``problem.method`` asks for.

    Raises
    ------
    CurveError, ProblemError, SolverError, TrussError
        The arm cannot be built, or not moved by that method.
    """
    method = problem.method
    if method.name == "pseudoinverse":
        return ConventionalResolver(problem)
    if method.name == "curve-pseudoinverse" or method.tracking in ("recursive", "parallel"):
        return CurveFirstResolver(problem)
    return Resolver(problem)
