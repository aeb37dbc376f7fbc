"""What the step in one call of C, ``native/step.c``, needs of the solver of its QP."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.compiled import Kernel
from vgtm_qp.qp.answer import Accuracy, Move, StepSolution
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import ClearanceRows


class NearRows:
    """Arrays for rows of clearance in C.

    Attributes
    ----------
    near, slots : int
        Capacity: rows, and nodes of each.
    fields : dict of str to array
        By the names that these arrays have in C.
    """

    def __init__(self, near: int, slots: int) -> None:
        self.near, self.slots = near, slots
        self._nodes = np.zeros(near * slots, dtype=np.int32)
        self._rows, self._lower = np.zeros(3 * near * slots), np.zeros(near)
        self.fields = {"near_nodes": self._nodes, "near_rows": self._rows, "near_lower": self._lower}

    def hold(self, near: int, slots: int) -> bool:
        """Return whether there is room for `near` rows over `slots` nodes each."""
        return near <= self.near and slots <= self.slots

    def write(self, clearance: ClearanceRows) -> None:
        """Write rows, for which there is room."""
        near, slots = clearance.nodes.shape
        self._nodes[: near * slots] = clearance.nodes.reshape(-1)
        self._rows[: 3 * near * slots] = clearance.coefficients.reshape(-1)
        self._lower[:near] = clearance.lower

    def read(self, near: int, slots: int) -> tuple[Index, Array, Array]:
        """Return nodes (R, S), coefficients (R, S, 3) and bounds (R,) of the first rows."""
        nodes, rows = self._nodes[: slots * near], self._rows[: 3 * slots * near]
        return (
            nodes.reshape(-1, slots).astype(np.int64),
            rows.reshape(-1, slots, 3).copy(),
            self._lower[:near].copy(),
        )


class Workspace(Protocol):
    """The arrays of a QP in C.

    Attributes
    ----------
    points, torsions : (3 V,), (T,)
        The curve where the answer led, m and rad.
    missing : Kernel
        Its last results are the position and the rotation of the tip there.
    curve_nodes : Kernel or None
        The result of ``curve_rows.point_function`` there; None where constant tables describe the curve.
    shape : tuple of int
        Of a configuration.
    """

    points: Array
    torsions: Array
    missing: Kernel
    curve_nodes: Kernel | None
    shape: tuple[int, ...]

    @property
    def is_ready(self) -> bool:
        """Whether the C is compiled; always false if it cannot be."""

    @property
    def structures(self) -> dict[str, int]:
        """Addresses of the structures by their names in ``StepData``."""

    @property
    def data(self) -> Any:
        """The structure ``Fused``."""

    @property
    def inputs(self) -> Sequence[Array]:
        """The QP's point, boxes and goal, in the order of ``StepGraph.inputs``."""

    def refresh(self) -> None:
        """Use the kernels that were compiled meanwhile."""

    def reserve(self, near: int, slots: int) -> None:
        """Make room for `near` rows of clearance over `slots` nodes at least."""

    def near(self, count: int) -> tuple[Index, Array, Array]:
        """Return nodes (R, S), coefficients (R, S, 3) and bounds (R,) of the first rows of clearance."""


class Corrector(Protocol):
    """Solves further QPs in C where the answer of the one before is no step yet."""

    def point(self) -> tuple[Array, Array, Array, float]:
        """Return where the QP solved last was linearised: configuration, control vertices, torsion and progress."""

    def go_back(self, move: Move) -> None:
        """Linearise the next QP where a `move` led, at the end of its piece of path."""


class Stepper(Protocol):
    """Solves the QP of a step and settles where its answer leads, by C."""

    layout: Layout

    @property
    def workspace(self) -> Workspace:
        """The arrays of its QP."""

    @property
    def corrector(self) -> Corrector | None:
        """What solves further QPs; None where C can solve none, nor take steps of a moving base."""

    def aim(self, accuracy: Accuracy) -> None:
        """Settle to that `accuracy` from now on."""

    def draw(self, vertices: Array, goals: Array | None) -> None:
        """Draw control vertices, which are at `vertices` (V, 3), to `goals` (V, 3), m, in the next QP."""

    def bend(self, torsion: Array, base_frame: Array) -> None:
        """Set the torsion (T,) and the frame (3, 3) at the base of the curve in the next QP."""

    def answered(self) -> StepSolution:
        """Return the answer of the QP solved last, without ``nodes`` and ``vertices``."""

    def led(self, *, is_settled: bool) -> Move:
        """Return where that answer led."""
