"""A recorded arm with what it carries at its tip, for its clearances in one scene of a loop."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.result.record import Record
from vgtm_qp.verify.arm import Arm


class CarryingArm:
    """The bodies of an arm, then the capsules of what it carries; attributes as of ``RecordedArm``.

    ResultError if a record of what is carried is malformed.
    """

    def __init__(self, arm: Arm, carried: Sequence[Mapping[str, Any]]) -> None:
        tables = [Record(record, f"manifest.scenes.carried.{k}") for k, record in enumerate(carried)]
        ends = [table.numbers("ends", (None, 2, 3)) for table in tables]
        radius = [table.numbers("radius", (len(own),)) for table, own in zip(tables, ends, strict=True)]
        self._arm, self._count, self._local = arm, len(arm.member_names), np.concatenate(ends)
        names = [str(record["body"]["name"]) for record in carried]
        self.member_names = (
            *arm.member_names,
            *(name for name, own in zip(names, radius, strict=True) for _ in own),
        )
        new = np.arange(len(self._local))
        self.radius = np.concatenate([arm.radius, *radius])
        self.length = np.concatenate([arm.length, np.linalg.norm(np.diff(self._local, axis=1)[:, 0], axis=1)])
        own_joints = int(arm.members.max(initial=-1)) + 1 + np.arange(2 * len(new)).reshape(-1, 2)
        self.members = np.concatenate([arm.members, own_joints])
        # What is carried may touch the bodies that end at the tip, and one part of it another.
        at_tip = np.flatnonzero(np.isin(arm.members, arm.tip_joints).any(axis=1))
        first, second = np.meshgrid(np.concatenate([at_tip, self._count + new]), self._count + new)
        pairs = np.stack([first, second], axis=-1)[first < second]
        self.touching = np.concatenate([arm.touching, pairs])
        self.size, self.stretches = arm.size, arm.stretches

    def states_ends(self, states: Array) -> Array:
        """Return (T, M, 2, 3) the ends of all bodies, m, at states (T, ...)."""
        return np.concatenate([self._arm.states_ends(states), self._placed(states)], axis=1)

    def ends_between(self, before: Array, after: Array, share: Array, body: Index) -> Array:
        """Return (P, 2, 3) the ends, m, of bodies (P,) at shares (P,) of a straight motion between states."""
        found, own = np.empty((len(body), 2, 3)), body < self._count
        found[own] = self._arm.ends_between(before, after, share[own], body[own])
        if not own.all():
            at, which = np.unique(share[~own], return_inverse=True)
            # The ends of the motion are exact.
            share_of = at.reshape(-1, *[1] * before.ndim)
            placed = self._placed((1.0 - share_of) * before + share_of * after)
            found[~own] = placed[which, body[~own] - self._count]
        return found

    def bend(self, before: Array, after: Array, body: Index) -> Array:
        """Return (P,) an upper bound, m, of |d2 r / d share2| of the ends of bodies (P,)."""
        found, own = np.empty(len(body)), body < self._count
        found[own] = self._arm.bend(before, after, body[own])
        reach = np.linalg.norm(self._local, axis=2).max(axis=1)[body[~own] - self._count]
        found[~own] = self._arm.tip_bend(before, after, reach)
        return found

    def ends(self, points: Array) -> Array:
        """Return the ends of the arm's own bodies for its points."""
        return self._arm.ends(points)

    @property
    def home(self) -> Array:
        """The arm's points at home, m."""
        return self._arm.home

    def _placed(self, states: Array) -> Array:
        """Return (T, C, 2, 3) the ends of the capsules, m, at states (T, ...)."""
        position, rotation = self._arm.tip_position(states), self._arm.tip_rotations(states)
        return np.asarray(position[:, None, None] + np.einsum("tij,cej->tcei", rotation, self._local))
