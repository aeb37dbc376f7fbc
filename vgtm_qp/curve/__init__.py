"""Reference shape curves: weights, frames and Jacobians, closest points, degree of redundancy."""

from vgtm_qp.curve.closest import ClosestPoints, closest_to_box, closest_to_point
from vgtm_qp.curve.curve import Curve, straight_curve
from vgtm_qp.curve.families import FAMILIES, CurveFamily, b_spline, beta_spline, bezier, make_family
from vgtm_qp.curve.linear import Conditions, NodeTables, base_conditions, node_tables, tip_condition

__all__ = [
    "FAMILIES",
    "ClosestPoints",
    "Conditions",
    "Curve",
    "CurveFamily",
    "NodeTables",
    "b_spline",
    "base_conditions",
    "beta_spline",
    "bezier",
    "closest_to_box",
    "closest_to_point",
    "make_family",
    "node_tables",
    "straight_curve",
    "tip_condition",
]
