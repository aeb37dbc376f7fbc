"""The same maneuver by several methods: a report with one row of measured numbers for each, failures included."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from vgtm_qp.comparison.row import INTERRUPTED, MethodRow, make_row
from vgtm_qp.comparison.tables import markdown_table
from vgtm_qp.errors import ProblemError, VgtmError
from vgtm_qp.machine import machine, sentence
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.maneuver.solve import compile_steps, solve
from vgtm_qp.methods.presets import DEFAULT_METHODS, check_methods, with_method
from vgtm_qp.problem import Problem
from vgtm_qp.problem.problem import check_is_problem
from vgtm_qp.step.step import Step

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MethodProgress = Callable[[str, float, Step], None]

_NUMBERS = {
    "tip error [m]": ("tip_error", 1.0, ".1e"),
    "member drift [m]": ("member_drift", 1.0, ".1e"),
    "least clearance [m]": ("least_clearance", 1.0, ".4f"),
    "stroke beyond [m]": ("stroke_violation", 1.0, ".3g"),
    "rate beyond [m/s]": ("rate_violation", 1.0, ".3g"),
    "off the curve [m]": ("tracking_gap", 1.0, ".1e"),
    "travel [m]": ("actuator_travel", 1.0, ".2f"),
    "step [ms]": ("step_time", 1e3, ".2f"),
}
"""Columns of the table: the attribute of :class:`MethodRow`, its factor, and its format."""


@dataclass(frozen=True, eq=False, repr=False)
class Report:
    """The result of a comparison.

    Attributes
    ----------
    rows : tuple of MethodRow
    maneuvers : dict
        The maneuvers by (problem, method); a method that was refused is missing.
    machine : dict
        Machine and versions of the times.
    """

    rows: tuple[MethodRow, ...]
    maneuvers: dict[tuple[str, str], Maneuver]
    machine: dict[str, str]

    def __str__(self) -> str:
        return self.markdown()

    def __repr__(self) -> str:
        solved = ", ".join(f"{row.method} {'solved' if row.solved else 'not'}" for row in self.rows)
        return f"<Report: {solved}>"

    @property
    def interrupted(self) -> bool:
        """True if an interrupt ended the comparison; methods that were not run have rows that say so."""
        return any(row.status == INTERRUPTED for row in self.rows)

    def row(self, method: str) -> MethodRow:
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
        header = ("method", "solved", "path", *_NUMBERS, "why not")
        parts = []
        for name in dict.fromkeys(row.problem for row in self.rows):
            rows = [_cells(row) for row in self.rows if row.problem == name]
            parts.append(f"### {name}\n\n{markdown_table(header, rows)}")
        return "\n\n".join([*parts, f"Measured on: {sentence(self.machine)}."]) + "\n"

    def figure(self) -> Figure:
        """Return one figure: the end state of every method, clearance and member drift along the path."""
        from vgtm_qp.comparison.figure import plot_comparison

        return plot_comparison(self.rows, self.maneuvers)

    def __add__(self, other: Report) -> Report:
        return Report(self.rows + other.rows, {**self.maneuvers, **other.maneuvers}, self.machine)


def compare(
    problem: Problem,
    *,
    methods: Sequence[str] = DEFAULT_METHODS,
    progress: MethodProgress | None = None,
) -> Report:
    """Solve a problem by each method, verify each maneuver, and return the report.

    Parameters
    ----------
    problem
        What `load_problem` returns; its weights, gains and solver are those of all methods.
    methods
        Names of ``vgtm_qp.methods.presets.PRESETS``, at least one.
    progress
        Called after each step with the method's name, its share of the path, 0 to 1, and the step. An interrupt
        ends the comparison: rows without a whole maneuver have the status ``interrupted``.

    Raises
    ------
    GoalError
        `methods` is empty, is not a list, or has a name that no method has.
    ProblemError
        `problem` is not a Problem.
    """
    check_is_problem(problem)
    check_methods(methods)
    found: dict[str, tuple[MethodRow, Maneuver | None]] = {}
    try:
        for name in methods:
            with suppress(VgtmError):
                compile_steps(with_method(problem, name))
            found[name] = run_method(problem, name, progress=progress)
            if found[name][0].status == INTERRUPTED:
                break
    except KeyboardInterrupt:
        pass
    for name in methods:
        found.setdefault(name, (missing_row(problem, name), None))
    maneuvers = {(problem.name, name): maneuver for name, (_, maneuver) in found.items() if maneuver}
    return Report(tuple(found[name][0] for name in methods), maneuvers, machine())


def missing_row(problem: Problem, name: str) -> MethodRow:
    """Return the row of a method that was not run because of an interrupt."""
    return MethodRow(
        problem.name, name, False, False, INTERRUPTED, 0.0, 0, "interrupted before its first step"
    )


def run_method(
    problem: Problem, name: str, *, progress: MethodProgress | None = None
) -> tuple[MethodRow, Maneuver | None]:
    """Return the row of one method, and the maneuver unless the method was refused."""
    try:
        changed = with_method(problem, name)
        maneuver = solve(
            changed, progress=None if progress is None else lambda part, step: progress(name, part, step)
        )
    except VgtmError as error:
        # The report names the problem already, and has no room for the path of its file.
        reason = str(error.mistakes[0] if isinstance(error, ProblemError) else error).splitlines()[0]
        return MethodRow(problem.name, name, False, False, "refused", 0.0, 0, reason), None
    row = make_row(problem.name, name, maneuver)
    if INTERRUPTED in maneuver.blocked_by:
        row = replace(row, status=INTERRUPTED)
    return row, maneuver


def _cells(row: MethodRow) -> list[str]:
    found = [(getattr(row, key), factor, form) for key, factor, form in _NUMBERS.values()]
    return [
        row.method,
        "yes" if row.solved else "drifts" if row.kept else "no",
        f"{100 * row.reached:.0f} %",
        *("-" if value is None else format(factor * value, form) for value, factor, form in found),
        row.reason,
    ]
