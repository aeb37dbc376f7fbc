"""Clearance of an arm of capsules and hulls: near contacts, least distances, proofs between two states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.compiled import compiler
from vgtm_qp.geometry.bodies import Bodies
from vgtm_qp.geometry.candidates import Candidates
from vgtm_qp.geometry.formulas import FAR
from vgtm_qp.geometry.groups import Found, Lowered, Scene
from vgtm_qp.geometry.pairs import BetweenReport, Contacts, Pair, PairNames, Wanted
from vgtm_qp.geometry.shapes import Obstacle, ObstaclePieces
from vgtm_qp.geometry.solids import Solids
from vgtm_qp.geometry.sweep import sweep_group
from vgtm_qp.geometry.watch import Watch, can_be_watched

__all__ = ["BetweenReport", "Clearance", "Contacts", "Pair"]

_AMONG = {"all": (False, True), "obstacles": (False,), "members": (True,)}


class Clearance:
    """Distances of an arm's bodies from obstacles and from each other; one thread at a time.

    Positions ``X`` (P, 3), m, are those of the points that ``Bodies.points`` indexes. Lists of pairs that may be near
    are kept from one call to the next. Scenes without meshes are also watched, which is faster.

    Parameters
    ----------
    bodies
        See :mod:`vgtm_qp.geometry.bodies`.
    obstacles
        See :mod:`vgtm_qp.geometry.shapes`.
    safe, self_safe, influence : float
        Surface distances to keep from obstacles and between bodies, and that below which a pair is near, m.
    self_collision : bool
        Whether pairs of bodies that are not neighbours count.
    watch : bool
        Whether scenes are watched; the answers are the same.
    by_fcl : bool
        Whether :meth:`near` may use python-fcl for the contacts of capsules.
    unit : float
        Unit of length of the tolerances of its answers, m.
    """

    def __init__(
        self,
        bodies: Bodies,
        obstacles: Sequence[Obstacle] = (),
        *,
        safe: float,
        influence: float,
        self_safe: float = 0.0,
        self_collision: bool = True,
        watch: bool = True,
        by_fcl: bool = True,
        unit: float = 1.0,
    ) -> None:
        self.scene = Scene(bodies, obstacles, self_collision, by_fcl, unit)
        self.self_collision = self_collision
        self.safe, self.self_safe, self.influence = safe, self_safe, influence
        self._may_watch = watch and compiler() is not None
        self._begin()

    def _begin(self) -> None:
        """Forget all pairs, and see what the scene is."""
        self.bodies = self.scene.bodies
        self._widest = float(self.bodies.radius.max(initial=0.0))
        self._watching: Watch | None = None
        self._candidates = Candidates(self.scene, self.influence, self.self_influence)
        self._look()

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """The obstacles of the scene; see :meth:`put`."""
        return self.scene.obstacles

    @property
    def pieces(self) -> ObstaclePieces:
        """The convex pieces of all obstacles."""
        return self.scene.pieces

    @property
    def names(self) -> PairNames:
        """Names of the pairs."""
        return self.scene.names

    @property
    def self_influence(self) -> float:
        """Surface distance below which a pair of bodies is near, m."""
        return min(self.influence, 2.0 * (self.safe + self._widest))

    def put(self, obstacles: Sequence[Obstacle], bodies: Bodies | None = None) -> None:
        """Put `obstacles` in the place of those that were there, and other `bodies` in that of the arm's, if given.

        What is known of pairs of bodies is kept if these stay.
        """
        self.scene.put(obstacles, bodies)
        if bodies is not None:
            self._begin()
            return
        self._candidates.forget_pieces()
        if self._watching is not None:
            self._watching.forget_pieces()
        self._look()

    def _look(self) -> None:
        """See whether the obstacles can be watched, and which of them enclose space."""
        self.is_watched = self._may_watch and can_be_watched(self.scene)
        self._solids = Solids(self.scene)

    def watching(self) -> Watch | None:
        """Return what watches the scene, if it can be watched and once that is compiled."""
        if self._watching is None and self.is_watched and self.scene.is_ready():
            self._watching = Watch(self.scene, self.influence, self.self_influence)
        return self._watching if self.is_watched else None

    def near(
        self,
        X: Array,
        time: float = 0.0,
        reach: float | None = None,
        *,
        self_reach: float | None = None,
        by_fcl: bool = False,
        tracked: bool = False,
        wanted: Wanted | None = None,
    ) -> Contacts:
        """Return all contacts of surfaces nearer than `reach`, exact; to 1e-6 m where FCL supplies them.

        A pair has two rows where the nearest point of a body is not unique. Triangles of a mesh have rows of
        their own only if they differ in normal, or face different parts of the body.

        Parameters
        ----------
        X : (P, 3)
            m.
        time : float
            s.
        reach, self_reach : float or None
            m; by default `influence`, for two bodies at most twice the sum of `safe` and the largest radius.
        by_fcl : bool
            Whether python-fcl supplies contacts, each proven; see ``Contacts.by_fcl`` for the others.
        tracked : bool
            Whether `X` is an accepted state, at which the next motion begins. A watched scene is then
            evaluated from state to state; trial positions would make the watch go there and back.
        wanted : Wanted or None
            Which of the pairs nearer than `reach` have contacts; all by default.
        """
        reach = self.influence if reach is None else reach
        self_reach = min(reach, self.self_influence) if self_reach is None else self_reach
        if tracked and (watch := self.watching()) is not None:
            watched = watch.near(X, time, reach, self_reach, by_fcl=by_fcl, wanted=wanted)
            if watched is not None:
                return watched
        candidates = self._candidates
        motion = candidates.cover(X, time, reach, self_reach)
        parts: list[Found] = []
        for group in candidates.groups:
            limit = self_reach if group.is_self else reach
            # A negated comparison is true for NaN.
            rows = np.flatnonzero(~(group.lower(motion, limit)[0] >= limit))
            if len(rows):
                # Of rows that depend on one another a solver takes the first ones.
                rows = rows[np.lexsort((group.other[rows], group.body[rows]))]
                both = group.evaluate(group.at(X, time, rows))
                k, which = np.nonzero(~(both[:, :, 0] >= min(limit, FAR)))
                found, pairs = both[k, which], rows[k]
                candidates.count_unneeded(group, len(rows) - int(np.count_nonzero(which == 0)))
                if wanted is not None:
                    needed = group.chosen(wanted, pairs, found)
                    found, pairs = found[needed], pairs[needed]
                if group.shape == "triangle":
                    kept = group.distinct(pairs, found)
                    found, pairs = found[kept], pairs[kept]
                parts.append(group.contacts(X, time, pairs, found, by_fcl))
        candidates.refresh_where_due(X, time)
        return self.scene.contacts(self._solids.with_enclosed(parts, X, time))

    def least(self, X: Array, time: float = 0.0, *, among: str = "all") -> tuple[float, Pair | None]:
        """Return the exact least clearance, m, and its pair; ``(inf, None)`` where there is no pair.

        The clearance of a pair is the distance of the body's axis from the solid obstacle, or from the other
        axis, less the radius or radii. It is never less than minus the radius or radii, even if an axis
        reaches into the other. The contacts of :meth:`near` have the depth there, since they lead out.

        Parameters
        ----------
        among : {"all", "obstacles", "members"}
            Pairs with obstacles, pairs of bodies, or both.
        """
        wanted = _AMONG[among]
        best, pair = np.inf, None
        enclosed = self.scene.contacts(self._solids.enclosed(X, time) if False in wanted else [])
        if len(enclosed):
            inside = -self.bodies.radius[enclosed.body]
            k = int(np.argmin(inside))
            best, pair = float(inside[k]), enclosed.pair(k)
        candidates, reach, self_reach = self._candidates, 0.0, 0.0
        while True:
            motion = candidates.cover(X, time, reach, self_reach)
            for group in candidates.groups:
                if group.is_self in wanted:
                    best, row, count = group.nearest(motion, X, time, best)
                    candidates.count_unneeded(group, count)
                    if row >= 0:
                        pair = Pair(int(group.body[row]), int(group.other[row]), group.is_self)
            far, far_self = candidates.beyond(motion)
            search = False in wanted and far < min(best, FAR)
            search_self = True in wanted and far_self < min(best, FAR)
            if not (search or search_self):
                candidates.refresh_where_due(X, time)
                return best, pair
            reach = 2.0 * max(far, self.influence) if search else reach
            self_reach = 2.0 * max(far_self, self.self_influence) if search_self else self_reach

    def keeps(self, X: Array, time: float, floor: float, self_floor: float | None = None) -> bool:
        """Return whether no surface distance is below its floor; cheaper than :meth:`least`.

        Parameters
        ----------
        floor, self_floor : float
            For obstacles and, if it differs, between bodies, m.
        """
        self_floor = floor if self_floor is None else self_floor
        watch = self._watching if self.is_watched else None
        if watch is not None and watch.keeps(X, time, floor, self_floor):
            return True
        motion = self._candidates.cover(X, time, max(floor, 0.0), max(self_floor, 0.0))
        for group in self._candidates.groups:
            least = self_floor if group.is_self else floor
            rows = np.flatnonzero(~(group.lower(motion, least)[0] >= least))
            if len(rows) and not (group.distances(X, time, rows, least) >= least).all():
                return False
        return not self._solids.enclosed(X, time)

    def along(
        self,
        places: Array,
        start_time: float,
        end_time: float,
        floor: float,
        self_floor: float | None = None,
        *,
        thorough: bool = True,
        lowered: Lowered | None = None,
    ) -> BetweenReport:
        """Prove that no surface distance falls below its floor on straight pieces of equal duration.

        The watch is tried first, then for a piece that it does not prove bounds of the motion, then separating planes,
        then halves of the time for the remaining pairs. A pair that is not proven after twelve halvings is refused: a
        false alarm is possible, a false proof is not. Pieces after one that is not proven are not examined.

        Parameters
        ----------
        places : (K + 1, P, 3)
            Positions of the points where pieces meet, m.
        start_time, end_time : float
            s; the obstacles move meanwhile.
        floor, self_floor : float
            For obstacles and, if it differs, between bodies, m. Floors below zero are for surfaces that overlap
            already. Only the watch can prove them, of capsules; without it they count as zero.
        thorough : bool
            False if nothing is tried after the watch, where there is one.
        lowered : Lowered or None
            Other floors of some pairs, minus infinity for those that do not count; the watch is not asked then.

        Raises
        ------
        GeometryError
            A position is not finite; so do `near` and `least`.
        """
        floors = floor, floor if self_floor is None else self_floor
        watch = None if lowered else self.watching()
        pieces, lowest, k = len(places) - 1, np.inf, 0
        times = [start_time + j / pieces * (end_time - start_time) for j in range(pieces)] + [end_time]
        while k < pieces:
            if watch is not None:
                proven = watch.follow(places[k:], times[k], end_time, *floors)
                if proven or not thorough:
                    return BetweenReport(proven, min(lowest, *floors), np.zeros(0), self.scene.nothing)
                if watch.followed > 1:
                    k, lowest = k + watch.followed - 1, min(lowest, *floors)
            report = self._between(places[k], places[k + 1], (times[k], times[k + 1]), floors, lowered or {})
            lowest, fraction, k = min(lowest, report.clearance), (k + report.fraction) / pieces, k + 1
            if not report.certified:
                break
        return replace(report, clearance=lowest, fraction=fraction)

    def _between(
        self,
        start: Array,
        end: Array,
        times: tuple[float, float],
        floors: tuple[float, float],
        lowered: Lowered,
    ) -> BetweenReport:
        """Return the proof for one piece, without the watch."""
        (start_time, end_time), (floor, self_floor) = times, (max(least, 0.0) for least in floors)
        motion = self._candidates.cover(start, start_time, floor, self_floor, end, end_time)
        lowest, fractions = min(self._candidates.beyond(motion)), [np.zeros(0)]
        parts: list[Found] = []
        for group in self._candidates.groups:
            least = self_floor if group.is_self else floor
            lower, others = group.lower(motion, least)
            open_ = ~(lower >= least)
            lowest = min(lowest, others, float(lower[~open_].min(initial=np.inf)))
            rows = np.flatnonzero(open_)
            if len(rows):
                kept = group.floors(rows, least, lowered) if lowered else least
                result = sweep_group(group, rows, start, end, start_time, end_time, kept)
                lowest = min(lowest, result.lowest)
                if len(result.rows):
                    parts.append((group.numbers[result.rows], result.contacts))
                    fractions.append(result.fraction)
        for part in self._solids.enclosed(start, start_time, besides=lowered):
            parts.append(part)
            fractions.append(np.full(len(part[0]), 1.0 / 32.0))
        failing = self.scene.contacts(parts)
        lowest = min(lowest, float(failing.distance.min(initial=np.inf)))
        return BetweenReport(not parts, lowest, np.concatenate(fractions), failing)
