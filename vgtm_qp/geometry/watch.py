"""All pairs of a scene at rest, evaluated only when they may have come near.

Each pair keeps a lower bound of its distance: what it was when it was evaluated last, less what its members have moved
towards each other since, at most. Where that falls below the distance that matters, one compiled call evaluates the
pair and bounds its distance on the way from the state before. Far pairs are looked at seldom, near ones in every state,
and all of them are covered in a dozen array operations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.compiled import Kernel
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.geometry.exact import CONTACT, WIDTH
from vgtm_qp.geometry.fcl_queries import FclQueries
from vgtm_qp.geometry.formulas import FAR, FURTHEST
from vgtm_qp.geometry.groups import FOLLOWED, Group
from vgtm_qp.geometry.pairs import Pair
from vgtm_qp.geometry.shapes import GeometryError

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_AT_ONCE = FOLLOWED[-1]
_AHEAD = 1.2
"""Pairs are evaluated from so many times the distance on that mattered last: it may be larger in the next state."""

_NEXT = 2.0
"""Pairs whose bounds are below so many times the distance that matters are due before long."""


@dataclass(frozen=True, eq=False)
class Contacts:
    """R contacts that are near.

    Attributes
    ----------
    distance : (R,)
        From surface to surface, m.
    weights : (R, 4)
        Of the velocities of `nodes` in that of the witness points towards each other.
    normal : (R, 3)
        Unit, from the obstacle or other member to the member.
    nodes : (R, 4) int
        Ends of the member, then those of the other member, or its own again, with weights of zero.
    is_self : (R,) bool
    name : callable
        From a row to the name of its clearance.
    """

    distance: Array
    weights: Array
    normal: Array
    nodes: Index
    is_self: NDArray[np.bool_]
    name: Callable[[int], str]


class _Pairs:
    """The pairs of one shape, and what is known of them."""

    def __init__(self, group: Group, parameters: Array) -> None:
        self.group, self.is_self = group, group.is_self
        self.flags = np.full(2 * len(group), group.is_self)
        self.asks_fcl = group.shape in FclQueries.SHAPES
        self.nodes = np.concatenate([group.nodes, group.other_nodes], axis=1)
        piece = np.zeros((len(group), WIDTH)) if group.is_self else parameters[group.other]
        normal = np.tile([0.0, 0.0, 1.0], (len(group), 1))
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

    def look(self, places: Array, lower: Array, limit: float) -> None:
        """Evaluate the pairs that may be nearer than `limit`, m, in the present state.

        Parameters
        ----------
        places : (N, 6)
            Node positions in the state before and in the present one, m.
        lower : (C,)
            Bounds of the distances, m; those of the pairs that are evaluated are written anew.
        """
        # Where none is near yet, those that are due next are looked at in one go.
        reach = limit if self.is_close else max(limit, _NEXT * limit)
        # A negated comparison also catches what is not a number.
        self.near = near = (~(lower >= reach)).nonzero()[0]
        size, lowest = len(near), lower.take(near)
        arguments = (
            places.take(self.nodes.take(near, axis=0), axis=0).reshape(size, 24),
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
        # What it had been proven to be without looking holds as well.
        self.lowest = float(np.maximum(found[:, CONTACT - 1], lowest).min())

    def pass_over(self) -> None:
        """Note that no pair is near."""
        self.near, self.is_close, self.lowest = self.near[:0], False, np.inf


class Watch:
    """Keeps all pairs of a small scene at rest; one thread at a time.

    Parameters
    ----------
    monitor : Clearance
        Of a scene that :meth:`serves`.
    """

    def __init__(self, monitor: Clearance) -> None:
        self._monitor = monitor
        self._pairs: list[_Pairs] = []
        self._parts: list[slice] = []
        self._bounds: Kernel | None = None
        self._at, self._places = np.zeros((0, 3)), np.zeros((0, 6))
        self._limits = self._wanted = (-np.inf, -np.inf)

    @staticmethod
    def serves(monitor: Clearance) -> bool:
        """Whether nothing moves but the arm and there are not too many pairs."""
        return monitor.rests

    def near(self, X: Array, limit: float, self_limit: float, fcl_reach: float) -> Contacts | None:
        """Return all contacts nearer than `limit`, or `self_limit` between members, m; None where surfaces overlap.

        Parameters
        ----------
        X : (N, 3)
            Node positions, m. Not to be written to afterwards: a state is known by its array.
        fcl_reach : float
            Surface distance below which obstacles are asked of FCL too, m.
        """
        if X is not self._at or limit > self._limits[0] or self_limit > self._limits[1]:
            self._look(X, limit, self_limit)
        self._wanted = _AHEAD * limit, _AHEAD * self_limit
        parts = []
        for pairs in self._pairs:
            if len(pairs.near):
                limit_here = self_limit if pairs.is_self else limit
                rows = (pairs.contacts[:, 0] < limit_here).nonzero()[0]
                if len(rows):
                    parts.append(self._contacts(pairs, rows, fcl_reach))
        if not parts:
            return _NONE
        found = parts[0] if len(parts) == 1 else _join(*parts)
        return found if found.distance.min() > 0.0 else None

    def follow(self, start: Array, end: Array, floor: float, self_floor: float) -> bool:
        """Return whether no surface distance falls below its floor, m, while nodes move straight from `start` to `end`.

        False may also mean that this was not proven. Arrays (N, 3) as in :meth:`near`.
        """
        limits = max(self._wanted[0], floor), max(self._wanted[1], self_floor)
        if start is not self._at:
            self._look(start, *limits)
        self._look(end, *limits)
        floors = {False: floor, True: self_floor}
        return all(pairs.lowest >= floors[pairs.is_self] for pairs in self._pairs)

    def _look(self, X: Array, limit: float, self_limit: float) -> None:
        """Evaluate what may be nearer than the limits, m, at `X` and go on from there.

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
        for k, pairs in enumerate(self._pairs):
            nearer_than = self_limit if pairs.is_self else limit
            if least[k] >= nearer_than:
                pairs.pass_over()
            else:
                pairs.look(self._places, lower[self._parts[k]], nearer_than)
        inputs[1][:] = inputs[0]
        inputs[2][:] = lower
        self._at, self._limits = X, (limit, self_limit)

    def _start(self, X: Array) -> Kernel:
        """List all pairs, with their distances at `X`."""
        monitor = self._monitor
        groups = monitor.every_pair(X).groups
        self._pairs = [_Pairs(group, monitor.pieces.parameters) for group in groups]
        ends = np.cumsum([0, *map(len, groups)])
        self._parts = [slice(a, b) for a, b in pairwise(ends.tolist())]
        self._bounds = kernel = Kernel(_bound_function(monitor.members, self._pairs, len(X)), compiled=False)
        kernel.inputs[1][:] = X.reshape(-1)
        for group, part in zip(groups, self._parts, strict=True):
            kernel.inputs[2][part] = group.distance
        self._at, self._places = X, np.zeros((len(X), 6))
        return kernel

    def _contacts(self, pairs: _Pairs, rows: Index, fcl_reach: float) -> Contacts:
        found, pair = pairs.contacts.take(rows, axis=0), pairs.near.take(rows >> 1)
        group = pairs.group

        def name(k: int) -> str:
            which = Pair(int(group.member[pair[k]]), int(group.other[pair[k]]), group.is_self)
            return self._monitor.names.clearance(which)

        is_self = pairs.flags[: len(rows)]
        distance, normal, weights = found[:, 0], found[:, 5:8], found[:, 1:5]
        if pairs.asks_fcl:
            for k in (distance < fcl_reach).nonzero()[0].tolist():
                # Where the nearest point is not unique, FCL may give one between the two ends of the contact.
                if rows[k] % 2 == 0 and pairs.contacts[rows[k] + 1, 0] >= FAR:
                    member = int(pair[k])
                    ends = self._at[group.nodes[member]].reshape(-1).tolist()
                    apart = float(distance[k] + group.radius[member])
                    answer = self._monitor.fcl.witness(int(group.other[member]), ends, apart)
                    if answer is not None:
                        t, normal[k], _ = answer
                        weights[k, :2] = 1.0 - t, t
        return Contacts(distance, weights, normal, pairs.nodes.take(pair, axis=0), is_self, name)


