"""The CSV file of a trajectory: the values of all joints, one instant a row."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import Mistake, ProblemError, nearest
from vgtm_qp.problem.path_file import GREATEST_MISTAKES, read_numbers, read_rows
from vgtm_qp.problem.table import shown


def read_trajectory(file: str | Path, names: Sequence[str]) -> tuple[Array, Array]:
    """Return times (T,), s, and values (T, J), rad or m, of the joints `names`, from columns of any order.

    ProblemError where the file is missing, is not text, lacks a column or has wrong cells: each is named by line and
    column.
    """
    header, rows = read_rows(Path(file))
    mistakes: list[Mistake] = []
    _check_columns(header, names, mistakes)
    if mistakes:
        raise ProblemError(str(file), mistakes[:GREATEST_MISTAKES])
    values = [read_numbers(header, line, cells, mistakes) for line, cells in rows]
    before = -math.inf
    for (line, _), row in zip(rows, values, strict=True):
        time = row.get("t", math.nan)
        if time < 0:
            mistakes.append(Mistake(f"line {line}, column t", f"{time:g}", "a time in seconds, 0 or more"))
        elif time <= before:
            expected = f"a time after that of the row before, {before:.9g} s"
            mistakes.append(Mistake(f"line {line}, column t", f"{time:.9g}", expected))
        if math.isfinite(time):
            before = time
    if not rows:
        mistakes.append(Mistake("line 2", "nothing", "at least one row of numbers below the header"))
    if mistakes:
        raise ProblemError(str(file), mistakes[:GREATEST_MISTAKES])
    return np.array([row["t"] for row in values]), np.array([[row[name] for name in names] for row in values])


def _check_columns(header: Sequence[str], names: Sequence[str], mistakes: list[Mistake]) -> None:
    """Add the mistakes of a header that has to hold ``t`` and `names`, each once."""
    known = ("t", *names)
    expected = f"the columns {','.join(known[:7])}{f' and {len(known) - 7} more' if len(known) > 7 else ''}"
    if not header:
        mistakes.append(Mistake("line 1", "nothing", expected))
        return
    for column, name in enumerate(header, start=1):
        if name not in known:
            mistakes.append(Mistake(f"line 1, column {column}", shown(name), expected + nearest(name, known)))
        elif name in header[: column - 1]:
            mistakes.append(Mistake(f"line 1, column {column}", shown(name), "each column once"))
    unknown = [name for name in header if name not in known]
    for name in known:
        if name not in header:
            mistakes.append(Mistake("line 1", f'no column "{name}"', expected + nearest(name, unknown)))
