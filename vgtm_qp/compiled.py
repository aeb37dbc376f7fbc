"""CasADi functions as kernels: compiled to C once per topology, evaluated in place on NumPy arrays.

``Function.buffer()`` costs 0.5-4 us a call where ``F(array)`` costs 23 us. A kernel is compiled when a C compiler
is there and the library is kept by a hash of its source, so the second process pays only for a `dlopen`. Without a
compiler the CasADi virtual machine evaluates the same graph, 4 to 10 times slower.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shlex
import shutil
import subprocess
import tempfile
import threading
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FLAGS = ("-O2", "-march=native", "-fno-math-errno", "-fno-trapping-math", "-shared", "-fPIC")
_building = threading.Lock()


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


def _library(function: ca.Function, cc: str) -> Path | None:
    """Return the compiled shared library of `function`, from the cache where it is there."""
    generator = ca.CodeGenerator(f"{function.name()}.c", {"with_header": False})
    generator.add(function)
    source = generator.dump()
    key = hashlib.sha256(
        "\0".join((source, cc, *_FLAGS, ca.CasadiMeta.version(), _machine())).encode()
    ).hexdigest()[:32]
    target = cache_directory() / f"{function.name()}-{key}.so"
    if target.exists():
        return target
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent) as scratch:
            c_file, so_file = Path(scratch) / "kernel.c", Path(scratch) / "kernel.so"
            c_file.write_text(source)
            command = [*shlex.split(cc), *_FLAGS, str(c_file), "-o", str(so_file), "-lm"]
            subprocess.run(command, check=True, capture_output=True, timeout=300)
            so_file.replace(target)
    except (OSError, subprocess.SubprocessError):
        return None
    return target


def compile_function(function: ca.Function) -> ca.Function:
    """Return `function` compiled to machine code, or as it is where no compiler works."""
    cc = compiler()
    if cc is None:
        return function
    with _building:
        for _ in range(2):
            library = _library(function, cc)
            if library is None:
                break
            try:
                return ca.external(function.name(), str(library))
            except RuntimeError:
                # Cut short by a full disk, or from a machine with another C library: compiled once more.
                with contextlib.suppress(OSError):
                    library.unlink(missing_ok=True)
    return function


class Kernel:
    """A CasADi function bound to arrays that live as long as it does.

    Attributes
    ----------
    inputs, outputs
        One flat float64 array per argument and result: the nonzeros in CasADi's column-major order. Write the
        inputs in place, call the kernel, read the outputs. One kernel must not be called by two threads at once.
    """

    def __init__(self, function: ca.Function, *, compiled: bool = True) -> None:
        self.function = compile_function(function) if compiled else function
        self.is_compiled = self.function is not function
        buffer: Any
        buffer, self._evaluate = self.function.buffer()
        self._buffer = buffer
        self.inputs: list[Array] = [np.zeros(function.nnz_in(i)) for i in range(function.n_in())]
        self.outputs: list[Array] = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
        for i, array in enumerate(self.inputs):
            self._buffer.set_arg(i, array.data)
        for i, array in enumerate(self.outputs):
            self._buffer.set_res(i, array.data)

    def __call__(self) -> None:
        """Evaluate: read `inputs`, overwrite `outputs`."""
        self._evaluate()

    def bind_input(self, index: int, array: Array) -> None:
        """Let argument `index` be read from `array` (C-contiguous float64, of its size), which the kernel keeps."""
        if array.size != self.inputs[index].size or not array.flags.c_contiguous or array.dtype != np.float64:
            raise ValueError(f"argument {index} takes {self.inputs[index].size} contiguous float64 numbers")
        self.inputs[index] = array
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
        self._buffer.set_res(index, array.reshape(-1).data)

    def __reduce__(self) -> tuple[Any, ...]:
        """Refuse to pickle: a kernel holds addresses; build it in the worker."""
        raise TypeError("a Kernel holds addresses and cannot be pickled; build it where it is used")
