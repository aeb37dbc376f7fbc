"""Bodies inside closed meshes, found by winding numbers."""

from __future__ import annotations

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.geometry.exact import NORMAL
from vgtm_qp.geometry.groups import Found, Lowered, Scene
from vgtm_qp.geometry.hulls import groups_of

_ROWS = 200_000


class Solids:
    """The closed meshes of a scene, which may move."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        meshes = {
            k: obstacle.pieces[:, :9].reshape(-1, 3, 3)
            for k, obstacle in enumerate(scene.obstacles)
            if obstacle.shape == "triangle" and obstacle.solid
        }
        self._meshes = [(k, t, t.min(axis=(0, 1)), t.max(axis=(0, 1))) for k, t in meshes.items()]

    def enclosed(self, X: Array, time: float, *, besides: Lowered | None = None) -> list[Found]:
        """Return contacts of the bodies with an end inside a closed mesh; their distances are negative.

        Pairs `besides` are left out.
        """
        known = besides or {}
        bodies, pieces = self._scene.bodies, self._scene.pieces
        parts: list[Found] = []
        places = bodies.some(X) if self._meshes else X
        for obstacle, triangles, low, high in self._meshes:
            points = places - time * self._scene.obstacles[obstacle].velocity
            inside = ((points >= low) & (points <= high)).all(axis=-1)
            if inside.any():
                inside[inside] = winding_number(points[inside], triangles) > 0.5
            body = np.flatnonzero(inside.any(axis=1))
            body = np.array([b for b in body.tolist() if (b, obstacle, False) not in known], dtype=np.int64)
            if not len(body):
                continue
            piece = np.flatnonzero(pieces.obstacle == obstacle)
            pairs = np.repeat(body, len(piece)), np.tile(piece, len(body))
            for group in groups_of(self._scene, "triangle", *pairs):
                found = group.evaluate(group.at(X, time, np.arange(len(group))))[:, 0]
                each = found[:, 0].reshape(-1, len(piece)).argmin(axis=1)
                nearest = each + len(piece) * np.arange(len(each))
                found, radius = found[nearest], group.radius[nearest]
                depth = found[:, 0] + radius
                # The depths of hulls that cut the surface are below zero already.
                found[:, 0] = -np.abs(depth) - radius
                # Turned to lead out, unless the body touches the surface.
                found[:, NORMAL] *= np.where(depth > 0.0, -1.0, 1.0)[:, None]
                parts.append((group.numbers[nearest], found))
        return parts

    def with_enclosed(self, parts: list[Found], X: Array, time: float) -> list[Found]:
        """Return the contacts, with one that leads out for each body inside a closed mesh."""
        enclosed = self.enclosed(X, time)
        if not enclosed:
            return parts
        owner = self._scene.pieces.obstacle
        inside = np.zeros((len(self._scene.bodies), len(self._scene.obstacles)), dtype=bool)
        for numbers, _ in enclosed:
            inside[numbers[:, -4], owner[numbers[:, -3]]] = True
        kept = []
        for numbers, found in parts:
            outside = numbers[:, -2] > 0
            outside[~outside] = ~inside[numbers[~outside, -4], owner[numbers[~outside, -3]]]
            kept.append((numbers[outside], found[outside]))
        return kept + enclosed


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
