"""What symbolic arms are made of: constants that are bound once, and the frames of their stations."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.frames import frame_constants, frame_function
from vgtm_qp.compiled import Kernel

Array = NDArray[np.float64]
Index = NDArray[np.int64]


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
        values = [frame_constants(points, frame) for points, frame in zip(home, rotations, strict=True)]
        cosines, sines, alignments = (np.stack(column) for column in zip(*values, strict=True))
        self._arguments = [
            constants.add(f"{name}_cosines", cosines),
            constants.add(f"{name}_sines", sines),
            constants.add(f"{name}_alignments", alignments.transpose(0, 2, 1).reshape(-1, 3)),
        ]
        self._columns = nodes.reshape(-1).tolist()
        self._function = frame_function(home.shape[1]).map(len(home))

    def at(self, X: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Return rotations (3, 3F) and spins (3, 3KF) at positions (3, N)."""
        rotation, spin = self._function(X[:, self._columns], *self._arguments)
        return rotation, spin
