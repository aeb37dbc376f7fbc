"""The nearest pairs of a scene at rest, followed from state to state by one compiled call.

A few pairs of each shape, those that may be nearest, are evaluated exactly in every state; the call that does it bounds
their distances on the way there as well. All the others cannot have come near as long as the arm has moved by less
than what kept them apart when the few were chosen. Where that does not suffice, :class:`Clearance` is asked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import accumulate

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.compiled import Kernel, compile_function
from vgtm_qp.geometry.candidates import Candidates
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.geometry.exact import CONTACT, WIDTH, follow_function
from vgtm_qp.geometry.fcl_queries import FclQueries
from vgtm_qp.geometry.formulas import FAR
from vgtm_qp.geometry.groups import Group
from vgtm_qp.geometry.pairs import Pair

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_AHEAD = 1.3
"""Bounds that keep the pairs that are not watched from less than so many times the limit are renewed."""

_NEVER = -1e9
"""The radius of a pair that only fills a place, m: it is never near."""


@dataclass(frozen=True, eq=False)
class Contacts:
    """R contacts that are near.

    Attributes
    ----------
    pair : (R,) int
        Which of the watched pairs each belongs to.
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

    pair: Index
    distance: Array
    weights: Array
    normal: Array
    nodes: Index
    is_self: NDArray[np.bool_]
    name: Callable[[int], str]


class Watch:
    """Keeps the pairs that are nearest; one thread at a time.

    Parameters
    ----------
    monitor : Clearance
        Of a scene that :meth:`serves`.
    """

    def __init__(self, monitor: Clearance) -> None:
        self._monitor = monitor
        shapes = sorted(set(monitor.pieces.shape.tolist()))
        self._shapes = (*shapes, "segment") if monitor.self_collision else tuple(shapes)
        sizes = [_capacity(shape) for shape in self._shapes]
        self._places = dict(zip(self._shapes, accumulate([0, *sizes]), strict=False))
        count = sum(sizes)
        self._kernel = Kernel(_followed(self._shapes), compiled=False)
        self._before, self._after, self._piece, self._normal, self._radius = (
            array.reshape(count, -1) for array in self._kernel.inputs
        )
        self._after_flat = self._kernel.inputs[1]
        self._contacts = self._kernel.outputs[0].reshape(2 * count, CONTACT)
        self._distance = self._contacts[:, 0]
        self._first_normals = self._contacts[::2, 5:8]
        self._bound = self._contacts[:, CONTACT - 1]
        rows = 2 * np.array(sizes)
        self._is_self = np.repeat([shape == "segment" for shape in self._shapes], rows)
        self._asked = np.repeat([shape in FclQueries.SHAPES for shape in self._shapes], rows)
        self._limits: tuple[float, float] | None = None
        self._limit = np.zeros(2 * count)
        self._floors: tuple[float, float] | None = None
        self._floor = np.zeros(2 * count)
        self._nodes = np.zeros((count, 4), dtype=np.int64)
        self._gather = np.zeros(12 * count, dtype=np.int64)
        self._member = np.zeros(count, dtype=np.int64)
        self._other = np.zeros(count, dtype=np.int64)
        self._listed: Candidates | None = None
        self._bounds: list[_Bounds] = []
        self._reference: Array | None = None
        self._rest, self._rest_self = -np.inf, -np.inf
        self._at: Array | None = None
        self._moved = 0.0

    @staticmethod
    def serves(monitor: Clearance) -> bool:
        """Whether nothing moves but the arm, members end at their nodes, and obstacles are not meshes."""
        shapes = set(monitor.pieces.shape.tolist())
        simple = not monitor.pieces.moving and monitor.ends_at_nodes and "triangle" not in shapes
        return simple and bool(shapes or monitor.self_collision)

    def near(self, X: Array, limit: float, self_limit: float, fcl_reach: float) -> Contacts | None:
        """Return all contacts nearer than `limit`, or `self_limit` between members, m.

        None where they are too many, or surfaces overlap.

        Parameters
        ----------
        X : (N, 3)
            Node positions, m. Not to be written to afterwards: a state is known by its array.
        fcl_reach : float
            Surface distance from which on obstacles are asked of FCL too, m.
        """
        if not self._covers(X, limit, self_limit):
            self._choose(X, limit, self_limit)
            if not self._covers(X, limit, self_limit):
                return None
        if self._limits != (limit, self_limit):
            self._limits = limit, self_limit
            self._limit[:] = np.where(self._is_self, self_limit, limit)
        rows = (self._distance < self._limit).nonzero()[0]
        found, pair = self._contacts[rows], rows >> 1
        members, others, is_self = self._member[pair], self._other[pair], self._is_self[rows]

        def name(k: int) -> str:
            which = Pair(int(members[k]), int(others[k]), bool(is_self[k]))
            return self._monitor.names.clearance(which)

        contacts = Contacts(pair, found[:, 0], found[:, 1:5], found[:, 5:8], self._nodes[pair], is_self, name)
        if len(rows):
            if contacts.distance.min() <= 0.0:
                return None
            self._ask_fcl(rows, contacts, fcl_reach)
        return contacts

    def follow(self, start: Array, end: Array, floor: float, self_floor: float) -> bool:
        """Return whether no surface distance falls below its floor, m, while nodes move straight from `start` to `end`.

        False may also mean that this was not proven. Arrays (N, 3) as in :meth:`near`.
        """
        if start is not self._at:
            if self._reference is None:
                return False
            self._look(start)
        moved = self._moved
        self._look(end)
        moved = max(moved, self._moved)
        if self._floors != (floor, self_floor):
            self._floors = floor, self_floor
            self._floor[:] = np.where(self._is_self, self_floor, floor)
        # Negated comparisons also catch what is not a number.
        return bool(
            (self._bound >= self._floor).all()
            and self._rest - moved >= floor
            and self._rest_self - 2.0 * moved >= self_floor
        )

    def _covers(self, X: Array, limit: float, self_limit: float) -> bool:
        """Evaluate the watched pairs at `X`; whether all others are further than the limits."""
        if X is not self._at:
            if self._reference is None:
                return False
            self._look(X)
        return self._rest - self._moved >= limit and self._rest_self - 2.0 * self._moved >= self_limit

    def _look(self, X: Array) -> None:
        """Evaluate the watched pairs at `X`, and their bounds on the way there from where they were."""
        self._before[:] = self._after
        self._normal[:] = self._first_normals
        X.take(self._gather, out=self._after_flat, mode="clip")
        self._kernel()
        shift = X - self._reference
        self._moved = float(np.einsum("nc,nc->n", shift, shift).max()) ** 0.5
        self._at = X

    def _choose(self, X: Array, limit: float, self_limit: float) -> None:
        """Watch the pairs that may be nearest at `X` from now on."""
        candidates = self._monitor.candidates(X, 0.0, limit, self_limit)
        if candidates is not self._listed:
            self._listed = candidates
            self._bounds = [_Bounds(group, candidates.reference) for group in candidates.groups]
        rests = list(candidates.beyond(candidates.motion(X, 0.0)))
        self._radius[:] = _NEVER
        self._gather[:] = 0
        for bounds in self._bounds:
            group = bounds.group
            place, count = self._places[group.shape], _capacity(group.shape)
            chosen, rest = bounds.nearest(X, count, _AHEAD * (self_limit if group.is_self else limit))
            rests[group.is_self] = min(rests[group.is_self], rest)
            self._fill(slice(place, place + len(chosen)), group, chosen)
        self._rest, self._rest_self = rests
        self._reference = X
        self._look(X)

    def _fill(self, rows: slice, group: Group, chosen: Index) -> None:
        """Let the watched pairs `rows` be those of a group that are `chosen`."""
        nodes = np.concatenate([group.nodes[chosen], group.other_nodes[chosen]], axis=1)
        self._gather.reshape(-1, 4, 3)[rows] = 3 * nodes[..., None] + np.arange(3)
        self._radius[rows, 0] = group.radius[chosen]
        self._member[rows], self._other[rows] = group.member[chosen], group.other[chosen]
        self._nodes[rows] = nodes
        if not group.is_self:
            self._piece[rows] = self._monitor.pieces.parameters[group.other[chosen]]

    def _ask_fcl(self, rows: Index, contacts: Contacts, reach: float) -> None:
        """Take FCL's witness points for obstacles nearer than `reach`, where a nearest point is unique."""
        near = (contacts.distance < reach) & self._asked[rows]
        if not near.any():
            return
        for k in near.nonzero()[0].tolist():
            row, pair = int(rows[k]), int(contacts.pair[k])
            if row % 2 or self._distance[row + 1] < FAR:
                continue
            axis_distance = float(contacts.distance[k] + self._radius[pair, 0])
            ends = self._after[pair, :6].tolist()
            found = self._monitor.fcl.witness(int(self._other[pair]), ends, axis_distance)
            if found is not None:
                t, contacts.normal[k], _ = found
                contacts.weights[k, :2] = 1.0 - t, t


