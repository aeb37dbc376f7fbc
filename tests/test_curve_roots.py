"""Roots in brackets and sign changes of Bernstein polynomials, against polynomials made from their roots."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vgtm_qp.curve.bernstein import basis, split
from vgtm_qp.curve.roots import Pieces, crossings, increasing_roots, minima


def from_roots(roots, sign=1.0):
    coefficients = np.array([sign])
    for root in roots:
        degree = len(coefficients)
        raised = np.zeros(degree + 1)
        for j, c in enumerate(coefficients):
            raised[j] += c * -root * (degree - j) / degree
            raised[j + 1] += c * (1.0 - root) * (j + 1) / degree
        coefficients = raised
    return Pieces(coefficients[None], np.array([0.0]), np.array([1.0]))


@example([0, 1, 7, 8], -1.0)
@settings(max_examples=80, deadline=None)
@given(st.lists(st.integers(-30, 130), min_size=1, max_size=7, unique=True), st.sampled_from([-1.0, 1.0]))
def test_simple_roots_are_all_found(hundredths, sign):
    # An odd denominator keeps roots off the cuts; roots at 0 and 1 are no change inside.
    roots = np.sort(np.array(hundredths)) / 101.0
    inside = roots[(roots > 0.0) & (roots < 1.0)]
    pieces = from_roots(roots, sign)
    np.testing.assert_allclose(np.sort(crossings(pieces)), inside, atol=1e-6)
    slopes = [np.prod(np.delete(root - roots, k)) * sign for k, root in enumerate(roots)]
    rising = roots[(np.array(slopes) > 0.0) & (roots > 0.0) & (roots < 1.0)]
    np.testing.assert_allclose(np.sort(crossings(pieces, rising_only=True)), rising, atol=1e-6)


@pytest.mark.parametrize(
    ("roots", "found"),
    [
        ([0.5, 0.25, 0.75], [0.25, 0.5, 0.75]),
        ([0.5, 0.5], []),
        ([0.25, 0.25], []),
        ([0.5, 0.5, 0.5], [0.5]),
        ([0.3, 0.3, 0.3], [0.3]),
        ([0.0, 1.0], []),
        ([0.5, 0.5, 0.2], [0.2]),
    ],
)
def test_multiple_roots_and_roots_on_cuts(roots, found):
    np.testing.assert_allclose(np.sort(crossings(from_roots(roots))), found, atol=1e-4)


def test_minima_at_ends_joints_and_on_level_stretches():
    def chain(*rows):
        n = len(rows)
        joints = np.linspace(0.0, 1.0, n + 1)
        return minima(Pieces(np.array(rows, dtype=float), joints[:-1], joints[1:]))

    np.testing.assert_array_equal(chain([1, 1], [1, 1]), [0.0])
    np.testing.assert_array_equal(chain([-1, -1], [-1, -1]), [1.0])
    np.testing.assert_array_equal(chain([-1, -2], [3, 1]), [0.5])
    np.testing.assert_array_equal(np.sort(chain([1, 1], [-1, -1])), [0.0, 1.0])
    np.testing.assert_array_equal(chain([-1, -1], [0, 0], [0, 0], [1, 1]), [0.75])
    np.testing.assert_array_equal(chain([0, 0], [1, 1]), [0.5])
    np.testing.assert_array_equal(chain([0, 0]), [1.0])
    np.testing.assert_array_equal(chain([-1, 1]), [0.5])
    np.testing.assert_array_equal(chain([-1, 0], [0, 1]), [0.5])
    np.testing.assert_array_equal(chain([-1, 0], [0, -1]), [1.0])


def test_bracketed_roots_survive_flat_falling_and_steep_functions():
    functions = {
        "cubic": (lambda x: (x - 0.3) ** 3, lambda x: 3 * (x - 0.3) ** 2, 0.3),
        "steep": (lambda x: np.arctan(1e6 * (x - 0.9)), lambda x: 1e6 / (1 + 1e12 * (x - 0.9) ** 2), 0.9),
        "wavy": (lambda x: x - 0.1 + 0.3 * np.sin(9 * x), lambda x: 1 + 2.7 * np.cos(9 * x), None),
        "at its end": (lambda x: x, lambda x: np.ones_like(x), 0.0),
    }
    for name, (value, slope, root) in functions.items():
        found = increasing_roots(
            lambda x, v=value, d=slope: (v(x), d(x)), np.array([-0.5 * (root != 0.0)]), np.array([1.0])
        )
        assert abs(value(found)) < 1e-9, name
        if root is not None:
            np.testing.assert_allclose(found, root, atol=1e-5)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 9), st.floats(0.0, 1.0))
def test_split_parts_are_the_polynomial(seed, degree, cut):
    coefficients = np.random.default_rng(seed).normal(size=degree + 1)
    left, right = split(coefficients, cut)
    u = np.linspace(0.0, 1.0, 7)
    np.testing.assert_allclose(basis(degree, u) @ left, basis(degree, cut * u) @ coefficients, atol=1e-12)
    np.testing.assert_allclose(
        basis(degree, u) @ right, basis(degree, cut + (1 - cut) * u) @ coefficients, atol=1e-12
    )
