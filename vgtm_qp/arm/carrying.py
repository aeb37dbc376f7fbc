"""Bodies that an arm carries at its tip, and an arm with them: what clearances are kept of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vgtm_qp.arm.arm import Approach, Arm, between, tip_frame_function
from vgtm_qp.arrays import Array, Index
from vgtm_qp.geometry.bodies import lengthened
from vgtm_qp.geometry.shapes import Obstacle
from vgtm_qp.problem.enclosing import box_capsules, capsule_along, enclosing_capsule
from vgtm_qp.rotation import rotation_from_vector


@dataclass(frozen=True, eq=False)
class Carried:
    """A body fixed to the end effector, enclosed by C capsules.

    Attributes
    ----------
    obstacle : Obstacle
        The body as an obstacle, its pose in the frame of the end effector.
    ends, radius : (C, 2, 3), (C,)
        Axes of the capsules in that frame, and radii, m.
    """

    obstacle: Obstacle
    ends: Array
    radius: Array

    @property
    def name(self) -> str:
        """Its name in messages and results."""
        return self.obstacle.name

    def record(self) -> dict[str, Any]:
        """Return the body as JSON data for verification and pictures."""
        table = self.obstacle.table.model_dump(mode="json", exclude_none=True)
        return {"body": table, "ends": self.ends.tolist(), "radius": self.radius.tolist()}


def carried(obstacle: Obstacle) -> Carried:
    """Return an obstacle as a body that is carried, in the frame of the end effector instead of the base's."""
    table, centre = obstacle.table, np.zeros(3)
    if table.shape == "mesh":
        corners = obstacle.pieces[:, :9].reshape(-1, 3)
        found = [enclosing_capsule(np.unique(corners, axis=0))]
    else:
        if table.shape == "box":
            own = box_capsules(np.broadcast_to(np.asarray(table.size, dtype=float), 3))
        elif table.shape == "sphere":
            own = [(np.zeros((1, 3)), table.radius)]
        else:
            half = np.array([-0.5, 0.5]) * table.height
            own = [capsule_along(centre, np.array([0.0, 0.0, 1.0]), half, np.full(2, table.radius))]
        turn = rotation_from_vector(table.rotation_vector).T
        found = [(ends @ turn + table.center, radius) for ends, radius in own]
    radius = np.array([radius for _, radius in found])
    ends = np.stack([ends[[0, -1]] for ends, _ in found])
    return Carried(obstacle, lengthened(ends, radius), radius)


