"""CasADi functions as kernels: evaluated in place on NumPy arrays, as machine code as soon as that is there.

``Function.buffer()`` costs 0.5-4 us a call where ``F(array)`` costs 23 us. CasADi's virtual machine evaluates a kernel
until its compiled form is there, which does the same 4 to 10 times faster. A kernel that was called a few times is
handed to a process of its own, see :mod:`vgtm_qp.builder`, which compiles it. The library is loaded at the start of a
later call, in the thread that makes this call: nothing waits for a compiler but :func:`finish_compiling` and
:meth:`Kernel.compile`, and neither does the end of a process. What is not compiled by then is compiled all the same,
behind other work, so that the next process starts with it.

Libraries are kept by a hash of their function. What is loaded from the cache runs as this process does: folder and
files must be the user's, with nobody else allowed to write them, and the SHA-256 beside a library must be that of its
content.

The return code of a function shows whether it could be evaluated; if not, its outputs keep their old values. Every call
checks the code, in half a microsecond, so that old outputs never pass as new ones.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import gc
import hashlib
import logging
import os
import pickle
import platform
import queue
import shlex
import shutil
import stat
import subprocess
import sys
import threading
import weakref
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import EvaluationError

_LOG = logging.getLogger(__name__)

_X86 = platform.machine().lower() in ("x86_64", "amd64")
FLAGS = (
    "-O2",
    "-march=native",
    # GCC 12.2, tuning for Intel from Ice Lake on, copies the constants (a, a, 0, 0) as (a, a, a, a).
    *(("-mtune=generic",) if _X86 else ()),
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fPIC",
    "-fvisibility=hidden",
    '-DCASADI_SYMBOL_EXPORT=__attribute__((visibility("default")))',
)
QUICK = ("-O1",)
"""Flags for long code that calls straight-line functions: half the compile time, little slower code."""

OWN = ("-O3", "-fno-signed-zeros", "-fassociative-math")
"""Flags for our own C: sums may be vectorised; NaN and infinity keep their meaning."""

HUNG, WRONG = 3, 4
"""Exit codes of a builder whose compiler hung, or made code of other values than its function's."""

_FORM = "2"
"""Version of the libraries that builders make: with another number all of them are made anew."""

OFTEN, SELDOM = 8, 600
"""Number of calls from which on a kernel is compiled while another core is idle, and while none is.

A compiler takes about as much time as that many interpreted calls.
"""

_often = OFTEN

PATIENCE = 60.0
"""Seconds after which a compiler counts as hung."""

_LINGER = 1.0
"""Seconds for which a builder waits for further functions."""

_TICK = 0.005
"""Seconds between two looks for a library that is waited for."""

_BUILDER = (
    "import sys, pickle; sys.path[:] = pickle.load(sys.stdin.buffer); "
    "from vgtm_qp.builder import main; sys.exit(main())"
)


def compiler() -> str | None:
    """Return the command of the C compiler, as a shell reads it; None without a compiler.

    It is ``$VGTM_CC``, a program or one with flags, else the first of cc, gcc, clang. ``VGTM_CC=none`` asks for the
    virtual machine.
    """
    return _found(os.environ.get("VGTM_CC"), os.environ.get("PATH"))


@cache
def _found(wanted: str | None, _: str | None) -> str | None:
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


def digest_file(path: Path) -> Path:
    """Return the file that holds the SHA-256 of a file of the cache."""
    return path.with_name(f"{path.name}.sha256")


def is_sound(path: Path) -> bool:
    """Return whether a file of the cache is there, the user's own, and as it was made."""
    with contextlib.suppress(OSError, ValueError):
        digest = digest_file(path)
        if not distrust(path) and not distrust(digest):
            with path.open("rb") as file:
                return (
                    hashlib.file_digest(file, "sha256").hexdigest()
                    == digest.read_text(encoding="utf-8").strip()
                )
    return False


