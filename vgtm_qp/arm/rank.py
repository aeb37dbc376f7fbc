"""When a Jacobian of an arm counts as rank-deficient."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

RANK_TOLERANCE = 1e-8
"""Singular values below this fraction of the greatest one count as zero."""


def rank(values: NDArray[Any]) -> int:
    """Return the rank that goes with singular values."""
    return int(np.count_nonzero(values > RANK_TOLERANCE * values.max(initial=0.0)))