class Carrier:
    """An arm with the bodies that it carries; without any it is the arm itself.

    Attributes
    ----------
    arm : Arm
    carried : tuple of Carried
    bodies : Bodies
        Those of the arm, then the capsules of what it carries. The latter may touch the bodies that end at the tip.
    """

    def __init__(self, arm: Arm) -> None:
        self.arm, self._frame = arm, _TipFrame(arm) if arm.end_effector.has_frame else None
        self.carry(())

    def carry(self, carried: Sequence[Carried]) -> None:
        """Carry these bodies from now on, and no others; the end effector needs a frame if there are any."""
        self.carried, own = tuple(carried), self.arm.bodies
        if not carried:
            self.bodies, self._local = own, np.zeros((0, 3))
            return
        self._local = np.concatenate([body.ends for body in carried]).reshape(-1, 3)
        count, self._first = len(self._local) // 2, len(self.arm.points(self.arm.home_configuration))
        pairs = np.arange(2 * count).reshape(-1, 2)
        at_tip = np.flatnonzero(np.isin(own.joints, self.arm.end_effector.nodes).any(axis=1))
        new = len(own) + np.arange(count)
        with_tip = np.stack(np.meshgrid(at_tip, new), axis=-1).reshape(-1, 2)
        among = new[np.stack(np.triu_indices(count, 1), axis=1)]
        names = [body.name for body in carried for _ in body.radius]
        radius = np.concatenate([body.radius for body in carried])
        joints = int(own.joints.max(initial=-1)) + 1 + pairs
        both = own.joined(self._first + pairs, radius, joints, names)
        self.bodies = replace(both, touching=np.concatenate([own.touching, with_tip, among]))

    @property
    def leaves_chords(self) -> bool:
        """See ``Arm.leaves_chords``: what is carried turns with the tip."""
        return self.arm.leaves_chords or bool(self.carried)

    def points(self, q: Array) -> Array:
        """Return (P, 3) the points that span the bodies, m."""
        points = self.arm.points(q)
        if not self.carried:
            return points
        centre, rotation, _ = self._tip(q)
        return np.concatenate([points, centre + self._local @ rotation.T])

    def ways(self, start: Array, end: Array, pieces: int) -> Array:
        """Return (K + 1, P, 3) the points, m, at the ends of K equal `pieces` of a straight motion of q."""
        if not self.carried:
            return self.arm.ways(start, end, pieces)
        return np.stack([self.points(q) for q in between(start, end, pieces)])

    def over_nodes(self, q: Array, points: Index, coefficients: Array) -> tuple[Index, Array]:
        """See ``Arm.over_nodes``: the nodes of the tip move what is carried, as a force on it would move them."""
        is_carried = points >= self._first if self.carried else np.zeros(points.shape, dtype=bool)
        if not is_carried.any():
            return self.arm.over_nodes(q, points, coefficients)
        tip = self.arm.end_effector
        _, rotation, spin = self._tip(q)
        arms = self._local[np.where(is_carried, points - self._first, 0)] @ rotation.T
        forces = np.where(is_carried[..., None], coefficients, 0.0)
        force, moment = forces.sum(axis=1), np.cross(arms, forces).sum(axis=1)
        by_tip = tip.weights[:, None] * force[:, None] + (moment @ spin).reshape(len(points), -1, 3)
        own, by_own = self.arm.over_nodes(q, np.where(is_carried, 0, points), coefficients - forces)
        nodes = np.broadcast_to(tip.nodes, (len(points), len(tip.nodes)))
        return np.concatenate([own, nodes], axis=1), np.concatenate([by_own, by_tip], axis=1)

    def deviation(self, start: Array, end: Array) -> float:
        """See ``Arm.deviation``."""
        own = self.arm.deviation(start, end) if self.arm.leaves_chords else 0.0
        if not self.carried:
            return own
        reach = float(np.linalg.norm(self._local, axis=1).max())
        return max(own, 2.0 * self.arm.tip_deviation(start, end, reach))

    def approach(self, motion: Array) -> Approach | None:
        """See ``Arm.approach``; unknown for what is carried."""
        own, count = self.arm.approach(motion), len(self.arm.bodies)
        if own is None or not self.carried:
            return own

        def bound(body: Index, other: Index | None = None) -> Array:
            known = body < count if other is None else (body < count) & (other < count)
            found = np.full(len(body), np.nan)
            found[known] = own(body[known], None if other is None else other[known])
            return found

        return bound

    def _tip(self, q: Array) -> tuple[Array, Array, Array]:
        """Return position (3,), m, rotation (3, 3) and spin (3, 3K) of the end effector."""
        assert self._frame is not None
        return self._frame.at(self.arm.nodes(q))


class _TipFrame:
    """The end effector's frame, by its nodes alone."""

    def __init__(self, arm: Arm) -> None:
        self._tip, self._kernel = arm.end_effector, tip_frame_function(arm).kernel(compiled=False)

    def at(self, X: Array) -> tuple[Array, Array, Array]:
        """Return position (3,), m, rotation (3, 3) and spin (3, 3K) for nodes at `X` (N, 3), m."""
        self._kernel.inputs[0][:] = X[self._tip.nodes].reshape(-1)
        self._kernel()
        rotation, spin = self._kernel.outputs
        return self._tip.position(X), rotation.reshape(3, 3).T.copy(), spin.reshape(-1, 3).T.copy()
