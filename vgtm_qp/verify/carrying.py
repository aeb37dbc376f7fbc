"""A recorded arm with what it carries at its tip, for its clearances in one scene of a loop."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import ResultError
from vgtm_qp.result.record import Record
from vgtm_qp.verify.arm import AnyRecordedArm
from vgtm_qp.verify.distance import segment_ball
from vgtm_qp.verify.obstacles import Body, read_obstacles

_HELD = 1e-6
"""Distance by which a body may stick out of its capsules, over the arm's size."""
_GRID = 9
"""Points along an edge of a box, or round and along a cylinder, that must be in the capsules."""


class CarryingArm:
    """The bodies of an arm, then the capsules of what it carries; attributes as of ``RecordedArm``.

    ResultError if a record of what is carried is malformed.
    """

    def __init__(self, arm: AnyRecordedArm, carried: Sequence[Mapping[str, Any]]) -> None:
        tables = [Record(record, f"manifest.scenes.carried.{k}") for k, record in enumerate(carried)]
        self._bodies = [record["body"] for record in carried]
        ends = [table.numbers("ends", (None, 2, 3)) for table in tables]
        radius = [table.numbers("radius", (len(own),)) for table, own in zip(tables, ends, strict=True)]
        self._arm, self._count, self._local = arm, len(arm.member_names), np.concatenate(ends)
        if any((own <= 0.0).any() or not len(own) for own in radius):
            raise ResultError("manifest.scenes.carried: expected one capsule or more, with radii above 0")
        names = [str(body["name"]) for body in self._bodies]
        if known := set(names) & set(arm.member_names):
            raise ResultError(
                f"manifest.scenes.carried has the name of a {arm.body}: {', '.join(sorted(known))}"
            )
        first = np.cumsum([0, *(len(own) for own in radius)])
        self._own = [slice(start, stop) for start, stop in itertools.pairwise(first.tolist())]
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
        self.is_hull = np.concatenate([arm.is_hull, np.zeros(len(new), dtype=np.bool_)])
        self._way = (b"", b"")
        self._known: dict[float, Array] = {}
        """Ends at the shares of the last motion of :meth:`ends_between` that were evaluated so far."""

    def contradictions(self, meshes: Mapping[str, Any], directory: Path) -> tuple[list[str], list[str]]:
        """Return where capsules do not hold the body that they are for, and what could not be checked."""
        wrong, notes = [], []
        for table, own in zip(self._bodies, self._own, strict=True):
            found, complaints, _ = read_obstacles({"obstacle": [table]}, meshes, directory)
            notes += [f"carried {table['name']}: {complaint}" for complaint in complaints]
            for body in found:
                points = body.center + _surface(table, body) @ body.rotation.T
                outside = float(_outside(points, self._local[own], self.radius[self._count :][own]).max())
                if outside > _HELD * self.size:
                    wrong.append(f"carried {table['name']} sticks out of its capsules by {outside:.3g} m")
        return wrong, notes

    def states_ends(self, states: Array) -> Array:
        """Return (T, M, V, 3) the ends of all bodies, m, at states (T, ...)."""
        own, carried = self._arm.states_ends(states), self._placed(states)
        return np.concatenate([own, carried[:, :, np.arange(own.shape[2]) % 2]], axis=1)

    def ends_between(self, before: Array, after: Array, share: Array, body: Index) -> Array:
        """Return (P, V, 3) the ends, m, of bodies (P,) at shares (P,) of a straight motion between states."""
        own = body < self._count
        ends_of_own = self._arm.ends_between(before, after, share[own], body[own])
        if own.all():
            return ends_of_own
        found = np.empty((len(body), *ends_of_own.shape[1:]))
        found[own] = ends_of_own
        if self._way != (way := (before.tobytes(), after.tobytes())):
            self._way, self._known = way, {}
        at, which = np.unique(share[~own], return_inverse=True)
        if fresh := [one for one in at.tolist() if one not in self._known]:
            # The ends of the motion are exact.
            shares = np.reshape(fresh, (-1, *[1] * before.ndim))
            placed = self._placed((1.0 - shares) * before + shares * after)
            self._known |= dict(zip(fresh, placed, strict=True))
        ends = np.stack([self._known[one] for one in at.tolist()])
        found[~own] = ends[which, body[~own] - self._count][:, np.arange(found.shape[1]) % 2]
        return found

    def bend(self, before: Array, after: Array, body: Index) -> Array:
        """Return (P,) an upper bound, m, of |d2 r / d share2| of the ends of bodies (P,)."""
        found, own = np.empty(len(body)), body < self._count
        found[own] = self._arm.bend(before, after, body[own])
        reach = np.linalg.norm(self._local, axis=2).max(axis=1)[body[~own] - self._count]
        found[~own] = self._arm.tip_bend(before, after, reach)
        return found

    def _placed(self, states: Array) -> Array:
        """Return (T, C, 2, 3) the ends of the capsules, m, at states (T, ...)."""
        position, rotation = self._arm.tip_poses(states)
        return np.asarray(position[:, None, None] + np.einsum("tij,cej->tcei", rotation, self._local))


def _surface(table: Mapping[str, Any], body: Body) -> Array:
    """Return points (K, 3) of the surface of a body about its origin, along its own axes, m: of a mesh all corners."""
    shape, share = table["shape"], np.linspace(-1.0, 1.0, _GRID)
    if shape == "mesh":
        return body.shape.corners.reshape(-1, 3)
    if shape == "box":
        grid = np.stack(np.meshgrid(share, share, share), axis=-1).reshape(-1, 3)
        half: Array = np.broadcast_to(np.asarray(table["size"], dtype=float), 3) / 2.0
        return np.asarray(grid[np.abs(grid).max(axis=1) == 1.0] * half)
    angle, height = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 8 * _GRID), share)
    round_it = float(table["radius"]) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    if shape == "cylinder":
        along = height[..., None] * float(table["height"]) / 2.0
    else:
        round_it, along = (
            np.sqrt(1.0 - height**2)[..., None] * round_it,
            height[..., None] * float(table["radius"]),
        )
    return np.concatenate([round_it, along], axis=-1).reshape(-1, 3)


def _outside(points: Array, ends: Array, radius: Array) -> Array:
    """Return how far points (K, 3) are outside the union of capsules (C, 2, 3), m; negative inside."""
    each = [
        segment_ball(start - points, end - points, 0.0)[0] - thick
        for (start, end), thick in zip(ends, radius, strict=True)
    ]
    return np.asarray(np.min(each, axis=0))
