"""Least clearances of a maneuver: exact at its states, and a proven lower bound between them.

Between two states every node moves along a straight line, so a plane that separates a member from a convex
body at both ends of an interval separates them all through it. Intervals whose best plane proves too little
are halved.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.result.chain import RecordedChain
from vgtm_qp.verify.arm import RecordedArm
from vgtm_qp.verify.distance import Separation, segment_segment
from vgtm_qp.verify.obstacles import Body

Array = NDArray[np.float64]
Index = NDArray[np.int64]

RESOLUTION = 1e-6
"""The bound between states is at most this much below the least clearance found there, m."""

_GREATEST_DEPTH = 48
_GREATEST_COUNT = 1_000_000
_CHUNK = 200_000


@dataclass(frozen=True)
class MemberMotion:
    """The moving arm.

    Attributes
    ----------
    arm : RecordedArm
        Its members.
    time, nodes : (T,), (T, N, 3)
        The states, s and m.
    ends : (T, M, 2, 3)
        Member ends at the states, m.
    """

    arm: RecordedArm
    time: Array
    nodes: Array
    ends: Array = field(init=False)

    def __post_init__(self) -> None:
        """Place the ends of all members at all states."""
        object.__setattr__(self, "ends", np.stack([self.arm.ends(state) for state in self.nodes]))

    def ends_between(self, step: int, member: Index, share: Array) -> Array:
        """Return (P, 2, 3) the ends, m, of members (P,) at shares (P,) of the motion from state `step` to the next."""
        corner = self.arm.corners(member)
        before, after = self.nodes[step][corner], self.nodes[step + 1][corner]
        return self.arm.ends_at(before + share[:, None, None, None] * (after - before), member)

    def bend(self, step: int, member: Index) -> Array:
        """Return (P,) an upper bound, m, of |d2 r / d share2| of members' ends in the motion from state `step`.

        Zero for pin joints. The joint frame's axes are unit vectors of polynomials w of the share, and
        |(w/|w|)''| <= |w''|/|w| + 3 (|w'|/|w|)^2, with |w| bounded below from its ends; inf where that fails.
        """
        if self.arm.has_pin_joints:
            return np.zeros(len(member))
        corner = self.arm.corners(member)
        before, after = self.nodes[step][corner], self.nodes[step + 1][corner]
        first = [place[:, :, 1] - place[:, :, 0] for place in (before, after)]
        second = [place[:, :, 2] - place[:, :, 0] for place in (before, after)]
        x_rate, x_bend = _bisector_bounds(first, second)
        z_rate, z_bend = _normal_bounds(first, second)
        offset = np.abs(self.arm.offset[member])
        y_bend = z_bend + 2.0 * z_rate * x_rate + x_bend
        with np.errstate(invalid="ignore"):
            bound = offset[..., 0] * x_bend + offset[..., 1] * y_bend + offset[..., 2] * z_bend
        return np.asarray(np.where(np.isnan(bound), 0.0, bound).max(axis=1))


@dataclass(frozen=True)
class ChainMotion:
    """A moving serial arm, whose joints move straight from state to state; see :class:`MemberMotion`.

    Attributes
    ----------
    nodes : (T, J + 6)
        Configurations.
    """

    arm: RecordedChain
    time: Array
    nodes: Array
    ends: Array = field(init=False)

    def __post_init__(self) -> None:
        """Place the ends of all links at all states."""
        object.__setattr__(self, "ends", self.arm.ends(self.arm.placed(self.nodes)[0]))

    def ends_between(self, step: int, member: Index, share: Array) -> Array:
        """Return (P, 2, 3) the ends, m, of links (P,) at shares (P,) of the motion from state `step` to the next."""
        before, after = self.nodes[step], self.nodes[step + 1]
        # Many pairs are asked about at few instants.
        instants, which = np.unique(share, return_inverse=True)
        points = self.arm.placed(before + instants[:, None] * (after - before))[0]
        return np.asarray(points[which[:, None], self.arm.links[member]])

    def bend(self, step: int, member: Index) -> Array:
        """Return (P,) an upper bound, m, of |d2 r / d share2| of the links' ends in the motion from state `step`."""
        return np.full(len(member), self.arm.bend(self.nodes[step], self.nodes[step + 1]))


def motion_of(
    arm: RecordedArm | RecordedChain, time: Array, configurations: Array
) -> MemberMotion | ChainMotion:
    """Return the motion of an arm through its configurations: nodes (T, N, 3), or joints and base (T, J + 6)."""
    if isinstance(arm, RecordedChain):
        return ChainMotion(arm, time, configurations)
    return MemberMotion(arm, time, configurations)


def _norm(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def _unit_bounds(least: Array, rate: Array, bend: Array) -> tuple[Array, Array]:
    """Bounds of the first and second derivative of w/|w| from |w| >= least, |w'| <= rate, |w''| <= bend."""
    held = least > 0.0
    safe = np.where(held, least, 1.0)
    relative = rate / safe
    return np.where(held, relative, np.inf), np.where(held, bend / safe + 3.0 * relative**2, np.inf)


def _bisector_bounds(first: list[Array], second: list[Array]) -> tuple[Array, Array]:
    """Bounds of the derivatives of the outward bisector's direction."""
    rates, bends, units = [], [], []
    for before, after in (first, second):
        rate = _norm(after - before)
        least = (_norm(before) + _norm(after) - rate) / 2.0
        unit_rate, unit_bend = _unit_bounds(least, rate, np.zeros_like(rate))
        rates.append(unit_rate)
        bends.append(unit_bend)
        units.append([before / _norm(before)[..., None], after / _norm(after)[..., None]])
    rate, bend = rates[0] + rates[1], bends[0] + bends[1]
    sums = [_norm(units[0][k] + units[1][k]) for k in range(2)]
    return _unit_bounds((sums[0] + sums[1] - rate) / 2.0, rate, bend)


def _normal_bounds(first: list[Array], second: list[Array]) -> tuple[Array, Array]:
    """Bounds of the derivatives of the direction of first x second, which is quadratic in the share."""
    change = [after - before for before, after in (first, second)]
    bend = 2.0 * _norm(np.cross(change[0], change[1]))
    slopes = [np.cross(change[0], second[k]) + np.cross(first[k], change[1]) for k in range(2)]
    rate = np.maximum(_norm(slopes[0]), _norm(slopes[1]))
    areas = [_norm(np.cross(first[k], second[k])) for k in range(2)]
    return _unit_bounds((areas[0] + areas[1] - rate) / 2.0, rate, bend)


@dataclass
class Least:
    """The least clearance met so far, m, and between what and where."""

    value: float = np.inf
    where: str = ""


class Encounters(ABC):
    """All pairs of one member and one other thing that must keep apart."""

    def __init__(self, motion: MemberMotion | ChainMotion) -> None:
        self.motion = motion
        self.held_from: dict[tuple[int, int], int] = {}
        """First state at which each pair counts; pairs that are missing count from the first state on."""

    @abstractmethod
    def pairs_named(self, name: str) -> list[tuple[int, int]]:
        """Return the pairs of that name, an empty list if there are none."""

    def _held(self, pairs: tuple[Index, Index], state: int) -> tuple[Index, Index]:
        """Return those of the pairs (P,), (P,) that count at a state and in the motion from it."""
        if not self.held_from:
            return pairs
        each = zip(pairs[0].tolist(), pairs[1].tolist(), strict=True)
        kept = np.array([self.held_from.get(pair, 0) <= state for pair in each], dtype=bool)
        return pairs[0][kept], pairs[1][kept]

    @abstractmethod
    def near(self, low: Array, high: Array, start: int, stop: int, limit: float) -> tuple[Index, Index]:
        """Return the pairs (P,), (P,) that may be nearer than `limit`, m.

        `low`, `high` (M, 3) bound each member from state `start` to state `stop`.
        """

    @abstractmethod
    def place(self, step: int, pair: tuple[Index, Index], share: Array) -> Array:
        """Return (P, 2 or 4, 3) the ends that the pairs' separation depends on, m."""

    @abstractmethod
    def separation(self, points: Array, pair: tuple[Index, Index]) -> Separation:
        """Return the exact surface distance (P,), m, and the normal (P, 3) at those ends."""

    @abstractmethod
    def apart(self, points: Array, normal: Array, pair: tuple[Index, Index]) -> Array:
        """Return (P,) how far a plane across `normal` holds the surfaces apart, m.

        With a zero normal it is the value of axes that touch.
        """

    @abstractmethod
    def bend(self, step: int, pair: tuple[Index, Index]) -> Array:
        """Return (P,) bounds, m, of the pairs' second derivative that comes from turning joints."""

    @abstractmethod
    def name(self, pair: tuple[int, int]) -> str:
        """Return what the pair is called."""

    def at_state(self, state: int) -> Least:
        """Return the exact least clearance at a state."""
        ends = self.motion.ends[state]
        low, high = ends.min(axis=1), ends.max(axis=1)
        step = max(min(state, len(self.motion.nodes) - 2), 0)
        share = 1.0 if step < state else 0.0
        limit, least = self._first_limit(low, high, state, step, share), Least()
        first, second = self._held(self.near(low, high, state, state, limit), state)
        for part in _parts(len(first)):
            pair = (first[part], second[part])
            distance, _ = self.separation(self.place(step, pair, np.full(len(pair[0]), share)), pair)
            k = int(np.argmin(distance))
            if distance[k] < least.value:
                where = f"state {state}: {self.name((int(pair[0][k]), int(pair[1][k])))}"
                least = Least(float(distance[k]), where)
        return least

    def _first_limit(self, low: Array, high: Array, state: int, step: int, share: float) -> float:
        """Return an upper bound of the least clearance, from the pairs that a growing limit meets first."""
        reach = 0.05 * float(self.motion.arm.length.max())
        for _ in range(40):
            pair = self._held(self.near(low, high, state, state, reach), state)
            if len(pair[0]):
                pair = (pair[0][:_CHUNK], pair[1][:_CHUNK])
                distance, _ = self.separation(self.place(step, pair, np.full(len(pair[0]), share)), pair)
                # Boxes along the axes may be exactly as far apart as the pair: rounding must not drop it.
                return float(distance.min()) + RESOLUTION
            reach *= 2.0
        return np.inf

    def between(self, step: int, limit: Least, bound: Least) -> tuple[Least, Least]:
        """Return `limit` and `bound` lowered by the motion from state `step` to the next.

        `limit` is the least clearance at any instant looked at; `bound` is proven to be below every clearance
        on the steps seen so far, and comes within `RESOLUTION` of `limit`.
        """
        ends = self.motion.ends[step : step + 2]
        low, high = ends.min(axis=(0, 2)), ends.max(axis=(0, 2))
        slack = self.motion.bend(step, np.arange(len(low)))[:, None] / 8.0
        pairs = self._held(self.near(low - slack, high + slack, step, step + 1, limit.value), step)
        for part in _parts(len(pairs[0])):
            limit, bound = self.divide(step, (pairs[0][part], pairs[1][part]), limit, bound)
        return limit, bound

    def divide(self, step: int, pair: tuple[Index, Index], limit: Least, bound: Least) -> tuple[Least, Least]:
        """Return `limit` and `bound` lowered by pairs (P,), (P,) in the motion from state `step` to the next."""
        count = len(pair[0])
        start, width = np.zeros(count), 1.0
        bend = self.bend(step, pair)
        for depth in range(_GREATEST_DEPTH):
            edges = [self.place(step, pair, start), self.place(step, pair, np.minimum(start + width, 1.0))]
            proven = np.full(len(start), -np.inf)
            for points, share in zip(edges, (start, start + width), strict=True):
                distance, normal = self.separation(points, pair)
                k = int(np.argmin(distance))
                if distance[k] < limit.value:
                    where = (
                        f"step {step + 1} at {share[k]:.4f}: {self.name((int(pair[0][k]), int(pair[1][k])))}"
                    )
                    limit = Least(float(distance[k]), where)
                held = np.minimum(*(self.apart(ends, normal, pair) for ends in edges))
                touching = self.apart(points, np.zeros_like(normal), pair)
                proven = np.maximum(proven, np.maximum(held - bend * width**2 / 8.0, touching))
            open_ = (proven < limit.value - RESOLUTION) & np.isfinite(bend)
            if depth == _GREATEST_DEPTH - 1 or open_.sum() > _GREATEST_COUNT:
                open_[:] = False
            settled = np.where(open_, np.inf, proven)
            k = int(np.argmin(settled))
            if settled[k] < bound.value:
                bound = Least(float(settled[k]), self._place_name(step, start, pair, k))
            if not open_.any():
                break
            width /= 2.0
            start = np.concatenate([start[open_], start[open_] + width])
            pair = (np.tile(pair[0][open_], 2), np.tile(pair[1][open_], 2))
            bend = np.tile(bend[open_], 2)
        return limit, bound

    def _place_name(self, step: int, share: Array, pair: tuple[Index, Index], k: int) -> str:
        return f"step {step + 1} at {share[k]:.4f}: {self.name((int(pair[0][k]), int(pair[1][k])))}"


class AgainstBody(Encounters):
    """Members against the convex pieces of one obstacle, seen from its moving centre."""

    def __init__(self, motion: MemberMotion | ChainMotion, body: Body) -> None:
        super().__init__(motion)
        self.body = body
        corners = body.corners
        self._low, self._high = corners.min(axis=1), corners.max(axis=1)
        self._centers = np.stack([body.at(float(time)) for time in motion.time])

    def pairs_named(self, name: str) -> list[tuple[int, int]]:
        """Return all pieces of the body with the member of ``member / obstacle``."""
        return [
            (member, piece)
            for member in range(len(self.motion.arm.member_names))
            if self.name((member, 0)) == name
            for piece in range(len(self._low))
        ]

    def near(self, low: Array, high: Array, start: int, stop: int, limit: float) -> tuple[Index, Index]:
        """Return the pairs (member, piece) whose bounding boxes are nearer than `limit`."""
        reach = limit + self.motion.arm.radius
        shift = self._centers[start : stop + 1]
        low, high = low - shift.max(axis=0), high - shift.min(axis=0)
        whole = _box_gap(low, high, self._low.min(axis=0), self._high.max(axis=0))
        member = np.flatnonzero(whole < reach)
        if len(self._low) == 1 or not len(member):
            return member, np.zeros_like(member)
        limits = low[member].min(axis=0), high[member].max(axis=0)
        piece = np.flatnonzero(_box_gap(self._low, self._high, *limits) < reach[member].max())
        found = [_pairs_of(m, piece, low, high, self._low, self._high, reach) for m in member]
        return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])

    def at_state(self, state: int) -> Least:
        """Return the exact least clearance at a state; a member inside a closed mesh touches it."""
        least = super().at_state(state)
        ends = self.motion.ends[state] - self._centers[state]
        inside = self.body.encloses(ends.reshape(-1, 3)).reshape(-1, 2).any(axis=1)
        for member in np.flatnonzero(inside).tolist():
            value = -float(self.motion.arm.radius[member])
            if value < least.value:
                least = Least(value, f"state {state}: {self.name((member, 0))}")
        return least

    def place(self, step: int, pair: tuple[Index, Index], share: Array) -> Array:
        """Return (P, 2, 3) the members' ends relative to the obstacle's centre."""
        step_to = min(step + 1, len(self._centers) - 1)
        center = self._centers[step] + share[:, None] * (self._centers[step_to] - self._centers[step])
        if step_to == step:
            return np.asarray(self.motion.ends[step][pair[0]] - center[:, None])
        return np.asarray(self.motion.ends_between(step, pair[0], share) - center[:, None])

    def separation(self, points: Array, pair: tuple[Index, Index]) -> Separation:
        """Return surface distances and normals."""
        distance, normal = self.body.separation(points[:, 0], points[:, 1], pair[1])
        return distance - self.motion.arm.radius[pair[0]], normal

    def apart(self, points: Array, normal: Array, pair: tuple[Index, Index]) -> Array:
        """Return how far a plane across `normal` holds member and piece apart."""
        nearest = np.einsum("pec,pc->pe", points, normal).min(axis=1)
        return np.asarray(nearest - self.body.support(normal, pair[1]) - self.motion.arm.radius[pair[0]])

    def bend(self, step: int, pair: tuple[Index, Index]) -> Array:
        """Return bounds of the members' bending paths."""
        return self.motion.bend(step, pair[0])

    def name(self, pair: tuple[int, int]) -> str:
        """Return ``member / obstacle``."""
        return f"{self.motion.arm.member_names[pair[0]]} / {self.body.name}"


