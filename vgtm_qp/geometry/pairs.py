"""Reports about pairs: contacts with their witness points, and proofs between two states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.geometry.bodies import Bodies


class Pair(NamedTuple):
    """A body and a piece of an obstacle, or another body."""

    body: int
    other: int
    is_self: bool


@dataclass(frozen=True, eq=False)
class PairNames:
    """Names of bodies, and of the obstacle that each piece belongs to."""

    bodies: Bodies
    obstacles: tuple[str, ...]
    owner: tuple[int, ...]

    def clearance(self, pair: Pair) -> str:
        """Return the name of a clearance row: ``"clearance: member L3-2 / right cube"``."""
        return f"clearance: {self.called(pair)}"

    def called(self, pair: Pair) -> str:
        """Return the name of a pair: ``"member L3-2 / right cube"``."""
        other = self.bodies.called(pair.other) if pair.is_self else self.obstacles[self.owner[pair.other]]
        return f"{self.bodies.called(pair.body)} / {other}"

    def plain(self, pair: Pair) -> str:
        """Return the name of a pair as records have it, without kinds: ``"L3-2 / right cube"``."""
        names = self.bodies.names
        other = names[pair.other] if pair.is_self else self.obstacles[self.owner[pair.other]]
        return f"{names[pair.body]} / {other}"


@dataclass(frozen=True, eq=False)
class Contacts:
    """R pairs of witness points of near surfaces; a pair has two rows where its nearest points are not unique.

    The distance changes by ``normal . sum_k weights[k] d points[k]`` while obstacles rest.

    Attributes
    ----------
    distance : (R,)
        From surface to surface, m; negative where they intersect.
    normal : (R, 3)
        Unit, from the obstacle or other body to the body.
    points : (R, 4) int
        The points that span the body, then those of the other body, or the same again for an obstacle.
    weights : (R, 4)
        Of the velocities of `points` in the velocity of the body's witness point relative to the other
        witness point; the last two are zero for an obstacle.
    is_self : (R,) bool
        Whether the other is a body of the arm too.
    normal_speed : (R,)
        Velocity of the obstacle along `normal`, m/s.
    body, other : (R,) int
        `other` is a piece of an obstacle or, where ``is_self``, a body.
    by_fcl : (R,) bool
        True if FCL supplied the row, False if a closed form did.
    names : PairNames
        Names of bodies and obstacles, for :meth:`name`.
    """

    distance: Array
    normal: Array
    points: Index
    weights: Array
    is_self: Mask
    normal_speed: Array
    body: Index
    other: Index
    by_fcl: Mask
    names: PairNames

    def __len__(self) -> int:
        return len(self.distance)

    def name(self, k: int) -> str:
        """Return the name of row `k`: ``"clearance: member L3-2 / right cube"``."""
        return self.names.clearance(self.pair(k))

    def pair(self, k: int) -> Pair:
        """Return the pair of row `k`."""
        return Pair(int(self.body[k]), int(self.other[k]), bool(self.is_self[k]))


class Wanted(Protocol):
    """Says which pairs are wanted, from their distances."""

    def __call__(self, body: Index, other: Index, distance: Array, *, is_self: bool) -> Mask:
        """Return (R,) for pairs (R,), (R,) at surface distances (R,), m; all are of one kind."""
        ...


@dataclass(frozen=True, eq=False)
class BetweenReport:
    """The proof of a motion from one state to the next.

    Attributes
    ----------
    certified : bool
        No pair comes below the floor. False may also mean that the proof was not found.
    clearance : float
        Proven lower bound of the surface distances over the motion; the least distance found where not certified.
    fraction : (F,)
        For each failing pair the place on the motion (0 < s <= 1) of the least distance found.
    failing : Contacts
        The failing pairs there, one row each.
    """

    certified: bool
    clearance: float
    fraction: Array
    failing: Contacts

    def failing_parameters(self, apart: float = 0.05) -> list[float]:
        """Return the fractions, worst pair first, except those nearer than `apart` to a worse one."""
        chosen: list[float] = []
        for k in np.argsort(self.failing.distance, kind="stable"):
            s = float(self.fraction[k])
            if all(abs(s - c) > apart for c in chosen):
                chosen.append(s)
        return chosen
