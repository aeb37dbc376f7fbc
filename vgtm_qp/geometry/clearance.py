"""Clearance of an arm of capsules: near pairs, least distances, proofs between two states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vgtm_qp.geometry.candidates import Candidates, Group, Kernels, Members
from vgtm_qp.geometry.fcl_queries import FclQueries
from vgtm_qp.geometry.shapes import Obstacle, Pieces
from vgtm_qp.geometry.sweep import Found, sweep_group

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

_SECOND_CONTACT = 0.2
"""Fraction of a member's length that two contacts of it with one piece are apart, at least."""


class Pair(NamedTuple):
    """A member and a piece of an obstacle, or another member."""

    member: int
    other: int
    is_self: bool


@dataclass(frozen=True, eq=False)
class NearPairs:
    """K near pairs of surfaces.

    Attributes
    ----------
    member : (K,) int
    other : (K,) int
        Piece index, or the other member.
    is_self : (K,) bool
    distance : (K,)
        From surface to surface, m; negative where they intersect.
    normal : (K, 3)
        Unit, from the obstacle or other member to the member: the gradient of `distance` with respect to the
        witness point.
    t, t_other : (K,)
        Parameters of the witness points on the member and, for self pairs, on the other member (else 0).
    normal_speed : (K,)
        Velocity of the obstacle along `normal`, m/s.
    point : (K, 3)
        Witness point on the piece, or on the other member's axis, m.
    names : Names
        What :meth:`name` reads.
    """

    member: Index
    other: Index
    is_self: Mask
    distance: Array
    normal: Array
    t: Array
    t_other: Array
    normal_speed: Array
    point: Array
    names: Names

    def __len__(self) -> int:
        return len(self.member)

    def name(self, k: int) -> str:
        """Return the name of row `k`: ``"clearance: member L3-2 / right cube"``."""
        return self.names.clearance(Pair(int(self.member[k]), int(self.other[k]), bool(self.is_self[k])))


@dataclass(frozen=True)
class Names:
    """Names of members and of the obstacle that each piece belongs to."""

    members: tuple[str, ...]
    obstacles: tuple[str, ...]
    owner: tuple[int, ...]

    def clearance(self, pair: Pair) -> str:
        """Return the name of a clearance row."""
        other = (
            f"member {self.members[pair.other]}" if pair.is_self else self.obstacles[self.owner[pair.other]]
        )
        return f"clearance: member {self.members[pair.member]} / {other}"


@dataclass(frozen=True, eq=False)
class BetweenReport:
    """What was proven about a motion from one state to the next.

    Attributes
    ----------
    certified : bool
        No pair comes below the floor. False may also mean that the proof was not found.
    clearance : float
        Proven lower bound of the surface distances over the motion; the least distance found where not
        certified.
    fraction : (F,)
        For each failing pair, where on the motion (0 < s < 1) the least distance was found.
    failing : NearPairs
        The failing pairs there, one row each.
    """

    certified: bool
    clearance: float
    fraction: Array
    failing: NearPairs

    def failing_parameters(self, apart: float = 0.05) -> list[float]:
        """Return the fractions, worst pair first, without those nearer than `apart` to a worse one."""
        chosen: list[float] = []
        for k in np.argsort(self.failing.distance, kind="stable"):
            s = float(self.fraction[k])
            if all(abs(s - c) > apart for c in chosen):
                chosen.append(s)
        return chosen


