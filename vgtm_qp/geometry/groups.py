"""Pairs of one shape as arrays: exact contacts, and lower bounds of distances that shrink as the bodies move."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np

from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.geometry.batch import Batch
from vgtm_qp.geometry.bodies import Bodies
from vgtm_qp.geometry.exact import (
    CONTACT,
    NORMAL,
    NORMAL_FROM,
    PROOF,
    distance_function,
    proof_function,
    sweep_function,
    width,
)
from vgtm_qp.geometry.fcl_queries import FclQueries
from vgtm_qp.geometry.pairs import Contacts, PairNames, Wanted
from vgtm_qp.geometry.searching import Search, is_ready
from vgtm_qp.geometry.shapes import Obstacle, ObstaclePieces

Found = tuple[Index, Array]
"""The ``Group.numbers`` (R, 2 E + 4) of pairs, and their contacts (R, 2 E + 5), see :class:`Scene`."""

Lowered = Mapping[tuple[int, int, bool], float]
"""Floors of some pairs, m: by body, obstacle or other body, and whether it is a body."""

_FIRST = 16
"""Number of pairs, nearest at the reference, that are searched first for the least distance."""

_CONTACTS = 3
"""Greatest number of contacts of a pair with a hull, which may lie flat on something."""

_RELATIVE = 0.5 * np.array([[1.0, 1.0, -1.0, -1.0], [-1.0, 1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0]])
"""Takes displacements of the four ends of two bodies to the relative displacement of their middles, and to half the
difference of the ends of each body.
"""


class Scene:
    """Bodies of an arm and obstacles, with the functions that evaluate pairs of them.

    Attributes
    ----------
    has_self : bool
        Whether pairs of bodies that are not neighbours count.
    unit : float
        Unit of length of the tolerances of FCL's answers, m.
    fcl, of_hulls : FclQueries or None
        Supplies contacts, and those of hulls, which have no closed form; None where these are not used.
    nothing, nothing_found : Contacts, (0, 2 E + 5)
        No rows, and no contacts.
    shapes : list of str
        Shapes of the others in the pairs; ``"segment"`` is a body.
    span, size, each : int
        Number E of points that span a body; numbers of a contact, which has 2 E weights in the place of the four of
        ``exact``; greatest number of contacts of a pair.
    """

    def __init__(
        self, bodies: Bodies, obstacles: Sequence[Obstacle], has_self: bool, by_fcl: bool, unit: float
    ) -> None:
        self.bodies, self.has_self, self.unit = bodies, has_self, unit
        self._by_fcl = by_fcl
        self._batches: dict[tuple[Callable[[str], ca.Function], str], Batch] = {}
        self._searches: dict[str, Search] = {}
        self.put(obstacles)

    def put(self, obstacles: Sequence[Obstacle], bodies: Bodies | None = None) -> None:
        """Put `obstacles` in the place of those that were there, and make the functions that steps use for them.

        Groups of pairs with obstacles that were made before are of no use afterwards; those of bodies are, unless there
        are other `bodies` now.
        """
        if bodies is not None:
            self.bodies, self._searches = bodies, {}
        self.span = self.bodies.points.shape[1]
        self.size, self.each = 2 * self.span + 5, _CONTACTS if self.bodies.hulls else 2
        self.obstacles = tuple(obstacles)
        self.pieces = ObstaclePieces(self.obstacles)
        names = tuple(obstacle.name for obstacle in self.obstacles)
        self.names = PairNames(self.bodies, names, tuple(self.pieces.obstacle.tolist()))
        queries = (
            FclQueries(self.pieces, self.bodies, self.unit) if self._by_fcl or self.bodies.hulls else None
        )
        self.fcl, self.of_hulls = queries if self._by_fcl else None, queries
        self.nothing_found = np.zeros((0, self.size))
        self.nothing = self._contacts(np.zeros((0, 2 * self.span + 4), dtype=np.int64), self.nothing_found)
        self.shapes = [*np.unique(self.pieces.shape).tolist(), *(["segment"] if self.has_self else [])]
        for make in (distance_function, sweep_function, *((proof_function,) if self.fcl else ())):
            for shape in self.shapes:
                self.batch(make, shape)

    @property
    def has_pairs(self) -> bool:
        """Whether two bodies, or a body and an obstacle, can ever be near."""
        count = len(self.bodies)
        return bool(count and len(self.pieces)) or (self.has_self and count > 1)

    def contacts(self, parts: Sequence[Found]) -> Contacts:
        """Return the contacts of all `parts`, one part after the other."""
        if not parts:
            return self.nothing
        if len(parts) == 1:
            return self._contacts(*parts[0])
        return self._contacts(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _contacts(self, numbers: Index, found: Array) -> Contacts:
        normal, other, is_self = found[:, NORMAL], numbers[:, -3], numbers[:, -2] > 0
        speed = np.zeros(len(found))
        if self.pieces.moving:
            piece = ~is_self
            speed[piece] = np.einsum("kc,kc->k", normal[piece], self.pieces.velocity[other[piece]])
        return Contacts(
            distance=found[:, 0],
            normal=normal,
            points=numbers[:, :-4],
            weights=found[:, 1:-4],
            is_self=is_self,
            normal_speed=speed,
            body=numbers[:, -4],
            other=other,
            by_fcl=numbers[:, -1] > 0,
            names=self.names,
        )

    def widened(self, found: Array) -> Array:
        """Return contacts (..., ``CONTACT``) of capsules with 2 E weights (..., 2 E + 5)."""
        if self.size == CONTACT:
            return found
        wide = np.zeros((*found.shape[:-1], self.size))
        wide[..., :3], wide[..., NORMAL.start :] = found[..., :3], found[..., NORMAL.start :]
        wide[..., 1 + self.span : 3 + self.span] = found[..., 3:5]
        return wide

    def batch(self, make: Callable[[str], ca.Function], shape: str) -> Batch:
        """Return a function of :mod:`vgtm_qp.geometry.exact` for many pairs of a shape, made when first needed."""
        if (make, shape) not in self._batches:
            self._batches[make, shape] = Batch(make(shape))
        return self._batches[make, shape]

    def is_ready(self) -> bool:
        """Whether C is there for the pairs of the scene; always false if nothing can be compiled."""
        return is_ready(self.shapes, has_hulls=bool(self.bodies.hulls))

    def search(self, shape: str) -> Search | None:
        """Return C's search for the nearest points of pairs of a shape with hulls, once it is there."""
        if shape not in self._searches and self.is_ready():
            self._searches[shape] = Search(self.bodies, self.unit, shape)
        return self._searches.get(shape)


