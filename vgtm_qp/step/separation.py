"""Clearance in a step: bodies and obstacles, bodies and bodies, the angles between bodies that meet; the user's rows.

A pair that is already below its clearance does not stop the arm: it must not come nearer, and is driven apart.
"""

from __future__ import annotations

import math

import numpy as np

from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.compiled import Kernel
from vgtm_qp.geometry.clearance import BetweenReport, Contacts, Pair
from vgtm_qp.geometry.pairs import Wanted
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.qp.terms import OwnTerms
from vgtm_qp.rows.angles import angle_gradients, angles, corners
from vgtm_qp.rows.clearance import allowed, allowed_function, clearance_rows
from vgtm_qp.rows.limits import LEAST_APPROACH
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import Shortfall, State

RECOVERY = 0.01
"""Distance by which a step drives apart a pair that is too near at its start, over the arm's unit."""

_ROUNDING = 1e-10
"""Shortfall of a clearance that counts as rounding, m, for arms of a fineness of 1."""

_APPROACH = 0.4
"""Largest share of its remaining clearance that a pair may use in one step."""

MOST_PIECES = 16
"""Greatest number of pieces into which a motion is cut if points leave their chords."""

_NEAR_ANGLE = 0.3
"""Excess over the least angle, rad, above which bodies that meet have no row."""

_BETWEEN = 5e-5
"""Violation of a clearance between states that is allowed if points leave their chords, over the arm's unit.

It is half of the published tolerance.
"""


