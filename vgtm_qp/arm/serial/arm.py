"""A serial arm: joints one after another, from the ``[arm]`` table of a problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from vgtm_qp.arm.arm import Approach, Stations, Tip, has_full_rank
from vgtm_qp.arm.frames import frames_along
from vgtm_qp.arm.joint_space import Follower, JointSpaceArm
from vgtm_qp.arm.serial.bend import bend_function
from vgtm_qp.arm.serial.chain import SerialChain, hull_of, vertices_of
from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.compiled import Kernel
from vgtm_qp.geometry.bodies import Bodies, Hull, capsules, convex_bodies
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.problem.arm import ArmBody, ArmTable, Joint

_BENDS = (0.1, 0.3, -0.3)
"""Turns, rad, that are tried to bend a home from which the tip cannot start in every direction."""


class SerialArm(JointSpaceArm):
    """See ``arm.Arm``; the joints of an ``[arm]`` table. Joints locked from the start stay at home.

    Its nodes are those of ``SerialChain.functions``.

    Attributes
    ----------
    chain : SerialChain
    values : (J, 2)
        Least and greatest values of all joints, rad or m, followers included.
    """

    kind = "serial"

    def __init__(self, spec: ArmTable) -> None:
        joints, stuck = spec.joint, {lock.joint for lock in spec.locked if lock.time == 0.0}
        self.segments, self.quantity_names = len(joints), tuple(joint.name for joint in joints)
        self.home_configuration = np.array([*spec.home_values(), *[0.0] * 6], dtype=float)
        self.actuated = np.array([joint.name not in stuck and joint.mimic is None for joint in joints])
        self._limit(joints)
        self.home_quantities = self.measured(self.home_configuration)
        hulls = [hull_of(body) for body in spec.body or ()]
        chain = SerialChain.of(spec, hulls)
        self.chain = chain if spec.every else replace(chain, every=self._every(chain))
        self.functions, self.constants = self.chain.functions, self.chain.constants
        self.movers = self.chain.movers
        self.mass, self.weight = float(chain.mass.sum()), chain.weight
        self.revolute, self.reaches = chain.revolute, self._reaches()
        self.actuator_units = tuple("rad" if turns else "m" for turns in self.revolute[self.actuated])
        self._place_stations(spec.tip_rotation_vector)
        if not spec.body:
            self._vertices, self.bodies = None, self._links(spec.link_radius)
            return
        sides = zip(spec.body, hulls, strict=True)
        self._vertices = tuple(vertices_of(body, hull)[1] for body, hull in sides)
        self.bodies = self._apart(self._carried(spec.body, hulls))

    def _limit(self, joints: Sequence[Joint]) -> None:
        """Find followers and limits; the limits of a follower become limits of the joint that it follows."""
        number = {joint.name: k for k, joint in enumerate(joints)}
        self.stroke = np.array([joint.limits or (-np.inf, np.inf) for joint in joints], dtype=float)
        self.rate = _or_infinite([joint.rate for joint in joints])
        self.acceleration = _or_infinite([joint.acceleration for joint in joints])
        self.effort = _or_infinite([joint.effort for joint in joints])
        rules = [(k, joint.mimic) for k, joint in enumerate(joints) if joint.mimic is not None]
        self.followers = tuple(Follower(k, number[rule.joint], rule.multiplier) for k, rule in rules)
        for (k, rule), (_, other, factor) in zip(rules, self.followers, strict=True):
            least, greatest = np.sort((self.stroke[k] - rule.offset) / factor)
            self.stroke[other] = max(self.stroke[other, 0], least), min(self.stroke[other, 1], greatest)
            self.rate[other] = min(self.rate[other], self.rate[k] / abs(factor))
            self.acceleration[other] = min(self.acceleration[other], self.acceleration[k] / abs(factor))
            self.rate[k] = self.acceleration[k] = np.inf
        self.values = self.stroke.copy()
        for (k, rule), (_, other, factor) in zip(rules, self.followers, strict=True):
            self.values[k] = np.sort(factor * self.stroke[other] + rule.offset)
            self.stroke[k] = -np.inf, np.inf

    def _placed(self, chain: SerialChain, q: Array) -> tuple[Array, Array]:
        """Return nodes (N, 3), m, and their derivatives (N, 3, J) by the quantities, at a configuration."""
        nodes, jacobian = chain.at(q)
        return nodes, self.by_quantities(jacobian.reshape(-1, len(chain))).reshape(jacobian.shape)

    def _every(self, chain: SerialChain) -> int:
        """Return the least spacing of stations, in joints, at which all can keep to the curve at home.

        If no spacing allows that, as at the straight home of a snake, there is a station for every three
        actuators.
        """
        joints, (_, jacobian) = len(chain), self._placed(chain, self.home_configuration)
        for every in range(1, joints + 1):
            if self._can_hold(jacobian[[*range(1 + every, joints + 1, every), joints + 1]]):
                return every
        return -(-joints // max(1, len(self.actuators) // 3))

    def _can_hold(self, jacobian: Array) -> bool:
        """Whether nodes with a Jacobian (K, 3, J) can be held in place independently."""
        return has_full_rank(jacobian[:, :, self.actuators].reshape(3 * len(jacobian), len(self.actuators)))

    def _place_stations(self, tip_turn: Sequence[float] | None) -> None:
        """Find nodes and stations at home; the stations' z-axes lie along the arm.

        The end effector's z-axis does too, unless the rotation vector `tip_turn`, rad, gives its attitude in
        the last frame.
        """
        count, tracked = len(self.chain), self.chain.tracked
        words = ["base", *(self.quantity_names[j] for j in tracked), "tip"]
        beside = tuple(f"{word} {axis}" for word in words for axis in "xy")
        points = tuple(f"point {k}" for k in range(len(self.chain.points)))
        self.node_names = ("base", *self.quantity_names, "tip", *points, *beside)
        self.home, jacobian = self._placed(self.chain, self.home_configuration)
        self.height = float(np.linalg.norm(np.diff(self.home[: count + 2], axis=0), axis=1).sum())
        self.unit = self.chain.mean_length
        origins = np.array([0, *(1 + j for j in tracked), count + 1])
        first = count + 2 + len(points) + 2 * np.arange(len(origins))
        nodes = np.column_stack([origins, first, first + 1])
        fixed = count + 2 + np.flatnonzero(self.chain.carriers == 0)
        self.base = np.isin(np.arange(len(self.home)), [0, 1, *fixed, *nodes[0]])
        self.free = np.flatnonzero(~self.base)
        weights = np.tile([1.0, 0.0, 0.0], (len(nodes), 1))
        frames = frames_along(self.home[origins])
        trackable = ("position",) if self._can_hold(jacobian[origins[1:]]) else ()
        self.stations = Stations(nodes, weights, frames, trackable, word="joint")
        frame = frames[-1] if tip_turn is None else self.chain.attitude(self.home_configuration, tip_turn)
        self.end_effector = Tip(nodes[-1], weights[-1], frame)

    def _reaches(self) -> Array:
        """Return (J + 1,) the :attr:`reaches`: all slides fully extended, all links in one line."""
        chain, (to_places, to_frames) = self.chain, self._ways
        beside = np.full(len(chain) + 1, np.sqrt(2.0) * chain.spread)
        tip = to_places[-1] + beside[-1]
        np.maximum.at(beside, chain.carriers, chain.beyond)
        furthest = to_frames + beside
        furthest[-1] = max(furthest[-1], tip)
        reaches = np.maximum.accumulate(furthest[::-1])[::-1]
        reaches[1:] -= to_places[:-1]
        return reaches

    def reach(self) -> Array:
        """See ``arm.Arm``: from the base's origin and from that of the first joint, which are its first nodes."""
        to_places, bounds = self._ways[0], np.full(int(self.base.sum()), np.inf)
        bounds[:2] = to_places[-1], to_places[-1] - to_places[0]
        return bounds

    def tip_deviation(self, start: Array, end: Array, reach: float) -> float:
        """See ``arm.Arm``: an eighth of a bound of a point's second derivative, at least that for all nodes."""
        bend = self._bend
        bend.inputs[0][:], bend.inputs[1][:] = start, end
        bend()
        nodes, tip, beyond = bend.outputs[0]
        return float(max(nodes, tip + beyond * reach)) / 8.0

    def bending(self) -> Kernel:
        return bend_function(self.chain).kernel()

    def approach(self, motion: Array) -> Approach:
        """See ``arm.Arm``.

        A joint between two bodies moves the further one by at most its turn times the length of the links up
        to there.
        """
        # For each joint, sums over the joints before it: turns, turns times lengths along the links, slides.
        sums = np.zeros((3, len(self.chain) + 1))
        # Infinite limits give NaN.
        with np.errstate(invalid="ignore"):
            np.cumsum(np.abs(motion[:-6]) * self._shares, axis=1, out=sums[:, 1:])
        way, (first, last) = self._extents, self._movers

        def bound(body: Index, other: Index | None = None) -> Array:
            begin, further = np.zeros(len(body), dtype=np.int64), body
            if other is not None:
                begin = np.minimum(first[body], first[other])
                further = np.where(last[body] > last[other], body, other)
            with np.errstate(invalid="ignore"):
                turns, levers, slides = sums[:, last[further]] - sums[:, begin]
                return np.asarray(way[further] * turns - levers + slides)

        return bound

    @cached_property
    def _shares(self) -> Array:
        """(3, J) turn, turn times the length along the links up to there, and slide, per change of a joint."""
        return np.stack([self.revolute, self.revolute * self._ways[0][:-1], ~self.revolute])

    @cached_property
    def _extents(self) -> Array:
        """(B,) lengths along the links from the base to the furthest points of bodies, m."""
        chain, (to_places, to_frames) = self.chain, self._ways
        to_points = to_frames[chain.carriers] + chain.beyond
        extents: Array = np.concatenate([[0.0], to_places, to_points])[self.bodies.points].max(axis=1)
        return extents

    @cached_property
    def _movers(self) -> tuple[Index, Index]:
        """(B,) numbers of joints that move a body as a whole, and (B,) of joints that move any part of it."""
        places = np.concatenate([[0], np.arange(len(self.chain) + 1), self.chain.carriers])
        last = places[self.bodies.points].max(axis=1)
        # A slide within a body stretches it; a joint that turns a body is at its end.
        stretches = (last > 0) & ~self.revolute[last - 1] & (places[self.bodies.points].min(axis=1) < last)
        return last - stretches, last

    @cached_property
    def _ways(self) -> tuple[Array, Array]:
        """Lengths along the links from the base, slides fully extended, m.

        The first (J + 1,) lead to the joints and the tip; the second (J + 1,) to the origins of the frames of
        the base and the joints.
        """
        to_places = np.cumsum(self.chain.lengths + np.concatenate([[0.0], self._slides()]))
        return to_places, np.concatenate([[0.0], to_places[:-1] + self._slides()])

    def _slides(self) -> Array:
        """Return (J,) the greatest extensions of slides, m; 0 for joints that turn."""
        return np.where(self.chain.revolute, 0.0, np.abs(self.values).max(axis=1, initial=0.0))

    def _links(self, radius: float) -> Bodies:
        """Return links between successive origins; joints that are always in one place join links like one joint."""
        place = self._places()
        kept = np.flatnonzero(self._have_length())
        points = np.stack([kept + 1, kept + 2], axis=1)
        names = [self.quantity_names[j] for j in kept]
        return capsules(points, radius, names, joints=place[points], kind="link")

    def _have_length(self) -> Mask:
        """Return (J,) True for joints whose origin may be apart from the next one."""
        return (self.chain.lengths[1:] > 0.0) | ~self.chain.revolute

    def _places(self) -> Index:
        """Return (J + 2,) numbers of the origins, base first, the same for those that are always in one place."""
        place, apart = np.arange(len(self.chain) + 2), self._have_length()
        for node in range(len(self.chain), 0, -1):
            place[node] = node if apart[node - 1] else place[node + 1]
        return place

    def _carried(self, table: Sequence[ArmBody], hulls: Sequence[Hull | None]) -> Bodies:
        """Return the bodies of the table; those that move with one joint, or with successive ones, are neighbours."""
        spans = [2 if hull is None else len(hull.simplex) for hull in hulls]
        first = np.cumsum([0, *spans])
        points = [
            range(len(self.chain) + 2 + k, len(self.chain) + 2 + k + n)
            for k, n in zip(first, spans, strict=False)
        ]
        carrier = self.chain.carriers[first[:-1]]
        joints = self._places()[np.stack([carrier, carrier + 1], axis=1)]
        radius, names = [body.radius for body in table], [body.name for body in table]
        return convex_bodies(points, hulls, radius, names, joints=joints)

    def _apart(self, bodies: Bodies) -> Bodies:
        """Return the bodies without the pairs that touch at home: these are not kept apart."""
        near = Clearance(bodies, safe=0.0, influence=0.0, watch=False, by_fcl=False).near(self.home)
        touching = near.distance <= 0.0
        pairs = np.stack([near.body[touching], near.other[touching]], axis=1)
        return replace(bodies, touching=np.unique(np.sort(pairs, axis=1), axis=0))

    def unreachable(self) -> tuple[str, ...]:
        """See ``arm.Arm``: with a bent home that the tip can leave in every direction, if there is one."""
        tip, turning = len(self.chain) + 1, self.revolute & self.actuated
        for turn in _BENDS:
            further = self.home_configuration[:-6] + np.where(turning, turn, 0.0)
            within = (further >= self.stroke[:, 0]) & (further <= self.stroke[:, 1])
            q = self.home_configuration.copy()
            q[:-6] += self.following(np.where(turning & within, turn, 0.0))
            if self._can_hold(self._placed(self.chain, q)[1][[tip]]):
                own = np.setdiff1d(np.arange(len(q) - 6), [one.joint for one in self.followers])
                values = ", ".join(f"{value:.6g}" for value in q[own])
                return (f"the axes of its joints leave a direction out; it can with home values {values}",)
        return ()

    def hollow(self) -> float:
        """See ``arm.Arm``: from the tip to points of the bodies that move with it."""
        if not len(self.chain.points):
            return 0.0
        points = self.bodies.some(self.home)[self._carriers() == len(self.chain)]
        gaps = np.linalg.norm(points - self.end_effector.position(self.home), axis=2)
        return float(gaps.min(initial=np.inf))

    def _carriers(self) -> Index:
        """Return (B,) numbers of the joints that bodies of the table move with."""
        return np.asarray(self.chain.carriers[self.bodies.points[:, 0] - len(self.chain) - 2])

    def record(self) -> dict[str, Any]:
        """See ``arm.Arm``.

        Keys: ``kind``, ``joint_names``, ``revolute``, ``axis``, ``position``, ``rotation`` (in the frame of
        the joint before), ``home``, ``followers`` (joint, and the joint it follows) and their
        ``multipliers``, ``tip`` in the last frame and ``tip_frame`` at home; of the bodies ``body_names``,
        ``links`` (the two ends or the vertices of each, padded by the last one, among these points: base, joints, tip,
        then those of bodies) and ``joined`` (their ends; bodies
        with one in common are neighbours), ``points`` of bodies in the frames of their ``carriers``, numbers
        of joints that move them, and ``touching`` pairs, which are not kept apart.
        """
        chain, bodies = self.chain, self.bodies
        keys = ("revolute", "axis", "position", "rotation", "tip")
        geometry = {key: getattr(chain, key) for key in keys} | self._recorded_bodies()
        arrays = {
            "home": self.home_configuration[:-6],
            "followers": np.array([one[:2] for one in self.followers], dtype=np.int64).reshape(-1, 2),
            "multipliers": np.array([one.multiplier for one in self.followers]),
            "tip_frame": self.end_effector.frame,
            "joined": bodies.joints,
            "touching": bodies.touching,
            **geometry,
        }
        names = {"joint_names": list(self.quantity_names), "body_names": list(bodies.names)}
        lists = {key: array.tolist() for key, array in arrays.items()}
        return {**super().record(), "kind": self.kind, **names, **lists}

    def _recorded_bodies(self) -> dict[str, Array | Index]:
        """Return the keys ``links``, ``points`` and ``carriers`` of the record."""
        none = np.zeros(0, dtype=np.int64)
        if self._vertices is None:
            return {"links": self.bodies.points, "points": none.reshape(0, 3), "carriers": none}
        counts = [len(vertices) for vertices in self._vertices]
        first = len(self.chain) + 2 + np.cumsum([0, *counts[:-1]])
        every, last = np.arange(max(counts, default=2)), np.array(counts)[:, None] - 1
        return {
            "links": first[:, None] + np.minimum(every, last),
            "points": np.concatenate(self._vertices),
            "carriers": np.repeat(self._carriers(), counts),
        }


def _or_infinite(limits: Sequence[float | None]) -> Array:
    return np.array([np.inf if limit is None else limit for limit in limits])
