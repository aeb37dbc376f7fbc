"""The pairs of a scene that may soon be near, evaluated only when they may have come near.

``pairs.c`` lists them, in a small scene all pairs. Each keeps a lower bound of its distance: its
distance at the last evaluation, less a bound of the approach of its bodies since. A body's distance from an obstacle
changes by no more than an end of the body and the obstacle move. The distance of two bodies changes by no more than
the relative displacement of their middles plus the turns of both about these. If the bound falls below the limit, the
pair is evaluated, and its distance on the motion from the state before is bounded. The pairs that are not listed have
bounds as well, and are listed anew before they can be near.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import EvaluationError
from vgtm_qp.geometry.exact import proof_function
from vgtm_qp.geometry.formulas import FURTHEST
from vgtm_qp.geometry.groups import Found, Scene
from vgtm_qp.geometry.hulls import groups_by_kind
from vgtm_qp.geometry.pairs import Contacts, Wanted
from vgtm_qp.geometry.parts import Division
from vgtm_qp.geometry.searching import hulls_of, kernel, pairs_of
from vgtm_qp.geometry.shapes import GeometryError
from vgtm_qp.native import Code, Program

AHEAD = 1.2
"""Distance below which pairs are evaluated, over the last limit: the next limit may be larger."""

_FEW_PAIRS = 4_000
"""Greatest number of bodies, times that of bodies and pieces, of a scene whose pairs are all listed."""

AXIS, _RIGID = 8, 11
"""Numbers in C of the axis of a body, and of the motion of a part of the arm."""

_LISTED = np.dtype([("body", np.int32), ("other", np.int32), ("lower", np.float64)])
"""A pair as C knows it."""

_ROOM = 64
"""Number of pairs of one shape that there is room for at first."""

_NEXT = 2.0
"""If no pair is near: distance below which pairs are still evaluated, in one call, over the limit."""


def can_be_watched(scene: Scene) -> bool:
    """Return whether there are pairs, and no meshes."""
    bodies, pieces = len(scene.bodies), scene.pieces
    return "triangle" not in pieces.shape and bodies > 1 and (scene.has_self or len(pieces) > 0)


class ListedPairs:
    """The listed pairs of one shape, with bounds and contacts of the last evaluation: arrays that C fills."""

    def __init__(self, scene: Scene, shape: str) -> None:
        self._scene, self._shape, self.is_self = scene, shape, shape == "segment"
        self._program = pairs_of(shape, has_hulls=bool(scene.bodies.hulls))
        self._program.set(next=_NEXT)
        if scene.fcl is not None:
            proof = kernel(proof_function, shape)
            pair, answer = proof.inputs
            self._program.set(proof=proof, proof_pair=pair, answer=answer, proven=proof.outputs[0])
        self.data = self._program.data
        self._hold(_ROOM)

    def _hold(self, room: int) -> None:
        """Make room for that many pairs; those that were listed are forgotten."""
        self._listed, self._normal = np.zeros(room, dtype=_LISTED), np.zeros((room, 3))
        self._rows = np.zeros(room, dtype=np.int64)
        self._contacts = np.zeros((room * self._scene.each, self._scene.size))
        self._program.set(
            count=0,
            near=0,
            room=room,
            listed=self._listed,
            normal=self._normal,
            rows=self._rows,
            contacts=self._contacts,
        )

    def forget_pieces(self) -> None:
        """Forget the pairs with pieces."""
        if not self.is_self:
            self.data.count = self.data.near = self.data.overlaps = 0

    def make_room(self) -> bool:
        """Make more room if there is none left; return whether there was none."""
        is_full = bool(self.data.count == self.data.room)
        if is_full:
            self._hold(2 * self.data.room)
        return is_full

    def address(self) -> int:
        """Return the address of the pairs for C; uses the kernels compiled meanwhile."""
        self._program.refresh()
        return self._program.address

    def keeps(self, floor: float) -> bool:
        """Return whether no distance in the present state is below `floor`, m."""
        return bool(self._listed["lower"][: self.data.count].min(initial=np.inf) >= floor)

    def near(
        self, X: Array, time: float, limit: float, by_fcl: bool, wanted: Wanted | None
    ) -> Iterator[Found]:
        """Yield the `wanted` contacts nearer than `limit`, m, in the present state, `X` at a `time`, s."""
        each = self._scene.each
        contacts = self._contacts[: each * self.data.near]
        near = (contacts[:, 0] < limit).nonzero()[0]
        rows, contacts = self._rows.take(near // each), contacts.take(near, axis=0)
        body, other = (self._listed[which].take(rows).astype(np.int64) for which in ("body", "other"))
        for group, own in groups_by_kind(self._scene, self._shape, body, other):
            rows, found = np.arange(len(group)), contacts[own]
            if wanted is not None:
                kept = group.chosen(wanted, rows, found)
                rows, found = rows[kept], found[kept]
            yield group.contacts(X, time, rows, found, by_fcl)


class Watch:
    """Holds the pairs of a scene that :func:`can_be_watched`; one thread at a time.

    States are positions of the points (P, 3), m, and times, s, at which pieces are where their motion leads.
    `influence` and `self_influence` are those of ``Candidates``.
    """

    def __init__(self, scene: Scene, influence: float, self_influence: float) -> None:
        self._scene, self._influence, self._self_influence = scene, influence, self_influence
        self._pairs: dict[str, ListedPairs] = {}
        self._way: Program | None = None
        self._put()

    def _put(self) -> None:
        """Allocate what the shapes of the scene need."""
        for shape in self._scene.shapes:
            if shape not in self._pairs:
                self._pairs[shape] = ListedPairs(self._scene, shape)
        self._groups = [self._pairs[shape] for shape in self._scene.shapes]

    def forget_pieces(self) -> None:
        """Forget the pairs with pieces, because the pieces are others now; pairs of bodies are kept."""
        self._put()
        for pairs in self._pairs.values():
            pairs.forget_pieces()
        if self._way is not None:
            self._way.set(**self._of_pieces())

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
        way = self._see(X, time, limit, self_limit)
        way.set(wanted=AHEAD * limit, self_wanted=AHEAD * self_limit)
        limits, near = (limit, self_limit), [pairs for pairs in self._groups if pairs.data.near]
        if any(pairs.data.overlaps for pairs in near):
            return None
        found = [pairs.near(X, time, limits[pairs.is_self], by_fcl, wanted) for pairs in near]
        return self._scene.contacts(list(chain.from_iterable(found)))

    def keeps(self, X: Array, time: float, floor: float, self_floor: float) -> bool:
        """Return whether `X` and `time` are the present state, with no surface distance below its floor, m."""
        way, floors = self._way, (floor, self_floor)
        if way is None or way.data.lost or not way.data.reach > -np.inf:
            return False
        is_there = bool(way.data.time == self._clock(time)) and X.tobytes() == self._place.tobytes()
        return (
            is_there
            and way.data.far >= floor
            and min(way.data.self_far, way.data.parted) >= self_floor
            and all(pairs.keeps(floors[pairs.is_self]) for pairs in self._groups)
        )

    def follow(
        self, places: Array, start_time: float, end_time: float, floor: float, self_floor: float
    ) -> bool:
        """Return whether no surface distance falls below its floor, m, on a path of straight pieces.

        False may also mean that this was not proven. The path leads from one of the `places` of the points
        (K + 1, P, 3), m, to the next, in equal parts of the time. The last place reached becomes the present state.

        Raises
        ------
        GeometryError
            A position is not finite; the present state stays as it was.
        """
        way, places = self._see(places[0], start_time, -np.inf, -np.inf), np.ascontiguousarray(places)
        way.set(
            pieces=len(places) - 1,
            places=places,
            start=self._clock(start_time),
            end=self._clock(end_time),
            floor=floor,
            self_floor=self_floor,
        )
        return self._answered("prove_path") is Code.DONE

    @property
    def followed(self) -> int:
        """Number of pieces of the last path that were followed: up to the first one that was not proven."""
        return 0 if self._way is None else int(self._way.data.done)

    def _see(self, X: Array, time: float, limit: float, self_limit: float) -> Program:
        """Make `X` and `time` the present state, with all contacts nearer than the limits, m; return C's ``Way``."""
        way, place = self.started(X), np.ascontiguousarray(X)
        self.refresh()
        way.set(places=place)
        self._answered("see_place", self._clock(time), limit, self_limit)
        return way

    def _answered(self, name: str, *arguments: float) -> Code:
        """Call a function of C, again with more room where it lacked some, and return its code.

        Raises
        ------
        GeometryError
            A position is not a finite number.
        EvaluationError
            The distance of a pair has no value.
        """
        assert self._way is not None
        while (code := self._way.call(name, *arguments)) is Code.FULL:
            self.make_room()
        if code is Code.TOO_FAR:
            raise GeometryError("node positions must be finite numbers")
        if code is Code.NO_VALUE:
            raise EvaluationError("the distance of a pair has no value")
        return code

    def _clock(self, time: float) -> float:
        """Return `time`, s, if pieces of obstacles move; else zero, since places at rest are the same at all times."""
        return time if self._scene.pieces.moving else 0.0

    def refresh(self) -> None:
        """Use the kernels that were compiled meanwhile."""
        for k, pairs in enumerate(self._groups):
            self._addresses[k] = pairs.address()

    def make_room(self) -> None:
        """Make more room where there was none for a pair, of bodies or of parts that are near to each other."""
        assert self._way is not None
        larger = next((pairs for pairs in self._groups if pairs.make_room()), None)
        if larger is not None:
            # What was listed is forgotten, so that C lists it anew. If another group lacks room, the next call says so.
            self._way.set(**{"self_far" if larger.is_self else "far": -np.inf})
            return
        room = 2 * self._way.data.neighbour_room
        self._way.set(neighbour=np.zeros(room, dtype=np.int32), neighbour_room=room)

    def started(self, X: Array) -> Program:
        """Return C's ``Way``, made at the first call for bodies at positions `X` (P, 3), m."""
        if self._way is not None:
            return self._way
        bodies, parts, self._place = self._scene.bodies, Division(self._scene.bodies, X), X.copy()
        touching, touching_at = bodies.neighbours
        count = len(bodies)
        tables = {
            "ends": bodies.points,
            "touching": touching,
            "touching_at": touching_at,
            "part_points": parts.points,
            "points_at": parts.points_at,
            "part_bodies": parts.bodies,
            "bodies_at": parts.bodies_at,
            "neighbour": np.zeros(8 * len(parts)),
            "neighbours_at": np.zeros(len(parts) + 1),
        }
        self._way = Program("Way")
        if bodies.hulls:
            self._hulls = hulls_of(bodies, self._scene.unit)
            self._way.set(hulls=self._hulls.address)
        self._way.set(
            points=len(X),
            furthest=FURTHEST,
            place=self._place,
            line=np.zeros((2, *X.shape)),
            bodies=count,
            span=self._scene.span,
            each=self._scene.each,
            size=self._scene.size,
            radius=bodies.radius,
            axis=np.zeros((count, AXIS)),
            middle=np.zeros((count, 3)),
            turned=np.zeros(count),
            moved=np.zeros(count),
            influence=self._influence,
            self_influence=self._self_influence,
            most=AHEAD * self._influence,
            parts=len(parts),
            thickness=parts.thickness,
            part=np.zeros((len(parts), _RIGID)),
            neighbour_room=8 * len(parts),
            self_far=-np.inf if self._scene.has_self else np.inf,
            parted=np.inf,
            wanted=-np.inf,
            self_wanted=-np.inf,
            **{name: np.ascontiguousarray(table, dtype=np.int32) for name, table in tables.items()},
            **self._of_pieces(),
        )
        return self._way

    def _of_pieces(self) -> dict[str, object]:
        """Return by field what C knows of the pieces of obstacles; no pair with one is listed yet."""
        pieces, shapes, bodies = self._scene.pieces, self._scene.shapes, len(self._scene.bodies)
        is_small = bodies * (bodies + len(pieces)) <= _FEW_PAIRS
        self._addresses = np.array([pairs.address() for pairs in self._groups], dtype=np.uintp)
        arrays = {
            "solid": pieces.parameters,
            "centre": pieces.center,
            "extent": pieces.radius,
            "allowance": pieces.allowance,
            "velocity": pieces.velocity,
            "speed": pieces.speed,
        }
        return {
            "solids": len(pieces),
            "fastest": pieces.fastest,
            "kind": np.array([shapes.index(shape) for shape in pieces.shape.tolist()], dtype=np.int32),
            "groups": len(shapes),
            "group": self._addresses,
            "among": self._pairs["segment"].address() if "segment" in shapes else 0,
            "slack": np.inf if is_small else self._influence,
            "far": -np.inf,
            "reach": -np.inf,
            "self_reach": -np.inf,
            **{name: np.ascontiguousarray(array) for name, array in arrays.items()},
        }
