"""Whether pairs of bodies keep a distance all along a motion: proven, refuted, or neither.

The proof is that of ``verify.clearance``: a plane that separates two bodies at instants of an interval separates them
through it, but for what turning joints bend. Here it is held against one floor, for all steps of the motion at once,
and a pair is left as soon as its floor is proven or broken.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array, Index
from vgtm_qp.result.chain import RecordedChain
from vgtm_qp.verify.clearance import (
    CLEARANCE_TOLERANCE,
    AgainstBody,
    AgainstMembers,
    Encounters,
    Pairs,
    RecordedMotion,
    box_gap,
)
from vgtm_qp.verify.obstacles import Body

_COARSE = 0.1
"""How far a joint may bend a link's way in one interval of the first look, over the mean length of links."""
_GREATEST_SPLIT = 8
_GREATEST_DEPTH = 24
_GREATEST_COUNT = 200_000
"""Halvings at first and in all, and number of open intervals, from which on nothing more is decided."""
_CHUNK = 1_000_000
_SAMPLES = 17
"""Instants of a step at which a pair that comes too near is looked at."""


class Way:
    """The motion of a chain through its states, in intervals short enough for a first look.

    An instant is a number x from 0 to the number of steps S: its whole part is the step, the rest the share of it.
    """

    def __init__(self, chain: RecordedChain, time: Array, states: Array) -> None:
        if len(time) == 1:
            time, states = np.repeat(time, 2), np.repeat(states, 2, axis=0)
        self.motion, self.chain = RecordedMotion(chain, time, states), chain
        self.bends = chain.bend(states[:-1], states[1:], np.arange(len(chain.links)))
        """(S, B) bounds, m, of |d2 r / d x2| of the links."""
        self.rounding = 64.0 * float(np.finfo(float).eps) * float(np.abs(self.motion.ends).max())
        worst = self.bends.max(axis=1) / (8.0 * _COARSE * chain.size)
        halvings = np.clip(np.ceil(0.5 * np.log2(np.maximum(worst, 1.0))), 0, _GREATEST_SPLIT).astype(int)
        self.width = np.repeat(0.5**halvings, 2**halvings)
        edges = np.append(np.cumsum(self.width) - self.width, len(halvings))
        self.start, self.step = edges[:-1], edges[:-1].astype(np.int64)
        ends = self.ends(edges)
        slack = (self.bends[self.step] * self.width[:, None] ** 2 / 8.0)[:, :, None]
        self.low = np.minimum(ends[:-1], ends[1:]).min(axis=2) - slack
        self.high = np.maximum(ends[:-1], ends[1:]).max(axis=2) + slack

    def _parts(self, x: Array) -> tuple[Index, Array]:
        step = np.minimum(x.astype(np.int64), len(self.bends) - 1)
        return step, x - step

    def time(self, x: Array) -> Array:
        """Return (P,) the times, s, of instants (P,)."""
        (step, share), time = self._parts(x), self.motion.time
        return np.asarray(time[step] + share * (time[step + 1] - time[step]))

    def ends(self, x: Array) -> Array:
        """Return (P, B, 2, 3) the ends of the links, m, at instants (P,)."""
        (step, share), states = self._parts(x), self.motion.states
        return self.chain.states_ends(states[step] + share[:, None] * (states[step + 1] - states[step]))


@dataclass
class Decision:
    """What came out for the pairs of one kind: a proven bound of their distances, m, and where it is not enough.

    Those are the intervals (from, to, names, value): instants, and the least distance found or, in `undecided`, proven.
    """

    bound: float = np.inf
    violated: list[tuple[float, float, tuple[str, str], float]] = field(default_factory=list)
    undecided: list[tuple[float, float, tuple[str, str], float]] = field(default_factory=list)


class _Seen(NamedTuple):
    """Pairs (P,), (P,) that were found too near at instants (P,) of steps (P,)."""

    x: Array
    step: Index
    first: Index
    second: Index


