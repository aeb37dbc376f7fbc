"""A trajectory as it is given: arrays, a CSV file, a ROS 2 bag or a JointTrajectory message."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vgtm_qp.arrays import Array
from vgtm_qp.errors import Mistake, ProblemError, nearest
from vgtm_qp.problem.fields import GREATEST_LENGTH, quoted
from vgtm_qp.problem.table import shown
from vgtm_qp.problem.timed_rows import GREATEST_MISTAKES, NUMBER, read_timed_rows, time_mistakes
from vgtm_qp.verify.arm import AnyRecordedArm
from vgtm_qp.verify.check import locks_of

if TYPE_CHECKING:
    from vgtm_qp.problem import Problem


@dataclass(frozen=True, eq=False)
class Columns:
    """What a trajectory gives: the values of joints, or the lengths of a truss's actuators.

    Attributes
    ----------
    names, units : tuple of str
    quantities : (K,) int
        Which of the arm's quantities they are.
    needed : (K,) bool
        False for those that are locked from the start.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    quantities: NDArray[np.int64]
    needed: NDArray[np.bool_]

    @classmethod
    def of(cls, arm: AnyRecordedArm, problem: Problem) -> Columns:
        """Return the columns of an arm's trajectories."""
        given = arm.actuated.copy()
        given[arm.followers[:, 0]] = True
        given[[arm.quantity_names.index(name) for name, _ in locks_of(problem.to_dict())]] = True
        index = np.flatnonzero(given)
        return cls(
            tuple(arm.quantity_names[k] for k in index),
            tuple("rad" if arm.revolute[k] else "m" for k in index),
            index,
            np.asarray(arm.actuated[index]),
        )

    @cached_property
    def keys(self) -> tuple[str, ...]:
        """Headers of a table's columns: the names; one that is "t", like the time, with its unit."""
        named = zip(self.names, self.units, strict=True)
        return tuple(f"{name} [{unit}]" if name == "t" else name for name, unit in named)

    @cached_property
    def spellings(self) -> dict[str, str]:
        """The keys of the columns by the spellings that a header may use; rates are spelt as in exports."""
        found = {"t": "t", "time [s]": "t"}
        for name, unit, key in zip(self.names, self.units, self.keys, strict=True):
            rate = f"d {name}/dt [{unit}/s]"
            found |= {key: key, f"{name} [{unit}]": key, rate: rate}
        return found

    def needed_names(self) -> tuple[str, ...]:
        """Return the names that a trajectory has to have."""
        return tuple(name for name, needed in zip(self.names, self.needed, strict=True) if needed)

    def expected(self) -> str:
        """Return the possible names in words."""
        known = self.names
        more = f" and {len(known) - 8} more" if len(known) > 8 else ""
        return f"{', '.join(known[:8])}{more}"


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Times (T,), s, increasing, and values (T, K) of the quantities (K,) of an arm, rad or m."""

    time: Array
    values: Array
    quantities: NDArray[np.int64]

    def filled(self, home: Array) -> Array:
        """Return (T, M) all quantities of the arm; those not given are as in `home` (M,)."""
        found = np.tile(home, (len(self.time), 1))
        found[:, self.quantities] = self.values
        return found


def read_trajectory(file: str | Path, columns: Columns) -> Trajectory:
    """Read a trajectory from a CSV file, a ROS 2 bag (``.mcap``) or a JointTrajectory message (``.yaml``).

    The CSV file has a header, ``t`` in seconds and the names of `columns`, in any order, and a row for each instant;
    what ``vgtm export`` writes is read too.

    Raises
    ------
    ProblemError
        With one :class:`Mistake` for each fault, which names its place.
    MissingExtraError
        The package that reads bags, or YAML, is not installed.
    """
    from vgtm_qp.certify import messages

    kind = Path(file).suffix.lower()
    if kind == ".mcap":
        return _from_points(file, *messages.read_bag(Path(file)), columns)
    if kind in (".yaml", ".yml"):
        return _from_points(file, *messages.read_message(Path(file)), columns)
    return _read_csv(file, columns)


def _read_csv(file: str | Path, columns: Columns) -> Trajectory:
    header, rows = read_timed_rows(Path(file), partial(_read_header, columns))
    given = [k for k, key in enumerate(columns.keys) if key in header]
    values = np.array([[row[columns.keys[k]] for k in given] for row in rows])
    return Trajectory(
        np.array([row["t"] for row in rows]), values.reshape(len(rows), -1), columns.quantities[given]
    )


def _read_header(columns: Columns, cells: list[str], mistakes: list[Mistake]) -> list[str]:
    """Return the key of each column: "t", one of `columns.keys`, or an exported rate's; `mistakes` has the others."""
    expected = f"t and the names {columns.expected()}"
    spellings = columns.spellings
    if len(cells) == 1 and re.search(r"[;\t|]", cells[0]):
        mistakes.append(Mistake("line 1", shown(cells[0]), "names with commas between them"))
        return []
    for number, cell in enumerate(cells, start=1):
        if "\n" in cell:
            told = "a name on one line; its quotation mark stays open"
            mistakes.append(Mistake(f"line 1, column {number}", shown(cell), told))
            return []
    header = [spellings.get(cell, cell) for cell in cells]
    unknown = [cell for cell in cells if cell not in spellings]
    known = set(header) & set(columns.keys)
    if (unknown or not cells) and not known and not any(_meant(cell, spellings) for cell in unknown):
        mistakes.append(Mistake("line 1", shown(",".join(cells) or None), f"a header with {expected}"))
        return []
    for number, (cell, key) in enumerate(zip(cells, header, strict=True), start=1):
        place = f"line 1, column {number}"
        if cell in unknown:
            told = expected + _meant(cell, ("t", *columns.names))
            mistakes.append(Mistake(place, shown(cell or None), told))
        elif key in header[: number - 1]:
            mistakes.append(Mistake(place, shown(cell), f'each column once; "{key}" stands before it'))
    needed = ("t", *(key for key, wanted in zip(columns.keys, columns.needed, strict=True) if wanted))
    # A misspelt name is reported as misspelt, not as missing too.
    absent = [
        key for key in needed if key not in header and not any(_meant(cell, (key,)) for cell in unknown)
    ]
    if absent:
        mistakes.append(Mistake("line 1", f"no column {quoted(absent)}", f"a column for each of {expected}"))
    return header


