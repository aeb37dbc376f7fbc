"""The weights of every curve family: eqs. (29)-(30), ends, hull, continuity, other definitions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from vgtm_qp.curve.families import b_spline, beta_spline, bezier, make_family
from vgtm_qp.errors import CurveError

S = np.linspace(0.0, 1.0, 201)


@st.composite
def families(draw, most=9):
    name = draw(st.sampled_from(["bezier", "b-spline", "beta-spline"]))
    if name == "bezier":
        return bezier(draw(st.integers(2, most)))
    if name == "beta-spline":
        return beta_spline(draw(st.integers(2, most)), draw(st.floats(0.3, 3.0)), draw(st.floats(0.0, 10.0)))
    degree = draw(st.integers(1, 4))
    count = draw(st.integers(0, most - degree - 1))
    interior = sorted(draw(st.lists(st.integers(1, 9), min_size=count, max_size=count, unique=True)))
    return b_spline(degree + 1 + count, degree, np.array(interior, dtype=float) / 10.0)


@settings(max_examples=60, deadline=None)
@given(families())
def test_weights_are_a_partition_of_unity_without_negative_weights(family):
    table = family.weights(S)
    assert table.shape == (201, family.control_vertices)
    assert np.all(table >= 0.0)
    np.testing.assert_allclose(table.sum(axis=1), 1.0, atol=1e-14)
    for order in (1, 2):
        np.testing.assert_allclose(family.weights(S, order).sum(axis=1), 0.0, atol=1e-10)
    np.testing.assert_array_equal(table[0], np.eye(family.control_vertices)[0])
    np.testing.assert_allclose(table[-1], np.eye(family.control_vertices)[-1], atol=1e-15)


@settings(max_examples=40, deadline=None)
@given(families(), st.integers(0, 10**6))
def test_curve_is_in_the_hull_of_its_vertices(family, seed):
    rng = np.random.default_rng(seed)
    vertices = rng.normal(size=(family.control_vertices, 3))
    directions = rng.normal(size=(3, 50))
    reach = (family.weights(S) @ vertices) @ directions
    assert np.all(reach <= (vertices @ directions).max(axis=0) + 1e-12)


@settings(max_examples=40, deadline=None)
@given(families())
def test_derivative_tables_agree_with_differences(family):
    inner = (family.breaks[:-1, None] + np.diff(family.breaks)[:, None] * np.array([0.13, 0.5, 0.81])).ravel()
    h = 1e-6
    for order in (0, 1):
        difference = (family.weights(inner + h, order) - family.weights(inner - h, order)) / (2 * h)
        exact = family.weights(inner, order + 1)
        np.testing.assert_allclose(difference, exact, atol=1e-6 * max(1.0, np.abs(exact).max()))


@settings(max_examples=40, deadline=None)
@given(families())
def test_vertices_at_the_abscissae_of_a_line_give_the_line(family):
    assert np.all(np.diff(family.abscissae) > 0.0)
    s = family.weights(S) @ family.abscissae
    assert np.all(np.diff(s) > 0.0)
    if (family.bias, family.tension) == (1.0, 0.0):
        np.testing.assert_allclose(s, S, atol=1e-13)


@pytest.mark.parametrize(("bias", "tension", "deviation"), [(2.0, 0.0, 0.06), (1.0, 10.0, 0.01)])
def test_beta_spline_deviates_from_a_linear_parameter_only_a_little(bias, tension, deviation):
    family = beta_spline(7, bias, tension)
    worst = np.abs(family.weights(S) @ family.abscissae - S).max()
    assert 1e-4 < worst < deviation


@pytest.mark.parametrize("degree", [1, 2, 3, 5])
@pytest.mark.parametrize("interior", [None, [0.1, 0.4, 0.45, 0.9]])
def test_b_spline_is_scipys(degree, interior):
    family = b_spline(degree + 5, degree, interior)
    for order in range(3):
        basis = BSpline(family.knots, np.eye(family.control_vertices), degree)
        expected = (basis.derivative(order) if order else basis)(S[:-1]) if order <= degree else 0.0
        np.testing.assert_allclose(family.weights(S[:-1], order), expected, atol=1e-9)


def test_repeated_knots_are_scipys_and_lose_smoothness():
    family = b_spline(8, 3, [0.3, 0.3, 0.6, 0.6])
    assert family.smooth
    basis = BSpline(family.knots, np.eye(8), 3)
    np.testing.assert_allclose(family.weights(S), basis(S), atol=1e-14)
    assert not b_spline(8, 3, [0.3, 0.3, 0.3, 0.6]).smooth


@settings(max_examples=30, deadline=None)
@given(st.integers(3, 8), st.floats(0.3, 3.0), st.floats(0.0, 10.0))
def test_beta_spline_is_geometrically_continuous(vertices, bias, tension):
    family = beta_spline(vertices, bias, tension)
    joints = family.breaks[1:-1]
    # Third-order polynomials: the values just before a joint follow from the segment's own derivatives.
    h = 1e-3 / (vertices - 1)
    before = [family.weights(joints - h, order) for order in range(4)]
    left0 = before[0] + h * before[1] + h**2 / 2 * before[2] + h**3 / 6 * before[3]
    left1 = before[1] + h * before[2] + h**2 / 2 * before[3]
    left2 = before[2] + h * before[3]
    segment = 1.0 / (vertices - 1)
    np.testing.assert_allclose(family.weights(joints), left0, atol=1e-12)
    np.testing.assert_allclose(family.weights(joints, 1), bias * left1, atol=1e-9)
    np.testing.assert_allclose(
        family.weights(joints, 2) * segment**2,
        (bias**2 * left2) * segment**2 + tension * left1 * segment,
        atol=1e-9,
    )


def test_beta_spline_without_bias_and_tension_is_the_uniform_cubic_b_spline():
    vertices = 8
    family = beta_spline(vertices)
    # The phantom vertices touch only the first and the last segment.
    knots = np.arange(-2, vertices + 2, dtype=float) / (vertices - 1)
    uniform = BSpline(knots, np.eye(vertices), 3, extrapolate=False)
    s = np.linspace(family.breaks[1], family.breaks[-2], 101)[:-1]
    np.testing.assert_allclose(family.weights(s), uniform(s), atol=1e-13)


def test_beta_spline_leaves_along_the_legs_of_its_polygon():
    family = beta_spline(6, 1.7, 3.0)
    start, end = family.weights(0.0, 1), family.weights(1.0, 1)
    np.testing.assert_allclose(start[2:], 0.0, atol=1e-14)
    np.testing.assert_allclose(end[:-2], 0.0, atol=1e-14)
    assert start[1] > 0.0 > end[-2]


def test_shapes_follow_the_parameter():
    family = make_family("bezier", 5)
    assert family.weights(0.3).shape == (5,)
    assert family.weights([0.3]).shape == (1, 5)
    assert family.weights(np.full((2, 3), 0.3)).shape == (2, 3, 5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": "beizer", "control_vertices": 5}, 'did you mean "bezier".*bezier, b-spline, beta-spline'),
        ({"name": "bezier", "control_vertices": 1}, "at least 2"),
        ({"name": "b-spline", "control_vertices": 3}, "at least 4"),
        ({"name": "b-spline", "control_vertices": 3, "degree": 0}, "1 or more"),
        ({"name": "beta-spline", "control_vertices": 5, "bias": 0.0}, "greater than 0"),
        ({"name": "beta-spline", "control_vertices": 5, "tension": -1.0}, "0 or more"),
        ({"name": "beta-spline", "control_vertices": 5, "tension": float("nan")}, "0 or more"),
    ],
)
def test_wrong_families_are_refused(arguments, message):
    with pytest.raises(CurveError, match=message):
        make_family(**arguments)


@pytest.mark.parametrize("interior", [[0.5], [0.5, 0.4], [0.0, 0.5], [0.5, float("nan")]])
def test_wrong_knots_are_refused(interior):
    with pytest.raises(CurveError, match="interior knots"):
        b_spline(6, 3, interior)


def test_knots_that_tear_the_curve_are_refused():
    with pytest.raises(CurveError, match="repeated"):
        b_spline(6, 2, [0.5, 0.5, 0.5])


@pytest.mark.parametrize("s", [-0.1, 1.1, float("nan"), [0.2, 1.5]])
def test_parameters_outside_the_curve_are_refused(s):
    with pytest.raises(CurveError, match="0 <= s <= 1"):
        bezier(4).weights(s)
