"""CasADi functions as kernels: compiled to C once per topology, evaluated in place on NumPy arrays.

``Function.buffer()`` costs 0.5-4 us a call where ``F(array)`` costs 23 us. A kernel is compiled when a C compiler
is there and the library is kept by a hash of its source, so the second process pays only for a `dlopen`. Without a
compiler the CasADi virtual machine evaluates the same graph, 4 to 10 times slower.

The first time, the compiler's time is what an arm waits for. The straight-line functions that a kernel maps or calls
are compiled by themselves, once for all kernels that use them, by several processes at a time, and a kernel waits for
its own when it is called first.

A function tells by its return code that it could not be evaluated, and then leaves its outputs as they were. Every call
reads that code, in half a microsecond: outputs of an earlier call never pass as those of this one.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import shlex
import shutil
import subprocess
import tempfile
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
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
"""For what calls the straight-line functions, where it is long: half the compiler's time, and little to gain."""

_LONG = 100_000
"""Source texts of more characters take the compiler seconds."""

_MOST_COMPILERS = 4
_WORTH_IT = 100
"""Functions of fewer lines are not compiled by themselves."""

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
    """Return the C compiler to use: ``$VGTM_CC``, else the first of cc, gcc, clang; ``None`` where there is none.

    ``VGTM_CC=none`` asks for the virtual machine.
    """
    wanted = os.environ.get("VGTM_CC")
    if wanted is not None:
        return None if wanted in ("", "none") else shutil.which(wanted)
    return next((path for name in ("cc", "gcc", "clang") if (path := shutil.which(name))), None)


def cache_directory() -> Path:
    """Return where compiled kernels are kept: ``$VGTM_CACHE``, else the user's cache directory."""
    if "VGTM_CACHE" in os.environ:
        return Path(os.environ["VGTM_CACHE"])
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "vgtm-qp"


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


