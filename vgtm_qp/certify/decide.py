"""Whether bodies keep their clearances all along a motion: proven, refuted, or neither.

The proof is that of ``verify.clearance``: a plane that separates two bodies at both ends of an interval
separates them throughout, except for the bend of their paths. The proven bound is compared with the clearance
to keep, for all segments of the motion at once; an interval is halved only until that decides.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array, Index
from vgtm_qp.certify.motion import GivenMotion
from vgtm_qp.certify.pairs import Kept, Near
from vgtm_qp.certify.verdict import Finding
from vgtm_qp.verify.clearance import CLEARANCE_TOLERANCE, Pairs

GREATEST_DEPTH = 30
"""Number of halvings from which on nothing more is decided."""
_GREATEST_COUNT = 200_000
"""Number of intervals at a time from which on nothing more is decided."""
_NEAR_ENOUGH = 1e-3
_REPORT_DEPTH = 10
"""Greatest gap between proven bound and least clearance, over the mean link, and halvings to reach it."""
_INSTANTS = 17
"""Number of instants of a segment at which a pair is measured if it comes too near in the segment."""
_POINTS = 2_000_000
"""Number of points of pairs, or of bodies at instants, that are in the memory at a time, nearly."""


@dataclass
class Decision:
    """What is decided of pairs: a proven lower bound of their clearances, m, and the findings."""

    bound: float = np.inf
    violations: list[Finding] = field(default_factory=list)
    undecided: list[Finding] = field(default_factory=list)


def decide(motion: GivenMotion, kept: Sequence[Kept]) -> dict[str, Decision]:
    """Decide the pairs, kind by kind; pairs of one kind have one floor."""
    found = {pairs.kind: Decision() for pairs in kept}
    for kind, decision in found.items():
        Bisection(motion, [pairs for pairs in kept if pairs.kind == kind]).run(decision)
    return found


@dataclass
class _Edge:
    """Pairs (P,) at instants: points (P, 2 V, 3), distances (P,), normals (P, 3), and the gaps of their planes; m."""

    points: Array
    distance: Array
    normal: Array
    held: Array

    @staticmethod
    def none(points: int) -> _Edge:
        return _Edge(np.zeros((0, points, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros(0))

    @staticmethod
    def joined(parts: Sequence[_Edge]) -> _Edge:
        """Return the rows of all parts, one part after another."""
        return _Edge(*(np.concatenate(each) for each in zip(*map(_Edge.arrays, parts), strict=True)))

    @staticmethod
    def interleaved(first: _Edge, second: _Edge) -> _Edge:
        """Return the rows of two, one of each in turn."""
        both = zip(first.arrays(), second.arrays(), strict=True)
        return _Edge(*(np.stack(pair, axis=1).reshape(-1, *pair[0].shape[1:]) for pair in both))

    def at(self, rows: Index) -> _Edge:
        """Return some of the rows."""
        return _Edge(*(array[rows] for array in self.arrays()))

    def arrays(self) -> tuple[Array, ...]:
        """Return the four arrays."""
        return self.points, self.distance, self.normal, self.held


class Bisection:
    """Pairs of one kind that may come too near, each in one segment, and the intervals of these that are open.

    Pairs are in the order of the `kept` that they belong to, and intervals in that of their pairs.
    """

    def __init__(self, motion: GivenMotion, kept: Sequence[Kept]) -> None:
        self.motion, self.kept = motion, kept
        floor = kept[0].floor - CLEARANCE_TOLERANCE
        rounding = max(pairs.rounding for pairs in kept)
        self.least, self.most = floor - rounding, floor + rounding
        self.points = 2 * motion.arm.states_ends(motion.states[:1]).shape[2]
        self.close = _NEAR_ENOUGH * motion.arm.size
        near, self.rest = self._candidates()
        sizes = [len(pairs.gap) for pairs in near]
        self.starts = np.cumsum([0, *sizes])
        self.segment = np.concatenate([pairs.segment for pairs in near])
        self.first, self.second = (np.concatenate([pairs.pair[k] for pairs in near]) for k in (0, 1))
        everything = np.arange(len(self.segment))
        groups = list(self._groups(everything))
        self.bend = np.concatenate(
            [np.zeros(0)]
            + [own.bend(self.segment[rows], self._pair(everything[rows])) for own, rows in groups]
        )
        self.depth = np.concatenate(
            [np.zeros(0)] + [own.depth(self._pair(everything[rows])) for own, rows in groups]
        )
        self.found = np.full(len(everything), np.inf)
        self.proven = np.full(len(everything), np.inf)
        # Times, s: of the least distance found, and the first and the last at which it is too small.
        self.at, self.since, self.until = np.full((3, len(everything)), np.nan)
        self.left: list[tuple[Index, Array, Array, Array]] = []
        """Undecided intervals: pairs, starts and widths as shares of a segment, and proven bounds, m."""

    def _candidates(self) -> tuple[list[Near], float]:
        """Return pairs that may come too near, or else the nearest; and a bound of the others' clearances."""
        nearest = np.inf
        for own in self.kept:
            one = own.nearest()
            if len(one.gap) and one.gap[0] < nearest:
                ends = self.motion.arm.states_ends(self.motion.states[one.segment])
                time = self.motion.time[one.segment]
                edge = _edge_of(own, one.pair, ends, time, np.zeros(1, dtype=np.int64))
                nearest = min(nearest, float(edge.distance[0]))
        found = [own.near(max(own.floor, nearest) + own.rounding) for own in self.kept]
        return [near for near, _ in found], min((rest for _, rest in found), default=np.inf)

    def run(self, decision: Decision) -> None:
        """Decide all pairs, and add the results to `decision`."""
        size = max(1, _POINTS // self.points)
        for first in range(0, len(self.segment), size):
            self._halve(np.arange(first, min(first + size, len(self.segment))))
        self._look_closer()
        self._tell(decision)

    def _halve(self, pair: Index) -> None:
        """Halve the intervals of some pairs until each is decided."""
        start, width = np.zeros(len(pair)), 1.0
        first = self._edge(pair, np.zeros(len(pair)))
        last = self._edge(pair, np.ones(len(pair)), first.normal)
        proven = self._across(pair, first, last)
        for depth in range(GREATEST_DEPTH + 1):
            proven = np.maximum(proven - self.bend[pair] * width**2 / 8.0, -self.depth[pair])
            open_ = self._open(pair, proven, depth)
            np.minimum.at(self.proven, pair[~open_], proven[~open_])
            self._note_undecided(pair, start, width, proven, ~open_)
            if not open_.any():
                break
            rows = np.flatnonzero(open_)
            pair, start, first, last = pair[rows], start[rows], first.at(rows), last.at(rows)
            width /= 2.0
            middle = self._edge(pair, start + width, first.normal)
            first, last = _Edge.interleaved(first, middle), _Edge.interleaved(middle, last)
            start = np.stack([start, start + width], axis=1).reshape(-1)
            pair = np.repeat(pair, 2)
            proven = self._across(pair, first, last)

    def _open(self, pair: Index, proven: Array, depth: int) -> NDArray[np.bool_]:
        """Return (I,) which intervals are halved."""
        found = self.found[pair]
        broken, doubtful = found < self.least, ~self._are_proven(proven)
        wanted = np.where(broken, found, min(float(self.found.min(initial=np.inf)), self.rest)) - self.close
        coarse = (proven < wanted) & (depth < _REPORT_DEPTH)
        open_ = np.where(broken, coarse, doubtful | coarse) & np.isfinite(self.bend[pair])
        if open_.sum() > _GREATEST_COUNT:
            open_ &= doubtful & ~broken
        if depth == GREATEST_DEPTH or open_.sum() > _GREATEST_COUNT:
            open_[:] = False
        return np.asarray(open_)

    def _are_proven(self, proven: Array) -> NDArray[np.bool_]:
        """Return (I,) where proven bounds, m, keep a pair clear; False for NaN."""
        return np.asarray(proven >= self.most)

    def _note_undecided(
        self, pair: Index, start: Array, width: float, proven: Array, closed: NDArray[np.bool_]
    ) -> None:
        left = closed & ~self._are_proven(proven) & ~(self.found[pair] < self.least)
        if left.any():
            self.left.append((pair[left], start[left], np.full(int(left.sum()), width), proven[left]))

    def _across(self, pair: Index, first: _Edge, last: _Edge) -> Array:
        """Return (I,) the gap, m, that the better of the two edges' planes holds at both edges."""
        others = self._apart(
            np.repeat(pair, 2),
            np.stack([last.points, first.points], axis=1).reshape(-1, *first.points.shape[1:]),
            np.stack([first.normal, last.normal], axis=1).reshape(-1, 3),
        )
        held = np.minimum(np.stack([first.held, last.held], axis=1), others.reshape(-1, 2))
        return np.asarray(held.max(axis=1))

    def _edge(self, pair: Index, share: Array, near: Array | None = None) -> _Edge:
        """Return pairs (P,) at shares (P,) of their segments, and record the least distances so far.

        Their normals are searched `near` (P, 3) those.
        """
        x = self.segment[pair] + share
        instants, which = np.unique(x, return_inverse=True)
        if len(instants) > 1 and len(instants) * len(self.motion.arm.radius) * self.points > _POINTS:
            half = len(pair) // 2
            halves = (slice(half), slice(half, None))
            return _Edge.joined(
                [self._edge(pair[k], share[k], None if near is None else near[k]) for k in halves]
            )
        segment = np.minimum(instants.astype(np.int64), len(self.motion.time) - 2)
        ends = self.motion.ends_at(segment, instants - segment)
        time = self.motion.times_at(segment, instants - segment)
        parts = [_Edge.none(2 * ends.shape[2])]
        for own, rows in self._groups(pair):
            hint = None if near is None else near[rows]
            parts.append(_edge_of(own, self._pair(pair[rows]), ends, time, which[rows], hint))
        edge = _Edge.joined(parts)
        self._keep(pair, edge.distance, time[which])
        return edge

    def _keep(self, pair: Index, distance: Array, time: Array) -> None:
        """Record each pair's least distance and its time, and from when to when the pair is too near."""
        np.minimum.at(self.found, pair, distance)
        least = distance <= self.found[pair]
        self.at[pair[least]] = time[least]
        near = distance < self.least
        np.fmin.at(self.since, pair[near], time[near])
        np.fmax.at(self.until, pair[near], time[near])

    def _pair(self, rows: Index) -> Pairs:
        return self.first[rows], self.second[rows]

    def _groups(self, pair: Index) -> Iterator[tuple[Kept, slice]]:
        """Yield each `Kept` with the slice of the pairs (P,), in order, that belong to it."""
        edges = np.searchsorted(pair, self.starts)
        for own, first, last in zip(self.kept, edges[:-1].tolist(), edges[1:].tolist(), strict=True):
            if last > first:
                yield own, slice(first, last)

    def _apart(self, pair: Index, points: Array, normal: Array) -> Array:
        """Return (P,) the gaps, m, that planes across the normals (P, 3) leave between pairs (P,) at points."""
        return np.concatenate(
            [np.zeros(0)]
            + [
                own.apart(points[rows], normal[rows], self._pair(pair[rows]))
                for own, rows in self._groups(pair)
            ]
        )

    def _look_closer(self) -> None:
        """Measure pairs that come too near at more instants: from when to when, and how near."""
        broken = np.flatnonzero(self.found < self.least)[:_GREATEST_COUNT]
        share = np.linspace(0.0, 1.0, _INSTANTS)
        size = max(1, _POINTS // (self.points * len(share)))
        for first in range(0, len(broken), size):
            own = broken[first : first + size]
            self._edge(np.repeat(own, len(share)), np.tile(share, len(own)))

    def _tell(self, decision: Decision) -> None:
        """Add the results to `decision`; the same bodies in successive segments make one finding."""
        decision.bound = float(np.minimum(self.rest, self.proven.min(initial=np.inf)))
        floor, kind = self.kept[0].floor, self.kept[0].kind
        broken = np.flatnonzero(self.found < self.least)
        for names, run in self._runs(broken):
            worst = run[int(np.argmin(self.found[run]))]
            start, end = float(self.since[run].min()), float(self.until[run].max())
            value, at = float(self.found[worst]), float(self.at[worst])
            decision.violations.append(Finding(start, end, kind, names, value, floor, at))
        decision.violations += self._enclosed(decision)
        if not self.left:
            return
        pair, begin, width, proven = (np.concatenate(parts) for parts in zip(*self.left, strict=True))
        for names, run in self._runs(np.unique(pair[~(self.found[pair] < self.least)])):
            own = np.isin(pair, run)
            segment = self.segment[pair[own]]
            low, high = (self.motion.times_at(segment, x[own]) for x in (begin, begin + width))
            found = float(low.min()), float(high.max()), kind, names, float(proven[own].min()), floor
            decision.undecided.append(Finding(*found))

    def _enclosed(self, decision: Decision) -> Iterator[Finding]:
        """Yield a finding for each body inside a closed surface, from the first to the last such state."""
        floor, kind, time = self.kept[0].floor, self.kept[0].kind, self.motion.time
        for own in self.kept:
            states: dict[tuple[int, int], list[int]] = {}
            for state, pair in own.enclosed():
                states.setdefault(pair, []).append(state)
            for (first, second), found in states.items():
                one = np.array([first]), np.array([second])
                depth = -float(np.minimum(own.depth(one), self.motion.arm.length[first])[0])
                decision.bound = min(decision.bound, depth)
                start, end = float(time[found[0]]), float(time[found[-1]])
                yield Finding(start, end, kind, own.names((first, second)), depth, floor, start)

    def _runs(self, pair: Index) -> Iterator[tuple[tuple[str, str], Index]]:
        """Yield the names of each pair of bodies with its pairs (R,) in successive segments."""
        named: dict[tuple[str, str], list[int]] = {}
        for own, rows in self._groups(pair):
            for k in pair[rows].tolist():
                named.setdefault(own.names((int(self.first[k]), int(self.second[k]))), []).append(k)
        for names, found in named.items():
            each = np.array(found)
            each = each[np.argsort(self.segment[each], kind="stable")]
            for run in np.split(each, np.flatnonzero(np.diff(self.segment[each]) > 1) + 1):
                yield names, run


def _edge_of(
    own: Kept, pair: Pairs, ends: Array, time: Array, which: Index, near: Array | None = None
) -> _Edge:
    """Return pairs (P,), each at the instant `which` (P,) of `ends` (U, B, 2, 3), m, and `time` (U,), s."""
    points = own.points(pair, lambda member: ends[which, member], time[which])
    distance, normal = own.separation(points, pair, near)
    return _Edge(points, distance, normal, own.apart(points, normal, pair))
