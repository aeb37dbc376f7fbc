"""The step's QP of a long arm, solved exactly at a cost linear in its bays by one of two eliminations."""

from __future__ import annotations

from abc import ABC, abstractmethod

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import SolverError
from vgtm_qp.qp.answer import StepSolution
from vgtm_qp.qp.daqp import fitted
from vgtm_qp.qp.dense import DenseSolver
from vgtm_qp.qp.long.chain_data import ChainData
from vgtm_qp.qp.long.elimination import Elimination
from vgtm_qp.qp.long.sweep import ChainClosing
from vgtm_qp.qp.long.working_set import Answer, DisplacementsAt, Key, RowTable, solve_rows
from vgtm_qp.qp.numbers import RowNumbers, StepNumbers, beyond, norm
from vgtm_qp.qp.residual import loose, refuse_large, relative

SINGULAR = "the QP is singular: the arm is in a singular pose, or a term that it needs has weight zero"

PRESSES = 1e-9
"""Least multiplier of a row that the next QP starts with: interior-point solvers give each row some."""


class ChainSolver(ABC):
    """Solves the QP of a step with its unknowns eliminated: its Hessian is L L' for an L that a subclass computes.

    Rows with bounds form a small dense QP. The progress is the last of the unknowns, and is not coupled to others by
    the objective.

    Attributes
    ----------
    layout : Layout
    chain : Chain
    data : ChainData
        The numbers of the QP except those of ``RowNumbers``.
    elimination : Elimination
    gains : list
        Matrices of the period's gains, the second result of the elimination: for their sparsity.
    dense : DenseSolver
    strokes_at, held_at, node_at : (n_a,), (l,), (N,) int
        Places of actuators and locked members in ``chain.members``, and of nodes after those of the base, there at 0.
    moving_at : (n, 3m) int
        Numbers of a period's actuated places among all of them; -1 at other places.
    """

    settles = "curve"
    gain_moved: Array
    """Displacements (n m, 3, n_e) by the motions of the last gain, nodes in the chain's order."""
    gains: list[ca.SX]

    def __init__(
        self, elimination: Elimination, size: int, solver: DenseSolver, *, is_reversed: bool
    ) -> None:
        self.elimination = elimination
        chain = self.chain = elimination.chain
        self.layout = chain.layout
        self.dense = fitted(solver, self.layout.arm.fineness)
        self.data = ChainData(chain, elimination.inputs.sizes, is_reversed=is_reversed)
        self._size, self._curve = size, elimination.curve
        self._free = np.zeros(self._curve)
        at, own = np.argsort(chain.members.reshape(-1)), chain.nodes.shape[1]
        self.strokes_at, self.held_at = at[chain.bays.actuators], at[chain.locked]
        numbers = np.cumsum(np.tile(chain.actuated, chain.periods)).reshape(chain.members.shape) - 1
        self.moving_at = np.where(chain.actuated, numbers, -1)
        self._among_actuated = self.moving_at.reshape(-1)[self.strokes_at]
        self.node_at = np.where(chain.node_period >= 0, (chain.node_period + 1) * own + chain.node_place, 0)
        self._active: set[Key] = set()
        self._last: tuple[RowTable, Answer] | None = None

    def solve(self, numbers: StepNumbers) -> StepSolution:
        """Solve one QP.

        Raises
        ------
        InfeasibleStepError
            The hard rows contradict one another.
        SolverError
            The QP is singular, or the answer failed the residual check.
        """
        self.data.fill(numbers)
        return self.solve_filled(numbers)

    def solve_filled(self, numbers: RowNumbers) -> StepSolution:
        """Solve the QP whose other numbers were written to `data`; see :meth:`solve`."""
        self._last = None
        self._eliminate()
        if not numbers.progress_curvature > 0.0:
            raise SolverError(SINGULAR)
        data = self.data
        of_curve = data.end_rows(), data.leg_rows(numbers.legs)
        table = RowTable(self.layout, numbers, self.chain.locked, data.member_rows, *of_curve)
        scale = 1.0 / np.sqrt(numbers.progress_curvature)
        progress = 0.0

        def columns(rows: Index) -> Array:
            nodes, coefficients, curve, along = table.coefficients(rows)
            return np.vstack([self._columns(nodes, coefficients, curve), scale * along])

        def values(combined: Array) -> Array:
            nonlocal progress
            progress = -scale * (scale * numbers.progress_gradient + float(combined[-1]))
            # The minimiser must be computed before its curve coordinates are read.
            least = self._least(combined[:-1])
            return table.values(*least, self._free, progress)

        answer = solve_rows(table, self._size + 1, columns, values, self._active, self.dense)
        nodes, vertices = self.displacements(), self.data.vertices(self._free)
        self._check(table, answer, nodes, vertices)
        self._last, (found, multipliers) = (table, answer), answer[:2]
        active = np.flatnonzero(np.abs(multipliers) > PRESSES)
        self._active = {table.key(k) for k in active.tolist() if k >= table.equal}
        return StepSolution(
            nodes=nodes,
            actuators=found[table.actuators].copy(),
            vertices=vertices,
            progress=progress,
            actuator_multipliers=multipliers[table.actuators].copy(),
            clearance_multipliers=-multipliers[table.clearance],
            iterations=answer.iterations,
        )

    def gain(self, held: NDArray[np.bool_]) -> Array | None:  # noqa: ARG002
        """See ``solvers.StepSolver``."""
        return None

    def _check(self, table: RowTable, answer: Answer, nodes: Array, vertices: Array) -> None:
        """Refuse an answer whose primal or dual residual is too large."""
        weights, values, multipliers = self.layout.weights, answer.values, answer.multipliers
        nodal = weights.node_rate * nodes + table.nodal_forces(multipliers)
        strokes = values[table.actuators]
        forces = np.zeros(self.chain.bays.member_count)
        forces[self.strokes_at] = (
            weights.actuators * strokes + table.numbers.actuator_gradient + multipliers[table.actuators]
        )
        forces[self.held_at] = multipliers[table.locked]
        left, dual = self._residuals(nodes, vertices, strokes, nodal, forces.reshape(self.chain.periods, -1))
        if self._curve:
            dual[-self._curve :] += table.curve_forces(multipliers)
        primal = norm(np.concatenate([left, beyond(values, table.lower, table.upper)]))
        off = max(norm(dual), loose(multipliers, values, table.lower, table.upper))
        refuse_large(primal, relative(off, forces, multipliers), "the elimination")

    @abstractmethod
    def functions(self) -> dict[str, ca.Function]:
        """Return a period's functions by the names that ``native/chain.c`` gives them; its periods are alike."""

    @abstractmethod
    def closing(self) -> ChainClosing:
        """Return the iteration that closes member lengths with the factors of the QP solved last."""

    @abstractmethod
    def _eliminate(self) -> None:
        """Factorise the Hessian of `data`; raise SolverError if it is singular."""

    @abstractmethod
    def _columns(self, nodes: Index, coefficients: Array, curve: Array) -> Array:
        """Return (size, R) L^-1 A' of rows A: nodes (R, Q), coefficients (R, Q, 3), and over the curve (R, 3V - 5)."""

    @abstractmethod
    def _least(self, combined: Array) -> tuple[DisplacementsAt, Array, Array]:
        """Minimise the Lagrangian, given columns times multipliers (size,).

        Return the nodes' displacements and the changes of actuated (n_a,) and locked (l,) members at the minimum.
        """

    @abstractmethod
    def displacements(self) -> Array:
        """Return (N, 3) the nodes' displacements at the minimum of the Lagrangian, m."""

    @abstractmethod
    def _residuals(
        self, nodes: Array, vertices: Array, strokes: Array, nodal: Array, forces: Array
    ) -> tuple[Array, Array]:
        """Return the residuals of the equalities, m, and of stationarity, the curve's free coordinates last.

        Given are displacements (N, 3), (V, 3), (n_a,), and gradients by nodes (N, 3) and members (n, 3m).
        """
