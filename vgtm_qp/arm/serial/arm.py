"""A serial arm: joints one after another, from the ``[arm]`` table of a problem."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vgtm_qp.arm.arm import Stations, Tip, has_full_rank
from vgtm_qp.arm.frames import frames_along
from vgtm_qp.arm.joint_space import JointSpaceArm
from vgtm_qp.arm.serial.chain import SerialChain
from vgtm_qp.arrays import Array
from vgtm_qp.geometry.bodies import Bodies, capsules
from vgtm_qp.problem.arm import ArmTable


class SerialArm(JointSpaceArm):
    """See ``arm.Arm``; joints of an ``[arm]`` table, of which those locked from the start stay at home.

    Its nodes are those of ``SerialChain.functions``.
    """

    kind = "serial"

    def __init__(self, spec: ArmTable) -> None:
        joints, stuck = spec.joint, {lock.joint for lock in spec.locked if lock.time == 0.0}
        self.segments, self.quantity_names = len(joints), tuple(joint.name for joint in joints)
        self.home_quantities = np.array([joint.home for joint in joints], dtype=float)
        self.home_configuration = np.concatenate([self.home_quantities, np.zeros(6)])
        self.actuated = np.array([joint.name not in stuck for joint in joints])
        self.stroke = np.array([joint.limits or (-np.inf, np.inf) for joint in joints], dtype=float)
        self.rate = _or_infinite([joint.rate for joint in joints])
        self.acceleration = _or_infinite([joint.acceleration for joint in joints])
        chain = SerialChain.of(spec)
        self.chain = chain if spec.every else replace(chain, every=self._every(chain))
        self.functions, self.constants = self.chain.functions, self.chain.constants
        self.revolute, self.reaches = chain.revolute, self._reaches()
        self.actuator_units = tuple("rad" if turns else "m" for turns in self.revolute[self.actuated])
        self._place_stations()
        self.bodies = self._links(spec.link_radius)

    def _every(self, chain: SerialChain) -> int:
        """Return the least spacing of stations, in joints, with which all can stay on the curve at once at home.

        If there is none, as at the straight home of a snake, there is a station for every three actuators.
        """
        joints, (_, jacobian) = len(chain), chain.at(self.home_configuration)
        for every in range(1, joints + 1):
            if self._can_hold(jacobian[[*range(1 + every, joints + 1, every), joints + 1]]):
                return every
        return -(-joints // max(1, len(self.actuators) // 3))

    def _can_hold(self, jacobian: Array) -> bool:
        """Whether nodes with a Jacobian (K, 3, J) can be held in place independently."""
        return has_full_rank(jacobian[:, :, self.actuators].reshape(3 * len(jacobian), len(self.actuators)))

    def _place_stations(self) -> None:
        """Find nodes and stations at home; the stations' z-axes lie along the arm."""
        count, tracked = len(self.chain), self.chain.tracked
        words = ["base", *(self.quantity_names[j] for j in tracked), "tip"]
        beside = tuple(f"{word} {axis}" for word in words for axis in "xy")
        self.node_names = ("base", *self.quantity_names, "tip", *beside)
        self.home, jacobian = self.chain.at(self.home_configuration)
        self.height = float(np.linalg.norm(np.diff(self.home[: count + 2], axis=0), axis=1).sum())
        self.unit = self.chain.mean_length
        origins = np.array([0, *(1 + j for j in tracked), count + 1])
        first = count + 2 + 2 * np.arange(len(origins))
        nodes = np.column_stack([origins, first, first + 1])
        self.base = np.isin(np.arange(len(self.home)), [0, 1, *nodes[0]])
        self.free = np.flatnonzero(~self.base)
        weights = np.tile([1.0, 0.0, 0.0], (len(nodes), 1))
        frames = frames_along(self.home[origins])
        trackable = ("position",) if self._can_hold(jacobian[origins[1:]]) else ()
        self.stations = Stations(nodes, weights, frames, trackable, word="joint")
        self.end_effector = Tip(nodes[-1], weights[-1], frames[-1])

    def _reaches(self) -> Array:
        """Return (J + 1,) the :attr:`reaches`: all slides fully extended, all links in one line."""
        chain = self.chain
        slide = np.where(chain.revolute, 0.0, np.abs(self.stroke).max(axis=1, initial=0.0))
        beyond = np.cumsum((chain.lengths[1:] + slide)[::-1])[::-1] + np.sqrt(2.0) * chain.spread
        return np.concatenate([[beyond[0] + chain.lengths[0]], beyond])

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

    def record(self) -> dict[str, Any]:
        """See ``arm.Arm``.

        Keys: ``kind``, ``joint_names``, ``revolute``, ``axis``, ``position``, ``rotation`` (in the frame of the one
        before), ``home``, ``tip`` in the last frame and ``tip_frame`` at home; of the bodies ``body_names``, ``links``
        (their points: base, joints, tip) and ``joined`` (their ends; bodies with one in common are neighbours).
        """
        chain, bodies = self.chain, self.bodies
        geometry = {key: getattr(chain, key) for key in ("revolute", "axis", "position", "rotation", "tip")}
        arrays = {
            "home": self.home_quantities,
            "tip_frame": self.end_effector.frame,
            "links": bodies.points,
            "joined": bodies.joints,
            **geometry,
        }
        names = {"joint_names": list(self.quantity_names), "body_names": list(bodies.names)}
        lists = {key: array.tolist() for key, array in arrays.items()}
        return {**super().record(), "kind": self.kind, **names, **lists}


def _or_infinite(limits: Sequence[float | None]) -> Array:
    return np.array([np.inf if limit is None else limit for limit in limits])
