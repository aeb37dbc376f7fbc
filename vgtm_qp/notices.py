"""What a person is told beside results: the warnings that the package logs, and durations in words.

Library code logs under ``vgtm_qp`` and leaves it to the program what becomes of that; without any settings Python
writes warnings to stderr.
"""

from __future__ import annotations

import logging
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager

ROOT = "vgtm_qp"
"""Name of the logger above those of all modules."""


class Notices(logging.Handler):
    """Tells each warning once, in one line, by `tell`; the traceback of an error follows it."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        super().__init__(logging.WARNING)
        self._tell = tell
        self._told: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """Tell a record, unless it was told before."""
        line = f"{record.levelname.lower()}: {' '.join(record.getMessage().split())}"
        if line in self._told:
            return
        self._told.add(line)
        self._tell(line)
        if record.exc_info and record.exc_info[1] is not None:
            self._tell("".join(traceback.format_exception(record.exc_info[1])).rstrip())


@contextmanager
def telling(tell: Callable[[str], None]) -> Iterator[None]:
    """Tell the package's warnings by `tell` while in here, each once."""
    handler, logger = Notices(tell), logging.getLogger(ROOT)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def spoken(seconds: float) -> str:
    """Return a duration as people read it: ``0.82 ms``, ``7.4 s``, ``2 min 5 s``, ``1 h 3 min``."""
    if seconds < 0.9995:
        return f"{1000.0 * seconds:.3g} ms"
    if seconds < 59.95:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    hours, minutes = divmod(round(seconds / 60.0), 60)
    return f"{hours} h {minutes} min"
