"""CasADi functions as kernels: compiled to C once per topology, evaluated in place on NumPy arrays.

``Function.buffer()`` costs 0.5-4 us a call where ``F(array)`` costs 23 us. A kernel is compiled when a C compiler
is there and the library is kept by a hash of its source, so the second process pays only for a `dlopen`. Without a
compiler the CasADi virtual machine evaluates the same graph, 4 to 10 times slower.

The first set-up of an arm is mostly compile time. The straight-line functions that a kernel maps or calls are compiled
separately, once for all kernels that use them, by several processes at a time; a kernel waits for them at its first
call.

What is loaded from the cache runs as this process does. Folder and files must therefore be the user's, with nobody else
allowed to write them, and the SHA-256 beside a library must be that of its content.

The return code of a function shows whether it could be evaluated; if not, its outputs keep their old values. Every call
checks the code, in half a microsecond, so that old outputs never pass as new ones.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shlex
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import threading
import time
import warnings
import weakref
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import EvaluationError

Array = NDArray[np.float64]

_FLAGS = (
    "-O2",
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fPIC",
    "-fvisibility=hidden",
    '-DCASADI_SYMBOL_EXPORT=__attribute__((visibility("default")))',
)
_QUICK = ("-O1",)
"""Flags for long code that calls the straight-line functions: half the compile time, at little cost in speed."""

_OWN = ("-O3", "-fno-signed-zeros", "-fassociative-math")
"""Flags for our own C: sums may be vectorised; NaN and infinity keep their meaning."""

_LONG = 100_000
"""Length of a source text, in characters, from which compiling lasts seconds."""

_MOST_COMPILERS, _MOST_LINKERS = 4, 64
"""Processes at a time; most linkers only wait for their objects."""

_PATIENCE = 60.0
"""Seconds after which a compiler counts as hung."""

_TICK = 0.2
"""Seconds after which a compiler is looked after."""

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


def compiler() -> str | None:
    """Return the command of the C compiler, as a shell reads it; None where there is none.

    It is ``$VGTM_CC``, a program or one with flags, else the first of cc, gcc, clang. ``VGTM_CC=none`` asks for the
    virtual machine.
    """
    wanted = os.environ.get("VGTM_CC")
    if wanted in ("", "none"):
        return None
    commands = [["cc"], ["gcc"], ["clang"]] if wanted is None else [[wanted]]
    if wanted:
        # The whole is tried first, for the path of a program may hold spaces.
        with contextlib.suppress(ValueError):
            commands.append(shlex.split(wanted))
    for program, *flags in filter(None, commands):
        if path := shutil.which(program):
            return shlex.join([path, *flags])
    return None


def cache_directory() -> Path:
    """Return where compiled kernels are kept: ``$VGTM_CACHE``, else the user's cache directory."""
    if "VGTM_CACHE" in os.environ:
        return Path(os.environ["VGTM_CACHE"])
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "vgtm-qp"


def distrust(path: Path) -> str:
    """Return why code from `path`, a folder or a file, may be somebody else's; empty where it is the user's own."""
    if not hasattr(os, "getuid"):
        return ""
    found = path.stat()
    if found.st_uid not in (os.getuid(), 0):
        return f"{path} belongs to another user (number {found.st_uid})"
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"others may write {path}; chmod go-w {shlex.quote(str(path))}"
    return ""


def _digest_file(path: Path) -> Path:
    return path.with_name(f"{path.name}.sha256")


def _is_sound(path: Path) -> bool:
    """Return whether a file of the cache is there, the user's own, and as it was made."""
    with contextlib.suppress(OSError, ValueError):
        digest = _digest_file(path)
        if not distrust(path) and not distrust(digest):
            with path.open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest() == digest.read_text().strip()
    return False


@cache
def _machine() -> str:
    """Return what a ``-march=native`` library depends on beside its source."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")


def _hash(*parts: str) -> str:
    return hashlib.sha256(
        "\0".join((*parts, *_FLAGS, *_QUICK, ca.CasadiMeta.version(), _machine())).encode()
    ).hexdigest()[:32]


def _split(source: str) -> tuple[str, dict[str, str]]:
    """Return `source` with its long straight-line functions left out but declared, and those by their new names.

    A function that calls no other, and uses nothing but one-line helpers, has a name made of its text: what is mapped
    over faces, pairs or bays is one function in however many kernels.
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
        unit = f"vgtm_{_hash(before, body)}"
        units[unit] = f"{_PRELUDE}{before}int {unit}{body}"
        renamed[name] = unit
        source = source.replace(text, f"int {unit}{body[: body.index('{')].rstrip()};\n", 1)
    for name, unit in renamed.items():
        source = re.sub(rf"^#define {name} .*\n", "", source, flags=re.MULTILINE)
        source = re.sub(rf"\b{name}\b", unit, source)
    return source, units