@cache
def _machine() -> str:
    """Return what a ``-march=native`` library depends on beside its source."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    return next((line for line in lines if line.startswith(("flags", "Features"))), "")


def _hash(*parts: str) -> str:
    every = (*parts, *FLAGS, *QUICK, _FORM, ca.CasadiMeta.version(), _machine())
    return hashlib.sha256("\0".join(every).encode()).hexdigest()[:32]


class _Builder:
    """A process that compiles, fed by a thread; it ends by itself when it has had nothing to do for a while.

    Attributes
    ----------
    ended : threading.Event
    is_lost : bool
        Whether it was stopped, or belongs to the process that this one was forked from.
    code : int
        Its exit code; 0 before it has ended.
    """

    def __init__(self) -> None:
        self.ended = threading.Event()
        self.is_lost, self.code = False, 0
        self._is_open = True
        self._process: subprocess.Popen[bytes] | None = None
        self._jobs: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._jobs.put(list(sys.path))
        threading.Thread(target=self._serve, daemon=True, name="vgtm-builder").start()

    def take(self, job: dict[str, Any]) -> bool:
        """Accept a job without waiting; False if the process takes no more."""
        with _lock:
            if self._is_open:
                self._jobs.put(job)
            return self._is_open

    def _serve(self) -> None:
        try:
            with contextlib.suppress(OSError):
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-c", _BUILDER],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    bufsize=0,
                    start_new_session=True,
                )
                self._feed(self._process)
                self.code = self._process.wait()
        finally:
            with _lock:
                self._is_open = False
            self.ended.set()

    def _feed(self, process: subprocess.Popen[bytes]) -> None:
        if self.is_lost:
            process.terminate()
        assert process.stdin is not None
        with contextlib.suppress(OSError), process.stdin as pipe:
            job: Any = True
            while job is not None:
                # The last job is None: while a forked process holds the pipe open, it has no end.
                job = self._next()
                text = memoryview(pickle.dumps(job))
                while text:
                    text = text[pipe.write(text) :]

    def _next(self) -> Any:
        try:
            return self._jobs.get(timeout=_LINGER)
        except queue.Empty:
            with _lock:
                self._is_open = not self._jobs.empty()
            return self._jobs.get() if self._is_open else None

    def stop(self) -> None:
        """End the process and the compilers that it runs."""
        self.is_lost, self._is_open = True, False
        if self._process is not None:
            self._process.terminate()

    def forget(self) -> None:
        """Give up the builder process in a process that was forked from its owner."""
        self.is_lost, self._is_open = True, False
        if self._process is not None:
            self._process.returncode = 0
            if self._process.stdin is not None:
                self._process.stdin.close()


_lock = threading.RLock()
_builder: _Builder | None = None


def _hand_over(job: dict[str, Any]) -> _Builder:
    """Return the builder that takes the job."""
    global _builder
    with _lock:
        while _builder is None or not _builder.take(job):
            _builder = _Builder()
        return _builder


def stop_compilers() -> None:
    """End all compilers of this process at once, as an interrupt does; later kernels begin anew."""
    global _builder
    with _lock:
        stopped, _builder = _builder, None
    if stopped is not None:
        stopped.stop()


def _start_anew() -> None:
    """Begin anew in a forked process, which has none of its parent's threads."""
    global _lock, _builder
    _lock, left, _builder = threading.RLock(), _builder, None
    if left is not None:
        left.forget()


@atexit.register
def _stop_if_interrupted() -> None:
    """End the compilers if an interrupt that nobody caught ends the program."""
    if getattr(sys, "last_type", None) is KeyboardInterrupt:
        stop_compilers()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_start_anew)


