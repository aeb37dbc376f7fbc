"""Our own C: one library of all sources in this folder, called with structures of numbers and addresses.

The sources declare the structures that their functions take. :func:`structure` reads the fields from there, their only
definition. ``hulls.c`` finds where convex bodies are nearest, ``pairs.c`` knows which bodies may have come near,
``working.c`` a QP whose working set is known, ``qp.c`` the QP of a step, ``chain.c`` that of a long arm, ``step.c`` the
whole step.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable
from enum import IntEnum
from functools import cache, partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from vgtm_qp.compiled import Building, Kernel, cache_directory, compiler
from vgtm_qp.errors import EvaluationError

_STRUCT = re.compile(r"typedef struct \{((?:(?!typedef).)*?)\} (\w+);", re.DOTALL)
_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
_FUNCTION_POINTER = re.compile(r"\(\*(\w+)\)")

_NAMES = "base.h", "hulls.c", "pairs.c", "working.c", "qp.c", "chain.c", "step.c"
_SOURCES = tuple(map(Path(__file__).with_name, _NAMES))

INCLUDES = Path(ca.__file__).parent / "include"
"""Headers of the libraries in CasADi's wheel, DAQP's among them."""


class Code(IntEnum):
    """What the functions of the library return; see ``base.h``."""

    (
        DONE,
        NO_VALUE,
        INFEASIBLE,
        INACCURATE,
        UNSETTLED,
        FAILED,
        TOO_FAR,
        NOT_PROVEN,
        FULL,
        CROWDED,
        OVERLAPPING,
        ASKS,
        FLAWED,
        OFF_CURVE,
        TOO_NEAR,
    ) = range(15)


class CompiledKernel(ctypes.Structure):
    """A CasADi function for C: its address, arguments, results and workspaces."""

    _fields_ = [(name, ctypes.c_void_p) for name in ("eval", "arg", "res", "iw", "w")]


_TYPES: dict[str, Any] = {"int": ctypes.c_int, "double": ctypes.c_double, "Kernel": CompiledKernel}


@cache
def _text() -> str:
    return "".join(source.read_text(encoding="utf-8") for source in _SOURCES)


@cache
def structure(name: str) -> type[ctypes.Structure]:
    """Return the structure of that `name` in our C as a class of ctypes; its pointers are addresses."""
    body = next(match[1] for match in _STRUCT.finditer(_text()) if match[2] == name)
    fields: list[tuple[str, Any]] = []
    for declaration in _COMMENT.sub("", body).split(";"):
        words = declaration.replace("const ", "").split(None, 1)
        if len(words) < 2:
            continue
        pointer = _FUNCTION_POINTER.search(declaration)
        if pointer:
            fields.append((pointer[1], ctypes.c_void_p))
            continue
        for field in words[1].split(","):
            is_pointer = "*" in field
            fields.append((field.strip(" *\n"), ctypes.c_void_p if is_pointer else _TYPES[words[0]]))
    return type(name, (ctypes.Structure,), {"_fields_": fields})


def building() -> Building:
    """Begin to compile the library, once in a process for each compiler."""
    return _building(compiler(), cache_directory())


@cache
def _building(*_: object) -> Building:
    return Building("native", _text(), (f"-I{INCLUDES}",))


class Program:
    """A structure for functions of the library, and the arrays and kernels that it points to.

    Attributes
    ----------
    data : ctypes.Structure
    address : int
        Of the structure.

    Raises
    ------
    OSError
        The library could not be compiled.
    """

    def __init__(self, name: str) -> None:
        library = building().finish()
        if library is None:
            raise OSError("our C could not be compiled")
        self._library = ctypes.CDLL(str(library))
        self.data = structure(name)()
        self.address = ctypes.addressof(self.data)
        self._kept: dict[str, Any] = {}
        self._interpreted: dict[str, Kernel] = {}

    def set(self, **values: Any) -> None:
        """Set fields: numbers, kernels, and C-contiguous arrays, which are kept, for pointers."""
        for name, value in values.items():
            if isinstance(value, Kernel):
                is_interpreted = not value.is_done or not value.is_compiled
                found, self._kept[name] = _interpreted(value) if is_interpreted else _compiled(value)
                setattr(self.data, name, found)
                if is_interpreted and not value.is_done:
                    self._interpreted[name] = value
                else:
                    self._interpreted.pop(name, None)
            elif isinstance(value, np.ndarray):
                assert value.flags.c_contiguous
                setattr(self.data, name, value.ctypes.data)
                self._kept[name] = value
            else:
                setattr(self.data, name, value)

    def refresh(self) -> None:
        """Use the kernels that were compiled meanwhile."""
        if self._interpreted:
            self.set(**{key: kernel for key, kernel in self._interpreted.items() if kernel.is_done})

    def entry(self, name: str) -> Callable[[], int]:
        """Return the C function of that name, called with the structure alone: for calls in which every us counts."""
        function = self._library[name]
        function.argtypes = (ctypes.c_void_p,)
        return partial(function, self.address)

    def call(self, name: str, *arguments: float) -> Code:
        """Call the C function of that name with the structure and numbers; kernels compiled meanwhile are used."""
        self.refresh()
        return Code(self._library[name](ctypes.c_void_p(self.address), *map(ctypes.c_double, arguments)))


_EVALUATION = ctypes.CFUNCTYPE(ctypes.c_int, *[ctypes.c_void_p] * 4, ctypes.c_int)


def _interpreted(kernel: Kernel) -> tuple[CompiledKernel, list[Any]]:
    """Return a kernel that C calls back, and the objects that must live as long as it does."""

    def evaluate(*_: object) -> int:
        try:
            kernel()
        except EvaluationError:
            return 1
        return 0

    arg, res = (
        np.array([array.ctypes.data for array in arrays], dtype=np.uintp)
        for arrays in (kernel.inputs, kernel.outputs)
    )
    function = _EVALUATION(evaluate)
    address = ctypes.cast(function, ctypes.c_void_p).value
    return CompiledKernel(address, arg.ctypes.data, res.ctypes.data, 0, 0), [function, arg, res]


def _compiled(kernel: Kernel) -> tuple[CompiledKernel, list[Any]]:
    """Return a compiled kernel as C calls it, and the arrays that must live as long as it does."""
    library = ctypes.CDLL(str(kernel.library))
    sizes = [ctypes.c_longlong() for _ in range(4)]
    library[f"{kernel.name}_work"](*map(ctypes.byref, sizes))
    arguments, results, integers, numbers = (size.value for size in sizes)
    arg, res = np.zeros(arguments, dtype=np.uintp), np.zeros(results, dtype=np.uintp)
    arg[: len(kernel.inputs)] = [array.ctypes.data for array in kernel.inputs]
    res[: len(kernel.outputs)] = [array.ctypes.data for array in kernel.outputs]
    iw, w = np.zeros(integers, dtype=np.int64), np.zeros(numbers)
    address = ctypes.cast(library[kernel.name], ctypes.c_void_p).value
    kept = [arg, res, iw, w, *kernel.inputs, *kernel.outputs]
    return CompiledKernel(address, *(array.ctypes.data for array in (arg, res, iw, w))), kept
