"""One scalar kernel over any number of rows: mapped at a few capacities and padded."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.compiled import Kernel

Array = NDArray[np.float64]

_CAPACITIES = (16, 128, 1024)


class Batch:
    """A CasADi function of column vectors, evaluated on rows.

    Capacities are compiled when first needed. Not for two threads at once.
    """

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self._kernels: dict[int, tuple[Kernel, list[Array], list[Array]]] = {}

    def _kernel(self, capacity: int) -> tuple[Kernel, list[Array], list[Array]]:
        if capacity not in self._kernels:
            kernel = Kernel(
                self._function.map(f"{self._function.name()}_{capacity}", "serial", capacity, [], [])
            )
            self._kernels[capacity] = (
                kernel,
                [x.reshape(capacity, -1) for x in kernel.inputs],
                [x.reshape(capacity, -1) for x in kernel.outputs],
            )
        return self._kernels[capacity]

    def __call__(self, *rows: Array) -> Sequence[Array]:
        """Evaluate on `rows`, one (K, width) array per argument.

        Returns
        -------
        sequence of (K, width) arrays
            Views that the next call overwrites.
        """
        count = len(rows[0])
        capacity = _capacity(count)
        if count <= capacity:
            return self._part(capacity, rows, 0, count)
        parts = []
        start = 0
        while start < count:
            capacity = _capacity(count - start)
            stop = min(start + capacity, count)
            parts.append([x.copy() for x in self._part(capacity, rows, start, stop)])
            start = stop
        return [np.concatenate(columns) for columns in zip(*parts, strict=True)]

    def _part(self, capacity: int, rows: Sequence[Array], start: int, stop: int) -> list[Array]:
        kernel, inputs, outputs = self._kernel(capacity)
        size = stop - start
        for target, source in zip(inputs, rows, strict=True):
            target[:size] = source[start:stop]
        kernel()
        return [x[:size] for x in outputs]


def _capacity(count: int) -> int:
    """Return the largest capacity of which no more than half would be padding, else the smallest."""
    fitting = [c for c in _CAPACITIES if c <= 2 * count]
    return fitting[-1] if fitting else _CAPACITIES[0]
