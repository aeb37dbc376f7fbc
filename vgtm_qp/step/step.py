"""The result of one step: its status, the state after it, and the active rows of its QP."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np

from vgtm_qp.arrays import record
from vgtm_qp.errors import EvaluationError, SolverError
from vgtm_qp.notebook import html_table
from vgtm_qp.qp.answer import StepSolution
from vgtm_qp.qp.full import StepQP
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.qp.residual import AnswerError, FailedStepError, InfeasibleStepError
from vgtm_qp.step.actuation import Limits
from vgtm_qp.step.state import State

WHOLE = 1.0 - 1e-9
"""Progress from which a goal counts as reached."""


class StepStatus(StrEnum):
    """How a step ended."""

    REACHED = "reached"
    SLOWED = "slowed"
    BLOCKED = "blocked"


@dataclass(frozen=True, eq=False, repr=False)
class Step:
    """The result of one call of ``Resolver.step``.

    Attributes
    ----------
    status : StepStatus
        ``reached``: the goal was met; ``slowed``: the arm moved along its path to the goal, as far as the rows allow;
        ``blocked``: no safe motion was found and the state is unchanged.
    progress : float
        Share of the path that was covered, 0 to 1.
    state : State
        The state after the step.
    reason : str
        Why the step was cut short; empty if it was not.
    qps : int
        QPs solved, including those of attempts that were not accepted.
    solver_failed : bool
        True if the step was blocked only because the QP solver gave no accurate answer.
    braked : bool
        True if the only step found was to brake on the previous path: with limited accelerations an arm
        cannot leave it at once.
    gave_way : bool
        True if stations are off the curve after the step although ``method.tracking_mode`` is exact: because
        the arm got further that way, or brakes, or is blocked in a state with stations off the curve.
    gap : float
        Greatest distance of a station from its curve node after the step, m; if turns are kept as well, at
        least the greatest turn times the arm's unit. NaN if no station tracks a curve in a QP, as with every
        pseudoinverse.
    left_path : bool
        True if the tip left the path while braking, because it is elastic or its base moves on.
    solution, rows, limits
        The answer of the QP that moved the arm, its clearance rows, and the limits of its actuators; or None.
    failure : FailedStepError or None
        The error that blocked the step, if that was a QP without an answer.
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
    gap: float = math.nan
    solution: StepSolution | None = None
    rows: ClearanceRows | None = None
    limits: Limits | None = None
    failure: FailedStepError | None = None

    @classmethod
    def stopped(
        cls,
        state: State,
        reason: str,
        qps: int,
        solution: StepSolution | None = None,
        rows: ClearanceRows | None = None,
        *,
        failure: FailedStepError | None = None,
        solver_failed: bool = False,
    ) -> Step:
        """Return a blocked step that leaves the arm in its `state`."""
        return cls(
            StepStatus.BLOCKED,
            0.0,
            state,
            reason,
            qps,
            solver_failed,
            solution=solution,
            rows=rows,
            failure=failure,
        )

    @classmethod
    def failed(
        cls,
        state: State,
        error: SolverError,
        qps: int,
        solution: StepSolution | None,
        rows: ClearanceRows | None,
    ) -> Step:
        """Return the step that a QP without an answer has blocked."""
        reason = str(error)
        if isinstance(error, InfeasibleStepError) and not isinstance(error, AnswerError):
            reason = "no displacement keeps all limits and clearances"
        return cls.stopped(
            state,
            reason,
            qps,
            solution,
            rows,
            failure=error if isinstance(error, FailedStepError) else None,
            solver_failed=isinstance(error, AnswerError | EvaluationError),
        )

    def __str__(self) -> str:
        """Return one line: status, progress, time, and the rows that held the arm back."""
        text = f"{self.status}: {100.0 * self.progress:.4g} % of the way, time {self.state.time:.6g} s"
        held = "" if self.status is StepStatus.REACHED else ", ".join(self.blocked_by[:4])
        return f"{text}, held by {held}" if held else text

    def __repr__(self) -> str:
        return f"<Step {self}>"

    def _repr_html_(self) -> str:
        rows = [
            ("status", self.status),
            ("progress", f"{100.0 * self.progress:.4g} %"),
            ("time", f"{self.state.time:.6g} s"),
            ("QPs", self.qps),
            ("off the curve", "-" if math.isnan(self.gap) else f"{self.gap:.3g} m"),
            *((("held by", ", ".join(self.blocked_by)),) if self.status is not StepStatus.REACHED else ()),
            *((("reason", self.reason),) if self.reason else ()),
        ]
        return html_table("step", rows)

    def over(self, share: float, limits: Limits | None) -> Step:
        """Return the step as one over a longer piece of path, of which its own piece is a `share`."""
        status, progress = self.status, share * self.progress
        if self.moved:
            status = StepStatus.REACHED if progress >= WHOLE else StepStatus.SLOWED
        fields = {**vars(self), "status": status, "progress": progress, "limits": limits}
        fields.pop("multipliers", None)
        return record(Step, **fields)

    @property
    def moved(self) -> bool:
        """Whether the state changed."""
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
        # A share of a step has narrower bounds than the limits, so that an active bound need not be a limit.
        limited = np.isfinite(np.where(pull > 0.0, self.limits.upper, self.limits.lower))
        for k in np.flatnonzero((np.abs(pull) > 1e-9) & limited):
            found[self.limits.name(int(k), upper=bool(pull[k] > 0.0))] = float(abs(pull[k]))
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    @property
    def fcl_rows(self) -> int:
        """Number of rows that FCL supplied to the QP that moved the arm, each proven.

        Where FCL is asked for the rows that press alone, others do not count.
        """
        return 0 if self.rows is None else self.rows.by_fcl

    @property
    def exact_rows(self) -> int:
        """Number of clearance rows by closed forms: FCL unused, its answer refused, or axes touching.

        Rows of which FCL was not asked, since they do not press, do not count.
        """
        return 0 if self.rows is None else self.rows.by_formula

    @property
    def failed_qp(self) -> StepQP | None:
        """The last QP, with names of all rows and columns, if it had no answer and so blocked the step."""
        return None if self.failure is None else self.failure.qp

    @property
    def active(self) -> tuple[str, ...]:
        """Names of the rows that were active in the QP that moved the arm, most decisive first."""
        return tuple(self.multipliers)

    @property
    def blocked_by(self) -> tuple[str, ...]:
        """Names of the obstacles, members and limits that held the arm back; the reason if there are none."""
        return self.active or ((self.reason,) if self.reason else ())
