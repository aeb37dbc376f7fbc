"""The machine and the versions that a measured time belongs to.

NumPy is not imported: its BLAS reads the number of threads when it is loaded.
"""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

THREADS = (
    "OPENBLAS_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
_TIMED = ("vgtm-qp", "numpy", "scipy", "casadi", "daqp")


def pin_threads() -> bool:
    """Hold BLAS and OpenMP to one thread, here and in child processes; False if BLAS is loaded already.

    The matrices of a step are small: with a second thread a pseudoinverse of ten bays takes a hundred times
    as long.
    """
    late = "numpy" in sys.modules and any(os.environ.get(name) != "1" for name in THREADS[:2])
    os.environ.update(dict.fromkeys(THREADS, "1"))
    return not late


@contextmanager
def environment(changes: Mapping[str, str]) -> Iterator[None]:
    """Change variables of the environment, also for processes started meanwhile, and put them back."""
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def noting_interrupts(noted: threading.Event) -> Iterator[None]:
    """Set `noted` at each interrupt while the main thread is in here; KeyboardInterrupt is raised as usual.

    Code that catches every exception would swallow the interrupt, as CasADi does while it is imported.
    """
    before: Any = None

    def interrupt(_signum: int, _frame: Any) -> None:
        noted.set()
        raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        before = signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        if before is not None:
            signal.signal(signal.SIGINT, before)


def machine_record() -> dict[str, Any]:
    """Return as JSON data: processor, cores, load, system and Python."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        # Windows does not know it.
        "load": [round(value, 2) for value in os.getloadavg()] if hasattr(os, "getloadavg") else [],
        "system": platform.platform(),
        "python": platform.python_version(),
    }


def machine() -> dict[str, str]:
    """Return processor, cores, system, BLAS threads and versions as text, for the foot of a table."""
    return {
        "processor": _processor(),
        "cores": str(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "BLAS threads": os.environ.get("OPENBLAS_NUM_THREADS", "not set"),
        **{name: found or "not installed" for name, found in versions(_TIMED).items()},
    }


def sentence(found: Mapping[str, str]) -> str:
    """Return what `machine` found as one sentence."""
    return ", ".join(f"{name} {value}" for name, value in found.items())


def versions(packages: Iterable[str]) -> dict[str, str | None]:
    """Return the versions of `packages`, None where one is not installed."""
    found: dict[str, str | None] = {}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = None
    return found


def commit() -> str | None:
    """Return the commit of the source tree that this runs from, with "+" if changed since; None elsewhere."""
    root = Path(__file__).resolve().parents[1]
    if not (root / ".git").exists():
        return None
    try:
        head, changes = (
            subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True)
            for arguments in (("rev-parse", "HEAD"), ("status", "--porcelain", "--untracked-files=no"))
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return head.stdout.strip() + ("+" if changes.stdout.strip() else "")


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine())
