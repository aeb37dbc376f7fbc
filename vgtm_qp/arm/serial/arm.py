"""The second arm behind the door: joints one after another, whose values and base pose are the configuration."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

from vgtm_qp.arm.arm import Label, MotionPattern, Pose, Stations, Tip
from vgtm_qp.arm.record import or_none
from vgtm_qp.arm.serial.chain import Array, Index, Mask, SerialChain
from vgtm_qp.arm.serial.description import ChainDescription
from vgtm_qp.arm.serial.kinematics import ChainKinematics, ChainRows
from vgtm_qp.arm.serial.symbols import ChainSymbols
from vgtm_qp.arm.symbols import Constants
from vgtm_qp.compiled import Kernel
from vgtm_qp.geometry.bodies import Bodies, capsules
from vgtm_qp.rotation import vector_near


class SerialArm:
    """See ``arm.Arm``; its nodes are the joints' origins, the tip, and two beside each station."""

    kind = "serial"
    bays = None
    leaves_chords = True

    def __init__(self, chain: SerialChain) -> None:
        self.chain = chain
        self.node_names, self.quantity_names = chain.node_names, chain.names
        self.stroke, self.rate, self.acceleration = chain.limits, chain.rate, chain.acceleration
        self.home_quantities, self.segments = chain.home, len(chain)
        self.home_configuration = np.concatenate([chain.home, np.zeros(6)])
        self.actuated: Mask = ~chain.locked
        self.actuators, self.base, self.free = chain.actuators, chain.base, chain.free
        self.actuator_units = tuple("rad" if chain.revolute[j] else "m" for j in self.actuators)
        self._nodes = Kernel(chain.nodes, compiled=False)
        for argument, part in enumerate(chain.geometry.values(), start=1):
            self._nodes.inputs[argument][:] = part.reshape(-1)
        self.home = chain.home_nodes
        self.height = float(np.linalg.norm(np.diff(self.home[: len(chain) + 2], axis=0), axis=1).sum())
        nodes, origin = chain.station_nodes, np.array([1.0, 0.0, 0.0])
        trackable = ("position",) if chain.holds_origins(nodes[1:, 0]) else ()
        weights = np.tile(origin, (len(nodes), 1))
        self.stations = Stations(nodes, weights, chain.station_frames, trackable, word="joint")
        self.end_effector = Tip(nodes[-1], origin, chain.station_frames[-1])

    @cached_property
    def bodies(self) -> Bodies:
        """Links between successive origins; those of joints in one place are joined as if they were one."""
        chain, count = self.chain, len(self.chain)
        apart = (chain.lengths[1:] > 0.0) | ~chain.revolute
        place = np.arange(count + 2)
        for node in range(count, 0, -1):
            place[node] = node if apart[node - 1] else place[node + 1]
        kept = np.flatnonzero(apart)
        points = np.stack([kept + 1, kept + 2], axis=1)
        names = [chain.names[j] for j in kept]
        return capsules(points, chain.radius, names, joints=place[points], kind="link")

    @cached_property
    def motion_pattern(self) -> MotionPattern:
        """d_rho - K d_a, dense in the actuators."""
        rows, count = 3 * len(self.free), len(self.actuators)
        grid = np.indices((rows, count)).reshape(2, -1)
        labels = tuple(
            Label(f"node: {self.node_names[n]} {axis}", "kinematics", "m")
            for n in self.free
            for axis in "xyz"
        )
        every = np.arange(rows)
        return MotionPattern(
            np.concatenate([every, grid[0]]), np.concatenate([every, rows + grid[1]]), labels
        )

    def nodes(self, q: Array) -> Array:
        """See ``arm.Arm``."""
        self._nodes.inputs[0][:] = q
        self._nodes()
        return self._nodes.outputs[0].reshape(-1, 3).copy()

    points = nodes

    def over_nodes(self, q: Array, points: Index, coefficients: Array) -> tuple[Index, Array]:  # noqa: ARG002
        """See ``arm.Arm``: the points are the nodes."""
        return points, coefficients

    def measured(self, q: Array) -> Array:
        """See ``arm.Arm``."""
        return np.array(q[:-6])

    def based(self, q: Array, pose: Pose) -> Array:
        """See ``arm.Arm``."""
        return np.concatenate([q[:-6], pose.position, vector_near(pose.rotation, q[-3:])])

    def carried(self, q: Array, before: Pose, after: Pose) -> Array:  # noqa: ARG002
        """See ``arm.Arm``: joints keep their values."""
        return self.based(q, after)

    def advanced(self, q: Array, nodes: Array, strokes: Array) -> Array:  # noqa: ARG002
        """See ``arm.Arm``."""
        q = q.copy()
        q[self.actuators] += strokes
        return q

    def corrected(self, q: Array, missing: Array, solve: Callable[[], Array]) -> Array:  # noqa: ARG002
        """See ``arm.Arm``."""
        return np.concatenate([q[:-6] + missing, q[-6:]])

    def travel(self, motion: Array) -> float:
        """See ``arm.Arm``."""
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
        """(J + 1,) reach beyond the base and beyond each joint, m."""
        return np.concatenate([[self.chain.reach[0] + self.chain.lengths[0]], self.chain.reach])

    def _motions(self, motion: Array) -> tuple[Array, Array]:
        """Return turns (J + 1,), rad, the base's first and counted twice, and slides (J + 1,), m."""
        joints, revolute = np.abs(motion[:-6]), self.chain.revolute
        base = 2.0 * float(np.linalg.norm(motion[-3:]))
        turn, slide = np.where(revolute, joints, 0.0), np.where(revolute, 0.0, joints)
        return np.concatenate([[base], turn]), np.concatenate([[0.0], slide])

    def reach(self) -> Array:
        """See ``arm.Arm``."""
        return np.full(int(self.base.sum()), self._reach[0])

    def hollow(self) -> float:
        """See ``arm.Arm``: the tip is the end of the last link."""
        return 0.0

    def unreachable(self) -> tuple[str, ...]:
        """See ``arm.Arm``."""
        return ()

    def describe(self) -> ChainDescription:
        """See ``arm.Arm``."""
        stations, hard = len(self.stations) - 1, "position" in self.stations.trackable
        return ChainDescription(
            len(self.chain), len(self.actuators), len(self.bodies), stations, self.height, hard
        )

    def kinematics(self, *, compiled: bool = True) -> ChainKinematics:
        """See ``arm.Arm``."""
        return ChainKinematics(self.chain, compiled=compiled)

    def symbols(self, constants: Constants) -> ChainSymbols:
        """See ``arm.Arm``."""
        return ChainSymbols(self.chain, constants)

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
            "joint_names": list(chain.names),
            "revolute": chain.revolute.tolist(),
            "axis": chain.axis.tolist(),
            "position": chain.position.tolist(),
            "rotation": chain.rotation.tolist(),
            "home": chain.home.tolist(),
            "stroke": [or_none(limits) for limits in chain.limits],
            "rate": or_none(chain.rate),
            "acceleration": or_none(chain.acceleration),
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
        names = {"joint_names": np.array(self.chain.names), "body_names": np.array(self.bodies.names)}
        return {"joints": quantities, **names}

    def motion_rows(self, *values: Array) -> ChainRows:
        """See ``arm.Arm``: K column by column, and r."""
        response, rhs = values
        return ChainRows(response.reshape(len(self.actuators), -1).T, rhs)
