"""Closest points against dense sampling: every local minimum is found, and nothing else is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vgtm_qp.curve.closest import closest_to_box, closest_to_point
from vgtm_qp.curve.curve import Curve, straight_curve
from vgtm_qp.curve.families import b_spline, beta_spline, bezier
from vgtm_qp.errors import CurveError

FAMILIES = [
    bezier(2),
    bezier(4),
    bezier(7),
    b_spline(8, 3),
    b_spline(7, 1),
    b_spline(7, 4),
    beta_spline(7, 2.0, 3.0),
]
DENSE = np.linspace(0.0, 1.0, 20001)


def box_distance(points, center, size, rotation):
    excess = np.abs((points - center) @ rotation) - np.broadcast_to(size, 3) / 2
    return np.linalg.norm(np.maximum(excess, 0.0), axis=-1) + np.minimum(excess.max(axis=-1), 0.0)


def sampled_minima(distance):
    padded = np.concatenate([[np.inf], distance, [np.inf]])
    return DENSE[(distance < padded[:-2]) & (distance <= padded[2:])]


def assert_all_minima(curve, closest, distance_to):
    values = distance_to(curve.position(DENSE))
    np.testing.assert_allclose(distance_to(closest.position), closest.distance, atol=1e-12)
    np.testing.assert_allclose(curve.position(closest.s), closest.position, atol=1e-14)
    np.testing.assert_allclose(
        np.linalg.norm(closest.position - closest.witness, axis=1), np.abs(closest.distance), atol=1e-12
    )
    assert np.all(np.diff(closest.distance) >= 0.0)
    assert closest.distance[0] <= values.min() + 1e-12
    for s in sampled_minima(values):
        assert np.abs(closest.s - s).min() < 2.0 / len(DENSE)
    # Polygons may have minima that are narrower than a thousandth.
    for side in (-1e-6, 1e-6):
        around = distance_to(curve.position(np.clip(closest.s + side, 0.0, 1.0)))
        assert np.all(around >= closest.distance - 1e-12)


@settings(max_examples=80, deadline=None)
@given(st.sampled_from(FAMILIES), st.integers(0, 10**6))
def test_all_closest_points_to_a_point(family, seed):
    rng = np.random.default_rng(seed)
    curve = Curve(family, rng.normal(size=(family.control_vertices, 3)))
    point = rng.normal(size=3)
    closest = closest_to_point(curve, point)
    assert_all_minima(curve, closest, lambda r: np.linalg.norm(r - point, axis=-1))
    inner = (closest.s > 0.0) & (closest.s < 1.0)
    if family.smooth and family.bias == 1.0:
        foot = np.sum((closest.position - point) * curve.derivative(closest.s), axis=1)[inner]
        np.testing.assert_allclose(foot, 0.0, atol=1e-10)


@settings(max_examples=80, deadline=None)
@given(st.sampled_from(FAMILIES), st.integers(0, 10**6), st.booleans())
def test_all_closest_points_to_a_box(family, seed, turned):
    rng = np.random.default_rng(seed)
    curve = Curve(family, 1.5 * rng.normal(size=(family.control_vertices, 3)))
    center, size = rng.normal(size=3), rng.uniform(0.2, 2.0, size=3)
    rotation = Rotation.random(rng=rng).as_matrix() if turned else np.eye(3)
    closest = closest_to_box(curve, center, size, rotation)
    assert_all_minima(curve, closest, lambda r: box_distance(r, center, size, rotation))


@pytest.mark.smoke
def test_straight_curve_beside_and_through_a_box():
    curve = straight_curve(bezier(6), [0, 0, 0], [0, 0, 4])
    beside = closest_to_box(curve, [1.15, 0, 2.2], 0.9)
    np.testing.assert_allclose(beside.distance, [0.7], atol=1e-12)
    assert 1.75 - 1e-12 <= beside.position[0, 2] <= 2.65 + 1e-12
    tied = closest_to_box(curve, [0.1, 0, 2.0], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(tied.distance, [-0.4], atol=1e-12)
    # Where the depth stays the same for a stretch, its end has the side and the lid of the box equally near.
    np.testing.assert_allclose(np.linalg.norm(tied.witness - tied.position, axis=1), [0.4], atol=1e-12)
    through = closest_to_box(curve, [0.1, 0, 2.0], [1.0, 2.0, 6.0])
    np.testing.assert_allclose(through.distance, [-0.4], atol=1e-12)
    np.testing.assert_allclose(through.witness[0, 0], -0.4, atol=1e-12)
    corner = closest_to_box(curve, [1.0, 1.0, 2.0], 1.0, Rotation.from_rotvec([0, 0, np.pi / 4]).as_matrix())
    np.testing.assert_allclose(corner.distance, [np.sqrt(2.0) - 0.5], atol=1e-12)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda f: f"{f.name}-{f.degree}")
@pytest.mark.parametrize("s", [0.0, 0.5, 0.37, 1.0])
def test_point_on_the_curve_is_found_at_distance_zero(family, s, rng):
    curve = Curve(family, rng.normal(size=(family.control_vertices, 3)))
    closest = closest_to_point(curve, curve.position(s))
    np.testing.assert_allclose(closest.distance[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(closest.s[0], s, atol=1e-7)


def test_every_root_of_symmetric_curves_is_found():
    # The foot is in the very middle of the segment, where halving puts its cut: a maximum between two minima.
    arch = Curve(bezier(4), np.array([[-1, 0, 0], [-1, 0, 2], [1, 0, 2], [1, 0, 0]], dtype=float))
    below = closest_to_point(arch, [0.0, 0.0, -3.0])
    np.testing.assert_allclose(below.s, [0.0, 1.0])
    above = closest_to_point(arch, [0.0, 0.0, 3.0])
    np.testing.assert_allclose(above.s, [0.5], atol=1e-12)
    np.testing.assert_allclose(above.distance, [1.5], atol=1e-12)


def test_perpendicular_end_is_no_minimum_when_the_curve_goes_on_towards_the_point():
    # At s = 0 the derivative of the distance is zero and then negative.
    curve = Curve(bezier(3), np.array([[0, 0, 0], [1, 0, 0], [2, 1, 0]], dtype=float))
    assert closest_to_point(curve, [0.0, 5.0, 0.0]).s.min() > 0.0


def test_flat_quartic_minimum_is_found_once():
    # |r - q| = 1 + O(s - 1/2)^4: a triple root of its derivative.
    parabola = Curve(bezier(3), np.array([[-1, 1, 0], [0, -1, 0], [1, 1, 0]], dtype=float))
    closest = closest_to_point(parabola, [0.0, 0.5, 0.0])
    assert closest.s.shape == (1,)
    np.testing.assert_allclose(closest.s, 0.5, atol=1e-5)
    np.testing.assert_allclose(closest.distance, 0.5, atol=1e-12)


@pytest.mark.parametrize(
    ("query", "message"),
    [
        (lambda c: closest_to_point(c, [0, 0]), "the point"),
        (lambda c: closest_to_point(c, [0, 0, np.nan]), "the point"),
        (lambda c: closest_to_box(c, [0, 0, np.inf], 1.0), "the center"),
        (lambda c: closest_to_box(c, [0, 0, 0], [1, 1, 0]), "greater than 0"),
    ],
)
def test_wrong_obstacles_are_refused(query, message):
    with pytest.raises(CurveError, match=message):
        query(straight_curve(bezier(4), [0, 0, 0], [0, 0, 1]))
