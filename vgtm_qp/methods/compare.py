"""The same maneuver by several methods: one row of measured numbers for each, failures included."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vgtm_qp.errors import VgtmError
from vgtm_qp.maneuver.result import Maneuver
from vgtm_qp.maneuver.solve import solve
from vgtm_qp.methods.machine import describe_machine, machine
from vgtm_qp.methods.presets import DEFAULT_METHODS, check_methods, with_method
from vgtm_qp.problem import Problem
from vgtm_qp.problem.problem import check_is_problem
from vgtm_qp.step.resolver import Step

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Progress = Callable[[str, float, Step], None]

MEMBER_TOLERANCE = 1e-3
TIP_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Row:
    """One method on one problem. Lengths in m, times in s; None where there was nothing to measure.

    Attributes
    ----------
    solved : bool
        The maneuver came through and its verification passed.
    kept : bool
        It came through and kept every limit and clearance of the verification, with members and tip allowed to be
        off by 1 mm: what a method without drift correction is held against.
    status : str
        ``solved``, ``blocked`` or ``refused`` (the method cannot be set up for this arm).
    reached : float
        How far along the path, 0 to 1.
    reason : str
        Step and reason of a breakdown, or the first tolerance that verification found broken.
    actuator_travel : float
        Sum over actuators and steps of the changes of length.
    rank : int or None
        Of the Jacobian of eq. (26) in the last step, where the method reveals it.
    """

    problem: str
    method: str
    solved: bool
    kept: bool
    status: str
    reached: float
    steps: int
    reason: str
    tip_error: float | None = None
    member_drift: float | None = None
    least_clearance: float | None = None
    stroke_violation: float | None = None
    rate_violation: float | None = None
    actuator_travel: float | None = None
    step_time: float | None = None
    setup_time: float | None = None
    rank: int | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Report:
    """What a comparison found.

    Attributes
    ----------
    rows : tuple of Row
    maneuvers : dict
        The maneuvers by (problem, method); none where the method was refused.
    machine : dict
        What the times belong to.
    """

    rows: tuple[Row, ...]
    maneuvers: dict[tuple[str, str], Maneuver]
    machine: dict[str, str]

    def __str__(self) -> str:
        return self.markdown()

    def __repr__(self) -> str:
        solved = ", ".join(f"{row.method} {'solved' if row.solved else 'not'}" for row in self.rows)
        return f"<Report: {solved}>"

    def row(self, method: str) -> Row:
        """Return the first row of a method."""
        return next(row for row in self.rows if row.method == method)

    def to_dict(self) -> dict[str, Any]:
        """Return rows and machine as JSON data."""
        return {"machine": self.machine, "rows": [asdict(row) for row in self.rows]}

    def json(self) -> str:
        """Return the report as JSON."""
        return json.dumps(self.to_dict(), indent=2, allow_nan=False)

    def markdown(self) -> str:
        """Return the report as Markdown tables, one a problem, and the machine."""
        parts = []
        for name in dict.fromkeys(row.problem for row in self.rows):
            rows = [row for row in self.rows if row.problem == name]
            parts.append(f"### {name}\n\n{markdown_table(_HEADER, [_cells(row) for row in rows])}")
        return "\n\n".join([*parts, f"Measured on: {describe_machine(self.machine)}."]) + "\n"

    def figure(self) -> Figure:
        """Return one figure: the end state of every method, clearance and member drift along the path."""
        from vgtm_qp.methods.comparison_figure import plot_comparison

        return plot_comparison(self)

    def __add__(self, other: Report) -> Report:
        return Report(self.rows + other.rows, {**self.maneuvers, **other.maneuvers}, self.machine)


def compare(
    problem: Problem,
    *,
    methods: Sequence[str] = DEFAULT_METHODS,
    progress: Progress | None = None,
) -> Report:
    """Solve a problem by each method, verify each maneuver, and return the report.

    Parameters
    ----------
    problem
        What `load_problem` returns; its weights, gains and solver are those of all methods.
    methods
        Names of ``vgtm_qp.methods.presets.PRESETS``, at least one.
    progress
        Called after each step with the method's name, its part of the path, 0 to 1, and the step.

    Raises
    ------
    GoalError
        `methods` is empty, is not a list, or has a name that is no method's.
    ProblemError
        `problem` is none.
    """
    check_is_problem(problem)
    check_methods(methods)
    rows, maneuvers = [], {}
    for name in methods:
        row, maneuver = run_method(problem, name, progress=progress)
        rows.append(row)
        if maneuver is not None:
            maneuvers[problem.name, name] = maneuver
    return Report(tuple(rows), maneuvers, machine())


def run_method(
    problem: Problem, name: str, *, progress: Progress | None = None
) -> tuple[Row, Maneuver | None]:
    """Return the row of one method, and the maneuver unless the method was refused."""
    try:
        changed = with_method(problem, name)
        maneuver = solve(
            changed, progress=None if progress is None else lambda part, step: progress(name, part, step)
        )
    except VgtmError as error:
        reason = str(error).splitlines()[0]
        return Row(problem.name, name, False, False, "refused", 0.0, 0, reason), None
    return make_row(problem.name, name, maneuver), maneuver


def make_row(problem: str, method: str, maneuver: Maneuver) -> Row:
    """Return the row of a verified maneuver."""
    certificate = maneuver.certificate
    assert certificate is not None, "a maneuver is verified before it is compared"
    summary, failures = maneuver.summary(), certificate.failures()
    done = maneuver.status == "solved"
    member, tip = certificate.member_error.value or 0.0, certificate.tip_error.value or 0.0
    drifting = member <= MEMBER_TOLERANCE and tip <= TIP_TOLERANCE
    others = [line for line in failures if not line.startswith(("member error", "tip error"))]
    between = certificate.clearance_between.value
    travel = np.abs(np.diff(maneuver.member_lengths[:, maneuver.member_actuated], axis=0)).sum()
    reason = ", ".join(maneuver.blocked_by[:3]) if not done else next(iter([*others, *failures]), "")
    return Row(
        problem=problem,
        method=method,
        solved=done and certificate.ok,
        kept=done and drifting and not others,
        status=maneuver.status,
        reached=maneuver.reached,
        steps=maneuver.steps,
        reason=reason,
        tip_error=certificate.tip_error.value,
        member_drift=member,
        least_clearance=between,
        stroke_violation=certificate.stroke_violation.value,
        rate_violation=certificate.rate_violation.value,
        actuator_travel=float(travel),
        step_time=summary["step_time"]["median"],
        setup_time=summary["setup_time"],
        rank=maneuver.manifest.get("jacobian_rank"),
    )


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with aligned columns."""
    cells = [list(header), *[list(row) for row in rows]]
    widths = [max(len(cell) for cell in column) for column in zip(*cells, strict=True)]
    lines = ["| " + " | ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) + " |" for row in cells]
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


_HEADER = (
    "method",
    "solved",
    "path",
    "tip error [m]",
    "member drift [m]",
    "least clearance [m]",
    "stroke beyond [m]",
    "rate beyond [m/s]",
    "travel [m]",
    "step [ms]",
    "why not",
)


def _cells(row: Row) -> list[str]:
    return [
        row.method,
        "yes" if row.solved else "drifts" if row.kept else "no",
        f"{100 * row.reached:.0f} %",
        _number(row.tip_error, ".1e"),
        _number(row.member_drift, ".1e"),
        _number(row.least_clearance, ".4f"),
        _number(row.stroke_violation, ".3g"),
        _number(row.rate_violation, ".3g"),
        _number(row.actuator_travel, ".2f"),
        _number(None if row.step_time is None else 1e3 * row.step_time, ".2f"),
        row.reason.replace("|", "/"),
    ]


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
