"""The same maneuver by several methods: one row of measured numbers for each, failures included."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from vgtm_qp.comparison.report import Report
from vgtm_qp.comparison.row import Row, make_row
from vgtm_qp.errors import VgtmError
from vgtm_qp.machine import machine
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.maneuver.solve import solve
from vgtm_qp.methods.presets import DEFAULT_METHODS, check_methods, with_method
from vgtm_qp.problem import Problem
from vgtm_qp.problem.problem import check_is_problem
from vgtm_qp.step.resolver import Step

Progress = Callable[[str, float, Step], None]


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
        Called after each step with the method's name, its share of the path, 0 to 1, and the step.

    Raises
    ------
    GoalError
        `methods` is empty, is not a list, or has a name that no method has.
    ProblemError
        `problem` is not a Problem.
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
