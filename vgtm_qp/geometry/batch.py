"""A kernel of one row over any number of rows: mapped at a few capacities and padded."""

from __future__ import annotations

from collections.abc import Iterable

import casadi as ca
import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.compiled import Compiling, Kernel

_CAPACITIES = (16, 128, 1024)

_BEGIN = 8
_SWITCH = 64
"""A capacity that was not prepared is compiled from the 8th call that asks for it on, and used from the 64th on.

Until then smaller ones are used, with the same results up to rounding: a list that is made once is not worth compiling
for, and no step waits for the compiler.
"""


class Batch:
    """A CasADi function of column vectors with one output, evaluated on rows.

    Not for two threads at once.

    Attributes
    ----------
    kernels : dict
        The kernels in use by capacity, each with its inputs and its output as rows.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self.kernels: dict[int, tuple[Kernel, list[Array], Array]] = {}
        self._begun: dict[int, Kernel] = {}
        self._asked: dict[int, int] = {}

    def prepare(self, count: int, *, for_later: bool = False) -> None:
        """Begin to compile the kernel for `count` rows, so that no step has to wait for it.

        :func:`vgtm_qp.compiled.finish_compiling` does not wait for kernels `for_later`.
        """
        self._use(_capacity(count, _CAPACITIES), for_later=for_later)

    def _use(self, capacity: int, *, for_later: bool = True) -> None:
        if capacity not in self.kernels:
            kernel = self._begun.pop(capacity, None)
            kernel = kernel or _kernel(self._function, capacity, for_later=for_later)
            inputs = [x.reshape(capacity, -1) for x in kernel.inputs]
            self.kernels[capacity] = kernel, inputs, kernel.outputs[0].reshape(capacity, -1)

    def _ask(self, capacity: int) -> None:
        """Count a call that would have used a kernel of a missing capacity."""
        asked = self._asked[capacity] = self._asked.get(capacity, 0) + 1
        if capacity == _CAPACITIES[0] or asked >= _SWITCH:
            self._use(capacity)
        elif asked == _BEGIN:
            self._begun[capacity] = _kernel(self._function, capacity, for_later=True)
        if not self.kernels:
            self._use(_CAPACITIES[0])

    def __call__(self, *rows: Array) -> Array:
        """Evaluate on `rows`, one (K, width) array per argument, and return a new (K, outputs) array."""
        count = len(rows[0])
        capacity = _capacity(count, _CAPACITIES)
        if capacity not in self.kernels:
            self._ask(capacity)
            capacity = _capacity(count, self.kernels)
        if count <= capacity:
            return self._part(capacity, rows, 0, count)
        parts = []
        start = 0
        while start < count:
            capacity = _capacity(count - start, self.kernels)
            parts.append(self._part(capacity, rows, start, min(start + capacity, count)))
            start += capacity
        return np.concatenate(parts)

    def _part(self, capacity: int, rows: tuple[Array, ...], start: int, stop: int) -> Array:
        kernel, inputs, output = self.kernels[capacity]
        size = stop - start
        for target, source in zip(inputs, rows, strict=True):
            target[:size] = source[start:stop]
        kernel()
        return output[:size].copy()


_functions: dict[tuple[str, int], tuple[ca.Function, Compiling]] = {}


def _kernel(function: ca.Function, capacity: int, *, for_later: bool) -> Kernel:
    """Return `function`, mapped; compiled once for all batches of a process."""
    key = (function.name(), capacity)
    if key not in _functions:
        mapped = function.map(f"{key[0]}_{capacity}", "serial", capacity, [], [])
        _functions[key] = mapped, Compiling(mapped)
    mapped, compiling = _functions[key]
    return Kernel(mapped, compiled=compiling, for_later=for_later)


def _capacity(count: int, capacities: Iterable[int]) -> int:
    """Return the largest capacity of which no more than half would be padding, else the smallest."""
    fitting = [c for c in capacities if c <= 2 * count]
    return max(fitting) if fitting else min(capacities)
