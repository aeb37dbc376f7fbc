"""Reference shape curves: weights, frames and Jacobians, closest points, degree of redundancy."""

from vgtm_qp.curve.closest import ClosestPoints, closest_to_box, closest_to_point
from vgtm_qp.curve.curve import Curve, straight_curve
from vgtm_qp.curve.families import FAMILIES, CurveFamily, b_spline, beta_spline, bezier, make_family
from vgtm_qp.curve.redundancy import (
    Refit,
    add_control_vertices,
    degree_of_redundancy,
    excess_freedom,
    refit,
    remove_control_vertices,
)

__all__ = [
    "FAMILIES",
    "ClosestPoints",
    "Curve",
    "CurveFamily",
    "Refit",
    "add_control_vertices",
    "b_spline",
    "beta_spline",
    "bezier",
    "closest_to_box",
    "closest_to_point",
    "degree_of_redundancy",
    "excess_freedom",
    "make_family",
    "refit",
    "remove_control_vertices",
    "straight_curve",
]
