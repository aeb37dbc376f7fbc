"""Limits as JSON data, which has no infinity."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def or_none(limits: NDArray[np.float64]) -> list[float | None]:
    """Return limits, None where there is none."""
    return [limit if math.isfinite(limit) else None for limit in limits.tolist()]
