"""What a step keeps apart: members and obstacles, members and members, and the angles between members that meet.

A pair that is already nearer than it may be does not stop the arm: it may not come nearer, and is driven apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.truss.chords import chord_deviation
from vgtm_qp.arm.truss.kinematics import EndKinematics
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.geometry.clearance import BetweenReport, Clearance, NearPairs, Pair
from vgtm_qp.geometry.pairs import certified
from vgtm_qp.geometry.watch import Contacts, Watch
from vgtm_qp.qp.numbers import ClearanceRows

Array = NDArray[np.float64]
Index = NDArray[np.int64]

Shortfall = Mapping[Pair, float]
"""Pairs that are nearer than they may be, with their distances, m."""

_BINDING = 0.002
"""Pairs that are nearer than this to their floor, m, are asked of FCL too."""

_LEAST_APPROACH = 2e-3
"""A pair that slows down may come nearer by so much in one step all the same, m."""

_MOST_PIECES = 16

_NEAR_ANGLE = 0.3
"""Members that meet at an angle larger than the least one by this, rad, are far from it."""

_BETWEEN = 5e-5
"""Members with offset joints may come nearer by this between states, m: half of the published tolerance."""


@dataclass(frozen=True)
class Distances:
    """What is kept: surface to surface from obstacles and between members, m, and angles between members, rad.

    The QP keeps `margin` more, m, for what is not linear in its step; pairs further than `influence`, m, are not
    in it. A pair that is too near at the start of a step is driven apart by up to `recovery`, m, in one step. A pair
    may use up the part `approach` of its room in one step: where that is 1, members come at full speed and stop dead,
    which is a jump in the rates of all actuators.
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
    """Rows, checks and proofs of clearance for the steps of one arm."""

    def __init__(self, arm, monitor: Clearance, distances: Distances) -> None:
        self.monitor = monitor
        self.distances = distances
        self.truss = truss = arm.truss
        self._ends = None if truss.joints is None else EndKinematics(truss)
        self._watch = Watch(monitor) if Watch.serves(monitor) else None
        self._corners = (
            _corners(truss) if distances.minimum_angle > 0.0 else np.zeros((0, 2, 2), dtype=np.int64)
        )

    def shortfall(self, X: Array, time: float) -> Shortfall:
        """Return the pairs that are too near at node positions `X` (N, 3); empty as a rule."""
        kept = self.distances
        floors = kept.safe - kept.rounding, kept.self_safe - kept.rounding
        if self.monitor.keeps(X, time, *floors):
            return {}
        pairs = self.monitor.near(X, time, floors[0], use_fcl=False, self_reach=floors[1])
        found: dict[Pair, float] = {}
        for k in range(len(pairs)):
            pair = pairs.pair(k)
            found[pair] = min(found.get(pair, np.inf), float(pairs.distance[k]))
        return found

    def holds(self, X: Array, time: float, before: Shortfall, *, proven: bool = False) -> Shortfall | None:
        """Return what is too near at `X`, or None where a pair is that was not `before`, or comes nearer.

        `proven` is whether :meth:`between` was certified for the way there, which then holds for its end too; but not
        for offset joints, whose members may come a little nearer on the way than at its end.
        """
        if not self._angles_hold(X):
            return None
        if proven and not before and self.truss.joints is None:
            return {}
        after = self.shortfall(X, time)
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
        if self.truss.joints is None:
            floors = floor - kept.rounding, max(self_floor - kept.rounding, 0.0)
            if self._watch is not None and self._watch.follow(start, end, *floors):
                return certified(min(floors), self.monitor.names)
            return self.monitor.between(start, end, start_time, end_time, *floors)
        # Cut in k pieces the ends leave their chords by a k-th of a k-th.
        deviation = self.deviation(start, end)
        pieces = (
            min(math.ceil(math.sqrt(max(deviation / _BETWEEN, 1.0))), _MOST_PIECES) if deviation < 1.0 else 1
        )
        spare = deviation / pieces**2 - _BETWEEN
        floors, lowest = (floor + spare, max(self_floor + spare, 0.0)), np.inf
        for k in range(pieces):
            here, there = (start + share * (end - start) for share in (k / pieces, (k + 1) / pieces))
            lapse = (end_time - start_time) / pieces
            since = start_time + k * lapse
            report = self.monitor.between(here, there, since, since + lapse, *floors)
            lowest = min(lowest, report.clearance)
            if not report.certified:
                break
        return replace(report, clearance=lowest, fraction=(k + report.fraction) / pieces)

    def deviation(self, start: Array, end: Array) -> float:
        """Return how far members' ends leave their chords at most, m: offset joints turn on the way."""
        return 2.0 * chord_deviation(self.truss, start, end)

    def rows(
        self, X: Array, time: float, duration: float, reach: float, short: Shortfall, gain: float
    ) -> ClearanceRows:
        """Return the rows at `X`.

        Parameters
        ----------
        duration
            How long the obstacles move on until the end of the step, s; zero at the end. Where it is not, a zero
            step is allowed as far as the obstacles rest, but for the margin that the step before may have used up
            and for what is to be recovered; and pairs slow down before they touch.
        reach
            How far a node moves at most, m: a pair further from its floor than that cannot become active. One that
            was missed because a member moved further is found by the check of the new state, and corrected.
        short, gain
            Pairs that were too near at the start of the step, and how far they are driven apart in it, m.
        """
        kept, motion = self.distances, duration > 0.0
        reach += self.monitor.pieces.fastest * duration
        limits = min(kept.influence, kept.safe + reach), min(kept.influence, kept.self_safe + 2.0 * reach)
        fcl_reach = kept.safe + _BINDING if motion else 0.0
        watched = None if self._watch is None or short else self._watch.near(X, *limits, fcl_reach)
        if watched is not None:
            return self._with_angles(self._watched_rows(watched, motion=motion), X, motion=motion)
        pairs = self.monitor.near(
            X, time, limits[0], use_fcl=motion, fcl_reach=fcl_reach, self_reach=limits[1]
        )
        rows = self._clearance_rows(X, pairs)
        if motion:
            np.minimum(rows.lower, 2.0 * kept.margin, out=rows.lower)
        for k in (
            np.flatnonzero(pairs.distance < np.where(pairs.is_self, kept.self_safe, kept.safe))
            if short
            else ()
        ):
            least = kept.self_safe if pairs.is_self[k] else kept.safe
            before = short.get(pairs.pair(int(k)))
            if before is not None:
                rows.lower[k] = min(before + gain, least) - pairs.distance[k]
        if motion and self.monitor.pieces.moving:
            rows.lower += pairs.normal_speed * duration
        return self._with_angles(rows, X, motion=motion)

    def _with_angles(self, rows: ClearanceRows, X: Array, *, motion: bool) -> ClearanceRows:
        """Return the rows of near pairs, slowing down where they are to move, and those of angles at `X`."""
        if motion:
            # Of the room that is left when the obstacles have moved: the arm need not flee from what only comes nearer.
            slow = np.minimum(self.distances.approach * rows.lower, -_LEAST_APPROACH)
            np.maximum(rows.lower, slow, out=rows.lower)
        return rows.joined(self._angle_rows(X, motion=motion)) if len(self._corners) else rows

    def _watched_rows(self, contacts: Contacts, *, motion: bool) -> ClearanceRows:
        """Return the rows n . d(witness) >= floor - distance of contacts in a scene at rest."""
        kept = self.distances
        if not len(contacts.distance):
            return ClearanceRows(name=contacts.name)
        coefficients = contacts.weights[:, :, None] * contacts.normal[:, None, :]
        lower = kept.safe + kept.margin - contacts.distance
        lower += (kept.self_safe - kept.safe) * contacts.is_self
        if motion:
            np.minimum(lower, 2.0 * kept.margin, out=lower)
        return ClearanceRows(contacts.nodes, coefficients, lower, contacts.name)

    def rows_between(
        self, start: Array, X: Array, start_time: float, time: float, stations: list[float]
    ) -> list[ClearanceRows]:
        """Return the rows at the `stations`, 0 to 1, on the way from `start` to `X`: the end state moves them too."""
        kept = self.distances
        found = []
        for s in stations:
            at = start + s * (X - start)
            pairs = self.monitor.near(at, start_time + s * (time - start_time), 1.5 * kept.safe)
            found.append(self._clearance_rows(at, pairs, s))
        return found

    def _clearance_rows(self, X: Array, pairs: NearPairs, fraction: float = 1.0) -> ClearanceRows:
        """Return the rows of pairs found at `X`; those of members in offset joints go over the joints' triangles."""
        kept = self.distances
        floors = kept.safe + kept.margin, kept.self_safe + kept.margin
        rows = clearance_rows(self.monitor, pairs, *floors, fraction)
        if self._ends is None or not len(rows):
            return rows
        self._ends.evaluate(X)
        both = np.stack([pairs.member, np.where(pairs.is_self, pairs.other, pairs.member)], axis=1)
        jacobian = self._ends.jacobian[both].reshape(len(rows), 4, 3, 9)
        coefficients = np.einsum("rsc,rscn->rsn", rows.coefficients, jacobian).reshape(len(rows), 12, 3)
        return replace(rows, nodes=self._ends.nodes[both].reshape(len(rows), 12), coefficients=coefficients)

    def names(self, short: Shortfall) -> tuple[str, ...]:
        """Return what is too near, nearest first."""
        return tuple(
            self.monitor.names.clearance(pair) for pair, _ in sorted(short.items(), key=lambda item: item[1])
        )

    def _angles(self, X: Array) -> tuple[Array, Array, Array]:
        """Return angles (K,), rad, and the two members' vectors (K, 3) away from the node they share, m."""
        ends = self.truss.member_ends(X)
        along = ends[:, 1] - ends[:, 0]
        first, second = (
            np.where(self._corners[:, e, 1, None] == 0, 1.0, -1.0) * along[self._corners[:, e, 0]]
            for e in range(2)
        )
        sine = np.linalg.norm(np.cross(first, second), axis=1)
        return np.arctan2(sine, np.einsum("kc,kc->k", first, second)), first, second

    def _angles_hold(self, X: Array) -> bool:
        if not len(self._corners):
            return True
        return bool(np.all(self._angles(X)[0] >= self.distances.minimum_angle - self.distances.rounding))

    def _angle_rows(self, X: Array, *, motion: bool) -> ClearanceRows:
        angles, first, second = self._angles(X)
        chosen = np.flatnonzero(angles < self.distances.minimum_angle + _NEAR_ANGLE)
        angle, u, v = angles[chosen], first[chosen], second[chosen]
        lengths = [np.linalg.norm(w, axis=1, keepdims=True) for w in (u, v)]
        u, v = u / lengths[0], v / lengths[1]
        sine, cosine = np.sin(angle)[:, None], np.cos(angle)[:, None]
        turn_u = -(v - cosine * u) / (lengths[0] * np.maximum(sine, 1e-6))
        turn_v = -(u - cosine * v) / (lengths[1] * np.maximum(sine, 1e-6))
        corners, members = self._corners[chosen], self.truss.members
        node = members[corners[:, 0, 0], corners[:, 0, 1]]
        others = [members[corners[:, e, 0], 1 - corners[:, e, 1]] for e in range(2)]
        nodes = np.stack([node, *others, others[1]], axis=1)
        coefficients = np.stack([-turn_u - turn_v, turn_u, turn_v, np.zeros_like(turn_u)], axis=1)
        lower = self.distances.minimum_angle + self.distances.margin - angle
        names = self.truss.member_names
        return ClearanceRows(
            nodes,
            coefficients,
            np.minimum(lower, 2.0 * self.distances.margin) if motion else lower,
            lambda k: f"angle: {names[corners[k, 0, 0]]} / {names[corners[k, 1, 0]]}",
        )


