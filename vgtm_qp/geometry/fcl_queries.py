"""Distances by python-fcl, each compared with the exact one; an answer that differs from it is not used.

FCL's distance from a capsule to a box is always too large, and for bodies parallel to edges on round
coordinates too large by up to a metre (FCL issue 508). So the capsule has radius zero, the radius is subtracted,
and an answer counts only where the closed form agrees and the two are apart. FCL's signed distance is never asked for:
it can end the process.
"""

from __future__ import annotations

from math import sqrt
from typing import Any, ClassVar

import numpy as np

from vgtm_qp.geometry.shapes import ObstaclePieces

_AGREEMENT = 1e-9
"""How far FCL and the closed form may be apart, m."""

_APART = 1e-3
"""The normal is the way between FCL's two nearest points, which are as exact as its distance. Of an axis that is nearer
than this to a surface, or touches it, the way is mostly rounding, and the answer is refused, m."""

_UNIT = 1e-6
"""How far the length of FCL's normal may be from 1."""


class FclQueries:
    """FCL objects of all pieces and one capsule, built once and moved in place.

    Attributes
    ----------
    asked, replaced : int
        Queries so far, and those whose answer the guard refused.
    """

    SHAPES: ClassVar[tuple[str, ...]] = ("box", "sphere", "cylinder")

    def __init__(self, pieces: ObstaclePieces) -> None:
        self.asked = self.replaced = 0
        self._pieces = pieces
        self._objects: dict[int, Any] = {}

    def _object(self, piece: int) -> Any:
        if piece not in self._objects:
            import fcl

            if not self._objects:
                self._fcl, self._capsule = fcl, fcl.Capsule(0.0, 1.0)
                self._body = fcl.CollisionObject(self._capsule, fcl.Transform())
                self._request = fcl.DistanceRequest(enable_nearest_points=True, enable_signed_distance=False)
            shape, row = self._pieces.shape[piece], self._pieces.parameters[piece]
            if shape == "sphere":
                geometry = fcl.Sphere(row[12])
            elif shape == "box":
                geometry = fcl.Box(*(2.0 * row[12:]))
            else:
                geometry = fcl.Cylinder(row[12], 2.0 * row[13])
            turn = row[3:12].reshape(3, 3)
            self._objects[piece] = fcl.CollisionObject(geometry, fcl.Transform(turn, row[:3]))
        return self._objects[piece]

    def witness(
        self, piece: int, time: float, ends: list[float], distance: float
    ) -> tuple[float, tuple[float, float, float]] | None:
        """Return where FCL finds a segment nearest to a piece at `time`: the parameter on it, and the normal (3).

        None where its answer is refused: its distance is not the `distance`, m, of the closed form, or the segment is
        too near for the points to have a direction.
        """
        other = self._object(piece)
        if self._pieces.moving:
            other.setTranslation(self._pieces.at(time)[piece, :3])
        ax, ay, az, bx, by, bz = ends
        x, y, z = bx - ax, by - ay, bz - az
        length = sqrt(x * x + y * y + z * z)
        if not length > 0.0:
            return None
        self._capsule.lz = length
        self._body.setQuatRotation(_quaternion(x, y, z, length))
        self._body.setTranslation(np.array((0.5 * (ax + bx), 0.5 * (ay + by), 0.5 * (az + bz))))
        result = self._fcl.DistanceResult()
        found = self._fcl.distance(self._body, other, self._request, result)
        self.asked += 1
        if not (found > _APART and abs(found - distance) <= _AGREEMENT):
            self.replaced += 1
            return None
        point, witness = result.nearest_points
        (px, py, pz), (wx, wy, wz) = point.tolist(), witness.tolist()
        nx, ny, nz = (px - wx) / found, (py - wy) / found, (pz - wz) / found
        if not abs(sqrt(nx * nx + ny * ny + nz * nz) - 1.0) <= _UNIT:
            self.replaced += 1
            return None
        along = (x * (px - ax) + y * (py - ay) + z * (pz - az)) / (length * length)
        return min(max(along, 0.0), 1.0), (nx, ny, nz)


def _quaternion(x: float, y: float, z: float, length: float) -> list[float]:
    """Return the quaternion w, x, y, z that turns the z axis onto a vector."""
    w = length + z
    if w <= 1e-9 * length:
        return [0.0, 1.0, 0.0, 0.0]
    size = sqrt(w * w + x * x + y * y)
    return [w / size, -y / size, x / size, 0.0]