class Displacement(NamedTuple):
    """Displacements of the points that span bodies from a reference, in one state or on the path between two.

    Attributes
    ----------
    states, reference : tuple of (P, 3), (P, 3)
        Positions of one state, or at both ends of the path, m; and those of the reference.
    moved : (P,)
        Greatest distance of each point from its reference, m.
    greatest : float
        Greatest change of the distance of a pair since the reference, m.
    elapsed : float
        Time since the reference, s, in which obstacles move.
    """

    states: tuple[Array, ...]
    reference: Array
    moved: Array
    greatest: float
    elapsed: float


class Group:
    """Pairs of one shape: bodies against pieces, or against bodies for ``"segment"``.

    Attributes
    ----------
    body, other : (C,) int
        `other` is a piece or, for ``"segment"``, a body.
    points : (C, 2 E) int
        The points that span `body`, then those of `other`, or the same again for a piece.
    numbers : (C, 2 E + 4) int
        `points`, `body`, `other`, `is_self`, and 0; the last is 1 for a contact that FCL supplied.
    radius : (C,)
        Of the body less the obstacle's allowance, or the sum of both radii, m.
    distance : (C,)
        Surface distance at the reference configuration, m, ascending once :meth:`keep_near` was called.
    is_self, moving : bool
        True for pairs of bodies; True for pairs with obstacles if an obstacle moves.
    place : int
        Index of their list in :class:`vgtm_qp.geometry.candidates.Candidates`.
    own : int
        How many of the numbers that :meth:`at` gives for a pair are the points of its body.
    at_once : int
        Number of intervals of a motion up to which one more costs nothing.
    """

    own = 6
    at_once = 16

    def __init__(self, scene: Scene, shape: str, body: Index, other: Index, *, place: int = 0) -> None:
        self.scene, self.shape, self.place = scene, shape, place
        self.is_self = shape == "segment"
        self.moving = scene.pieces.moving and not self.is_self
        self._distances = scene.batch(distance_function, shape)
        self._ends = [0, 1, scene.span, scene.span + 1]
        self._set(body, other, np.zeros(len(body)))

    def _set(self, body: Index, other: Index, distance: Array) -> None:
        bodies = self.scene.bodies
        self.distance, self.radius = distance, bodies.radius[body]
        if self.is_self:
            self.radius = self.radius + bodies.radius[other]
        else:
            self.radius = self.radius - self.scene.pieces.allowance[other]
        span = bodies.points.shape[1]
        self.numbers = np.zeros((len(body), 2 * span + 4), dtype=np.int64)
        self.points, self.body, self.other = self.numbers[:, :-4], self.numbers[:, -4], self.numbers[:, -3]
        self.points[:, :span] = bodies.points[body]
        self.points[:, span:] = bodies.points[other] if self.is_self else self.points[:, :span]
        self.body[:], self.other[:], self.numbers[:, -2] = body, other, self.is_self

    def __len__(self) -> int:
        return len(self.body)

    def keep_near(self, X: Array, time: float, horizon: float) -> None:
        """Make `X` the reference: drop the pairs at `horizon` or further and sort the others by distance."""
        distance = self.distances(X, time, np.arange(len(self)))
        order = np.argsort(distance, kind="stable")
        order = order[: np.searchsorted(distance[order], horizon)]
        self._set(self.body[order], self.other[order], distance[order])

    def select(self, kept: Mask) -> None:
        """Drop the pairs that are not `kept`, (C,)."""
        self._set(self.body[kept], self.other[kept], self.distance[kept])

    def lower(self, motion: Sequence[Displacement], limit: float) -> tuple[Array, float]:
        """Return lower bounds of the surface distances of the first pairs, and one bound of all others, m.

        The other pairs cannot have come nearer than `limit`, m. `motion` holds the displacement of each list.
        """
        displacement = motion[self.place]
        # The motion can matter only near the head of the sorted list.
        count = int(np.searchsorted(self.distance, limit + displacement.greatest))
        bound = self.distance[:count]
        if count and self.is_self:
            bound = bound - self._nearer(displacement, count)
        elif count:
            bound = bound - displacement.moved.take(self.points[:count, : self.scene.span]).max(axis=1)
            if self.moving:
                bound -= self.scene.pieces.speed[self.other[:count]] * displacement.elapsed
        return bound, float(self.distance[count] - displacement.greatest) if count < len(self) else np.inf

    def _nearer(self, displacement: Displacement, count: int) -> Array:
        """Return (count,) bounds of how much nearer the first pairs of bodies came, m.

        A bound is the relative displacement of the two middles plus the turns of both bodies about their
        middles. On a straight path it is greatest at an end.
        """
        points = self.points[:count]
        reference = displacement.reference.take(points, axis=0)
        shifts = [state.take(points, axis=0) - reference for state in displacement.states]
        if self.scene.span > 2:
            return np.asarray(np.max([_apart(shift) for shift in shifts], axis=0))
        # The same for two points a body, at a quarter of the cost.
        vectors = (_RELATIVE @ shift for shift in shifts)
        return np.asarray(
            np.max([np.sqrt(np.einsum("ksc,ksc->ks", v, v)).sum(axis=1) for v in vectors], axis=0)
        )

    def at(self, X: Array, time: float, rows: Index) -> Array:
        """Return some pairs as the functions of :mod:`vgtm_qp.geometry.exact` take them, (k, 7 + width)."""
        numbers = self.numbers.take(rows, axis=0)
        pairs = np.empty((len(rows), 7 + width(self.shape)))
        pairs[:, :12] = X.take(numbers[:, self._ends], axis=0).reshape(-1, 12)
        pairs[:, -1] = self.radius.take(rows)
        if not self.is_self:
            pairs[:, 6:-1] = self.scene.pieces.at(time).take(numbers[:, -3], axis=0)
        return pairs

    def evaluate(self, pairs: Array) -> Array:
        """Return two contacts (k, 2, 2 E + 5) for each of `pairs`, as given by :meth:`at`."""
        return self.scene.widened(self._distances(pairs).reshape(len(pairs), 2, CONTACT))

    def sweep(self, start: Array, end: Array) -> Array:
        """Return ``sweep_function`` (k, 3) of pairs, as given by :meth:`at`, that move from `start` to `end`."""
        return self.scene.batch(sweep_function, self.shape)(start, end)

    def distances(self, X: Array, time: float, rows: Index, enough: float = np.inf) -> Array:  # noqa: ARG002
        """Return exact surface distances (k,) of some pairs, m."""
        return self._distances(self.at(X, time, rows))[:, 0]

    def nearest(
        self, motion: Sequence[Displacement], X: Array, time: float, best: float
    ) -> tuple[float, int, int]:
        """Return the least clearance below `best`, m, its row, and a count of evaluated pairs.

        The row is -1 if no clearance is below `best`. The first few pairs do not count.
        """
        # The nearest pairs at the reference are probably the nearest still; they make `best` small for the others.
        rows, row = np.arange(min(len(self), _FIRST)), -1
        for first in (True, False):
            if len(rows):
                distance = np.maximum(self.distances(X, time, rows), self._deepest(rows))
                k = int(np.argmin(distance))
                if distance[k] < best:
                    best, row = float(distance[k]), int(rows[k])
            if first:
                rows = np.flatnonzero(self.lower(motion, best)[0] < best)
                rows = rows[rows >= _FIRST]
        return best, row, len(rows)

    def _deepest(self, rows: Index) -> Array:
        """Return (R,) bounds that clearances are never below, m."""
        return np.asarray(-self.radius[rows])

    def chosen(self, by: Wanted, rows: Index, found: Array) -> Mask:
        """Return which of the contacts `found` (R, 2 E + 5) of the pairs `rows` are wanted."""
        return by(self.body[rows], self.other[rows], found[:, 0], is_self=self.is_self)

    def floors(self, rows: Index, floor: float, lowered: Lowered) -> Array:
        """Return the floor (R,) of each of the pairs `rows`: `floor`, m, or that in `lowered`."""
        floors = np.full(len(rows), floor)
        body, other = self.body[rows], self.other[rows]
        if not self.is_self:
            other = self.scene.pieces.obstacle[other]
        for (first, second, is_self), least in lowered.items():
            if is_self == self.is_self:
                same = (body == first) & (other == second)
                floors[same | (body == second) & (other == first) if is_self else same] = least
        return floors

    def distinct(self, rows: Index, found: Array) -> Index:
        """Return the nearest of contacts of `rows` with the same body, mesh, normal and place on the body."""
        order = np.argsort(found[:, 0], kind="stable")
        bodies, meshes = self.body[rows], self.scene.pieces.obstacle[self.other[rows]]
        normal, place = np.round(2.0 * found[:, NORMAL]), np.round(4.0 * found[:, 2 : self.scene.span + 1])
        like = np.column_stack([bodies, meshes, normal, place])
        return order[np.sort(np.unique(like[order], axis=0, return_index=True)[1])]

    def contacts(self, X: Array, time: float, rows: Index, found: Array, by_fcl: bool) -> Found:
        """Return the contacts `found` (R, 2 E + 5) of the pairs `rows`; if `by_fcl`, FCL's overwrite them in place.

        For a pair with two contacts FCL is given the two points of the body. A contact stays as it was found if the
        axes touch or FCL's answer is not proven, see ``proof_function``.
        """
        numbers, fcl = self.numbers.take(rows, axis=0), self.scene.fcl
        if fcl is None or not by_fcl or not len(rows):
            return numbers, found
        pairs, of_two = self.at(X, time, rows), (found[:, -1] == 0.0).nonzero()[0]
        if len(of_two):
            ends, t = pairs[of_two, :6], found[of_two, 2, None]
            pairs[of_two, :6] = np.tile((1.0 - t) * ends[:, :3] + t * ends[:, 3:], 2)
        answers = fcl.answers(pairs, None if self.is_self else numbers[:, -3].tolist(), time)
        proven = self.scene.batch(proof_function, self.shape)(pairs, answers)
        proven[of_two, 1:3] = found[of_two, 1:3]
        # NaN fails the comparisons.
        unit, gap = self.scene.unit, proven[:, 0] + pairs[:, -1]
        holds = (proven[:, -1] <= PROOF * unit) & (gap > NORMAL_FROM * unit)
        fcl.refused += len(rows) - int(np.count_nonzero(holds))
        np.copyto(found[:, :-1], self.scene.widened(proven)[:, :-1], where=holds[:, None])
        numbers[:, -1] = holds
        return numbers, found


def _apart(shift: Array) -> Array:
    """Return (C,) bounds of how much nearer two bodies came, from displacements (C, 2 E, 3) of their points, m."""
    both = shift.reshape(len(shift), 2, -1, 3)
    middle = both.mean(axis=2)
    turned = np.linalg.norm(both - middle[:, :, None], axis=3).max(axis=2).sum(axis=1)
    return np.asarray(np.linalg.norm(middle[:, 0] - middle[:, 1], axis=1) + turned)
