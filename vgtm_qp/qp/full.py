"""The whole QP of one step, every column and row with a name, a kind and a unit.

    minimise  1/2 z' P z + q' z   subject to   row_lower <= A z <= row_upper,  column_lower <= z <= column_upper

z holds the displacements over the step of nodes, actuators, control vertices and path progress, and after it the gaps
between faces and curve and what an elastic tip leaves; because actuators and gaps are columns of their own, P is
constant and only A's values change.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from vgtm_qp.arm.arm import Label
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import StepNumbers, StepSolution, beyond, norm, slack_curvature
from vgtm_qp.rows.tip import unit

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False, repr=False)
class StepQP:
    """A step's QP as data. Arrays are its builder's, and valid until that builds again.

    Attributes
    ----------
    P : (n, n) sparse
        Hessian, symmetric, constant over a maneuver.
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

    def dual_residual(self, z: Array, row_multipliers: Array, column_multipliers: Array) -> float:
        """Return |P z + q + A'y + w|, multipliers positive at upper and negative at lower bounds."""
        return norm(self.P @ z + self.q + self.A.T @ row_multipliers + column_multipliers)

    def complementarity_residual(self, z: Array, row_multipliers: Array, column_multipliers: Array) -> float:
        """Return the norm of |multiplier| times slack of its bound, at most 1: what multipliers press on nothing.

        A multiplier of the wrong sign has the slack of the other bound, one of a free row an infinite slack.
        """
        pairs = (
            (row_multipliers, self.A @ z, self.row_lower, self.row_upper),
            (column_multipliers, z, self.column_lower, self.column_upper),
        )
        parts = []
        for multiplier, x, lower, upper in pairs:
            slack = np.where(multiplier > 0.0, upper - x, x - lower)
            parts.append(np.abs(multiplier) * np.clip(slack, 0.0, 1.0))
        return norm(np.concatenate(parts))

    def violated(self, z: Array, tolerance: float = 1e-9) -> list[tuple[str, float]]:
        """Return the names of rows and columns out of their bounds at `z` by more than `tolerance`, worst first."""
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
    """Fills the full QP from :class:`StepNumbers`; the sparsity is kept while the near pairs stay the same."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        arm, weights = layout.arm, layout.weights
        tracked, vertices = len(layout.tracked), layout.vertices
        sizes = {
            "nodes": layout.node_columns,
            "actuators": len(arm.actuators),
            "vertices": 3 * vertices,
            "torsion": layout.torsion,
            "position": 3 * tracked,
            "tangent": layout.turns * tracked,
            "spacing": layout.spacings,
            "slack": 2 * len(layout.tip_rows) if layout.elastic_tip else 0,
            "progress": 1,
        }
        ends = np.cumsum(list(sizes.values()))
        self.column = {
            name: slice(int(end - size), int(end))
            for (name, size), end in zip(sizes.items(), ends, strict=True)
        }
        self.size = int(ends[-1])
        diagonal = [
            np.full(sizes["nodes"], weights.node_rate),
            np.full(sizes["actuators"], weights.actuator_rate + weights.stroke_centring),
        ]
        self._hessian = sparse.block_diag(
            [
                sparse.diags(np.concatenate(diagonal)),
                np.kron(layout.vertex_hessian, np.eye(3)),
                weights.curve_rate * np.eye(layout.torsion),
                sparse.diags(np.full(sizes["position"], 0.0 if layout.hard_tracking else weights.tracking)),
                sparse.diags(0.0 * layout.turn_weights if layout.hard_turns else layout.turn_weights),
                sparse.diags(np.full(sizes["spacing"], weights.spacing)),
                sparse.diags(np.full(sizes["slack"], slack_curvature(weights.end_effector))),
                np.ones((1, 1)),
            ],
            format="csc",
        )
        self._rows_i, self._rows_j, self._row_labels = self._fixed_pattern()
        self._column_labels = self._columns()
        self._pattern: tuple[bytes, ...] | None = None
        self._matrix = sparse.csc_matrix((0, self.size))
        self._order: Index = np.zeros(0, dtype=np.int64)
        self._labels: tuple[Label, ...] = ()
        self._keep: Index = np.zeros(0, dtype=np.int64)

    @property
    def _turns(self) -> str:
        """Axes of the turns between a face and the curve: x and y tilt it, z rolls it."""
        return "xyz"[: self.layout.turns]

    @property
    def structure(self) -> object:
        """A token that changes when the sparsity of `A` does."""
        return self._pattern

    def build(self, numbers: StepNumbers) -> StepQP:
        """Return the QP with the values of `numbers`."""
        layout, clearance = self.layout, numbers.clearance
        fixed_rows = len(self._row_labels)
        columns = layout.node_column[clearance.nodes]
        present = columns >= 0
        pattern = (columns.tobytes(),)
        if pattern != self._pattern:
            k, slot = np.nonzero(present)
            i = np.repeat(fixed_rows + k, 3)
            j = (columns[k, slot][:, None] + np.arange(3)).reshape(-1)
            rows = np.concatenate([self._rows_i, i])
            cols = np.concatenate([self._rows_j, j])
            total = fixed_rows + len(clearance)
            keys = cols * total + rows
            unique, position = np.unique(keys, return_inverse=True)
            indptr = np.searchsorted(unique, np.arange(self.size + 1) * total)
            self._matrix = sparse.csc_matrix(
                (np.zeros(len(unique)), unique % total, indptr), shape=(total, self.size)
            )
            self._order, self._pattern = position, pattern
        self._labels = self._row_labels + tuple(
            Label(clearance.name(k), "clearance", "m") for k in range(len(clearance))
        )
        values = np.concatenate([self._fixed_values(numbers), clearance.coefficients[present].reshape(-1)])
        self._matrix.data[:] = np.bincount(self._order, weights=values, minlength=len(self._matrix.data))

        q = np.zeros(self.size)
        q[self.column["actuators"]] = numbers.actuator_gradient
        q[self.column["vertices"]] = numbers.vertex_gradient.reshape(-1)
        q[self.column["slack"]] = layout.weights.end_effector
        q[self.column["progress"]] = numbers.progress_gradient
        self._hessian.data[-1] = numbers.progress_curvature

        column_lower, column_upper = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        column_lower[self.column["actuators"]], column_upper[self.column["actuators"]] = (
            numbers.lower,
            numbers.upper,
        )
        column_lower[self.column["slack"]] = 0.0
        column_lower[-1], column_upper[-1] = numbers.progress_lower, numbers.progress_upper
        if layout.hard_tracking:
            column_lower[self.column["position"]] = column_upper[self.column["position"]] = 0.0
        if layout.hard_turns:
            column_lower[self.column["tangent"]] = column_upper[self.column["tangent"]] = 0.0
        equal = np.concatenate(
            [
                numbers.motion.rhs,
                numbers.tip_rhs,
                numbers.base_displacement if layout.vertices else np.zeros(0),
                numbers.base_rhs if layout.vertices else np.zeros(0),
                -numbers.position_rhs.reshape(-1),
                -(numbers.tangent_rhs if numbers.curve is None else numbers.curve.turn_rhs).reshape(-1),
                np.zeros(0) if numbers.curve is None else -numbers.curve.spacing_rhs,
            ]
        )
        return StepQP(
            self._hessian,
            q,
            self._matrix,
            np.concatenate([equal, clearance.lower]),
            np.concatenate([equal, np.full(len(clearance), np.inf)]),
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

    def _columns(self) -> tuple[Label, ...]:
        layout, arm = self.layout, self.layout.arm
        axes, word = "xyz", arm.stations.word
        labels = [
            Label(f"node {arm.node_names[n]} {a}", "node displacement", "m") for n in arm.free for a in axes
        ]
        labels += [
            Label(f"stroke: {arm.quantity_names[m]}", "actuator displacement", unit)
            for m, unit in zip(arm.actuators, arm.actuator_units, strict=True)
        ]
        labels += [
            Label(f"control vertex p{i} {a}", "control vertex displacement", "m")
            for i in range(layout.vertices)
            for a in axes
        ]
        labels += [Label(f"torsion {j + 1}", "torsion", "rad") for j in range(layout.torsion)]
        labels += [Label(f"gap: {word} {k} {a}", "tracking gap", "m") for k in layout.tracked for a in axes]
        labels += [
            Label(f"tilt: {word} {k} {a}", "tangent gap", "rad") for k in layout.tracked for a in self._turns
        ]
        labels += [Label(f"stretch: piece {k}", "spacing gap", "m") for k in range(layout.spacings)]
        if layout.elastic_tip:
            labels += [
                Label(f"tip slack {name.removeprefix('tip ')}{sign}", "tip slack", unit(name))
                for sign in "+-"
                for name in layout.tip_rows
            ]
        return (*labels, Label("progress along the path", "progress", "1"))

    def _fixed_pattern(self) -> tuple[Index, Index, tuple[Label, ...]]:
        """Return row and column of every entry above the clearance rows, in the order of `_fixed_values`."""
        layout, arm, column = self.layout, self.layout.arm, self.column
        stations, word, tips = arm.stations, arm.stations.word, arm.end_effector.nodes
        rows: list[Index] = []
        cols: list[Index] = []
        labels: list[Label] = []

        def add(i: Index, j: Index) -> None:
            rows.append(np.asarray(i, dtype=np.int64).reshape(-1) + len(labels))
            cols.append(np.asarray(j, dtype=np.int64).reshape(-1))

        # Columns of the arm's own rows are those of the nodes and actuators, which come first.
        add(arm.motion_pattern.rows, arm.motion_pattern.columns)
        labels += arm.motion_pattern.labels
        tip = len(layout.tip_rows)
        tip_columns = layout.node_column[tips]
        present = np.repeat(tip_columns >= 0, 3)
        flat = (tip_columns[:, None] + np.arange(3)).reshape(-1)[present]
        add(np.repeat(np.arange(tip), len(flat)), np.tile(flat, tip))
        add(np.arange(tip), np.full(tip, column["progress"].start))
        if layout.elastic_tip:
            add(np.tile(np.arange(tip), 2), np.arange(column["slack"].start, column["slack"].stop))
        labels += [Label(name, "end effector", unit(name)) for name in layout.tip_rows]
        if not layout.vertices:
            return np.concatenate(rows), np.concatenate(cols), tuple(labels)

        vertex = column["vertices"].start
        add(np.arange(3), vertex + np.arange(3))
        labels += [Label(f"curve base {a}", "curve base", "m") for a in "xyz"]
        add(np.repeat(np.arange(2), 6), np.tile(vertex + np.arange(6), 2))
        labels += [Label(f"curve base tangent {a}", "curve base", "m") for a in "xy"]

        tracked = len(layout.tracked)
        faces = layout.node_column[stations.nodes[layout.tracked]]
        k, slot = np.nonzero(faces >= 0)
        axis = np.arange(3)
        add(3 * k[:, None] + axis, faces[k, slot][:, None] + axis)
        if layout.general is None:
            i, v = np.nonzero(layout.curve_weights)
            add(3 * i[:, None] + axis, vertex + 3 * v[:, None] + axis)
        else:
            curve = np.arange(vertex, column["torsion"].stop)
            add(*(grid.reshape(-1) for grid in np.meshgrid(np.arange(3 * tracked), curve, indexing="ij")))
        add(np.arange(3 * tracked), column["position"].start + np.arange(3 * tracked))
        labels += [Label(f"track: {word} {f} {a}", "tracking", "m") for f in layout.tracked for a in "xyz"]

        turns = layout.turns
        shape = (len(k), turns, 3)
        add(
            np.broadcast_to((turns * k[:, None] + np.arange(turns))[..., None], shape),
            np.broadcast_to((faces[k, slot][:, None] + axis)[:, None, :], shape),
        )
        if layout.general is None:
            i, v = np.nonzero(layout.curve_slopes)
            shape = (len(i), 2, 3)
            add(
                np.broadcast_to((2 * i[:, None] + np.arange(2))[..., None], shape),
                np.broadcast_to((vertex + 3 * v[:, None] + axis)[:, None, :], shape),
            )
        else:
            add(*(grid.reshape(-1) for grid in np.meshgrid(np.arange(turns * tracked), curve, indexing="ij")))
        add(np.arange(turns * tracked), column["tangent"].start + np.arange(turns * tracked))
        labels += [
            Label(f"tilt: {word} {f} {a}", "tangent", "rad") for f in layout.tracked for a in self._turns
        ]
        if layout.spacings:
            pieces = np.arange(layout.spacings)
            add(*(grid.reshape(-1) for grid in np.meshgrid(pieces, curve, indexing="ij")))
            add(pieces, column["spacing"].start + pieces)
            labels += [Label(f"spacing: piece {k}", "spacing", "m") for k in pieces]
        return np.concatenate(rows), np.concatenate(cols), tuple(labels)

    def _fixed_values(self, numbers: StepNumbers) -> Array:
        layout, arm = self.layout, self.layout.arm
        present = np.repeat(layout.node_column[arm.end_effector.nodes] >= 0, 3)
        values = [
            numbers.motion.values,
            numbers.tip_jacobian[:, present].reshape(-1),
            -numbers.tip_rate,
        ]
        if layout.elastic_tip:
            values += [np.repeat([1.0, -1.0], len(layout.tip_rows))]
        if layout.vertices:
            faces = arm.stations.nodes[layout.tracked]
            k, slot = np.nonzero(layout.node_column[faces] >= 0)
            weights = arm.stations.weights[layout.tracked][k, slot]
            given = numbers.curve
            turned = numbers.tangent_face if given is None else given.turn_face
            tangent = turned.reshape(-1, layout.turns, 3, 3)[k, :, slot]
            if given is None:
                i, v = np.nonzero(layout.curve_weights)
                position = np.repeat(-layout.curve_weights[i, v], 3)
                ii, vv = np.nonzero(layout.curve_slopes)
                slope = numbers.tangent_curve[ii] * layout.curve_slopes[ii, vv][:, None, None]
            else:
                position, slope = -given.position, given.turn_curve
            base = np.concatenate([-numbers.base_axes, numbers.base_axes], axis=1)
            values += [
                np.ones(3),
                base.reshape(-1),
                np.repeat(weights, 3),
                position.reshape(-1),
                np.full(3 * len(layout.tracked), -1.0),
                tangent.reshape(-1),
                slope.reshape(-1),
                np.full(layout.turns * len(layout.tracked), -1.0),
            ]
            if layout.spacings and given is not None:
                values += [given.spacing.reshape(-1), np.full(layout.spacings, -1.0)]
        return np.concatenate(values)