class Clearance:
    """Keeps the candidate pairs of an arm; one thread at a time.

    Parameters
    ----------
    members : (M, 2) int
        Nodes of each member.
    radius : (M,)
        Capsule radii, m.
    obstacles
        See :mod:`vgtm_qp.geometry.shapes`.
    safe, influence : float
        Surface distance to keep, and that from which a pair is near, m.
    self_collision : bool
        Whether pairs of members that share no node count.
    member_names
        Default ``"0"``, ``"1"``...
    self_influence : float or None
        The same as `influence` for two members; by default at most twice `safe` and the largest radius
        together.
    fcl_reach : float or None
        Pairs nearer than this are asked of FCL too; by default 2.5 `safe`.
    """

    def __init__(
        self,
        members: ArrayLike,
        radius: ArrayLike,
        obstacles: Sequence[Obstacle] = (),
        *,
        safe: float,
        influence: float,
        self_collision: bool = True,
        member_names: Sequence[str] | None = None,
        self_influence: float | None = None,
        fcl_reach: float | None = None,
    ) -> None:
        self.members = np.asarray(members, dtype=np.int64).reshape(-1, 2)
        self.radius = np.broadcast_to(np.asarray(radius, dtype=float), len(self.members)).copy()
        self.obstacles = tuple(obstacles)
        self.safe, self.influence, self.self_collision = safe, influence, self_collision
        widest = 2.0 * (safe + float(self.radius.max(initial=0.0)))
        self.self_influence = min(influence, widest) if self_influence is None else self_influence
        self.fcl_reach = 2.5 * safe if fcl_reach is None else fcl_reach
        self.pieces = Pieces(self.obstacles)
        names = tuple(member_names) if member_names is not None else tuple(map(str, range(len(self.members))))
        self.names = Names(names, tuple(o.name for o in self.obstacles), tuple(self.pieces.obstacle.tolist()))
        self.fcl = FclQueries(self.pieces)
        self._members = Members(self.members, self.radius)
        self._kernels = Kernels()
        self._candidates: Candidates | None = None
        self._wasted = 0

    def near(
        self,
        X: Array,
        time: float = 0.0,
        reach: float | None = None,
        use_fcl: bool = True,
        self_reach: float | None = None,
    ) -> NearPairs:
        """Return all pairs whose surfaces are nearer than `reach`, exact.

        Parameters
        ----------
        X : (N, 3)
            Node positions, m.
        time : float
            s.
        reach, self_reach : float or None
            m; by default `influence` and the lesser of `reach` and `self_influence`.
        use_fcl : bool
            Ask python-fcl for the pairs nearer than `fcl_reach`; each answer is guarded.
        """
        reach = self.influence if reach is None else reach
        self_reach = min(reach, self.self_influence) if self_reach is None else self_reach
        candidates, motion = self._covering(X, time, reach, self_reach)
        elapsed = time - candidates.time
        parts = []
        wasted = 0
        for group in candidates.groups:
            limit = self_reach if group.is_self else reach
            rows = np.flatnonzero(group.lower(motion, elapsed) < limit)
            if len(rows):
                part = self._near_rows(group, X, time, rows, limit, use_fcl)
                wasted += len(rows) - len(part)
                parts.append(part)
        self._tire(candidates, X, time, wasted)
        return _join(parts, self.names)

    def _tire(self, candidates: Candidates, X: Array, time: float, wasted: int) -> None:
        """Renew the reference once the pairs evaluated for nothing have cost as much as that."""
        self._wasted += wasted
        if self._wasted > sum(len(g.member) for g in candidates.groups):
            candidates.refresh(X, time)
            self._wasted = 0

    def _near_rows(
        self, group: Group, X: Array, time: float, rows: Index, limit: float, use_fcl: bool
    ) -> NearPairs:
        segments, others = group.segments(X, rows), group.others(X, time, rows)
        outputs = group.exact_of(segments, others, rows)
        kept = np.flatnonzero(outputs[0][:, 0] < limit)
        if use_fcl and group.shape in FclQueries.SHAPES:
            asked = kept[outputs[0][kept, 0] < self.fcl_reach]
            self.fcl.improve(
                group.shape, group.other[rows], group.radius[rows], segments, others, outputs, asked
            )
        second = kept[
            (np.abs(outputs[4][kept, 0] - outputs[1][kept, 0]) >= _SECOND_CONTACT)
            & (outputs[5][kept, 0] < limit)
        ]
        return self._pairs(group, rows, segments, outputs, kept, second)

    def _pairs(
        self, group: Group, rows: Index, segments: Array, outputs: list[Array], first: Index, second: Index
    ) -> NearPairs:
        """Return the rows `first` by their witness points and `second` by their other contacts."""
        both = np.concatenate([first, second])
        member, other = group.member[rows[both]], group.other[rows[both]]
        count = len(first)

        def column(k: int, k_second: int) -> Array:
            values: Array = outputs[k][both]
            values[count:] = outputs[k_second][second]
            return values

        t, distance, normal = column(1, 4)[:, 0], column(0, 5)[:, 0], column(2, 6)
        if group.is_self:
            t_other, speed = column(7, 8)[:, 0], np.zeros(len(both))
        else:
            t_other = np.zeros(len(both))
            speed = np.einsum("kc,kc->k", normal, self.pieces.velocity[other])
        ends = segments[both]
        axis = ends[:, :3] + t[:, None] * (ends[:, 3:] - ends[:, :3])
        point = axis - (distance + group.radius[rows[both]])[:, None] * normal
        is_self = np.full(len(both), group.is_self)
        return NearPairs(member, other, is_self, distance, normal, t, t_other, speed, point, self.names)

    def least(self, X: Array, time: float = 0.0, *, among: str = "all") -> tuple[float, Pair | None]:
        """Return the exact least surface distance and its pair; ``(inf, None)`` where there is no pair.

        Parameters
        ----------
        among : {"all", "obstacles", "members"}
            Pairs with obstacles, pairs of members, or both.
        """
        wanted = {"all": (False, True), "obstacles": (False,), "members": (True,)}[among]
        best, pair = np.inf, None
        reach, self_reach = self.influence, self.self_influence
        extent = float(np.ptp(X, axis=0).sum()) + self._spread(X, time)
        while True:
            candidates, motion = self._covering(X, time, reach, self_reach)
            for group in candidates.groups:
                if group.is_self in wanted:
                    distance, row = self._least_of(group, candidates, motion, X, time, best)
                    if distance < best:
                        best, pair = (
                            distance,
                            Pair(int(group.member[row]), int(group.other[row]), group.is_self),
                        )
            enough = all(
                best <= r or r > extent
                for r, s in ((reach, False), (self_reach, True))
                if self._asks(s, wanted)
            )
            if enough:
                return best, pair
            if self._asks(False, wanted) and best > reach:
                reach = max(2.0 * reach, 1e-3)
            if self._asks(True, wanted) and best > self_reach:
                self_reach = max(2.0 * self_reach, 1e-3)

    def _asks(self, is_self: bool, wanted: tuple[bool, ...]) -> bool:
        return is_self in wanted and (self.self_collision if is_self else len(self.pieces) > 0)

    def _spread(self, X: Array, time: float) -> float:
        """Return a length that no distance to an obstacle exceeds."""
        if not len(self.pieces):
            return 0.0
        centers = self.pieces.center + time * self.pieces.velocity
        return float(np.linalg.norm(centers - X[0], axis=1).max())

    @staticmethod
    def _least_of(
        group: Group, candidates: Candidates, motion: Array, X: Array, time: float, best: float
    ) -> tuple[float, int]:
        """Return the least distance of a group below `best` and its row, by way of the lower bounds."""
        lower = group.lower(motion, time - candidates.time)
        row = int(np.argmin(lower)) if len(lower) else -1
        if row < 0 or lower[row] >= best:
            return np.inf, -1
        best = min(best, float(group.exact(X, time, np.array([row]))[0][0, 0]))
        rows = np.flatnonzero(lower <= best)
        distance = group.exact(X, time, rows)[0][:, 0]
        k = int(np.argmin(distance))
        return float(distance[k]), int(rows[k])

    def between(
        self, start: Array, end: Array, start_time: float, end_time: float, floor: float
    ) -> BetweenReport:
        """Prove that no surface distance falls below `floor` while the nodes move on straight lines.

        Motion bounds first, then fixed separating planes, then halves of the time for the pairs that are
        left. What is not proven after twelve halvings is refused: the answer may be a false alarm, never a
        false proof.

        Parameters
        ----------
        start, end : (N, 3)
            Node positions, m.
        start_time, end_time : float
            s; the obstacles move meanwhile.
        floor : float
            m; not negative.
        """
        floor = max(floor, 0.0)
        candidates, motion = self._covering(start, start_time, floor, floor, end, end_time)
        elapsed = max(abs(start_time - candidates.time), abs(end_time - candidates.time))
        proven = min(candidates.beyond(motion, candidates.time + elapsed))
        found: list[tuple[Group, Found]] = []
        for group in candidates.groups:
            lower = group.lower(motion, elapsed)
            open_ = lower < floor
            proven = min(proven, float(lower[~open_].min(initial=np.inf)))
            rows = np.flatnonzero(open_)
            if len(rows):
                result = sweep_group(group, rows, start, end, start_time, end_time, floor)
                proven = min(proven, result.proven)
                if len(result.rows):
                    found.append((group, result))
        failing = _join([self._failing(g, r, start, end, start_time, end_time) for g, r in found], self.names)
        fraction = np.concatenate([np.zeros(0), *(r.fraction for _, r in found)])
        least = min(proven, float(failing.distance.min(initial=np.inf)))
        return BetweenReport(not found, least, fraction, failing)

    def _failing(
        self, group: Group, found: Found, start: Array, end: Array, start_time: float, end_time: float
    ) -> NearPairs:
        segments, others = found.placed(group, start, end, start_time, end_time)
        outputs = group.exact_of(segments, others, found.rows)
        every = np.arange(len(found.rows))
        return self._pairs(group, found.rows, segments, outputs, every, every[:0])

    def _covering(
        self,
        X: Array,
        time: float,
        reach: float,
        self_reach: float,
        end: Array | None = None,
        end_time: float | None = None,
    ) -> tuple[Candidates, Array]:
        """Return candidates with every pair nearer than the reaches, and the motion since their reference.

        With an `end` they hold on the whole straight way there, and the motion is the greatest on it.
        """
        candidates = self._candidates
        if candidates is not None:
            motion, last = self._motion(candidates, X, end), self._last(candidates, time, end_time)
            far, far_self = candidates.beyond(motion, last)
            if far >= reach and far_self >= self_reach:
                return candidates, motion
        travel = 0.0 if end is None else float(self._members.motion(end, X).max(initial=0.0))
        drift = 0.0 if end_time is None else float(self.pieces.speed.max(initial=0.0)) * abs(end_time - time)
        horizon = max(reach, self.influence) + self.influence + travel + drift
        self_horizon = max(self_reach, self.self_influence) + self.self_influence + 2.0 * travel
        self._candidates = candidates = Candidates(
            self._members,
            self.pieces,
            self._kernels,
            X,
            time,
            horizon,
            self_horizon if self.self_collision else None,
        )
        self._wasted = 0
        return candidates, self._motion(candidates, X, end)

    @staticmethod
    def _motion(candidates: Candidates, X: Array, end: Array | None) -> Array:
        motion = candidates.motion(X)
        return motion if end is None else np.maximum(motion, candidates.motion(end))

    @staticmethod
    def _last(candidates: Candidates, time: float, end_time: float | None) -> float:
        """Return which of the two times is farther from that of the candidates."""
        times = (time,) if end_time is None else (time, end_time)
        return max(times, key=lambda t: abs(t - candidates.time))


_COLUMNS = ("member", "other", "is_self", "distance", "normal", "t", "t_other", "normal_speed", "point")


def _join(parts: list[NearPairs], names: Names) -> NearPairs:
    if len(parts) == 1:
        return parts[0]
    if not parts:
        none, index, rows = np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros((0, 3))
        return NearPairs(index, index, np.zeros(0, dtype=bool), none, rows, none, none, none, rows, names)
    columns = {key: np.concatenate([getattr(part, key) for part in parts]) for key in _COLUMNS}
    return NearPairs(**columns, names=names)
