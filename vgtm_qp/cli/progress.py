"""The progress bar, and an interrupt that waits for the end of the step."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vgtm_qp.maneuver.solve import Progress
    from vgtm_qp.step.resolver import Step


@contextmanager
def following(title: str, *, shown: bool) -> Iterator[Progress]:
    """Give what ``solve`` calls after each step: it moves a bar on stderr, where that is a terminal.

    The first interrupt after the first step takes effect when the step under way is done, so that the states
    which were solved are whole; a second one takes effect at once.
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
        advance(fraction)
        if interrupted.is_set():
            raise KeyboardInterrupt

    with _bar(title) if shown and sys.stderr.isatty() else nullcontext(_nothing) as advance:
        try:
            yield after_step
        finally:
            if before is not None:
                signal.signal(signal.SIGINT, before)


def _nothing(_fraction: float) -> None:
    """Show nothing."""


@contextmanager
def _bar(title: str) -> Iterator[Any]:
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(escape(title), total=1.0)
        yield lambda fraction: bar.update(task, completed=fraction)
