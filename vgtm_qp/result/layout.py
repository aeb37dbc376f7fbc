"""The arrays of a maneuver: their names, shapes and kinds, and the check against them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import ResultError


class ArrayLayout(NamedTuple):
    """Axes by name or size, kinds of number and finiteness of an array of the result file."""

    axes: tuple[str | int, ...]
    kinds: str = "f"
    finite: bool = True
    required: bool = True


LAYOUTS = {
    "time": ArrayLayout(("T",)),
    "nodes": ArrayLayout(("T", "N", 3)),
    "members": ArrayLayout(("M", 2), "iu"),
    "member_names": ArrayLayout(("M",), "U"),
    "member_actuated": ArrayLayout(("M",), "b"),
    "member_lengths": ArrayLayout(("T", "M")),
    "joints": ArrayLayout(("T", "J")),
    "joint_names": ArrayLayout(("J",), "U"),
    "body_names": ArrayLayout(("B",), "U"),
    "control_vertices": ArrayLayout(("T", "V", 3)),
    "tip_position": ArrayLayout(("T", 3)),
    "tip_rotation": ArrayLayout(("T", 3, 3)),
    "tip_target_position": ArrayLayout(("T", 3)),
    "clearance": ArrayLayout(("T",), finite=False),
    "self_clearance": ArrayLayout(("T",), finite=False),
    "progress": ArrayLayout(("T",)),
    "step_time": ArrayLayout(("T",)),
    "phase_names": ArrayLayout(("P",), "U"),
    "phase_time": ArrayLayout(("T", "P")),
    "tip_target_rotation": ArrayLayout(("T", 3, 3), required=False),
    "tip_target_pointing": ArrayLayout(("T", 3), required=False),
}

OF_TRUSSES = ("nodes", "members", "member_names", "member_actuated", "member_lengths")
OF_SERIAL_ARMS = ("joints", "joint_names", "body_names")


def names_of(arrays: Collection[str]) -> list[str]:
    """Return the names of the arrays that a result file of the kind of these may have."""
    others = OF_TRUSSES if "joints" in arrays else OF_SERIAL_ARMS
    return [name for name in LAYOUTS if name not in others]


def plain(array: Any) -> NDArray[Any]:
    """Return an array in the byte order and width of the file."""
    array = np.asarray(array)
    wide = {"f": np.float64, "i": np.int64, "u": np.int64}.get(array.dtype.kind)
    return np.asarray(array, dtype=wide, order="C")


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """Return a copy on immutable bytes, which cannot be made writable again either."""
    return np.ndarray(array.shape, array.dtype, buffer=array.tobytes())


def check_arrays(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise ResultError for the first array that is missing, unknown, malformed or holds no number."""
    possible = names_of(arrays)
    for name in arrays:
        if name not in possible:
            raise ResultError(f"array {name} is not one of a result file; those are {', '.join(possible)}")
    sizes: dict[str, int] = {}
    for name in possible:
        layout = LAYOUTS[name]
        if name not in arrays:
            if layout.required:
                raise ResultError(f"array {name} is missing")
            continue
        array = arrays[name]
        if array.dtype.kind not in layout.kinds:
            raise ResultError(f"array {name} holds {array.dtype}; expected kind {' or '.join(layout.kinds)}")
        expected = tuple(sizes.get(a, a) if isinstance(a, str) else a for a in layout.axes)
        if array.ndim != len(expected) or any(
            isinstance(e, int) and e != size for e, size in zip(expected, array.shape, strict=True)
        ):
            axes = ", ".join(f"{a} = {sizes[a]}" if a in sizes else str(a) for a in layout.axes)
            raise ResultError(f"array {name} has shape {array.shape}; expected ({axes})")
        sizes |= {a: size for a, size in zip(layout.axes, array.shape, strict=True) if isinstance(a, str)}
        if array.dtype.kind == "f" and (np.isnan(array).any() or (layout.finite and np.isinf(array).any())):
            row = int(np.argwhere(~np.isfinite(array))[0][0])
            raise ResultError(f"array {name} holds a value that is not a number, row {row}")
    states = "joints" if "joints" in arrays else "nodes"
    if min(arrays[states].shape[:2]) < 1:
        raise ResultError(f"there is no state in it: array {states} is empty")
    members = arrays.get("members", np.zeros(0))
    if members.size and (members.min() < 0 or members.max() >= sizes["N"]):
        raise ResultError(f"array members names a node outside 0..{sizes['N'] - 1}")
    if (np.diff(arrays["time"]) <= 0.0).any():
        row = int(np.argmax(np.diff(arrays["time"]) <= 0.0)) + 1
        raise ResultError(f"array time does not increase at row {row}")
