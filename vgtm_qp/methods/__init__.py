"""Every method of the paper behind one interface: the conventional solution, the curve first, and the QP."""

from vgtm_qp.methods.select import AnyResolver, make_resolver

__all__ = ["AnyResolver", "make_resolver"]