def _with_fast_helpers(source: str) -> str:
    """Return `source` with all before its first function, matrix products among it, compiled as the rest is not."""
    head = re.search(r"^/\* \w+:\(", source, flags=re.MULTILINE)
    if head is None:
        return source
    before, after = source[: head.start()], source[head.start() :]
    return (
        '#include <math.h>\n#pragma GCC push_options\n#pragma GCC optimize ("O2")\n'
        f"{before}#pragma GCC pop_options\n{after}"
    )


class _Workers:
    """The threads in which the compilers of this process run, the objects they make, and the compilers."""

    def __init__(self) -> None:
        self.resolving = threading.RLock()
        self.linkers = ThreadPoolExecutor(_MOST_LINKERS, "vgtm-linker")
        self.hung = False
        self._compilers = ThreadPoolExecutor(min(_MOST_COMPILERS, os.cpu_count() or 1), "vgtm-compiler")
        self._lock = threading.Lock()
        self._objects: dict[Path, Future[bool]] = {}
        self._running: set[subprocess.Popen[bytes]] = set()
        self._stopped = False

    def compile(self, cc: str, text: str, target: Path, flags: tuple[str, ...]) -> Future[bool]:
        """Begin to compile `text` into the object `target`, unless that is done or being done."""
        with self._lock:
            begun = self._objects.get(target)
            if begun is None or (begun.done() and not (begun.result() and target.exists())):
                command = [*shlex.split(cc), *_FLAGS, *flags, "-x", "c", "-c", "-"]
                self._objects[target] = self._compilers.submit(self.make, target, command, text)
            return self._objects[target]

    def link(self, cc: str, objects: dict[Path, Future[bool]], library: Path) -> Path | None:
        """Return the shared library, made of `objects`; None where it cannot be made."""
        made = False
        if all(begun.result() for begun in objects.values()):
            made = self.make(library, [*shlex.split(cc), "-shared", *map(str, objects), "-lm"])
            for left in (library.with_suffix(".o"), _digest_file(library.with_suffix(".o"))):
                with contextlib.suppress(OSError):
                    left.unlink()
        # Another process may have made the library meanwhile, and cleared up.
        return library if made or _is_sound(library) else None

    def make(self, target: Path, command: list[str], text: str = "") -> bool:
        """Have a compiler read `text` and write all of `target`, or nothing; return whether it is there."""
        with contextlib.suppress(OSError):
            if not _is_sound(target):
                target.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
                with tempfile.TemporaryDirectory(dir=target.parent) as scratch:
                    made = Path(scratch) / target.name
                    if self._run([*command, "-o", str(made)], text.encode()):
                        made.chmod(0o644)
                        digest = _digest_file(made)
                        digest.write_text(hashlib.sha256(made.read_bytes()).hexdigest())
                        digest.chmod(0o644)
                        # A library whose digest is not there yet would be made again by others.
                        digest.replace(_digest_file(target))
                        made.replace(target)
        return _is_sound(target)

    def _run(self, command: list[str], text: bytes) -> bool:
        """Run a compiler; return whether it succeeded. One that hangs is ended, and no other is begun."""
        with self._lock:
            if self._stopped or self.hung:
                return False
            process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                # Its end is seen at once, where a process without a pipe is asked twenty times a second.
                stderr=subprocess.PIPE,
                start_new_session=True,
            )
            self._running.add(process)
        end = time.monotonic() + _PATIENCE
        given: bytes | None = text
        with process:
            while True:
                try:
                    process.communicate(given, timeout=_TICK)
                    break
                except subprocess.TimeoutExpired:
                    # What it has not read yet goes on being written.
                    given = None
                    self.hung = time.monotonic() > end
                    if self.hung or _is_interrupted():
                        _end(process)
                        break
        with self._lock:
            self._running.discard(process)
        return process.returncode == 0

    def stop(self) -> None:
        """End the compilers that run, with all their children, and begin no other."""
        with self._lock:
            self._stopped = True
            running = list(self._running)
        for pool in (self._compilers, self.linkers):
            pool.shutdown(wait=False, cancel_futures=True)
        for process in running:
            _end(process)


