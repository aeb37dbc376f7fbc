"""The step's QP of a long arm, exactly and at a cost linear in its bays (elastic tracking or none).

A Riccati recursion from the tip to the base eliminates the free motions of every bay; the curve's coordinates
are global unknowns beside them; rows with bounds meet in a small dense QP of their own.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtrs

from vgtm_qp.errors import SolverError
from vgtm_qp.qp.long.chain import Chain
from vgtm_qp.qp.long.chain_data import ChainData
from vgtm_qp.qp.long.elimination import Elimination
from vgtm_qp.qp.long.sweep import Sweep
from vgtm_qp.qp.long.working_set import Point, RowTable, solve_rows
from vgtm_qp.qp.numbers import StepNumbers, StepSolution

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_BLOCK = 8
_WORST_CONDITION = 1e8
RESIDUAL = 1e-8
SINGULAR = "the QP is singular: the truss is in a singular pose, or a term that it needs has weight zero"


class StagedSolver:
    """Solves the QP of a step by elimination along a chain.

    Parameters
    ----------
    chain : Chain
        Of a layout without hard tracking.
    """

    def __init__(self, chain: Chain) -> None:
        self.layout, self.chain = chain.layout, chain
        elimination = Elimination(chain)
        periods = chain.periods
        self._freedom, self._curve = periods * elimination.freedom, elimination.curve
        self._numbers = ChainData(chain, elimination.inputs.sizes)
        self._reversed = np.zeros_like(self._numbers.data)
        self._factor = Sweep(elimination.factor(), periods)
        self._columns = Sweep(elimination.columns(_BLOCK), periods)
        self._forward = Sweep(elimination.forward(), periods)
        self._balance = Sweep(elimination.balance(), periods)
        gains = self._factor.outputs[1]
        for sweep in (self._factor, self._columns, self._balance):
            sweep.bind_input(1, self._reversed)
        for sweep in (self._columns, self._balance):
            sweep.bind_input(2, gains)
        self._forward.bind_input(1, self._numbers.data)
        self._gains = gains.reshape(periods, -1)
        self._forward_gains = self._forward.inputs[2].reshape(periods, -1)
        self._motions = self._forward.inputs[3].reshape(periods, -1)
        own = chain.nodes.shape[1]
        # Rows of base nodes, which answer to no displacement, go to places behind the last one that is read.
        self._rows = np.zeros(((periods + 1) * _BLOCK * own, 3))
        self._columns.bind_input(3, self._rows.reshape(-1)[: self._columns.inputs[3].size])
        self._place = np.where(
            chain.node_period >= 0,
            (periods - 1 - chain.node_period) * _BLOCK * own + chain.node_place,
            periods * _BLOCK * own,
        )
        self._outer = self._factor.outputs[2].reshape(self._freedom, -1)
        self._active: set[tuple[object, ...]] = set()
        self._table: RowTable | None = None

    def solve(self, numbers: StepNumbers) -> StepSolution:
        """Solve one QP.

        Raises
        ------
        InfeasibleStepError
            The hard rows contradict one another.
        SolverError
            The QP is singular, or the answer failed the residual check.
        """
        self._eliminate(numbers)
        table = RowTable.of(self.layout, numbers, self.chain.locked)
        size = self._freedom + self._curve + 1
        self._table = table
        answer = solve_rows(self, size, table, self._active, _BLOCK)
        self._check(table, answer.point, answer.multipliers)
        self._active = answer.active
        return answer.solution()

    def gain(self, held: NDArray[np.bool_]) -> Array | None:
        """Return the least motions (N, 3, n_e) of the nodes that move the tip by one unit of each row.

        In the metric of the QP solved last; its progress and the `held` actuators (n_a,) stay as they are.
        None where they leave no such motion.
        """
        table = self._table
        if table is None:
            return None
        tip = len(table.numbers.tip_rhs)
        rows = np.concatenate([np.arange(table.equal), table.actuators.start + np.flatnonzero(held)])
        columns = self.columns(table, rows)
        columns[-1] = 0.0
        gram = columns.T @ columns
        try:
            shares = np.linalg.solve(gram, np.eye(len(rows))[:, :tip])
        except np.linalg.LinAlgError:
            return None
        if not np.abs(shares).max(initial=0.0) * np.abs(gram).max(initial=0.0) < _WORST_CONDITION:
            return None
        rest = self.point(table, np.zeros(len(columns))).nodes
        return np.stack([self.point(table, -columns @ share).nodes - rest for share in shares.T], axis=-1)

    def columns(self, table: RowTable, rows: Index) -> Array:
        """Return (size, len(rows)) L^-1 A' of the given rows A, where H = L L'."""
        rest = slice(self._freedom, self._freedom + self._curve)
        columns = np.zeros((self._freedom + self._curve + 1, len(rows)))
        nodes, coefficients, progress = table.coefficients(rows)
        columns[-1] = progress * self._progress_scale
        passed = self._columns.outputs[1].reshape(self._freedom, _BLOCK)
        for start in range(0, len(rows), _BLOCK):
            block = slice(start, start + _BLOCK)
            count = len(progress[block])
            place = self._place[nodes[block]] + (np.arange(count) * self.chain.nodes.shape[1])[:, None]
            np.add.at(self._rows, place, coefficients[block])
            self._columns()
            columns[: self._freedom, block] = passed[:, :count]
            self._rows[place] = 0.0
        if self._curve:
            through = self._outer[:, :-1].T @ columns[: self._freedom]
            columns[rest] = -dtrtrs(self._curve_factor, through, lower=1)[0]
        return columns

    def point(self, table: RowTable, combined: Array) -> Point:
        """Return the point that minimises the Lagrangian, given columns times multipliers (size,)."""
        chain, truss = self.chain, self.layout.truss
        freedom, curve = self._freedom, self._curve
        free = np.zeros(0)
        if curve:
            known = self._curve_rhs + combined[freedom : freedom + curve]
            free = -dtrtrs(self._curve_factor, known, lower=1, trans=1)[0]
        progress = -self._progress_scale * (self._progress_rhs + float(combined[-1]))
        motions = self._outer[:, -1] + self._outer[:, :-1] @ free + combined[:freedom]
        self._motions[:] = motions.reshape(chain.periods, -1)[::-1]
        self._forward()
        _, moved, changed, _ = self._forward.outputs
        nodes, lengths = np.zeros((truss.node_count, 3)), np.empty(truss.member_count)
        nodes[chain.nodes] = moved.reshape(*chain.nodes.shape, 3)
        lengths[chain.members] = changed.reshape(chain.members.shape)
        values = table.values(nodes, lengths, progress)
        return Point(nodes, lengths, self._numbers.vertices(free), progress, values)

    def _eliminate(self, numbers: StepNumbers) -> None:
        """Run the recursion and factorise what is left, in the curve's coordinates."""
        data = self._numbers
        data.fill(numbers)
        self._reversed[:] = data.data[::-1]
        self._factor()
        if not np.all(np.isfinite(self._outer[-1])) or not numbers.progress_curvature > 0.0:
            raise SolverError(SINGULAR)
        self._forward_gains[:] = self._gains[::-1]
        self._progress_scale = 1.0 / np.sqrt(numbers.progress_curvature)
        self._progress_rhs = self._progress_scale * numbers.progress_gradient
        if self._curve:
            hessian, gradient = data.curve_terms()
            outer = self._outer[:, :-1]
            try:
                self._curve_factor = np.linalg.cholesky(hessian - outer.T @ outer)
            except np.linalg.LinAlgError as error:
                raise SolverError(SINGULAR) from error
            gradient += self._factor.carry[-1, -self._curve :]
            self._curve_rhs = dtrtrs(self._curve_factor, gradient, lower=1)[0]

    def _check(self, table: RowTable, point: Point, multipliers: Array) -> None:
        """Refuse an answer whose primal or dual residual is too large."""
        chain, numbers, weights = self.chain, table.numbers, self.layout.weights
        truss = self.layout.truss
        nodal, force, face = self._balance.inputs[3:]
        gradient = weights.node_rate * point.nodes + table.nodal_forces(multipliers)
        actuator = np.zeros(truss.member_count)
        actuator[truss.actuators] = (
            (weights.actuator_rate + weights.stroke_centring) * point.values[table.actuators]
            + numbers.actuator_gradient
            + multipliers[table.actuators]
        )
        actuator[chain.locked] = multipliers[len(numbers.tip_rhs) : table.equal]
        nodal[:] = gradient[chain.nodes[::-1]].reshape(-1)
        force[:] = actuator[chain.members[::-1][:, chain.soft]].reshape(-1)
        residual = 0.0
        if self._curve:
            gap, tilt = self._numbers.misfit(point.vertices, self._forward.outputs[3].reshape(-1, 5))
            pulled = np.hstack([weights.tracking * gap, weights.tangent * tilt])
            face[:] = pulled.reshape(chain.periods, -1)[::-1].reshape(-1)
            residual = float(np.max(np.abs(self._numbers.curve_gradient(point.vertices, gap, tilt))))
        self._balance()
        residual = max(residual, float(np.max(np.abs(self._balance.outputs[1]), initial=0.0)))
        scale = 1.0 + float(np.max(np.abs(force), initial=0.0)) + float(np.max(np.abs(multipliers)))
        fixed = point.lengths[self.layout.fixed]
        primal = max(float(np.max(table.violation(point.values))), float(np.max(np.abs(fixed), initial=0.0)))
        dual = residual / scale
        if not (primal <= RESIDUAL and dual <= RESIDUAL):
            raise SolverError(
                f"the elimination left a primal residual of {primal:.1e} m and a dual residual of {dual:.1e}"
            )
