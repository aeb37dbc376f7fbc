"""A kernel of one row over any number of rows: mapped at a few capacities and padded."""

from __future__ import annotations

from pathlib import Path

import casadi as ca
import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.compiled import Compiling, Kernel, cache_directory, compiler

_LEAST, _MOST = 8, 1024
"""Capacities are the powers of two between these."""

_compilings: dict[tuple[str, str | None, Path], Compiling] = {}


class Batch:
    """A CasADi function of column vectors with one output, evaluated on rows.

    It is compiled for one row, once for all batches of a process. Two threads must not use it at once.

    Attributes
    ----------
    kernels : dict
        The kernels so far by capacity, each with its inputs and its output as rows.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        key = function.name(), compiler(), cache_directory()
        if key not in _compilings:
            _compilings[key] = Compiling(function)
        self._compiling = _compilings[key]
        self.kernels: dict[int, tuple[Kernel, list[Array], Array]] = {}

    def __call__(self, *rows: Array) -> Array:
        """Evaluate on `rows`, one (K, width) array per argument, and return a new (K, outputs) array."""
        count = len(rows[0])
        if count <= _MOST:
            return self._part(rows, 0, count)
        parts = [self._part(rows, start, min(start + _MOST, count)) for start in range(0, count, _MOST)]
        return np.concatenate(parts)

    def _part(self, rows: tuple[Array, ...], start: int, stop: int) -> Array:
        size = stop - start
        capacity = max(_LEAST, 1 << (size - 1).bit_length())
        found = self.kernels.get(capacity)
        kernel, inputs, output = found if found is not None else self._add(capacity)
        for target, source in zip(inputs, rows, strict=True):
            target[:size] = source[start:stop]
        kernel()
        return output[:size].copy()

    def _add(self, capacity: int) -> tuple[Kernel, list[Array], Array]:
        kernel = Kernel(self._function, times=capacity, compiled=self._compiling)
        inputs = [x.reshape(capacity, -1) for x in kernel.inputs]
        self.kernels[capacity] = kernel, inputs, kernel.outputs[0].reshape(capacity, -1)
        return self.kernels[capacity]
