"""Whether a file can be written, asked before the work that it is meant for."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

from vgtm_qp.errors import Mistake, ProblemError


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
