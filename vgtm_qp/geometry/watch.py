"""All pairs of a scene at rest, evaluated only when they may have come near.

Each pair keeps a lower bound of its distance: its distance at the last evaluation, less a bound of the approach of its
bodies since. A distance from an obstacle changes by no more than an end of the body moves. That of two bodies changes
by no more than their middles do, and both turn about those. If the bound falls below the limit, the pair is evaluated,
and its distance on the way from the state before is bounded: ``watch.c``.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.compiled import Compiling, Kernel, compiler
from vgtm_qp.errors import EvaluationError
from vgtm_qp.geometry.candidates import every_pair
from vgtm_qp.geometry.exact import CONTACT, WIDTH, follow_function
from vgtm_qp.geometry.formulas import FURTHEST
from vgtm_qp.geometry.groups import Found, Group, Scene
from vgtm_qp.geometry.pairs import Contacts
from vgtm_qp.geometry.shapes import GeometryError
from vgtm_qp.native import Program, building

SOURCE = Path(__file__).with_name("watch.c")

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


@cache
def _contact(shape: str, _: str | None) -> tuple[ca.Function, Compiling]:
    """Return the function that evaluates one pair, and what compiles it, once for all scenes and each compiler."""
    function = follow_function(shape)
    return function, Compiling(function)


def is_ready(shapes: Iterable[str]) -> bool:
    """Whether scenes of these shapes can be watched: false for ever where nothing can be compiled."""
    source = building(SOURCE)
    if not source.ask():
        for shape in shapes:
            _contact(shape, compiler())[1].ask()
    return source.library is not None


class _WatchedGroup:
    """The pairs of one shape, with bounds and contacts of the last evaluation."""

    def __init__(self, group: Group, places: Array, motion: dict[str, Array]) -> None:
        count, points = len(group), len(places) // 2
        self.group = group
        piece = np.zeros((count, WIDTH)) if group.is_self else group.scene.pieces.parameters[group.other]
        normal = np.tile([0.0, 0.0, 1.0], (count, 1))
        function, compiling = _contact(group.shape, compiler())
        contact = Kernel(function, compiled=compiling)
        self._rows, self._contacts = np.zeros(count, dtype=np.int64), np.zeros((2 * count, CONTACT))
        self._program = Program(SOURCE, "Pairs")
        self._program.set(
            count=count,
            is_self=int(group.is_self),
            body=group.body.astype(np.int32),
            other=group.other.astype(np.int32),
            points=np.ascontiguousarray(group.points, dtype=np.int32),
            before=places[:points],
            after=places[points:],
            lower=group.distance.copy(),
            known=np.concatenate([piece, group.radius[:, None], normal], axis=1),
            next=_NEXT,
            contact=contact,
            ends=contact.inputs[0],
            pair=contact.inputs[1],
            found=contact.outputs[0],
            rows=self._rows,
            contacts=self._contacts,
            **motion,
        )
        self.data = self._program.data

    def evaluate(self, limit: float) -> None:
        """Evaluate the pairs that may be nearer than `limit`, m, in the present state."""
        self.data.limit = limit
        if self._program.call("evaluate"):
            raise EvaluationError(f"the distance of a {self.group.shape} has no value")

    def near(self, X: Array, limit: float, by_fcl: bool) -> Found:
        """Return the contacts nearer than `limit`, m, in the present state `X`."""
        contacts = self._contacts[: 2 * self.data.near]
        rows = (contacts[:, 0] < limit).nonzero()[0]
        return self.group.contacts(X, 0.0, self._rows.take(rows >> 1), contacts.take(rows, axis=0), by_fcl)


class Watch:
    """Keeps all pairs of a scene that :func:`can_be_watched`; one thread at a time."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._groups: list[_WatchedGroup] = []
        self._motion: Program | None = None
        self._at, self._places = b"", np.zeros((0, 3))
        self._limits = self._wanted = (-np.inf, -np.inf)

    def near(self, X: Array, limit: float, self_limit: float, *, by_fcl: bool = False) -> Contacts | None:
        """Return all contacts nearer than `limit`, or `self_limit` between bodies, m; None where surfaces overlap.

        `X` (P, 3) are positions of the points; `by_fcl` says whether FCL supplies the contacts.
        """
        if limit > self._limits[0] or self_limit > self._limits[1] or not self._is_at(X):
            self._move_to(X, (limit, self_limit))
        self._wanted = _AHEAD * limit, _AHEAD * self_limit
        limits, near = (limit, self_limit), [pairs for pairs in self._groups if pairs.data.near]
        if any(pairs.data.overlaps for pairs in near):
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
        return all(
            pairs.data.lowest >= (self_floor if pairs.group.is_self else floor) for pairs in self._groups
        )

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
        motion = self._start(X) if self._motion is None else self._motion
        self._places[len(X) :] = X
        motion.call("follow")
        if not motion.data.square < FURTHEST:
            raise GeometryError("node positions must be finite numbers")
        self._at, self._motion = b"", None
        for pairs in self._groups:
            pairs.evaluate(limits[pairs.group.is_self])
        self._motion = motion
        self._places[: len(X)] = X
        self._at, self._limits = X.tobytes(), limits

    def _start(self, X: Array) -> Program:
        """List all pairs, with their distances at `X`."""
        bodies, groups = len(self._scene.bodies), every_pair(self._scene, X)
        self._places, motion = np.concatenate([X, X]), Program(SOURCE, "Motion")
        found = {"middle": np.zeros((bodies, 3)), "turned": np.zeros(bodies), "furthest": np.zeros(bodies)}
        motion.set(
            points=len(X),
            bodies=bodies,
            ends=np.ascontiguousarray(self._scene.bodies.points, dtype=np.int32),
            before=self._places[: len(X)],
            after=self._places[len(X) :],
            **found,
        )
        self._groups = [_WatchedGroup(group, self._places, found) for group in groups]
        return motion
