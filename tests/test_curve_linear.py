"""The constant tables and the linear conditions that a quadratic program takes from a curve."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

from vgtm_qp.curve import Curve, base_conditions, make_family, node_tables, tip_condition


@pytest.mark.parametrize("name", ["bezier", "b-spline", "beta-spline"])
def test_conditions_hold_base_and_tip_and_nothing_else(name):
    family = make_family(name, 6)
    rng = np.random.default_rng(0)
    frame = Rotation.from_rotvec([0.3, 0.8, -0.2]).as_matrix()
    center, tip = rng.normal(size=3), rng.normal(size=3)
    base, end = base_conditions(6, center, frame), tip_condition(6, tip)
    matrix, value = np.vstack([base.matrix, end.matrix]), np.concatenate([base.value, end.value])
    free = null_space(matrix)
    assert free.shape[1] == 3 * 6 - 5 - 3
    p = np.linalg.lstsq(matrix, value)[0] + free @ rng.normal(size=free.shape[1])
    curve = Curve(family, p.reshape(6, 3))
    np.testing.assert_allclose(curve.position([0.0, 1.0]), [center, tip], atol=1e-12)
    np.testing.assert_allclose(np.cross(curve.tangent(0.0), frame[:, 2]), 0.0, atol=1e-12)


def test_tables_are_the_curve_at_its_nodes():
    family = make_family("b-spline", 7)
    s = np.linspace(0.0, 1.0, 6)
    curve = Curve(family, np.random.default_rng(1).normal(size=(7, 3)))
    tables = node_tables(family, s)
    for order, table in enumerate(tables):
        np.testing.assert_allclose(table @ curve.control_vertices, curve.derivative(s, order), atol=1e-12)
