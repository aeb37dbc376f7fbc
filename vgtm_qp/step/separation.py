"""What a step keeps apart: bodies and obstacles, bodies and bodies, and the angles between bodies that meet.

A pair that is already nearer than it may be does not stop the arm: it may not come nearer, and is driven apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Arm
from vgtm_qp.geometry.clearance import BetweenReport, Clearance, Contacts, Pair
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.rows.angles import angle_gradients, angles, corners
from vgtm_qp.rows.clearance import clearance_rows, slowed

Array = NDArray[np.float64]
Index = NDArray[np.int64]

Shortfall = Mapping[Pair, float]
"""Pairs that are nearer than they may be, with their distances, m."""

_BINDING = 0.002
"""FCL is asked about pairs that are nearer than this to their floor, m, too."""

_LEAST_APPROACH = 2e-3
"""A pair that slows down may come nearer by so much in one step all the same, m."""

_MOST_PIECES = 16
"""A motion whose points leave their chords is cut in so many pieces at most."""

_NEAR_ANGLE = 0.3
"""Bodies that meet at an angle larger than the least one by this, rad, have no row."""

_BETWEEN = 5e-5
"""Bodies whose points leave their chords may come nearer by this between states, m.

That is half of the published tolerance.
"""


@dataclass(frozen=True)
class Distances:
    """What is kept: surface to surface from obstacles and between bodies, m, and angles between bodies, rad.

    The QP keeps `margin` more, m, for what is not linear in its step; pairs further than `influence`, m, are not
    in it. A pair that is too near at the start of a step is driven apart by up to `recovery`, m, in one step. A pair
    may use the share `approach` of its remaining clearance in one step: where that is 1, bodies come at full speed
    and stop dead, which is a jump in the rates of all actuators.
    """

    safe: float
    self_safe: float
    influence: float
    margin: float = 2e-4
    minimum_angle: float = 0.0
    recovery: float = 0.01
    approach: float = 1.0
    rounding: float = 1e-10


class Separation:
    """Rows, checks and proofs of clearance for the steps of one arm.

    Parameters
    ----------
    arm
        Whose configurations are meant.
    monitor
        Of the arm's bodies and the obstacles.
    distances
        What is kept.
    """

    def __init__(self, arm: Arm, monitor: Clearance, distances: Distances) -> None:
        self._arm = arm
        self.monitor = monitor
        self.distances = distances
        meeting = monitor.bodies.joints if distances.minimum_angle > 0.0 else np.zeros((0, 2), dtype=np.int64)
        self._corners = corners(meeting)

    def shortfall(self, q: Array, time: float) -> Shortfall:
        """Return the pairs that are too near at a configuration; empty as a rule."""
        kept, points = self.distances, self._arm.points(q)
        floors = kept.safe - kept.rounding, kept.self_safe - kept.rounding
        if self.monitor.keeps(points, time, *floors):
            return {}
        contacts = self.monitor.near(points, time, floors[0], self_reach=floors[1], fcl_reach=0.0)
        found: dict[Pair, float] = {}
        for k in range(len(contacts)):
            pair = contacts.pair(k)
            found[pair] = min(found.get(pair, np.inf), float(contacts.distance[k]))
        return found

    def holds(self, q: Array, time: float, before: Shortfall, *, proven: bool = False) -> Shortfall | None:
        """Return what is too near at `q`, or None where a pair is that was not `before`, or comes nearer.

        `proven` is whether :meth:`between` was certified for the motion that ends at `q`. Its proof holds at `q` too,
        but not where points leave their chords: bodies may then come a little nearer on the way than at its end.
        """
        if not self._angles_hold(q):
            return None
        if proven and not before and not self._arm.leaves_chords:
            return {}
        after = self.shortfall(q, time)
        if all(
            distance >= before.get(pair, np.inf) - self.distances.rounding for pair, distance in after.items()
        ):
            return after
        return None

    def between(
        self, start: Array, end: Array, start_time: float, end_time: float, before: Shortfall
    ) -> BetweenReport:
        """Return the proof that no surfaces come nearer on the way than they may, or than the nearest are already."""
        kept = self.distances
        floor, self_floor = (
            min([least, *(distance for pair, distance in before.items() if pair.is_self == is_self)])
            for least, is_self in ((kept.safe, False), (kept.self_safe, True))
        )
        points = self._arm.points
        if not self._arm.leaves_chords:
            floors = floor - kept.rounding, max(self_floor - kept.rounding, 0.0)
            return self.monitor.between(points(start), points(end), start_time, end_time, *floors)
        deviation = self.deviation(start, end)
        # Cut in k pieces, the points leave their chords by 1 / k^2 of that.
        pieces = (
            min(math.ceil(math.sqrt(max(deviation / _BETWEEN, 1.0))), _MOST_PIECES) if deviation < 1.0 else 1
        )
        spare = deviation / pieces**2 - _BETWEEN
        floors, lowest = (floor + spare, max(self_floor + spare, 0.0)), np.inf
        for k in range(pieces):
            here, there = (points(start + share * (end - start)) for share in (k / pieces, (k + 1) / pieces))
            lapse = (end_time - start_time) / pieces
            since = start_time + k * lapse
            report = self.monitor.between(here, there, since, since + lapse, *floors)
            lowest = min(lowest, report.clearance)
            if not report.certified:
                break
        return replace(report, clearance=lowest, fraction=(k + report.fraction) / pieces)

    def deviation(self, start: Array, end: Array) -> float:
        """Return how far two points come nearer to each other than their chords do at most, m."""
        return self._arm.deviation(start, end) if self._arm.leaves_chords else 0.0

    def rows(
        self, q: Array, time: float, duration: float, reach: float, short: Shortfall, gain: float
    ) -> ClearanceRows:
        """Return the rows at a configuration.

        Parameters
        ----------
        duration
            How long the obstacles move on until the end of the step, s; zero at the end. Where it is not zero, a zero
            step is allowed as far as the obstacles rest, except for the margin that the step before may have used
            and for what is to be recovered; and pairs slow down before they touch.
        reach
            How far a node moves at most, m: a pair further from its floor than that cannot become active. One that
            was missed because a body moved further is found by the check of the new state, and corrected.
        short, gain
            Pairs that were too near at the start of the step, and how far they are driven apart in it, m.
        """
        kept, motion = self.distances, duration > 0.0
        reach += self.monitor.pieces.fastest * duration
        limits = min(kept.influence, kept.safe + reach), min(kept.influence, kept.self_safe + 2.0 * reach)
        fcl_reach = kept.safe + _BINDING if motion else 0.0
        contacts = self.monitor.near(
            self._arm.points(q), time, limits[0], self_reach=limits[1], fcl_reach=fcl_reach, tracked=not short
        )
        rows = self._clearance_rows(q, contacts)
        if len(contacts):
            self._allow(rows, contacts, duration, short, gain)
        return rows.joined(self._angle_rows(q, motion=motion)) if len(self._corners) else rows

    def _allow(
        self, rows: ClearanceRows, contacts: Contacts, duration: float, short: Shortfall, gain: float
    ) -> None:
        """Let pairs come nearer no faster than they may: overwrites ``rows.lower``; arguments as of :meth:`rows`."""
        kept, motion = self.distances, duration > 0.0
        if motion:
            np.minimum(rows.lower, 2.0 * kept.margin, out=rows.lower)
        if short:
            self._recover(rows, contacts, short, gain)
        if motion and self.monitor.pieces.moving:
            rows.lower += contacts.normal_speed * duration
        if motion:
            # Slow down by the clearance left when the obstacles have moved: those that only come nearer need no haste.
            rows.lower = slowed(rows.lower, kept.approach, _LEAST_APPROACH)

    def _recover(self, rows: ClearanceRows, contacts: Contacts, short: Shortfall, gain: float) -> None:
        """Drive pairs that were too near apart by `gain`, m, as far as they are short: overwrites ``rows.lower``."""
        floor = np.where(contacts.is_self, self.distances.self_safe, self.distances.safe)
        for k in np.flatnonzero(contacts.distance < floor).tolist():
            before = short.get(contacts.pair(k))
            if before is not None:
                rows.lower[k] = min(before + gain, floor[k]) - contacts.distance[k]

    def rows_between(
        self, start: Array, q: Array, start_time: float, time: float, fractions: list[float]
    ) -> list[ClearanceRows]:
        """Return the rows at `fractions`, 0 to 1, of the way from `start` to `q`: the end state moves them too."""
        found = []
        for s in fractions:
            at = start + s * (q - start)
            now = start_time + s * (time - start_time)
            contacts = self.monitor.near(self._arm.points(at), now, 1.5 * self.distances.safe)
            found.append(self._clearance_rows(at, contacts, s))
        return found

    def _clearance_rows(self, q: Array, contacts: Contacts, fraction: float = 1.0) -> ClearanceRows:
        """Return the rows of contacts found at a configuration, a `fraction` of the way to the end."""
        kept = self.distances
        if not len(contacts):
            return ClearanceRows(name=contacts.name)
        coefficients, lower = clearance_rows(
            contacts.distance,
            contacts.normal,
            contacts.weights,
            contacts.is_self,
            kept.safe,
            kept.self_safe,
            margin=kept.margin,
            fraction=fraction,
        )
        nodes, coefficients = self._arm.over_nodes(q, contacts.points, coefficients)
        return ClearanceRows(nodes, coefficients, lower, contacts.name)

    def names(self, short: Shortfall) -> tuple[str, ...]:
        """Return what is too near, nearest first."""
        return tuple(
            self.monitor.names.clearance(pair) for pair, _ in sorted(short.items(), key=lambda item: item[1])
        )

    def _vectors(self, q: Array) -> tuple[Array, Array]:
        """Return the vectors (K, 3), m, of both bodies of each corner away from the joint where they meet."""
        points, (body, end) = self.monitor.bodies.points, np.moveaxis(self._corners, 2, 0)
        vectors = self._arm.points(q)
        vectors = vectors[points[body, 1 - end]] - vectors[points[body, end]]
        return vectors[:, 0], vectors[:, 1]

    def _angles_hold(self, q: Array) -> bool:
        if not len(self._corners):
            return True
        least = self.distances.minimum_angle - self.distances.rounding
        return bool(np.all(angles(*self._vectors(q)) >= least))

    def _angle_rows(self, q: Array, *, motion: bool) -> ClearanceRows:
        """Return the rows of the angles that are near the least one at a configuration.

        Where points are not the nodes, the nodes of the joints stand for them: the rows are then approximate.
        """
        kept, bodies = self.distances, self.monitor.bodies
        first, second = self._vectors(q)
        angle = angles(first, second)
        chosen = np.flatnonzero(angle < kept.minimum_angle + _NEAR_ANGLE)
        angle = angle[chosen]
        gradients = angle_gradients(angle, first[chosen], second[chosen])
        body, end = np.moveaxis(self._corners[chosen], 2, 0)
        far = bodies.joints[body, 1 - end]
        nodes = np.concatenate([bodies.joints[body[:, :1], end[:, :1]], far, far[:, 1:]], axis=1)
        lower = kept.minimum_angle + kept.margin - angle
        return ClearanceRows(
            nodes,
            np.pad(gradients, ((0, 0), (0, 1), (0, 0))),
            np.minimum(lower, 2.0 * kept.margin) if motion else lower,
            lambda k: f"angle: {bodies.names[body[k, 0]]} / {bodies.names[body[k, 1]]}",
        )
