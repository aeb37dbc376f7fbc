"""The rows with bounds of a long arm's QP: those near a bound form a small dense QP."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpotrf, dpotrs, dpstrf

from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import SolverError
from vgtm_qp.qp.dense import EQUALITY, DenseQP, DenseSolver, answered
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.long.chain_data import EndRows
from vgtm_qp.qp.numbers import UNBOUNDED, RowNumbers
from vgtm_qp.qp.residual import AnswerError, InfeasibleStepError

BLOCK = 8
"""Least number of violated rows that enter the dual QP at once."""

NO_ROW = 1e-11
DEPENDENT = 1e-14
INDEPENDENT = 1e-4
"""Ratio of the least to the greatest Cholesky pivot above which rows are far from dependent."""
REFINEMENTS = 4
"""Times that rounding may be removed from an answer whose rows are all known."""

UNMOVABLE = 1e-9
"""Distance from its bounds, m or rad, that is allowed to a row that nothing moves."""


MemberRows = Callable[[Index], tuple[Index, Array]]
"""Nodes (R, Q) and coefficients (R, Q, 3) of the lengths of members (R,); base nodes may have any coefficients."""

Key = int | bytes
"""Key of a row from QP to QP: its number, or the nodes of a clearance row."""

DisplacementsAt = Callable[[Index], Array]
"""Displacements (..., 3), m, of nodes (...,)."""


class RowTable:
    """All rows with bounds: tip, locked members, curve's end, progress, legs, actuators, clearance; in this order.

    Attributes
    ----------
    numbers : RowNumbers
    locked, end, actuators, clearance : slice
        Rows of each kind; `locked` are fixed members that a separate row holds.
    equal : int
        Number of equalities, which come first; the progress is the next row.
    lower, upper : (total,)
    """

    def __init__(
        self,
        layout: Layout,
        numbers: RowNumbers,
        locked: Index,
        member_rows: MemberRows,
        end: EndRows,
        legs: Array,
    ) -> None:
        self.numbers, self._arm, self._member_rows, self._end = numbers, layout.arm, member_rows, end
        self._legs = legs
        self._tip, near, held = len(numbers.tip_rhs), len(numbers.clearance), np.zeros(len(locked))
        self.locked = slice(self._tip, self._tip + len(locked))
        self.equal = self.locked.stop + len(end.rhs)
        self.end = slice(self.locked.stop, self.equal)
        self.legs = slice(self.equal + 1, self.equal + 1 + len(legs))
        self.actuators = slice(self.legs.stop, self.legs.stop + len(numbers.lower))
        self.clearance = slice(self.actuators.stop, self.actuators.stop + near)
        known, lower, free = (
            [numbers.tip_rhs, held, end.rhs],
            numbers.clearance.lower,
            np.full(near, UNBOUNDED),
        )
        least, any_length = numbers.legs.lower, np.full(len(legs), UNBOUNDED)
        self.lower = np.concatenate([*known, [numbers.progress_lower], least, numbers.lower, lower])
        self.upper = np.concatenate([*known, [numbers.progress_upper], any_length, numbers.upper, free])
        none = np.full(len(end.rhs) + 1 + len(legs), -1)
        self._members = np.concatenate([locked, none, layout.arm.actuators])

    def values(
        self, moved: DisplacementsAt, strokes: Array, held: Array, curve: Array, progress: float
    ) -> Array:
        """Return (total,) row values at displacements of the nodes.

        `strokes` (n_a,) and `held` (l,) are the changes of the actuated and of the locked members' lengths, `curve`
        (3V - 5,) those of the curve's free coordinates.
        """
        numbers, clearance = self.numbers, self.numbers.clearance
        tip = numbers.tip_jacobian @ moved(self._arm.end_effector.nodes).reshape(-1)
        near, end = np.einsum("rsc,rsc->r", clearance.coefficients, moved(clearance.nodes)), self._end.rhs
        if len(end):
            end = np.tensordot(self._end.coefficients, moved(self._end.nodes), 2) + self._end.curve @ curve
        legs = self._legs @ curve
        return np.concatenate([tip - numbers.tip_rate * progress, held, end, [progress], legs, strokes, near])

    def coefficients(self, rows: Index) -> tuple[Index, Array, Array, Array]:
        """Return nodes (R, Q) of rows and their coefficients (R, Q, 3), zero at unused places.

        Then the coefficients of the curve's free coordinates (R, 3V - 5) and of the progress (R,).
        """
        numbers, clearance, tip_nodes = self.numbers, self.numbers.clearance, self._arm.end_effector.nodes
        progress = (rows == self.equal).astype(float)
        at_tip = np.flatnonzero(rows < self._tip)
        progress[at_tip] = -numbers.tip_rate[rows[at_tip]]
        on_tip = numbers.tip_jacobian[rows[at_tip]].reshape(len(at_tip), len(tip_nodes), 3)
        parts = [(at_tip, tip_nodes[None], on_tip)]
        is_near = rows >= self.clearance.start
        curve = np.zeros((len(rows), self._end.curve.shape[1]))
        at_end = np.flatnonzero((rows >= self.end.start) & (rows < self.equal))
        if len(at_end):
            which = rows[at_end] - self.end.start
            parts.append((at_end, self._end.nodes[None], self._end.coefficients[which]))
            curve[at_end] = self._end.curve[which]
        at_legs = np.flatnonzero((rows >= self.legs.start) & (rows < self.legs.stop))
        curve[at_legs] = self._legs[rows[at_legs] - self.legs.start]
        is_member = ((rows >= self._tip) & (rows < self.end.start)) | (
            (rows >= self.actuators.start) & ~is_near
        )
        at_members = np.flatnonzero(is_member)
        if len(at_members):
            parts.append((at_members, *self._member_rows(self._members[rows[at_members] - self._tip])))
        if is_near.any():
            at_near = np.flatnonzero(is_near)
            near = rows[at_near] - self.clearance.start
            parts.append((at_near, clearance.nodes[near], clearance.coefficients[near]))
        width = max(named.shape[1] for _, named, _ in parts)
        nodes, coefficients = np.zeros((len(rows), width), dtype=np.int64), np.zeros((len(rows), width, 3))
        for where, named, values in parts:
            nodes[where, : named.shape[1]] = named
            coefficients[where, : named.shape[1]] = values
        return nodes, coefficients, curve, progress

    def curve_forces(self, multipliers: Array) -> Array:
        """Return (3V - 5,) the multipliers (total,) of the curve's end and legs times their rows over the curve."""
        return np.asarray(multipliers[self.end] @ self._end.curve + multipliers[self.legs] @ self._legs)

    def nodal_forces(self, multipliers: Array) -> Array:
        """Return (N, 3) the multipliers (total,) of tip, curve's end and clearance times their coefficients."""
        numbers, clearance = self.numbers, self.numbers.clearance
        forces = np.zeros((len(self._arm.node_names), 3))
        tip = multipliers[: self._tip] @ numbers.tip_jacobian
        np.add.at(forces, self._arm.end_effector.nodes, tip.reshape(-1, 3))
        if len(self._end.rhs):
            held = np.tensordot(multipliers[self.end], self._end.coefficients, 1)
            np.add.at(forces, self._end.nodes, held)
        active = np.flatnonzero(multipliers[self.clearance])
        pressing = multipliers[self.clearance][active, None, None] * clearance.coefficients[active]
        np.add.at(forces, clearance.nodes[active], pressing)
        return forces

    def key(self, row: int) -> Key:
        """Return a key of the row that is valid in the next QP, which may have other clearance rows."""
        near = row - self.clearance.start
        return row if near < 0 else self.numbers.clearance.nodes[near].tobytes()

    def remembered(self, keys: set[Key]) -> list[int]:
        """Return the rows with these `keys`."""
        rows = [key for key in keys if isinstance(key, int)]
        if len(rows) < len(keys):
            rows += [k for k in range(self.clearance.start, len(self.lower)) if self.key(k) in keys]
        return sorted(rows)


