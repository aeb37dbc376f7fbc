"""Distances and nearest points by python-fcl, for many pairs at once; nothing here checks its answers.

FCL's distance from a capsule to a box is always too large: by up to a metre for bodies parallel to edges on
round coordinates (FCL issue 508). So a body is a capsule of radius zero here, and the caller has to prove
each answer. For axes that touch, FCL's penetration depth is not the least one. Its signed distance can crash
the process, and is never used.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import repeat
from math import inf, sqrt
from typing import Any

import fcl
import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.geometry.bodies import Bodies, Hull
from vgtm_qp.geometry.shapes import ObstaclePieces

_UNITS = 1e5
"""FCL's units in a unit of length; its iterations end at 1e-6, which of 1 m turns normals by 1e-3 rad."""

_POLAR_STEPS, _ROUNDING = 8, 4e-15
"""Most steps to the rotation nearest to a frame; error of one by rounding alone."""

_TRIANGLE = np.array([3, 0, 1, 2, 3, 0, 2, 1])
"""Both sides of a triangle as faces: FCL measures distances to convex sets, but not to its own triangles."""


class _Axis:
    """The axis of a body or of its part, for FCL: a capsule of radius zero or a point, moved in place."""

    def __init__(self) -> None:
        self._capsule = fcl.Capsule(0.0, 1.0)
        self._segment = fcl.CollisionObject(self._capsule, fcl.Transform())
        self._point = fcl.CollisionObject(fcl.Sphere(0.0), fcl.Transform())

    def placed(self, middle: Array, span: list[float]) -> fcl.CollisionObject:
        """Return the axis with the middle (3,) and the `span` (3) from end to end, in FCL's units."""
        x, y, z = span
        length = sqrt(x * x + y * y + z * z)
        if not length > 0.0:
            self._point.setTranslation(middle)
            return self._point
        self._capsule.lz = length
        self._segment.setQuatRotation(_quaternion(x, y, z, length))
        self._segment.setTranslation(middle)
        return self._segment


class FclQueries:
    """FCL objects of all pieces and hulls, and two axes that are moved in place.

    Attributes
    ----------
    asked, refused : int
        Queries so far, and those whose answer was not proven.
    scale : float
        FCL's units in a metre.
    """

    def __init__(self, pieces: ObstaclePieces, bodies: Bodies, unit: float = 1.0) -> None:
        self.asked = self.refused = 0
        self._pieces, self.scale = pieces, _UNITS / unit
        self._hulls = [None if hull is None else _hull(hull, self.scale) for hull in bodies.hulls]
        # Of each hull the mean of the corners of its simplex, m, and the inverse of its edges.
        self._corners, self._inverse = np.zeros((len(bodies.hulls), 3)), np.zeros((len(bodies.hulls), 3, 3))
        for k, hull in enumerate(bodies.hulls):
            if hull is not None:
                self._corners[k] = hull.simplex.mean(axis=0)
                self._inverse[k] = hull.inverse
        self._objects: dict[int, Any] = {}
        self._body, self._other = _Axis(), _Axis()
        self._request = fcl.DistanceRequest(enable_nearest_points=True, enable_signed_distance=False)
        self._result = fcl.DistanceResult()
        self._result.nearest_points = [np.full(3, np.nan)] * 2

    def answers(self, pairs: Array, pieces: list[int] | None, time: float) -> Array:
        """Return (K, 7) FCL's distance of each pair, m, and its nearest points of the body and of the other.

        Parameters
        ----------
        pairs : (K, 6 or more)
            Ends of the body's axis, or twice the same point, m; for two bodies then those of the other.
        pieces : list of int or None
            The pieces that are the others; None for two bodies.
        time : float
            s; the pieces are where they are at that time.
        """
        ends = self.scale * pairs[:, :12]
        bodies = map(self._body.placed, *_axes(ends[:, :3], ends[:, 3:6]))
        if pieces is None:
            others = map(self._other.placed, *_axes(ends[:, 6:9], ends[:, 9:]))
        else:
            others = map(self._piece, pieces, repeat(time))
        return self._ask(bodies, others)

    def answer(self, question: Array, piece: int | None, time: float, answer: Array) -> None:
        """Write FCL's distance and nearest points (7) of one pair, all in FCL's units, to `answer`.

        The `question` (12) has middle and span of the body's axis, then those of the other body's, which only count
        where `piece` is None. Pieces are where they are at a `time`, s.
        """
        body = self._body.placed(question[:3], question[3:6].tolist())
        other = (
            self._other.placed(question[6:9], question[9:].tolist())
            if piece is None
            else self._piece(piece, time)
        )
        # A value that FCL does not overwrite must not pass for an answer.
        self._result.min_distance = inf
        answer[0] = fcl.distance(body, other, self._request, self._result)
        answer[1:4], answer[4:] = self._result.nearest_points
        self.asked += 1

    def answers_of_hulls(
        self, body: Sequence[int], points: Array, other: Sequence[int], of_other: Array, *, is_self: bool
    ) -> Array:
        """Return (K, 7) FCL's distance and nearest points, m, of pairs of which at least one body is a hull.

        Parameters
        ----------
        body, points : (K,) int, (K, 4, 3)
            Bodies, and the points that span them, m.
        other, of_other : (K,) int, (K, 4, 3) or (K, 15)
            Other bodies and their points, or pieces and their numbers.
        """
        bodies = map(self._placed, repeat(self._body), body, points, self._poses(body, points))
        if is_self:
            poses = self._poses(other, of_other)
            return self._ask(bodies, map(self._placed, repeat(self._other), other, of_other, poses))
        return self._ask(bodies, map(self._moved, other, of_other))

    def _ask(self, bodies: Iterable[fcl.CollisionObject], others: Iterable[fcl.CollisionObject]) -> Array:
        """Return FCL's answers (K, 7) for pairs of objects, each placed just before it is asked of."""
        found, request, result, ask = list[float](), self._request, self._result, fcl.distance
        for body, other in zip(bodies, others, strict=True):
            # A value that FCL does not overwrite must not pass for an answer.
            result.min_distance = inf
            found.append(ask(body, other, request, result))
            here, there = result.nearest_points
            found += here.tolist()
            found += there.tolist()
        self.asked += len(found) // 7
        return np.array(found).reshape(-1, 7) / self.scale

    def _poses(self, bodies: Sequence[int], points: Array) -> list[Array]:
        """Return for each body the rotation and the position (3, 4) of its hull for `points` (K, 4, 3), m."""
        corners, inverse = self._corners[bodies, :, None], self._inverse[bodies]
        edges = np.swapaxes(points[:, 1:] - points[:, :1], 1, 2)
        turn = _rotations(edges @ inverse)
        position = self.scale * (points.mean(axis=1)[..., None] - turn @ corners)
        return list(np.concatenate([turn, position], axis=2))

    def _placed(self, axis: _Axis, body: int, points: Array, pose: Array) -> fcl.CollisionObject:
        """Return the object of a body: its hull at `pose` (3, 4), or `axis` for a capsule at `points` (4, 3), m."""
        known = self._hulls[body]
        if known is None:
            first, second = self.scale * points[:2]
            return axis.placed(0.5 * (first + second), (second - first).tolist())
        known.setTransform(fcl.Transform(pose[:, :3], pose[:, 3]))
        return known

    def _moved(self, piece: int, row: Array) -> fcl.CollisionObject:
        """Return the object of a piece at the place that its numbers `row` (15,) have."""
        known = self._piece(piece, 0.0)
        if self._pieces.moving:
            own = self._pieces.parameters[piece] if self._pieces.shape[piece] == "triangle" else np.zeros(3)
            known.setTranslation(self.scale * (row[:3] - own[:3]))
        return known

    def _piece(self, piece: int, time: float) -> fcl.CollisionObject:
        """Return the object of a piece at its place at `time`, s."""
        known = self._objects.get(piece)
        if known is None:
            shape, row = self._pieces.shape[piece], self._pieces.parameters[piece]
            known = self._objects[piece] = _object(shape, row, self.scale)
        if self._pieces.moving:
            at = time * self._pieces.velocity[piece]
            if self._pieces.shape[piece] != "triangle":
                at += self._pieces.center[piece]
            known.setTranslation(self.scale * at)
        return known


