"""The progress bar, and an interrupt that waits for the end of the step."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
        advance(fraction, 1.0)
        if interrupted.is_set():
            raise KeyboardInterrupt

    with bar(title, shown=shown) as advance:
        try:
            yield after_step
        finally:
            if before is not None:
                signal.signal(signal.SIGINT, before)


@contextmanager
def bar(title: str, *, shown: bool, counted: bool = False) -> Iterator[Callable[[float, float], None]]:
    """Give what moves a bar on stderr to what is done of the total, if that is a terminal.

    The bar has a percentage beside it, or where things are `counted` their number.
    """
    if not shown or not sys.stderr.isatty():
        yield lambda _done, _total: None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import MofNCompleteColumn, Progress

    description, line, percentage, remaining = Progress.get_default_columns()
    columns = (description, line, MofNCompleteColumn() if counted else percentage, remaining)
    with Progress(*columns, console=Console(stderr=True), transient=True) as shown_bar:
        task = shown_bar.add_task(escape(title), total=None if counted else 1.0)
        yield lambda done, total: shown_bar.update(task, completed=done, total=total)
