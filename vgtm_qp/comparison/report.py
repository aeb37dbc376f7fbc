"""What a comparison found: rows, maneuvers, and the machine that the times belong to."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from vgtm_qp.comparison.markdown import markdown_table
from vgtm_qp.comparison.row import Row
from vgtm_qp.machine import sentence
from vgtm_qp.maneuver.maneuver import Maneuver

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class Report:
    """What a comparison found.

    Attributes
    ----------
    rows : tuple of Row
    maneuvers : dict
        The maneuvers by (problem, method); a method that was refused is missing.
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
        return "\n\n".join([*parts, f"Measured on: {sentence(self.machine)}."]) + "\n"

    def figure(self) -> Figure:
        """Return one figure: the end state of every method, clearance and member drift along the path."""
        from vgtm_qp.comparison.figure import plot_comparison

        return plot_comparison(self.rows, self.maneuvers)

    def __add__(self, other: Report) -> Report:
        return Report(self.rows + other.rows, {**self.maneuvers, **other.maneuvers}, self.machine)


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