class Building:
    """C code on its way to a shared library.

    Attributes
    ----------
    library : Path or None
        The library once it is there.
    is_settled : bool
        Whether it is there, or is known never to be.
    calls : int
        Number of calls for which it was asked so far in vain.
    """

    def __init__(self, name: str, text: str, flags: tuple[str, ...]) -> None:
        self._plan(name, text, {"text": text, "flags": (*flags, *OWN)}, *flags, *OWN)

    def _plan(self, name: str, code: str, job: dict[str, Any], *more: str) -> None:
        """Use the library that is in the cache already, or prepare the `job` of making it."""
        self.library: Path | None = None
        self.is_settled, self.calls, self._may_fail = False, 0, True
        self._builder: _Builder | None = None
        cc, folder = compiler(), cache_directory()
        if cc is None or cc in _hanging or _warned_of(folder):
            self.is_settled = True
            return
        self._target = folder / f"{name}-{_hash(name, code, cc, *more)}.so"
        self._job = {**job, "library": str(self._target), "cc": cc, "key": _hash(cc)[:8]}
        self._load()
        if not self.is_settled:
            with _lock:
                _waiting.add(self)

    def ask(self) -> bool:
        """Return whether it is settled, without waiting; begin to make it once it was asked for often."""
        if not self.is_settled:
            self.calls += 1
            if self._builder is not None:
                self._look()
            else:
                # Resolvers of equal arms share one count.
                _asked[self._target] += 1
                if _asked[self._target] >= _often:
                    self.begin()
        return self.is_settled

    def begin(self) -> None:
        """Begin to make it, if that has not been done."""
        with _lock:
            if self.is_settled or self._builder is not None:
                return
            if self._job["cc"] in _hanging:
                self.is_settled = True
                return
            with contextlib.suppress(OSError):
                self._target.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            self._builder = _hand_over({**self._job, "patience": PATIENCE})

    def finish(self) -> Path | None:
        """Make it now, wait for the end of it, and return `library`."""
        try:
            while not self.is_settled:
                self.begin()
                self._look()
                if (builder := self._builder) is not None and not self.is_settled:
                    builder.ended.wait(_TICK)
        except KeyboardInterrupt:
            stop_compilers()
            raise
        return self.library

    def _look(self) -> None:
        """Load the library if it is there by now; settle without one if there will be none."""
        with _lock:
            builder = self._builder
            if self.is_settled or builder is None:
                return
            # Asked before the look at the file, because a library may come just before the end.
            has_ended = builder.ended.is_set()
            if self._target.exists() and self._load():
                return
            if builder.is_lost:
                self._builder = None
            elif has_ended:
                self.is_settled = True
                fault = ""
                if builder.code == HUNG:
                    _hanging.add(self._job["cc"])
                    fault = f"did not end within {PATIENCE:g} s: kernels run"
                elif builder.code == WRONG:
                    fault = "made code that has wrong values, which is not used: some kernels run"
                if fault:
                    _warn(
                        f"the C compiler {self._job['cc']} {fault} uncompiled, 4 to 10 times slower; "
                        "VGTM_CC names another compiler"
                    )

    def _load(self) -> bool:
        """Load the library and return True; False if it is not whole.

        The library of a machine with another C library cannot be loaded: it is made once more.
        """
        if not is_sound(self._target):
            return False
        try:
            self._accept(self._target)
            self.library, self.is_settled = self._target, True
        except (OSError, RuntimeError):
            with contextlib.suppress(OSError):
                self._target.unlink(missing_ok=True)
            self.is_settled, self._may_fail, self._builder = not self._may_fail, False, None
        return True

    def _accept(self, library: Path) -> None:
        ctypes.CDLL(str(library))


class Compiling(Building):
    """A function on its way to machine code; several kernels may wait for the same.

    Attributes
    ----------
    given, found : ca.Function
        The function itself, and its compiled form once that is loaded.
    """

    def __init__(self, function: ca.Function) -> None:
        self.given = self.found = function
        text = "" if compiler() is None else function.serialize()
        self._plan(function.name(), text, {"function": text})

    def _accept(self, library: Path) -> None:
        self.found = ca.external(self.given.name(), str(library))


_waiting: weakref.WeakSet[Building] = weakref.WeakSet()
_asked: Counter[Path] = Counter()
"""Numbers of calls for which libraries were asked in vain."""
_hanging: set[str] = set()
"""Compilers that hung, and are not asked again by this process."""


def compile_after(calls: int) -> None:
    """Set the calls after which this process compiles a kernel: ``OFTEN``; ``SELDOM`` for one of many."""
    global _often
    _often = calls


def finish_compiling() -> bool:
    """Compile all kernels that this process has called, wait for the end of it, and return whether none failed.

    Each begins to run compiled at its next call.
    """
    # Kernels that only reference cycles keep alive are not worth waiting for.
    gc.collect()
    with _lock:
        used = [one for one in _waiting if one.calls and not one.is_settled]
    for one in used:
        one.begin()
    every = [one.finish() is not None for one in used]
    return all(every)


@cache
def _warn(text: str) -> None:
    """Warn once that kernels are slow, and why."""
    _LOG.warning(text)


def _warned_of(folder: Path) -> bool:
    """Return whether the cache at `folder` must not be used, and if so warn of the reason."""
    hindrance = ""
    with contextlib.suppress(OSError):
        hindrance = distrust(folder)
    if hindrance:
        _warn(f"{hindrance}: the kernel cache is not used, kernels run uncompiled, 4 to 10 times slower")
    return bool(hindrance)


