"""What the page shows of a session at one moment."""

from __future__ import annotations

from typing import NamedTuple

from vgtm_qp.arrays import Array
from vgtm_qp.step.step import StepStatus

OUTCOMES = {StepStatus.REACHED: "moving", StepStatus.SLOWED: "slowed", StepStatus.BLOCKED: "blocked"}


class TooNear(NamedTuple):
    """A pair that is nearer than it should be: its name, its distance, and the `least` that is kept, m."""

    name: str
    distance: float
    least: float


class Hold(NamedTuple):
    """The pair that holds the arm back.

    Its name; the bodies of the arm in it, by index; the obstacle in it, empty for two bodies; and the points (2, 3), m,
    of the first body's axis and of the other's surface between which the `distance`, m, is least.
    """

    name: str
    distance: float
    bodies: tuple[int, ...]
    obstacle: str
    line: Array


class Reading(NamedTuple):
    """What the page shows: one of `OUTCOMES`, ``"at rest"`` or ``"stopped"``, and what holds the arm back.

    The rows that hold it come with the most decisive first, and with a sentence that says what would let it go on,
    empty if it moves. Then all active rows of the last QP; the least distances to obstacles and between members that
    share no node, m; the pair nearest to an obstacle; the pairs that are too near, the worst first; the pair to
    highlight; the greatest gap between stations and curve, m, NaN without a curve; whether exact tracking gave way in
    the last step; and the computing time of that step, s.
    """

    outcome: str
    stopped_by: tuple[str, ...]
    why: str
    active: tuple[str, ...]
    clearance: float
    self_clearance: float
    nearest: str
    too_near: tuple[TooNear, ...]
    hold: Hold | None
    gap: float
    gave_way: bool
    step_time: float
