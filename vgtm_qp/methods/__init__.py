"""Every method of the paper behind one interface; ``methods.compare`` compares them on the same maneuver."""

from vgtm_qp.methods.presets import DEFAULT_METHODS, PRESETS, with_method
from vgtm_qp.methods.select import make_resolver

__all__ = [
    "DEFAULT_METHODS",
    "PRESETS",
    "make_resolver",
    "with_method",
]
