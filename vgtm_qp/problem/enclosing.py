"""Shapes that enclose other ones: capsules, several side by side for a box, and prisms for a cylinder."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.arrays import Array

Capsule = tuple[Array, float]
"""Both ends of the axis (2, 3), or its one point (1, 3), and the radius, m."""

_ROUNDING = 1e-12
_RADII = np.linspace(1.0, 1.6, 61)
"""Radii that are tried, over the least possible one: a thicker capsule may be shorter."""
_STEPS = 100
_MOST = 9
"""Greatest number of capsules that hold a box."""


_SIDES = 24
"""Sides of a prism that stands for a cylinder: it sticks out by at most 0.9 % of the radius."""
_FLAT = 1e-6
"""Least thickness of a volume, over its length."""


def spans_volume(points: ArrayLike) -> bool:
    """Whether points (K, 3) are not nearly in one plane."""
    at = np.asarray(points, dtype=float)
    spread = np.linalg.svd(at - at.mean(axis=0), compute_uv=False)
    return bool(len(spread) == 3 and spread[2] > _FLAT * spread[0])


def enclosing_prism(radius: float, half: float) -> Array:
    """Return the corners (K, 3) of a prism round a cylinder about the z-axis, of half height `half`, m."""
    angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    rim = radius / np.cos(np.pi / _SIDES) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([np.insert(rim, 2, end, axis=1) for end in (-half, half)])


def enclosing_capsule(points: Array) -> Capsule:
    """Return a small capsule that holds points (K, 3): the smallest over axes along and near their principal ones."""
    from scipy.optimize import minimize

    centred = points - points.mean(axis=0)
    # The full matrices of many points would fill the memory; those of fewer than three have all axes.
    axes = np.linalg.svd(centred, full_matrices=len(points) < 3)[2]

    def along(tilt: Array, frame: Array) -> Capsule:
        direction = frame[0] + tilt[0] * frame[1] + tilt[1] * frame[2]
        direction = direction / np.linalg.norm(direction)
        across = np.linalg.svd(direction[None])[2][1:]
        middle = _centre(points @ across.T)
        centre = middle @ across
        gap = points - centre
        return capsule_along(centre, direction, gap @ direction, np.linalg.norm(gap @ across.T, axis=1))

    frames = [np.roll(axes, -k, axis=0) for k in range(3)]
    best = min(frames, key=lambda frame: _volume(along(np.zeros(2), frame)))
    options = {"maxfev": 60, "initial_simplex": [[0.0, 0.0], [0.1, 0.0], [0.0, 0.1]]}
    tilt = minimize(
        lambda tilt: _volume(along(tilt, best)), np.zeros(2), method="Nelder-Mead", options=options
    ).x
    return min((along(np.zeros(2), best), along(tilt, best)), key=_volume)


def capsule_along(centre: Array, direction: Array, along: Array, aside: Array) -> Capsule:
    """Return the smallest capsule on a line that holds points at distances `along` and `aside` of it (K,), m."""
    least = float(aside.max())
    # With the radius of the whole extent the capsule is a ball.
    extent = float(np.hypot(least, 0.5 * np.ptp(along)))
    found = []
    for radius in np.minimum(least * _RADII, extent) if least > 0.0 else [extent]:
        # How far the caps reach beyond the axis's ends at each point.
        cap = np.sqrt(np.maximum(radius**2 - aside**2, 0.0))
        low, high = float((along + cap).min()), float((along - cap).max())
        if low > high:
            low = high = 0.5 * (low + high)
        ends = centre + np.array([[low], [high]]) * direction
        found.append((ends, float(radius)))
    ends, _ = min(found, key=_volume)
    points = centre + along[:, None] * direction
    length = float(np.linalg.norm(ends[1] - ends[0]))
    share = np.clip((points - ends[0]) @ direction, 0.0, length)
    # The radius grows by what rounding left outside.
    needed = np.hypot((points - ends[0]) @ direction - share, aside).max()
    size = float(np.abs(ends).max()) + float(needed)
    return ends, float(needed) + _ROUNDING * size


def _volume(capsule: Capsule) -> float:
    ends, radius = capsule
    return float(np.pi * radius**2 * (np.linalg.norm(ends[-1] - ends[0]) + 4.0 / 3.0 * radius))


def _centre(points: Array) -> Array:
    """Return (2,) nearly the centre of the smallest circle round points (K, 2) (Badoiu and Clarkson 2003)."""
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    best, least = centre, np.inf
    for k in range(1, _STEPS):
        gaps = points - centre
        squares = (gaps * gaps).sum(axis=1)
        furthest = int(np.argmax(squares))
        if squares[furthest] < least:
            best, least = centre, squares[furthest]
        centre = centre + gaps[furthest] / (k + 1)
    return np.asarray(best)


def box_capsules(size: Array) -> list[Capsule]:
    """Return the capsules along the longest edge of a box with edges `size` (3,), m, that hold it about its centre.

    They are at most nine, and stick out least: by an eighth of the edge of a cube.
    """
    first, second, along = np.argsort(size, kind="stable").tolist()
    edges, counts = size[[first, second, along]], itertools.product(range(1, _MOST + 1), repeat=2)
    _, best, radius, half = min(_cells(edges, (m, n)) for m, n in counts if m * n <= _MOST)
    found = []
    for i, j in np.ndindex(best):
        ends = np.zeros((2, 3))
        ends[:, first] = ((i + 0.5) / best[0] - 0.5) * size[first]
        ends[:, second] = ((j + 0.5) / best[1] - 0.5) * size[second]
        ends[:, along] = -half, half
        found.append((ends, radius * (1.0 + _ROUNDING)))
    return found


def _cells(size: Array, count: tuple[int, int]) -> tuple[float, tuple[int, int], float, float]:
    """Return by how much `count` capsules stick out of a box, `count`, their radius, and half the length of their axes.

    The axes are along the last edge. A larger radius allows shorter axes, so that they stick out less at the ends and
    more at the sides; as much at both if the cap's height at the corners of a cell is half a cell's least edge.
    """
    aside = np.array(size[:2]) / (2.0 * np.array(count))
    cap = min(float(aside.min()), size[2] / 2.0)
    radius = float(np.hypot(np.hypot(*aside), cap))
    half = float(size[2] / 2.0 - cap)
    return max(radius - float(aside.min()), radius - cap), count, radius, half
