"""The picture of an object in a notebook: a table in HTML."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

_WRONG = ' style="color:#b91c1c;font-weight:bold"'


def html_table(title: str, rows: Iterable[Sequence[object]], head: Sequence[str] = ()) -> str:
    """Return a titled table; rows that begin with FAIL are red."""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    lines = [f"<tr>{top}</tr>"] if head else []
    for row in rows:
        look = _WRONG if row and row[0] == "FAIL" else ""
        cells = "".join(f'<td style="text-align:left">{escape(str(cell))}</td>' for cell in row)
        lines.append(f"<tr{look}>{cells}</tr>")
    return f"<p>{escape(title)}</p><table>{''.join(lines)}</table>"
