"""The rows with bounds of a long arm's QP: the few that are near them meet in a small dense QP."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotrs, dpstrf

from vgtm_qp.arm.arm import Bays, LengthRowsLike
from vgtm_qp.errors import SolverError
from vgtm_qp.qp import daqp
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import UNBOUNDED, ClearanceRows, StepNumbers, StepSolution
from vgtm_qp.qp.residual import InfeasibleStepError

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_NO_ROW = 1e-11
_DEPENDENT = 1e-14
_INDEPENDENT = 1e-4
"""Rows whose Cholesky pivots differ by less than this are far from dependent."""
_VIOLATED = 1e-10
_REFINEMENTS = 4


MemberRows = Callable[[Index], tuple[Index, Array]]
"""Nodes (R, Q) and coefficients (R, Q, 3) of the lengths of members (R,); base nodes may have any coefficients."""

Moved = Callable[[Index], Array]
"""Displacements (..., 3), m, of nodes (...,)."""


@dataclass(frozen=True, eq=False)
class RowNumbers:
    """What the rows with bounds, and the progress, need of a QP; see :class:`StepNumbers`."""

    lower: Array
    upper: Array
    tip_jacobian: Array
    tip_rate: Array
    tip_rhs: Array
    progress_lower: float
    progress_upper: float
    progress_gradient: float
    progress_curvature: float
    clearance: ClearanceRows
    actuator_gradient: Array
    member_rows: MemberRows

    @classmethod
    def of(cls, bays: Bays, numbers: StepNumbers) -> RowNumbers:
        """Return those of `numbers`."""
        rows = cast(LengthRowsLike, numbers.motion)
        return cls(
            lower=numbers.lower,
            upper=numbers.upper,
            tip_jacobian=numbers.tip_jacobian,
            tip_rate=numbers.tip_rate,
            tip_rhs=numbers.tip_rhs,
            progress_lower=numbers.progress_lower,
            progress_upper=numbers.progress_upper,
            progress_gradient=numbers.progress_gradient,
            progress_curvature=numbers.progress_curvature,
            clearance=numbers.clearance,
            actuator_gradient=numbers.actuator_gradient,
            member_rows=lambda members: (bays.member_nodes[members], rows.gradient[members]),
        )


@dataclass(frozen=True, eq=False)
class RowTable:
    """All rows with bounds of one QP: tip, locked members, progress, actuators, clearance, in this order.

    Attributes
    ----------
    layout : Layout
    numbers : RowNumbers
    locked : (l,) int
        Fixed members that are held by a row of their own.
    lower, upper : (total,)
    equal : int
        Number of equalities, which come first.
    actuators, clearance : slice
        Where the actuators' bounds and the clearance rows are.
    """

    layout: Layout
    numbers: RowNumbers
    locked: Index
    lower: Array
    upper: Array
    equal: int
    actuators: slice
    clearance: slice

    @classmethod
    def of(cls, layout: Layout, numbers: RowNumbers, locked: Index) -> RowTable:
        """Return the table of `numbers`."""
        held = np.zeros(len(locked))
        clearance = numbers.clearance.lower
        lower = [numbers.tip_rhs, held, np.array([numbers.progress_lower]), numbers.lower, clearance]
        upper = [
            numbers.tip_rhs,
            held,
            np.array([numbers.progress_upper]),
            numbers.upper,
            np.full(len(clearance), UNBOUNDED),
        ]
        equal = len(numbers.tip_rhs) + len(locked)
        first_clearance = equal + 1 + len(numbers.lower)
        return cls(
            layout,
            numbers,
            locked,
            np.concatenate(lower),
            np.concatenate(upper),
            equal,
            slice(equal + 1, first_clearance),
            slice(first_clearance, first_clearance + len(clearance)),
        )

    def values(self, moved: Moved, strokes: Array, held: Array, progress: float) -> Array:
        """Return (total,) row values at displacements of the nodes.

        `strokes` (n_a,) and `held` (l,) are the changes of the actuated and of the locked members' lengths.
        """
        numbers, clearance = self.numbers, self.numbers.clearance
        tip = moved(self.layout.arm.end_effector.nodes).reshape(-1)
        return np.concatenate(
            [
                numbers.tip_jacobian @ tip - numbers.tip_rate * progress,
                held,
                [progress],
                strokes,
                np.einsum("rsc,rsc->r", clearance.coefficients, moved(clearance.nodes)),
            ]
        )

    def violation(self, values: Array) -> Array:
        """Return (total,) how far the values are out of their bounds; not positive where they are not."""
        return np.maximum(self.lower - values, values - self.upper)

    def coefficients(self, rows: Index) -> tuple[Index, Array, Array]:
        """Return nodes (R, Q), coefficients (R, Q, 3), zero where spare, and those of the progress (R,)."""
        numbers, tip_nodes = self.numbers, self.layout.arm.end_effector.nodes
        tip = len(numbers.tip_rhs)
        if rows.max() < tip + (not len(self.locked)):
            every = np.vstack([numbers.tip_jacobian, np.zeros_like(numbers.tip_jacobian[:1])])
            on_tip = every[rows].reshape(len(rows), -1, 3)
            return np.tile(tip_nodes, (len(rows), 1)), on_tip, np.append(-numbers.tip_rate, 1.0)[rows]
        is_stroke = (rows >= self.actuators.start) & (rows < self.clearance.start)
        is_held = (rows >= tip) & (rows < self.equal)
        members = np.empty(len(rows), dtype=np.int64)
        members[is_stroke] = self.layout.arm.actuators[rows[is_stroke] - self.actuators.start]
        members[is_held] = self.locked[rows[is_held] - tip]
        along = np.flatnonzero(is_stroke | is_held)
        member_nodes, gradients = numbers.member_rows(members[along])
        width = max(len(tip_nodes), member_nodes.shape[1], numbers.clearance.nodes.shape[1])
        nodes, coefficients = np.zeros((len(rows), width), dtype=np.int64), np.zeros((len(rows), width, 3))
        progress = np.zeros(len(rows))

        def put(where: Index, named: Index, values: Array) -> None:
            nodes[where, : named.shape[-1]] = named
            coefficients[where, : named.shape[-1]] = values

        put(along, member_nodes, gradients)
        where = np.flatnonzero(rows < tip)
        put(where, tip_nodes, numbers.tip_jacobian[rows[where]].reshape(len(where), len(tip_nodes), 3))
        progress[where] = -numbers.tip_rate[rows[where]]
        progress[rows == self.equal] = 1.0
        where = np.flatnonzero(rows >= self.clearance.start)
        near = rows[where] - self.clearance.start
        put(where, numbers.clearance.nodes[near], numbers.clearance.coefficients[near])
        return nodes, coefficients, progress

    def nodal_forces(self, multipliers: Array) -> Array:
        """Return (N, 3) the tip's and clearance rows' multipliers (total,) times their coefficients."""
        numbers, arm = self.numbers, self.layout.arm
        forces = np.zeros((len(arm.node_names), 3))
        tip = multipliers[: len(numbers.tip_rhs)] @ numbers.tip_jacobian
        np.add.at(forces, arm.end_effector.nodes, tip.reshape(-1, 3))
        active = np.flatnonzero(multipliers[self.clearance])
        pressing = multipliers[self.clearance][active, None, None] * numbers.clearance.coefficients[active]
        np.add.at(forces, numbers.clearance.nodes[active], pressing)
        return forces

    def key(self, row: int) -> tuple[object, ...]:
        """Return what names the row in the next QP, where clearance rows may be others."""
        if row < self.clearance.start:
            return (row,)
        return ("clearance", self.numbers.clearance.nodes[row - self.clearance.start].tobytes())

    def remembered(self, keys: set[tuple[object, ...]]) -> list[int]:
        """Return the inequality rows that `keys` name."""
        found = [key[0] for key in keys if len(key) == 1]
        rows = [row for row in found if isinstance(row, int) and self.equal <= row < self.clearance.start]
        if len(found) < len(keys):
            rows += [k for k in range(self.clearance.start, len(self.lower)) if self.key(k) in keys]
        return sorted(rows)


def _all_active(
    gram: Array, values: Array, lower: Array, upper: Array, equal: NDArray[np.bool_]
) -> Array | None:
    """Return the multipliers where all rows are active at the bounds they violate; None where they may not be."""
    above = equal | (values > upper)
    if not np.all(above | (values < lower)):
        return None
    factor, failed = dpotrf(gram, lower=1)
    pivots = factor.diagonal()
    if failed or not pivots.min() > _INDEPENDENT * pivots.max():
        return None
    found: Array = dpotrs(factor, values - np.where(above, upper, lower), lower=1)[0]
    right = np.where(above, found, -found)[~equal] >= 0.0
    return found if right.all() and np.isfinite(found).all() else None


def dual_solution(
    gram: Array, values: Array, lower: Array, upper: Array, equal: NDArray[np.bool_]
) -> tuple[Array, int]:
    """Return the multipliers that bring `values` - `gram` multipliers into the bounds at least cost.

    Multipliers are positive at upper and negative at lower bounds. `gram` (R, R) is A H^-1 A' of rows A.

    Raises
    ------
    InfeasibleStepError
        The rows contradict one another.
    SolverError
        The dual QP was not solved.
    """
    guessed = _all_active(gram, values, lower, upper, equal)
    if guessed is not None:
        return guessed, 1
    norm = np.sqrt(np.maximum(np.diag(gram), 0.0))
    multipliers = np.zeros(len(norm))
    if not np.all(np.isfinite(norm)):
        raise SolverError("the QP is singular: the truss is in a singular pose, or all weights are zero")
    empty = norm < _NO_ROW
    if empty.any():
        outside = np.maximum(lower - values, values - upper)[empty]
        if outside.max() > 1e-9:
            raise InfeasibleStepError("a hard row cannot be moved by any actuator")
    kept = np.flatnonzero(~empty)
    if not len(kept):
        return multipliers, 0
    scale = 1.0 / norm[kept]
    scaled = gram[np.ix_(kept, kept)] * scale[:, None] * scale
    factor, pivot, rank, _ = dpstrf(scaled, tol=_DEPENDENT * len(kept), lower=1)
    rows = np.zeros((len(kept), rank))
    rows[pivot - 1] = np.tril(factor)[:, :rank]
    bounds = []
    for bound in (lower, upper):
        value = bound[kept]
        free = np.abs(value) >= UNBOUNDED
        bounds.append(np.where(free, value, (value - values[kept]) * scale))
    sense = np.where(equal[kept], daqp.EQUALITY, 0).astype(np.int32)
    answer = daqp.ask(np.eye(rank), np.zeros(rank), rows, bounds[0], bounds[1], sense)
    if answer.flag < 1:
        raise SolverError(f"daqp ended with exit flag {answer.flag}")
    multipliers[kept] = answer.multipliers * scale
    return multipliers, answer.iterations


@dataclass(frozen=True, eq=False)
class Point:
    """A primal point of the QP and its row values.

    Attributes
    ----------
    nodes : (N, 3)
    vertices : (V, 3)
    progress : float
    values : (total,)
    """

    nodes: Array
    vertices: Array
    progress: float
    values: Array


class Eliminated(Protocol):
    """A QP whose unknowns are eliminated: H = L L' for some L that only it knows."""

    def columns(self, table: RowTable, rows: Index) -> Array:
        """Return (size, len(rows)) L^-1 A' of the given rows A."""
        ...

    def values(self, table: RowTable, combined: Array) -> Array:
        """Return (total,) the row values where the Lagrangian is least, given columns times multipliers (size,)."""
        ...

    def point(self, values: Array) -> Point:
        """Return the point whose `values` were asked for last."""
        ...


