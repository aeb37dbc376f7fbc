"""Parts of arms in symbols: constants that are bound once, rotations, and the frames of stations."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from vgtm_qp.arm.frames import frame_function, frame_tables, rotation_function
from vgtm_qp.arrays import Array, Index
from vgtm_qp.compiled import Compiling, Kernel

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

    def bound(self, name: str, inputs: list[ca.MX], results: list[ca.MX]) -> Bound:
        """Return the function of `inputs` and these constants that gives the `results`, dense."""
        arguments = [*inputs, *self.symbols]
        return Bound(ca.Function(name, arguments, [ca.densify(result) for result in results]), self.values)


@dataclass(frozen=True, eq=False)
class Bound:
    """A CasADi function and the constants to bind to its last arguments."""

    function: ca.Function
    constants: list[Array]

    def kernel(self, *, times: int = 1, compiled: bool | Compiling = True) -> Kernel:
        """Return the function as a kernel with its constants bound; see ``compiled.Kernel``."""
        kernel = Kernel(self.function, times=times, compiled=compiled)
        first = len(kernel.inputs) - len(self.constants)
        for k, values in enumerate(self.constants):
            kernel.bind_input(first + k, np.tile(values, times))
        return kernel


class Frames:
    """Frames of F stations with K nodes each, with their constants."""

    def __init__(self, home: Array, rotations: Array, nodes: Index, constants: Constants, name: str) -> None:
        names = (f"{name}_cosines", f"{name}_sines", f"{name}_alignments")
        tables = zip(names, frame_tables(home, rotations), strict=True)
        self._arguments = [constants.add(name, table) for name, table in tables]
        self._columns = nodes.reshape(-1).tolist()
        self._shape = home.shape

    def at(self, X: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Return rotations (3, 3F) and spins (3, 3KF) at positions (3, N)."""
        rotation, spin = self._of_each(frame_function, X)
        return rotation, spin

    def rotations(self, X: ca.MX) -> ca.MX:
        """Return rotations (3, 3F) alone, in a third of the time."""
        rotations: ca.MX = self._of_each(rotation_function, X)
        return rotations

    def _of_each(self, function: Callable[[int], ca.Function], X: ca.MX) -> Any:
        frames, nodes, _ = self._shape
        return function(nodes).map(frames)(X[:, self._columns], *self._arguments)


class EliminationStage(NamedTuple):
    """A stage: its rows, quantities (m,), determine as many coordinates (m,) of free nodes from those before it.

    `row`, `column` and `flat` (E,) are places of the nonzeros: among the stage's rows, the coordinates of all free
    nodes, and the gradients of ``ArmSymbols.motion``; values in one place add up.
    """

    rows: Index
    coordinates: Index
    row: Index
    column: Index
    flat: Index


class ArmSymbols(ABC):
    """An arm in CasADi's symbols: functions of a configuration of :attr:`shape`.

    Constants of a maneuver are arguments that are bound once: compiled code depends on the arm's topology alone.

    Attributes
    ----------
    shape : (int, int)
    home : (M, 1)
        Quantities at home.
    given : list of int
        Nodes whose displacement with the base is given; the others follow by the fixed quantities.
    can_eliminate : bool
        Whether coordinates can be eliminated in order, by :meth:`elimination` and :meth:`closed`.
    """

    shape: tuple[int, int]
    given: list[int]

    def __init__(self, home: Array, actuators: Index, constants: Constants) -> None:
        self.home = constants.add("home", home)
        self._actuators: list[int] = actuators.tolist()

    @property
    def can_eliminate(self) -> bool:
        """See the class."""
        return True

    @abstractmethod
    def nodes(self, q: Any) -> Any:
        """Return (3, N) the nodes."""

    @abstractmethod
    def quantities(self, q: Any) -> Any:
        """Return (M, 1) the quantities."""

    @abstractmethod
    def motion(self, q: Any, at: Any, moved: Any) -> list[Any]:
        """Return what ``Arm.motion_rows`` takes: rows at `at`, residuals at `q`, base moving by `moved` (3, N)."""

    def elimination(self) -> Sequence[EliminationStage]:
        """Return the stages in which K and r follow from :meth:`motion`; empty where these are its results."""
        return ()

    def twists(self, at: Any) -> Any:  # noqa: ARG002
        """Return (6, n_a) twists by which actuators move nodes: turn, velocity of the origin; None if they do not."""
        return None

    def movers(self) -> Index:
        """Return (N - N_c,) how many actuators, from the first, move each free node by their :meth:`twists`."""
        return np.zeros(0, dtype=np.int64)

    @abstractmethod
    def coordinates(self, nodes: Any, strokes: Any) -> Any:
        """Return the displacements that move the configuration: of the nodes (3 (N - N_c), c), or strokes (n_a, c)."""

    @abstractmethod
    def along(self, q: Any, coordinates: Any) -> Any:
        """Return the configuration after a displacement of :meth:`coordinates` (c,)."""

    @abstractmethod
    def closed(self, q: Any, lower: Any, upper: Any) -> Any:
        """Return the configuration after one Newton step to the fixed quantities, actuators in their boxes (n_a,)."""

    def aims(self, quantities: Any, lower: Any, upper: Any) -> Any:
        """Return the target values of `quantities` (M, 1): fixed ones as at home, actuators in their boxes (n_a,)."""
        aims = self.home * 1.0
        aims[self._actuators] = ca.fmax(lower, ca.fmin(upper, quantities[self._actuators]))
        return aims

    def follows(self, tracked: Sequence[int]) -> bool:  # noqa: ARG002
        """Whether fixed quantities and the places of `tracked` stations determine the configuration, stage by stage."""
        return False


def goal_after(goal: Any, turned: Any, velocity: Any, spin: Any, gone: Any) -> tuple[Any, Any]:
    """Return position and rotation of a `goal`, `turned` (3, 3), that moves on by a progress `gone` at its rates."""
    return goal + gone * velocity, rotated(gone * spin) @ turned


def rotated(vector: Any) -> Any:
    """Return the (3, 3) rotation by |vector| about it (Rodrigues), smooth at zero; `vector` (3, 1), rad."""
    square = ca.dot(vector, vector) + _TINY
    angle, cross = ca.sqrt(square), ca.skew(vector)
    return ca.DM.eye(3) + (ca.sin(angle) / angle) * cross + ((1.0 - ca.cos(angle)) / square) * (cross @ cross)
