"""Markdown tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any


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
    """Return a Markdown table with a cell for each line and column, "-" where a line has none.

    Parameters
    ----------
    titles
        Of what names the lines.
    columns
        Titles of the columns by their keys.
    lines
        Cells by the keys of their columns, by the tuple of the line's names; a line without cells is left out.
    """
    rows = [(*names, *(cells.get(key, "-") for key in columns)) for names, cells in lines.items() if cells]
    return markdown_table((*titles, *columns.values()), rows)