class Separation:
    """Rows, checks and proofs of clearance for the steps of one arm.

    If the `setup` slows down, a pair may use only a share of its remaining clearance in one step. Otherwise
    bodies would arrive at full speed and stop dead, and the rates of all actuators would jump.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup, self._arm, self._monitor = setup, setup.carrier, setup.monitor
        self._approach = _APPROACH if setup.slows_down else 1.0
        self._unit, self._rounding = setup.arm.unit, _ROUNDING * setup.arm.fineness
        self._least, self._between = LEAST_APPROACH * self._unit, _BETWEEN * self._unit
        own = setup.layout.own
        self._own = own if own is not None and own.rows else None
        meeting = setup.monitor.bodies.joints
        self._corners = corners(meeting if setup.minimum_angle > 0.0 else meeting[:0])

    @property
    def pace(self) -> dict[str, Kernel | float]:
        """By name what ``step.c`` knows: the bounds of pairs in a step, and tolerances, m."""
        bounds = Kernel(allowed_function())
        for argument, value in ((1, 2.0 * self._setup.margin), (3, self._approach), (4, self._least)):
            bounds.inputs[argument][:] = value
        return {"allowed": bounds, "rounding": self._rounding, "between": self._between}

    def shortfall(self, q: Array, time: float, *, tracked: bool = False) -> Shortfall:
        """Return the pairs that are too near at a configuration; usually there are none.

        `tracked` says whether it is that of an accepted state, see ``Clearance.near``.
        """
        points, kept = self._arm.points(q), self._setup
        floor, self_floor = kept.safe - self._rounding, kept.self_safe - self._rounding
        if not tracked and self._monitor.keeps(points, time, floor, self_floor):
            return {}
        contacts = self._monitor.near(points, time, floor, self_reach=self_floor, tracked=tracked)
        found: dict[Pair, float] = {}
        for k in range(len(contacts)):
            pair = contacts.pair(k)
            found[pair] = min(found.get(pair, np.inf), float(contacts.distance[k]))
        return found

    def shortfall_of(self, state: State) -> Shortfall:
        """Return the pairs that are too near in a state."""
        return self.shortfall(state.q, state.time) if state.shortfall is None else state.shortfall

    def proof(
        self, state: State, q: Array, time: float, before: Shortfall
    ) -> tuple[BetweenReport, Shortfall | None]:
        """Return the proof of :meth:`between` for the motion to `q`, and the pairs that are too near there.

        The pairs are None where `q` is refused: a pair is too near that was not so `before`, or that came nearer; or an
        angle is too small; or a row of the user's own is not kept. Where points leave their chords, the proof allows a
        little less clearance than a state must have, and the end of the motion is checked by itself.
        """
        report = self.between(state.q, q, state.time, time, before)
        if not self._angles_hold(q) or not (self._own is None or self._own.hold(q)):
            return report, None
        if report.certified and not before and not self._arm.leaves_chords:
            return report, {}
        after = self.shortfall(q, time)
        if all(distance >= before.get(pair, np.inf) - self._rounding for pair, distance in after.items()):
            return report, after
        return report, None

    def between(
        self, start: Array, end: Array, start_time: float, end_time: float, before: Shortfall
    ) -> BetweenReport:
        """Return the proof that no pair falls below its clearance, or below its own at the start if that is less."""
        floor, self_floor = self._setup.safe, self._setup.self_safe
        for pair, distance in before.items():
            if pair.is_self:
                self_floor = min(self_floor, distance)
            else:
                floor = min(floor, distance)
        along, ways, lowered = self._monitor.along, self._arm.ways, self._lowered(before)
        if not self._arm.leaves_chords:
            floors = floor - self._rounding, max(self_floor - self._rounding, 0.0)
            places = ways(start, end, 1)
            report = along(places, start_time, end_time, *floors)
            if report.certified and lowered:
                report = along(places, start_time, end_time, *self._floors(-self._rounding), lowered=lowered)
            return report
        deviation = self.deviation(start, end)
        # In k pieces, the deviation from the chords is 1 / k^2 of the whole. Most motions need only one
        # piece.
        is_far = deviation >= self._unit
        needed = 1 if is_far else math.ceil(math.sqrt(max(deviation / self._between, 1.0)))
        tries = sorted({1, min(needed, MOST_PIECES)})
        for pieces in tries:
            spare = deviation / pieces**2 - self._between
            floors = floor + spare, max(self_floor + spare, 0.0)
            is_last = pieces == tries[-1]
            report = along(ways(start, end, pieces), start_time, end_time, *floors, thorough=is_last)
            if report.certified:
                break
        if report.certified and lowered:
            places, floors = ways(start, end, pieces), self._floors(spare)
            lowered = {pair: least + spare for pair, least in lowered.items()}
            report = along(places, start_time, end_time, *floors, lowered=lowered)
        return report

    def _floors(self, more: float) -> tuple[float, float]:
        """Return the least clearances from obstacles and between bodies, m, and `more`."""
        return self._setup.safe + more, max(self._setup.self_safe + more, 0.0)

    def _lowered(self, before: Shortfall) -> dict[tuple[int, int, bool], float]:
        """Return the floors of pairs that are too near already, m.

        Surfaces that overlap have none: that they come no nearer is proven together with all others.
        """
        found: dict[tuple[int, int, bool], float] = {}
        for (body, other, is_self), distance in before.items():
            pair = body, other if is_self else int(self._monitor.pieces.obstacle[other]), is_self
            least = distance - self._rounding if distance > 0.0 else -math.inf
            found[pair] = min(found.get(pair, math.inf), least)
        return found

    def deviation(self, start: Array, end: Array) -> float:
        """Return a bound of how much nearer two points come to each other than their chords, m."""
        return self._arm.deviation(start, end)

    def rows(
        self,
        q: Array,
        time: float,
        duration: float,
        reach: float,
        short: Shortfall,
        gain: float,
        *,
        expected: Array | None = None,
    ) -> ClearanceRows:
        """Return the rows of every pair that can become active at a configuration, by FCL where proven.

        Parameters
        ----------
        duration
            Time from the configuration to the end of the step, s, in which the obstacles move; zero at the
            end. If it is not zero, pairs slow down before they touch. While obstacles are at rest a zero step
            is then allowed, except for margins used up by the step before and for pairs that are driven
            apart.
        reach
            Bound of the displacement of a node, m: a pair further from its floor cannot become active. If a body moves
            further, the check of the new state finds the missed pair, and another QP corrects it.
        short, gain
            Pairs that were too near at the start of the step, and the distance by which they are driven apart, m.
        expected
            Displacement of the configuration, if one is known: pairs whose approach in it is less than their distance
            from the floor need no rows.
        """
        kept, motion, monitor = self._setup, duration > 0.0, self._monitor
        reach += monitor.pieces.fastest * duration
        limits = min(kept.influence, kept.safe + reach), min(kept.influence, kept.self_safe + 2.0 * reach)
        wanted = None if expected is None else self._wanted(expected, duration)
        contacts = monitor.near(
            self._arm.points(q),
            time,
            limits[0],
            self_reach=limits[1],
            by_fcl=True,
            tracked=not short,
            wanted=wanted,
        )
        rows = self._clearance_rows(q, contacts)
        if len(contacts):
            self._allow(rows, contacts, duration, short, gain)
        if len(self._corners):
            rows = rows.joined(self._angle_rows(q, motion=motion))
        return rows if self._own is None else rows.joined(self._own_rows(self._own, q, motion=motion))

    def _own_rows(self, own: OwnTerms, q: Array, *, motion: bool) -> ClearanceRows:
        names = list(own.units)
        return ClearanceRows(*own.linear_rows(q, motion=motion), names.__getitem__)

    def _wanted(self, expected: Array, duration: float) -> Wanted | None:
        """Return which pairs can become active in a displacement; None for all."""
        approach = self._arm.approach(expected)
        if approach is None:
            return None
        kept, drift = self._setup, self._monitor.pieces.fastest * duration

        def wanted(body: Index, other: Index, distance: Array, *, is_self: bool) -> Mask:
            floor = kept.margin + (kept.self_safe if is_self else kept.safe)
            nearer = approach(body, other) if is_self else approach(body) + drift
            # NaN fails the comparison.
            return ~(distance >= floor + nearer)

        return wanted

    def _allow(
        self, rows: ClearanceRows, contacts: Contacts, duration: float, short: Shortfall, gain: float
    ) -> None:
        """Limit the approach of pairs in one step: overwrites ``rows.lower``; arguments as of :meth:`rows`."""
        kept, most = self._setup, np.full(len(contacts), 2.0 * self._setup.margin)
        if short:
            # Pairs that were too near are driven apart by the gain, but not beyond their clearance.
            floor = np.where(contacts.is_self, kept.self_safe, kept.safe)
            for k in np.flatnonzero(contacts.distance < floor).tolist():
                before = short.get(contacts.pair(k))
                if before is not None:
                    rows.lower[k], most[k] = min(before + gain, floor[k]) - contacts.distance[k], np.inf
        if duration > 0.0:
            nearer = contacts.normal_speed * duration
            rows.lower = allowed(rows.lower, most, nearer, self._approach, self._least)

    def with_rows_between(
        self, rows: ClearanceRows, state: State, q: Array, time: float, fractions: list[float]
    ) -> ClearanceRows:
        """Return `rows`, and the rows at `fractions`, 0 to 1, of the motion from a state to `q`."""
        for s in fractions:
            at, now = state.q + s * (q - state.q), state.time + s * (time - state.time)
            contacts = self._monitor.near(self._arm.points(at), now, 1.5 * self._setup.safe, by_fcl=True)
            rows = rows.joined(self._clearance_rows(at, contacts, s))
        return rows

    def _clearance_rows(self, q: Array, contacts: Contacts, fraction: float = 1.0) -> ClearanceRows:
        """Return the rows of contacts found at a configuration, at a `fraction` of the motion to the end."""
        if not len(contacts):
            return ClearanceRows(name=contacts.name)
        kept = self._setup
        pairs = contacts.distance, contacts.normal, contacts.weights, contacts.is_self
        coefficients, lower = clearance_rows(
            *pairs, kept.safe, kept.self_safe, margin=kept.margin, fraction=fraction
        )
        nodes, coefficients = self._arm.over_nodes(q, contacts.points, coefficients)
        by_fcl = int(np.count_nonzero(contacts.by_fcl))
        return ClearanceRows(nodes, coefficients, lower, contacts.name, by_fcl, len(contacts) - by_fcl)

    def _vectors(self, q: Array) -> tuple[Array, Array]:
        """Return the vectors (K, 3), m, of both bodies of each corner away from the joint where they meet."""
        points, (body, end) = self._monitor.bodies.points, np.moveaxis(self._corners, 2, 0)
        vectors = self._arm.points(q)
        vectors = vectors[points[body, 1 - end]] - vectors[points[body, end]]
        return vectors[:, 0], vectors[:, 1]

    def _angles_hold(self, q: Array) -> bool:
        if not len(self._corners):
            return True
        return bool(np.all(angles(*self._vectors(q)) >= self._setup.minimum_angle - _ROUNDING))

    def _angle_rows(self, q: Array, *, motion: bool) -> ClearanceRows:
        """Return the rows of the angles that are near the least one at a configuration.

        If points are not the nodes, the nodes of the joints stand for them, and the rows are approximate.
        """
        kept, bodies = self._setup, self._monitor.bodies
        first, second = self._vectors(q)
        angle = angles(first, second)
        chosen = np.flatnonzero(angle < kept.minimum_angle + _NEAR_ANGLE)
        angle = angle[chosen]
        gradients = angle_gradients(angle, first[chosen], second[chosen])
        body, end = np.moveaxis(self._corners[chosen], 2, 0)
        far = bodies.joints[body, 1 - end]
        nodes = np.concatenate([bodies.joints[body[:, :1], end[:, :1]], far, far[:, 1:]], axis=1)
        margin = kept.margin / self._unit
        lower = kept.minimum_angle + margin - angle
        return ClearanceRows(
            nodes,
            np.pad(gradients, ((0, 0), (0, 1), (0, 0))),
            np.minimum(lower, 2.0 * margin) if motion else lower,
            lambda k: f"angle: {bodies.names[body[k, 0]]} / {bodies.names[body[k, 1]]}",
        )