def _is_interrupted() -> bool:
    """Return whether an interrupt that nobody caught ended the program, which waits for its threads now."""
    last = getattr(sys, "last_type", None)
    return last is KeyboardInterrupt and not threading.main_thread().is_alive()


def _end(process: subprocess.Popen[bytes]) -> None:
    """Kill what is left of a compiler and its children, which are a session of their own."""
    if process.poll() is None:
        with contextlib.suppress(OSError):
            if hasattr(os, "killpg"):
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()


_workers = _Workers()


def _start_anew() -> None:
    """Begin anew in a forked process, which has none of its parent's threads."""
    global _workers
    _workers = _Workers()


def stop_compilers() -> None:
    """End all compilers of this process at once, as an interrupt does; kernels that are wanted later begin anew."""
    global _workers
    stopped, _workers = _workers, _Workers()
    stopped.stop()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_start_anew)


def _begin(function: ca.Function, cc: str) -> Future[Path | None]:
    """Begin to compile `function`; return what will be its shared library, None where it cannot be compiled."""
    generator = ca.CodeGenerator(f"{function.name()}.c", {"with_header": False})
    generator.add(function)
    source = generator.dump()
    folder = cache_directory()
    library = folder / f"{function.name()}-{_hash(source, cc)}.so"
    if _is_sound(library):
        found: Future[Path | None] = Future()
        found.set_result(library)
        return found
    objects: dict[Path, Future[bool]] = {}
    rest, units = _split(source)
    texts = {folder / f"{name}-{_hash(cc)[:8]}.o": text for name, text in units.items()}
    main, quick = library.with_suffix(".o"), _QUICK if len(rest) > _LONG else ()
    texts[main] = _with_fast_helpers(rest) if quick else rest
    # The longest first: nothing waits for it at the end.
    for path in sorted(texts, key=lambda path: -len(texts[path])):
        objects[path] = _workers.compile(cc, texts[path], path, quick if path == main else ())
    return _workers.linkers.submit(_workers.link, cc, objects, library)


class Building:
    """A C source on its way to a shared library; `flags` are the compiler's beside those of every kernel."""

    def __init__(self, name: str, text: str, flags: tuple[str, ...]) -> None:
        self._name, self._text, self._flags, self._cc = name, text, flags, compiler()
        self._library: Future[Path | None] | None = None
        if self._cc is not None and not _warned_of(cache_directory()):
            library = cache_directory() / f"{name}-{_hash(text, self._cc, *flags, *_OWN)}.so"
            objects = {}
            if not _is_sound(library):
                target = library.with_suffix(".o")
                objects[target] = _workers.compile(self._cc, text, target, (*flags, *_OWN))
            self._library = _workers.linkers.submit(_workers.link, self._cc, objects, library)

    @property
    def is_done(self) -> bool:
        """Whether :meth:`result` does not wait."""
        return self._library is None or self._library.done()

    def result(self) -> Path | None:
        """Return the library; None where no compiler works."""
        return None if self._library is None else self._library.result()


class Compiling:
    """A function on its way to machine code; several kernels may wait for the same."""

    def __init__(self, function: ca.Function) -> None:
        self._function, self._cc = function, compiler()
        self.library: Path | None = None
        """The shared library, once it is loaded."""
        self._found: ca.Function | None = None
        self._begin()

    def _begin(self) -> None:
        self._begun_by = _workers
        self._library: Future[Path | None] | None = None
        if self._cc is not None and not _warned_of(cache_directory()):
            self._library = _begin(self._function, self._cc)

    @property
    def is_done(self) -> bool:
        """Whether :meth:`result` does not wait."""
        return self._found is not None or self._library is None or self._library.done()

    def result(self) -> ca.Function:
        """Return the compiled function when it is there, or the one it comes from where no compiler works."""
        if self._found is None:
            try:
                self._found = self._load() or self._function
            except KeyboardInterrupt:
                stop_compilers()
                raise
        return self._found

    def _load(self) -> ca.Function | None:
        if self._begun_by is not _workers:
            # The compilers were at work for the process that this one was forked from, or were interrupted.
            self._begin()
        for _ in range(2):
            library = None
            with contextlib.suppress(CancelledError):
                library = None if self._library is None else self._library.result()
            if library is None:
                break
            try:
                found = ca.external(self._function.name(), str(library))
                self.library = library
                return found
            except RuntimeError:
                # Cut short by a full disk, or from a machine with another C library: compiled once more.
                with contextlib.suppress(OSError):
                    library.unlink(missing_ok=True)
                self._begin()
        if self._begun_by.hung:
            _warn(
                f"the C compiler {self._cc} did not end within {_PATIENCE:g} s: kernels run uncompiled, 4 to 10 times "
                "slower; VGTM_CC names another compiler"
            )
        return None