def _corners(truss: Truss) -> Index:
    """Return (K, 2, 2): the two members that meet at a node, and which of their ends does."""
    at: dict[int, list[tuple[int, int]]] = {}
    for member, nodes in enumerate(truss.members.tolist()):
        for end, node in enumerate(nodes):
            at.setdefault(node, []).append((member, end))
    found = [(a, b) for meeting in at.values() for k, a in enumerate(meeting) for b in meeting[k + 1 :]]
    return np.array(found, dtype=np.int64).reshape(-1, 2, 2)


def clearance_rows(
    monitor: Clearance, pairs: NearPairs, safe: float, self_safe: float, fraction: float = 1.0
) -> ClearanceRows:
    ends = monitor.members[pairs.member]
    nodes = np.concatenate((ends, ends), axis=1)
    coefficients = np.zeros((len(pairs.distance), 4, 3))
    pull = fraction * pairs.normal
    coefficients[:, 1] = pairs.t[:, None] * pull
    coefficients[:, 0] = pull - coefficients[:, 1]
    lower = safe - pairs.distance
    mutual = np.flatnonzero(pairs.is_self)
    if len(mutual):
        nodes[mutual, 2:] = monitor.members[pairs.other[mutual]]
        coefficients[mutual, 3] = -pairs.t_other[mutual, None] * pull[mutual]
        coefficients[mutual, 2] = -pull[mutual] - coefficients[mutual, 3]
        lower[mutual] += self_safe - safe
    return ClearanceRows(nodes, coefficients, lower, pairs.name)
