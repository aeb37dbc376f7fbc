"""Least clearances of a maneuver: exact at its states, and a proven lower bound between them.

Between two states every node moves along a straight line. So a plane that separates a member from a convex
body at both ends of an interval separates them throughout. Intervals whose best plane proves too little are
halved.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array, Index
from vgtm_qp.verify.arm import AnyRecordedArm
from vgtm_qp.verify.carrying import CarryingArm
from vgtm_qp.verify.convex import hull_distance, of_each
from vgtm_qp.verify.distance import DistanceAndNormal, segment_segment
from vgtm_qp.verify.obstacles import Body

Pairs = tuple[Index, Index]

CLEARANCE_TOLERANCE = 1e-9
"""Tolerance of clearances at states, m."""
BETWEEN_TOLERANCE = 1e-4
"""Tolerance of clearances between states, over the mean length of members or links."""
RESOLUTION = 1e-6
"""Greatest gap between bound and least clearance found between states, over the same mean length."""

_GREATEST_DEPTH = 48
GREATEST_COUNT = 400_000
"""Greatest numbers of halvings, and of open intervals of one step; beyond, a bound stays as it is."""
_CHUNK = 200_000
_ENDS = 3_000_000
"""Number of coordinates of ends that are in the memory at a time."""


class RecordedMotion:
    """The moving arm: times (T,), s, and states, which are nodes (T, N, 3), m, or joints and base (T, J + 6).

    The ends (T, M, V, 3), m, are those of its bodies at the states, or their vertices. In names the states count from
    `first` on.
    """

    def __init__(self, arm: AnyRecordedArm | CarryingArm, time: Array, states: Array, first: int = 0) -> None:
        self.arm, self.time, self.states, self.first = arm, time, states, first
        # No bound is nearer than the rounding of positions.
        rounding = 64.0 * float(np.finfo(float).eps) * self.furthest
        self.resolution = max(RESOLUTION * arm.size, rounding)

    @cached_property
    def ends(self) -> Array:
        """See the class."""
        return self.arm.states_ends(self.states)

    def ends_by_parts(self) -> Iterator[tuple[slice, Array]]:
        """Yield some states after others, and their ends: those of all states may be too much for the memory."""
        size = max(1, _ENDS // max(1, self.arm.states_ends(self.states[:1]).size))
        for first in range(0, len(self.states), size):
            own = slice(first, first + size)
            yield own, self.arm.states_ends(self.states[own])

    @cached_property
    def boxes(self) -> tuple[Array, Array]:
        """Least and greatest corners (T, M, 3) of boxes round the bodies' ends, m."""
        each = [(ends.min(axis=2), ends.max(axis=2)) for _, ends in self.ends_by_parts()]
        low, high = zip(*each, strict=True)
        return np.concatenate(low), np.concatenate(high)

    @property
    def furthest(self) -> float:
        """Greatest coordinate of an end, m."""
        return max(float(np.abs(corners).max(initial=0.0)) for corners in self.boxes)

    def part(self, first: int, last: int, arm: AnyRecordedArm | CarryingArm | None = None) -> RecordedMotion:
        """Return the motion from the state `first` to the state `last`, of an `arm` that carries something if given."""
        if arm is None and (first, last) == (0, len(self.time) - 1):
            return self
        rows = slice(first, last + 1)
        return RecordedMotion(arm or self.arm, self.time[rows], self.states[rows], self.first + first)

    def name(self, state: int) -> str:
        """Return the name of a state."""
        return f"state {self.first + state}"

    def ends_between(self, step: Index, body: Index, share: Array) -> Array:
        """Return (P, V, 3) the ends, m, of bodies (P,) at shares (P,) of the ways from states (P,) to the next."""
        found = np.empty((len(body), *self.ends.shape[2:]))
        for k in np.unique(step).tolist():
            own = np.flatnonzero(step == k)
            found[own] = self.arm.ends_between(self.states[k], self.states[k + 1], share[own], body[own])
        return found

    @cached_property
    def bend(self) -> Array:
        """(T - 1, M) upper bounds, m, of |d2 r / d share2| of bodies' ends on the ways from one state to the next."""
        every = np.arange(len(self.arm.radius))
        ways = itertools.pairwise(self.states)
        found = [self.arm.bend(before, after, every) for before, after in ways]
        return np.array(found).reshape(-1, len(every))


