"""Arrays of the arm's record in the manifest."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import ResultError


def numbers(record: Mapping[str, Any], key: str, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
    """Return ``record[key]`` as floats of that shape, inf for None."""
    array = np.asarray(record[key], dtype=np.float64)
    array = np.where(np.isnan(array), np.inf, array)
    if array.ndim != len(shape) or any(
        size not in (None, found) for size, found in zip(shape, array.shape, strict=True)
    ):
        raise ResultError(f"manifest.arm.{key} has shape {array.shape}; expected {shape}")
    return array


def is_serial(record: Mapping[str, Any]) -> bool:
    """Whether the arm is a serial one."""
    return record.get("kind") == "serial"
