"""CSV files with a header and one instant a row, its time in the column ``t``."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from pathlib import Path

from vgtm_qp.errors import Mistake, ProblemError, nearest
from vgtm_qp.problem.fields import GREATEST_LENGTH
from vgtm_qp.problem.table import shown

_GREATEST_BYTES = 200_000_000
_GREATEST_MISTAKES = 100
_NUMBER = f"a finite number between -{GREATEST_LENGTH:g} and {GREATEST_LENGTH:g}"

Mistakes = list[Mistake]


def read_timed_rows(
    file: Path,
    check_header: Callable[[list[str], Mistakes], None],
    shortest: float = 0.0,
    longest: float = math.inf,
    named: Callable[[list[str]], list[str]] = list,
) -> tuple[list[str], list[dict[str, float]]]:
    """Return the header, and the numbers of each row by column; times increase, from 0 or later.

    Parameters
    ----------
    file
        With cells of numbers; empty lines are skipped.
    check_header
        Adds what is wrong with the columns to the mistakes that it is given.
    shortest, longest
        Least and greatest time from one row to the next, s; for the first row, from 0 if it is later.
    named
        Returns the names of the columns for a header that has others.

    Raises
    ------
    ProblemError
        The file is missing, is not text, or has wrong columns or cells: each is named by line and column.
    """
    header, rows = _rows(file)
    header, mistakes = named(header), list[Mistake]()
    check_header(header, mistakes)
    if not mistakes:
        values = [_numbers(header, line, cells, mistakes) for line, cells in rows]
        before = -math.inf
        for (line, _), row in zip(rows, values, strict=True):
            time = row.get("t", math.nan)
            step, place = time - max(before, 0.0), f"line {line}, column t"
            if time < 0:
                mistakes.append(Mistake(place, f"{time:g}", "a time in seconds, 0 or more"))
            elif time <= before:
                expected = f"a time after that of the row before, {before:.9g} s"
                mistakes.append(Mistake(place, f"{time:.9g}", expected))
            elif time > 0 and not shortest <= step <= longest:
                mistakes.append(Mistake(place, f"{step:g} s", f"a step of {shortest:g} to {longest:g} s"))
            if math.isfinite(time):
                before = time
        if not rows:
            mistakes.append(Mistake("line 2", "nothing", "at least one row of numbers below the header"))
    if mistakes:
        raise ProblemError(str(file), mistakes[:_GREATEST_MISTAKES])
    return header, values


def check_columns(header: list[str], known: tuple[str, ...], expected: str, mistakes: Mistakes) -> None:
    """Add columns that are not `known`, or stand twice, to the mistakes."""
    for column, name in enumerate(header, start=1):
        if name not in known:
            mistakes.append(Mistake(f"line 1, column {column}", shown(name), expected + nearest(name, known)))
        elif name in header[: column - 1]:
            mistakes.append(Mistake(f"line 1, column {column}", shown(name), "each column once"))


def _rows(file: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the header and the rows that are not empty, with their line numbers; ProblemError where it is no CSV."""
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
    """Return the numbers of a row by column, without those that are none: `mistakes` has these."""
    if len(cells) != len(header):
        mistakes.append(
            Mistake(f"line {line}", f"{len(cells)} cells", f"{len(header)} cells, as the header has")
        )
        return {}
    row: dict[str, float] = {}
    for name, cell in zip(header, cells, strict=True):
        try:
            number = float(cell)
        except ValueError:
            number = math.nan
        # NaN fails this comparison too.
        if abs(number) <= GREATEST_LENGTH:
            row[name] = number
        else:
            mistakes.append(Mistake(f"line {line}, column {name}", shown(cell), _NUMBER))
    return row
