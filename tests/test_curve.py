"""Frames, arc length and every Jacobian of a curve, against finite differences and closed forms."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.interpolate import BPoly
from scipy.spatial.transform import Rotation

from vgtm_qp.curve.curve import Curve, straight_curve
from vgtm_qp.curve.families import b_spline, bernstein, beta_spline, bezier, make_family
from vgtm_qp.errors import CurveError

FAMILIES = [
    bezier(6),
    b_spline(7, 3),
    b_spline(8, 4, [0.2, 0.3, 0.7]),
    b_spline(6, 2),
    beta_spline(6, 1.4, 2.0),
]
NODES = np.array([0.0, 0.21, 0.5, 0.83, 1.0])


def bent_curve(family, rng, torsion=2, bend=0.25):
    vertices = 4.0 * family.abscissae[:, None] * np.array([0.0, 0.0, 1.0])
    vertices = vertices + bend * rng.normal(size=vertices.shape)
    return Curve(family, vertices, rng.normal(size=torsion))


def moved(curve, step):
    size = curve.control_vertices.size
    vertices = curve.control_vertices + step[:size].reshape(-1, 3)
    return Curve(curve.family, vertices, curve.torsion + step[size:], curve.base_frame)


def differences(function, curve, h=1e-5):
    columns = []
    for step in h * np.eye(curve.coordinates):
        columns.append((function(moved(curve, step)) - function(moved(curve, -step))) / (2 * h))
    return np.stack(columns, axis=-1)


def exact_frames(curves, nodes):
    """Return frames at ascending nodes from 0 on, (curves, nodes, 3, 3), integrated from dF/ds = [w]x F."""

    def transport(s, flat):
        x, y, z = np.stack([curve.frame_rate(s) for curve in curves], axis=-1)
        skew = np.moveaxis(np.array([[0 * x, -z, y], [z, 0 * x, -x], [-y, x, 0 * x]]), -1, 0)
        return (skew @ flat.reshape(-1, 3, 3)).ravel()

    frames = [np.stack([curve.frame(nodes[0]) for curve in curves])]
    breaks = curves[0].family.breaks
    for start, end in itertools.pairwise(nodes):
        inner = breaks[(breaks > start) & (breaks < end)]
        frame = frames[-1]
        for near, far in itertools.pairwise([start, *inner, end]):
            inside = far - 1e-12
            way = solve_ivp(transport, (near, inside), frame.ravel(), method="DOP853", rtol=1e-11, atol=1e-12)
            frame = way.y[:, -1].reshape(-1, 3, 3)
        frames.append(frame)
    return np.stack(frames, axis=1)


def angular_velocity_rows(curve, nodes, h=1e-5):
    steps = h * np.eye(curve.coordinates)
    frames = exact_frames([moved(curve, step) for step in [*steps, *-steps]], nodes)
    ahead, behind = np.split(frames, 2)
    turns = (ahead @ np.swapaxes(behind, -1, -2)).reshape(-1, 3, 3)
    rows = Rotation.from_matrix(turns).as_rotvec().reshape(*ahead.shape[:2], 3) / (2 * h)
    return np.moveaxis(rows, 0, -1)


@pytest.mark.smoke
@pytest.mark.parametrize("family", FAMILIES, ids=lambda f: f"{f.name}-{f.degree}")
def test_jacobians_agree_with_differences(family, rng):
    curve = bent_curve(family, rng)
    np.testing.assert_allclose(
        curve.position_jacobian(NODES), differences(lambda c: c.position(NODES), curve), atol=1e-9
    )
    np.testing.assert_allclose(
        curve.tangent_jacobian(NODES), differences(lambda c: c.tangent(NODES), curve), atol=1e-7
    )


@pytest.mark.parametrize("family", FAMILIES, ids=lambda f: f"{f.name}-{f.degree}")
def test_orientation_jacobian_agrees_with_differences(family, rng):
    curve = bent_curve(family, rng, bend=0.1)
    rows = curve.orientation_jacobian(NODES)
    atol = 1e-6 * (1.0 + np.abs(rows).max())
    np.testing.assert_allclose(rows, angular_velocity_rows(curve, NODES), atol=atol)
    size = curve.control_vertices.size
    turn = np.einsum("kid,ki->kd", rows[..., size:], curve.tangent(NODES))
    np.testing.assert_allclose(turn[-1], [0.0, 1.0], atol=1e-14)
    np.testing.assert_allclose(turn[0], 0.0, atol=1e-14)


def test_orientation_rows_on_a_turned_base(rng):
    base = Rotation.from_rotvec([0.4, -0.3, 0.9]).as_matrix()
    free = bent_curve(bezier(5), rng)
    curve = Curve(free.family, free.control_vertices @ base.T, free.torsion, base)
    np.testing.assert_allclose(curve.frame(NODES), base @ free.frame(NODES), atol=1e-12)
    np.testing.assert_allclose(
        curve.orientation_jacobian(NODES), angular_velocity_rows(curve, NODES), atol=1e-6
    )


@pytest.mark.smoke
@settings(max_examples=25, deadline=None)
@given(st.sampled_from(FAMILIES), st.integers(0, 10**6), st.floats(0.01, 0.99))
def test_frames_are_rotations_with_the_tangent_as_third_axis(family, seed, s):
    curve = bent_curve(family, np.random.default_rng(seed))
    nodes = np.array([0.0, s, 1.0])
    frames = curve.frame(nodes)
    np.testing.assert_allclose(
        frames @ np.swapaxes(frames, -1, -2), np.broadcast_to(np.eye(3), (3, 3, 3)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, atol=1e-12)
    np.testing.assert_allclose(frames[..., 2], curve.tangent(nodes), atol=1e-12)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda f: f"{f.name}-{f.degree}")
def test_frame_rate_agrees_with_differences(family, rng):
    curve = bent_curve(family, rng)
    inner = np.array([0.13, 0.47, 0.91])
    h = 1e-5
    turn = curve.frame(inner + h) @ np.swapaxes(curve.frame(inner - h), -1, -2)
    rate = curve.frame_rate(inner)
    atol = 1e-5 * (1.0 + np.abs(rate).max())
    np.testing.assert_allclose(rate, Rotation.from_matrix(turn).as_rotvec() / (2 * h), atol=atol)


def test_frame_does_not_turn_about_the_tangent_without_torsion(rng):
    curve = bent_curve(bezier(6), rng, torsion=0)
    s = np.linspace(0.0, 1.0, 400)
    np.testing.assert_allclose(np.sum(curve.frame_rate(s) * curve.tangent(s), axis=1), 0.0, atol=1e-12)
    # A closed form: along a plane curve the frame turns about the plane's normal and keeps that normal.
    flat = Curve(bezier(4), np.array([[0, 0, 0], [0, 0, 1], [1, 0, 2], [2, 0, 1.5]], dtype=float))
    np.testing.assert_allclose(flat.frame(s)[:, :, 1], np.tile([0.0, 1.0, 0.0], (400, 1)), atol=1e-12)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda f: f"{f.name}-{f.degree}")
def test_frame_is_the_solution_of_its_differential_equation(family, rng):
    curve = bent_curve(family, rng, bend=0.05)
    np.testing.assert_allclose(curve.frame(NODES), exact_frames([curve], NODES)[0], atol=1e-5)


def test_frame_of_a_single_parameter_is_that_of_many(rng):
    curve = bent_curve(b_spline(7, 3), rng)
    many = curve.frame(np.linspace(0.0, 1.0, 41))
    np.testing.assert_allclose(curve.frame(0.525), many[21], atol=1e-14)
    assert curve.frame(np.full((2, 3), 0.5)).shape == (2, 3, 3, 3)
    assert curve.frame(np.empty(0)).shape == (0, 3, 3)


@pytest.mark.parametrize("name", ["bezier", "b-spline", "beta-spline"])
def test_straight_home_curve(name):
    curve = straight_curve(make_family(name, 6), [0.0, 0.0, 0.5], [0.0, 0.0, 4.5])
    s = np.linspace(0.0, 1.0, 9)
    np.testing.assert_allclose(curve.position(s), np.c_[0 * s, 0 * s, 0.5 + 4.0 * s], atol=1e-12)
    np.testing.assert_allclose(curve.frame(s), np.broadcast_to(np.eye(3), (9, 3, 3)), atol=1e-14)
    np.testing.assert_allclose(curve.length(s), 4.0 * s, atol=1e-12)
    roll = curve.orientation_jacobian(s)[:, 2]
    np.testing.assert_allclose(roll, 0.0, atol=1e-14)


def test_torsion_turns_the_tip_by_its_last_coordinate():
    straight = straight_curve(bezier(5), [0, 0, 0], [0, 0, 3])
    curve = Curve(straight.family, straight.control_vertices, np.array([0.2, 0.7]))
    np.testing.assert_allclose(curve.frame(1.0), Rotation.from_rotvec([0, 0, 0.7]).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(curve.frame(0.0), np.eye(3), atol=1e-14)


def test_length_of_a_parabola():
    curve = Curve(bezier(3), np.array([[0, 0, 0], [0.5, 0, 0], [1, 1, 0]], dtype=float))
    exact = np.sqrt(5.0) / 2.0 + np.arcsinh(2.0) / 4.0
    np.testing.assert_allclose(curve.length(), exact, atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(
    st.sampled_from(FAMILIES), st.integers(0, 10**6), st.lists(st.floats(0.0, 1.0), min_size=1, max_size=5)
)
def test_arc_parameters_are_at_their_fractions(family, seed, fractions):
    curve = bent_curve(family, np.random.default_rng(seed))
    s = curve.arc_parameter(fractions)
    np.testing.assert_allclose(curve.length(s), np.array(fractions) * curve.length(), atol=1e-9)


def test_arc_parameters_of_the_ends_are_exact(rng):
    curve = bent_curve(bezier(6), rng)
    np.testing.assert_array_equal(curve.arc_parameter([0.0, 1.0]), [0.0, 1.0])


@pytest.mark.parametrize("family", FAMILIES, ids=lambda f: f"{f.name}-{f.degree}")
def test_arc_nodes_move_along_the_curve_by_the_term_the_paper_omits(family, rng):
    curve = bent_curve(family, rng)
    fractions = np.array([0.0, 0.31, 0.64, 1.0])
    s = curve.arc_parameter(fractions)
    rates = curve.arc_node_rates(s)
    np.testing.assert_allclose(rates, differences(lambda c: c.arc_parameter(fractions), curve), atol=1e-6)
    whole = curve.position_jacobian(s) + curve.derivative(s)[:, :, None] * rates[:, None, :]
    np.testing.assert_allclose(
        whole, differences(lambda c: c.position(c.arc_parameter(fractions)), curve), atol=1e-6
    )
    assert np.abs(whole - curve.position_jacobian(s)).max() > 0.1


@pytest.mark.parametrize("fraction", [-0.1, 1.1, float("nan")])
def test_fractions_outside_are_refused(fraction, rng):
    with pytest.raises(CurveError, match="0 to 1"):
        bent_curve(bezier(4), rng).arc_parameter(fraction)


def test_arc_parameters_around_a_cusp_and_a_sudden_stop():
    cusp = Curve(bezier(4), np.array([[0, 0, 0], [1, 0, 1], [0, 0, 1], [1, 0, 0]], dtype=float))
    stop = Curve(bezier(5), np.array([[0, 0, 0], [0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 2]], dtype=float))
    fractions = np.linspace(0.0, 1.0, 21)
    for curve in (cusp, stop):
        s = curve.arc_parameter(fractions)
        np.testing.assert_allclose(curve.length(s), fractions * curve.length(), atol=1e-10)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Curve(bezier(4), np.zeros((5, 3))), r"shape \(4, 3\)"),
        (lambda: Curve(bezier(2), np.full((2, 3), np.nan)), "finite"),
        (lambda: Curve(bezier(2), np.zeros((2, 3))).tangent(0.5), "no tangent"),
        (lambda: Curve(bezier(2), np.zeros((2, 3))).frame_rate(0.5), "no curvature"),
        (lambda: straight_curve(b_spline(4, 1), [0, 0, 0], [0, 0, 1]).frame(0.5), "kinks"),
        (lambda: straight_curve(bezier(3), [0, 0, 1], [0, 0, 0]).frame(0.5), "against the base normal"),
    ],
)
def test_curves_without_an_answer_are_refused(build, message):
    with pytest.raises(CurveError, match=message):
        build()


@pytest.mark.parametrize("part", [1.0, 0.1, 1e-2, 1e-3, 1e-5])
def test_arc_length_is_as_exact_beside_a_cusp(part):
    # Its legs cross so that r' vanishes in the middle, but for a part that leaves the plane.
    polygon = np.array([[0.0, 0.0, 0.0], [1.0, part, 1.0], [0.0, 0.0, 1.0], [1.0, 0.3 * part, 0.0]])
    thirds = np.arange(4) / 3.0
    # A part of it: in the middle cells meet, and are as exact as they can be.
    begun = BPoly(polygon[:, None, :], [0.0, 1.0])(0.83 * thirds)
    curve = Curve(bezier(4), np.linalg.solve(bernstein(3, thirds), begun))
    whole = BPoly(curve.control_vertices[:, None, :], [0.0, 1.0]).derivative()
    fine = np.linspace(0.0, 1.0, 2001)
    fine = np.unique(np.append(fine, minimum_speed(whole) + np.outer([-1, 1], 0.7 ** np.arange(90)).ravel()))
    fine = fine[(fine >= 0.0) & (fine <= 1.0)]
    nodes, weights = np.polynomial.legendre.leggauss(12)
    points = fine[:-1, None] + 0.5 * np.diff(fine)[:, None] * (nodes + 1.0)
    pieces = 0.5 * np.diff(fine) * (np.linalg.norm(whole(points), axis=-1) @ weights)
    exact = np.append(0.0, np.cumsum(pieces))
    np.testing.assert_allclose(curve.length(fine), exact, atol=1e-10 * exact[-1])


def minimum_speed(derivative):
    low, high = 0.0, 1.0
    for _ in range(60):
        s = np.linspace(low, high, 101)
        k = int(np.argmin(np.linalg.norm(derivative(s), axis=-1)))
        low, high = s[max(k - 1, 0)], s[min(k + 1, 100)]
    return 0.5 * (low + high)
