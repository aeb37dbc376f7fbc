"""Time and memory of a fresh process: start of the command, first step with a warm or an empty cache.

Run as ``python -m vgtm_qp.bench.fresh``, this module is that process: it reads a problem in JSON from stdin
and writes the measures to stdout. With a file as its argument it solves the problem and writes the result
there.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from itertools import pairwise
from pathlib import Path
from time import perf_counter, process_time, time
from typing import Any

from vgtm_qp.errors import SolverError

resource: Any
try:
    import resource
except ImportError:
    # Windows has no such module.
    resource = None

_PACKAGE_PARENT = Path(__file__).resolve().parents[2]
_STEPS = 5
_REPEATS = 3
_HELP = "from vgtm_qp.cli import main; main(['--help'])"


def measure_start() -> dict[str, float]:
    """Return CPU seconds of a bare interpreter, of one that imports the package, and of ``vgtm --help``.

    Each is the least of three runs, since disturbances only add to it; on Windows, by the clock.
    """
    scripts = {"python": "pass", "import": "import vgtm_qp", "help": _HELP}
    return {name: min(_cpu_seconds_of(script) for _ in range(_REPEATS)) for name, script in scripts.items()}


def measure_fresh(problem: dict[str, Any], *, cold: bool = False) -> dict[str, float]:
    """Return what a fresh process takes to set up a problem in the form of ``Problem.to_dict`` and take a few steps.

    Keys: ``imports``, s, of what a resolver needs; ``setup`` and ``setup_cpu``, s from the problem to a
    resolver that can take its first step, by the clock and as CPU time; ``first_step``, s; ``to_first_step``,
    s by the clock from the start of the process to the end of its first accepted step; ``peak_memory`` and
    ``imported_memory``, the greatest resident memory after some steps and after the imports alone, bytes. If
    `cold`, an empty cache of kernels replaces the user's, and there is one more key, ``to_result``: s by the
    clock from the start of another such process until the whole maneuver is solved, verified and written.

    Raises
    ------
    SolverError
        That process failed; the message has the last line of its stderr.
    """
    found = _run(problem, cold=cold)
    found["to_first_step"] -= found.pop("began")
    if cold:
        began = time()
        _run(problem, "result.npz", cold=True)
        found["to_result"] = time() - began
    return found


def _run(problem: dict[str, Any], *result: str, cold: bool) -> dict[str, float]:
    """Return the measures of a fresh process; none if it writes the solved problem to a file `result`."""
    # Its compiling process may outlive it, and still write into the folder.
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        environment = _environment() | ({"VGTM_CACHE": str(Path(folder) / "cache")} if cold else {})
        began = time()
        done = subprocess.run(
            [
                sys.executable,
                "-P",
                "-m",
                "vgtm_qp.bench.fresh",
                *(str(Path(folder) / name) for name in result),
            ],
            input=json.dumps(problem),
            capture_output=True,
            text=True,
            env=environment,
        )
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise SolverError(f"set-up in a fresh process failed: {lines[-1]}")
    return {} if result else {"began": began, **json.loads(done.stdout)}


def _solve(problem: dict[str, Any], result: str) -> None:
    """Solve a problem, verify the maneuver and write it, as the command does."""
    from vgtm_qp.maneuver.solve import solve
    from vgtm_qp.problem import Problem

    solve(Problem.from_dict(problem)).save(result)


def _measured(problem: dict[str, Any]) -> dict[str, float]:
    """Set a problem up in this process, take some steps, and return the measures."""
    started = perf_counter()
    from vgtm_qp.maneuver.plan import make_plan
    from vgtm_qp.methods import Resolver
    from vgtm_qp.problem import Problem

    loaded = Problem.from_dict(problem)
    imports, imported = perf_counter() - started, _peak_memory()
    clock, cpu = perf_counter(), _cpu_seconds()
    resolver = Resolver(loaded)
    plan = make_plan(loaded, *resolver.tip())
    setup, setup_cpu = perf_counter() - clock, _cpu_seconds() - cpu
    first_step = to_first_step = 0.0
    for start, end in pairwise([plan.path.start, *plan.marks[:_STEPS].tolist()]):
        clock = perf_counter()
        step = resolver.follow(plan.path, start, end)
        first_step = first_step or perf_counter() - clock
        to_first_step = to_first_step or (time() if step.moved else 0.0)
    return {
        "imports": imports,
        "setup": setup,
        "setup_cpu": setup_cpu,
        "first_step": first_step,
        "to_first_step": to_first_step,
        "peak_memory": _peak_memory(),
        "imported_memory": imported,
    }


def _peak_memory() -> int:
    """Return the greatest resident memory of this process, bytes; 0 where the system does not tell.

    On Linux ``ru_maxrss`` begins with what the parent had when it forked; the status file does not.
    """
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    except OSError:
        status = ""
    for line in status.splitlines():
        if line.startswith("VmHWM:"):
            return 1024 * int(line.split()[1])
    if resource is None:
        return 0
    peak = int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return peak if sys.platform == "darwin" else 1024 * peak


def _cpu_seconds() -> float:
    """Return the CPU time of this process and of the children that it waited for, s; on Windows without these."""
    if resource is None:
        return process_time()
    both = (resource.getrusage(whose) for whose in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return float(sum(usage.ru_utime + usage.ru_stime for usage in both))


def _cpu_seconds_of(script: str) -> float:
    before, clock = _cpu_seconds(), perf_counter()
    subprocess.run([sys.executable, "-P", "-c", script], check=True, capture_output=True, env=_environment())
    return perf_counter() - clock if resource is None else _cpu_seconds() - before


def _environment() -> dict[str, str]:
    """Return the environment in which a child finds this very package."""
    found = [str(_PACKAGE_PARENT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(found)}


if __name__ == "__main__":
    given = json.load(sys.stdin)
    if len(sys.argv) > 1:
        _solve(given, sys.argv[1])
    else:
        print(json.dumps(_measured(given)))