def _meant(cell: str, names: Iterable[str]) -> str:
    """Return in words which of `names` a cell is meant for, whatever its case and its unit; empty if none."""
    bare, names = re.sub(r" *\[.*\]$", "", cell), list(names)
    same = [name for name in names if name.lower() == bare.lower()]
    return f'; did you mean "{same[0]}"?' if same else nearest(bare, names)


def _from_points(
    file: str | Path,
    names: Sequence[str],
    points: Sequence[tuple[str, float, Sequence[Any]]],
    columns: Columns,
) -> Trajectory:
    """Return the trajectory of joints `names` from points: place in words, time, s, and positions of each."""
    mistakes = list(_wrong_names(names, columns))
    before = -math.inf
    for place, time, positions in points:
        if len(positions) != len(names):
            found = f"{len(positions)} positions"
            mistakes.append(Mistake(f"{place}, positions", found, f"{len(names)}, one for each joint name"))
        for name, value in zip(names, positions, strict=False):
            if not _is_number(value):
                mistakes.append(Mistake(f"{place}, {name}", shown(value), NUMBER))
        mistakes += time_mistakes(f"{place}, time", time, before)
        before = time
    if not points:
        mistakes.append(Mistake("points", "nothing", "at least one point"))
    if mistakes:
        raise ProblemError(str(file), mistakes[:GREATEST_MISTAKES])
    given = [k for k, name in enumerate(columns.names) if name in names]
    order = [list(names).index(columns.names[k]) for k in given]
    values = np.array([positions for _, _, positions in points], dtype=np.float64)
    return Trajectory(np.array([time for _, time, _ in points]), values[:, order], columns.quantities[given])


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= GREATEST_LENGTH


