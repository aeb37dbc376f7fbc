"""All pairs of a scene at rest, evaluated only when they may have come near.

Each pair keeps a lower bound of its distance: its distance at the last evaluation, less a bound of the
approach of its bodies since. A body's distance from an obstacle changes by no more than an end of the body
moves. The distance of two bodies changes by no more than the relative displacement of their middles plus the
turns of both about these. If the bound falls below the limit, the pair is evaluated, and its distance on the
motion from the state before is bounded: ``watch.c``.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.compiled import Compiling, Kernel, compiler
from vgtm_qp.errors import EvaluationError
from vgtm_qp.geometry.candidates import every_pair, every_pair_with_pieces
from vgtm_qp.geometry.exact import CONTACT, WIDTH, follow_function
from vgtm_qp.geometry.formulas import FURTHEST
from vgtm_qp.geometry.groups import Found, Group, Scene
from vgtm_qp.geometry.pairs import Contacts, Wanted
from vgtm_qp.geometry.shapes import GeometryError
from vgtm_qp.native import Program, building

SOURCE = Path(__file__).with_name("watch.c")

_MOST_PAIRS = 8000
"""Greatest number of pairs of a scene that can be watched."""

_AHEAD = 1.2
"""Distance below which pairs are evaluated, over the last limit: the next limit may be larger."""

_NEXT = 2.0
"""If no pair is near: distance below which pairs are still evaluated, in one call, over the limit."""


class _FollowCode(IntEnum):
    """What ``follow`` of ``watch.c`` returns."""

    DONE, NO_VALUE, TOO_FAR, NOT_PROVEN = range(4)


def can_be_watched(scene: Scene) -> bool:
    """Return whether only the arm moves, there are no meshes and no hulls, and there are not too many pairs."""
    bodies, pieces = len(scene.bodies), scene.pieces
    simple = not (pieces.moving or scene.bodies.hulls) and "triangle" not in pieces.shape
    count = bodies * len(pieces) + (bodies * (bodies - 1) // 2 if scene.has_self else 0)
    return simple and bodies > 1 and 0 < count <= _MOST_PAIRS


@cache
def _contact(shape: str, _: str | None) -> tuple[ca.Function, Compiling]:
    """Return the function that evaluates one pair, and its compilation, once for each compiler."""
    function = follow_function(shape)
    return function, Compiling(function)


def is_ready(shapes: Iterable[str]) -> bool:
    """Whether scenes of these shapes can be watched; always false if nothing can be compiled."""
    source = building(SOURCE)
    if not source.ask():
        for shape in shapes:
            _contact(shape, compiler())[1].ask()
    return source.library is not None


class _WatchedGroup:
    """The pairs of one shape, with bounds and contacts of the last evaluation."""

    def __init__(self, group: Group) -> None:
        function, compiling = _contact(group.shape, compiler())
        contact = Kernel(function, compiled=compiling)
        self._program = Program(SOURCE, "Pairs")
        self._program.set(
            is_self=int(group.is_self),
            next=_NEXT,
            contact=contact,
            ends=contact.inputs[0],
            pair=contact.inputs[1],
            found=contact.outputs[0],
        )
        self.data = self._program.data
        self.hold(group)

    def hold(self, group: Group) -> None:
        """Watch the pairs of `group`, of the same shape, in the place of those before."""
        count = len(group)
        self.group = group
        piece = np.zeros((count, WIDTH)) if group.is_self else group.scene.pieces.parameters[group.other]
        normal = np.tile([0.0, 0.0, 1.0], (count, 1))
        self._lower = group.distance.copy()
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
        )

    def address(self) -> int:
        """Return the address of the pairs for C; uses the kernels compiled meanwhile."""
        self._program.refresh()
        return self._program.address

    def keeps(self, floor: float) -> bool:
        """Return whether no distance in the present state is below `floor`, m."""
        return bool(self._lower.min(initial=np.inf) >= floor)

    def near(self, X: Array, limit: float, by_fcl: bool, wanted: Wanted | None) -> Found:
        """Return the `wanted` contacts nearer than `limit`, m, in the present state `X`."""
        contacts = self._contacts[: 2 * self.data.near]
        near = (contacts[:, 0] < limit).nonzero()[0]
        rows, contacts = self._rows.take(near >> 1), contacts.take(near, axis=0)
        if wanted is not None:
            kept = self.group.chosen(wanted, rows, contacts)
            rows, contacts = rows[kept], contacts[kept]
        return self.group.contacts(X, 0.0, rows, contacts, by_fcl)


class Watch:
    """Holds all pairs of a scene that :func:`can_be_watched`; one thread at a time."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._groups: list[_WatchedGroup] = []
        self._of_shape: dict[str, _WatchedGroup] = {}
        self._way: Program | None = None
        self._is_whole = True
        self._place: Array = np.zeros((0, 3))
        self._at = b""
        self._floors = self._limits = self._pairs = np.zeros(0)
        self._reach = self._wanted = (-np.inf, -np.inf)

    def forget_pieces(self) -> None:
        """Forget the pairs with pieces, because the pieces are others now; pairs of bodies are kept."""
        self._groups = [pairs for pairs in self._groups if pairs.group.is_self]
        self._is_whole, self._at, self._reach = False, b"", (-np.inf, -np.inf)

    def near(
        self,
        X: Array,
        limit: float,
        self_limit: float,
        *,
        by_fcl: bool = False,
        wanted: Wanted | None = None,
    ) -> Contacts | None:
        """Return the contacts nearer than `limit`, or `self_limit` between bodies, m; None where surfaces overlap.

        `X` (P, 3) are positions of the points; `by_fcl` says whether FCL supplies the contacts, `wanted`
        which pairs have any.
        """
        if limit > self._reach[0] or self_limit > self._reach[1] or not self._is_at(X):
            self._move_to(X, (limit, self_limit))
        self._wanted = _AHEAD * limit, _AHEAD * self_limit
        limits, near = (limit, self_limit), [pairs for pairs in self._groups if pairs.data.near]
        if any(pairs.data.overlaps for pairs in near):
            return None
        return self._scene.contacts(
            [pairs.near(X, limits[pairs.group.is_self], by_fcl, wanted) for pairs in near]
        )

    def keeps(self, X: Array, floor: float, self_floor: float) -> bool:
        """Return whether `X` is the present state, and no surface distance there is below its floor, m."""
        floors = floor, self_floor
        return self._is_at(X) and all(pairs.keeps(floors[pairs.group.is_self]) for pairs in self._groups)

    def follow(self, places: Array, floor: float, self_floor: float) -> bool:
        """Return whether no surface distance falls below its floor, m, on a path of straight pieces.

        False may also mean that this was not proven. The path leads from one of the `places` of the points
        (K + 1, P, 3), m, to the next. The last place reached becomes the present state.
        """
        reach = max(self._wanted[0], floor), max(self._wanted[1], self_floor)
        if not self._is_at(places[0]):
            self._move_to(places[0], reach)
        return self._go(places, (floor, self_floor), reach)

    def _is_at(self, X: Array) -> bool:
        """Return whether `X` (P, 3) are the positions of the present state."""
        return X.tobytes() == self._at

    def _move_to(self, X: Array, reach: tuple[float, float]) -> None:
        """Make `X` the present state, and evaluate the pairs that may be nearer than `reach`, m, there."""
        before = X if self._way is None else self._place
        self._go(np.stack([before, X]), (-np.inf, -np.inf), reach)

    def _go(self, places: Array, floors: tuple[float, float], reach: tuple[float, float]) -> bool:
        """Go from place to place as long as the floors, m, are proven, and return whether all are.

        The last place reached becomes the present state. At the last of `places` the pairs that may be nearer
        than `reach`, m, are evaluated.

        Raises
        ------
        GeometryError
            A position is not finite; the present state stays as it was.
        """
        way = self._start(places[0]) if self._way is None else self._way
        if not self._is_whole:
            self._hold([*map(self._watched, every_pair_with_pieces(self._scene, self._place)), *self._groups])
        places = np.ascontiguousarray(places)
        for k, pairs in enumerate(self._groups):
            self._pairs[k] = pairs.address()
            self._floors[k], self._limits[k] = floors[pairs.group.is_self], reach[pairs.group.is_self]
        way.set(pieces=len(places) - 1, places=places)
        code = _FollowCode(way.call("follow"))
        if code is _FollowCode.TOO_FAR:
            raise GeometryError("node positions must be finite numbers")
        if code is _FollowCode.NO_VALUE:
            self._way, self._at = None, b""
            raise EvaluationError("the distance of a pair has no value")
        done = way.data.done
        self._place = places[done]
        self._at = self._place.tobytes()
        self._reach = reach if done == len(places) - 1 else floors
        return code is _FollowCode.DONE

    def _start(self, X: Array) -> Program:
        """List all pairs, with their distances at `X`."""
        bodies, self._way = self._scene.bodies, Program(SOURCE, "Way")
        self._way.set(
            points=len(X),
            bodies=len(bodies),
            ends=np.ascontiguousarray(bodies.points, dtype=np.int32),
            furthest=FURTHEST,
            middle=np.zeros((len(bodies), 3)),
            turned=np.zeros(len(bodies)),
            moved=np.zeros(len(bodies)),
        )
        self._place = X.copy()
        self._hold(list(map(self._watched, every_pair(self._scene, X))))
        return self._way

    def _watched(self, group: Group) -> _WatchedGroup:
        """Return what watches the pairs of `group`; kernels of a shape are set up once."""
        known = self._of_shape.get(group.shape)
        if known is None:
            known = self._of_shape[group.shape] = _WatchedGroup(group)
        else:
            known.hold(group)
        return known

    def _hold(self, groups: list[_WatchedGroup]) -> None:
        """Watch the pairs of `groups`, whose distances are those at the present place."""
        assert self._way is not None
        count = len(groups)
        self._groups, self._is_whole = groups, True
        self._pairs = np.zeros(count, dtype=np.uintp)
        self._floors, self._limits = np.zeros(count), np.zeros(count)
        self._way.set(groups=count, group=self._pairs, floors=self._floors, limits=self._limits)
