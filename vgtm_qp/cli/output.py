"""What the commands share: options, exit codes, and what is written: results on stdout, all else on stderr."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Iterable, Sequence
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TextIO

from cyclopts import Parameter

from vgtm_qp.errors import Mistake, ProblemError

Output = partial(Parameter, name=["--output", "-o"])
Switch = partial(Parameter, negative="")
"""An option that is given or not: it has no opposite."""
Json = Annotated[bool, Switch(show_default=False, help="print exactly one JSON document on stdout")]
ProblemName = Annotated[str, Parameter(help="problem file, or the name of a bundled problem (vgtm list)")]
ResultFile = Annotated[Path, Parameter(name="RESULT", help="result file, .npz")]


class ExitCode(IntEnum):
    """What the exit code of ``vgtm`` says."""

    SOLVED = 0
    INTERNAL = 1
    USAGE = 2
    BLOCKED = 3
    UNVERIFIED = 4
    INTERRUPTED = 130


def answer(data: Any, text: str, *, as_json: bool) -> None:
    """Print `data` as a JSON document, or `text`."""
    if as_json:
        document(data)
    else:
        say(text)


def document(data: Any) -> None:
    """Print `data` as one strict JSON document on stdout."""
    say(json.dumps(data, indent=2, ensure_ascii=False, allow_nan=False))


def say(text: str) -> None:
    """Print `text` on stdout."""
    _write(sys.stdout, text)


def note(text: str) -> None:
    """Print `text` on stderr."""
    _write(sys.stderr, text)


def table(rows: Iterable[Sequence[str]], *, indent: str = "") -> str:
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


def check_writable(path: Path, option: str, suffixes: Sequence[str]) -> None:
    """Raise ProblemError where `path` cannot be written or lacks one of `suffixes`; create nothing."""
    if path.suffix.lower() not in suffixes:
        expected = f"the name of a file that ends in {' or '.join(suffixes)}"
    elif path.is_dir():
        expected = "the name of a file; this is a folder"
    elif hindrance := why_not_writable(path.absolute().parent):
        expected = f"a place that can be written; {hindrance}"
    else:
        return
    raise ProblemError("command line", [Mistake(option, f'"{path}"', expected)])


def why_not_writable(folder: Path) -> str:
    """Return why no file can be made in `folder`, which need not exist yet; empty where one can."""
    try:
        while not folder.exists() and folder != folder.parent:
            folder = folder.parent
        with tempfile.TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return f"{folder}: {error.strerror}"
