"""All pairs of a scene at rest, evaluated only when they may have come near.

Each pair keeps a lower bound of its distance: the distance when it was evaluated last, less the most that its bodies
can have come nearer to each other since. Where the bound falls below the distance that matters, one compiled call
evaluates the pair and bounds its distance on the way from the state before. Far pairs are evaluated seldom, near ones
in every state, and all of them are covered in a dozen array operations.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.compiled import Kernel
from vgtm_qp.geometry.bodies import Bodies
from vgtm_qp.geometry.exact import CONTACT, WIDTH
from vgtm_qp.geometry.fcl_queries import FclQueries
from vgtm_qp.geometry.formulas import FAR, FURTHEST
from vgtm_qp.geometry.groups import FOLLOWED, Group
from vgtm_qp.geometry.pairs import Contacts, PairNames, join, no_contacts
from vgtm_qp.geometry.shapes import GeometryError, Pieces

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_AT_ONCE = FOLLOWED[-1]

_AHEAD = 1.2
"""Pairs are evaluated from so many times the distance on that mattered last: it may be larger in the next state."""

_NEXT = 2.0
"""Where no pair is near, those below so many times the distance that matters are evaluated too: all in one call."""


class _WatchedGroup:
    """The pairs of one shape, and what is known of them."""

    def __init__(self, group: Group, parameters: Array) -> None:
        count = len(group)
        self.group, self.is_self = group, group.is_self
        self.flags = np.full(2 * count, group.is_self)
        self.zeros = np.zeros(2 * count)
        self.asks_fcl = group.shape in FclQueries.SHAPES
        self.points = np.concatenate([group.points, group.other_points], axis=1)
        self.numbers = np.column_stack([self.points, group.body, group.other])
        piece = np.zeros((count, WIDTH)) if group.is_self else parameters[group.other]
        normal = np.tile([0.0, 0.0, 1.0], (count, 1))
        self.known = np.concatenate([piece, group.radius[:, None], normal], axis=1)
        self._contacts = group.follow
        self.near = np.zeros(0, dtype=np.int64)
        """Pairs that were evaluated in the present state,"""
        self.contacts = np.zeros((0, CONTACT))
        """and their contacts, two for each."""
        self.is_close = False
        """Whether one of them was as near as to matter."""
        self.lowest = np.inf
        """Least lower bound of their distances on the way there, m."""

    def evaluate(self, places: Array, lower: Array, limit: float) -> None:
        """Evaluate the pairs that may be nearer than `limit`, m, in the present state.

        Parameters
        ----------
        places : (P, 6)
            Positions of the points in the state before and in the present one, m.
        lower : (C,)
            Bounds of the distances, m; those of the pairs that are evaluated are overwritten.
        """
        reach = limit if self.is_close else max(limit, _NEXT * limit)
        # A negated comparison is true for NaN.
        self.near = near = (~(lower >= reach)).nonzero()[0]
        size, lowest = len(near), lower.take(near)
        arguments = (
            places.take(self.points.take(near, axis=0), axis=0).reshape(size, 24),
            self.known.take(near, axis=0),
        )
        if size <= _AT_ONCE:
            found = self._contacts(*arguments)
        else:
            parts = [slice(k, k + _AT_ONCE) for k in range(0, size, _AT_ONCE)]
            found = np.concatenate([self._contacts(*(a[part] for a in arguments)) for part in parts])
        self.is_close = bool(found[:, 0].min() < limit)
        self.contacts = found.reshape(2 * size, CONTACT)
        self.known[near, WIDTH + 1 :] = found[:, 5:8]
        lower[near] = found[:, 0]
        # The bound from the motion alone holds as well.
        self.lowest = float(np.maximum(found[:, CONTACT - 1], lowest).min())

    def skip(self) -> None:
        """Record that no pair can be near in the present state."""
        self.near, self.is_close, self.lowest = self.near[:0], False, np.inf


class Watch:
    """Keeps all pairs of a scene at rest that has few of them; one thread at a time.

    Parameters
    ----------
    bodies, pieces, names, fcl
        Of the scene.
    every_pair : callable
        From positions of the points (P, 3), m, to groups of all pairs with their distances there.
    """

    def __init__(
        self,
        bodies: Bodies,
        pieces: Pieces,
        names: PairNames,
        fcl: FclQueries,
        every_pair: Callable[[Array], list[Group]],
    ) -> None:
        self._bodies, self._pieces, self._fcl, self._every_pair = bodies, pieces, fcl, every_pair
        self._none = no_contacts(names)
        self._groups: list[_WatchedGroup] = []
        self._parts: list[slice] = []
        self._bounds: Kernel | None = None
        self._at, self._known_at, self._places = np.zeros((0, 3)), b"", np.zeros((0, 6))
        self._limits = self._wanted = (-np.inf, -np.inf)

    def near(self, X: Array, limit: float, self_limit: float, fcl_reach: float) -> Contacts | None:
        """Return all contacts nearer than `limit`, or `self_limit` between bodies, m; None where surfaces overlap.

        Parameters
        ----------
        X : (P, 3)
            Positions of the points, m.
        fcl_reach : float
            Surface distance below which FCL is asked about obstacles too, m.
        """
        if limit > self._limits[0] or self_limit > self._limits[1] or not self._is_at(X):
            self._move_to(X, limit, self_limit)
        self._wanted = _AHEAD * limit, _AHEAD * self_limit
        parts = []
        for pairs in self._groups:
            if len(pairs.near):
                rows = (pairs.contacts[:, 0] < (self_limit if pairs.is_self else limit)).nonzero()[0]
                if len(rows):
                    parts.append(self._contacts(pairs, rows, fcl_reach))
        if not parts:
            return self._none
        found = join(parts, self._none)
        return found if found.distance.min(initial=np.inf) > 0.0 else None

    def follow(self, start: Array, end: Array, floor: float, self_floor: float) -> bool:
        """Return whether no surface distance falls below its floor, m, while points move straight to `end`.

        False may also mean that this was not proven. `start` and `end` are positions of the points (P, 3), m.
        """
        limits = max(self._wanted[0], floor), max(self._wanted[1], self_floor)
        if not self._is_at(start):
            self._move_to(start, *limits)
        self._move_to(end, *limits)
        floors = {False: floor, True: self_floor}
        return all(pairs.lowest >= floors[pairs.is_self] for pairs in self._groups)

    def _is_at(self, X: Array) -> bool:
        """Return whether `X` (P, 3) are the positions of the present state."""
        return X.tobytes() == self._known_at

    def _move_to(self, X: Array, limit: float, self_limit: float) -> None:
        """Make `X` the present state, and evaluate the pairs that may be nearer than the limits, m, there.

        Raises
        ------
        GeometryError
            A position is not finite; nothing has changed.
        """
        bounds = self._bounds if self._bounds is not None else self._start(X)
        inputs, (lower, lowest) = bounds.inputs, bounds.outputs
        inputs[0][:] = X.reshape(-1)
        self._places[:, :3] = self._at
        self._places[:, 3:] = X
        bounds()
        *least, motion = lowest.tolist()
        if not motion < FURTHEST:
            raise GeometryError("node positions must be finite numbers")
        for k, pairs in enumerate(self._groups):
            nearer_than = self_limit if pairs.is_self else limit
            if least[k] >= nearer_than:
                pairs.skip()
            else:
                pairs.evaluate(self._places, lower[self._parts[k]], nearer_than)
        inputs[1][:] = inputs[0]
        inputs[2][:] = lower
        self._known_at, self._limits = X.tobytes(), (limit, self_limit)

    def _start(self, X: Array) -> Kernel:
        """List all pairs, with their distances at `X`."""
        if not np.isfinite(X).all():
            raise GeometryError("node positions must be finite numbers")
        groups = self._every_pair(X)
        self._groups = [_WatchedGroup(group, self._pieces.parameters) for group in groups]
        ends = np.cumsum([0, *map(len, groups)])
        self._parts = [slice(a, b) for a, b in pairwise(ends.tolist())]
        self._bounds = kernel = Kernel(
            _bound_function(self._bodies.points, self._groups, len(X)), compiled=False
        )
        kernel.inputs[1][:] = X.reshape(-1)
        for group, part in zip(groups, self._parts, strict=True):
            kernel.inputs[2][part] = group.distance
        # The positions before the motion are those of the present state once its pairs are evaluated.
        self._at, self._places = kernel.inputs[1].reshape(-1, 3), np.zeros((len(X), 6))
        return kernel

    def _contacts(self, pairs: _WatchedGroup, rows: Index, fcl_reach: float) -> Contacts:
        """Return the contacts `rows` (R,) of a group."""
        found, pair = pairs.contacts.take(rows, axis=0), pairs.near.take(rows >> 1)
        count, group = len(rows), pairs.group
        distance, normal, weights = found[:, 0], found[:, 5:8], found[:, 1:5]
        if pairs.asks_fcl:
            for k in (distance < fcl_reach).nonzero()[0].tolist():
                # Where the nearest point is not unique, FCL may give one between the two ends of the contact.
                if rows[k] % 2 == 0 and pairs.contacts[rows[k] + 1, 0] >= FAR:
                    this = int(pair[k])
                    ends = self._at[group.points[this]].reshape(-1).tolist()
                    apart = float(distance[k] + group.radius[this])
                    answer = self._fcl.witness(int(group.other[this]), ends, apart)
                    if answer is not None:
                        t, normal[k] = answer
                        weights[k, :2] = 1.0 - t, t
        numbers = pairs.numbers.take(pair, axis=0)
        return Contacts(
            distance,
            normal,
            numbers[:, :4],
            weights,
            pairs.flags[:count],
            pairs.zeros[:count],
            numbers[:, 4],
            numbers[:, 5],
            self._none.names,
        )


def _bound_function(points: Index, every: list[_WatchedGroup], count: int) -> ca.Function:
    """Return the function that bounds the distances of all pairs after a motion.

    Arguments: positions of the P points after and before it (3, P); bounds before it (C), m. Results: bounds after
    it (C); the least one of each shape, and the sum of the squares of the displacements.

    A distance from an obstacle changes by no more than an end of the body moves. That of two bodies changes by no
    more than an end of one moves relative to an end of the other: no more than their middles do, and both turn about
    those. It is a dozen operations on whole arrays, which the virtual machine does as fast as machine code.
    """
    X, before = ca.MX.sym("X", 3, count), ca.MX.sym("before", 3, count)
    lower = ca.MX.sym("lower", sum(len(pairs.group) for pairs in every))
    moved = X - before
    first, second = (moved[:, points[:, end].tolist()] for end in (0, 1))
    middle, turned = (first + second) / 2, _norms(second - first) / 2
    furthest = ca.fmax(_norms(first), _norms(second))
    nearer = []
    for pairs in every:
        a, b = pairs.group.body.tolist(), pairs.group.other.tolist()
        nearer.append(
            _norms(middle[:, a] - middle[:, b]) + turned[a] + turned[b] if pairs.is_self else furthest[a]
        )
    after = lower - ca.vertcat(*nearer) if every else lower
    ends = np.cumsum([0, *(len(pairs.group) for pairs in every)]).tolist()
    parts = ca.vertsplit(after, ends) if every else []
    # `mmin` skips NaN; the sum keeps it.
    least = ca.vertcat(*map(ca.mmin, parts), ca.sumsqr(moved))
    return ca.Function("bounds", [X, before, lower], [after, least])


def _norms(vectors: ca.MX) -> ca.MX:
    """Return the norms (K, 1) of columns (3, K)."""
    return ca.sqrt(ca.sum1(vectors**2)).T
