"""The second arm behind the door: joints one after another, whose values and base pose are the configuration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from vgtm_qp.arm.arm import Arm, Label, MotionPattern, Pose, Stations, Tip, has_full_rank, or_none
from vgtm_qp.arm.serial.chain import SerialChain
from vgtm_qp.arm.serial.symbols import ChainSymbols
from vgtm_qp.arm.symbols import Constants
from vgtm_qp.arrays import Array
from vgtm_qp.geometry.bodies import Bodies, capsules
from vgtm_qp.problem.arm import ArmTable
from vgtm_qp.rotation import rotation_from_vector, turn_between, vector_near


@dataclass(frozen=True)
class ChainDescription:
    """What `vgtm check` tells of a serial arm.

    Attributes
    ----------
    joints, actuated, links, stations : int
    length : float
        Of the way from the base over the joints to the tip at home, m.
    hard : bool
        Whether all stations can keep their positions on the curve at home.
    """

    joints: int
    actuated: int
    links: int
    stations: int
    length: float
    hard: bool

    def __str__(self) -> str:
        can = "can" if self.hard else "cannot"
        return (
            f"serial arm of {self.joints} joints, {self.actuated} of them actuated, {self.links} links, "
            f"{self.length:.6g} m long\n"
            f"{self.stations} stations track the curve; they {can} keep their positions on it exactly"
        )


@dataclass(frozen=True, eq=False)
class ChainRows:
    """d_rho - K d_a = rhs; see ``arm.MotionRows``. `jacobian` is K."""

    jacobian: Array
    rhs: Array

    @property
    def values(self) -> Array:
        return np.concatenate([np.ones(len(self.rhs)), -self.jacobian.reshape(-1)])

    def response(self) -> tuple[Array, Array]:
        """Return K and r."""
        return self.jacobian, self.rhs


class SerialArm(Arm):
    """See ``arm.Arm``; joints of an ``[arm]`` table, of which those that are locked from the start are stuck at home.

    Its nodes are those of ``SerialChain.functions``.
    """

    kind = "serial"
    bays = None
    leaves_chords = True

    def __init__(self, spec: ArmTable) -> None:
        joints, stuck = spec.joint, {lock.member for lock in spec.locked if lock.time == 0.0}
        self.segments, self.quantity_names = len(joints), tuple(joint.name for joint in joints)
        self.home_quantities = np.array([joint.home for joint in joints], dtype=float)
        self.home_configuration = np.concatenate([self.home_quantities, np.zeros(6)])
        self.actuated = np.array([joint.name not in stuck for joint in joints])
        self.actuator_units = tuple(
            "rad" if joint.kind == "revolute" else "m" for joint in joints if joint.name not in stuck
        )
        self.stroke = np.array([joint.limits or (-np.inf, np.inf) for joint in joints], dtype=float)
        self.rate = _or_infinite([joint.rate for joint in joints])
        self.acceleration = _or_infinite([joint.acceleration for joint in joints])
        chain = SerialChain.of(spec)
        self.chain = chain if spec.every else replace(chain, every=self._every(chain))
        self._place_stations()
        self.bodies = self._links(spec.link_radius)

    def _every(self, chain: SerialChain) -> int:
        """Return the least distance of stations, in joints, at which all of them can keep to the curve at once at home.

        Where there is none, as at the straight home of a snake, there is a station for every three actuators.
        """
        joints, (_, jacobian) = len(chain), chain.at(self.home_configuration)
        for every in range(1, joints + 1):
            if self._can_hold(jacobian[[*range(1 + every, joints + 1, every), joints + 1]]):
                return every
        return -(-joints // max(1, len(self.actuators) // 3))

    def _can_hold(self, jacobian: Array) -> bool:
        """Whether nodes whose Jacobian (K, 3, J) this is can be held in place one by one."""
        return has_full_rank(jacobian[:, :, self.actuators].reshape(3 * len(jacobian), len(self.actuators)))

    def _place_stations(self) -> None:
        """Find nodes and stations at home; the stations' z-axes lie along the arm."""
        count, tracked = len(self.chain), self.chain.tracked
        words = ["base", *(self.quantity_names[j] for j in tracked), "tip"]
        beside = tuple(f"{word} {axis}" for word in words for axis in "xy")
        self.node_names = ("base", *self.quantity_names, "tip", *beside)
        self.home, jacobian = self.chain.at(self.home_configuration)
        self.height = float(np.linalg.norm(np.diff(self.home[: count + 2], axis=0), axis=1).sum())
        origins = np.array([0, *(1 + j for j in tracked), count + 1])
        first = count + 2 + 2 * np.arange(len(origins))
        nodes = np.column_stack([origins, first, first + 1])
        self.base = np.isin(np.arange(len(self.home)), [0, 1, *nodes[0]])
        self.free = np.flatnonzero(~self.base)
        frames = [np.eye(3)]
        for before, after in pairwise(self.home[origins]):
            way, length = after - before, float(np.linalg.norm(after - before))
            # Of two stations in one place the second has the attitude of the first.
            turn = turn_between(frames[-1][:, 2], way / length) if length > 0.0 else np.zeros(3)
            frames.append(rotation_from_vector(turn) @ frames[-1])
        weights = np.tile([1.0, 0.0, 0.0], (len(nodes), 1))
        trackable = ("position",) if self._can_hold(jacobian[origins[1:]]) else ()
        self.stations = Stations(nodes, weights, np.stack(frames), trackable, word="joint")
        self.end_effector = Tip(nodes[-1], weights[-1], frames[-1])

    def _links(self, radius: float) -> Bodies:
        """Return links between successive origins; those of joints in one place are joined as if they were one."""
        chain, count = self.chain, len(self.chain)
        apart = (chain.lengths[1:] > 0.0) | ~chain.revolute
        place = np.arange(count + 2)
        for node in range(count, 0, -1):
            place[node] = node if apart[node - 1] else place[node + 1]
        kept = np.flatnonzero(apart)
        points = np.stack([kept + 1, kept + 2], axis=1)
        names = [self.quantity_names[j] for j in kept]
        return capsules(points, radius, names, joints=place[points], kind="link")

    @cached_property
    def motion_pattern(self) -> MotionPattern:
        """d_rho - K d_a, dense in the actuators."""
        rows, count = 3 * len(self.free), len(self.actuators)
        grid, own = np.indices((rows, count)).reshape(2, -1), np.arange(rows)
        labels = tuple(
            Label(f"node: {self.node_names[n]} {axis}", "kinematics", "m")
            for n in self.free
            for axis in "xyz"
        )
        return MotionPattern(np.concatenate([own, grid[0]]), np.concatenate([own, rows + grid[1]]), labels)

    def symbols(self, constants: Constants) -> ChainSymbols:
        return ChainSymbols(self.chain, self.home_quantities, self.actuators, self.free, constants)

    def motion_rows(self, *values: Array) -> ChainRows:
        """See ``arm.Arm``: K column by column, and r."""
        response, rhs = values
        return ChainRows(response.reshape(len(self.actuators), len(rhs)).T, rhs)

    def measured(self, q: Array) -> Array:
        return np.array(q[:-6])

    def based(self, q: Array, pose: Pose) -> Array:
        return np.concatenate([q[:-6], pose.position, vector_near(pose.rotation, q[-3:])])

    def advanced(self, q: Array, nodes: Array, strokes: Array) -> Array:  # noqa: ARG002
        q = q.copy()
        q[self.actuators] += strokes
        return q

    def corrected(self, q: Array, missing: Array, solve: Callable[[], Array]) -> Array:  # noqa: ARG002
        return np.concatenate([q[:-6] + missing, q[-6:]])

    def travel(self, motion: Array) -> float:
        turn, slide = self._motions(motion)
        return float(turn @ self._reach + slide.sum() + np.abs(motion[-6:-3]).max(initial=0.0))

    def deviation(self, start: Array, end: Array) -> float:
        """See ``arm.Arm``: an eighth of a bound of the nodes' second derivative on the way, for both of a pair.

        A point's velocity is sum w_j a_j x (X - o_j) + sum d_j a_j, the axes a_j turn with all joints before them, and
        what is beyond a joint moves against it by no more than its own joints make it.
        """
        turn, slide = self._motions(end - start)
        before = np.concatenate([[0.0], np.cumsum(turn)[:-1]])
        beyond = np.cumsum((turn * self._reach + slide)[::-1])[::-1]
        bend = turn @ (2.0 * before * self._reach + beyond) + slide @ before
        return 2.0 * float(bend) / 8.0

    @cached_property
    def _reach(self) -> Array:
        """(J + 1,) bound of the distance from the base, and from each joint, to any node beyond it in any pose, m."""
        chain = self.chain
        slide = np.where(chain.revolute, 0.0, np.abs(self.stroke).max(axis=1, initial=0.0))
        beyond = np.cumsum((chain.lengths[1:] + slide)[::-1])[::-1] + np.sqrt(2.0) * chain.spread
        return np.concatenate([[beyond[0] + chain.lengths[0]], beyond])

    def _motions(self, motion: Array) -> tuple[Array, Array]:
        """Return turns (J + 1,), rad, the base's first and counted twice, and slides (J + 1,), m."""
        joints, revolute = np.abs(motion[:-6]), self.chain.revolute
        base = 2.0 * float(np.linalg.norm(motion[-3:]))
        turn, slide = np.where(revolute, joints, 0.0), np.where(revolute, 0.0, joints)
        return np.concatenate([[base], turn]), np.concatenate([[0.0], slide])

    def reach(self) -> Array:
        return np.full(int(self.base.sum()), self._reach[0])

    def describe(self) -> ChainDescription:
        stations, hard = len(self.stations) - 1, "position" in self.stations.trackable
        return ChainDescription(
            self.segments, len(self.actuators), len(self.bodies), stations, self.height, hard
        )

    def record(self) -> dict[str, Any]:
        """See ``arm.Arm``.

        Keys: ``kind``, ``joint_names``, ``revolute``, ``axis``, ``position``, ``rotation`` (in the frame of the one
        before), ``home``, ``stroke``, ``rate``, ``acceleration``, ``actuated``, ``tip`` in the last frame and
        ``tip_frame`` at home; of the bodies ``body_names``, ``radius``, ``links`` (their points: base, joints, tip) and
        ``joined`` (their ends; bodies with one in common are neighbours). None means no limit.
        """
        chain, bodies = self.chain, self.bodies
        return {
            "kind": self.kind,
            "joint_names": list(self.quantity_names),
            "revolute": chain.revolute.tolist(),
            "axis": chain.axis.tolist(),
            "position": chain.position.tolist(),
            "rotation": chain.rotation.tolist(),
            "home": self.home_quantities.tolist(),
            "stroke": [or_none(limits) for limits in self.stroke],
            "rate": or_none(self.rate),
            "acceleration": or_none(self.acceleration),
            "actuated": self.actuated.tolist(),
            "tip": chain.tip.tolist(),
            "tip_frame": self.end_effector.frame.tolist(),
            "body_names": list(bodies.names),
            "radius": bodies.radius.tolist(),
            "links": bodies.points.tolist(),
            "joined": bodies.joints.tolist(),
        }

    def recorded(self, q: Array, quantities: Array) -> dict[str, Any]:  # noqa: ARG002
        """See ``arm.Arm``: the base's pose follows from the problem."""
        names = {"joint_names": np.array(self.quantity_names), "body_names": np.array(self.bodies.names)}
        return {"joints": quantities, **names}


def _or_infinite(limits: Sequence[float | None]) -> Array:
    return np.array([np.inf if limit is None else limit for limit in limits])
