"""The process that compiles kernels: it reads functions from its input and leaves shared libraries in the cache.

It is a process of its own, in a session of its own. The process that computes hands over its functions and
goes on: it waits neither for generated code nor for the C compiler, and may end before the libraries are
there.

A library is made in a folder beside it, ``NAME.so.new``, and moved to its place when it is complete. The
process that makes this folder makes the library; other processes wait for it.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.compiled import FLAGS, HUNG, QUICK, WRONG, digest_file, is_sound

_LONG = 100_000
"""Length of a source text, in characters, above which compiling takes seconds."""

_MOST_COMPILERS, _MOST_LINKERS = 4, 64
"""Processes at a time; most linkers only wait for their objects."""

_NICENESS = 5
"""Niceness of the compilers, which lets other work go first."""

_TICK = 0.05
"""Seconds after which a file that another process makes is looked for again."""

_ABANDONED = 3.0
"""Age at which a folder counts as abandoned, over the time after which a compiler counts as hung."""

_TRIALS, _ERROR, _LAST_DIGITS = 3, 1e-6, 1e-12
"""Arguments at which code is compared with its function; difference, over the greatest value, that is no rounding; and
relative differences of arguments that may do as much as rounding does on the way."""

_WORTH_IT = 100
"""Number of lines below which functions are not compiled separately."""

_FUNCTION = re.compile(r"^static int (casadi_f\d+)\(.*?^}\n", re.MULTILINE | re.DOTALL)
_HELPER = re.compile(
    r"^(?:static |inline )*casadi_real (casadi_\w+)\([^;{]*\{(?:[^\n]*\}\n|.*?^\}\n)",
    re.MULTILINE | re.DOTALL,
)
_PRELUDE = """#include <math.h>
#define casadi_real double
#define casadi_int long long int
"""


def source_of(function: ca.Function) -> str:
    """Return the C code of a function, whose arguments must all be given."""
    generator = ca.CodeGenerator(f"{function.name()}.c", {"with_header": False})
    generator.add(function)
    # CasADi looks at each use of an argument whether it is missing, and keeps zeros for it.
    return re.sub(r"(arg\[\d+\]) ?\? (\1(?:\[\d+\])?) : \w+;", r"\2;", str(generator.dump()))


def split(source: str) -> tuple[str, dict[str, str]]:
    """Return `source` with its long straight-line functions only declared, and their texts by new names.

    A straight-line function calls nothing but one-line helpers. Its new name is a hash of its text: a
    function that is mapped over faces or bays is compiled once for all kernels.
    """
    helpers = {match.group(1): match.group(0) for match in _HELPER.finditer(source)}
    units: dict[str, str] = {}
    renamed: dict[str, str] = {}
    for match in _FUNCTION.finditer(source):
        name, text = match.group(1), match.group(0)
        used = set(re.findall(r"\bcasadi_\w+", text)) - {name, "casadi_real", "casadi_int"}
        if text.count("\n") < _WORTH_IT or not used <= helpers.keys():
            continue
        body = text[text.index("(") :]
        before = "".join(
            re.sub(r"^(?:static |inline )*", "static inline ", helpers[helper]) for helper in sorted(used)
        )
        unit = f"vgtm_{hashlib.sha256((before + body).encode()).hexdigest()[:32]}"
        units[unit] = f"{_PRELUDE}{before}int {unit}{body}"
        renamed[name] = unit
        source = source.replace(text, f"int {unit}{body[: body.index('{')].rstrip()};\n", 1)
    for name, unit in renamed.items():
        source = re.sub(rf"^#define {name} .*\n", "", source, flags=re.MULTILINE)
        source = re.sub(rf"\b{name}\b", unit, source)
    return source, units


def _with_fast_helpers(source: str) -> str:
    """Return `source` with the helpers before its first function, such as matrix products, set to -O2."""
    head = re.search(r"^/\* \w+:\(", source, flags=re.MULTILINE)
    if head is None:
        return source
    before, after = source[: head.start()], source[head.start() :]
    return (
        '#include <math.h>\n#pragma GCC push_options\n#pragma GCC optimize ("O2")\n'
        f"{before}#pragma GCC pop_options\n{after}"
    )


def is_true_to(function: ca.Function, library: Path) -> bool:
    """Whether a library has the values of the function that it was made of; compilers make mistakes.

    It has not if a result is another one at all of some random arguments, by more than rounding can do: arguments that
    differ in their last digits show how much that is. What has no values there is not compared.
    """
    rng = np.random.default_rng(0)
    differs = np.ones(function.n_out(), dtype=bool)
    for _ in range(_TRIALS):
        given = [rng.uniform(0.5, 1.5, function.nnz_in(k)) for k in range(function.n_in())]
        nearly = [values * (1.0 + _LAST_DIGITS * rng.uniform(-1.0, 1.0, values.shape)) for values in given]
        try:
            compiled = ca.external(function.name(), str(library))
            pairs = (function, given), (function, nearly), (compiled, given)
            every = list(zip(*(_values(*pair) for pair in pairs), strict=True))
        except RuntimeError:
            return True
        for k, (wanted, close, found) in enumerate(every):
            error = _ERROR * np.abs(wanted).max(initial=1.0) + np.abs(close - wanted).max(initial=0.0)
            # Infinities are equal; NaN differs from everything, and proves nothing.
            off = (wanted != found) & ~(np.abs(wanted - found) <= error)
            differs[k] &= bool(off.any()) and not np.isnan(wanted).any()
    return not differs.any()


def _values(function: ca.Function, given: list[NDArray[np.float64]]) -> list[NDArray[np.float64]]:
    """Return the nonzeros of the results of a function at those of its arguments."""
    arguments = [ca.DM(function.sparsity_in(k), values) for k, values in enumerate(given)]
    return [np.array(result.nonzeros()) for result in function.call(arguments)]


class Builder:
    """The compilers at work and the objects they make.

    Attributes
    ----------
    patience : float
        Seconds after which a compiler counts as hung.
    hung, erred : bool
        Whether one hung, or made code of other values than its function's.
    """

    def __init__(self) -> None:
        self.patience = 60.0
        self.hung = self.erred = self._stopped = False
        self._lock = threading.Lock()
        self._compilers = ThreadPoolExecutor(min(_MOST_COMPILERS, os.cpu_count() or 1))
        self._linkers = ThreadPoolExecutor(_MOST_LINKERS)
        self._objects: dict[Path, Future[bool]] = {}
        self._running: set[subprocess.Popen[bytes]] = set()

    def build(self, job: dict[str, Any]) -> None:
        """Begin to make a ``library`` by the compiler ``cc`` of a serialised ``function``, or of a ``text`` of C.

        The job's ``key`` tells compilers and machines apart; a text has ``flags`` of its own.
        """
        library, cc = Path(job["library"]), job["cc"]
        if is_sound(library):
            return
        main, texts, function = library.with_suffix(".o"), {}, None
        if "text" in job:
            rest, flags = job["text"], job["flags"]
        else:
            function = ca.Function.deserialize(job["function"])
            rest, units = split(source_of(function))
            texts = {library.with_name(f"{name}-{job['key']}.o"): text for name, text in units.items()}
            flags = QUICK if len(rest) > _LONG else ()
            rest = _with_fast_helpers(rest) if flags else rest
        texts[main] = rest
        # The longest first, so that at the end nothing waits for it alone.
        objects = {
            path: self._compile(
                cc, texts[path], path, flags if path == main else (), library if path == main else None
            )
            for path in sorted(texts, key=lambda path: -len(texts[path]))
        }
        self._linkers.submit(self._link, cc, objects, library, function)

    def finish(self) -> None:
        """Wait for all libraries."""
        self._linkers.shutdown()
        self._compilers.shutdown()

    def stop(self) -> None:
        """End the compilers that run, with all their children, and begin no other."""
        with self._lock:
            self._stopped = True
            running = list(self._running)
        for process in running:
            _end(process)

    def _compile(
        self, cc: str, text: str, target: Path, flags: tuple[str, ...], library: Path | None
    ) -> Future[bool]:
        """Begin to compile `text` into the object `target`, unless that is done or being done.

        An object for one `library` alone is not needed once this library is there or being linked.
        """
        begun = self._objects.get(target)
        if begun is None or (begun.done() and not is_sound(target)):
            command = [*shlex.split(cc), *FLAGS, *flags, "-x", "c", "-c", "-"]
            self._objects[target] = self._compilers.submit(self._make, target, command, text, library=library)
        return self._objects[target]

    def _link(
        self, cc: str, objects: dict[Path, Future[bool]], library: Path, function: ca.Function | None
    ) -> None:
        """Make the shared library of `objects`, which must have the values of the `function`."""
        if all(begun.result() for begun in objects.values()):
            command = [*shlex.split(cc), "-shared", *map(str, objects), "-lm"]
            self._make(library, command, spent=library.with_suffix(".o"), function=function)

    def _make(
        self,
        target: Path,
        command: list[str],
        text: str = "",
        *,
        spent: Path | None = None,
        library: Path | None = None,
        function: ca.Function | None = None,
    ) -> bool:
        """Have a compiler read `text` and write all of `target`, or nothing; return whether it is there.

        It is not where it is not true to its `function`.

        The file `spent` is removed before the target is there. See :meth:`_compile` for `library`.
        """
        folder = _folder_of(target)
        with contextlib.suppress(OSError):
            while not (self._stopped or is_sound(target) or (library is not None and is_sound(library))):
                try:
                    folder.mkdir(mode=0o700)
                except FileExistsError:
                    # Another process makes it, or was killed while it did.
                    if not self._is_being_made(target):
                        shutil.rmtree(folder, ignore_errors=True)
                    time.sleep(_TICK)
                    continue
                if library is not None and (is_sound(library) or self._is_being_made(library)):
                    # Another process links it, and may have removed the object that it made.
                    shutil.rmtree(folder, ignore_errors=True)
                    time.sleep(_TICK)
                    continue
                try:
                    made = folder / "made"
                    if not is_sound(target) and self._run([*command, "-o", str(made)], text, folder):
                        if spent is not None:
                            spent.unlink(missing_ok=True)
                            digest_file(spent).unlink(missing_ok=True)
                        if function is not None and not is_true_to(function, made):
                            self.erred = True
                            break
                        _publish(made, target)
                finally:
                    shutil.rmtree(folder, ignore_errors=True)
                break
        return is_sound(target)

    def _is_being_made(self, target: Path) -> bool:
        """Whether a process makes `target`; the folder of a killed process counts until it is too old."""
        folder = _folder_of(target)
        return folder.exists() and _age(folder) <= _ABANDONED * self.patience

    def _run(self, command: list[str], text: str, folder: Path) -> bool:
        """Run a compiler; return whether it succeeded. One that hangs is ended, and no other is begun."""
        with self._lock:
            if self._stopped or self.hung:
                return False
            process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                # With a pipe the end of the process is seen at once; without one it is polled twenty times a
                # second.
                stderr=subprocess.PIPE,
                env={**os.environ, "TMPDIR": str(folder)},
                start_new_session=True,
            )
            self._running.add(process)
        with process:
            try:
                process.communicate(text.encode(), timeout=self.patience)
            except subprocess.TimeoutExpired:
                self.hung = True
                _end(process)
        with self._lock:
            self._running.discard(process)
        return process.returncode == 0


def _folder_of(target: Path) -> Path:
    """Return the folder in which a file of the cache is made."""
    return target.with_name(f"{target.name}.new")


def _age(folder: Path) -> float:
    """Return how long ago a folder was changed, s; zero where it is gone."""
    try:
        return time.time() - folder.stat().st_mtime
    except OSError:
        return 0.0


def _publish(made: Path, target: Path) -> None:
    """Move a file of the cache to its place, its digest before it."""
    made.chmod(0o644)
    digest = digest_file(made)
    digest.write_text(hashlib.sha256(made.read_bytes()).hexdigest(), encoding="utf-8")
    digest.chmod(0o644)
    # Other processes would make a file again whose digest is not there yet.
    digest.replace(digest_file(target))
    made.replace(target)


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill what is left of a compiler and its children, which are a session of their own."""
    if process.poll() is None:
        with contextlib.suppress(OSError):
            if hasattr(os, "killpg"):
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()


def main() -> int:
    """Make the library of each job that comes by standard input."""
    if hasattr(os, "nice"):
        os.nice(_NICENESS)
    builder = Builder()

    def stop(*_: Any) -> None:
        builder.stop()
        raise SystemExit(1)

    signal.signal(signal.SIGTERM, stop)
    # The last job is None, or cut short.
    with contextlib.suppress(EOFError, pickle.UnpicklingError):
        while (job := pickle.load(sys.stdin.buffer)) is not None:
            builder.patience = job["patience"]
            with contextlib.suppress(OSError, RuntimeError):
                builder.build(job)
    builder.finish()
    return HUNG if builder.hung else WRONG if builder.erred else 0
