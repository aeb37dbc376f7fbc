"""The step's QP of a long arm with elastic tracking or without a curve.

A Riccati recursion from the tip to the base eliminates the free motions of every bay; the curve's coordinates
are global unknowns beside them.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtrs

from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import SolverError
from vgtm_qp.qp.daqp import DAQP
from vgtm_qp.qp.dense import DenseSolver
from vgtm_qp.qp.long.chain import Chain
from vgtm_qp.qp.long.elimination import Elimination
from vgtm_qp.qp.long.solver import SINGULAR, ChainSolver
from vgtm_qp.qp.long.sweep import ChainClosing, Sweep
from vgtm_qp.qp.long.working_set import BLOCK, DisplacementsAt
from vgtm_qp.qp.settle import WORST_CONDITION


class StagedSolver(ChainSolver):
    """Eliminates the free motions of the bays; for layouts without hard tracking."""

    settles = "strokes"

    def __init__(self, chain: Chain, solver: DenseSolver = DAQP) -> None:
        elimination = Elimination(chain)
        periods, own = chain.periods, chain.nodes.shape[1]
        self._freedom = periods * elimination.freedom
        # The recursion runs from the tip to the base.
        super().__init__(elimination, self._freedom + elimination.curve, solver, is_reversed=True)
        data = self.data
        factor = elimination.factor()
        self.gains = elimination.gain_parts
        self._factor = Sweep(factor, periods, data.head, data.tail, data.table)
        gains = self._factor.outputs[1]
        self._through = Sweep(elimination.columns(BLOCK), periods, data.head, gains)
        self._balance = Sweep(elimination.balance(), periods, data.head, gains)
        self._gains = gains.reshape(periods, -1)
        self._forward_head, self._forward_gains = np.zeros_like(data.head), np.zeros_like(self._gains)
        ahead = self._forward_head, self._forward_gains
        self._forward = Sweep(elimination.forward(), periods, *ahead)
        self._strokes = Sweep(elimination.strokes(len(self.layout.tip_rows)), periods, *ahead)
        self._motions = self._forward.inputs[3].reshape(periods, -1)
        # Rows of base nodes, which are not unknowns, go behind the last place that is read.
        self._rows = np.zeros(((periods + 1) * BLOCK * own, 3))
        self._through.bind_input(3, self._rows[: periods * BLOCK * own])
        is_free = chain.node_period >= 0
        first = np.where(is_free, periods - 1 - chain.node_period, periods) * BLOCK * own
        self._row_place = first + chain.node_place * is_free
        # First the rows of base nodes, which do not move.
        self._moved = np.zeros(((periods + 1) * own, 3))
        self._forward.bind_output(1, self._moved[own:])
        self._outer = self._factor.outputs[2].reshape(self._freedom, -1)
        self._fixed = ~chain.bays.actuated[chain.members.reshape(-1)]

    def functions(self) -> dict[str, ca.Function]:
        """See :class:`ChainSolver`."""
        graphs = self.elimination
        return {
            "eliminate": graphs.factor(curved=False),
            "balance": graphs.balance(),
            "forward": graphs.forward(),
            "close": graphs.close(),
        }

    def gain(self, held: NDArray[np.bool_]) -> Array | None:
        """Return the changes (n_a, n_e) of the actuated lengths that move the tip by one unit of each of its rows.

        The motion is the least one in the metric of the QP solved last; progress and `held` actuators (n_a,)
        do not change. None if there is no such motion.
        """
        if self._last is None:
            return None
        table, answer = self._last
        rows = [*range(table.equal), *(table.actuators.start + np.flatnonzero(held)).tolist()]
        known = dict(zip(answer.rows, answer.columns[:-1].T, strict=True))
        missing = np.array([row for row in rows if row not in known], dtype=np.int64)
        if len(missing):
            known |= zip(missing.tolist(), self._columns(*table.coefficients(missing)[:3]).T, strict=True)
        columns = np.stack([known[row] for row in rows], axis=1)
        gram = columns.T @ columns
        try:
            shares = np.linalg.solve(gram, np.eye(len(rows))[:, : table.locked.start])
        except np.linalg.LinAlgError:
            return None
        if not np.abs(shares).max(initial=0.0) * np.abs(gram).max(initial=0.0) < WORST_CONDITION:
            return None
        combined = -columns @ shares
        motions = combined[: self._freedom]
        if self._curve:
            on_curve = dtrtrs(self._curve_factor, combined[self._freedom :], lower=1, trans=1)[0]
            motions = motions - self._outer[:, :-1] @ on_curve
        sweep, periods = self._strokes, self.chain.periods
        sweep.inputs[3].reshape(periods, -1)[:] = motions.reshape(periods, -1)[::-1]
        sweep()
        self.gain_moved = sweep.outputs[2].reshape(-1, 3, motions.shape[1])
        return sweep.outputs[1].reshape(-1, motions.shape[1]).take(self._among_actuated, axis=0)

    def closing(self) -> ChainClosing:
        """See :class:`ChainSolver`."""
        return ChainClosing(self.chain, self.elimination.close(), self._forward_head, self._forward_gains)

    def _columns(self, nodes: Index, coefficients: Array, curve: Array) -> Array:
        passed = self._through.outputs[1].reshape(self._freedom, BLOCK)
        columns = np.empty((self._size, len(nodes)))
        for start in range(0, len(nodes), BLOCK):
            block = slice(start, min(start + BLOCK, len(nodes)))
            count = block.stop - start
            place = self._row_place[nodes[block]] + (np.arange(count) * self.chain.nodes.shape[1])[:, None]
            np.add.at(self._rows, place, coefficients[block])
            self._through()
            columns[: self._freedom, block] = passed[:, :count]
            self._rows[place] = 0.0
        if self._curve:
            through = self._outer[:, :-1].T @ columns[: self._freedom] - curve.T
            columns[self._freedom :] = -dtrtrs(self._curve_factor, through, lower=1)[0]
        return columns

    def _least(self, combined: Array) -> tuple[DisplacementsAt, Array, Array]:
        motions = self._outer[:, -1] + combined[: self._freedom]
        if self._curve:
            known = self._curve_rhs + combined[self._freedom :]
            self._free = -dtrtrs(self._curve_factor, known, lower=1, trans=1)[0]
            motions += self._outer[:, :-1] @ self._free
        self._motions[:] = motions.reshape(self.chain.periods, -1)[::-1]
        self._forward()
        changed = self._forward.outputs[2]
        return self._moved_by, changed.take(self.strokes_at), changed[self.held_at]

    def _moved_by(self, nodes: Index) -> Array:
        return self._moved[self.node_at[nodes]]

    def displacements(self) -> Array:
        """See ``ChainSolver``."""
        return self._moved.take(self.node_at, axis=0)

    def _eliminate(self) -> None:
        """Run the recursion and factorise the remaining Hessian, in the curve's coordinates."""
        self._factor()
        if not np.all(np.isfinite(self._outer[-1])):
            raise SolverError(SINGULAR)
        self._forward_head[:] = self.data.head[::-1]
        self._forward_gains[:] = self._gains[::-1]
        if self._curve:
            hessian, gradient = self.data.curve_terms()
            outer = self._outer[:, :-1]
            try:
                self._curve_factor = np.linalg.cholesky(hessian - outer.T @ outer)
            except np.linalg.LinAlgError as error:
                raise SolverError(SINGULAR) from error
            gradient += self._factor.carry[-1, -self._curve :]
            self._curve_rhs = dtrtrs(self._curve_factor, gradient, lower=1)[0]

    def _residuals(
        self,
        nodes: Array,  # noqa: ARG002
        vertices: Array,
        strokes: Array,  # noqa: ARG002
        nodal: Array,
        forces: Array,
    ) -> tuple[Array, Array]:
        chain = self.chain
        gradient, force, station = self._balance.inputs[3:]
        nodal.take(chain.nodes[::-1].reshape(-1), axis=0, out=gradient.reshape(-1, 3), mode="clip")
        force[:] = forces[::-1, chain.actuated].reshape(-1)
        dual = [self._balance.outputs[1]]
        if self._curve:
            weights, parts = self.layout.weights, self._forward.outputs[3].reshape(chain.periods, -1)[::-1]
            gap, tilt = self.data.misfit(vertices, parts.reshape(-1, 5))
            station[:] = np.hstack([weights.tracking * gap, weights.tangent * tilt]).reshape(-1)
            dual.append(self.data.curve_gradient(vertices, gap, tilt))
        self._balance()
        return self._forward.outputs[2][self._fixed], np.concatenate(dual)
