"""Which pairs may come near: one broad phase, then lower bounds that shrink by what the nodes move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vgtm_qp.geometry.batch import Batch
from vgtm_qp.geometry.exact import distance_function, sweep_function
from vgtm_qp.geometry.shapes import Pieces

Array = NDArray[np.float64]
Index = NDArray[np.int64]


SECOND_CONTACT = 0.2
"""Two contacts of a member with one piece are apart by this fraction of its length, at least."""


@dataclass(frozen=True, eq=False)
class Members:
    """The arm as capsules: ``nodes`` (M, 2) int and ``radius`` (M,)."""

    nodes: Index
    radius: Array

    def motion(self, X: Array, reference: Array) -> Array:
        """Return how far any point of each member is from where it was, at most, (M,)."""
        shift = X - reference
        moved = np.sqrt(np.einsum("ic,ic->i", shift, shift))
        return np.asarray(np.maximum(moved[self.nodes[:, 0]], moved[self.nodes[:, 1]]))


class Contacts:
    """Outputs of ``distance_function`` for K pairs, distances from surface to surface.

    Attributes
    ----------
    distance, distance_second, t, t_second, s, s_second : (K,)
    normal, normal_second, point, point_second : (K, 3)
    two : (K,) bool
        Whether the second contact is worth a row of its own.
    """

    def __init__(self, rows: Array) -> None:
        self.rows = rows
        self.distance, self.distance_second, self.t, self.t_second = rows[:, :4].T
        self.normal, self.normal_second = rows[:, 4:7], rows[:, 7:10]
        self.point, self.point_second = rows[:, 10:13], rows[:, 13:16]
        self.s, self.s_second = rows[:, 16], rows[:, 17]
        self.two = np.abs(self.t_second - self.t) >= SECOND_CONTACT


class Group:
    """Candidate pairs of one shape: members against pieces, or against members for ``"segment"``.

    Attributes
    ----------
    member, other : (C,) int
        `other` is a piece or, for ``"segment"``, a member.
    distance : (C,)
        Surface distance at the reference configuration, m.
    """

    def __init__(
        self, shape: str, member: Index, other: Index, members: Members, pieces: Pieces, kernels: Kernels
    ) -> None:
        self.shape, self.member, self.other = shape, member, other
        self.is_self = shape == "segment"
        self.moving = pieces.moving and not self.is_self
        self.distance = np.zeros(len(member))
        self._members, self._pieces, self._kernels = members, pieces, kernels
        self.nodes = members.nodes[member]
        self.radius = members.radius[member]
        self.speed = np.zeros(len(member))
        if self.is_self:
            self.other_nodes = members.nodes[other]
            self.radius = self.radius + members.radius[other]
        else:
            self.speed = pieces.speed[other]

    def select(self, kept: NDArray[np.bool_]) -> Group:
        """Return the group of the `kept` pairs, their distances with them."""
        group = Group(
            self.shape, self.member[kept], self.other[kept], self._members, self._pieces, self._kernels
        )
        group.distance = self.distance[kept]
        return group

    def lower(self, motion: Array, elapsed: float) -> Array:
        """Return lower bounds of the surface distances after a `motion` (M,) and `elapsed` seconds."""
        bound = self.distance - motion[self.member]
        if self.is_self:
            bound -= motion[self.other]
        elif self.moving:
            bound -= self.speed * abs(elapsed)
        return np.asarray(bound)

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


class Kernels:
    """The batched kernels of each shape, built when first needed."""

    def __init__(self) -> None:
        self._distance: dict[str, Batch] = {}
        self._sweep: dict[str, Batch] = {}

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


class Candidates:
    """All pairs nearer than a horizon at a reference configuration, with their exact distances there.

    Pairs that are not listed were at least ``horizon`` (``self_horizon`` for two members) apart.
    """

    def __init__(
        self,
        members: Members,
        pieces: Pieces,
        kernels: Kernels,
        X: Array,
        time: float,
        horizon: float,
        self_horizon: float | None,
    ) -> None:
        self.reference, self.time = X.copy(), time
        self.horizon = horizon if len(pieces) else np.inf
        self.self_horizon = np.inf if self_horizon is None else self_horizon
        self._members, self._fastest = members, float(pieces.speed.max(initial=0.0))
        self.groups: list[Group] = []
        ends = X[members.nodes]
        middle = ends.mean(axis=1)
        reach = 0.5 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) + members.radius
        tree = cKDTree(middle)
        if len(pieces):
            member, piece = _near_pieces(tree, middle, reach, pieces, time, horizon)
            for shape in np.unique(pieces.shape):
                chosen = pieces.shape[piece] == shape
                self._add(Group(str(shape), member[chosen], piece[chosen], members, pieces, kernels), horizon)
        if self_horizon is not None:
            first, second = _near_members(tree, middle, reach, members.nodes, self_horizon)
            self._add(Group("segment", first, second, members, pieces, kernels), self_horizon)

    def _add(self, group: Group, horizon: float) -> None:
        rows = np.arange(len(group.member))
        if len(rows):
            group.distance = group.contacts(self.reference, self.time, rows).distance
            self.groups.append(group.select(group.distance < horizon))

    def refresh(self, X: Array, time: float) -> None:
        """Move the reference to `X` without a broad phase: the horizons shrink by what the members moved."""
        motion = self._members.motion(X, self.reference)
        self.horizon, self.self_horizon = self.beyond(motion, time)
        self.reference, self.time = X.copy(), time
        for group in self.groups:
            group.distance = group.contacts(X, time, np.arange(len(group.member))).distance

    def motion(self, X: Array) -> Array:
        """Return the motion of each member since the reference, (M,)."""
        return self._members.motion(X, self.reference)

    def beyond(self, motion: Array, time: float) -> tuple[float, float]:
        """Return lower bounds of the distances of the pairs not listed: to pieces, and between members."""
        greatest = float(motion.max(initial=0.0))
        drift = self._fastest * abs(time - self.time)
        return self.horizon - greatest - drift, self.self_horizon - 2.0 * greatest


def _near_pieces(
    tree: cKDTree, middle: Array, reach: Array, pieces: Pieces, time: float, horizon: float
) -> tuple[Index, Index]:
    """Return pairs (member, piece) whose bounding spheres come nearer than `horizon`."""
    centers = pieces.center + time * pieces.velocity
    found = tree.query_ball_point(centers, pieces.radius + (float(reach.max()) + horizon))
    counts = np.fromiter((len(f) for f in found), dtype=np.int64, count=len(found))
    piece = np.repeat(np.arange(len(found)), counts)
    member = np.fromiter((m for f in found for m in f), dtype=np.int64, count=int(counts.sum()))
    gap = np.linalg.norm(middle[member] - centers[piece], axis=1) - reach[member] - pieces.radius[piece]
    near = gap < horizon
    return member[near], piece[near]


def _near_members(
    tree: cKDTree, middle: Array, reach: Array, nodes: Index, horizon: float
) -> tuple[Index, Index]:
    """Return pairs of members that share no node and whose bounding spheres come nearer than `horizon`."""
    pairs = tree.query_pairs(2.0 * float(reach.max()) + horizon, output_type="ndarray").astype(np.int64)
    first, second = pairs[:, 0], pairs[:, 1]
    apart = (nodes[first][:, :, None] != nodes[second][:, None, :]).all(axis=(1, 2))
    first, second = first[apart], second[apart]
    gap = np.linalg.norm(middle[first] - middle[second], axis=1) - reach[first] - reach[second]
    near = gap < horizon
    return first[near], second[near]