class Kernel:
    """A CasADi function bound to arrays that live as long as it does: `inputs` and `outputs`.

    They are one flat float64 array per argument and result: the nonzeros in CasADi's column-major order. Write the
    inputs in place, call the kernel, read the outputs. One kernel must not be called by two threads at once.

    Parameters
    ----------
    function
    times
        Number of columns of arguments on which it is evaluated in one call, as by ``function.map(times)``.
    compiled
        Whether it may become machine code, or the function's compilation, which kernels may share.

    Attributes
    ----------
    name : str
        Of the function.
    library : Path or None
        The shared library once it is machine code.
    """

    def __init__(self, function: ca.Function, *, times: int = 1, compiled: bool | Compiling = True) -> None:
        self._given, self._times, self.name = function, times, function.name()
        self.library: Path | None = None
        self._compiling = Compiling(function) if compiled is True else compiled or None
        self.inputs: list[Array] = [np.zeros(times * function.nnz_in(i)) for i in range(function.n_in())]
        self.outputs: list[Array] = [np.zeros(times * function.nnz_out(i)) for i in range(function.n_out())]
        self._use(function if self._compiling is None else self._compiling.found)
        self._settle()

    def _use(self, function: ca.Function) -> None:
        """Evaluate by `function` from now on."""
        self._function = function
        self._buffer: Any
        self._buffer, self._evaluate = function.map(self._times).buffer()
        self._code = self._buffer.ret
        for i, array in enumerate(self.inputs):
            self._buffer.set_arg(i, array.reshape(-1).data)
        for i, array in enumerate(self.outputs):
            self._buffer.set_res(i, array.reshape(-1).data)

    def _settle(self) -> None:
        """Use the result of the compilation, once it is settled."""
        compiling = self._compiling
        if compiling is not None and compiling.is_settled:
            self._compiling, self.library = None, compiling.library
            if compiling.found is not self._function:
                self._use(compiling.found)

    def prepare(self) -> None:
        """Count a call: a kernel called often is compiled, and runs as machine code once that is there."""
        if self._compiling is not None:
            self._compiling.ask()
            self._settle()

    @property
    def is_done(self) -> bool:
        """Whether it is machine code by now, or never will be."""
        self._settle()
        return self._compiling is None

    @property
    def is_compiled(self) -> bool:
        """Whether it is machine code by now."""
        return self._function is not self._given

    def compile(self) -> bool:
        """Compile now, wait for the end of it, and return whether it is machine code."""
        if self._compiling is not None:
            self._compiling.finish()
            self._settle()
        return self.is_compiled

    def __call__(self) -> None:
        """Evaluate: read `inputs`, overwrite `outputs`.

        Raises EvaluationError, with all outputs NaN, if the function could not be evaluated, as at a singular
        matrix.
        """
        if self._compiling is not None:
            self.prepare()
        self._evaluate()
        if self._code():
            # Old outputs must not be read as an answer.
            for array in self.outputs:
                array.fill(np.nan)
            raise EvaluationError(f'the function "{self._given.name()}" has no value at its arguments')

    def bind_input(self, index: int, array: Array) -> None:
        """Let argument `index` be read from `array` (C-contiguous float64, of its size), which the kernel keeps."""
        self.inputs[index] = _bindable(array, self.inputs[index].size, f"argument {index} takes")
        self._buffer.set_arg(index, array.reshape(-1).data)

    def bind_output(self, index: int, array: Array) -> None:
        """Let result `index` be written to `array` (C-contiguous float64, of its size), which the kernel keeps."""
        self.outputs[index] = _bindable(array, self.outputs[index].size, f"result {index} gives")
        self._buffer.set_res(index, array.reshape(-1).data)

    def __reduce__(self) -> tuple[Any, ...]:
        """Refuse to pickle: a kernel holds addresses; build it in the worker."""
        raise TypeError("a Kernel holds addresses and cannot be pickled; build it where it is used")


def _bindable(array: Array, size: int, what: str) -> Array:
    if array.size != size or not array.flags.c_contiguous or array.dtype != np.float64:
        raise ValueError(f"{what} {size} contiguous float64 numbers")
    return array
