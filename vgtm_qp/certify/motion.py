"""Where the bodies of an arm are at every instant of a trajectory, and how much their paths bend."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.certify.verdict import Finding
from vgtm_qp.result.chain import RecordedChain
from vgtm_qp.result.poses import base_poses
from vgtm_qp.verify.arm import AnyRecordedArm
from vgtm_qp.verify.clearance import RecordedMotion


class GivenMotion(RecordedMotion):
    """A motion in S segments, one from each of its S + 1 states to the next.

    Attributes
    ----------
    bends : (S, B)
        Bounds of |d2 r / d share2| of any point of the bodies in each segment, m; infinite if unknown.
    rounding : float
        Bound of the rounding error of a distance, m.
    """

    bends: Array

    def __init__(self, arm: AnyRecordedArm, time: Array, states: Array) -> None:
        super().__init__(arm, time, states)
        steps = 64.0 + 16.0 * len(arm.quantity_names)
        self.rounding = steps * float(np.finfo(float).eps) * self.furthest

    @abstractmethod
    def ends_at(self, segment: Index, share: Array) -> Array:
        """Return (U, B, 2, 3) the ends of the bodies, m, at shares (U,) of segments (U,)."""

    def doubts(self) -> Iterator[Finding]:
        """Yield where the bodies asked for were not found; by default nowhere."""
        yield from ()

    def times_at(self, segment: Index, share: Array) -> Array:
        """Return (U,) the times, s, at shares (U,) of segments (U,)."""
        return np.asarray((1.0 - share) * self.time[segment] + share * self.time[segment + 1])


class JointMotion(GivenMotion):
    """A serial arm whose joints move linearly between rows, on the base that the problem moves."""

    def __init__(self, arm: RecordedChain, time: Array, joints: Array, problem: Mapping[str, Any]) -> None:
        self._problem = problem
        self._base_moves = bool((problem.get("arm") or {}).get("base_motion"))
        super().__init__(arm, time, np.concatenate([joints, base_poses(problem, time)], axis=1))
        self.bends = arm.bend(self.states[:-1], self.states[1:], np.arange(len(arm.member_names)))
        turned = float(np.abs(joints).max(initial=0.0)) * float(np.finfo(float).eps)
        self.rounding += turned * len(arm.quantity_names) * self.furthest

    def ends_at(self, segment: Index, share: Array) -> Array:
        """Return the ends; the base is where the problem has it at that time, not on the chord between two rows."""
        before, after = self.states[segment], self.states[segment + 1]
        q = before + share[:, None] * (after - before)
        if self._base_moves:
            q[:, -6:] = base_poses(self._problem, self.times_at(segment, share))
        return self.arm.states_ends(q)
