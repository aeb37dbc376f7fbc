"""What symbolic arms are made of: constants that are bound once, rotations, and the frames of their stations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.frames import frame_function, frame_tables
from vgtm_qp.compiled import Kernel

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_TINY = 1e-30


class Constants:
    """Numbers that are constant over a maneuver: arguments of a graph beside the values to bind to them once."""

    def __init__(self) -> None:
        self.symbols: list[ca.MX] = []
        self.values: list[Array] = []

    def add(self, name: str, value: Array) -> ca.MX:
        """Return the symbol of a constant whose columns are the rows of `value`, a vector or matrix."""
        self.symbols.append(ca.MX.sym(name, *reversed(np.atleast_2d(value).shape)))
        self.values.append(np.ascontiguousarray(value, dtype=float).reshape(-1))
        return self.symbols[-1]


@dataclass(frozen=True, eq=False)
class Bound:
    """A CasADi function and the constants to bind to its last arguments."""

    function: ca.Function
    constants: list[Array]

    def kernel(self, *, compiled: bool = True) -> Kernel:
        """Return the function as a kernel with its constants bound."""
        kernel = Kernel(self.function, compiled=compiled)
        first = len(kernel.inputs) - len(self.constants)
        for k, values in enumerate(self.constants):
            kernel.bind_input(first + k, values)
        return kernel


class Frames:
    """Frames of F stations with K nodes each, with their constants."""

    def __init__(self, home: Array, rotations: Array, nodes: Index, constants: Constants, name: str) -> None:
        names = (f"{name}_cosines", f"{name}_sines", f"{name}_alignments")
        tables = zip(names, frame_tables(home, rotations), strict=True)
        self._arguments = [constants.add(name, table) for name, table in tables]
        self._columns = nodes.reshape(-1).tolist()
        self._function = frame_function(home.shape[1]).map(len(home))

    def at(self, X: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Return rotations (3, 3F) and spins (3, 3KF) at positions (3, N)."""
        rotation, spin = self._function(X[:, self._columns], *self._arguments)
        return rotation, spin


def rotated(vector: Any) -> Any:
    """Return the (3, 3) rotation by |vector| about it (Rodrigues), smooth at zero; `vector` (3, 1), rad."""
    square = ca.dot(vector, vector) + _TINY
    angle, cross = ca.sqrt(square), ca.skew(vector)
    return ca.DM.eye(3) + (ca.sin(angle) / angle) * cross + ((1.0 - ca.cos(angle)) / square) * (cross @ cross)
