"""The pairs of a scene that may soon be near, evaluated only when they may have come near.

They are those that ``Candidates`` list, of a small scene all. Each pair keeps a lower bound of its distance: its
distance at the last evaluation, less a bound of the approach of its bodies since. A body's distance from an obstacle
changes by no more than an end of the body moves, and the obstacle. The distance of two bodies changes by no more than
the relative displacement of their middles plus the turns of both about these. If the bound falls below the limit, the
pair is evaluated, and its distance on the motion from the state before is bounded: ``pairs.c``. The pairs that are not
listed have bounds as well, and are listed anew before they can be near.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

import casadi as ca
import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.compiled import Compiling, Kernel, compiler
from vgtm_qp.errors import EvaluationError
from vgtm_qp.geometry.candidates import TO_PIECES, Candidates
from vgtm_qp.geometry.exact import CONTACT, WIDTH, follow_function, proof_function
from vgtm_qp.geometry.formulas import FAR, FURTHEST
from vgtm_qp.geometry.groups import Found, Group, Scene
from vgtm_qp.geometry.pairs import Contacts, Wanted
from vgtm_qp.geometry.parts import Parts
from vgtm_qp.geometry.shapes import GeometryError
from vgtm_qp.native import Code, Program, building

AHEAD = 1.2
"""Distance below which pairs are evaluated, over the last limit: the next limit may be larger."""

_AMPLE = 1.3
"""Least bound of the distances of pairs that are not listed, over the distance below which pairs are evaluated."""

_RIGID = 11
"""Numbers of the motion of a part of the arm in C."""

_NEXT = 2.0
"""If no pair is near: distance below which pairs are still evaluated, in one call, over the limit."""


def can_be_watched(scene: Scene) -> bool:
    """Return whether there are pairs, no meshes and no hulls."""
    bodies, pieces = len(scene.bodies), scene.pieces
    simple = not scene.bodies.hulls and "triangle" not in pieces.shape
    return simple and bodies > 1 and (scene.has_self or len(pieces) > 0)


@cache
def _contact(shape: str, _: str | None) -> tuple[ca.Function, Compiling]:
    """Return the function that evaluates one pair, and its compilation, once for each compiler."""
    function = follow_function(shape)
    return function, Compiling(function)


@cache
def _proof(shape: str, _: str | None) -> tuple[ca.Function, Compiling]:
    """Return the function that proves an answer of FCL, and its compilation, once for each compiler."""
    function = proof_function(shape)
    return function, Compiling(function)


def is_ready(shapes: Iterable[str]) -> bool:
    """Whether scenes of these shapes can be watched; always false if nothing can be compiled."""
    library = building()
    if not library.ask():
        for shape in shapes:
            _contact(shape, compiler())[1].ask()
    return library.library is not None


class WatchedGroup:
    """Pairs of one shape, with bounds and contacts of the last evaluation; see :meth:`hold`."""

    def __init__(self, group: Group, lower: Array) -> None:
        function, compiling = _contact(group.shape, compiler())
        contact = Kernel(function, compiled=compiling)
        self._program = Program("Pairs")
        self._program.set(
            is_self=int(group.is_self),
            next=_NEXT,
            contact=contact,
            ends=contact.inputs[0],
            pair=contact.inputs[1],
            found=contact.outputs[0],
        )
        if group.scene.fcl is not None:
            function, compiling = _proof(group.shape, compiler())
            proof = Kernel(function, compiled=compiling)
            pair, answer = proof.inputs
            self._program.set(proof=proof, proof_pair=pair, answer=answer, proven=proof.outputs[0])
        self.data = self._program.data
        self.hold(group, lower)

    def hold(self, group: Group, lower: Array) -> None:
        """Watch the pairs of `group`, of the same shape, in the place of those before.

        `lower` (C,) are lower bounds of their distances, m.
        """
        count, pieces = len(group), group.scene.pieces
        self.group, self.body, self.other = group, group.body, group.other
        piece = np.zeros((count, WIDTH)) if group.is_self else pieces.parameters[group.other]
        normal = np.tile([0.0, 0.0, 1.0], (count, 1))
        self._lower = lower.copy()
        self._rows, self._contacts = np.zeros(count, dtype=np.int64), np.zeros((2 * count, CONTACT))
        self._program.set(
            count=count,
            near=0,
            is_close=0,
            overlaps=0,
            body=group.body.astype(np.int32),
            other=group.other.astype(np.int32),
            points=np.ascontiguousarray(group.points, dtype=np.int32),
            lower=self._lower,
            known=np.concatenate([piece, group.radius[:, None], normal], axis=1),
            rows=self._rows,
            contacts=self._contacts,
            velocity=pieces.velocity[group.other] if group.moving else 0,
            speed=pieces.speed[group.other] if group.moving else 0,
        )

    def address(self) -> int:
        """Return the address of the pairs for C; uses the kernels compiled meanwhile."""
        self._program.refresh()
        return self._program.address

    def keeps(self, floor: float) -> bool:
        """Return whether no distance in the present state is below `floor`, m."""
        return bool(self._lower.min(initial=np.inf) >= floor)

    def near(self, X: Array, time: float, limit: float, by_fcl: bool, wanted: Wanted | None) -> Found:
        """Return the `wanted` contacts nearer than `limit`, m, in the present state, `X` at a `time`, s."""
        contacts = self._contacts[: 2 * self.data.near]
        near = (contacts[:, 0] < limit).nonzero()[0]
        rows, contacts = self._rows.take(near >> 1), contacts.take(near, axis=0)
        if wanted is not None:
            kept = self.group.chosen(wanted, rows, contacts)
            rows, contacts = rows[kept], contacts[kept]
        return self.group.contacts(X, time, rows, contacts, by_fcl)


class Watch:
    """Holds the pairs of a scene that :func:`can_be_watched`; one thread at a time.

    States are positions of the points (P, 3), m, and times, s, at which pieces are where their motion leads.
    `influence` and `self_influence` are those of ``Candidates``.

    Attributes
    ----------
    groups : list
        The pairs of each list and shape.
    """

    def __init__(self, scene: Scene, influence: float, self_influence: float) -> None:
        self._scene = scene
        for shape in scene.shapes:
            # A list may have pairs of a shape only later, within a step.
            _contact(shape, compiler())[1].ask()
        self._candidates, self._most = Candidates(scene, influence, self_influence), AHEAD * influence
        self.groups: list[WatchedGroup] = []
        self._known: dict[tuple[int, str], WatchedGroup] = {}
        self._way: Program | None = None
        self._renewals: list[int] = []
        self._parts: Parts | None = None
        self._place: Array = np.zeros((0, 3))

    def forget_pieces(self) -> None:
        """Forget the pairs with pieces, because the pieces are others now; pairs of bodies are kept."""
        self._candidates.forget_pieces()
        if self._way is not None:
            self._hold([pairs for pairs in self.groups if pairs.group.is_self])
            self._way.set(reach=-np.inf, self_reach=-np.inf, far=-np.inf, fastest=self._scene.pieces.fastest)

    def near(
        self,
        X: Array,
        time: float,
        limit: float,
        self_limit: float,
        *,
        by_fcl: bool = False,
        wanted: Wanted | None = None,
    ) -> Contacts | None:
        """Return the contacts nearer than `limit`, or `self_limit` between bodies, m; None where surfaces overlap.

        `X` and `time` are the state; `by_fcl` says whether FCL supplies the contacts, `wanted` which pairs have any.
        """
        way = self.move_to(X, time, limit, self_limit)
        way.set(wanted=AHEAD * limit, self_wanted=AHEAD * self_limit)
        limits, near = (limit, self_limit), [pairs for pairs in self.groups if pairs.data.near]
        if any(pairs.data.overlaps for pairs in near):
            return None
        return self._scene.contacts(
            [pairs.near(X, time, limits[pairs.group.is_self], by_fcl, wanted) for pairs in near]
        )

    def keeps(self, X: Array, time: float, floor: float, self_floor: float) -> bool:
        """Return whether `X` and `time` are the present state, with no surface distance below its floor, m."""
        floors = floor, self_floor
        if self._way is None or not self._is_at(X, time):
            return False
        far, self_far = self._far(self._way)
        return (
            far >= floor
            and self_far >= self_floor
            and all(pairs.keeps(floors[pairs.group.is_self]) for pairs in self.groups)
        )

    def follow(
        self, places: Array, start_time: float, end_time: float, floor: float, self_floor: float
    ) -> bool:
        """Return whether no surface distance falls below its floor, m, on a path of straight pieces.

        False may also mean that this was not proven. The path leads from one of the `places` of the points
        (K + 1, P, 3), m, to the next, in equal parts of the time. The last place reached becomes the present state.
        """
        if not self._is_at(places[0], start_time):
            self._go_to(places[0], start_time)
        return self._go(places, start_time, end_time, floor, self_floor)

    def move_to(self, X: Array, time: float, limit: float, self_limit: float) -> Program:
        """Make `X` and `time` the present state, with all contacts nearer than the limits, m; return C's ``Way``."""
        way = self.started(X, time)
        if not self._is_at(X, time) or limit > way.data.reach or self_limit > way.data.self_reach:
            way.set(wanted=limit, self_wanted=self_limit)
            self._go_to(X, time)
            if limit > way.data.reach or self_limit > way.data.self_reach:
                # On the way there pairs that are not listed may have come near.
                self._list(way, X, time)
                self._go(np.stack([X, X]), time, time, -np.inf, -np.inf)
        return way

    def _clock(self, time: float) -> float:
        """Return the time that tells where pieces are: zero where they rest, else `time`, s."""
        return time if self._scene.pieces.moving else 0.0

    def _is_at(self, X: Array, time: float) -> bool:
        """Return whether `X` (P, 3) and `time` are the present state."""
        way = self._way
        if way is None or way.data.lost or not way.data.reach > -np.inf:
            return False
        return self._is_there(X, time)

    def _is_there(self, X: Array, time: float) -> bool:
        """Return whether `X` (P, 3) and `time` are the present state, whose pairs may not have been evaluated."""
        assert self._way is not None
        return bool(self._way.data.time == self._clock(time)) and X.tobytes() == self._place.tobytes()

    def _go_to(self, X: Array, time: float) -> None:
        """Go from the present state, if there is one, to another."""
        way = self.started(X, time)
        self._go(np.stack([self._place, X]), way.data.time, time, -np.inf, -np.inf)

    def _go(self, places: Array, start_time: float, end_time: float, floor: float, self_floor: float) -> bool:
        """Go from place to place as long as the floors, m, are proven, and return whether all are.

        The last place reached becomes the present state. At the last of `places` the pairs that may be nearer
        than is wanted, m, are evaluated.

        Raises
        ------
        GeometryError
            A position is not finite; the present state stays as it was.
        """
        way, places = self._way, np.ascontiguousarray(places)
        assert way is not None
        self.refresh()
        way.set(
            pieces=len(places) - 1,
            places=places,
            start=self._clock(start_time),
            end=self._clock(end_time),
            floor=floor,
            self_floor=self_floor,
            limit=max(way.data.wanted, floor),
            self_limit=max(way.data.self_wanted, self_floor),
        )
        code = way.call("follow")
        if code is Code.TOO_FAR:
            raise GeometryError("node positions must be finite numbers")
        if code is Code.NO_VALUE:
            raise EvaluationError("the distance of a pair has no value")
        return code is Code.DONE

    def refresh(self) -> None:
        """Use the kernels that were compiled meanwhile."""
        for k, pairs in enumerate(self.groups):
            self._pairs[k] = pairs.address()

    def started(self, X: Array, time: float) -> Program:
        """Return the ``Way`` of C, with all pairs that can be near in a step from a state, or of a small scene all."""
        way = self._way
        if way is None or way.data.lost:
            return self._start(X, time)
        needed, self_needed = self._needed(way)
        if way.data.parted < self_needed:
            way.call("measure_parts")
        far, self_far = self._far(way)
        # NaN fails the comparisons.
        if not (far >= needed and self_far >= self_needed):
            self._list(way, X, time)
        return way

    def _far(self, way: Program) -> tuple[float, float]:
        """Return lower bounds of the distances of pairs that are not listed, m: to pieces and between bodies."""
        return way.data.far, min(way.data.self_far, way.data.parted)

    def _needed(self, way: Program) -> tuple[float, float]:
        """Return the least bounds of the distances of pairs that are not listed, m: to pieces and between bodies."""
        wanted, self_wanted = way.data.wanted, way.data.self_wanted
        ample, self_ample = (min(_AMPLE * distance, self._most) for distance in (wanted, self_wanted))
        return max(wanted, ample), max(self_wanted, self_ample)

    def _start(self, X: Array, time: float) -> Program:
        """Begin in a state."""
        bodies, way, self._place, self._renewals = self._scene.bodies, Program("Way"), X.copy(), []
        way.set(
            points=len(X),
            bodies=len(bodies),
            ends=np.ascontiguousarray(bodies.points, dtype=np.int32),
            furthest=FURTHEST,
            middle=np.zeros((len(bodies), 3)),
            turned=np.zeros(len(bodies)),
            moved=np.zeros(len(bodies)),
            place=self._place,
            time=self._clock(time),
            fastest=self._scene.pieces.fastest,
            parts=0,
            **dict.fromkeys(("reach", "self_reach", "wanted", "self_wanted"), -np.inf),
            **dict.fromkeys(("self_far", "parted"), np.inf),
        )
        self._way, self._parts = way, None
        self._list(way, X, time)
        return way

    def _list(self, way: Program, X: Array, time: float) -> None:
        """Go to a state, and list the pairs there that may be near soon."""
        if self._renewals and not self._is_there(X, time):
            self._go(np.stack([self._place, X]), way.data.time, time, -np.inf, -np.inf)
        candidates, data, began = self._candidates, way.data, bool(self._renewals)
        (_, self_far), (needed, self_needed) = self._far(way), self._needed(way)
        # What C knows of pairs of bodies is more: those that moved together came no nearer.
        is_short = not (began and self_far >= self_needed)
        reaches = max(needed, 0.0), max(self_needed, 0.0) if is_short else -np.inf
        motion = candidates.cover(X, self._clock(time), *reaches)
        before, self._renewals = self._renewals or [0] * len(candidates.renewals), candidates.renewals
        renewed = [place for place, count in enumerate(self._renewals) if count != before[place]]
        way.set(far=candidates.beyond(motion)[0])
        parts = candidates.parts
        if parts is not None:
            near, parted = candidates.apart(motion)
            if any(place != TO_PIECES for place in renewed):
                way.set(self_far=near, parted=parted)
            elif began:
                way.set(self_far=max(near, data.self_far), parted=max(parted, data.parted))
        if parts is not None and parts is not self._parts:
            self._parts = parts
            self._part(way, parts, all_listed=near >= 0.5 * FAR)
        if renewed:
            kept = [pairs for pairs in self.groups if pairs.group.place not in renewed]
            new = [
                self._watched(group, group.lower(motion, np.inf)[0])
                for group in candidates.groups
                if group.place in renewed
            ]
            self._hold([*new, *kept])
            way.set(reach=-np.inf, self_reach=-np.inf)

    def _part(self, way: Program, parts: Parts, *, all_listed: bool) -> None:
        """Give C the parts of the arm, unless all pairs of bodies are listed."""
        first, second = np.sort(parts.near, axis=1).T
        order = np.lexsort((second, first))
        count = len(parts.starts)
        ends = np.searchsorted(first[order], np.arange(count + 1))
        tables = {
            "part_points": parts.points,
            "points_at": np.append(parts.starts, len(parts.points)),
            "neighbour": second[order],
            "neighbours_at": ends,
        }
        way.set(
            parts=0 if all_listed else count,
            thickness=parts.thickness,
            part=np.zeros((count, _RIGID)),
            **{name: np.ascontiguousarray(table, dtype=np.int32) for name, table in tables.items()},
        )

    def _watched(self, group: Group, lower: Array) -> WatchedGroup:
        """Return what watches the pairs of `group`; kernels of a list's shape are set up once."""
        key = group.place, group.shape
        if key in self._known:
            self._known[key].hold(group, lower)
        else:
            self._known[key] = WatchedGroup(group, lower)
        return self._known[key]

    def _hold(self, groups: list[WatchedGroup]) -> None:
        """Watch the pairs of `groups`, whose bounds are those at the present place."""
        assert self._way is not None
        self.groups = groups
        self._pairs = np.array([pairs.address() for pairs in groups], dtype=np.uintp)
        self._way.set(groups=len(groups), group=self._pairs)
