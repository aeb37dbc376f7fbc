"""More and fewer control vertices for the same shape, and the counts of freedom."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from vgtm_qp.curve.curve import Curve, straight_curve
from vgtm_qp.curve.families import b_spline, beta_spline, bezier
from vgtm_qp.curve.redundancy import (
    add_control_vertices,
    degree_of_redundancy,
    excess_freedom,
    refit,
    remove_control_vertices,
)
from vgtm_qp.errors import CurveError

S = np.linspace(0.0, 1.0, 301)
EXACT = [
    bezier(3),
    bezier(6),
    b_spline(6, 3),
    b_spline(7, 2),
    b_spline(9, 3, [0.1, 0.5, 0.5, 0.6, 0.9]),
    b_spline(5, 4),
]
FAMILIES = [*EXACT, beta_spline(6), beta_spline(7, 1.5, 2.0)]


def bent_curve(family, seed, bend=0.3):
    rng = np.random.default_rng(seed)
    vertices = 4.0 * family.abscissae[:, None] * np.array([0.0, 0.0, 1.0])
    return Curve(family, vertices + bend * rng.normal(size=vertices.shape), rng.normal(size=2))


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(EXACT), st.integers(0, 10**6), st.integers(0, 4))
def test_adding_control_vertices_does_not_move_the_curve(family, seed, count):
    curve = bent_curve(family, seed)
    raised, change = add_control_vertices(curve, count)
    assert raised.family.control_vertices == family.control_vertices + count
    assert raised.family.name == family.name
    assert change < 1e-12
    for order in (0, 1):
        np.testing.assert_allclose(raised.derivative(S, order), curve.derivative(S, order), atol=1e-10)


@pytest.mark.parametrize("family", EXACT, ids=lambda f: f"{f.name}-{f.degree}")
def test_adding_control_vertices_does_not_turn_the_frame(family):
    # A gentle bend: frames are exact to fourth order of a step, and the steps change with the breaks.
    curve = bent_curve(family, 1, bend=0.03)
    np.testing.assert_allclose(add_control_vertices(curve, 3).curve.frame(S), curve.frame(S), atol=1e-7)


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(EXACT), st.integers(0, 10**6), st.integers(1, 3))
def test_removing_what_was_added_gives_the_old_curve_back(family, seed, count):
    curve = bent_curve(family, seed)
    lowered, change = remove_control_vertices(add_control_vertices(curve, count).curve, count)
    assert change < 1e-9
    assert lowered.family.control_vertices == family.control_vertices
    np.testing.assert_allclose(lowered.position(S), curve.position(S), atol=1e-9)


@settings(max_examples=25, deadline=None)
@given(st.sampled_from([family for family in FAMILIES if family.control_vertices > 4]), st.integers(0, 10**6))
@example(bezier(6), 131072)  # A hundred samples missed the greatest change by a thousandth.
def test_removal_keeps_ends_and_base_tangent_and_reports_the_change(family, seed):
    curve = bent_curve(family, seed)
    lowered, change = remove_control_vertices(curve, 2)
    assert lowered.family.control_vertices == family.control_vertices - 2
    np.testing.assert_allclose(lowered.position([0.0, 1.0]), curve.position([0.0, 1.0]), atol=1e-12)
    np.testing.assert_allclose(lowered.tangent(0.0), curve.tangent(0.0), atol=1e-12)
    np.testing.assert_array_equal(lowered.torsion, curve.torsion)
    moved = np.linalg.norm(lowered.position(S) - curve.position(S), axis=1).max()
    assert moved * (1 - 1e-9) <= change * (1 + 1e-3)
    assert 0.0 < change < 2.0


@pytest.mark.parametrize(
    "family", [bezier(5), b_spline(5, 3), beta_spline(5, 1.4, 1.0)], ids=lambda f: f.name
)
def test_refit_is_the_least_squares_fit(family):
    curve = bent_curve(bezier(9), 3)
    fitted = refit(curve, family).curve
    s = (np.arange(2000) + 0.5) / 2000
    table, goal = family.weights(s), curve.position(s)
    start, end, tangent = curve.position(0.0), curve.position(1.0), curve.tangent(0.0)

    def vertices(z):
        return np.vstack([start, start + z[0] * tangent, z[1:].reshape(-1, 3), end])

    def residual(z):
        return np.mean(np.sum((table @ vertices(z) - goal) ** 2, axis=1))

    best = minimize(residual, np.concatenate([[1.0], curve.control_vertices[[3, 6]].ravel()]), tol=1e-14)
    p = fitted.control_vertices
    mine = np.mean(np.sum((table @ p - goal) ** 2, axis=1))
    assert mine <= best.fun * (1 + 1e-5)
    assert mine > 1e-6


def test_adding_to_a_beta_spline_says_how_far_it_moved():
    curve = bent_curve(beta_spline(6, 1.5, 1.0), 2)
    raised, change = add_control_vertices(curve, 3)
    assert raised.family.control_vertices == 9
    assert (raised.family.bias, raised.family.tension) == (1.5, 1.0)
    moved = np.linalg.norm(raised.position(S) - curve.position(S), axis=1).max()
    assert 1e-4 < moved <= change * 1.001
    np.testing.assert_allclose(raised.position([0.0, 1.0]), curve.position([0.0, 1.0]), atol=1e-12)


def test_conversion_is_exact_where_the_other_family_holds_the_curve():
    curve = bent_curve(bezier(4), 5)
    for family in (bezier(6), b_spline(8, 3), b_spline(7, 5)):
        assert refit(curve, family).change < 1e-10
    assert refit(curve, beta_spline(8)).change < 0.1


def test_refit_never_turns_the_base_tangent_around():
    # A hairpin right at the base: with three vertices, plain least squares would put p_1 behind the base.
    vertices = np.array(
        [[0, 0, 0], [0, 0, 0.01], [0, 0, -3], [0.5, 0, -3], [1, 0, -3], [1, 0, -1]], dtype=float
    )
    curve = Curve(bezier(6), vertices)
    lowered, change = remove_control_vertices(curve, 3)
    np.testing.assert_allclose(lowered.tangent(0.0), [0.0, 0.0, 1.0], atol=1e-12)
    assert change > 0.1


@pytest.mark.parametrize("vertices", [4, 6, 9])
def test_degree_of_redundancy_is_the_null_space_of_the_conditions(vertices):
    # p_0 in its place, p_1 across the base normal, the last one at the tip.
    matrix = np.eye(3 * vertices)[[0, 1, 2, 3, 4, -3, -2, -1]]
    assert degree_of_redundancy(vertices, 3) == matrix.shape[1] - np.linalg.matrix_rank(matrix)
    assert degree_of_redundancy(vertices, 6, torsion_vertices=2) == degree_of_redundancy(vertices, 3) - 1


def test_excess_freedom_is_named_with_its_number():
    assert excess_freedom(13, 15) is None
    assert excess_freedom(15, 15) is None
    warning = excess_freedom(19, 15)
    assert "19 degrees of freedom" in warning
    assert "the arm 15" in warning
    assert "4 without effect" in warning


@pytest.mark.parametrize(
    "change",
    [
        lambda c: remove_control_vertices(c, 2),
        lambda c: remove_control_vertices(c, -1),
        lambda c: add_control_vertices(c, -1),
        lambda c: refit(c, bezier(2)),
    ],
)
def test_impossible_changes_are_refused(change):
    with pytest.raises(CurveError, match="control vertices"):
        change(straight_curve(bezier(4), [0, 0, 0], [0, 0, 1]))
