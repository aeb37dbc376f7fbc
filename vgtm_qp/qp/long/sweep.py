"""A CasADi function of one period as a recursion along all of them, in one call."""

from __future__ import annotations

import casadi as ca
import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.compiled import Kernel
from vgtm_qp.qp.long.chain import Chain


class Sweep(Kernel):
    """A period's function run along the chain: its first argument is its first result for the period before.

    CasADi maps a function in order. First argument and first result share memory, shifted by one period, so
    that the map is a recursion. The other arguments are read from the given arrays.

    Attributes
    ----------
    carry : (n + 1, size)
        Results handed to the next period; row 0 is the start.
    """

    def __init__(self, function: ca.Function, periods: int, *arguments: Array) -> None:
        super().__init__(function.map(periods))
        size = function.nnz_in(0)
        self.carry: Array = np.zeros((periods + 1, size))
        flat = self.carry.reshape(-1)
        for k, array in enumerate((flat[: periods * size], *arguments)):
            self.bind_input(k, array)
        self.bind_output(0, flat[size:])


class ChainClosing(Sweep):
    """Closes member lengths by Newton steps with the Jacobian that a QP has factorised.

    Errors after a QP are small, so that such steps converge fast; each costs one substitution. The function is one of
    ``Elimination.newton``.

    Attributes
    ----------
    aims : tuple of (n, ...) arrays
        Arguments after the positions: target lengths and points.
    lengths : (n, 3m)
        Of the members in the configuration that the last step started from, m.
    """

    def __init__(self, chain: Chain, function: ca.Function, head: Array, gains: Array) -> None:
        super().__init__(function, chain.periods, head, gains)
        self._base = chain.window[0, : len(chain.carried)]
        self.aims = tuple(array.reshape(chain.periods, -1) for array in self.inputs[4:])
        self.lengths = self.outputs[2].reshape(chain.periods, -1)

    def start(self, base: Array) -> None:
        """Put base nodes at their rows of `base` (N, 3), m."""
        self.carry[0] = 0.0
        self.carry[0, : 3 * len(self._base)] = base[self._base].reshape(-1)

    def step(self, X: Array) -> tuple[Array, float]:
        """Return the positions after one step from `X` (n m, 3), and the greatest error before it, m."""
        self.inputs[3][:] = X.reshape(-1)
        self()
        return self.outputs[1].reshape(-1, 3), float(np.abs(self.outputs[3]).max())
