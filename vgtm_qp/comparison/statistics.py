"""Of what was measured: growth exponents, orders of convergence and confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """Return p of the least-squares fit values = c sizes^p, in logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return Wilson's interval of a proportion (J. Am. Stat. Assoc. 22, 1927), 95 %."""
    if trials == 0:
        return 0.0, 1.0
    z = 1.96
    share, square = successes / trials, z * z
    middle = (share + square / (2 * trials)) / (1 + square / trials)
    half = z * math.sqrt(share * (1 - share) / trials + square / (4 * trials**2)) / (1 + square / trials)
    return max(middle - half, 0.0), min(middle + half, 1.0)
