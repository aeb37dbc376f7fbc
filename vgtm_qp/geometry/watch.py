"""All pairs of a scene at rest, evaluated only when they may have come near.

Each pair keeps a lower bound of its distance: its distance at the last evaluation, less a bound of the approach of its
bodies since. If the bound falls below the limit, one compiled call evaluates the pair and bounds its distance on the
way from the state before. Far pairs are evaluated seldom, near ones in every state; a dozen array operations cover all.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.compiled import Kernel
from vgtm_qp.geometry.candidates import every_pair
from vgtm_qp.geometry.exact import CONTACT, NORMAL, WIDTH, follow_function
from vgtm_qp.geometry.formulas import FURTHEST
from vgtm_qp.geometry.groups import Found, Group, Scene
from vgtm_qp.geometry.pairs import Contacts
from vgtm_qp.geometry.shapes import GeometryError

_MOST_PAIRS = 8000
"""Greatest number of pairs of a scene that can be watched."""

_AHEAD = 1.2
"""Ratio of the distance below which pairs are evaluated to the last limit: the next limit may be larger."""

_NEXT = 2.0
"""If no pair is near, ratio to the limit below which pairs are evaluated all the same, in one call."""


def can_be_watched(scene: Scene) -> bool:
    """Return whether only the arm moves, there are no meshes, and there are not too many pairs."""
    bodies, pieces = len(scene.bodies), scene.pieces
    simple = not pieces.moving and "triangle" not in pieces.shape
    count = bodies * len(pieces) + (bodies * (bodies - 1) // 2 if scene.has_self else 0)
    return simple and bodies > 1 and 0 < count <= _MOST_PAIRS


class _WatchedGroup:
    """The pairs of one shape, with bounds and contacts of the last evaluation."""

    def __init__(self, group: Group, points: int, lower: Array) -> None:
        count = len(group)
        self.group, self._lower = group, lower
        piece = np.zeros((count, WIDTH)) if group.is_self else group.scene.pieces.parameters[group.other]
        normal = np.tile([0.0, 0.0, 1.0], (count, 1))
        self._known = np.concatenate([piece, group.radius[:, None], normal], axis=1)
        self._places = np.concatenate([group.points, group.points + points], axis=1)
        self._follow = group.scene.batch(follow_function, group.shape)
        self._near = np.zeros(0, dtype=np.int64)
        """Pairs that were evaluated in the present state,"""
        self.contacts = np.zeros((0, CONTACT))
        """and their contacts, two for each."""
        self._is_close = False
        """Whether one of them was nearer than the limit,"""
        self.overlaps = False
        """and whether surfaces of one overlap."""
        self.lowest = np.inf
        """Least lower bound of their distances on the way there, m."""

    def evaluate(self, places: Array, limit: float) -> None:
        """Evaluate the pairs that may be nearer than `limit`, m, in the present state, and overwrite their bounds.

        `places` (2 P, 3) are the positions of the points in the state before and in the present one, m.
        """
        reach = limit if self._is_close else max(limit, _NEXT * limit)
        # A negated comparison is true for NaN.
        self._near = near = (~(self._lower >= reach)).nonzero()[0]
        size, lowest = len(near), self._lower.take(near)
        ends = places.take(self._places.take(near, axis=0), axis=0).reshape(size, 24)
        found = self._follow(ends, self._known.take(near, axis=0))
        least = float(found[:, 0].min())
        self._is_close, self.overlaps = least < limit, not least > 0.0
        self.contacts = found[:, :-1].reshape(2 * size, CONTACT)
        self._known[near, WIDTH + 1 :] = found[:, NORMAL]
        self._lower[near] = found[:, 0]
        # The bound from the motion alone holds as well.
        self.lowest = float(np.maximum(found[:, -1], lowest).min())

    def skip(self) -> None:
        """Record that no pair can be near in the present state."""
        self._near, self.contacts = self._near[:0], self.contacts[:0]
        self._is_close, self.overlaps, self.lowest = False, False, np.inf

    def near(self, X: Array, limit: float, by_fcl: bool) -> Found:
        """Return the contacts nearer than `limit`, m, in the present state `X`."""
        rows = (self.contacts[:, 0] < limit).nonzero()[0]
        found, pairs = self.contacts.take(rows, axis=0), self._near.take(rows >> 1)
        return self.group.contacts(X, 0.0, pairs, found, by_fcl)


class Watch:
    """Keeps all pairs of a scene that :func:`can_be_watched`; one thread at a time."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._groups: list[_WatchedGroup] = []
        self._bounds: Kernel | None = None
        self._at, self._places = b"", np.zeros((0, 3))
        self._limits = self._wanted = (-np.inf, -np.inf)

    def near(self, X: Array, limit: float, self_limit: float, *, by_fcl: bool = False) -> Contacts | None:
        """Return all contacts nearer than `limit`, or `self_limit` between bodies, m; None where surfaces overlap.

        `X` (P, 3) are positions of the points; `by_fcl` says whether FCL supplies the contacts.
        """
        if limit > self._limits[0] or self_limit > self._limits[1] or not self._is_at(X):
            self._move_to(X, (limit, self_limit))
        self._wanted = _AHEAD * limit, _AHEAD * self_limit
        limits, near = (limit, self_limit), [pairs for pairs in self._groups if len(pairs.contacts)]
        if any(pairs.overlaps for pairs in near):
            return None
        return self._scene.contacts([pairs.near(X, limits[pairs.group.is_self], by_fcl) for pairs in near])

    def follow(self, start: Array, end: Array, floor: float, self_floor: float) -> bool:
        """Return whether no surface distance falls below its floor, m, while points move straight to `end`.

        False may also mean that this was not proven. `start` and `end` are positions of the points (P, 3), m.
        """
        limits = max(self._wanted[0], floor), max(self._wanted[1], self_floor)
        if not self._is_at(start):
            self._move_to(start, limits)
        self._move_to(end, limits)
        return all(pairs.lowest >= (self_floor if pairs.group.is_self else floor) for pairs in self._groups)

    def _is_at(self, X: Array) -> bool:
        """Return whether `X` (P, 3) are the positions of the present state."""
        return X.tobytes() == self._at

    def _move_to(self, X: Array, limits: tuple[float, float]) -> None:
        """Make `X` the present state, and evaluate the pairs that may be nearer than the limits, m, there.

        Raises
        ------
        GeometryError
            A position is not finite; nothing has changed.
        """
        bounds = self._bounds if self._bounds is not None else self._start(X)
        lower, lowest = bounds.outputs
        self._places[len(X) :] = X
        bounds()
        *least, motion = lowest.tolist()
        if not motion < FURTHEST:
            raise GeometryError("node positions must be finite numbers")
        for pairs, bound in zip(self._groups, least, strict=True):
            limit = limits[pairs.group.is_self]
            if bound >= limit:
                pairs.skip()
            else:
                pairs.evaluate(self._places, limit)
        self._places[: len(X)] = X
        bounds.inputs[2][:] = lower
        self._at, self._limits = X.tobytes(), limits

    def _start(self, X: Array) -> Kernel:
        """List all pairs, with their distances at `X`."""
        groups = every_pair(self._scene, X)
        kernel = Kernel(_bound_function(self._scene.bodies.points, groups, len(X)), compiled=False)
        self._places = np.concatenate([X, X])
        kernel.bind_input(0, self._places[len(X) :])
        kernel.bind_input(1, self._places[: len(X)])
        kernel.inputs[2][:] = np.concatenate([np.zeros(0), *(group.distance for group in groups)])
        parts = np.split(kernel.outputs[0], np.cumsum([len(group) for group in groups])[:-1])
        self._groups = [
            _WatchedGroup(group, len(X), lower) for group, lower in zip(groups, parts, strict=False)
        ]
        self._bounds = kernel
        return kernel