def _hull(hull: Hull, scale: float) -> fcl.CollisionObject:
    """Return a hull in FCL's units."""
    faces = np.insert(hull.faces, 0, 3, axis=1).ravel()
    return fcl.CollisionObject(fcl.Convex(scale * hull.vertices, len(hull.faces), faces), fcl.Transform())


def _rotations(frames: Array) -> Array:
    """Return the rotations (K, 3, 3) nearest to `frames`: those of points that go straight are only nearly so."""
    # Newton's iteration for the polar factor, which doubles the digits; far from rotations it may not converge.
    for _ in range(_POLAR_STEPS):
        square = np.swapaxes(frames, 1, 2) @ frames
        off = np.abs(square - np.eye(3)).max(initial=0.0)
        if off < _ROUNDING:
            return frames
        if not off < 0.5:
            break
        frames = frames @ (1.5 * np.eye(3) - 0.5 * square)
    u, _, v = np.linalg.svd(frames)
    return np.asarray(u @ v)


def _axes(first: Array, second: Array) -> tuple[list[Array], list[list[float]]]:
    """Return middles (3,) of axes between two ends each (K, 3), and vectors (3) from the first end to the second."""
    return list(0.5 * (first + second)), (second - first).tolist()


def _object(shape: str, row: Array, scale: float) -> fcl.CollisionObject:
    """Return a piece at time 0 in FCL's units; see ``Obstacle.pieces`` for its numbers (15,)."""
    if shape == "triangle":
        return fcl.CollisionObject(fcl.Convex(scale * row[:9].reshape(3, 3), 2, _TRIANGLE), fcl.Transform())
    first, second, third = scale * row[12:]
    if shape == "sphere":
        geometry = fcl.Sphere(first)
    elif shape == "box":
        geometry = fcl.Box(2.0 * first, 2.0 * second, 2.0 * third)
    else:
        geometry = fcl.Cylinder(first, 2.0 * second)
    return fcl.CollisionObject(geometry, fcl.Transform(row[3:12].reshape(3, 3), scale * row[:3]))


def _quaternion(x: float, y: float, z: float, length: float) -> list[float]:
    """Return the quaternion w, x, y, z that turns the z axis onto a vector."""
    w = length + z
    if w <= 1e-9 * length:
        return [0.0, 1.0, 0.0, 0.0]
    size = sqrt(w * w + x * x + y * y)
    return [w / size, -y / size, x / size, 0.0]
