"""Every method of the paper behind one interface, ``step.mover.Mover``."""

from vgtm_qp.methods.conventional import ConventionalResolver
from vgtm_qp.methods.curve_first import CurveFirstResolver
from vgtm_qp.methods.presets import DEFAULT_METHODS, PRESETS, with_method
from vgtm_qp.problem import Problem
from vgtm_qp.step.mover import Mover
from vgtm_qp.step.resolver import Resolver

__all__ = ["DEFAULT_METHODS", "PRESETS", "make_resolver", "with_method"]


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
