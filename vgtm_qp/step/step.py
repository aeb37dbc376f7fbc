"""What one step did: how it ended, the state after it, and the rows that were active in its QP."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property

import numpy as np

from vgtm_qp.qp.answer import StepSolution
from vgtm_qp.qp.full import StepQP
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.qp.residual import FailedStepError
from vgtm_qp.step.actuation import Limits
from vgtm_qp.step.state import State

WHOLE = 1.0 - 1e-9
"""Progress from which on a goal counts as met."""


class StepStatus(StrEnum):
    """How a step ended."""

    REACHED = "reached"
    SLOWED = "slowed"
    BLOCKED = "blocked"


@dataclass(frozen=True, eq=False, repr=False)
class Step:
    """What one call of ``Resolver.step`` did.

    Attributes
    ----------
    status : StepStatus
        ``reached``: the goal was met; ``slowed``: the arm moved on along its path to it, as far as the rows allow;
        ``blocked``: no safe motion was found and the state is unchanged.
    progress : float
        Share of the path that was covered, 0 to 1.
    state : State
        The state after the step.
    reason : str
        Why the step was cut, empty where it was not.
    qps : int
        QPs solved.
    solver_failed : bool
        Whether it was blocked only because the QP solver gave no good answer.
    braked : bool
        Whether no other step was found than to brake on the path that the arm was on before: limited accelerations
        do not let it leave that at once.
    gave_way : bool
        Whether stations left the curve, with ``method.tracking_mode`` exact, since the arm came further without it.
    left_path : bool
        Whether the tip left the path while braking: it is elastic, or its base moves on whatever happens.
    solution, rows, limits
        The answer of the QP that moved the arm, its clearance rows, and the limits of its actuators; or None.
    failure : FailedStepError or None
        What blocked it if that was a QP without an answer.
    """

    status: StepStatus
    progress: float
    state: State
    reason: str
    qps: int
    solver_failed: bool = False
    braked: bool = False
    left_path: bool = False
    gave_way: bool = False
    solution: StepSolution | None = None
    rows: ClearanceRows | None = None
    limits: Limits | None = None
    failure: FailedStepError | None = None

    def __str__(self) -> str:
        """Return one line: how it ended, how far and when, and what held the arm back where something did."""
        text = f"{self.status}: {100.0 * self.progress:.4g} % of the way, time {self.state.time:.6g} s"
        held = "" if self.status is StepStatus.REACHED else ", ".join(self.blocked_by[:4])
        return f"{text}, held by {held}" if held else text

    def __repr__(self) -> str:
        return f"<Step {self}>"

    def over(self, share: float, limits: Limits | None) -> Step:
        """Return the same step as one over a piece of path of which it covers a `share`."""
        status, progress = self.status, share * self.progress
        if self.moved:
            status = StepStatus.REACHED if progress >= WHOLE else StepStatus.SLOWED
        return replace(self, status=status, progress=progress, limits=limits)

    @property
    def moved(self) -> bool:
        """Whether the state is another one than before."""
        return self.status is not StepStatus.BLOCKED

    @cached_property
    def multipliers(self) -> dict[str, float]:
        """Multipliers of the rows that were active in the QP that moved the arm, by name, the greatest first."""
        if self.solution is None or self.rows is None or self.limits is None:
            return {}
        found: dict[str, float] = {}
        pressing = self.solution.clearance_multipliers
        for k in np.flatnonzero(pressing > 1e-9):
            name = self.rows.name(int(k))
            found[name] = max(found.get(name, 0.0), float(pressing[k]))
        pull = self.solution.actuator_multipliers
        # A share of a step has narrower bounds than the limits, so that an actuator without any may be held by one.
        limited = np.isfinite(np.where(pull > 0.0, self.limits.upper, self.limits.lower))
        for k in np.flatnonzero((np.abs(pull) > 1e-9) & limited):
            found[self.limits.name(int(k), upper=bool(pull[k] > 0.0))] = float(abs(pull[k]))
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    @property
    def fcl_rows(self) -> int:
        """How many clearance rows of that QP FCL supplied, each proven."""
        return 0 if self.rows is None else self.rows.by_fcl

    @property
    def exact_rows(self) -> int:
        """How many of them are by closed forms: FCL was not to be asked, its answer was refused, or an axis touched."""
        return 0 if self.rows is None else self.rows.by_formula

    @property
    def failed_qp(self) -> StepQP | None:
        """The last QP, where the step was blocked because it had no answer: every row and column with a name."""
        return None if self.failure is None else self.failure.qp

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the rows that were active in that QP, most decisive first."""
        return tuple(self.multipliers)

    @property
    def blocked_by(self) -> tuple[str, ...]:
        """Names of the obstacles, members and limits that held the arm back; the reason where there are none."""
        return self.active or ((self.reason,) if self.reason else ())