def _all_active(
    gram: Array, values: Array, lower: Array, upper: Array, equal: NDArray[np.bool_]
) -> Array | None:
    """Return the multipliers with all rows active at the bounds they violate; None if that may be wrong."""
    above = equal | (values > upper)
    if not np.all(above | (values < lower)):
        return None
    factor, failed = dpotrf(gram, lower=1)
    pivots = factor.diagonal()
    if failed or not pivots.min() > INDEPENDENT * pivots.max():
        return None
    found: Array = dpotrs(factor, values - np.where(above, upper, lower), lower=1)[0]
    right = np.where(above, found, -found)[~equal] >= 0.0
    return found if right.all() and np.isfinite(found).all() else None


def dual_solution(
    gram: Array,
    values: Array,
    lower: Array,
    upper: Array,
    equal: NDArray[np.bool_],
    solver: DenseSolver,
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
        raise SolverError("the QP is singular: the arm is in a singular pose, or all weights are zero")
    empty = norm < NO_ROW
    if empty.any():
        outside = np.maximum(lower - values, values - upper)[empty]
        if outside.max() > UNMOVABLE:
            raise InfeasibleStepError("a hard row cannot be moved by any actuator")
    kept = np.flatnonzero(~empty)
    if not len(kept):
        return multipliers, 0
    scale = 1.0 / norm[kept]
    scaled = gram[np.ix_(kept, kept)] * scale[:, None] * scale
    factor, pivot, rank, _ = dpstrf(scaled, tol=DEPENDENT * len(kept), lower=1)
    rows = np.zeros((len(kept), rank))
    rows[pivot - 1] = np.tril(factor)[:, :rank]
    bounds = []
    for bound in (lower, upper):
        value = bound[kept]
        free = np.abs(value) >= UNBOUNDED
        bounds.append(np.where(free, value, (value - values[kept]) * scale))
    sense = np.where(equal[kept], EQUALITY, 0).astype(np.int32)
    answer = answered(solver, DenseQP(np.eye(rank), np.zeros(rank), rows, bounds[0], bounds[1], sense))
    if not answer.is_solved:
        raise AnswerError(answer.status)
    multipliers[kept] = answer.multipliers * scale
    return multipliers, answer.iterations


class Answer(NamedTuple):
    """The dual answer of a QP, and its row values at the minimum of the Lagrangian.

    Attributes
    ----------
    values, multipliers : (total,)
        Multipliers are positive at upper and negative at lower bounds.
    rows : list of int
        Rows of the dual QP, equalities first.
    columns : (size, R)
        L^-1 times those rows transposed.
    iterations : int
        Of the dual QPs.
    """

    values: Array
    multipliers: Array
    rows: list[int]
    columns: Array
    iterations: int


def solve_rows(
    table: RowTable,
    size: int,
    find_columns: Callable[[Index], Array],
    find_values: Callable[[Array], Array],
    remembered: set[Key],
    solver: DenseSolver,
) -> Answer:
    """Return the answer of a QP with the rows of `table`; `remembered` are keys of those active before.

    Violated rows enter the dual QP, the worst first, and stay in it, so that the iteration ends.

    Parameters
    ----------
    size
        Of L, where H = L L' is the Hessian.
    find_columns
        Gives L^-1 A' (size, R) of rows A.
    find_values
        Gives the row values (total,) at the minimum of the Lagrangian, from columns times multipliers (size,).

    Raises
    ------
    InfeasibleStepError
        The rows contradict one another.
    SolverError
        A dual QP was not solved, or rounding kept a row out of its bounds.
    """
    rows: list[int] = []
    columns, gram = np.zeros((size, 0)), np.zeros((0, 0))
    multipliers = np.zeros(0)
    iterations, refined = 0, 0
    new = [*range(table.equal), *table.remembered(remembered)]
    values = find_values(np.zeros(size))
    while True:
        violation = np.maximum(table.lower - values, values - table.upper)
        violated = np.flatnonzero(violation > solver.accuracy)
        known = {*rows, *new}
        outside = np.array([k for k in violated.tolist() if k not in known], dtype=np.int64)
        room = BLOCK * max(1, len(outside) // (4 * BLOCK))
        if not rows:
            room = max(0, -len(new) % BLOCK)
        new += outside[np.argsort(-violation[outside])][:room].tolist()
        if not new:
            if not len(violated):
                break
            refined += 1
            if refined > REFINEMENTS:
                raise AnswerError(f"rounding left a row {violation.max():.1e} m or rad out of its bounds")
        else:
            added = find_columns(np.array(new, dtype=np.int64))
            columns = np.hstack([columns, added])
            grown = columns.T @ added
            gram = np.vstack([np.hstack([gram, grown[: len(rows)]]), grown.T])
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
            solver,
        )
        iterations += count
        values = find_values(columns @ multipliers)
    every = np.zeros(len(table.lower))
    every[rows] = multipliers
    return Answer(values, every, rows, columns, iterations)
