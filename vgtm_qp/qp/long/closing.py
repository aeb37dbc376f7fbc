"""Members brought to their lengths, bay after bay, by Newton steps with the Jacobian that the QP has factorised.

What is left after a QP is small, so that such steps converge fast, and each costs one substitution.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.qp.long.chain import Chain
from vgtm_qp.qp.long.sweep import Sweep

Array = NDArray[np.float64]

MOST_STEPS = 12
TOO_FAR = 1e-2
"""Lengths that are further off than this, m, are not worth trying."""


class ChainClosing:
    """Repeats a sweep of ``elimination.Positions.function`` until the errors vanish.

    Attributes
    ----------
    aims : tuple of (n, ...) arrays
        Arguments of the sweep behind the positions: what it aims at.
    lengths : (n, 3m)
        Of the members in the configuration that the last call returned, m.
    """

    def __init__(self, chain: Chain, function: ca.Function, head: Array, gains: Array) -> None:
        self._base = chain.window[0, : len(chain.carried)]
        self._sweep = Sweep(function, chain.periods, head, gains)
        self._positions = self._sweep.inputs[3]
        self.aims = tuple(array.reshape(chain.periods, -1) for array in self._sweep.inputs[4:])
        self.lengths = self._sweep.outputs[2].reshape(chain.periods, -1)

    def start(self, base: Array) -> None:
        """Let base nodes stand at their rows of `base` (N, 3), m."""
        place = self._base.size * 3
        self._sweep.carry[0, :place] = base[self._base].reshape(-1)
        self._sweep.carry[0, place:] = 0.0

    def step(self, X: Array) -> tuple[Array, float]:
        """Return the positions after one step from `X` (n m, 3), and the greatest error there was before it, m."""
        self._positions[:] = X.reshape(-1)
        self._sweep()
        return self._sweep.outputs[1].reshape(-1, 3), float(np.abs(self._sweep.outputs[3]).max())
