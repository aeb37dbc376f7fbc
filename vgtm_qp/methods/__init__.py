"""Every method of the paper behind one class, ``Resolver``, whose subclasses are named here."""

from vgtm_qp.methods.conventional import ConventionalResolver
from vgtm_qp.methods.curve_first import CurveFirstResolver
from vgtm_qp.methods.presets import DEFAULT_METHODS, PRESETS, method_name, methods_for, with_method
from vgtm_qp.step.qp_resolver import QPResolver
from vgtm_qp.step.resolver import Resolver

__all__ = [
    "DEFAULT_METHODS",
    "PRESETS",
    "ConventionalResolver",
    "CurveFirstResolver",
    "QPResolver",
    "Resolver",
    "method_name",
    "methods_for",
    "with_method",
]