@cache
def _warn(text: str) -> None:
    """Warn once of what makes kernels slow."""
    warnings.warn(text, stacklevel=2)


def _warned_of(folder: Path) -> bool:
    """Return whether nothing is loaded from the cache at `folder`, and warn of the reason."""
    hindrance = ""
    with contextlib.suppress(OSError):
        hindrance = distrust(folder)
    if hindrance:
        _warn(f"{hindrance}: the kernel cache is not used, kernels run uncompiled, 4 to 10 times slower")
    return bool(hindrance)


_waiting: weakref.WeakSet[Kernel] = weakref.WeakSet()


def finish_compiling() -> None:
    """Wait until all kernels of this process are compiled, so that none of them has to be waited for later.

    Those that were begun for later go on being compiled.
    """
    for kernel in list(_waiting):
        _ = kernel.is_compiled


class Kernel:
    """A CasADi function bound to arrays that live as long as it does: `inputs` and `outputs`.

    They are one flat float64 array per argument and result: the nonzeros in CasADi's column-major order. Write the
    inputs in place, call the kernel, read the outputs. One kernel must not be called by two threads at once.
    """

    def __init__(
        self, function: ca.Function, *, compiled: bool | Compiling = True, for_later: bool = False
    ) -> None:
        self._given, self.name = function, function.name()
        self.library: Path | None = None
        self._compiling = Compiling(function) if compiled is True else compiled or None
        self._found: ca.Function | None = None
        self._buffer: Any = None
        self.inputs: list[Array] = [np.zeros(function.nnz_in(i)) for i in range(function.n_in())]
        self.outputs: list[Array] = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
        if self._compiling is None:
            self._resolve()
        elif not for_later:
            _waiting.add(self)

    def _resolve(self) -> ca.Function:
        """Return the function that is evaluated, bound to the arrays; waits for the compiler."""
        with _workers.resolving:
            if self._found is None:
                found = self._given if self._compiling is None else self._compiling.result()
                if self._compiling is not None:
                    self.library = self._compiling.library
                self._buffer, self._evaluate = found.buffer()
                self._code = self._buffer.ret
                for i, array in enumerate(self.inputs):
                    self._buffer.set_arg(i, array.reshape(-1).data)
                for i, array in enumerate(self.outputs):
                    self._buffer.set_res(i, array.reshape(-1).data)
                self._found, self._compiling = found, None
                _waiting.discard(self)
            return self._found

    @property
    def is_done(self) -> bool:
        """Whether it is compiled, or never will be."""
        return self._compiling is None or self._compiling.is_done

    @property
    def is_compiled(self) -> bool:
        """Whether it is machine code; waits for the compiler."""
        return self._resolve() is not self._given

    def __call__(self) -> None:
        """Evaluate: read `inputs`, overwrite `outputs`.

        EvaluationError, with all outputs NaN, where the function could not be evaluated, at a singular matrix say.
        """
        if self._found is None:
            self._resolve()
        self._evaluate()
        if self._code():
            # Old outputs must not be read as an answer.
            for array in self.outputs:
                array.fill(np.nan)
            raise EvaluationError(f'the function "{self._given.name()}" has no value at its arguments')

    def bind_input(self, index: int, array: Array) -> None:
        """Let argument `index` be read from `array` (C-contiguous float64, of its size), which the kernel keeps."""
        self.inputs[index] = _bindable(array, self.inputs[index].size, f"argument {index} takes")
        if self._buffer is not None:
            self._buffer.set_arg(index, array.reshape(-1).data)

    def bind_output(self, index: int, array: Array) -> None:
        """Let result `index` be written to `array` (C-contiguous float64, of its size), which the kernel keeps."""
        self.outputs[index] = _bindable(array, self.outputs[index].size, f"result {index} gives")
        if self._buffer is not None:
            self._buffer.set_res(index, array.reshape(-1).data)

    def __reduce__(self) -> tuple[Any, ...]:
        """Refuse to pickle: a kernel holds addresses; build it in the worker."""
        raise TypeError("a Kernel holds addresses and cannot be pickled; build it where it is used")


def _bindable(array: Array, size: int, what: str) -> Array:
    if array.size != size or not array.flags.c_contiguous or array.dtype != np.float64:
        raise ValueError(f"{what} {size} contiguous float64 numbers")
    return array
