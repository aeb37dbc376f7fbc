"""Clearance of an arm of capsules: near pairs, least distances, proofs between two states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vgtm_qp.geometry.candidates import Candidates
from vgtm_qp.geometry.fcl_queries import FclQueries
from vgtm_qp.geometry.formulas import FURTHEST
from vgtm_qp.geometry.groups import Contacts, Group, Kernels, Members, Motion
from vgtm_qp.geometry.pairs import BetweenReport, Names, NearPairs, Pair, join
from vgtm_qp.geometry.shapes import GeometryError, Obstacle, Pieces
from vgtm_qp.geometry.solids import Solid
from vgtm_qp.geometry.sweep import Found, sweep_group

__all__ = ["BetweenReport", "Clearance", "NearPairs", "Pair"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_AMONG = {"all": (False, True), "obstacles": (False,), "members": (True,)}
_FIRST = 16


_FEW_PAIRS = 20_000
_MOST_WATCHED = 8000


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
    ends : callable or None
        From node positions (N, 3) to member ends (M, 2, 3), m, where those are not the nodes.
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
        ends: Callable[[Array], Array] | None = None,
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
        self._ends = ends
        points = self.members if ends is None else np.arange(2 * len(self.members)).reshape(-1, 2)
        self._members = Members(points, self.radius, self.members)
        self._kernels = Kernels()
        shapes = {*self.pieces.shape.tolist()} | ({"segment"} if self_collision else set())
        self._kernels.prepare(sorted(shapes), rests=self.rests)
        self._candidates: Candidates | None = None
        self._solids = {
            k: Solid(o.pieces[:, :9].reshape(-1, 3, 3), o.velocity)
            for k, o in enumerate(self.obstacles)
            if o.shape == "triangle" and o.solid
        }

    def near(
        self,
        X: Array,
        time: float = 0.0,
        reach: float | None = None,
        use_fcl: bool = True,
        self_reach: float | None = None,
        fcl_reach: float | None = None,
    ) -> NearPairs:
        """Return all pairs whose surfaces are nearer than `reach`, exact.

        A pair has two rows where the nearest point of a member is not unique. Of the triangles of a mesh
        only those stay that differ in normal or in the part of the member they face.

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
        fcl_reach : float or None
            m; by default that of this object.
        """
        reach = self.influence if reach is None else reach
        fcl_reach = (self.fcl_reach if fcl_reach is None else fcl_reach) if use_fcl else 0.0
        self_reach = min(reach, self.self_influence) if self_reach is None else self_reach
        X = self._points(X)
        candidates, motion = self._covering(X, time, reach, self_reach)
        parts = []
        for group in candidates.groups:
            limit = self_reach if group.is_self else reach
            rows = np.flatnonzero(group.lower(motion, limit)[0] < limit)
            if len(rows):
                contacts, two = self._contacts(group, X, time, rows, min(limit, fcl_reach))
                first = np.flatnonzero(contacts.distance < limit)
                candidates.waste(group, len(rows) - len(first))
                second = first[two[first] & (contacts.distance_second[first] < limit)]
                part = self._pairs(group, rows, contacts, first, second)
                parts.append(self._distinct(part) if group.shape == "triangle" else part)
        candidates.tire(X, time)
        return self._with_enclosed(join(parts, self.names), X, time)

    @property
    def rests(self) -> bool:
        """Whether nothing moves but the arm, members end at their nodes, there are no meshes and not too many pairs."""
        members, pieces = len(self.members), self.pieces
        simple = not pieces.moving and self.ends_at_nodes and "triangle" not in pieces.shape
        count = members * len(pieces) + (members * (members - 1) // 2 if self.self_collision else 0)
        return simple and members > 1 and 0 < count <= _MOST_WATCHED

    @property
    def ends_at_nodes(self) -> bool:
        """Whether members end at nodes: joints have no extent."""
        return self._ends is None

    def every_pair(self, X: Array) -> Candidates:
        """Return the list of all pairs, with their distances at node positions `X` (N, 3) and time 0."""
        horizon = np.inf if self.self_collision else None
        arm = (self._members, self.pieces, self._kernels)
        return Candidates(*arm, self._points(X), 0.0, np.inf, horizon)

    def _points(self, X: Array) -> Array:
        """Return the points that members end at, from node positions (N, 3)."""
        return X if self._ends is None else self._ends(X).reshape(-1, 3)

    def _contacts(
        self, group: Group, X: Array, time: float, rows: Index, fcl_reach: float
    ) -> tuple[Contacts, NDArray[np.bool_]]:
        """Return the contacts of `rows`, and which have a second one: by the closed form, whatever FCL says (K,)."""
        segments, others = group.segments(X, rows), group.others(X, time, rows)
        contacts = group.contacts_of(segments, others, rows)
        two = contacts.two()
        if fcl_reach > 0.0 and group.shape in FclQueries.SHAPES:
            asked = np.flatnonzero(contacts.distance < fcl_reach)
            self.fcl.improve(group.other[rows], group.radius[rows], segments, others, contacts, asked, two)
        return contacts, two

    def _pairs(self, group: Group, rows: Index, contacts: Contacts, first: Index, second: Index) -> NearPairs:
        """Return the rows `first` by their witness points and `second` by their other contacts."""
        c = contacts
        distance, t, s = c.distance[first], c.t[first], c.s[first]
        normal, point = c.normal[first], c.point[first]
        if len(second):
            distance = np.concatenate([distance, c.distance_second[second]])
            t, s = np.concatenate([t, c.t_second[second]]), np.concatenate([s, c.s_second[second]])
            normal = np.concatenate([normal, c.normal_second[second]])
            point = np.concatenate([point, c.point_second[second]])
            first = np.concatenate([first, second])
        member, other = group.member[rows[first]], group.other[rows[first]]
        speed = self._normal_speed(normal, other) if not group.is_self else np.zeros(len(first))
        is_self = np.full(len(first), group.is_self)
        return NearPairs(member, other, is_self, distance, normal, t, s, speed, point, self.names)

    def _normal_speed(self, normal: Array, piece: Index) -> Array:
        if not self.pieces.moving:
            return np.zeros(len(piece))
        return np.asarray(np.einsum("kc,kc->k", normal, self.pieces.velocity[piece]))

    def _distinct(self, pairs: NearPairs) -> NearPairs:
        """Return the nearest of the rows alike in member, mesh, normal and place on the member."""
        order = np.argsort(pairs.distance, kind="stable")
        like = np.column_stack(
            [
                pairs.member[order],
                self.pieces.obstacle[pairs.other[order]],
                np.round(2.0 * pairs.normal[order]),
                np.round(4.0 * pairs.t[order]),
            ]
        )
        return pairs.select(order[np.sort(np.unique(like, axis=0, return_index=True)[1])])

    def least(self, X: Array, time: float = 0.0, *, among: str = "all") -> tuple[float, Pair | None]:
        """Return the exact least surface distance and its pair; ``(inf, None)`` where there is no pair.

        Parameters
        ----------
        among : {"all", "obstacles", "members"}
            Pairs with obstacles, pairs of members, or both.
        """
        wanted, X = _AMONG[among], self._points(X)
        best, pair = np.inf, None
        enclosed = self._enclosed(X, time) if False in wanted else None
        if enclosed is not None:
            k = int(np.argmin(enclosed.distance))
            best, pair = float(enclosed.distance[k]), enclosed.pair(k)
        reach = self_reach = 0.0
        while True:
            candidates, motion = self._covering(X, time, reach, self_reach)
            for group in candidates.groups:
                if group.is_self in wanted:
                    distance, row, count = _least_of(group, motion, X, time, best)
                    candidates.waste(group, count)
                    if row >= 0:
                        best = distance
                        pair = Pair(int(group.member[row]), int(group.other[row]), group.is_self)
            far, far_self = candidates.beyond(motion)
            extent = self._extent(X, time) if best > min(far, far_self) else 0.0
            search = False in wanted and len(self.pieces) > 0 and far < min(best, extent)
            search_self = True in wanted and far_self < min(best, extent)
            if not (search or search_self):
                candidates.tire(X, time)
                return best, pair
            reach = 2.0 * max(far, self.influence) if search else reach
            self_reach = 2.0 * max(far_self, self.self_influence) if search_self else self_reach

    def _extent(self, X: Array, time: float) -> float:
        """Return a length that no distance exceeds."""
        centers = self.pieces.center + time * self.pieces.velocity
        points = np.vstack([X, centers])
        return float(np.linalg.norm(np.ptp(points, axis=0)))

    def keeps(self, X: Array, time: float, floor: float, self_floor: float | None = None) -> bool:
        """Return whether no surface distance is below its floor; cheaper than :meth:`least`.

        Parameters
        ----------
        floor, self_floor : float
            For obstacles and, if it differs, between members, m.
        """
        self_floor = floor if self_floor is None else self_floor
        X = self._points(X)
        candidates, motion = self._covering(X, time, max(floor, 0.0), max(self_floor, 0.0))
        for group in candidates.groups:
            least = self_floor if group.is_self else floor
            rows = np.flatnonzero(~(group.lower(motion, least)[0] >= least))
            if len(rows) and not (group.contacts(X, time, rows).distance >= least).all():
                return False
        return self._enclosed(X, time) is None

    def between(
        self,
        start: Array,
        end: Array,
        start_time: float,
        end_time: float,
        floor: float,
        self_floor: float | None = None,
    ) -> BetweenReport:
        """Prove that no surface distance falls below its floor while the members' ends move on straight lines.

        Motion bounds first, then fixed separating planes, then halves of the time for the pairs that are
        left. What is not proven after twelve halvings is refused: the answer may be a false alarm, never a
        false proof.

        Parameters
        ----------
        start, end : (N, 3)
            Node positions, m.
        start_time, end_time : float
            s; the obstacles move meanwhile.
        floor, self_floor : float
            For obstacles and, if it differs, between members, m; not negative.

        Raises
        ------
        GeometryError
            A position is not finite; so do `near` and `least`.
        """
        floor = max(floor, 0.0)
        self_floor = floor if self_floor is None else max(self_floor, 0.0)
        start, end = self._points(start), self._points(end)
        candidates, motion = self._covering(start, start_time, floor, self_floor, end, end_time)
        proven = min(candidates.beyond(motion))
        found: list[tuple[Group, Found]] = []
        for group in candidates.groups:
            least = self_floor if group.is_self else floor
            lower, others = group.lower(motion, least)
            open_ = ~(lower >= least)
            proven = min(proven, others, float(lower[~open_].min(initial=np.inf)))
            rows = np.flatnonzero(open_)
            if len(rows):
                result = sweep_group(group, rows, start, end, start_time, end_time, least)
                proven = min(proven, result.proven)
                if len(result.rows):
                    found.append((group, result))
        parts = [self._failing(g, r, start, end, start_time, end_time) for g, r in found]
        fractions = [r.fraction for _, r in found]
        enclosed = self._enclosed(start, start_time)
        if enclosed is not None:
            parts.append(enclosed)
            fractions.append(np.full(len(enclosed), 1.0 / 32.0))
        failing = join(parts, self.names)
        least = min([proven, float(failing.distance.min(initial=np.inf)), *(r.worst for _, r in found)])
        return BetweenReport(not parts, least, np.concatenate([np.zeros(0), *fractions]), failing)

    def _failing(
        self, group: Group, found: Found, start: Array, end: Array, start_time: float, end_time: float
    ) -> NearPairs:
        segments, others = found.placed(group, start, end, start_time, end_time)
        every = np.arange(len(found.rows))
        contacts = group.contacts_of(segments, others, found.rows)
        return self._pairs(group, found.rows, contacts, every, every[:0])

    def _enclosed(self, X: Array, time: float) -> NearPairs | None:
        """Return the members with an end inside a closed mesh, at minus their distance to its surface."""
        parts = []
        for obstacle, solid in self._solids.items():
            inside = solid.contains(X, time)
            member = np.flatnonzero(inside[self._members.nodes].any(axis=1))
            if not len(member):
                continue
            piece = np.flatnonzero(self.pieces.obstacle == obstacle)
            group = Group(
                "triangle",
                np.repeat(member, len(piece)),
                np.tile(piece, len(member)),
                self._members,
                self.pieces,
                self._kernels,
            )
            contacts = group.contacts(X, time, np.arange(len(group.member)))
            nearest = contacts.distance.reshape(len(member), -1).argmin(axis=1) + len(piece) * np.arange(
                len(member)
            )
            pairs = self._pairs(group, np.arange(len(group.member)), contacts, nearest, nearest[:0])
            radius = self.radius[member]
            depth = pairs.distance + radius
            outward = np.where(depth > 0.0, -1.0, 1.0)
            parts.append(
                replace(
                    pairs,
                    distance=-depth - radius,
                    normal=outward[:, None] * pairs.normal,
                    normal_speed=outward * pairs.normal_speed,
                )
            )
        return join(parts, self.names) if parts else None

    def _with_enclosed(self, pairs: NearPairs, X: Array, time: float) -> NearPairs:
        """Return `pairs` with one row that leads out for each member inside a closed mesh."""
        enclosed = self._enclosed(X, time)
        if enclosed is None:
            return pairs
        inside = np.zeros((len(self.members), len(self.obstacles)), dtype=bool)
        inside[enclosed.member, self.pieces.obstacle[enclosed.other]] = True
        owner = self.pieces.obstacle[np.where(pairs.is_self, 0, pairs.other)]
        kept = pairs.is_self | ~inside[pairs.member, owner]
        return join([pairs.select(kept), enclosed], self.names)

    def _covering(
        self,
        X: Array,
        time: float,
        reach: float,
        self_reach: float,
        end: Array | None = None,
        end_time: float | None = None,
    ) -> tuple[Candidates, Motion]:
        """Return candidates with every pair nearer than the reaches, and the motion since their reference.

        With an `end` they hold on the whole straight way there, and the motion is the greatest on it.
        """
        candidates = self._candidates
        far = far_self = np.nan
        if candidates is not None:
            motion = candidates.motion(X, time, end, end_time)
            far, far_self = candidates.beyond(motion)
            if far >= reach and far_self >= self_reach:
                return candidates, motion
        # What is not a number fails the comparisons above and comes here.
        if not all(np.abs(at).max(initial=0.0) < FURTHEST for at in (X, X if end is None else end)):
            raise GeometryError("node positions must be finite numbers")
        travel = 0.0 if end is None else float(np.sqrt(((end - X) ** 2).sum(axis=1).max(initial=0.0)))
        drift = 0.0 if end_time is None else self.pieces.fastest * abs(end_time - time)
        horizon = max(reach, self.influence) + self.influence + travel + drift
        self_horizon = max(self_reach, self.self_influence) + self.influence + 2.0 * travel
        if len(self.members) * (len(self.members) + len(self.pieces)) <= _FEW_PAIRS:
            # A list of all pairs never needs another broad phase, which would cost more than its tail does.
            horizon = self_horizon = 2.0 * self._extent(X, time) + horizon + self_horizon
        if candidates is None:
            self._candidates = candidates = Candidates(
                self._members,
                self.pieces,
                self._kernels,
                X,
                time,
                horizon,
                self_horizon if self.self_collision else None,
            )
        else:
            if not far >= reach:
                candidates.renew_pieces(X, time, horizon)
            if not far_self >= self_reach:
                candidates.follow_members(X, time, self_reach, travel, self_horizon)
        return candidates, candidates.motion(X, time, end, end_time)


def _least_of(group: Group, motion: Motion, X: Array, time: float, best: float) -> tuple[float, int, int]:
    """Return the least distance below `best`, its row, and how many pairs the bounds left beside the first.

    The row is -1 where none is below.
    """
    # The nearest pairs at the reference are likely to be so still; they make `best` small for the others.
    rows, row = np.arange(min(len(group), _FIRST)), -1
    for first in (True, False):
        if len(rows):
            distance = group.contacts(X, time, rows).distance
            k = int(np.argmin(distance))
            if distance[k] < best:
                best, row = float(distance[k]), int(rows[k])
        if first:
            rows = np.flatnonzero(group.lower(motion, best)[0] < best)
            rows = rows[rows >= _FIRST]
    return best, row, len(rows)
