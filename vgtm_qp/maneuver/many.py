"""Many maneuvers at once, over processes."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor

from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.maneuver.solve import solve
from vgtm_qp.problem import Problem

_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def solve_many(
    problems: Iterable[Problem], *, workers: int | None = None, verify: bool = True
) -> Iterator[Maneuver]:
    """Solve problems in processes of their own and yield their maneuvers in order.

    Each process solves one problem after another with a resolver of its own and one BLAS thread. Kernels are compiled
    once for all of them, into the cache that they share.

    Parameters
    ----------
    problems
        What `load_problem` returns.
    workers
        Number of processes; that of the processors by default.
    verify
        Check each result again from its nodes alone.

    Raises
    ------
    VgtmError
        What `solve` raises for a problem, when its turn comes; the maneuvers before it were yielded.
    concurrent.futures.process.BrokenProcessPool
        A process was killed from outside.
    """
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, mp_context=context) as pool:
            tasks = [pool.submit(solve, problem, verify=verify) for problem in problems]
            try:
                for task in tasks:
                    yield task.result()
            finally:
                for task in tasks:
                    task.cancel()
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
