"""Markdown tables, and two statistics of measurements: growth exponents and confidence intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]], *, right: bool = False) -> str:
    """Return a Markdown table with aligned columns, all but the first to the `right` where asked for."""
    cells = [list(header), *([cell.replace("|", "/") for cell in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = []
    for row in cells:
        first, *others = zip(row, widths, strict=True)
        aligned = [f"{cell:>{width}}" if right else f"{cell:<{width}}" for cell, width in others]
        lines.append("| " + " | ".join([first[0].ljust(first[1]), *aligned]) + " |")
    lines.insert(1, "|" + "|".join("-" * (width + 2) for width in widths) + "|")
    return "\n".join(lines)


def crossed_table(
    titles: Sequence[str], columns: Mapping[Any, str], lines: Mapping[Any, Mapping[Any, str]]
) -> str:
    """Return a Markdown table of `lines`: by the names that a line begins with, its cells by column key.

    `titles` head the names, the values of `columns` the cells. A missing cell is "-", and a line without
    cells is left out.
    """
    rows = [(*names, *(cells.get(key, "-") for key in columns)) for names, cells in lines.items() if cells]
    return markdown_table((*titles, *columns.values()), rows)


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
