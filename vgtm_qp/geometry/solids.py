"""Whether a point is inside a closed mesh, by its winding number."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_ROWS = 200_000


def winding_number(points: Array, triangles: Array) -> Array:
    """Return the winding number of closed `triangles` (T, 3, 3) round each of `points` (K, 3).

    The sum of the solid angles over 4 pi, by A. van Oosterom and J. Strackee, "The solid angle of a plane
    triangle", IEEE Trans. Biomed. Eng. 30 (1983): 1 inside, 0 outside.
    """
    total = np.zeros(len(points))
    step = max(1, _ROWS // max(1, len(points)))
    for start in range(0, len(triangles), step):
        a, b, c = (triangles[start : start + step, i] - points[:, None] for i in range(3))
        la, lb, lc = (np.linalg.norm(v, axis=2) for v in (a, b, c))
        volume = np.einsum("kti,kti->kt", a, np.cross(b, c))
        spread = la * lb * lc
        for v, w, length in ((a, b, lc), (b, c, la), (c, a, lb)):
            spread += np.einsum("kti,kti->kt", v, w) * length
        total += np.arctan2(volume, spread).sum(axis=1)
    return np.asarray(total / (2.0 * np.pi))


class Solid:
    """A closed mesh that may move."""

    def __init__(self, triangles: Array, velocity: Array) -> None:
        self._triangles, self._velocity = triangles, velocity
        self._low, self._high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))

    def contains(self, points: Array, time: float) -> Mask:
        """Return which of `points` (K, 3) are inside at `time`."""
        local = points - time * self._velocity
        inside = ((local >= self._low) & (local <= self._high)).all(axis=1)
        rows = np.flatnonzero(inside)
        if len(rows):
            inside[rows] = winding_number(local[rows], self._triangles) > 0.5
        return np.asarray(inside)
