"""CSV files with a header and one instant a row, its time in the column ``t``."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path

from vgtm_qp.errors import Mistake, ProblemError, nearest
from vgtm_qp.problem.fields import GREATEST_LENGTH, LONGEST_STEP, SHORTEST_STEP
from vgtm_qp.problem.table import shown

_GREATEST_BYTES = 200_000_000
GREATEST_MISTAKES = 100
NUMBER = f"a finite number between -{GREATEST_LENGTH:g} and {GREATEST_LENGTH:g}"


def read_timed_rows(
    file: Path, read_header: Callable[[list[str], list[Mistake]], list[str]]
) -> tuple[list[str], list[dict[str, float]]]:
    """Return the keys of the columns, and the numbers of each row by key; the times ``t`` increase, from 0 or later.

    Parameters
    ----------
    file
        With cells of numbers; empty lines are skipped.
    read_header
        Returns the key of each column, and adds the mistakes of the columns to its second argument.

    Raises
    ------
    ProblemError
        The file is missing, is not text, or has wrong columns or cells: each is named by line and column.
    """
    header, rows = _rows(file)
    mistakes: list[Mistake] = []
    header, values = read_header(header, mistakes), list[dict[str, float]]()
    if not mistakes:
        before = -math.inf
        for line, cells in rows:
            row = _numbers(header, line, cells, mistakes)
            time = row.get("t", math.nan)
            mistakes += time_mistakes(f"line {line}, column t", time, before)
            before = time if math.isfinite(time) else before
            values.append(row)
        if not rows:
            mistakes.append(Mistake("line 2", "nothing", "at least one row of numbers below the header"))
    if mistakes:
        raise ProblemError(str(file), mistakes[:GREATEST_MISTAKES])
    return header, values


def time_mistakes(place: str, time: float, before: float) -> list[Mistake]:
    """Return the mistakes of a row's time after the time `before`, s, -inf for the first row; NaN passes."""
    step = time - max(before, 0.0)
    if time < 0:
        return [Mistake(place, f"{time:g}", "a time in seconds, 0 or more")]
    if time <= before:
        return [Mistake(place, f"{time:.9g}", f"a time after that of the row before, {before:.9g} s")]
    if time > 0 and not SHORTEST_STEP <= step <= LONGEST_STEP:
        return [Mistake(place, f"{step:g} s", f"a step of {SHORTEST_STEP:g} to {LONGEST_STEP:g} s")]
    return []


def check_columns(header: list[str], known: tuple[str, ...], expected: str, mistakes: list[Mistake]) -> None:
    """Add columns that are not `known`, or stand twice, to the mistakes."""
    for column, name in enumerate(header, start=1):
        if name not in known:
            mistakes.append(Mistake(f"line 1, column {column}", shown(name), expected + nearest(name, known)))
        elif name in header[: column - 1]:
            mistakes.append(Mistake(f"line 1, column {column}", shown(name), "each column once"))


def _rows(file: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the header and the rows that are not empty, with line numbers; ProblemError if it is not CSV."""
    try:
        if not file.is_file():
            raise ProblemError.at(file, "file", "nothing", "a CSV file")
        if file.stat().st_size > _GREATEST_BYTES:
            raise ProblemError.at(file, "file", "a huge file", f"less than {_GREATEST_BYTES} bytes")
        with file.open(encoding="utf-8-sig", newline="") as lines:
            reader = csv.reader(lines, skipinitialspace=True)
            rows = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader if any(cells)]
    except UnicodeDecodeError as error:
        raise ProblemError.at(file, "file", f"byte {error.start}", "text in UTF-8") from None
    except csv.Error as error:
        raise ProblemError.at(file, "file", str(error), "comma-separated numbers") from None
    except OSError as error:
        raise ProblemError.at(file, "file", error.strerror or "", "a readable file") from None
    return (rows[0][1], rows[1:]) if rows else ([], [])


def _numbers(header: list[str], line: int, cells: list[str], mistakes: list[Mistake]) -> dict[str, float]:
    """Return the numbers of a row by column; cells that are not numbers are added to `mistakes`."""
    if len(cells) != len(header):
        mistakes.append(
            Mistake(f"line {line}", f"{len(cells)} cells", f"{len(header)} cells, as the header has")
        )
        return {}
    row: dict[str, float] = {}
    for name, cell in zip(header, cells, strict=True):
        try:
            # Python would read 1_000 too.
            number = math.nan if "_" in cell else float(cell)
        except ValueError:
            number = math.nan
        # NaN fails this comparison too.
        if abs(number) <= GREATEST_LENGTH:
            row[name] = number
        else:
            mistakes.append(Mistake(f"line {line}, column {name}", shown(cell), NUMBER))
    return row