@dataclass(frozen=True)
class Least:
    """The least clearance so far, m, with its pair and place."""

    value: float = np.inf
    where: str = ""

    def or_lower(self, values: Array, where: Callable[[int], str]) -> Least:
        """Return the least of `values` with the place that `where` gives for its index, if it is lower."""
        k = int(np.argmin(values)) if len(values) else -1
        return Least(float(values[k]), where(k)) if k >= 0 and values[k] < self.value else self


class _Instant(NamedTuple):
    """Pairs (P,) at instants: their points (P, V or 2 V, 3), m, and normals (P, 3)."""

    points: Array
    normal: Array

    def at(self, rows: Index) -> _Instant:
        """Return some of the pairs."""
        return _Instant(self.points[rows], self.normal[rows])

    def joined(self, other: _Instant) -> _Instant:
        """Return these pairs and others after them."""
        return _Instant(*(np.concatenate(both) for both in zip(self, other, strict=True)))


class Encounters(ABC):
    """All pairs, of a member and an obstacle or of two members, that must keep apart."""

    def __init__(self, motion: RecordedMotion) -> None:
        self.motion = motion
        self.held_from: dict[tuple[int, int], int] = {}
        """First state at which each pair counts; other pairs count from the first state on."""

    @abstractmethod
    def pairs_named(self, name: str) -> list[tuple[int, int]]:
        """Return the pairs of that name, an empty list if there are none."""

    @abstractmethod
    def near(self, low: Array, high: Array, start: int, stop: int, limit: float) -> Pairs:
        """Return the pairs (P,), (P,) that may be nearer than `limit`, m.

        `low`, `high` (M, 3) bound each member from state `start` to state `stop`.
        """

    @abstractmethod
    def points(self, pair: Pairs, ends: Callable[[Index], Array], time: Array) -> Array:
        """Return (P, V or 2 V, 3) the points that the pairs' separation depends on, m.

        `ends` gives (P, V, 3) the ends of members (P,) at the times (P,), s.
        """

    @abstractmethod
    def swept(self, before: Array, after: Array) -> Array:
        """Return (P, 2 V or 4 V, 3) the points at two instants as those of bodies that have all of both."""

    @abstractmethod
    def separation(
        self,
        points: Array,
        pair: Pairs,
        near: Array | None = None,
        enough: Array | float = np.inf,
        *,
        decides: bool = False,
    ) -> DistanceAndNormal:
        """Return the exact surface distance (P,), m, and the normal (P, 3) at those points.

        See :func:`~vgtm_qp.verify.convex.hull_distance` for `near`, `enough` and `decides`, which are for hulls.
        """

    @abstractmethod
    def apart(self, points: Array, normal: Array, pair: Pairs) -> Array:
        """Return (P,) the gap between the surfaces' supporting planes across `normal`, m.

        With a zero normal it is minus the radius, or the radii: the value for axes that touch.
        """

    @abstractmethod
    def _bend(self, step: Index, pair: Pairs) -> Array:
        """Return (P,) bounds, m, of the pairs' second derivative after states (P,), which comes from turning joints."""

    @abstractmethod
    def name(self, pair: tuple[int, int]) -> str:
        """Return the name of the pair."""

    def deepest(self, pair: Pairs) -> Array:
        """Return (P,) the distances of pairs whose axes touch, m: none is less, but for hulls."""
        count = len(pair[0])
        return self.apart(np.zeros((count, 2 * self.motion.ends.shape[2], 3)), np.zeros((count, 3)), pair)

    def _floor(self, pair: Pairs) -> Array:
        """Return (P,) what no distance is below, m."""
        return np.where(self.with_hull(pair), -np.inf, self.deepest(pair))

    @abstractmethod
    def with_hull(self, pair: Pairs) -> NDArray[np.bool_]:
        """Return (P,) which of the pairs have a hull."""

    def distances(self, state: Index, pair: Pairs, enough: Array | float = np.inf) -> Array:
        """Return the exact distances (P,) of pairs at states (P,), m; lower bounds of those that are `enough`."""
        ends, time = self.motion.ends, self.motion.time[state]
        points = self.points(pair, lambda member: ends[state, member], time)
        return self.separation(points, pair, enough=enough)[0]

    def at_states(self) -> list[Least]:
        """Return the exact least clearance at each state."""
        count = len(self.motion.time)
        limit, least = np.full(count, np.inf), [Least()] * count
        for state, pair in self._together(self._first(k) for k in range(count)):
            # Boxes along the axes may be exactly as far apart as the pair: rounding must not drop the pair.
            np.minimum.at(limit, state, self.distances(state, pair) + self.motion.resolution)
        for state, pair in self._together(self._at(k, k, limit[k]) for k in range(count)):
            distance = self.distances(state, pair, limit[state])
            order = np.lexsort((distance, state))
            for k in order[np.unique(state[order], return_index=True)[1]].tolist():
                at, one = int(state[k]), (pair[0][k : k + 1], pair[1][k : k + 1])
                called = self._called(self.motion.name(at), one)
                least[at] = least[at].or_lower(distance[k : k + 1], called)
        return least

    def _at(self, start: int, stop: int, limit: float) -> Iterator[tuple[int, Pairs]]:
        """Yield with a state the pairs that may be nearer than `limit`, m, there or on the way to `stop`."""
        slack = self.motion.bend[start, :, None] / 8.0 if stop > start else 0.0
        low, high = (corners[start : stop + 1] for corners in self.motion.boxes)
        for pair in self._counting(low.min(axis=0) - slack, high.max(axis=0) + slack, start, stop, limit):
            yield start, pair

    def _first(self, state: int) -> Iterator[tuple[int, Pairs]]:
        """Yield with a state some pairs that a growing limit meets first there."""
        reach = 0.05 * float(self.motion.arm.length.max())
        for _ in range(40):
            found = next(self._at(state, state, reach), None)
            if found is not None:
                yield found
                return
            reach *= 2.0

    def _together(self, each: Iterable[Iterable[tuple[int, Pairs]]]) -> Iterator[tuple[Index, Pairs]]:
        """Yield pairs of many states together, as many as the memory has room for, with the state (P,) of each."""
        most = _ENDS // (2 * 3 * self.motion.ends.shape[2])
        some, size = list[tuple[int, Pairs]](), 0
        for state, pair in itertools.chain.from_iterable(each):
            if some and size + len(pair[0]) > most:
                yield _joined(some)
                some, size = [], 0
            some.append((state, pair))
            size += len(pair[0])
        if some:
            yield _joined(some)

    def _counting(self, low: Array, high: Array, start: int, stop: int, limit: float) -> Iterator[Pairs]:
        """Yield the pairs of `near` that count from state `start` on, some pairs at a time."""
        # Boxes round hulls that overlap are not apart, however deep that limit is below zero.
        first, second = self.near(low, high, start, stop, max(limit, self.motion.resolution))
        if self.held_from:
            each = zip(first.tolist(), second.tolist(), strict=True)
            kept = np.array([self.held_from.get(pair, 0) <= start for pair in each], dtype=bool)
            first, second = first[kept], second[kept]
        for k in range(0, len(first), _CHUNK):
            yield first[k : k + _CHUNK], second[k : k + _CHUNK]

    def _called(self, when: str, pair: Pairs) -> Callable[[int], str]:
        return lambda k: f"{when}: {self.name((int(pair[0][k]), int(pair[1][k])))}"

    def between(self, limit: Least, bound: Least) -> tuple[Least, Least]:
        """Return `limit` and `bound` lowered by the motion from each state to the next.

        `limit` is the least clearance at any instant evaluated; `bound` is proven to be below every clearance
        in the steps so far, and comes within `RESOLUTION` of `limit`.
        """
        near = (self._at(step, step + 1, limit.value) for step in range(len(self.motion.time) - 1))
        for step, pair in self._together(near):
            limit, bound = self.divide(step, pair, limit, bound)
        return limit, bound

    def divide(self, step: Index, pair: Pairs, limit: Least, bound: Least) -> tuple[Least, Least]:
        """Return `limit` and `bound` lowered by pairs (P,), (P,) on the ways from states `step` (P,) to the next."""
        bend = self._bend(step, pair)
        proven = self._held_throughout(step, pair, limit.value, bend / 8.0)
        left = ~(proven >= limit.value)
        called = self._called_between(step[~left], np.zeros(int((~left).sum())), _some(pair, ~left))
        bound = bound.or_lower(proven[~left], called)
        step, pair, bend, start = step[left], _some(pair, left), bend[left], np.zeros(int(left.sum()))
        first, limit = self._edge(step, pair, start, np.zeros((len(start), 3)), limit)
        last, limit = self._edge(step, pair, start + 1.0, first.normal, limit)
        return self._halve(0, first, last, step, pair, bend, start, limit, bound)

    def _halve(
        self,
        depth: int,
        first: _Instant,
        last: _Instant,
        step: Index,
        pair: Pairs,
        bend: Array,
        start: Array,
        limit: Least,
        bound: Least,
    ) -> tuple[Least, Least]:
        """Go on with :meth:`divide` from intervals (P,), which begin at shares `start` (P,) of their steps."""
        for halvings in range(depth, _GREATEST_DEPTH):
            width = 0.5**halvings
            held = [
                np.minimum(*(self.apart(edge.points, normal, pair) for edge in (first, last)))
                for normal in (first.normal, last.normal)
            ]
            proven = np.maximum(np.maximum(*held) - bend * width**2 / 8.0, self._floor(pair))
            open_ = (proven < limit.value - self.motion.resolution) & np.isfinite(bend)
            is_much, steps = open_.sum() > GREATEST_COUNT, np.unique(step[open_])
            if halvings == _GREATEST_DEPTH - 1 or (is_much and len(steps) == 1):
                open_[:] = False
            settled = np.where(open_, np.inf, proven)
            bound = bound.or_lower(settled, self._called_between(step, start, pair))
            if not open_.any():
                break
            if is_much:
                # The greatest count is for one step; those of many are divided apart.
                for own in (step < steps[len(steps) // 2], step >= steps[len(steps) // 2]):
                    rows = np.flatnonzero(open_ & own)
                    parts = (
                        first.at(rows),
                        last.at(rows),
                        step[rows],
                        _some(pair, rows),
                        bend[rows],
                        start[rows],
                    )
                    limit, bound = self._halve(halvings, *parts, limit, bound)
                break
            width /= 2.0
            rows = np.flatnonzero(open_)
            first, last, step, pair = first.at(rows), last.at(rows), step[rows], _some(pair, rows)
            middle, limit = self._edge(step, pair, start[rows] + width, first.normal, limit)
            first, last = _Instant.joined(first, middle), _Instant.joined(middle, last)
            start = np.concatenate([start[rows], start[rows] + width])
            step, bend = np.tile(step, 2), np.tile(bend[rows], 2)
            pair = np.tile(pair[0], 2), np.tile(pair[1], 2)
        return limit, bound

    def _held_throughout(self, step: Index, pair: Pairs, limit: float, bend: Array) -> Array:
        """Return (P,) lower bounds, m, of the distances of pairs in the whole of steps (P,), if they have a hull.

        One plane may hold apart all that a pair sweeps over, by more than the `limit` and the `bend` (P,) of its way.
        Of other pairs, and where there is no such plane, the bound is below the limit.
        """
        found, rows = np.full(len(bend), -np.inf), np.flatnonzero(self.with_hull(pair))
        if len(rows):
            step, pair, enough = step[rows], _some(pair, rows), limit + bend[rows]
            ends = [self._points_between(step, pair, np.full(len(rows), share)) for share in (0.0, 1.0)]
            gap, _ = self.separation(self.swept(*ends), pair, None, enough, decides=True)
            found[rows] = gap - bend[rows]
        return found

    def _edge(
        self, step: Index, pair: Pairs, share: Array, near: Array, limit: Least
    ) -> tuple[_Instant, Least]:
        """Return pairs (P,) at shares (P,) of steps, and `limit` lowered by them; the search begins `near` normals."""
        points = self._points_between(step, pair, share)
        distance, normal = self.separation(points, pair, near)
        return _Instant(points, normal), limit.or_lower(distance, self._called_between(step, share, pair))

    def _points_between(self, step: Index, pair: Pairs, share: Array) -> Array:
        before, after = self.motion.time[step], self.motion.time[step + 1]
        time = before + share * (after - before)
        return self.points(pair, lambda member: self.motion.ends_between(step, member, share), time)

    def _called_between(self, step: Index, share: Array, pair: Pairs) -> Callable[[int], str]:
        first = self.motion.first + 1
        return lambda k: self._called(f"step {first + step[k]} at {share[k]:.4f}", pair)(k)


class AgainstBody(Encounters):
    """Members against the convex pieces of one obstacle, seen from its moving centre."""

    def __init__(self, motion: RecordedMotion, body: Body) -> None:
        super().__init__(motion)
        self.body = body
        corners = body.corners()
        self._low, self._high = corners.min(axis=1), corners.max(axis=1)
        self._centers = body.at(motion.time)

    def pairs_named(self, name: str) -> list[tuple[int, int]]:
        """Return the pairs of all pieces of the body with the member in ``member / obstacle``."""
        named = [k for k in range(len(self.motion.arm.member_names)) if self.name((k, 0)) == name]
        return [(member, piece) for member in named for piece in range(len(self._low))]

    def near(self, low: Array, high: Array, start: int, stop: int, limit: float) -> Pairs:
        """Return the members and pieces of the body that may be nearer than `limit`."""
        reach = limit + self.motion.arm.radius
        shift = self._centers[start : stop + 1]
        low, high = low - shift.max(axis=0), high - shift.min(axis=0)
        whole = box_gap(low, high, self._low.min(axis=0), self._high.max(axis=0))
        member = np.flatnonzero(whole < reach)
        if len(self._low) == 1 or not len(member):
            return member, np.zeros_like(member)
        limits = low[member].min(axis=0), high[member].max(axis=0)
        piece = np.flatnonzero(box_gap(self._low, self._high, *limits) < reach[member].max())
        near = [
            piece[box_gap(low[m], high[m], self._low[piece], self._high[piece]) < reach[m]] for m in member
        ]
        return np.repeat(member, [len(found) for found in near]), np.concatenate(near)

    def at_states(self) -> list[Least]:
        """Return the exact least clearances; what is inside a closed mesh touches, hulls by their length."""
        return [least.or_lower(*self._depth(state)) for state, least in enumerate(super().at_states())]

    def _depth(self, state: int) -> tuple[Array, Callable[[int], str]]:
        """Return (M,) distances, m, of members inside a closed mesh at a state, infinite for others; and names."""
        arm, ends = self.motion.arm, self.motion.ends[state] - self._centers[state]
        inside = self.body.encloses(ends.reshape(-1, 3)).reshape(len(ends), -1).any(axis=1)
        depth = np.where(inside, -np.where(arm.is_hull, arm.length, 0.0) - arm.radius, np.inf)
        return depth, lambda k: f"{self.motion.name(state)}: {self.name((k, 0))}"

    def points(self, pair: Pairs, ends: Callable[[Index], Array], time: Array) -> Array:
        """Return (P, V, 3) the ends of the members, seen from the centre of the body."""
        return np.asarray(ends(pair[0]) - self.body.at(time)[:, None])

    def swept(self, before: Array, after: Array) -> Array:
        """See ``Encounters``."""
        return np.concatenate([before, after], axis=1)

    def separation(
        self,
        points: Array,
        pair: Pairs,
        near: Array | None = None,
        enough: Array | float = np.inf,
        *,
        decides: bool = False,
    ) -> DistanceAndNormal:
        """Return surface distances and normals."""
        radius = self.motion.arm.radius[pair[0]]
        least = enough + radius
        distance, normal = of_each(
            self.with_hull(pair),
            lambda k: self.body.separation(points[k, 0], points[k, 1], pair[1][k]),
            lambda k: self.body.hull_separation(
                points[k], pair[1][k], None if near is None else near[k], least[k], decides=decides
            ),
        )
        return distance - radius, normal

    def apart(self, points: Array, normal: Array, pair: Pairs) -> Array:
        """Return the gaps between members and pieces."""
        nearest = np.einsum("pec,pc->pe", points, normal).min(axis=1)
        return np.asarray(nearest - self.body.support(normal, pair[1]) - self.motion.arm.radius[pair[0]])

    def with_hull(self, pair: Pairs) -> NDArray[np.bool_]:
        """See ``Encounters``."""
        return np.asarray(self.motion.arm.is_hull[pair[0]])

    def _bend(self, step: Index, pair: Pairs) -> Array:
        return np.asarray(self.motion.bend[step, pair[0]])

    def name(self, pair: tuple[int, int]) -> str:
        """Return ``member / obstacle``."""
        return f"{self.motion.arm.member_names[pair[0]]} / {self.body.name}"


class AgainstMembers(Encounters):
    """Members against members without a common node."""

    def pairs_named(self, name: str) -> list[tuple[int, int]]:
        """Return the two members in ``member / member``, in either order."""
        names, nodes = self.motion.arm.member_names, self.motion.arm.members
        apart = [k for k, first in enumerate(names) if name.startswith(f"{first} / ")]
        found = [(a, b) for a in apart for b in range(len(names)) if self.name((a, b)) == name]
        kept = [
            (a, b) for a, b in found if not np.isin(nodes[a], nodes[b]).any() and (a, b) not in self._touching
        ]
        return [pair for a, b in kept for pair in ((a, b), (b, a))]

    @cached_property
    def _touching(self) -> frozenset[tuple[int, int]]:
        """The pairs that are not kept apart, in either order."""
        pairs = self.motion.arm.touching.tolist()
        return frozenset(pair for a, b in pairs for pair in ((a, b), (b, a)))

    def _may_touch(self, first: Index, second: Index) -> NDArray[np.bool_]:
        pairs = zip(first.tolist(), second.tolist(), strict=True)
        return np.array([pair in self._touching for pair in pairs], dtype=bool)

    def near(self, low: Array, high: Array, start: int, stop: int, limit: float) -> Pairs:  # noqa: ARG002
        """Return the members that may be nearer to one another than `limit`; `start` and `stop` do not matter."""
        axis = int(np.argmax(high.max(axis=0) - low.min(axis=0)))
        radius = self.motion.arm.radius
        reach = limit + 2.0 * float(radius.max())
        order = np.argsort(low[:, axis], kind="stable")
        begin, end = low[order, axis], high[order, axis]
        last = np.searchsorted(begin, end + reach, side="right")
        count = np.maximum(last - np.arange(len(order)) - 1, 0)
        first = np.repeat(np.arange(len(order)), count)
        second = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + first + 1
        a, b = order[first], order[second]
        members = self.motion.arm.members
        shared = (members[a][:, :, None] == members[b][:, None, :]).any(axis=(1, 2))
        if self._touching:
            shared |= self._may_touch(a, b)
        a, b = a[~shared], b[~shared]
        gap = box_gap(low[a], high[a], low[b], high[b]) - radius[a] - radius[b]
        return a[gap < limit], b[gap < limit]

    def points(self, pair: Pairs, ends: Callable[[Index], Array], time: Array) -> Array:  # noqa: ARG002
        """Return (P, 2 V, 3) the ends of both members."""
        return np.concatenate([ends(member) for member in pair], axis=1)

    def swept(self, before: Array, after: Array) -> Array:
        """See ``Encounters``."""
        count = before.shape[1] // 2
        return np.concatenate(
            [at[:, own] for own in (slice(count), slice(count, None)) for at in (before, after)], 1
        )

    def separation(
        self,
        points: Array,
        pair: Pairs,
        near: Array | None = None,
        enough: Array | float = np.inf,
        *,
        decides: bool = False,
    ) -> DistanceAndNormal:
        """Return surface distances and normals."""
        radii = self.radii(pair)
        distance, normal = body_distance(points, self.with_hull(pair), near, enough + radii, decides=decides)
        return distance - radii, normal

    def apart(self, points: Array, normal: Array, pair: Pairs) -> Array:
        """Return the gaps between both members."""
        along, count = np.einsum("pec,pc->pe", points, normal), points.shape[1] // 2
        return np.asarray(along[:, :count].min(axis=1) - along[:, count:].max(axis=1) - self.radii(pair))

    def with_hull(self, pair: Pairs) -> NDArray[np.bool_]:
        """See ``Encounters``."""
        return np.asarray(self.motion.arm.is_hull[np.stack(pair)].any(axis=0))

    def _bend(self, step: Index, pair: Pairs) -> Array:
        return np.asarray(self.motion.bend[step, pair[0]] + self.motion.bend[step, pair[1]])

    def name(self, pair: tuple[int, int]) -> str:
        """Return ``member / member``."""
        return " / ".join(self.motion.arm.member_names[k] for k in pair)

    def radii(self, pair: Pairs) -> Array:
        """Return (P,) the sums of both radii, m."""
        return np.asarray(self.motion.arm.radius[pair[0]] + self.motion.arm.radius[pair[1]])


def apart_at_home(arm: AnyRecordedArm, resolution: float) -> list[str]:
    """Return the pairs of bodies recorded as touching at home that are further apart there than the `resolution`, m."""
    first, second = arm.touching.T
    ends = arm.ends(arm.home)
    with_hull = arm.is_hull[first] | arm.is_hull[second]
    gap, _ = body_distance(np.concatenate([ends[first], ends[second]], axis=1), with_hull)
    apart = gap - arm.radius[first] - arm.radius[second] > resolution
    names = arm.member_names
    return [f"{names[a]} / {names[b]} do not touch at home" for a, b in arm.touching[apart].tolist()]


def body_distance(
    points: Array,
    hull: NDArray[np.bool_],
    near: Array | None = None,
    enough: Array | float = np.inf,
    *,
    decides: bool = False,
) -> DistanceAndNormal:
    """Return distances (P,), m, and normals (P, 3) between two bodies of the arm each, without their radii.

    `points` (P, 2 V, 3) are the ends or vertices of both; `hull` (P,) says where at least one of them is a hull. See
    :func:`~vgtm_qp.verify.convex.hull_distance` for `near`, `enough` and `decides`.
    """
    count, enough = points.shape[1] // 2, np.broadcast_to(enough, len(points))

    def hulls(own: Index) -> DistanceAndNormal:
        others = points[own, count:]

        def furthest(direction: Array, rows: Index) -> Array:
            corner = np.einsum("pvc,pc->pv", others[rows], direction).argmax(axis=1)
            return np.asarray(others[rows, corner])

        hint = None if near is None else near[own]
        return hull_distance(points[own, :count], furthest, hint, enough[own], decides=decides)

    ends = (0, 1, count, count + 1)
    return of_each(hull, lambda own: segment_segment(*(points[own, k] for k in ends)), hulls)


def _joined(each: Sequence[tuple[int, Pairs]]) -> tuple[Index, Pairs]:
    """Return the states (P,) and the pairs (P,), (P,) of all entries, one entry after another."""
    states = np.repeat([state for state, _ in each], [len(pair[0]) for _, pair in each])
    first, second = (np.concatenate([pair[k] for _, pair in each]) for k in (0, 1))
    return states, (first, second)


def _some(pair: Pairs, rows: Index | NDArray[np.bool_]) -> Pairs:
    """Return some of the pairs."""
    return pair[0][rows], pair[1][rows]


def box_gap(low: Array, high: Array, other_low: Array, other_high: Array) -> Array:
    """Return the distances between axis-aligned boxes, m."""
    apart = np.maximum(np.maximum(other_low - high, low - other_high), 0.0)
    return np.asarray(np.linalg.norm(apart, axis=-1))
