"""The CSV file of a path: one pose of the end effector a row."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vgtm_qp.errors import Mistake, ProblemError, nearest
from vgtm_qp.problem.fields import GREATEST_LENGTH, LONGEST_STEP, SHORTEST_STEP
from vgtm_qp.problem.table import shown

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_COLUMNS = ("t", "x", "y", "z")
_TURNS = ("rx", "ry", "rz")
_GREATEST_BYTES = 200_000_000
GREATEST_MISTAKES = 100
_NUMBER = f"a finite number between -{GREATEST_LENGTH:g} and {GREATEST_LENGTH:g}"


@dataclass(frozen=True, eq=False)
class PathTable:
    """The rows of a path file: times (K,), s, increasing from 0 or later, and poses in the base frame.

    Those are positions (K, 3), m, and rotation vectors (K, 3), rad, or None where the file has no such columns.
    """

    time: NDArray[np.float64]
    position: NDArray[np.float64]
    rotation_vector: NDArray[np.float64] | None


def read_path(file: str | Path) -> PathTable:
    """Read a path: a header ``t,x,y,z`` or ``t,x,y,z,rx,ry,rz``, in any order, and one row a step.

    ProblemError where the file is missing, is not text, or has wrong cells: each is named by line and column.
    """
    import numpy as np

    header, rows = read_rows(Path(file))
    mistakes: list[Mistake] = []
    _check_header(header, mistakes)
    if mistakes:
        raise ProblemError(str(file), mistakes)
    values = [read_numbers(header, line, cells, mistakes) for line, cells in rows]
    before = -math.inf
    for (line, _), row in zip(rows, values, strict=True):
        time = row.get("t", math.nan)
        place = f"line {line}, column t"
        mistake = time_mistake(place, time, before)
        if mistake is None and time > 0 and before < 0:
            mistake = step_mistake(place, time)
        mistakes += [mistake] if mistake else []
        if math.isfinite(time):
            before = time
    if not rows:
        mistakes.append(Mistake("line 2", "nothing", "at least one row of numbers below the header"))
    if mistakes:
        raise ProblemError(str(file), mistakes[:GREATEST_MISTAKES])
    columns = {name: np.array([row[name] for row in values]) for name in header}
    turns = np.column_stack([columns[name] for name in _TURNS]) if "rx" in columns else None
    return PathTable(columns["t"], np.column_stack([columns[name] for name in "xyz"]), turns)


def time_mistake(place: str, time: float, before: float) -> Mistake | None:
    """Return what is wrong with the time of a row after one `before`, s, which is -inf for the first; NaN passes."""
    if time < 0:
        return Mistake(place, f"{time:g}", "a time in seconds, 0 or more")
    if time <= before:
        return Mistake(place, f"{time:.9g}", f"a time after that of the row before, {before:.9g} s")
    return step_mistake(place, time - before) if math.isfinite(time - before) else None


def step_mistake(place: str, duration: float) -> Mistake | None:
    """Return what is wrong with the duration of a step, s."""
    if SHORTEST_STEP <= duration <= LONGEST_STEP:
        return None
    return Mistake(place, f"{duration:g} s", f"a step of {SHORTEST_STEP:g} to {LONGEST_STEP:g} s")


def read_rows(file: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
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


def _check_header(header: list[str], mistakes: list[Mistake]) -> None:
    known = (*_COLUMNS, *_TURNS)
    expected = "the header t,x,y,z or t,x,y,z,rx,ry,rz"
    if not set(header) & set(known):
        mistakes.append(Mistake("line 1", shown(",".join(header) or None), expected))
        return
    for column, name in enumerate(header, start=1):
        if name not in known:
            mistakes.append(Mistake(f"line 1, column {column}", shown(name), expected + nearest(name, known)))
        elif name in header[: column - 1]:
            mistakes.append(Mistake(f"line 1, column {column}", shown(name), "each column once"))
    needed = known if set(header) & set(_TURNS) else _COLUMNS
    absent = [name for name in needed if name not in header]
    if absent and not mistakes:
        mistakes.append(
            Mistake("line 1", shown(",".join(header)), f"{expected}; missing: {', '.join(absent)}")
        )


def read_numbers(header: list[str], line: int, cells: list[str], mistakes: list[Mistake]) -> dict[str, float]:
    """Return the numbers of a row by column, without those that are none: `mistakes` has these."""
    if len(cells) != len(header):
        mistakes.append(
            Mistake(f"line {line}", f"{len(cells)} cells", f"{len(header)} cells, as the header has")
        )
        return {}
    row: dict[str, float] = {}
    for name, cell in zip(header, cells, strict=True):
        try:
            # Python reads 1_000 too.
            number = math.nan if "_" in cell else float(cell)
        except ValueError:
            number = math.nan
        # NaN fails this comparison too.
        if abs(number) <= GREATEST_LENGTH:
            row[name] = number
        else:
            mistakes.append(Mistake(f"line {line}, column {name}", shown(cell), _NUMBER))
    return row