class _Compilers:
    """Compilers at work for this process."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self._pool: ThreadPoolExecutor | None = None
        self._units: dict[Path, Future[Path | None]] = {}

    def compile(self, cc: str, text: str, target: Path, flags: tuple[str, ...]) -> Future[Path | None]:
        """Begin to compile `text` into the object `target`, unless that is done or being done."""
        with self.lock:
            if target not in self._units or (self._units[target].done() and not target.exists()):
                self._units[target] = self._workers().submit(_object, cc, text, target, flags)
            return self._units[target]

    def link(self, compiling: Compiling) -> None:
        """Have a library made as soon as its parts are there."""
        with self.lock:
            self._workers().submit(compiling.make)

    def _workers(self) -> ThreadPoolExecutor:
        if self._pool is None:
            most = max(1, min(_MOST_COMPILERS, os.cpu_count() or 1))
            self._pool = ThreadPoolExecutor(most, "vgtm-compiler")
        return self._pool


_compilers = _Compilers()
_resolving = threading.RLock()


def _forget() -> None:
    """Begin anew in a forked process, which has none of the threads."""
    global _compilers, _resolving
    _compilers, _resolving = _Compilers(), threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


def _run(command: list[str]) -> None:
    subprocess.run(command, check=True, capture_output=True, timeout=300)


def _object(cc: str, text: str, target: Path, flags: tuple[str, ...]) -> Path | None:
    """Return the object file that `text` was compiled to; None where it cannot be."""
    if target.exists():
        return target
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent) as scratch:
            c_file, o_file = Path(scratch) / "kernel.c", Path(scratch) / "kernel.o"
            c_file.write_text(text)
            _run([*shlex.split(cc), *_FLAGS, *flags, "-c", str(c_file), "-o", str(o_file)])
            o_file.replace(target)
    except (OSError, subprocess.SubprocessError):
        return None
    return target


class _Build:
    """A library that is being compiled."""

    def __init__(self, function: ca.Function, cc: str) -> None:
        generator = ca.CodeGenerator(f"{function.name()}.c", {"with_header": False})
        generator.add(function)
        source = generator.dump()
        folder = cache_directory()
        key = _hash(source, cc)
        self._cc, self._target = cc, folder / f"{function.name()}-{key}.so"
        self._parts: list[Future[Path | None]] = []
        self.process = os.getpid()
        self._main = folder / f"{function.name()}-{key}.o"
        if not self._target.exists():
            rest, units = _split(source)
            texts = {folder / f"{name}-{_hash(cc)[:8]}.o": text for name, text in units.items()}
            quick = _QUICK if len(rest) > _LONG else ()
            texts[self._main] = _with_fast_helpers(rest) if quick else rest
            # The longest first: nothing waits for it at the end.
            longest = sorted(texts, key=lambda path: -len(texts[path]))
            self._parts = [
                _compilers.compile(cc, texts[path], path, quick if path == self._main else ())
                for path in longest
            ]

    @property
    def is_made(self) -> bool:
        """Whether the shared library is there."""
        return self._target.exists()

    def library(self) -> Path | None:
        """Return the shared library as soon as it is there; None where it cannot be compiled."""
        if self._target.exists():
            return self._target
        objects = [part.result() for part in self._parts]
        try:
            with tempfile.TemporaryDirectory(dir=self._target.parent) as scratch:
                so_file = Path(scratch) / "kernel.so"
                _run([*shlex.split(self._cc), "-shared", *map(str, objects), "-o", str(so_file), "-lm"])
                so_file.replace(self._target)
            self._main.unlink(missing_ok=True)
        except (OSError, subprocess.SubprocessError):
            # Another process may have made the library meanwhile, and cleared up.
            pass
        return self._target if self._target.exists() else None


class Compiling:
    """A function on its way to machine code; several kernels may wait for the same."""

    def __init__(self, function: ca.Function) -> None:
        self._function, self._cc = function, compiler()
        self._build = None if self._cc is None else _Build(function, self._cc)
        self._done: ca.Function | None = None

    def result(self) -> ca.Function:
        """Return the compiled function when it is there, or the one it comes from where no compiler works."""
        if self._done is None:
            self._done = self._wait()
            self._build = None
        return self._done

    @property
    def is_made(self) -> bool:
        """Whether nothing has to be waited for."""
        return self._build is None or self._build.is_made

    def make(self) -> None:
        """Wait until the library is there, if it can be; any thread may."""
        build = self._build
        if build is not None and build.process == os.getpid():
            build.library()

    def _wait(self) -> ca.Function:
        if self._build is None or self._cc is None:
            return self._function
        if self._build.process != os.getpid():
            # The compilers were at work for the process that this one was forked from.
            self._build = _Build(self._function, self._cc)
        for _ in range(2):
            library = self._build.library()
            if library is None:
                break
            try:
                return ca.external(self._function.name(), str(library))
            except RuntimeError:
                # Cut short by a full disk, or from a machine with another C library: compiled once more.
                with contextlib.suppress(OSError):
                    library.unlink(missing_ok=True)
                self._build = _Build(self._function, self._cc)
        return self._function


_waiting: weakref.WeakSet[Kernel] = weakref.WeakSet()


def finish_compiling() -> None:
    """Wait until all kernels of this process are compiled, so that none of them has to be waited for later.

    Those that were begun for later go on being compiled.
    """
    kernels = list(_waiting)
    unmade = {
        kernel.compiling
        for kernel in kernels
        if kernel.compiling is not None and not kernel.compiling.is_made
    }
    if unmade:
        # Each is linked as soon as its parts are there, while others are still being compiled.
        with ThreadPoolExecutor(len(unmade), "vgtm-linker") as pool:
            list(pool.map(Compiling.make, unmade))
    for kernel in kernels:
        _ = kernel.is_compiled


class Kernel:
    """A CasADi function bound to arrays that live as long as it does.

    Attributes
    ----------
    inputs, outputs
        One flat float64 array per argument and result: the nonzeros in CasADi's column-major order. Write the
        inputs in place, call the kernel, read the outputs. One kernel must not be called by two threads at once.
    """

    def __init__(
        self, function: ca.Function, *, compiled: bool | Compiling = True, for_later: bool = False
    ) -> None:
        self._given = function
        self._compiling: Compiling | None
        if isinstance(compiled, Compiling):
            self._compiling = compiled
        else:
            self._compiling = Compiling(function) if compiled else None
        self._found: ca.Function | None = None
        self._buffer: Any = None
        self.inputs: list[Array] = [np.zeros(function.nnz_in(i)) for i in range(function.n_in())]
        self.outputs: list[Array] = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
        # Until it is called first, when this is replaced by the evaluation itself.
        self._evaluate: Callable[[], None] = self._evaluate_first
        self._code: Callable[[], int] = self._code_of_none
        if not compiled:
            self._resolve()
        elif not for_later:
            _waiting.add(self)
        elif self._compiling is not None and not self._compiling.is_made:
            # Its parts stand before it in the queue, so that they never wait for it.
            _compilers.link(self._compiling)

    def _resolve(self) -> ca.Function:
        with _resolving:
            if self._found is None:
                self._found = self._given if self._compiling is None else self._compiling.result()
                self._compiling = None
                _waiting.discard(self)
                self._buffer, self._evaluate = self._found.buffer()
                self._code = self._buffer.ret
                for i, array in enumerate(self.inputs):
                    self._buffer.set_arg(i, array.reshape(-1).data)
                for i, array in enumerate(self.outputs):
                    self._buffer.set_res(i, array.reshape(-1).data)
            return self._found

    def _evaluate_first(self) -> None:
        self._resolve()
        self._evaluate()

    def _code_of_none(self) -> int:
        raise AssertionError("a kernel that was never evaluated has no return code")

    def _refuse(self) -> None:
        """Leave nothing in the outputs that could be read as an answer, and raise."""
        for array in self.outputs:
            array.fill(np.nan)
        raise EvaluationError(f'the function "{self._given.name()}" has no value at its arguments')

    @property
    def compiling(self) -> Compiling | None:
        """What it waits for when it is called first; None once it was."""
        return self._compiling

    @property
    def function(self) -> ca.Function:
        """The function that is evaluated, compiled where it can be; waits for the compiler."""
        return self._resolve()

    @property
    def is_compiled(self) -> bool:
        """Whether it is machine code; waits for the compiler."""
        return self._resolve() is not self._given

    def __call__(self) -> None:
        """Evaluate: read `inputs`, overwrite `outputs`.

        Raises
        ------
        EvaluationError
            The function could not be evaluated, at a singular matrix say; all outputs are NaN.
        """
        self._evaluate()
        if self._code():
            self._refuse()

    def bind_input(self, index: int, array: Array) -> None:
        """Let argument `index` be read from `array` (C-contiguous float64, of its size), which the kernel keeps."""
        if array.size != self.inputs[index].size or not array.flags.c_contiguous or array.dtype != np.float64:
            raise ValueError(f"argument {index} takes {self.inputs[index].size} contiguous float64 numbers")
        self.inputs[index] = array
        if self._buffer is not None:
            self._buffer.set_arg(index, array.reshape(-1).data)

    def bind_output(self, index: int, array: Array) -> None:
        """Let result `index` be written to `array` (C-contiguous float64, of its size), which the kernel keeps."""
        if (
            array.size != self.outputs[index].size
            or not array.flags.c_contiguous
            or array.dtype != np.float64
        ):
            raise ValueError(f"result {index} gives {self.outputs[index].size} contiguous float64 numbers")
        self.outputs[index] = array
        if self._buffer is not None:
            self._buffer.set_res(index, array.reshape(-1).data)

    def __reduce__(self) -> tuple[Any, ...]:
        """Refuse to pickle: a kernel holds addresses; build it in the worker."""
        raise TypeError("a Kernel holds addresses and cannot be pickled; build it where it is used")
