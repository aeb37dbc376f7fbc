"""A CasADi function of one period as a recursion along all of them, in one call."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.compiled import Kernel

Array = NDArray[np.float64]


class Sweep(Kernel):
    """A period's function run along the chain: its first argument is its first result for the period before.

    CasADi maps a function in order and the two share memory, shifted by one period: the map is a recursion. Arrays
    given are what the arguments after the first one are read from.

    Attributes
    ----------
    carry : (n + 1, size)
        What was handed over; row 0 is the start.
    """

    def __init__(self, function: ca.Function, periods: int, *arguments: Array) -> None:
        super().__init__(function.map(periods))
        size = function.nnz_in(0)
        self.carry: Array = np.zeros((periods + 1, size))
        flat = self.carry.reshape(-1)
        for k, array in enumerate((flat[: periods * size], *arguments)):
            self.bind_input(k, array)
        self.bind_output(0, flat[size:])