def _bound_function(points: Index, groups: list[Group], count: int) -> ca.Function:
    """Return the function that bounds the distances of all pairs after a motion.

    Arguments: positions of the P points after and before it (3, P); bounds before it (C), m. Results: bounds after
    it (C); the least one of each shape, and the sum of the squares of the displacements.

    A distance from an obstacle changes by no more than an end of the body moves. That of two bodies changes by no
    more than an end of one moves relative to an end of the other: no more than their middles do, and both turn about
    those. It is a dozen operations on whole arrays, which the virtual machine does as fast as machine code.
    """
    X, before = ca.MX.sym("X", 3, count), ca.MX.sym("before", 3, count)
    ends = np.cumsum([0, *map(len, groups)]).tolist()
    lower = ca.MX.sym("lower", ends[-1])
    moved = X - before
    first, second = (moved[:, points[:, end].tolist()] for end in (0, 1))
    middle, turned = (first + second) / 2, _norms(second - first) / 2
    furthest = ca.fmax(_norms(first), _norms(second))
    nearer = []
    for group in groups:
        a, b = group.body.tolist(), group.other.tolist()
        nearer.append(
            _norms(middle[:, a] - middle[:, b]) + turned[a] + turned[b] if group.is_self else furthest[a]
        )
    after = lower - ca.vertcat(*nearer) if groups else lower
    parts = ca.vertsplit(after, ends) if groups else []
    # `mmin` skips NaN; the sum keeps it.
    least = ca.vertcat(*map(ca.mmin, parts), ca.sumsqr(moved))
    return ca.Function("bounds", [X, before, lower], [after, least])


def _norms(vectors: ca.MX) -> ca.MX:
    """Return the norms (K, 1) of columns (3, K)."""
    return ca.sqrt(ca.sum1(vectors**2)).T
