"""Every method of the paper behind one interface, and their comparison on the same maneuver."""

from vgtm_qp.methods.compare import Report, Row, compare
from vgtm_qp.methods.presets import DEFAULT_METHODS, PRESETS, with_method
from vgtm_qp.methods.select import AnyResolver, make_resolver

__all__ = [
    "DEFAULT_METHODS",
    "PRESETS",
    "AnyResolver",
    "Report",
    "Row",
    "compare",
    "make_resolver",
    "with_method",
]
