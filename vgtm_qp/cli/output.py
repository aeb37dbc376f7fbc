"""What the commands share: options, exit codes, and what is written: results on stdout, all else on stderr."""

from __future__ import annotations

import errno
import json
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TextIO

from cyclopts import Parameter

from vgtm_qp.errors import Mistake, ProblemError
from vgtm_qp.notices import spoken

if TYPE_CHECKING:
    from vgtm_qp.maneuver.solve import Progress
    from vgtm_qp.step.step import Step

Output = partial(Parameter, name=["--output", "-o"])
Switch = partial(Parameter, negative="")
"""An option without a negative form."""
Json = Annotated[bool, Switch(show_default=False, help="print exactly one JSON document on stdout")]
ProblemName = Annotated[str, Parameter(help="problem file, or the name of a bundled problem (vgtm list)")]
ResultFile = Annotated[Path, Parameter(name="RESULT", help="result file, .npz")]


_READER_ENDED = {errno.EPIPE, errno.EINVAL}
"""Error numbers of the system, EINVAL on Windows, where nobody reads any more what is written."""


class ExitCode(IntEnum):
    """Exit codes of ``vgtm``."""

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
    """Write and flush; a missing stream, or a reader that has ended, as ``head`` does, is not an error."""
    if stream is None:
        return
    encoding = stream.encoding or "utf-8"
    try:
        print(text.encode(encoding, "replace").decode(encoding), file=stream, flush=True)
    except OSError as error:
        if error.errno not in _READER_ENDED:
            raise
        # What is left in the buffer would fail again when Python closes the stream at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def check_writable(path: Path, option: str, suffixes: Sequence[str]) -> None:
    """Raise ProblemError where `path` cannot be written or lacks one of `suffixes`; create nothing, no folder."""
    folder = path.absolute().parent
    if path.suffix.lower() not in suffixes:
        expected = f"the name of a file that ends in {' or '.join(suffixes)}"
    elif path.is_dir():
        expected = "the name of a file; this is a folder"
    elif not folder.is_dir():
        expected = (
            f"a place in a folder that there is; {folder} is {'a file' if folder.exists() else 'missing'}"
        )
    elif hindrance := why_not_writable(folder):
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


asked_to_end = threading.Event()
"""Set by an interrupt of the command that runs."""


@contextmanager
def following(title: str, *, shown: bool) -> Iterator[Progress]:
    """Give the function that ``solve`` calls after each step: it moves a bar if stderr is a terminal.

    Until the first step the bar says that the arm is set up.

    The first interrupt after the first step takes effect when the step under way is done, so that all solved
    states are whole; a second one takes effect at once.
    """
    interrupted = threading.Event()
    before: Any = None

    def interrupt(_signum: int, _frame: Any) -> None:
        if interrupted.is_set():
            raise KeyboardInterrupt
        interrupted.set()

    def after_step(fraction: float, _step: Step) -> None:
        nonlocal before
        if before is None and threading.current_thread() is threading.main_thread():
            before = signal.signal(signal.SIGINT, interrupt)
        advance(fraction, 1.0)
        if interrupted.is_set() or asked_to_end.is_set():
            raise KeyboardInterrupt

    with bar(title, shown=shown, first="set-up") as advance:
        try:
            yield after_step
        finally:
            if before is not None:
                signal.signal(signal.SIGINT, before)


class MoveBar(Protocol):
    """Moves a bar to `done` of `total`, and gives it another `title`."""

    def __call__(self, done: float, total: float, title: str = "") -> None:
        """Move it."""


@contextmanager
def waiting(title: str, *, shown: bool) -> Iterator[None]:
    """Show that something is under way, and since when, if stderr is a terminal."""
    with bar(title, shown=shown):
        yield


@contextmanager
def bar(title: str, *, shown: bool, counted: bool = False, first: str = "") -> Iterator[MoveBar]:
    """Give the function that moves a bar if stderr is a terminal.

    Beside the bar are a percentage or, if things are `counted`, their number, the time that has passed and that is
    left. What comes `first`, before the bar is moved, is told beside the title.
    """
    if not shown or not on_terminal():
        yield lambda done, total, title="": None  # noqa: ARG005
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, Task, TaskProgressColumn, TextColumn
    from rich.progress import ProgressColumn as Column
    from rich.text import Text

    class Times(Column):
        """The time that has passed, and that is left."""

        def render(self, task: Task) -> Text:
            left = task.time_remaining
            words = [spoken(max(1.0, task.elapsed or 0.0)), f"{spoken(max(1.0, left))} left" if left else ""]
            return Text(", ".join(filter(None, words)), style="progress.elapsed")

    share = MofNCompleteColumn() if counted else TaskProgressColumn()
    columns = (TextColumn("{task.description}"), BarColumn(), share, Times())
    # What is written on stdout meanwhile stays there.
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, redirect_stdout=False) as shown_bar:
        task = shown_bar.add_task(escape(f"{title}: {first}" if first else title), total=None)

        def advance(done: float, total: float, title: str = title) -> None:
            shown_bar.update(task, completed=done, total=total, description=escape(title))

        yield advance


def on_terminal() -> bool:
    """Return whether somebody reads stderr as it is written."""
    return sys.stderr is not None and sys.stderr.isatty()
