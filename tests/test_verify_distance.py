"""Exact distances of the verification against brute force, and separating normals against supports."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vgtm_qp.result.poses import rotation_matrix
from vgtm_qp.verify.distance import (
    segment_ball,
    segment_box,
    segment_cylinder,
    segment_segment,
    segment_triangle,
)
from vgtm_qp.verify.obstacles import Body, ball, box, cylinder, mesh

Array = NDArray[np.float64]

# Round numbers bring the degenerate cases: parallel to edges, in face planes, of no length.
coordinate = st.one_of(st.integers(-4, 4).map(lambda k: k / 2), st.floats(-2.0, 2.0, allow_subnormal=False))
point = st.tuples(coordinate, coordinate, coordinate).map(np.array)
size = st.floats(0.05, 1.0)
many = settings(max_examples=150, deadline=None)


def least_along(distance: Any, start: Array, end: Array) -> float:
    """Least of a function of points along a segment: a grid, refined three times round its best sample."""
    low, high = 0.0, 1.0
    best = np.inf
    for _ in range(6):
        share = np.linspace(low, high, 401)
        values = distance(start + share[:, None] * (end - start))
        k = int(np.argmin(values))
        best = min(best, float(values[k]))
        low, high = share[max(k - 1, 0)], share[min(k + 1, 400)]
    return best


def to_segment(points: Array, start: Array, end: Array) -> Array:
    along = end - start
    square = along @ along
    share = np.clip((points - start) @ along / square, 0.0, 1.0) if square > 0 else np.zeros(len(points))
    return np.asarray(np.linalg.norm(points - start - share[:, None] * along, axis=1))


@pytest.mark.smoke
@many
@given(point, point, st.tuples(size, size, size).map(np.array))
@example(np.array([0.0, 0.5, -0.75]), np.array([0.0, 2.0, -0.75]), np.full(3, 0.25))
def test_segment_box(start: Array, end: Array, half: Array) -> None:
    found, _ = segment_box(start[None], end[None], half)

    def outside(points: Array) -> Array:
        return np.asarray(np.linalg.norm(np.maximum(np.abs(points) - half, 0.0), axis=1))

    assert found[0] == pytest.approx(least_along(outside, start, end), abs=1e-9)


@pytest.mark.smoke
def test_segment_box_where_another_library_is_wrong() -> None:
    found, _ = segment_box(np.array([[0.0, 0.5, -0.75]]), np.array([[0.0, 2.0, -0.75]]), np.full(3, 0.25))
    assert found[0] == pytest.approx(np.hypot(0.25, 0.5), abs=1e-15)


@pytest.mark.smoke
@many
@given(point, point, size)
def test_segment_ball(start: Array, end: Array, radius: float) -> None:
    found, _ = segment_ball(start[None], end[None], radius)
    expected = max(float(to_segment(np.zeros((1, 3)), start, end)[0]) - radius, 0.0)
    assert found[0] == pytest.approx(expected, abs=1e-12)


@pytest.mark.smoke
@many
@given(point, point, size, size)
def test_segment_cylinder(start: Array, end: Array, radius: float, half: float) -> None:
    found, _ = segment_cylinder(start[None], end[None], radius, half)

    def outside(points: Array) -> Array:
        radial = np.maximum(np.hypot(points[:, 0], points[:, 1]) - radius, 0.0)
        return np.asarray(np.hypot(radial, np.maximum(np.abs(points[:, 2]) - half, 0.0)))

    assert found[0] == pytest.approx(least_along(outside, start, end), abs=1e-9)


@pytest.mark.smoke
@many
@given(point, point, point, point)
def test_segment_segment(a: Array, b: Array, c: Array, d: Array) -> None:
    found, _ = segment_segment(a[None], b[None], c[None], d[None])
    expected = least_along(lambda points: to_segment(points, c, d), a, b)
    assert found[0] == pytest.approx(expected, abs=2e-8)
    swapped, _ = segment_segment(d[None], c[None], a[None], b[None])
    assert swapped[0] == pytest.approx(found[0], abs=1e-12)


@pytest.mark.smoke
@many
@given(point, point, point, point, point)
def test_segment_triangle(a: Array, b: Array, u: Array, v: Array, w: Array) -> None:
    area = np.linalg.norm(np.cross(v - u, w - u))
    if 0.0 < area < 1e-6:
        return
    found, _ = segment_triangle(a[None], b[None], np.stack([u, v, w])[None])

    def to_triangle(points: Array) -> Array:
        edges = [to_segment(points, *side) for side in ((u, v), (v, w), (w, u))]
        best = np.min(edges, axis=0)
        if area > 0.0:
            normal = np.cross(v - u, w - u) / area
            height = (points - u) @ normal
            foot = points - height[:, None] * normal
            inside = np.ones(len(points), dtype=bool)
            for p, q in ((u, v), (v, w), (w, u)):
                inside &= np.cross(q - p, foot - p) @ normal >= 0.0
            best = np.where(inside, np.abs(height), best)
        return np.asarray(best)

    assert found[0] == pytest.approx(least_along(to_triangle, a, b), abs=2e-8)


bodies = st.sampled_from(["box", "ball", "cylinder", "mesh"])


def make(kind: str, turn: Array) -> Body:
    placed = (kind, np.zeros(3), np.zeros(3), rotation_matrix(turn))
    if kind == "box":
        return Body(*placed, box(np.array([0.3, 0.5, 0.2])))
    if kind == "ball":
        return Body(*placed, ball(0.4))
    if kind == "cylinder":
        return Body(*placed, cylinder(0.3, half_height=0.5))
    triangle = np.array([[[0.5, 0.0, 0.0], [-0.2, 0.4, 0.1], [0.0, -0.3, 0.2]]])
    return Body(*placed, mesh(triangle, closed=False))


@pytest.mark.smoke
@many
@given(bodies, point, point, point)
def test_plane_across_the_normal_separates_by_the_whole_distance(
    kind: str, turn: Array, start: Array, end: Array
) -> None:
    """The two closest points of convex bodies have a common normal: no plane can hold them further apart."""
    body = make(kind, turn)
    piece = np.zeros(1, dtype=int)
    distance, normal = body.separation(start[None], end[None], piece)
    nearest = min(float(start @ normal[0]), float(end @ normal[0]))
    apart = nearest - float(body.support(normal, piece)[0])
    assert apart <= distance[0] + 1e-12
    assert apart == pytest.approx(distance[0], abs=1e-7)


@pytest.mark.smoke
@many
@given(bodies, point, point)
def test_support_and_corners_hold_the_body(kind: str, turn: Array, normal: Array) -> None:
    body = make(kind, turn)
    support = float(body.support(normal[None], np.zeros(1, dtype=int))[0])
    hull = float((body.corners()[0] @ normal).max())
    assert support <= hull + 1e-12
    assert support >= -1e-12 or kind == "mesh"


@pytest.mark.smoke
def test_winding_number_tells_inside_from_outside() -> None:
    import trimesh

    surface = trimesh.creation.torus(1.0, 0.3, major_sections=24, minor_sections=12)
    shape = mesh(np.asarray(surface.triangles), closed=True)
    ring = Body("ring", np.zeros(3), np.zeros(3), np.eye(3), shape)
    points = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, -1.1, 0.05], [1.0, 0.0, 0.29 + 0.05]])
    assert ring.encloses(points).tolist() == [True, False, True, False]


@pytest.mark.smoke
@many
@given(point)
def test_rotation_matrix(vector: Array) -> None:
    R = rotation_matrix(vector)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(R @ vector, vector, atol=1e-14)
    angle = np.linalg.norm(vector)
    assert np.trace(R) == pytest.approx(1 + 2 * np.cos(angle), abs=1e-13)
