"""Pairs of one shape as arrays: exact distances, and lower bounds that shrink as the bodies move."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.geometry.batch import Batch
from vgtm_qp.geometry.bodies import Bodies
from vgtm_qp.geometry.exact import SECOND_CONTACT, distance_function, follow_function, sweep_function
from vgtm_qp.geometry.shapes import ObstaclePieces

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FOLLOWED = (1, 128)
"""Numbers of pairs that a watch evaluates at once."""

_FEW, _MANY, _MANY_SWEPT = (1,), (1, 64, 1024), (1, 64)


class Displacement(NamedTuple):
    """How far the points that span bodies are from a reference: in one state, or on the straight path between two.

    Attributes
    ----------
    states : tuple of (P, 3)
        Positions, or those at both ends of the path, m.
    reference : (P, 3)
        m.
    moved : (P,)
        How far each point is from its reference, at most, m; for pairs of a body and a piece.
    greatest : float
        By how much the distance of a pair has changed since the reference at most, m.
    """

    states: tuple[Array, ...]
    reference: Array
    moved: Array
    greatest: float


class Displacements(NamedTuple):
    """Displacements from the references of pairs with pieces, of rigid parts and of bending parts; seconds since."""

    to_pieces: Displacement
    rigid: Displacement
    bending: Displacement
    elapsed: float


class PairDistances:
    """Outputs of ``distance_function`` for K pairs, distances from surface to surface.

    Attributes
    ----------
    distance, distance_second, t, t_second, s, s_second : (K,)
    normal, normal_second : (K, 3)
    """

    def __init__(self, rows: Array) -> None:
        self.distance, self.distance_second, self.t, self.t_second = rows[:, :4].T
        self.normal, self.normal_second = rows[:, 4:7], rows[:, 7:10]
        self.s, self.s_second = rows[:, 16], rows[:, 17]

    def two(self) -> NDArray[np.bool_]:
        """Return whether the second contact is worth a row of its own, (K,)."""
        return np.asarray(np.abs(self.t_second - self.t) >= SECOND_CONTACT)


class ShapeKernels:
    """The batched kernels of each shape, built when first needed."""

    def __init__(self) -> None:
        self._distance: dict[str, Batch] = {}
        self._sweep: dict[str, Batch] = {}
        self._follow: dict[str, Batch] = {}

    def prepare(self, shapes: Iterable[str], *, rests: bool) -> None:
        """Begin to compile what steps need: for a scene that is watched, and else for few and for many pairs."""
        shapes = tuple(shapes)
        for shape in shapes:
            for count in FOLLOWED if rests else ():
                self.follow(shape).prepare(count)
            for count in _FEW if rests else _MANY:
                self.distance(shape).prepare(count)
        for shape in shapes:
            for count in _FEW if rests else _MANY_SWEPT:
                # A watch rarely needs these: only for a motion that it cannot prove itself.
                self.sweep(shape).prepare(count, for_later=rests)

    def follow(self, shape: str) -> Batch:
        """Return the batch of ``follow_function(shape)``."""
        if shape not in self._follow:
            self._follow[shape] = Batch(follow_function(shape))
        return self._follow[shape]

    def distance(self, shape: str) -> Batch:
        """Return the batch of ``distance_function(shape)``."""
        if shape not in self._distance:
            self._distance[shape] = Batch(distance_function(shape))
        return self._distance[shape]

    def sweep(self, shape: str) -> Batch:
        """Return the batch of ``sweep_function(shape)``."""
        if shape not in self._sweep:
            self._sweep[shape] = Batch(sweep_function(shape))
        return self._sweep[shape]


class Group:
    """Pairs of one shape: bodies against pieces, or against bodies for ``"segment"``.

    Attributes
    ----------
    body, other : (C,) int
        `other` is a piece or, for ``"segment"``, a body.
    points, other_points : (C, 2) int
        The points that span `body` and, for ``"segment"``, `other`.
    distance : (C,)
        Surface distance at the reference configuration, m, ascending once :meth:`keep_near` was called.
    is_self, is_bending, moving : bool
        Whether these are pairs of bodies; whether of parts of the arm that bend; whether some obstacle moves.
    """

    def __init__(
        self,
        shape: str,
        body: Index,
        other: Index,
        bodies: Bodies,
        pieces: ObstaclePieces,
        kernels: ShapeKernels,
        *,
        is_bending: bool = False,
    ) -> None:
        self.shape, self.is_self, self.is_bending = shape, shape == "segment", is_bending
        self.moving = pieces.moving and not self.is_self
        self._bodies, self._pieces, self._kernels = bodies, pieces, kernels
        self._set(body, other)

    def _set(self, body: Index, other: Index) -> None:
        bodies = self._bodies
        self.body, self.other = body, other
        self.distance = np.zeros(len(body))
        self.points, self.radius = bodies.points[body], bodies.radius[body]
        self.other_points = bodies.points[other] if self.is_self else self.points
        if self.is_self:
            self.radius = self.radius + bodies.radius[other]
        self.speed = self._pieces.speed[other] if self.moving else np.zeros(0)

    def __len__(self) -> int:
        return len(self.body)

    def keep_near(self, X: Array, time: float, horizon: float) -> None:
        """Make `X` the reference: drop the pairs from `horizon` on and sort the others by distance."""
        distance = self.distances(X, time, np.arange(len(self))).distance
        order = np.argsort(distance, kind="stable")
        order = order[: np.searchsorted(distance[order], horizon)]
        self._set(self.body[order], self.other[order])
        self.distance = distance[order]

    @property
    def follow(self) -> Batch:
        """The batch of ``follow_function`` for this shape."""
        return self._kernels.follow(self.shape)

    def select(self, kept: NDArray[np.bool_]) -> None:
        """Drop the pairs that are not `kept`, (C,)."""
        distance = self.distance[kept]
        self._set(self.body[kept], self.other[kept])
        self.distance = distance

    def lower(self, motion: Displacements, limit: float) -> tuple[Array, float]:
        """Return lower bounds of the surface distances of the first pairs, and one of all the others, m.

        The others cannot have come nearer than `limit`, m.
        """
        own = motion.bending if self.is_bending else motion.rigid
        displacement = own if self.is_self else motion.to_pieces
        shrink = displacement.greatest
        if self.moving:
            shrink += self._pieces.fastest * motion.elapsed
        # Only near the head of the sorted list can the motion have mattered.
        few = len(self) <= 64 and not self.is_self
        count = len(self) if few else int(np.searchsorted(self.distance, limit + shrink))
        if self.is_self:
            bound = self.distance[:count] - self._nearer(displacement, count)
        else:
            bound = self.distance[:count] - displacement.moved.take(self.points[:count]).max(axis=1)
            if self.moving:
                bound -= self.speed[:count] * motion.elapsed
        return bound, float(self.distance[count] - shrink) if count < len(self) else np.inf

    def _nearer(self, displacement: Displacement, count: int) -> Array:
        """Return by how much the first pairs of bodies have come nearer at most, (count,), m.

        That is no more than a point of one has moved relative to a point of the other: no more than their middles
        have, and both have turned about those. On a straight path it is greatest at an end.
        """
        nearer = np.zeros(count)
        if count:
            points = np.concatenate([self.points[:count], self.other_points[:count]], axis=1)
            reference = displacement.reference.take(points, axis=0)
            for state in displacement.states:
                shift = state.take(points, axis=0) - reference
                between = 0.5 * (shift[:, 0] + shift[:, 1] - shift[:, 2] - shift[:, 3])
                vectors = np.stack(
                    [between, 0.5 * (shift[:, 1] - shift[:, 0]), 0.5 * (shift[:, 3] - shift[:, 2])], axis=1
                )
                np.maximum(
                    nearer, np.sqrt(np.einsum("ksc,ksc->ks", vectors, vectors)).sum(axis=1), out=nearer
                )
        return nearer

    def segments(self, X: Array, rows: Index) -> Array:
        """Return the bodies' ends (k, 6), m."""
        return X[self.points[rows]].reshape(-1, 6)

    def others(self, X: Array, time: float, rows: Index) -> Array:
        """Return the parameters of what the bodies are compared with (k, width)."""
        if self.is_self:
            return X[self.other_points[rows]].reshape(-1, 6)
        return np.asarray(self._pieces.at(time)[self.other[rows]])

    def distances(self, X: Array, time: float, rows: Index) -> PairDistances:
        """Return exact distances of some pairs."""
        return self.distances_of(self.segments(X, rows), self.others(X, time, rows), rows)

    def distances_of(self, segments: Array, others: Array, rows: Index) -> PairDistances:
        """Return the same for given ends and parameters."""
        answer = self._kernels.distance(self.shape)(segments, others)
        answer[:, :2] -= self.radius[rows, None]
        return PairDistances(answer)

    def sweep(self, a: Array, b: Array, other_a: Array, other_b: Array, rows: Index) -> Array:
        """Return the outputs of ``sweep_function`` (k, 3), distances from surface to surface, m."""
        arguments = (a, b, other_a, other_b) if self.is_self else (a, b, other_a)
        return np.asarray(self._kernels.sweep(self.shape)(*arguments) - self.radius[rows, None])

    def obstacle_displacement(self, duration: float, rows: Index) -> Array:
        """Return the displacements (k, 3) of the obstacles in `duration`, s, in m."""
        return np.asarray(self._pieces.velocity[self.other[rows]] * duration)
