"""The target of one step, and the input of its QP."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from vgtm_qp.arm.arm import Arm, Pose
from vgtm_qp.arrays import Array
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.linearise import StepInput
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.path import Path


@dataclass(frozen=True, eq=False)
class Target:
    """The target of one step: a piece of a path, the time at its end and the base's pose then.

    Attributes
    ----------
    path, start, end
        The path, and its values between which the step moves; progress alpha runs from 0 to 1 over them.
    lower, upper : (n_a,)
        Values of the actuators allowed at the end of the step.
    time, duration : float
        Time at the end of the step, and its duration, s: a difference of times would lack digits.
    base : Pose or None
        Pose of the base at the end of the step; None if the base is at rest.
    vertex_goals : (V, 3) or None
        Goals of control vertices, m; only the rows of ``Layout.vertex_goals`` are used.
    """

    path: Path
    start: float
    end: float
    lower: Array
    upper: Array
    time: float
    duration: float
    base: Pose | None = None
    vertex_goals: Array | None = None

    def goal(self, progress: float) -> TipGoal:
        """Return the tip's goal at a progress of 0 to 1."""
        return self.path.at(self.reached(progress))

    def reached(self, progress: float) -> float:
        """Return the path's value at a progress of 0 to 1."""
        return self.start + progress * (self.end - self.start)

    def part(self, share: float) -> Target:
        """Return the target of the first `share` of the piece, in the same time and with the same limits."""
        return replace(self, end=self.reached(share))


class QPInput(NamedTuple):
    """The point at which the QP of a step is linearised, and its target.

    Residuals are evaluated at `q`, Jacobians at `at`, which is `q` in a correction. The curve is (V, 3), m,
    and (T,), rad. The `goal` is that of the target at the tip's `progress`, 0 to 1. A QP of `motion` moves
    the arm; a correction returns to the constraints by the least displacement.
    """

    q: Array
    at: Array
    vertices: Array
    torsion: Array
    target: Target
    goal: TipGoal
    progress: float
    rows: ClearanceRows
    motion: bool

    def linear(self, layout: Layout, *, rows: bool = True, nodes: bool = True) -> StepInput:
        """Return this input for a QP of `layout`; without `rows`, the rows of a general curve are zeros.

        Without its `nodes` too, it has none of them: compiled code computes both.
        """
        arm, target, shape, curve = layout.arm, self.target, layout.general, None
        begin = base_frame(arm, target.base) if len(arm.stations) else np.eye(3)
        if shape is not None and nodes:
            at = self.vertices, self.torsion, begin
            curve = shape.rows(*at) if rows else shape.at(*at)
        places = arm.nodes(self.q)
        return StepInput(
            q=self.q,
            at=self.at,
            base=places if target.base is None else arm.nodes(arm.based(self.q, target.base)),
            vertices=self.vertices,
            lower=target.lower,
            upper=target.upper,
            motion=self.motion,
            progress=self.progress,
            goal=self.goal.over(target.end - target.start),
            curve=curve,
            vertex_goals=target.vertex_goals,
            torsion=self.torsion,
            base_frame=begin,
        )


def base_frame(arm: Arm, pose: Pose | None) -> Array:
    """Return (3, 3) the frame of the first station with the base at `pose`, or at home."""
    home = arm.stations.frames[0]
    return home if pose is None else np.asarray(pose.rotation @ home)
