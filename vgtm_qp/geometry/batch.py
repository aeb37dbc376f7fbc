"""One scalar kernel over any number of rows: mapped at a few capacities and padded."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.compiled import Kernel, compile_function

Array = NDArray[np.float64]

_CAPACITIES = (16, 128, 1024)


class Batch:
    """A CasADi function of column vectors, evaluated on rows; its outputs stand side by side in one array.

    Capacities are compiled when first needed. Not for two threads at once.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self._kernels: dict[int, tuple[Kernel, list[Array], Array]] = {}

    def prepare(self, count: int) -> None:
        """Compile what `count` rows need, so that no step has to wait for it."""
        self._kernel(_capacity(count))

    def _kernel(self, capacity: int) -> tuple[Kernel, list[Array], Array]:
        if capacity not in self._kernels:
            kernel = Kernel(_mapped(self._function, capacity), compiled=False)
            inputs = [x.reshape(capacity, -1) for x in kernel.inputs]
            self._kernels[capacity] = kernel, inputs, kernel.outputs[0].reshape(capacity, -1)
        return self._kernels[capacity]

    def __call__(self, *rows: Array) -> Array:
        """Evaluate on `rows`, one (K, width) array per argument, and return a new (K, outputs) array."""
        count = len(rows[0])
        capacity = _capacity(count)
        if count <= capacity:
            return self._part(capacity, rows, 0, count)
        parts = []
        start = 0
        while start < count:
            capacity = _capacity(count - start)
            parts.append(self._part(capacity, rows, start, min(start + capacity, count)))
            start += capacity
        return np.concatenate(parts)

    def _part(self, capacity: int, rows: tuple[Array, ...], start: int, stop: int) -> Array:
        kernel, inputs, output = self._kernel(capacity)
        size = stop - start
        for target, source in zip(inputs, rows, strict=True):
            target[:size] = source[start:stop]
        kernel()
        return output[:size].copy()


_functions: dict[tuple[str, int], ca.Function] = {}


def _mapped(function: ca.Function, capacity: int) -> ca.Function:
    """Return `function` with its outputs in one column, mapped and compiled; once for all batches of a process."""
    key = (function.name(), capacity)
    if key not in _functions:
        arguments = function.sx_in()
        packed = ca.Function(function.name(), arguments, [ca.cse(ca.vertcat(*function.call(arguments)))])
        _functions[key] = compile_function(packed.map(f"{key[0]}_{capacity}", "serial", capacity, [], []))
    return _functions[key]


def _capacity(count: int) -> int:
    """Return the largest capacity of which no more than half would be padding, else the smallest."""
    fitting = [c for c in _CAPACITIES if c <= 2 * count]
    return fitting[-1] if fitting else _CAPACITIES[0]
