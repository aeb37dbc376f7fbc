"""The bodies of an arm, and what it carries: capsules, each spanned by two points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.arrays import Array, Index, Mask


@dataclass(frozen=True, eq=False)
class Bodies:
    """B capsules between points of an arm; make them by :func:`capsules`.

    Attributes
    ----------
    points : (B, 2) int
        The two points that span each capsule: rows of the positions (P, 3).
    radius : (B,)
        m.
    joints : (B, 2) int
        The joints at the two ends. Two bodies with a joint in common are neighbours, and may touch.
    names : tuple of str
    kind : str
        Word for such a body in names, as in ``"member L3-2"``.
    touching : (K, 2) int
        Further pairs that may touch.
    carried : int
        Number of the last ones that belong to what the arm carries.
    """

    points: Index
    radius: Array
    joints: Index
    names: tuple[str, ...]
    kind: str
    touching: Index = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    carried: int = 0

    def __len__(self) -> int:
        return len(self.points)

    def may_touch(self, first: Index, second: Index) -> Mask:
        """Return (P,) which pairs of bodies are neighbours or :attr:`touching`."""
        a, b = self.joints[first], self.joints[second]
        allowed = (a[:, :, None] == b[:, None, :]).any(axis=(1, 2))
        if len(self.touching):
            count = len(self)
            pairs = np.minimum(first, second) * count + np.maximum(first, second)
            allowed |= np.isin(pairs, self.touching.min(axis=1) * count + self.touching.max(axis=1))
        return np.asarray(allowed)

    def called(self, body: int) -> str:
        """Return kind and name of a body: ``"member L3-2"``, ``"carried crate"``."""
        kind = self.kind if body < len(self) - self.carried else "carried"
        return f"{kind} {self.names[body]}"


def capsules(
    points: ArrayLike,
    radius: ArrayLike,
    names: Sequence[str] | None = None,
    *,
    joints: ArrayLike | None = None,
    kind: str = "member",
) -> Bodies:
    """Return capsules (B) between `points` (B, 2).

    The radius, m, may be one for all. Names are by default ``"0"``, ``"1"``..., and the joints (B, 2) the points:
    bodies that share a point are neighbours.
    """
    span = np.asarray(points, dtype=np.int64).reshape(-1, 2)
    return Bodies(
        points=span,
        radius=np.broadcast_to(np.asarray(radius, dtype=float), len(span)).copy(),
        joints=span if joints is None else np.asarray(joints, dtype=np.int64).reshape(-1, 2),
        names=tuple(map(str, range(len(span)))) if names is None else tuple(names),
        kind=kind,
    )
