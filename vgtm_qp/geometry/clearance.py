"""Clearance of an arm of capsules: near contacts, least distances, proofs between two states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.geometry.bodies import Bodies
from vgtm_qp.geometry.candidates import Candidates
from vgtm_qp.geometry.fcl_queries import FclQueries
from vgtm_qp.geometry.formulas import FURTHEST
from vgtm_qp.geometry.groups import Displacements, Group, PairDistances, ShapeKernels
from vgtm_qp.geometry.pairs import BetweenReport, Contacts, Pair, PairNames, join, no_contacts
from vgtm_qp.geometry.shapes import GeometryError, Obstacle, Pieces
from vgtm_qp.geometry.solids import Solid
from vgtm_qp.geometry.sweep import SweepResult, sweep_group
from vgtm_qp.geometry.watch import Watch

__all__ = ["BetweenReport", "Clearance", "Contacts", "Pair"]

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_AMONG = {"all": (False, True), "obstacles": (False,), "members": (True,)}

_FIRST = 16
"""The least distance is looked for among so many pairs first: those that were nearest at the reference."""

_FEW_PAIRS = 20_000
"""Scenes with no more pairs list them all."""

_MOST_WATCHED = 8000
"""Scenes at rest with no more pairs are watched."""


class Clearance:
    """Distances of an arm's bodies from obstacles and from each other; one thread at a time.

    Positions ``X`` (P, 3) are those of the points that ``Bodies.points`` counts, m. Lists of the pairs that may be
    near are kept from one call to the next. Small scenes at rest are watched besides, which is faster for states
    that follow each other.

    Parameters
    ----------
    bodies
        See :func:`vgtm_qp.geometry.bodies.capsules`.
    obstacles
        See :mod:`vgtm_qp.geometry.shapes`.
    safe, influence : float
        Surface distance to keep, and that from which a pair is near, m.
    self_collision : bool
        Whether pairs of bodies that are not neighbours count.
    self_influence : float or None
        The same as `influence` for two bodies; by default at most twice `safe` and the largest radius
        together.
    fcl_reach : float or None
        Pairs nearer than this are asked of FCL too; by default 2.5 `safe`.
    watch : bool
        Whether small scenes at rest are watched; the answers are the same.
    """

    def __init__(
        self,
        bodies: Bodies,
        obstacles: Sequence[Obstacle] = (),
        *,
        safe: float,
        influence: float,
        self_collision: bool = True,
        self_influence: float | None = None,
        fcl_reach: float | None = None,
        watch: bool = True,
    ) -> None:
        self.bodies, self.obstacles = bodies, tuple(obstacles)
        self.safe, self.influence, self.self_collision = safe, influence, self_collision
        widest = 2.0 * (safe + float(bodies.radius.max(initial=0.0)))
        self.self_influence = min(influence, widest) if self_influence is None else self_influence
        self.fcl_reach = 2.5 * safe if fcl_reach is None else fcl_reach
        self.pieces = Pieces(self.obstacles)
        self.names = PairNames(
            bodies, tuple(o.name for o in self.obstacles), tuple(self.pieces.obstacle.tolist())
        )
        self.fcl = FclQueries(self.pieces)
        self._none = no_contacts(self.names)
        self._kernels = ShapeKernels()
        shapes = {*self.pieces.shape.tolist()} | ({"segment"} if self_collision else set())
        watched = watch and self._can_be_watched()
        self._kernels.prepare(sorted(shapes), rests=watched)
        self._watch = Watch(bodies, self.pieces, self.names, self.fcl, self.every_pair) if watched else None
        self._candidates: Candidates | None = None
        self._solids = {
            k: Solid(o.pieces[:, :9].reshape(-1, 3, 3), o.velocity)
            for k, o in enumerate(self.obstacles)
            if o.shape == "triangle" and o.solid
        }

    @property
    def is_watched(self) -> bool:
        """Whether pairs are followed from state to state."""
        return self._watch is not None

    def _can_be_watched(self) -> bool:
        """Return whether nothing moves but the arm, there are no meshes, and there are not too many pairs."""
        bodies, pieces = len(self.bodies), self.pieces
        simple = not pieces.moving and "triangle" not in pieces.shape
        count = bodies * len(pieces) + (bodies * (bodies - 1) // 2 if self.self_collision else 0)
        return simple and bodies > 1 and 0 < count <= _MOST_WATCHED

    def near(
        self,
        X: Array,
        time: float = 0.0,
        reach: float | None = None,
        *,
        self_reach: float | None = None,
        fcl_reach: float | None = None,
    ) -> Contacts:
        """Return all contacts of surfaces nearer than `reach`, exact.

        A pair has two rows where the nearest point of a body is not unique. Of the triangles of a mesh
        only those stay that differ in normal or in the part of the body they face.

        Parameters
        ----------
        X : (P, 3)
            m.
        time : float
            s.
        reach, self_reach : float or None
            m; by default `influence` and the lesser of `reach` and `self_influence`.
        fcl_reach : float or None
            Pairs nearer than this, m, are asked of python-fcl too, and each answer is checked; by default that of
            this object, and none are where it is zero.
        """
        reach = self.influence if reach is None else reach
        fcl_reach = self.fcl_reach if fcl_reach is None else fcl_reach
        self_reach = min(reach, self.self_influence) if self_reach is None else self_reach
        if self._watch is not None:
            found = self._watch.near(X, reach, self_reach, fcl_reach)
            if found is not None:
                return found
        candidates, motion = self._covering(X, time, reach, self_reach)
        parts = []
        for group in candidates.groups:
            limit = self_reach if group.is_self else reach
            rows = np.flatnonzero(group.lower(motion, limit)[0] < limit)
            if len(rows):
                answer, two = self._distances(group, X, time, rows, min(limit, fcl_reach))
                first = np.flatnonzero(answer.distance < limit)
                candidates.count_unneeded(group, len(rows) - len(first))
                second = first[two[first] & (answer.distance_second[first] < limit)]
                part = self._contacts(group, rows, answer, first, second)
                parts.append(self._distinct(part) if group.shape == "triangle" else part)
        candidates.refresh_where_due(X, time)
        return self._with_enclosed(join(parts, self._none), X, time)

    def every_pair(self, X: Array) -> list[Group]:
        """Return groups of all pairs, with their distances at `X` (P, 3) and time 0."""
        horizon = np.inf if self.self_collision else None
        return Candidates(self.bodies, self.pieces, self._kernels, X, 0.0, np.inf, horizon).groups

    def _distances(
        self, group: Group, X: Array, time: float, rows: Index, fcl_reach: float
    ) -> tuple[PairDistances, NDArray[np.bool_]]:
        """Return distances of `rows`, and which have a second contact (K,): by the closed form, whatever FCL says."""
        segments, others = group.segments(X, rows), group.others(X, time, rows)
        answer = group.distances_of(segments, others, rows)
        two = answer.two()
        if fcl_reach > 0.0 and group.shape in FclQueries.SHAPES:
            asked = np.flatnonzero(answer.distance < fcl_reach)
            self.fcl.improve(group.other[rows], group.radius[rows], segments, others, answer, asked, two)
        return answer, two

    def _contacts(
        self, group: Group, rows: Index, answer: PairDistances, first: Index, second: Index
    ) -> Contacts:
        """Return the rows `first` by their witness points and `second` by their other contacts."""
        distance, t, s, normal = (
            answer.distance[first],
            answer.t[first],
            answer.s[first],
            answer.normal[first],
        )
        if len(second):
            distance = np.concatenate([distance, answer.distance_second[second]])
            t = np.concatenate([t, answer.t_second[second]])
            s = np.concatenate([s, answer.s_second[second]])
            normal = np.concatenate([normal, answer.normal_second[second]])
            first = np.concatenate([first, second])
        chosen = rows[first]
        share = 1.0 if group.is_self else 0.0
        return Contacts(
            distance=distance,
            normal=normal,
            points=np.concatenate([group.points[chosen], group.other_points[chosen]], axis=1),
            weights=np.stack([1.0 - t, t, share * (s - 1.0), -share * s], axis=1),
            is_self=np.full(len(first), group.is_self),
            normal_speed=np.zeros(len(first))
            if group.is_self
            else self._normal_speed(normal, group.other[chosen]),
            body=group.body[chosen],
            other=group.other[chosen],
            names=self.names,
        )

    def _normal_speed(self, normal: Array, piece: Index) -> Array:
        if not self.pieces.moving:
            return np.zeros(len(piece))
        return np.asarray(np.einsum("kc,kc->k", normal, self.pieces.velocity[piece]))

    def _distinct(self, contacts: Contacts) -> Contacts:
        """Return the nearest of the rows alike in body, mesh, normal and place on the body."""
        order = np.argsort(contacts.distance, kind="stable")
        like = np.column_stack(
            [
                contacts.body[order],
                self.pieces.obstacle[contacts.other[order]],
                np.round(2.0 * contacts.normal[order]),
                np.round(4.0 * contacts.weights[order, 1]),
            ]
        )
        return contacts.select(order[np.sort(np.unique(like, axis=0, return_index=True)[1])])

    def least(self, X: Array, time: float = 0.0, *, among: str = "all") -> tuple[float, Pair | None]:
        """Return the exact least surface distance and its pair; ``(inf, None)`` where there is no pair.

        Parameters
        ----------
        among : {"all", "obstacles", "members"}
            Pairs with obstacles, pairs of bodies, or both.
        """
        wanted = _AMONG[among]
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
                    candidates.count_unneeded(group, count)
                    if row >= 0:
                        best = distance
                        pair = Pair(int(group.body[row]), int(group.other[row]), group.is_self)
            far, far_self = candidates.beyond(motion)
            extent = self._extent(X, time) if best > min(far, far_self) else 0.0
            search = False in wanted and len(self.pieces) > 0 and far < min(best, extent)
            search_self = True in wanted and far_self < min(best, extent)
            if not (search or search_self):
                candidates.refresh_where_due(X, time)
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
            For obstacles and, if it differs, between bodies, m.
        """
        self_floor = floor if self_floor is None else self_floor
        candidates, motion = self._covering(X, time, max(floor, 0.0), max(self_floor, 0.0))
        for group in candidates.groups:
            least = self_floor if group.is_self else floor
            rows = np.flatnonzero(~(group.lower(motion, least)[0] >= least))
            if len(rows) and not (group.distances(X, time, rows).distance >= least).all():
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
        """Prove that no surface distance falls below its floor while the points move on straight lines.

        The watch is asked first. Then motion bounds, then separating planes, then halves of the time for the pairs
        that are left. A motion not proven after twelve halvings is refused: the answer may be a false alarm,
        never a false proof.

        Parameters
        ----------
        start, end : (P, 3)
            m.
        start_time, end_time : float
            s; the obstacles move meanwhile.
        floor, self_floor : float
            For obstacles and, if it differs, between bodies, m. Below zero, where surfaces overlap already, only
            the watch can prove them; without it they count as zero.

        Raises
        ------
        GeometryError
            A position is not finite; so do `near` and `least`.
        """
        self_floor = floor if self_floor is None else self_floor
        if self._watch is not None and self._watch.follow(start, end, floor, self_floor):
            return BetweenReport(True, min(floor, self_floor), np.zeros(0), self._none)
        floor, self_floor = max(floor, 0.0), max(self_floor, 0.0)
        candidates, motion = self._covering(start, start_time, floor, self_floor, end, end_time)
        proven = min(candidates.beyond(motion))
        found: list[tuple[Group, SweepResult]] = []
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
        failing = join(parts, self._none)
        least = min([proven, float(failing.distance.min(initial=np.inf)), *(r.worst for _, r in found)])
        return BetweenReport(not parts, least, np.concatenate([np.zeros(0), *fractions]), failing)

    def _failing(
        self, group: Group, found: SweepResult, start: Array, end: Array, start_time: float, end_time: float
    ) -> Contacts:
        segments, others = found.placed(group, start, end, start_time, end_time)
        every = np.arange(len(found.rows))
        answer = group.distances_of(segments, others, found.rows)
        return self._contacts(group, found.rows, answer, every, every[:0])

    def _enclosed(self, X: Array, time: float) -> Contacts | None:
        """Return the bodies with an end inside a closed mesh, at minus their distance to its surface."""
        parts = []
        for obstacle, solid in self._solids.items():
            inside = solid.contains(X, time)
            body = np.flatnonzero(inside[self.bodies.points].any(axis=1))
            if not len(body):
                continue
            piece = np.flatnonzero(self.pieces.obstacle == obstacle)
            group = Group(
                "triangle",
                np.repeat(body, len(piece)),
                np.tile(piece, len(body)),
                self.bodies,
                self.pieces,
                self._kernels,
            )
            every = np.arange(len(group))
            answer = group.distances(X, time, every)
            nearest = answer.distance.reshape(len(body), -1).argmin(axis=1) + len(piece) * np.arange(
                len(body)
            )
            contacts = self._contacts(group, every, answer, nearest, nearest[:0])
            radius = self.bodies.radius[body]
            depth = contacts.distance + radius
            outward = np.where(depth > 0.0, -1.0, 1.0)
            parts.append(
                replace(
                    contacts,
                    distance=-depth - radius,
                    normal=outward[:, None] * contacts.normal,
                    normal_speed=outward * contacts.normal_speed,
                )
            )
        return join(parts, self._none) if parts else None

    def _with_enclosed(self, contacts: Contacts, X: Array, time: float) -> Contacts:
        """Return `contacts` with one row that leads out for each body inside a closed mesh."""
        enclosed = self._enclosed(X, time)
        if enclosed is None:
            return contacts
        inside = np.zeros((len(self.bodies), len(self.obstacles)), dtype=bool)
        inside[enclosed.body, self.pieces.obstacle[enclosed.other]] = True
        owner = self.pieces.obstacle[np.where(contacts.is_self, 0, contacts.other)]
        kept = contacts.is_self | ~inside[contacts.body, owner]
        return join([contacts.select(kept), enclosed], self._none)

    def _covering(
        self,
        X: Array,
        time: float,
        reach: float,
        self_reach: float,
        end: Array | None = None,
        end_time: float | None = None,
    ) -> tuple[Candidates, Displacements]:
        """Return candidates with every pair nearer than the reaches, and the displacements from their references.

        With an `end` both hold on the whole straight path there.
        """
        candidates = self._candidates
        far = far_self = np.nan
        if candidates is not None:
            motion = candidates.motion(X, time, end, end_time)
            far, far_self = candidates.beyond(motion)
            if far >= reach and far_self >= self_reach:
                return candidates, motion
        # NaN fails the comparisons above and comes here.
        if not all(np.abs(at).max(initial=0.0) < FURTHEST for at in (X, X if end is None else end)):
            raise GeometryError("node positions must be finite numbers")
        travel = 0.0 if end is None else float(np.sqrt(((end - X) ** 2).sum(axis=1).max(initial=0.0)))
        drift = 0.0 if end_time is None else self.pieces.fastest * abs(end_time - time)
        horizon = max(reach, self.influence) + self.influence + travel + drift
        self_horizon = max(self_reach, self.self_influence) + self.influence + 2.0 * travel
        if len(self.bodies) * (len(self.bodies) + len(self.pieces)) <= _FEW_PAIRS:
            # A list of all pairs never needs another broad phase, which would cost more than the far pairs in it.
            horizon = self_horizon = 2.0 * self._extent(X, time) + horizon + self_horizon
        if candidates is None:
            self._candidates = candidates = Candidates(
                self.bodies,
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
                candidates.follow_bodies(X, time, self_reach, travel, self_horizon)
        return candidates, candidates.motion(X, time, end, end_time)


def _least_of(
    group: Group, motion: Displacements, X: Array, time: float, best: float
) -> tuple[float, int, int]:
    """Return the least distance below `best`, m, its row, and how many pairs were evaluated after the first few.

    The row is -1 where no distance is below.
    """
    # The nearest pairs at the reference are likely to be so still; they make `best` small for the others.
    rows, row = np.arange(min(len(group), _FIRST)), -1
    for first in (True, False):
        if len(rows):
            distance = group.distances(X, time, rows).distance
            k = int(np.argmin(distance))
            if distance[k] < best:
                best, row = float(distance[k]), int(rows[k])
        if first:
            rows = np.flatnonzero(group.lower(motion, best)[0] < best)
            rows = rows[rows >= _FIRST]
    return best, row, len(rows)