_NONE = Contacts(
    np.zeros(0),
    np.zeros((0, 4)),
    np.zeros((0, 3)),
    np.zeros((0, 4), dtype=np.int64),
    np.zeros(0, dtype=bool),
    str,
)


def _bound_function(members: Index, every: list[_Pairs], nodes: int) -> ca.Function:
    """Return the function that bounds the distances of all pairs after a motion.

    Arguments: node positions after and before it (3, N); bounds before it (C), m. Results: bounds after it (C); the
    least one of each shape, and the sum of the squares of the displacements.

    A distance from an obstacle changes by no more than an end of the member moves. That of two members changes by no
    more than an end of one moves relative to an end of the other: than their middles do, and both turn about those.
    It is a dozen operations on whole arrays, which the virtual machine does as fast as machine code.
    """
    X, before = ca.MX.sym("X", 3, nodes), ca.MX.sym("before", 3, nodes)
    lower = ca.MX.sym("lower", sum(len(pairs.group) for pairs in every))
    moved = X - before
    first, second = (moved[:, members[:, end].tolist()] for end in (0, 1))
    middle, turned = (first + second) / 2, _norms(second - first) / 2
    furthest = ca.fmax(_norms(first), _norms(second))
    nearer = []
    for pairs in every:
        a, b = pairs.group.member.tolist(), pairs.group.other.tolist()
        nearer.append(
            _norms(middle[:, a] - middle[:, b]) + turned[a] + turned[b] if pairs.is_self else furthest[a]
        )
    after = lower - ca.vertcat(*nearer) if every else lower
    ends = np.cumsum([0, *(len(pairs.group) for pairs in every)]).tolist()
    parts = ca.vertsplit(after, ends) if every else []
    # A least of numbers leaves out what is none; the sum does not.
    least = ca.vertcat(*map(ca.mmin, parts), ca.sumsqr(moved))
    return ca.Function("bounds", [X, before, lower], [after, least])


def _norms(vectors: ca.MX) -> ca.MX:
    """Return the norms (K, 1) of columns (3, K)."""
    return ca.sqrt(ca.sum1(vectors**2)).T


def _join(*parts: Contacts) -> Contacts:
    """Return the contacts of two or more shapes, one after the other."""
    names = [(part.name, k) for part in parts for k in range(len(part.distance))]
    arrays = ("distance", "weights", "normal", "nodes", "is_self")
    joined = {array: np.concatenate([getattr(part, array) for part in parts]) for array in arrays}
    return Contacts(**joined, name=lambda k: names[k][0](names[k][1]))