@dataclass(frozen=True, eq=False)
class Answer:
    """The primal and dual answer of a QP.

    Attributes
    ----------
    table : RowTable
    point : Point
    multipliers : (total,)
        Positive at upper and negative at lower bounds.
    iterations : int
        Of the dual QPs.
    rows : list of int
        Those that were in the dual QP, equalities first.
    columns, gram : (size, R), (R, R)
        Their columns, and what these are multiplied with each other.
    """

    table: RowTable
    point: Point
    multipliers: Array
    iterations: int
    rows: list[int]
    columns: Array
    gram: Array

    @property
    def active(self) -> set[tuple[object, ...]]:
        """Keys of the active inequalities."""
        return {self.table.key(k) for k in np.flatnonzero(self.multipliers).tolist() if k >= self.table.equal}

    def solution(self) -> StepSolution:
        """Return the answer in the arm's terms."""
        table, point = self.table, self.point
        return StepSolution(
            nodes=point.nodes,
            actuators=point.values[table.actuators].copy(),
            vertices=point.vertices,
            progress=point.progress,
            actuator_multipliers=self.multipliers[table.actuators].copy(),
            clearance_multipliers=-self.multipliers[table.clearance],
            iterations=self.iterations,
        )


def solve_rows(
    problem: Eliminated, size: int, table: RowTable, remembered: set[tuple[object, ...]], block: int = 8
) -> Answer:
    """Return the answer of a QP with the rows of `table`; `remembered` are keys of those active before.

    Rows enter the dual QP when they are violated, the worst first, and stay: so it ends.

    Raises
    ------
    InfeasibleStepError
        The rows contradict one another.
    SolverError
        A dual QP was not solved, or rounding kept a row out of its bounds.
    """
    rows: list[int] = []
    columns = np.zeros((size, 0))
    gram = np.zeros((0, 0))
    multipliers = np.zeros(0)
    iterations, refined = 0, 0
    new = [*range(table.equal), *table.remembered(remembered)]
    values = problem.values(table, np.zeros(size))
    while True:
        violation = table.violation(values)
        violated = np.flatnonzero(violation > _VIOLATED)
        known = {*rows, *new}
        outside = np.array([k for k in violated.tolist() if k not in known], dtype=np.int64)
        room = block * max(1, len(outside) // (4 * block))
        if not rows:
            room = max(0, -len(new) % block)
        new += outside[np.argsort(-violation[outside])][:room].tolist()
        if not new:
            if not len(violated):
                break
            refined += 1
            if refined > _REFINEMENTS:
                raise SolverError(f"rounding left a row {violation.max():.1e} m or rad out of its bounds")
        else:
            added = problem.columns(table, np.array(new, dtype=np.int64))
            columns = np.hstack([columns, added])
            grown = np.empty((columns.shape[1],) * 2)
            grown[: len(gram), : len(gram)] = gram
            grown[:, len(gram) :] = columns.T @ added
            grown[len(gram) :] = grown[:, len(gram) :].T
            gram = grown
            rows += new
            multipliers = np.concatenate([multipliers, np.zeros(len(new))])
            new = []
        index = np.array(rows, dtype=np.int64)
        multipliers, count = dual_solution(
            gram,
            values[index] + gram @ multipliers,
            table.lower[index],
            table.upper[index],
            index < table.equal,
        )
        iterations += count
        values = problem.values(table, columns @ multipliers)
    every = np.zeros(len(table.lower))
    every[rows] = multipliers
    return Answer(table, problem.point(values), every, iterations, rows, columns, gram)