class Decided(Encounters):
    """Encounters along a way that are held against a floor."""

    way: Way
    others: int
    """How many bodies the second ones of the pairs are taken from."""

    @abstractmethod
    def names(self, pair: tuple[int, int]) -> tuple[str, str]:
        """Return the names of the two bodies."""

    @abstractmethod
    def _gaps(self, pair: Pairs, chosen: slice) -> Array:
        """Return (K, P) lower bounds, m, of the distances of pairs in the `chosen` K intervals of the way."""

    def _first_look(self, floor: float, decision: Decision) -> tuple[Index, Pairs]:
        """Return the intervals (P,) and pairs (P,), (P,) that may be nearer than `floor`; notes what the rest keeps."""
        intervals, rows, columns = len(self.way.start), [], []
        pair = self._near(self.way.low[0], self.way.high[0], 0, 0, np.inf)
        size = max(1, _CHUNK // max(1, len(pair[0])))
        for first in range(0, intervals, size):
            gaps = self._gaps(pair, slice(first, first + size))
            row, column = np.nonzero(gaps < floor)
            decision.bound = min(decision.bound, float(gaps[gaps >= floor].min(initial=np.inf)))
            rows.append(row + first)
            columns.append(column)
        column = np.concatenate(columns)
        return np.concatenate(rows), (pair[0][column], pair[1][column])

    def decide(self, floor: float) -> Decision:
        """Return whether all pairs keep `floor`, m, along the whole way."""
        decision, way = Decision(), self.way
        interval, pair = self._first_look(floor, decision)
        start, width, step = way.start[interval], way.width[interval], way.step[interval]
        bend = self._bends(step, pair)
        least, most = floor - CLEARANCE_TOLERANCE - way.rounding, floor - CLEARANCE_TOLERANCE + way.rounding
        seen = [self._seen_at_rows(start, start + width, step, pair, least)]
        for depth in range(_GREATEST_DEPTH):
            if not len(start):
                break
            distance, held = self._held(start, width, pair)
            proven = np.maximum(held - bend * width**2 / 32.0, -self._depths(pair))
            broken = distance < least
            seen.append(
                _Seen(start[broken] + 0.5 * width[broken], step[broken], pair[0][broken], pair[1][broken])
            )
            dropped = self._among(seen, step, pair)
            open_ = (proven < most) & ~dropped
            if depth == _GREATEST_DEPTH - 1 or open_.sum() > _GREATEST_COUNT:
                self._doubt(decision, start, width, pair, proven, open_)
                open_[:] = False
            decision.bound = min(decision.bound, float(proven[~open_].min(initial=np.inf)))
            width = np.tile(0.5 * width[open_], 2)
            start = np.tile(start[open_], 2) + np.repeat([0.0, 1.0], open_.sum()) * width
            step, bend = np.tile(step[open_], 2), np.tile(bend[open_], 2)
            pair = (np.tile(pair[0][open_], 2), np.tile(pair[1][open_], 2))
        self._tell(decision, seen, least)
        return decision

    def _bends(self, step: Index, pair: Pairs) -> Array:
        """Return (P,) bounds, m, of the second derivative of pairs' distances across a plane in steps (P,)."""
        return np.asarray(self.way.bends[step, pair[0]])

    @abstractmethod
    def _depths(self, pair: Pairs) -> Array:
        """Return (P,) how deep pairs can be in one another by this measure, m."""

    def _points_at(self, x: Array, pair: Pairs) -> Array:
        instants, which = np.unique(x, return_inverse=True)
        ends = self.way.ends(instants)
        return self._points(pair, lambda member: ends[which, member], self.way.time(x))

    def _held(self, start: Array, width: Array, pair: Pairs) -> tuple[Array, Array]:
        """Return distances (P,) at the middles of intervals, and the least gap across their planes anywhere."""
        at = np.concatenate([start + 0.5 * width, start, start + width])
        points = self._points_at(at, (np.tile(pair[0], 3), np.tile(pair[1], 3)))
        middle, first, last = np.split(points, 3)
        distance, normal = self.separation(middle, pair)
        gaps = [self._apart(edge, normal, pair) for edge in (middle, first, last)]
        return distance, np.min(gaps, axis=0)

    def _seen_at_rows(self, start: Array, end: Array, step: Index, pair: Pairs, least: float) -> _Seen:
        """Return the pairs that are nearer than `least` where their intervals begin, or where the way ends."""
        last = np.flatnonzero(end == len(self.way.bends))
        x = np.concatenate([start, end[last]])
        first, second = (np.concatenate([side, side[last]]) for side in pair)
        broken = self.separation(self._points_at(x, (first, second)), (first, second))[0] < least
        return _Seen(x[broken], np.concatenate([step, step[last]])[broken], first[broken], second[broken])

    def _among(self, seen: list[_Seen], step: Index, pair: Pairs) -> NDArray[np.bool_]:
        """Return (P,) whether these pairs were seen too near in these steps."""
        count = self.way.bends.shape[1]

        def key(step: Index, first: Index, second: Index) -> Index:
            return np.asarray((step * count + first) * self.others + second)

        known = np.concatenate([key(each.step, each.first, each.second) for each in seen])
        return np.isin(key(step, *pair), known)

    def _doubt(
        self,
        decision: Decision,
        start: Array,
        width: Array,
        pair: Pairs,
        proven: Array,
        chosen: NDArray[np.bool_],
    ) -> None:
        """Note the chosen intervals as undecided, those of the same bodies in the same step as one."""
        found: dict[tuple[int, tuple[str, str]], tuple[float, float, float]] = {}
        for k in np.flatnonzero(chosen).tolist():
            key = int(start[k]), self.names((int(pair[0][k]), int(pair[1][k])))
            low, high, value = found.get(key, (np.inf, -np.inf, np.inf))
            found[key] = min(low, start[k]), max(high, start[k] + width[k]), min(value, proven[k])
        decision.undecided += [(low, high, key[1], value) for key, (low, high, value) in found.items()]

    def _tell(self, decision: Decision, seen: list[_Seen], least: float) -> None:
        """Note when pairs that come too near do so, and how near; steps that follow one another are one finding."""
        x, step, first, second = (np.concatenate(side) for side in zip(*seen, strict=True))
        for a, b in sorted(set(zip(first.tolist(), second.tolist(), strict=True))):
            its = (first == a) & (second == b)
            steps = np.unique(step[its])
            for run in np.split(steps, np.flatnonzero(np.diff(steps) > 1) + 1):
                own = x[its & (step >= run[0]) & (step <= run[-1])]
                looked = np.concatenate([own, (run[:, None] + np.linspace(0.0, 1.0, _SAMPLES)).reshape(-1)])
                pair = np.full(len(looked), a), np.full(len(looked), b)
                distance = self.separation(self._points_at(looked, pair), pair)[0]
                near = looked[distance < least]
                worst = float(distance.min())
                decision.violated.append((float(near.min()), float(near.max()), self.names((a, b)), worst))


class DecidedBody(Decided, AgainstBody):
    """Links against one obstacle, with a floor."""

    def __init__(self, way: Way, body: Body) -> None:
        AgainstBody.__init__(self, way.motion, body)
        self.way, self.others = way, len(self._low)

    def names(self, pair: tuple[int, int]) -> tuple[str, str]:
        """Return link and obstacle."""
        return self.way.chain.member_names[pair[0]], self.body.name

    def decide(self, floor: float) -> Decision:
        """Return whether all links keep `floor`, m, along the whole way; one that is inside a closed mesh does not.

        A link that is outside somewhere, and that nowhere comes near the surface, is outside everywhere.
        """
        decision, radius = super().decide(floor), self.way.chain.radius
        if self.body.shape.closed:
            for row, ends in enumerate(self.motion.ends - self._centers[:, None, None]):
                inside = self.body.encloses(ends.reshape(-1, 3)).reshape(-1, 2).any(axis=1)
                for k in np.flatnonzero(inside).tolist():
                    decision.violated.append((row, row, self.names((k, 0)), -float(radius[k])))
                    decision.bound = min(decision.bound, -float(radius[k]))
        return decision

    def _first_look(self, floor: float, decision: Decision) -> tuple[Index, Pairs]:
        if self.others == 1:
            return super()._first_look(floor, decision)
        way, found = self.way, []
        for k, step in enumerate(way.step.tolist()):
            link, piece = self._near(way.low[k], way.high[k], step, step + 1, floor)
            found.append((np.full(len(link), k), link, piece))
        interval, link, piece = (np.concatenate(side) for side in zip(*found, strict=True))
        decision.bound = min(decision.bound, floor)
        return interval, (link, piece)

    def _gaps(self, pair: Pairs, chosen: slice) -> Array:
        way, link = self.way, pair[0]
        start = way.start[chosen]
        centers = self.body.at(way.time(start)), self.body.at(way.time(start + way.width[chosen]))
        low, high = np.minimum(*centers) + self._low[0], np.maximum(*centers) + self._high[0]
        gap = box_gap(way.low[chosen][:, link], way.high[chosen][:, link], low[:, None], high[:, None])
        return gap - way.chain.radius[link]

    def _depths(self, pair: Pairs) -> Array:
        return self.way.chain.radius[pair[0]]


class DecidedLinks(Decided, AgainstMembers):
    """Links against links, with a floor."""

    def __init__(self, way: Way) -> None:
        AgainstMembers.__init__(self, way.motion)
        self.way, self.others = way, len(way.chain.member_names)

    def names(self, pair: tuple[int, int]) -> tuple[str, str]:
        """Return the two links."""
        first, second = (self.way.chain.member_names[k] for k in pair)
        return first, second

    def _gaps(self, pair: Pairs, chosen: slice) -> Array:
        low, high = self.way.low[chosen], self.way.high[chosen]
        return box_gap(low[:, pair[0]], high[:, pair[0]], low[:, pair[1]], high[:, pair[1]]) - self._depths(
            pair
        )

    def _bends(self, step: Index, pair: Pairs) -> Array:
        return np.asarray(self.way.bends[step, pair[0]] + self.way.bends[step, pair[1]])

    def _depths(self, pair: Pairs) -> Array:
        return self._radii(pair)
