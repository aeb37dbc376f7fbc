"""The pairs of bodies that a trajectory has to keep apart, for all its segments at once."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.certify.motion import GivenMotion
from vgtm_qp.verify.clearance import AgainstMembers, Pairs, box_gap
from vgtm_qp.verify.convex import of_each
from vgtm_qp.verify.distance import DistanceAndNormal
from vgtm_qp.verify.obstacles import Body

_CHUNK = 1_000_000


class Near(NamedTuple):
    """Pairs, as two arrays (P,), in segments (P,), and lower bounds (P,) of their distances there, m."""

    segment: Index
    pair: Pairs
    gap: Array

    @classmethod
    def joined(cls, parts: Sequence[Near]) -> Near:
        """Return the pairs of all parts."""
        segment = np.concatenate([part.segment for part in parts])
        first, second = (np.concatenate([part.pair[k] for part in parts]) for k in (0, 1))
        return cls(segment, (first, second), np.concatenate([part.gap for part in parts]))


class Kept(ABC):
    """Pairs that keep at least `floor`, m, from surface to surface.

    `kind` is the kind of their findings; `rounding` bounds the rounding error of their distances, m.
    """

    def __init__(self, motion: GivenMotion, kind: str, floor: float) -> None:
        self.motion, self.kind, self.floor, self.rounding = motion, kind, floor, motion.rounding
        slack, (low, high) = motion.bends[:, :, None] / 8.0, motion.boxes
        self._low = np.minimum(low[:-1], low[1:]) - slack
        self._high = np.maximum(high[:-1], high[1:]) + slack

    @abstractmethod
    def _gaps(self, segments: slice) -> Array:
        """Return (S, C) lower bounds, m, of distances in the segments; columns are as in `_near`."""

    @abstractmethod
    def _near(self, segment: Index, column: Index, gap: Array, limit: float) -> Near:
        """Return the pairs of columns (P,) in segments (P,) that may be nearer than `limit`, m."""

    @abstractmethod
    def points(self, pair: Pairs, ends: Callable[[Index], Array], time: Array) -> Array:
        """Return (P, 2 V, 3) the points that the pairs' distances depend on, m.

        `ends` gives (P, V, 3) the ends of bodies (P,) of the arm at the times (P,), s.
        """

    @abstractmethod
    def separation(self, points: Array, pair: Pairs, near: Array | None = None) -> DistanceAndNormal:
        """Return distances from surface to surface (P,), m, and normals (P, 3), those of hulls searched `near` some."""

    @abstractmethod
    def apart(self, points: Array, normal: Array, pair: Pairs) -> Array:
        """Return (P,) the gap between the surfaces' supporting planes across `normal` (P, 3), m."""

    @abstractmethod
    def depth(self, pair: Pairs) -> Array:
        """Return (P,) the greatest depth of penetration that distances can have, m: the radii; infinite for hulls."""

    @abstractmethod
    def bend(self, segment: Index, pair: Pairs) -> Array:
        """Return (P,) bounds of the second derivative of the pairs' relative motion in segments (P,), m."""

    @abstractmethod
    def names(self, pair: tuple[int, int]) -> tuple[str, str]:
        """Return the names of the two bodies."""

    def enclosed(self) -> Iterator[tuple[int, tuple[int, int]]]:
        """Yield each state and pair whose first body is inside a closed surface, however far from it."""
        yield from ()

    def near(self, limit: float) -> tuple[Near, float]:
        """Return the pairs that may come nearer than `limit`, m, and a bound of the distances of all the others."""
        found, rest = [], np.inf
        for first, gaps in self._chunks():
            # NaN bounds nothing: such a pair may be near.
            near = ~(gaps >= limit)
            rest = min(rest, float(gaps[~near].min(initial=np.inf)))
            row, column = np.nonzero(near)
            found.append(self._near(row + first, column, gaps[row, column], limit))
        return Near.joined(found), min(rest, limit) if self._divides else rest

    def nearest(self) -> Near:
        """Return the pair with the least bound of all; empty without pairs."""
        best = Near(*_nothing())
        for first, gaps in self._chunks():
            if gaps.size and (not len(best.gap) or gaps.min() < best.gap[0]):
                row, column = np.unravel_index([int(np.argmin(gaps))], gaps.shape)
                found = self._near(row + first, column, gaps[row, column], np.inf)
                k = [int(np.argmin(found.gap))]
                best = Near(found.segment[k], (found.pair[0][k], found.pair[1][k]), found.gap[k])
        return best

    def _chunks(self) -> Iterator[tuple[int, Array]]:
        """Yield the first segment and the gaps of some segments at a time."""
        count, size = len(self._low), max(1, _CHUNK // max(1, self._columns))
        for first in range(0, count, size):
            yield first, self._gaps(slice(first, first + size))

    _columns = 1
    _divides = False
    """Whether a column stands for several pairs, of which `_near` leaves out the far ones."""


def _nothing() -> tuple[Index, Pairs, Array]:
    none = np.zeros(0, dtype=np.int64)
    return none, (none, none), np.zeros(0)


class KeptBodies(Kept):
    """Bodies of the arm against all obstacles of one kind of shape; the second of a pair is a piece of an obstacle."""

    def __init__(self, motion: GivenMotion, floor: float, bodies: Sequence[Body]) -> None:
        super().__init__(motion, "clearance", floor)
        self.bodies = bodies
        counts = [len(body.shape.corners) for body in bodies]
        self._owner = np.repeat(np.arange(len(bodies)), counts)
        self._first = np.cumsum([0, *counts])
        self._center, self._velocity, self._rotation = (
            np.stack([getattr(body, name) for body in bodies])[self._owner]
            for name in ("center", "velocity", "rotation")
        )
        self._sizes = np.concatenate([body.shape.sizes for body in bodies])
        corners = np.concatenate([body.corners() for body in bodies])
        # An obstacle's start and its travel may cancel; their rounding errors do not.
        gone = np.abs(self._center) + np.abs(self._velocity) * float(motion.time[-1])
        self.rounding += 64.0 * float(np.finfo(float).eps) * float(gone.max())
        self._piece_low, self._piece_high = corners.min(axis=1), corners.max(axis=1)
        self._shape = bodies[0].shape
        self._columns = len(bodies) * len(motion.arm.radius)
        self._divides = len(self._owner) > len(bodies)

    def _relative(self, segments: slice | Index, body: int) -> tuple[Array, Array]:
        """Return least and greatest corners (S, B, 3) of the boxes round the arm's bodies, seen from an obstacle."""
        center = self.bodies[body].at(self.motion.time)
        low, high = np.minimum(center[:-1], center[1:]), np.maximum(center[:-1], center[1:])
        return self._low[segments] - high[segments][:, None], self._high[segments] - low[segments][:, None]

    def _gaps(self, segments: slice) -> Array:
        each = []
        for k in range(len(self.bodies)):
            own = slice(self._first[k], self._first[k + 1])
            whole = self._piece_low[own].min(axis=0), self._piece_high[own].max(axis=0)
            each.append(box_gap(*self._relative(segments, k), *whole) - self.motion.arm.radius)
        return np.concatenate(each, axis=1)

    def _near(self, segment: Index, column: Index, gap: Array, limit: float) -> Near:
        body, member = np.divmod(column, len(self.motion.arm.radius))
        if not self._divides:
            return Near(segment, (member, body), gap)
        found = [Near(*_nothing())]
        for k in np.unique(body).tolist():
            own = np.arange(self._first[k], self._first[k + 1])
            rows = np.flatnonzero(body == k)
            size = max(1, _CHUNK // len(own))
            for first in range(0, len(rows), size):
                row = rows[first : first + size]
                low, high = (
                    box[np.arange(len(row)), member[row], None] for box in self._relative(segment[row], k)
                )
                gaps = box_gap(low, high, self._piece_low[own], self._piece_high[own])
                gaps -= self.motion.arm.radius[member[row], None]
                near, piece = np.nonzero(gaps < limit)
                pair = member[row[near]], own[piece]
                found.append(Near(segment[row[near]], pair, gaps[near, piece]))
        return Near.joined(found)

    def points(self, pair: Pairs, ends: Callable[[Index], Array], time: Array) -> Array:
        """See ``Kept``: the ends of the body in the piece's own frame, twice."""
        center = self._center[pair[1]] + self._velocity[pair[1]] * time[:, None]
        own = np.einsum("pec,pcd->ped", ends(pair[0]) - center[:, None], self._rotation[pair[1]])
        return np.concatenate([own, own], axis=1)

    def separation(self, points: Array, pair: Pairs, near: Array | None = None) -> DistanceAndNormal:
        """See ``Kept``; normals are in the pieces' own frames."""
        shape, sizes = self._shape, self._sizes[pair[1]]
        distance, normal = of_each(
            self.motion.arm.is_hull[pair[0]],
            lambda k: shape.distance(points[k, 0], points[k, 1], sizes[k]),
            lambda k: shape.hull_distance(
                points[k, : points.shape[1] // 2], sizes[k], None if near is None else near[k]
            ),
        )
        return distance - self.motion.arm.radius[pair[0]], normal

    def apart(self, points: Array, normal: Array, pair: Pairs) -> Array:
        """See ``Kept``."""
        vertices = points[:, : points.shape[1] // 2]
        nearest = np.einsum("pec,pc->pe", vertices, normal).min(axis=1)
        reach = self._shape.reach(normal, self._sizes[pair[1]])
        return np.asarray(nearest - reach - self.motion.arm.radius[pair[0]])

    def depth(self, pair: Pairs) -> Array:
        """See ``Kept``."""
        arm = self.motion.arm
        return np.where(arm.is_hull[pair[0]], np.inf, arm.radius[pair[0]])

    def bend(self, segment: Index, pair: Pairs) -> Array:
        """See ``Kept``: obstacles go straight."""
        return np.asarray(self.motion.bends[segment, pair[0]])

    def names(self, pair: tuple[int, int]) -> tuple[str, str]:
        """Return the names of the body and of the obstacle."""
        return self.motion.arm.member_names[pair[0]], self.bodies[self._owner[pair[1]]].name

    def enclosed(self) -> Iterator[tuple[int, tuple[int, int]]]:
        """See ``Kept``: inside a closed mesh."""
        for body, first in zip(self.bodies, self._first.tolist(), strict=False):
            for own, places in self.motion.ends_by_parts() if body.shape.closed else ():
                ends = places - body.at(self.motion.time[own])[:, None, None]
                inside = body.encloses(ends.reshape(-1, 3)).reshape(ends.shape[:3]).any(axis=2)
                for state, member in np.argwhere(inside).tolist():
                    yield own.start + state, (member, first)


class KeptMembers(Kept):
    """Bodies of the arm against one another, except those that share an end or may touch."""

    def __init__(self, motion: GivenMotion, floor: float) -> None:
        super().__init__(motion, "self-clearance", floor)
        self._against = AgainstMembers(motion)
        pairs = np.sort(self._against.near(self._low[0], self._high[0], 0, 0, np.inf), axis=0)
        self._pair = pairs[0], pairs[1]
        self._columns = len(self._pair[0])

    def _gaps(self, segments: slice) -> Array:
        low, high, (first, second) = self._low[segments], self._high[segments], self._pair
        gaps = box_gap(low[:, first], high[:, first], low[:, second], high[:, second])
        return np.asarray(gaps - self._against.radii(self._pair))

    def _near(self, segment: Index, column: Index, gap: Array, limit: float) -> Near:  # noqa: ARG002
        return Near(segment, (self._pair[0][column], self._pair[1][column]), gap)

    def points(self, pair: Pairs, ends: Callable[[Index], Array], time: Array) -> Array:
        """See ``Kept``: the ends of both."""
        return self._against.points(pair, ends, time)

    def separation(self, points: Array, pair: Pairs, near: Array | None = None) -> DistanceAndNormal:
        """See ``Kept``."""
        return self._against.separation(points, pair, near)

    def apart(self, points: Array, normal: Array, pair: Pairs) -> Array:
        """See ``Kept``."""
        return self._against.apart(points, normal, pair)

    def depth(self, pair: Pairs) -> Array:
        """See ``Kept``."""
        return np.where(self._against.with_hull(pair), np.inf, self._against.radii(pair))

    def bend(self, segment: Index, pair: Pairs) -> Array:
        """See ``Kept``."""
        return np.asarray(self.motion.bends[segment, pair[0]] + self.motion.bends[segment, pair[1]])

    def names(self, pair: tuple[int, int]) -> tuple[str, str]:
        """Return the names of the two bodies."""
        return self.motion.arm.member_names[pair[0]], self.motion.arm.member_names[pair[1]]