class AgainstMembers(Encounters):
    """Members against members that they share no node with."""

    def pairs_named(self, name: str) -> list[tuple[int, int]]:
        """Return the two members of ``member / member`` in either order."""
        names, members = self.motion.arm.member_names, self.motion.arm.members
        apart = [k for k, first in enumerate(names) if name.startswith(f"{first} / ")]
        found = [(a, b) for a in apart for b in range(len(names)) if self.name((a, b)) == name]
        found = [
            pair for pair in found if not set(members[pair[0]].tolist()) & set(members[pair[1]].tolist())
        ]
        return [*found, *((b, a) for a, b in found)]

    def near(self, low: Array, high: Array, start: int, stop: int, limit: float) -> tuple[Index, Index]:  # noqa: ARG002
        """Return the pairs whose bounding boxes are nearer than `limit`, swept along the longest axis."""
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
        a, b = a[~shared], b[~shared]
        gap = _box_gap(low[a], high[a], low[b], high[b]) - radius[a] - radius[b]
        return a[gap < limit], b[gap < limit]

    def place(self, step: int, pair: tuple[Index, Index], share: Array) -> Array:
        """Return (P, 4, 3) the ends of both members."""
        if len(self.motion.nodes) == 1:
            return np.concatenate([self.motion.ends[0][member] for member in pair], axis=1)
        return np.concatenate([self.motion.ends_between(step, member, share) for member in pair], axis=1)

    def separation(self, points: Array, pair: tuple[Index, Index]) -> Separation:
        """Return surface distances and normals."""
        distance, normal = segment_segment(*(points[:, k] for k in range(4)))
        return distance - self._radii(pair), normal

    def apart(self, points: Array, normal: Array, pair: tuple[Index, Index]) -> Array:
        """Return how far a plane across `normal` holds the members apart."""
        along = np.einsum("pec,pc->pe", points, normal)
        return np.asarray(along[:, :2].min(axis=1) - along[:, 2:].max(axis=1) - self._radii(pair))

    def bend(self, step: int, pair: tuple[Index, Index]) -> Array:
        """Return bounds of both members' bending paths together."""
        return self.motion.bend(step, pair[0]) + self.motion.bend(step, pair[1])

    def name(self, pair: tuple[int, int]) -> str:
        """Return ``member / member``."""
        return " / ".join(self.motion.arm.member_names[k] for k in pair)

    def _radii(self, pair: tuple[Index, Index]) -> Array:
        return np.asarray(self.motion.arm.radius[pair[0]] + self.motion.arm.radius[pair[1]])


def _box_gap(low: Array, high: Array, other_low: Array, other_high: Array) -> Array:
    """Return the distances between axis-aligned boxes, m."""
    apart = np.maximum(np.maximum(other_low - high, low - other_high), 0.0)
    return np.asarray(np.linalg.norm(apart, axis=-1))


def _pairs_of(
    member: int | np.int64,
    piece: Index,
    low: Array,
    high: Array,
    piece_low: Array,
    piece_high: Array,
    reach: Array,
) -> tuple[Index, Index]:
    gap = _box_gap(low[member], high[member], piece_low[piece], piece_high[piece])
    close = piece[gap < reach[member]]
    return np.full(len(close), member), close


def _parts(count: int) -> list[slice]:
    """Return slices of at most `_CHUNK` pairs."""
    return [slice(k, min(k + _CHUNK, count)) for k in range(0, count, _CHUNK)]
