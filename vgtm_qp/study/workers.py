"""Independent tasks on one process, several processes or a Dask cluster; a crash loses only its own task."""

from __future__ import annotations

import logging
import multiprocessing
import signal
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from importlib import import_module
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from vgtm_qp.errors import MissingExtraError
from vgtm_qp.machine import noting_interrupts, pin_threads
from vgtm_qp.notices import ROOT, Notices

Task = dict[str, Any]
Row = dict[str, Any]

HANG = 900.0
"""Seconds after which a task counts as hung."""
_BEGUN = {"begun": True}
"""Message of a process that begins a task: the time of its own start does not count as the task's."""


def run_task(function: str, task: Task) -> Row:
    """Return the row of a task; `function` is ``"module:name"``. An exception becomes a row with its text."""
    module, name = function.split(":")
    try:
        return dict(getattr(import_module(module), name)(**task))
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        return {"failed": f"{type(error).__name__}: {error} ({Path(last.filename).name}:{last.lineno})"}


def run_here(function: str, tasks: Sequence[Task]) -> Iterator[tuple[int, Row]]:
    """Yield number and row of each task, one after another in this process; an interrupted task has no row."""
    interrupted = threading.Event()
    with noting_interrupts(interrupted):
        for k, task in enumerate(tasks):
            row = run_task(function, task)
            if interrupted.is_set():
                # An interrupted maneuver ends with the steps that it made, as if it were blocked.
                raise KeyboardInterrupt
            yield k, row


def run_processes(
    function: str, tasks: Sequence[Task], workers: int, *, hang: float = HANG
) -> Iterator[tuple[int, Row]]:
    """Yield number and row of each task as `workers` processes finish them.

    A process that dies, or takes longer than `hang` seconds for a task, loses only that task: another process
    takes its place, and the task is tried once more, alone, when all others are done. If that fails too, its
    row says so.
    """
    again: list[int] = []
    for k, row in _pool(function, enumerate(tasks), workers, hang):
        if row is None:
            again.append(k)
        else:
            yield k, row
    for k in again:
        for _, row in _pool(function, [(k, tasks[k])], 1, hang):
            yield k, row or {"failed": f"its process died, or took longer than {hang:g} s, twice"}


def run_dask(function: str, tasks: Sequence[Task], address: str) -> Iterator[tuple[int, Row]]:
    """Yield number and row of each task as the workers of a dask.distributed cluster finish them.

    Raises
    ------
    MissingExtraError
        Dask is not installed.
    """
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise MissingExtraError("cluster", "distributed") from None
    with Client(address) as client:
        futures = {client.submit(run_task, function, task, pure=False): k for k, task in enumerate(tasks)}
        for future in as_completed(futures):
            # If a worker dies, Dask itself gives its task to another one, three times by default.
            failed = future.exception()
            yield futures[future], {"failed": f"its worker died: {failed}"} if failed else future.result()


class _Worker:
    """A process that answers one task at a time, and the time at which it counts as hung."""

    def __init__(self, *, is_alone: bool) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, is_alone), daemon=True)
        self._process.start()
        theirs.close()

    def give(self, function: str, number: int, task: Task) -> None:
        self.number, self.deadline = number, time.monotonic() + HANG
        self.pipe.send((function, task))

    def answer(self) -> Row | None:
        """Return the process's answer; None if it died."""
        try:
            return dict(self.pipe.recv())
        except (EOFError, OSError):
            return None

    def stop(self) -> None:
        self._process.kill()
        self._process.join()
        self.pipe.close()


def _pool(
    function: str, tasks: Iterable[tuple[int, Task]], workers: int, hang: float
) -> Iterator[tuple[int, Row | None]]:
    """Yield number and row of each numbered task, None where its process died or hung."""
    # The processes inherit this before they import NumPy.
    pin_threads()
    waiting = deque(tasks)
    busy: list[_Worker] = []
    try:
        while waiting or busy:
            while waiting and len(busy) < workers:
                busy.append(_Worker(is_alone=workers == 1))
                busy[-1].give(function, *waiting.popleft())
            ready: list[Any] = wait([worker.pipe for worker in busy], timeout=0.5)
            for worker in list(busy):
                row = worker.answer() if worker.pipe in ready else None
                if row == _BEGUN:
                    worker.deadline = time.monotonic() + hang
                    continue
                if worker.pipe not in ready and time.monotonic() < worker.deadline:
                    continue
                yield worker.number, row
                if row is not None and waiting:
                    worker.give(function, *waiting.popleft())
                else:
                    busy.remove(worker)
                    worker.stop()
    finally:
        for worker in busy:
            worker.stop()


def _serve(pipe: Connection, is_alone: bool) -> None:
    """Answer tasks until the other end closes; interrupts are left to the other process."""
    from vgtm_qp.compiled import OFTEN, SELDOM, compile_after

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.getLogger(ROOT).addHandler(Notices(partial(print, file=sys.stderr, flush=True)))
    # Beside other processes, compiling the kernels of an arm costs more than it gains in a few maneuvers.
    compile_after(OFTEN if is_alone else SELDOM)
    while True:
        try:
            function, task = pipe.recv()
        except EOFError:
            return
        pipe.send(_BEGUN)
        pipe.send(run_task(function, task))
