"""What the commands print: results on stdout, all else on stderr; one JSON document where it is asked for."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import Annotated, Any, TextIO

from cyclopts import Parameter

Json = Annotated[
    bool, Parameter(negative="", show_default=False, help="print exactly one JSON document on stdout")
]


class ExitCode(IntEnum):
    """What the exit code of ``vgtm`` says."""

    SOLVED = 0
    INTERNAL = 1
    USAGE = 2
    BLOCKED = 3
    UNVERIFIED = 4
    INTERRUPTED = 130


def document(data: Any) -> None:
    """Print `data` as one strict JSON document on stdout."""
    say(json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False))


def say(text: str) -> None:
    """Print `text` on stdout."""
    _write(sys.stdout, text)


def note(text: str) -> None:
    """Print `text` on stderr."""
    _write(sys.stderr, text)


def table(rows: Iterable[Sequence[str]], *, indent: str = "  ") -> str:
    """Return rows of cells as lines with aligned columns."""
    cells = [list(row) for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in cells]
    return "\n".join((indent + line).rstrip() for line in lines)


def _write(stream: TextIO | None, text: str) -> None:
    """Write and flush; no stream, or a reader that has gone away as ``head`` does, is no reason to fail."""
    if stream is None:
        return
    encoding = stream.encoding or "utf-8"
    try:
        print(text.encode(encoding, "replace").decode(encoding), file=stream, flush=True)
    except BrokenPipeError:
        # What is left in the buffer would fail again when Python closes the stream at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
