"""Members brought to their lengths, bay after bay, by Newton steps with the Jacobian that the QP has factorised.

What is left after a QP is small, so that such steps converge fast, and each costs one substitution.
"""

from __future__ import annotations

from collections.abc import Sequence

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

    def __init__(self, chain: Chain, function: ca.Function, kept: Sequence[Array]) -> None:
        if chain.window is None:
            raise ValueError("the periods of this chain are not alike")
        self._base = chain.window[0, : len(chain.carried)]
        self._sweep = Sweep(function, chain.periods)
        for k, array in enumerate(kept):
            self._sweep.bind_input(1 + k, array)
        first = 1 + len(kept)
        self._positions = self._sweep.inputs[first]
        self.aims = tuple(array.reshape(chain.periods, -1) for array in self._sweep.inputs[first + 1 :])
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
        return self._sweep.outputs[1].reshape(-1, 3), float(self._sweep.carry[-1, -1])

    def run(self, X: Array, enough: float) -> tuple[Array, float]:
        """Return positions (n m, 3) near `X` with errors no more than `enough` where that works, and the greatest."""
        for _ in range(MOST_STEPS):
            closer, worst = self.step(X)
            if worst <= enough or not worst < TOO_FAR:
                break
            X = closer.copy()
        return X, worst
