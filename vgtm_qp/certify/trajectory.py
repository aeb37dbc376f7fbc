"""The CSV file of a trajectory: the values of all joints, one instant a row."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import Mistake, closest
from vgtm_qp.problem.timed_rows import check_columns, read_timed_rows


def read_trajectory(file: str | Path, names: Sequence[str]) -> tuple[Array, Array]:
    """Return times (T,), s, and values (T, J), rad or m, of the joints `names`, from columns of any order.

    What ``vgtm export --to csv`` writes is such a file too; its rates are not needed. ProblemError where the file is
    missing, is not text, lacks a column or has wrong cells: each is named by line and column.
    """
    _, values = read_timed_rows(Path(file), partial(_check_columns, names), named=_named)
    return np.array([row["t"] for row in values]), np.array([[row[name] for name in names] for row in values])


def _named(header: list[str]) -> list[str]:
    """Return the names of an exported maneuver's columns without their units; any other header as it is."""
    if header[:1] != ["time [s]"]:
        return header
    return ["t", *(column.rpartition(" [")[0] or column for column in header[1:])]


def _check_columns(names: Sequence[str], header: list[str], mistakes: list[Mistake]) -> None:
    """Add the mistakes of a header that has to hold ``t`` and `names`, each once."""
    known = ("t", *names)
    expected = f"the columns {','.join(known[:7])}{f' and {len(known) - 7} more' if len(known) > 7 else ''}"
    if not header:
        mistakes.append(Mistake("line 1", "nothing", expected))
        return
    all_known = (*known, *(f"d {name}/dt" for name in names))
    check_columns(header, all_known, expected, mistakes)
    unknown = [name for name in header if name not in all_known]
    for name in known:
        # A column that is probably meant for it was told.
        if name not in header and closest(name, unknown) is None:
            mistakes.append(Mistake("line 1", f'no column "{name}"', expected))
