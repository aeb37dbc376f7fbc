"""The whole QP of one step, every column and row with a name, a kind and a unit.

    minimise  1/2 z' P z + q' z   subject to   row_lower <= A z <= row_upper,  column_lower <= z <= column_upper

z holds the displacements of nodes, actuators, control vertices and path progress over the step, then the gaps between
stations and curve after it, then the slacks of an elastic tip. Actuators and gaps are separate columns, so that P is
constant and only the values of A change.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from vgtm_qp.arm.arm import Label
from vgtm_qp.arrays import Array, Index
from vgtm_qp.qp.answer import StepSolution
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import StepNumbers, beyond, norm
from vgtm_qp.rows.tip import unit


@dataclass(frozen=True, eq=False, repr=False)
class StepQP:
    """A step's QP as data. Its builder owns P and A: they are valid until the next ``FullBuilder.build``.

    Attributes
    ----------
    P : (n, n) sparse
        Hessian, symmetric, constant over a maneuver without objectives of the user's own.
    q : (n,)
    A : (m, n) sparse
    row_lower, row_upper : (m,)
    column_lower, column_upper : (n,)
    columns, rows : tuple of Label
    """

    P: sparse.csc_matrix
    q: Array
    A: sparse.csc_matrix
    row_lower: Array
    row_upper: Array
    column_lower: Array
    column_upper: Array
    columns: tuple[Label, ...]
    rows: tuple[Label, ...]

    def primal_residual(self, z: Array) -> float:
        """Return the norm of the violations of rows and bounds at `z`, each in its unit."""
        rows = beyond(self.A @ z, self.row_lower, self.row_upper)
        return norm(np.concatenate([rows, beyond(z, self.column_lower, self.column_upper)]))

    def violated(self, z: Array, tolerance: float = 1e-9) -> list[tuple[str, float]]:
        """Return rows and columns that violate their bounds at `z` by more than `tolerance`, worst first."""
        value = self.A @ z
        row = np.maximum(self.row_lower - value, value - self.row_upper)
        column = np.maximum(self.column_lower - z, z - self.column_upper)
        found = [(self.rows[k].name, float(row[k])) for k in np.flatnonzero(row > tolerance)]
        found += [(self.columns[k].name, float(column[k])) for k in np.flatnonzero(column > tolerance)]
        return sorted(found, key=lambda item: -item[1])

    def __repr__(self) -> str:
        return f"<StepQP: {len(self.columns)} columns, {len(self.rows)} rows>"

    def __str__(self) -> str:
        columns = Counter((label.kind, label.unit) for label in self.columns)
        rows = Counter((label.kind, label.unit) for label in self.rows)
        lines = [f"QP of one step: {len(self.columns)} columns, {len(self.rows)} rows, {self.A.nnz} nonzeros"]
        lines.append("columns")
        lines += [f"  {count:6d}  {kind} [{of}]" for (kind, of), count in columns.items()]
        lines.append("rows")
        lines += [f"  {count:6d}  {kind} [{of}]" for (kind, of), count in rows.items()]
        value = [label.name for label in self.rows if label.kind == "clearance"]
        if value:
            lines.append("near pairs: " + ", ".join(name.removeprefix("clearance: ") for name in value[:12]))
        return "\n".join(lines)


class FullBuilder:
    """Fills the full QP from :class:`StepNumbers`; its sparsity changes only with the near pairs."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        kinds = self._columns()
        ends = np.cumsum([len(labels) for labels, _ in kinds.values()]).tolist()
        self.size = ends[-1]
        self.column = {
            name: slice(end - len(labels), end)
            for (name, (labels, _)), end in zip(kinds.items(), ends, strict=True)
        }
        self._column_labels = tuple(label for labels, _ in kinds.values() for label in labels)
        blocks = [
            block if np.ndim(block) else sparse.identity(len(labels)) * block
            for labels, block in kinds.values()
        ]
        self._hessian = sparse.block_diag(blocks, format="csc")
        self._fixed = self._fixed_rows()
        starts = np.cumsum([0, *(len(rows.labels) for rows in self._fixed)])
        self.fixed_rows = int(starts[-1])
        self._row_labels = tuple(label for rows in self._fixed for label in rows.labels)
        entries = [
            (entry, start) for rows, start in zip(self._fixed, starts, strict=False) for entry in rows.entries
        ]
        self._rows_i = np.concatenate([entry.rows.reshape(-1) + start for entry, start in entries])
        self._rows_j = np.concatenate([entry.columns.reshape(-1) for entry, _ in entries])
        self.tip_rows = np.arange(starts[1], starts[2])
        self.leg_rows = np.arange(self.fixed_rows - len(layout.legs), self.fixed_rows)
        self.gap_rows = np.arange(starts[min(3, len(starts) - 1)], self.fixed_rows - len(layout.legs))
        self.gaps = np.arange(self.column["position"].start, self.column["spacing"].stop)
        self.hard_gaps = self.gaps[layout.hard]
        self._pattern: tuple[bytes, ...] | None = None
        self._matrix = sparse.csc_matrix((0, self.size))
        self._order: Index = np.zeros(0, dtype=np.int64)
        self._labels: tuple[Label, ...] = ()

    @property
    def _turns(self) -> str:
        """Axes of the turns between a station and the curve: tilts about x and y, roll about z."""
        return "xyz"[: self.layout.turns]

    def build(self, numbers: StepNumbers) -> StepQP:
        """Return the QP with the values of `numbers`."""
        layout, clearance = self.layout, numbers.clearance
        columns = layout.node_column[clearance.nodes]
        present = columns >= 0
        pattern = (columns.tobytes(),)
        if pattern != self._pattern:
            k, slot = np.nonzero(present)
            i = np.repeat(self.fixed_rows + k, 3)
            j = (columns[k, slot][:, None] + np.arange(3)).reshape(-1)
            rows = np.concatenate([self._rows_i, i])
            cols = np.concatenate([self._rows_j, j])
            total = self.fixed_rows + len(clearance)
            keys = cols * total + rows
            unique, position = np.unique(keys, return_inverse=True)
            indptr = np.searchsorted(unique, np.arange(self.size + 1) * total)
            self._matrix = sparse.csc_matrix(
                (np.zeros(len(unique)), unique % total, indptr), shape=(total, self.size)
            )
            self._order, self._pattern = position, pattern
        units = {} if layout.own is None else layout.own.units
        self._labels = self._row_labels + tuple(
            Label(name, "user's row" if name in units else "clearance", units.get(name, "m"))
            for name in map(clearance.name, range(len(clearance)))
        )
        fixed = [entry.values(numbers).reshape(-1) for rows in self._fixed for entry in rows.entries]
        values = np.concatenate([*fixed, clearance.coefficients[present].reshape(-1)])
        self._matrix.data[:] = np.bincount(self._order, weights=values, minlength=len(self._matrix.data))

        q = np.zeros(self.size)
        q[self.column["actuators"]] = numbers.actuator_gradient
        q[self.column["vertices"]] = numbers.vertex_gradient.reshape(-1)
        q[self.column["slack"]] = layout.slack_pull
        q[self.column["progress"]] = numbers.progress_gradient
        self._hessian.data[-1] = numbers.progress_curvature

        hessian = self._hessian
        if numbers.own is not None:
            nodes = self.column["nodes"]
            q[nodes] += numbers.own.gradient
            rest = sparse.csc_matrix((self.size - nodes.stop,) * 2)
            hessian = hessian + sparse.block_diag([numbers.own.hessian, rest], format="csc")

        column_lower, column_upper = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        column_lower[self.column["actuators"]], column_upper[self.column["actuators"]] = (
            numbers.lower,
            numbers.upper,
        )
        column_lower[self.column["slack"]] = 0.0
        column_lower[-1], column_upper[-1] = numbers.progress_lower, numbers.progress_upper
        column_lower[self.hard_gaps] = column_upper[self.hard_gaps] = 0.0
        equal = np.concatenate([rows.rhs(numbers).reshape(-1) for rows in self._fixed])
        below = np.concatenate([equal, np.full(len(clearance), np.inf)])
        below[self.leg_rows] = np.inf
        return StepQP(
            hessian,
            q,
            self._matrix,
            np.concatenate([equal, clearance.lower]),
            below,
            column_lower,
            column_upper,
            self._column_labels,
            self._labels,
        )

    def solution(
        self, z: Array, row_multipliers: Array, column_multipliers: Array, iterations: int
    ) -> StepSolution:
        """Return `z` and the multipliers in the arm's terms."""
        arm = self.layout.arm
        nodes = np.zeros((len(arm.node_names), 3))
        nodes[arm.free] = z[self.column["nodes"]].reshape(-1, 3)
        return StepSolution(
            nodes=nodes,
            actuators=z[self.column["actuators"]].copy(),
            vertices=z[self.column["vertices"]].reshape(-1, 3).copy(),
            progress=float(z[-1]),
            actuator_multipliers=column_multipliers[self.column["actuators"]].copy(),
            clearance_multipliers=-row_multipliers[len(self._row_labels) :],
            iterations=iterations,
            torsion=z[self.column["torsion"]].copy(),
            tip_slack=float(np.max(z[self.column["slack"]], initial=0.0)),
        )

    def _columns(self) -> dict[str, tuple[list[Label], Any]]:
        """Return each kind of column: its labels, and its block of the Hessian or that block's diagonal."""
        layout, arm, weights = self.layout, self.layout.arm, self.layout.weights
        word, tracked = arm.stations.word, layout.tracked
        nodes = [arm.node_names[n] for n in arm.free]
        actuators = zip((arm.quantity_names[m] for m in arm.actuators), arm.actuator_units, strict=True)
        slacks = [(name, sign) for sign in "+-" for name in layout.tip_rows] if layout.elastic_tip else []

        def labels(text: str, kind: str, unit: str, of: Iterable[object], axes: str = "xyz") -> list[Label]:
            return [Label(f"{text}{name} {axis}".rstrip(), kind, unit) for name in of for axis in axes]

        return {
            "nodes": (labels("node ", "node displacement", "m", nodes), weights.node_rate),
            "actuators": (
                [Label(f"stroke: {name}", "actuator displacement", of) for name, of in actuators],
                sparse.diags(layout.actuator_weights),
            ),
            "vertices": (
                labels("control vertex p", "control vertex displacement", "m", range(layout.vertices)),
                np.kron(layout.vertex_hessian, np.eye(3)),
            ),
            "torsion": (
                labels("torsion ", "torsion", "rad", range(1, layout.torsion + 1), " "),
                layout.torsion_weight,
            ),
            "position": (
                labels(f"gap: {word} ", "tracking gap", "m", tracked),
                sparse.diags(layout.gap_weights.reshape(-1)),
            ),
            "tangent": (
                labels(f"tilt: {word} ", "tangent gap", "rad", tracked, self._turns),
                sparse.diags(layout.tilt_weights.reshape(-1)),
            ),
            "spacing": (
                labels("stretch: piece ", "spacing gap", "m", range(layout.spacings), " "),
                weights.spacing,
            ),
            "slack": (
                [
                    Label(f"tip slack {name.removeprefix('tip ')}{sign}", "tip slack", unit(name))
                    for name, sign in slacks
                ],
                sparse.diags(layout.slack_weights),
            ),
            "progress": ([Label("progress along the path", "progress", "1")], np.ones((1, 1))),
        }

    def _fixed_rows(self) -> list[_Rows]:
        """Return the rows before the clearances: the arm's motion, the tip, the curve's base, the gaps."""
        layout, arm, column = self.layout, self.layout.arm, self.column
        pattern, tip = arm.motion_pattern, np.arange(len(layout.tip_rows))
        columns, present = layout.tip_columns
        tip_entries = [
            _Entries(*_grid(tip, columns), lambda numbers: numbers.tip_jacobian[:, present]),
            _Entries(tip, np.full(len(tip), self.size - 1), lambda numbers: -numbers.tip_rate),
        ]
        if layout.elastic_tip:
            slack = np.arange(column["slack"].start, column["slack"].stop)
            signs = np.repeat([1.0, -1.0], len(tip))
            tip_entries.append(_Entries(np.tile(tip, 2), slack, lambda _: signs))
        rows = [
            # The arm's motion rows are over nodes and actuators, whose columns come first.
            _Rows(
                pattern.labels,
                [_Entries(pattern.rows, pattern.columns, lambda numbers: numbers.motion.values)],
                lambda numbers: numbers.motion.rhs,
            ),
            _Rows(
                [Label(name, "end effector", unit(name)) for name in layout.tip_rows],
                tip_entries,
                lambda numbers: numbers.tip_rhs,
            ),
        ]
        return rows + self._curve_rows() if layout.vertices else rows

    def _curve_rows(self) -> list[_Rows]:
        layout, stations, column = self.layout, self.layout.arm.stations, self.column
        first, word, count, turns = column["vertices"].start, stations.word, len(layout.tracked), layout.turns
        curve = np.arange(first, column["torsion"].stop)
        faces = layout.node_column[stations.nodes[layout.tracked]]
        k, slot = np.nonzero(faces >= 0)
        axis, turn = np.arange(3), np.arange(turns)
        weights = np.repeat(stations.weights[layout.tracked][k, slot], 3)
        at_turn = np.broadcast_to((turns * k[:, None] + turn)[..., None], (len(k), turns, 3))
        over_face = np.broadcast_to((faces[k, slot][:, None] + axis)[:, None, :], (len(k), turns, 3))
        if layout.general is None:
            moves = np.kron(layout.curve_weights != 0.0, np.eye(3)).nonzero()
            rotates = np.kron(layout.curve_slopes != 0.0, np.ones((turns, 3))).nonzero()
        else:
            moves, rotates = (np.ones((rows * count, len(curve))).nonzero() for rows in (3, turns))

        def base_axes(numbers: StepNumbers) -> Array:
            return np.concatenate([-numbers.base_axes, numbers.base_axes], axis=1)

        def turned(numbers: StepNumbers) -> Array:
            return np.asarray(numbers.tangent_face.reshape(-1, turns, 3, 3)[k, :, slot])

        def gap(name: str) -> _Entries:
            columns = np.arange(column[name].start, column[name].stop)
            return _Entries(np.arange(len(columns)), columns, lambda _: np.full(len(columns), -1.0))

        def spacing(numbers: StepNumbers) -> Array:
            return np.zeros(0) if numbers.curve is None else numbers.curve.spacing_rows

        base = [
            _Entries(axis, curve[:3], lambda _: np.ones(3)),
            _Entries(*_grid(3 + np.arange(2), curve[:6]), base_axes),
        ]
        position = [
            _Entries(3 * k[:, None] + axis, faces[k, slot][:, None] + axis, lambda _: weights),
            _Entries(moves[0], curve[moves[1]], lambda numbers: -numbers.curve_rows(layout)[0][moves]),
            gap("position"),
        ]
        tangent = [
            _Entries(at_turn, over_face, turned),
            _Entries(rotates[0], curve[rotates[1]], lambda numbers: numbers.curve_rows(layout)[1][rotates]),
            gap("tangent"),
        ]
        pieces = np.arange(layout.spacings)
        names = [*(f"base {a}" for a in "xyz"), *(f"base tangent {a}" for a in "xy")]
        return [
            _Rows(
                [Label(f"curve {name}", "curve base", "m") for name in names],
                base,
                lambda numbers: np.concatenate([numbers.base_displacement, numbers.base_rhs]),
            ),
            _Rows(
                [Label(f"track: {word} {f} {a}", "tracking", "m") for f in layout.tracked for a in "xyz"],
                position,
                lambda numbers: -numbers.position_rhs,
            ),
            _Rows(
                [
                    Label(f"tilt: {word} {f} {a}", "tangent", "rad")
                    for f in layout.tracked
                    for a in self._turns
                ],
                tangent,
                lambda numbers: -numbers.tangent_rhs,
            ),
            _Rows(
                [Label(f"spacing: piece {piece}", "spacing", "m") for piece in pieces],
                [_Entries(*_grid(pieces, curve), spacing), gap("spacing")],
                lambda numbers: -numbers.spacing_rhs,
            ),
            self._leg_rows(curve[: 3 * layout.vertices]),
        ]

    def _leg_rows(self, vertices: Index) -> _Rows:
        """Return the rows of the legs with given directions; `vertices` (3 V,) are the vertices' columns."""
        count = len(self.layout.legs)
        labels = [Label(f"curve {name} leg", "curve leg", "m") for name in ("first", "last")[:count]]
        grid = _grid(np.arange(count), vertices)
        entries = [_Entries(*grid, lambda numbers: numbers.legs.rows)]
        return _Rows(labels, entries, lambda numbers: numbers.legs.lower)


class _Entries(NamedTuple):
    """Entries of one kind of row: rows, counted from the first of that kind, columns and values."""

    rows: Index
    columns: Index
    values: Callable[[StepNumbers], Array]


class _Rows(NamedTuple):
    """A kind of row: its labels, its entries and its right-hand sides."""

    labels: Sequence[Label]
    entries: Sequence[_Entries]
    rhs: Callable[[StepNumbers], Array]


def _grid(rows: Index, columns: Index) -> tuple[Index, Index]:
    """Return the row and column of every entry of a dense block."""
    return np.repeat(rows, len(columns)), np.tile(columns, len(rows))
