"""Pairs of one shape as arrays: exact contacts, and lower bounds that shrink by what the members moved."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.geometry.batch import Batch
from vgtm_qp.geometry.exact import SECOND_CONTACT, distance_function, follow_function, sweep_function
from vgtm_qp.geometry.shapes import Pieces

Array = NDArray[np.float64]
Index = NDArray[np.int64]

FOLLOWED = (1, 128)
"""Numbers of pairs that a watch evaluates at once."""

_FEW, _MANY, _MANY_SWEPT = (1,), (1, 64, 1024), (1, 64)


class Way(NamedTuple):
    """Where the points that members end at are, or a straight way of theirs, and how far from a reference.

    Attributes
    ----------
    states : tuple of (N, 3)
        Positions, or those at both ends of the way, m.
    reference : (N, 3)
        m.
    moved : (N,)
        How far each point is from where it was, at most, m; for members and pieces.
    greatest : float
        By how much the distance of a pair has changed since the reference at most, m.
    """

    states: tuple[Array, ...]
    reference: Array
    moved: Array
    greatest: float


class Motion(NamedTuple):
    """Ways from where members were compared with pieces, and with each other in stiff or soft parts; seconds since."""

    to_pieces: Way
    stiff: Way
    soft: Way
    elapsed: float


@dataclass(frozen=True, eq=False)
class Members:
    """The arm as capsules: ``nodes`` (M, 2) int, ``radius`` (M,) and ``joined`` (M, 2) int.

    Members that have an entry of ``joined`` in common may touch; it is ``nodes`` where joints have no extent.
    """

    nodes: Index
    radius: Array
    joined: Index


class Contacts:
    """Outputs of ``distance_function`` for K pairs, distances from surface to surface.

    Attributes
    ----------
    distance, distance_second, t, t_second, s, s_second : (K,)
    normal, normal_second, point, point_second : (K, 3)
    """

    def __init__(self, rows: Array) -> None:
        self.distance, self.distance_second, self.t, self.t_second = rows[:, :4].T
        self.normal, self.normal_second = rows[:, 4:7], rows[:, 7:10]
        self.point, self.point_second = rows[:, 10:13], rows[:, 13:16]
        self.s, self.s_second = rows[:, 16], rows[:, 17]

    def two(self) -> NDArray[np.bool_]:
        """Return whether the second contact is worth a row of its own, (K,)."""
        return np.asarray(np.abs(self.t_second - self.t) >= SECOND_CONTACT)


class Kernels:
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
                # A watch does without as a rule; what it does not prove is asked of these.
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
    """Pairs of one shape: members against pieces, or against members for ``"segment"``.

    Attributes
    ----------
    member, other : (C,) int
        `other` is a piece or, for ``"segment"``, a member.
    distance : (C,)
        Surface distance at the reference configuration, m, ascending once :meth:`keep_near` was called.
    is_self, is_soft, moving : bool
        Whether these are pairs of members; of parts of the arm that bend; whether some obstacle moves.
    """

    def __init__(
        self,
        shape: str,
        member: Index,
        other: Index,
        members: Members,
        pieces: Pieces,
        kernels: Kernels,
        *,
        is_soft: bool = False,
    ) -> None:
        self.shape, self.is_self, self.is_soft = shape, shape == "segment", is_soft
        self.moving = pieces.moving and not self.is_self
        self._members, self._pieces, self._kernels = members, pieces, kernels
        self._set(member, other)

    def _set(self, member: Index, other: Index) -> None:
        members = self._members
        self.member, self.other = member, other
        self.distance = np.zeros(len(member))
        self.nodes, self.radius = members.nodes[member], members.radius[member]
        self.other_nodes = members.nodes[other] if self.is_self else self.nodes
        if self.is_self:
            self.radius = self.radius + members.radius[other]
        self.speed = self._pieces.speed[other] if self.moving else np.zeros(0)

    def __len__(self) -> int:
        return len(self.member)

    def keep_near(self, X: Array, time: float, horizon: float) -> None:
        """Make `X` the reference: drop the pairs from `horizon` on and sort the others by distance."""
        distance = self.contacts(X, time, np.arange(len(self))).distance
        order = np.argsort(distance, kind="stable")
        order = order[: np.searchsorted(distance[order], horizon)]
        self._set(self.member[order], self.other[order])
        self.distance = distance[order]

    @property
    def follow(self) -> Batch:
        """The batch of ``follow_function`` for this shape."""
        return self._kernels.follow(self.shape)

    def select(self, kept: NDArray[np.bool_]) -> None:
        """Drop the pairs that are not `kept`, (C,)."""
        distance = self.distance[kept]
        self._set(self.member[kept], self.other[kept])
        self.distance = distance

    def lower(self, motion: Motion, limit: float) -> tuple[Array, float]:
        """Return lower bounds of the surface distances of the first pairs, and one of all the others.

        Those others cannot have come nearer than `limit`.
        """
        way = motion.to_pieces if not self.is_self else motion.soft if self.is_soft else motion.stiff
        shrink = way.greatest
        if self.moving:
            shrink += self._pieces.fastest * motion.elapsed
        # Only near the head of the sorted list can the motion have mattered.
        few = len(self) <= 64 and not self.is_self
        count = len(self) if few else int(np.searchsorted(self.distance, limit + shrink))
        if self.is_self:
            bound = self.distance[:count] - self._nearer(way, count)
        else:
            bound = self.distance[:count] - way.moved.take(self.nodes[:count]).max(axis=1)
            if self.moving:
                bound -= self.speed[:count] * motion.elapsed
        return bound, float(self.distance[count] - shrink) if count < len(self) else np.inf

    def _nearer(self, way: Way, count: int) -> Array:
        """Return by how much the first pairs of members have come nearer at most, (count,), m.

        That is no more than a point of one has moved relative to a point of the other: than their middles have, and
        both have turned about those. On a straight way it is greatest at an end.
        """
        nearer = np.zeros(count)
        if count:
            nodes = np.concatenate([self.nodes[:count], self.other_nodes[:count]], axis=1)
            reference = way.reference.take(nodes, axis=0)
            for state in way.states:
                shift = state.take(nodes, axis=0) - reference
                between = 0.5 * (shift[:, 0] + shift[:, 1] - shift[:, 2] - shift[:, 3])
                vectors = np.stack(
                    [between, 0.5 * (shift[:, 1] - shift[:, 0]), 0.5 * (shift[:, 3] - shift[:, 2])], axis=1
                )
                np.maximum(
                    nearer, np.sqrt(np.einsum("ksc,ksc->ks", vectors, vectors)).sum(axis=1), out=nearer
                )
        return nearer

    def segments(self, X: Array, rows: Index) -> Array:
        """Return the members' ends (k, 6)."""
        return X[self.nodes[rows]].reshape(-1, 6)

    def others(self, X: Array, time: float, rows: Index) -> Array:
        """Return the parameters of what the members are compared with (k, width)."""
        if self.is_self:
            return X[self.other_nodes[rows]].reshape(-1, 6)
        return np.asarray(self._pieces.at(time)[self.other[rows]])

    def contacts(self, X: Array, time: float, rows: Index) -> Contacts:
        """Return exact contacts of some pairs."""
        return self.contacts_of(self.segments(X, rows), self.others(X, time, rows), rows)

    def contacts_of(self, segments: Array, others: Array, rows: Index) -> Contacts:
        """Return the same for given ends and parameters."""
        answer = self._kernels.distance(self.shape)(segments, others)
        answer[:, :2] -= self.radius[rows, None]
        return Contacts(answer)

    def sweep(self, a: Array, b: Array, other_a: Array, other_b: Array, rows: Index) -> Array:
        """Return the outputs of ``sweep_function`` (k, 3), distances from surface to surface."""
        arguments = (a, b, other_a, other_b) if self.is_self else (a, b, other_a)
        return np.asarray(self._kernels.sweep(self.shape)(*arguments) - self.radius[rows, None])

    def displacement(self, duration: float, rows: Index) -> Array:
        """Return how far the obstacles move in `duration`, (k, 3)."""
        return np.asarray(self._pieces.velocity[self.other[rows]] * duration)