def _wrong_names(names: Sequence[str], columns: Columns) -> Iterator[Mistake]:
    expected = f"the names {columns.expected()}"
    for k, name in enumerate(names):
        if name not in columns.names:
            yield Mistake(f"joint_names[{k}]", shown(name), expected + nearest(name, columns.names))
        elif name in names[:k]:
            yield Mistake(f"joint_names[{k}]", shown(name), "each name once")
    unknown, absent = [name for name in names if name not in columns.names], []
    for name in columns.needed_names():
        if name not in names and not nearest(name, unknown):
            absent.append(name)
    if absent:
        yield Mistake("joint_names", f"no {quoted(absent)}", f"each of {expected}")


def given_trajectory(
    times: ArrayLike, joints: ArrayLike | Mapping[str, ArrayLike], columns: Columns
) -> Trajectory:
    """Return the trajectory of arrays (T,) and (T, K), or (T,) by name; ProblemError if they do not fit."""
    mistakes: list[Mistake] = []
    time = _array("times", times, mistakes)
    if isinstance(joints, Mapping):
        names = [str(name) for name in joints]
        mistakes += _wrong_names(names, columns)
        arrays = [_array(f'joints["{name}"]', value, mistakes) for name, value in joints.items()]
        if not mistakes:
            wrong = [(name, a) for name, a in zip(names, arrays, strict=True) if a.shape != time.shape]
            mistakes += [Mistake(f'joints["{n}"]', _shape(a), f"{len(time)} values") for n, a in wrong]
        chosen = [columns.names.index(name) for name in names] if not mistakes else []
        values = np.stack(arrays, axis=1) if arrays and not mistakes else np.zeros((len(time), 0))
    else:
        values = _array("joints", joints, mistakes)
        chosen = list(range(len(columns.names)))
        if values.ndim == 2 and values.shape[1] == columns.needed.sum() < len(chosen):
            chosen = np.flatnonzero(columns.needed).tolist()
        if not mistakes and values.shape != (*time.shape, len(chosen)):
            expected = (
                f"values ({len(time)}, {len(columns.names)}): a row a time, columns {columns.expected()}"
            )
            mistakes.append(Mistake("joints", _shape(values), expected))
    if not mistakes:
        mistakes = list(_wrong_values(time, values))
    if mistakes:
        raise ProblemError("certify", mistakes[:GREATEST_MISTAKES])
    return Trajectory(time, values, columns.quantities[chosen])


def _shape(array: Array) -> str:
    return f"an array of shape {array.shape}"


def _array(name: str, given: Any, mistakes: list[Mistake]) -> Array:
    try:
        array = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        mistakes.append(Mistake(name, shown(type(given).__name__), "an array of numbers"))
        return np.zeros(1)
    if name == "times" and (array.ndim != 1 or not len(array)):
        mistakes.append(Mistake(name, _shape(array), "times (T,), at least one"))
        return np.zeros(1)
    return array


def _wrong_values(time: Array, values: Array) -> Iterator[Mistake]:
    for name, array in (("times", time), ("joints", values)):
        for place in np.argwhere(~(np.abs(array) <= GREATEST_LENGTH))[:1]:
            index = ", ".join(map(str, place.tolist()))
            yield Mistake(f"{name}[{index}]", shown(float(array[tuple(place)])), NUMBER)
    steps = zip(time.tolist(), [-math.inf, *time[:-1].tolist()], strict=True)
    found = (time_mistakes(f"times[{k}]", at, before) for k, (at, before) in enumerate(steps))
    yield from next(filter(None, found), [])
