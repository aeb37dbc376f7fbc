"""Tables of a manifest. Values are checked as they are read, and errors name the key."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import ResultError

Sizes = tuple[int | None, ...]
"""Sizes of the axes; None for any size."""

GREATEST = 1e12
"""Greatest number of a record or an array: squares and products of such numbers are finite."""


class Record:
    """The table `data` of a manifest, `name` in messages; ResultError for a wrong kind or shape of value."""

    def __init__(self, data: Any, name: str) -> None:
        if not isinstance(data, Mapping):
            raise ResultError(f"{name} is {_shown(data)}; expected a JSON object")
        self._data, self._name = data, name

    def table(self, key: str) -> Record:
        """Return the table of a key."""
        return Record(self._value(key), f"{self._name}.{key}")

    def numbers(self, key: str, shape: Sizes, *, limits: bool = False) -> NDArray[np.float64]:
        """Return the numbers of a key. In `limits`, null means infinite."""
        array = self._array(key, shape, "numbers")
        if array.dtype.kind == "O" and limits:
            flat = array.reshape(-1)
            given = [value for value in flat if value is not None]
            if all(isinstance(value, float) or type(value) is int for value in given):
                if any(abs(value) > GREATEST for value in given):
                    raise self._error(key, f"numbers up to {GREATEST:g} or nulls")
                array = np.array([np.inf if value is None else value for value in flat]).reshape(array.shape)
        beyond = array.dtype.kind in "iuf" and np.abs(array[np.isfinite(array)]).max(initial=0) > GREATEST
        if array.size and (array.dtype.kind not in "iuf" or beyond):
            raise self._error(key, f"numbers up to {GREATEST:g}{' or nulls' if limits else ''}")
        return np.asarray(array, dtype=np.float64)

    def integers(self, key: str, shape: Sizes, below: int) -> NDArray[np.int64]:
        """Return the integers of a key, 0 to `below` - 1."""
        array = self._array(key, shape, "integers")
        if array.size and (array.dtype.kind not in "iu" or array.min() < 0 or array.max() >= below):
            raise self._error(key, f"integers from 0 to {below - 1}")
        return np.asarray(array, dtype=np.int64)

    def flags(self, key: str, shape: Sizes) -> NDArray[np.bool_]:
        """Return the truth values of a key."""
        array = self._array(key, shape, "truth values")
        if array.size and array.dtype.kind != "b":
            raise self._error(key, "truth values")
        return np.asarray(array, dtype=np.bool_)

    def names(self, key: str, count: int | None = None) -> tuple[str, ...]:
        """Return the strings of a key; no two are equal."""
        value = self._value(key)
        if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
            raise self._error(key, "a list of strings")
        if count not in (None, len(value)) or len(set(value)) < len(value):
            raise self._error(key, f"{'' if count is None else f'{count} '}different strings")
        return tuple(value)

    def has(self, key: str) -> bool:
        """Return whether the value of a key is not null; ResultError if the key is missing."""
        return self._value(key) is not None

    def flag(self, key: str) -> bool:
        """Return the truth value of a key."""
        return bool(self.flags(key, ()))

    def _value(self, key: str) -> Any:
        if key not in self._data:
            raise ResultError(f"{self._name} lacks {key}")
        return self._data[key]

    def _array(self, key: str, shape: Sizes, what: str) -> NDArray[Any]:
        try:
            array = np.asarray(self._value(key))
        except (ValueError, TypeError, OverflowError):
            array = np.zeros((0,) * (len(shape) + 1))
        # An empty list has lost its other axes.
        if array.shape == (0,) and shape and shape[0] in (None, 0):
            array = array.reshape(0, *(size or 0 for size in shape[1:]))
        if array.ndim != len(shape) or any(
            size not in (None, found) for size, found in zip(shape, array.shape, strict=True)
        ):
            sizes = " x ".join("any" if size is None else str(size) for size in shape) or "one"
            raise self._error(key, f"{sizes} {what}")
        return array

    def _error(self, key: str, expected: str) -> ResultError:
        return ResultError(f"{self._name}.{key} is {_shown(self._data[key])}; expected {expected}")


def _shown(value: Any) -> str:
    text = repr(value) if not isinstance(value, int) or abs(value) < 10**60 else "an integer of many digits"
    return text if len(text) <= 60 else f"{text[:57]}..."
