"""The CSV file of a path: one pose of the end effector a row."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vgtm_qp.errors import Mistake
from vgtm_qp.problem.table import shown
from vgtm_qp.problem.timed_rows import check_columns, read_timed_rows

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_COLUMNS = ("t", "x", "y", "z")
_TURNS = ("rx", "ry", "rz")


@dataclass(frozen=True, eq=False)
class PathTable:
    """The rows of a path file: times (K,), s, increasing from 0 or later, and poses in the base frame.

    A pose is a position (K, 3), m, and a rotation vector (K, 3), rad; None if the file has no columns for the
    latter.
    """

    time: NDArray[np.float64]
    position: NDArray[np.float64]
    rotation_vector: NDArray[np.float64] | None


def read_path(file: str | Path) -> PathTable:
    """Read a path: a header ``t,x,y,z`` or ``t,x,y,z,rx,ry,rz``, in any order, and one row a step.

    ProblemError where the file is missing, is not text, or has wrong cells: each is named by line and column.
    """
    import numpy as np

    header, values = read_timed_rows(Path(file), _read_header)
    columns = {name: np.array([row[name] for row in values]) for name in header}
    turns = np.column_stack([columns[name] for name in _TURNS]) if "rx" in columns else None
    return PathTable(columns["t"], np.column_stack([columns[name] for name in "xyz"]), turns)


def _read_header(header: list[str], mistakes: list[Mistake]) -> list[str]:
    known = (*_COLUMNS, *_TURNS)
    expected = "the header t,x,y,z or t,x,y,z,rx,ry,rz"
    if not set(header) & set(known):
        mistakes.append(Mistake("line 1", shown(",".join(header) or None), expected))
        return header
    check_columns(header, known, expected, mistakes)
    needed = known if set(header) & set(_TURNS) else _COLUMNS
    absent = [name for name in needed if name not in header]
    if absent and not mistakes:
        mistakes.append(
            Mistake("line 1", shown(",".join(header)), f"{expected}; missing: {', '.join(absent)}")
        )
    return header