def _capacity(shape: str) -> int:
    """Return how many pairs of a shape are watched: two members that share no node are seldom near."""
    return 24 if shape == "segment" else 40


class _Bounds:
    """Lower bounds of the distances of all pairs of a shape: exact at some state, less by what has moved since."""

    def __init__(self, group: Group, reference: Array) -> None:
        self.group, self._reference, self._distance = group, reference, group.distance

    def nearest(self, X: Array, count: int, enough: float) -> tuple[Index, float]:
        """Return the `count` pairs with the lowest bounds at `X` (N, 3), and what the others are apart at least, m.

        Where that is not `enough`, m, the distances are evaluated anew.
        """
        group = self.group
        if len(group) <= count:
            return np.arange(len(group)), np.inf
        for lower in (self._distance - group.moved(X, self._reference), None):
            if lower is None:
                self._reference = X
                lower = self._distance = group.contacts(X, 0.0, np.arange(len(group))).distance
            order = np.argpartition(lower, count)
            rest = float(lower[order[count]])
            if rest >= enough:
                break
        return order[:count], rest


@cache
def _followed(shapes: tuple[str, ...]) -> ca.Function:
    """Return ``follow_function`` over the watched pairs of all shapes, compiled; once for all of a process.

    Arguments: before, after (12, K), piece (15, K), normal (3, K), radius (1, K). Result: contacts (26, K).
    """
    count = sum(map(_capacity, shapes))
    widths = {"before": 12, "after": 12, "piece": WIDTH, "normal": 3, "radius": 1}
    arguments = [ca.MX.sym(name, width, count) for name, width in widths.items()]
    parts, place = [], 0
    for shape in shapes:
        size = _capacity(shape)
        parts.append(follow_function(shape).map(size)(*(a[:, place : place + size] for a in arguments)))
        place += size
    name = "follow_" + "_".join(shapes)
    return compile_function(ca.Function(name, arguments, [ca.horzcat(*parts)], list(widths), ["contacts"]))
