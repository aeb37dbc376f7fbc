"""What is reported about pairs: near ones with their witness points, and proofs between two states."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

_COLUMNS = ("member", "other", "is_self", "distance", "normal", "t", "t_other", "normal_speed", "point")


class Pair(NamedTuple):
    """A member and a piece of an obstacle, or another member."""

    member: int
    other: int
    is_self: bool


@dataclass(frozen=True)
class Names:
    """Names of members and of the obstacle that each piece belongs to."""

    members: tuple[str, ...]
    obstacles: tuple[str, ...]
    owner: tuple[int, ...]

    def clearance(self, pair: Pair) -> str:
        """Return the name of a clearance row."""
        other = (
            f"member {self.members[pair.other]}" if pair.is_self else self.obstacles[self.owner[pair.other]]
        )
        return f"clearance: member {self.members[pair.member]} / {other}"


@dataclass(frozen=True, eq=False)
class NearPairs:
    """K near pairs of surfaces.

    Attributes
    ----------
    member : (K,) int
    other : (K,) int
        Piece index, or the other member.
    is_self : (K,) bool
    distance : (K,)
        From surface to surface, m; negative where they intersect.
    normal : (K, 3)
        Unit, from the obstacle or other member to the member: the gradient of `distance` with respect to the
        witness point.
    t, t_other : (K,)
        Parameters of the witness points on the member and, for self pairs, on the other member (else 0).
    normal_speed : (K,)
        Velocity of the obstacle along `normal`, m/s.
    point : (K, 3)
        Witness point on the piece, or on the other member's axis, m.
    names : Names
        What :meth:`name` reads.
    """

    member: Index
    other: Index
    is_self: Mask
    distance: Array
    normal: Array
    t: Array
    t_other: Array
    normal_speed: Array
    point: Array
    names: Names

    def __len__(self) -> int:
        return len(self.member)

    def name(self, k: int) -> str:
        """Return the name of row `k`: ``"clearance: member L3-2 / right cube"``."""
        return self.names.clearance(self.pair(k))

    def pair(self, k: int) -> Pair:
        """Return which pair row `k` is about."""
        return Pair(int(self.member[k]), int(self.other[k]), bool(self.is_self[k]))

    def select(self, rows: Index | Mask) -> NearPairs:
        """Return some of the rows."""
        return NearPairs(**{key: getattr(self, key)[rows] for key in _COLUMNS}, names=self.names)


def join(parts: list[NearPairs], names: Names) -> NearPairs:
    """Return all rows of `parts`."""
    if len(parts) == 1:
        return parts[0]
    if not parts:
        none, index, rows = np.zeros(0), np.zeros(0, dtype=np.int64), np.zeros((0, 3))
        return NearPairs(index, index, np.zeros(0, dtype=bool), none, rows, none, none, none, rows, names)
    columns = {key: np.concatenate([getattr(part, key) for part in parts]) for key in _COLUMNS}
    return NearPairs(**columns, names=names)


@dataclass(frozen=True, eq=False)
class BetweenReport:
    """What was proven about a motion from one state to the next.

    Attributes
    ----------
    certified : bool
        No pair comes below the floor. False may also mean that the proof was not found.
    clearance : float
        Proven lower bound of the surface distances over the motion; the least distance found where not
        certified.
    fraction : (F,)
        For each failing pair, where on the motion (0 < s <= 1) the least distance was found.
    failing : NearPairs
        The failing pairs there, one row each.
    """

    certified: bool
    clearance: float
    fraction: Array
    failing: NearPairs

    def failing_parameters(self, apart: float = 0.05) -> list[float]:
        """Return the fractions, worst pair first, without those nearer than `apart` to a worse one."""
        chosen: list[float] = []
        for k in np.argsort(self.failing.distance, kind="stable"):
            s = float(self.fraction[k])
            if all(abs(s - c) > apart for c in chosen):
                chosen.append(s)
        return chosen


def certified(clearance: float, names: Names) -> BetweenReport:
    """Return the report of a motion over which no pair comes nearer than `clearance`, m."""
    return BetweenReport(True, clearance, np.zeros(0), join([], names))
