"""Exact distances of segments in plain NumPy, each with the direction in which the two bodies are apart.

Every function takes P pairs and returns ``distance (P,)``, m, and ``normal (P, 3)``: the unit vector from the
closest point of the second body to that of the segment, or zero if they touch.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array

DistanceAndNormal = tuple[Array, Array]


def segment_box(start: Array, end: Array, half: Array) -> DistanceAndNormal:
    """Segments against the solid boxes |x_i| <= half_i; `half` is (3,) or (P, 3), m.

    The squared distance is convex and piecewise quadratic along the segment, with a break wherever the
    segment crosses a face plane. Between two breaks its derivative is linear, so that its minimum has a
    closed form.
    """
    along, half = end - start, np.broadcast_to(half, start.shape)
    moving = np.where(along == 0.0, 1.0, along)
    with np.errstate(over="ignore"):
        crossings = np.concatenate([(half - start) / moving, (-half - start) / moving], axis=1)
    crossings = np.where(np.tile(along == 0.0, 2), 0.0, crossings)
    breaks = np.concatenate([np.zeros((len(start), 1)), crossings, np.ones((len(start), 1))], axis=1)
    breaks = np.sort(np.clip(breaks, 0.0, 1.0), axis=1)

    outside = _beyond(start[:, None] + breaks[:, :, None] * along[:, None], half[:, None])
    slope = np.sum(outside * along[:, None], axis=2)
    low, high = slope[:, :-1], slope[:, 1:]
    rise = np.where(high > low, high - low, 1.0)
    share = np.where(high > low, np.clip(-low / rise, 0.0, 1.0), 0.0)
    stationary = breaks[:, :-1] + share * np.diff(breaks, axis=1)
    candidates = np.concatenate([breaks, stationary], axis=1)

    apart = _beyond(start[:, None] + candidates[:, :, None] * along[:, None], half[:, None])
    return _nearest(apart)


def _beyond(points: Array, half: Array) -> Array:
    """Vectors from the box to `points` (..., 3)."""
    return points - np.clip(points, -half, half)


def segment_ball(start: Array, end: Array, radius: float | Array) -> DistanceAndNormal:
    """Segments against the solid balls round the origin; `radius` is one number or (P,), m."""
    point = _to_segment(np.zeros(3), start, end - start)
    span = np.linalg.norm(point, axis=1)
    outside = np.maximum(span - radius, 0.0)
    return outside, np.where(outside[:, None] > 0.0, -point / np.maximum(span, 1e-300)[:, None], 0.0)


def segment_cylinder(
    start: Array, end: Array, radius: float | Array, half_height: float | Array
) -> DistanceAndNormal:
    """Segments against the solid cylinders round the z axis, |z| <= half_height; both sizes one number or (P,), m.

    The squared distance to a convex body is convex along the segment and differentiable. Its minimum is where
    the derivative changes sign: bisection down to the rounding of the parameter.
    """
    along, low, high = end - start, np.zeros(len(start)), np.ones(len(start))
    sizes = np.stack(np.broadcast_arrays(radius, half_height, low)[:2], axis=1)
    for _ in range(54):
        middle = (low + high) / 2
        outside = _beyond_cylinder(start + middle[:, None] * along, sizes)
        rising = np.sum(outside * along, axis=1) >= 0.0
        high = np.where(rising, middle, high)
        low = np.where(rising, low, middle)
    candidates = np.stack([np.zeros(len(start)), low, high, np.ones(len(start))], axis=1)
    apart = _beyond_cylinder(start[:, None] + candidates[:, :, None] * along[:, None], sizes[:, None])
    return _nearest(apart)


def _beyond_cylinder(points: Array, sizes: Array) -> Array:
    """Vectors from cylinders of `sizes` (..., 2), radius and half height, to `points` (..., 3)."""
    radius, half_height = sizes[..., :1], sizes[..., 1:]
    span = np.linalg.norm(points[..., :2], axis=-1, keepdims=True)
    radial = points[..., :2] * (np.maximum(span - radius, 0.0) / np.maximum(span, 1e-300))
    axial = points[..., 2:] - np.clip(points[..., 2:], -half_height, half_height)
    return np.concatenate([radial, axial], axis=-1)


def segment_segment(start: Array, end: Array, other_start: Array, other_end: Array) -> DistanceAndNormal:
    """Segments against segments: the four ends, and the common perpendicular where both reach it."""
    first, second = end - start, other_end - other_start
    between = start - other_start
    ends = [
        _to_segment(start, other_start, second),
        _to_segment(end, other_start, second),
        -_to_segment(other_start, start, first),
        -_to_segment(other_end, start, first),
    ]
    a, e = np.sum(first * first, axis=1), np.sum(second * second, axis=1)
    b, c = np.sum(first * second, axis=1), np.sum(first * between, axis=1)
    f = np.sum(second * between, axis=1)
    determinant = a * e - b * b
    skew = determinant > 1e-14 * a * e
    safe = np.where(skew, determinant, 1.0)
    s = np.where(skew, np.clip((b * f - c * e) / safe, 0.0, 1.0), 0.0)
    t = np.where(skew, np.clip((a * f - b * c) / safe, 0.0, 1.0), 0.0)
    ends.append(between + s[:, None] * first - t[:, None] * second)
    return _nearest(np.stack(ends, axis=1))


def _to_segment(point: Array, start: Array, along: Array) -> Array:
    """Vectors from the closest points of the segments to `point`."""
    square = np.maximum(np.sum(along * along, axis=1), np.finfo(np.float64).tiny)
    share = np.clip(np.sum((point - start) * along, axis=1) / square, 0.0, 1.0)
    return np.asarray(point - start - share[:, None] * along)


def segment_triangle(start: Array, end: Array, triangle: Array) -> DistanceAndNormal:
    """Segments against triangles (P, 3, 3): ends above the face, the three edges, or zero where pierced."""
    origin = triangle[:, 0]
    u, v = triangle[:, 1] - origin, triangle[:, 2] - origin
    normal = np.cross(u, v)
    area = np.linalg.norm(normal, axis=1)
    flat = area <= 1e-14 * np.maximum(np.sum(u * u, axis=1), np.sum(v * v, axis=1))
    unit = normal / np.where(flat, 1.0, area)[:, None]
    far = np.full((len(start), 3), np.inf)

    heights = [np.sum((point - origin) * unit, axis=1) for point in (start, end)]
    candidates = []
    for point, height in zip((start, end), heights, strict=True):
        above = _over(point - origin, u, v, normal, area) & ~flat
        candidates.append(np.where(above[:, None], height[:, None] * unit, far))
    for k in range(3):
        distance, towards = segment_segment(start, end, triangle[:, k], triangle[:, (k + 1) % 3])
        candidates.append(distance[:, None] * towards)

    crosses = heights[0] * heights[1] <= 0.0
    fall = heights[0] - heights[1]
    share = np.where(fall == 0.0, 0.0, heights[0] / np.where(fall == 0.0, 1.0, fall))
    pierced = crosses & ~flat & (fall != 0.0)
    pierced &= _over(start + share[:, None] * (end - start) - origin, u, v, normal, area)
    candidates.append(np.where(pierced[:, None], 0.0, far))
    return _nearest(np.stack(candidates, axis=1))


def _over(point: Array, u: Array, v: Array, normal: Array, area: Array) -> NDArray[np.bool_]:
    """Return True for a `point` whose projection falls into the triangle (0, u, v)."""
    square = np.where(area > 0.0, area * area, 1.0)
    beta = np.sum(np.cross(point, v) * normal, axis=1) / square
    gamma = np.sum(np.cross(u, point) * normal, axis=1) / square
    return np.asarray((beta >= 0.0) & (gamma >= 0.0) & (beta + gamma <= 1.0))


def _nearest(apart: Array) -> DistanceAndNormal:
    """Return length and direction of the shortest of the vectors `apart` (P, C, 3)."""
    lengths = np.linalg.norm(apart, axis=2)
    best = np.argmin(lengths, axis=1)
    rows = np.arange(len(apart))
    distance = lengths[rows, best]
    return distance, apart[rows, best] / np.where(distance > 0.0, distance, np.inf)[:, None]
