"""The step's QP of a long arm whose stations stay on the curve exactly: only the curve's coordinates are free.

If a period has as many coordinates as fixed members and station coordinates, one pass from the base to the
tip gives all nodes as a linear function of the control vertices.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from scipy.linalg.lapack import dtrtrs

from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import SolverError
from vgtm_qp.qp.daqp import DAQP
from vgtm_qp.qp.dense import DenseSolver
from vgtm_qp.qp.long.chain import Chain
from vgtm_qp.qp.long.elimination import Elimination
from vgtm_qp.qp.long.solver import SINGULAR, ChainSolver
from vgtm_qp.qp.long.sparse_symbols import dense_function, nonzeros, small_inverse, symbols_like
from vgtm_qp.qp.long.sweep import ChainClosing, Sweep
from vgtm_qp.qp.long.working_set import DisplacementsAt


class Following:
    """The graphs of a period that follows the curve.

    With given positions of its stations, the displacements of a period are u = placed + B (gap - C placed): `placed` by
    its fixed members alone, C the Jacobian of the stations' centres, B the free motions that shift them by one unit.
    """

    def __init__(self, elimination: Elimination) -> None:
        self._elimination, chain = elimination, elimination.chain
        motions = ca.SX(len(elimination.live), 0)
        for stage in elimination.stages:
            free = ca.SX(motions.shape[0], stage.freedom)
            followed = stage.G @ (stage.T @ motions)
            motions = ca.vertcat(ca.horzcat(motions, free), ca.horzcat(followed, stage.N))
        self._stations = range(chain.stations.shape[1])
        self._centre = ca.vertcat(*[elimination.centre_row(k) for k in self._stations])
        inverse = small_inverse(self._centre @ motions)
        self.gains = [*(stage.G for stage in elimination.stages), ca.sparsify(motions @ inverse)]

    def _placed(self, before: ca.SX, rhs: list[ca.SX], gains: list[ca.SX], gap: ca.SX) -> ca.SX:
        """Return (3w + 3m, c) displacements after those `before` (3w, c), for each stage's `rhs` and for `gap`."""
        moved = before
        for stage, G, wanted in zip(self._elimination.stages, gains[:-1], rhs, strict=True):
            moved = ca.vertcat(moved, G @ (stage.T @ moved + wanted))
        return moved + gains[-1] @ (gap - self._centre @ moved)

    def factor(self) -> ca.Function:
        """Return (head) -> (gains): G of each stage and B, with which C responds to the curve."""
        gains = ca.vertcat(*[nonzeros(part) for part in self.gains])
        return dense_function("follow", [self._elimination.inputs.head], [gains])

    def response(self) -> ca.Function:
        """Return (carry, head, tail, table) -> (carry, gains, D, R, U): the responses to the curve.

        Stored by rows are the strokes D (actuated, 3V - 5 + 1), the angles R (2f, ...), the displacements U
        (3m, ...), and the carry, the displacements of the live nodes; their last columns are constants. U is
        left out if the next period uses all nodes of this one in order. The gains are those of :meth:`hold`.
        """
        elimination, inputs = self._elimination, self._elimination.inputs
        columns = elimination.curve + 1
        before = ca.SX.sym("carry", columns, len(elimination.live))
        rhs = [ca.horzcat(ca.SX(len(stage.hard), columns - 1), stage.rhs) for stage in elimination.stages]
        on_curve = [elimination.curve_columns(k) for k in self._stations]
        gap = ca.vertcat(*[ca.horzcat(on_curve[k][0], -inputs.gap[k]) for k in self._stations])
        moved = self._placed(before.T, rhs, self.gains, gap)
        strokes = inputs.jacobian[elimination.actuated, :] @ moved
        strokes[:, -1] -= inputs.rhs[elimination.actuated]
        angles = [
            elimination.tangent_row(k) @ moved + ca.horzcat(on_curve[k][1], inputs.tilt[k])
            for k in self._stations
        ]
        own = list(range(elimination.chain.before, elimination.size))
        gains = ca.vertcat(*[nonzeros(part) for part in self.gains])
        outputs = [moved[elimination.live, :].T, gains, strokes.T, ca.vertcat(*angles).T]
        if elimination.live != own:
            outputs.append(moved[own, :].T)
        return dense_function("following", [before, inputs.head, inputs.tail, inputs.table], outputs)

    def hold(self) -> ca.Function:
        """Return ``Elimination.newton`` towards lengths `aim` (3m,) and points `curve` (3f,) of the stations' centres.

        Only fixed members have target lengths; the lengths of actuated members follow.
        """
        elimination = self._elimination
        vector, gains = symbols_like([part.sparsity() for part in self.gains], "gains")
        aim, curve = ca.SX.sym("aim", elimination.chain.own), ca.SX.sym("curve", 3 * len(self._stations))

        def step(moved: ca.SX, X: ca.SX, lengths: ca.SX) -> tuple[ca.SX, ca.SX]:
            rhs = [aim[stage.hard] - lengths[stage.hard] for stage in elimination.stages]
            gap = curve - self._centre @ X
            return self._placed(moved, rhs, gains, gap), ca.vertcat(*rhs, gap)

        return elimination.newton("hold", vector, [aim, curve], step)


class TrackedSolver(ChainSolver):
    """Follows the curve, with hard tracking; for chains with `is_square`."""

    def __init__(self, chain: Chain, solver: DenseSolver = DAQP) -> None:
        elimination = Elimination(chain)
        super().__init__(elimination, elimination.curve, solver, is_reversed=False)
        graphs, data = Following(elimination), self.data
        self._graphs, self.gains = graphs, graphs.gains
        self._following = Sweep(graphs.response(), chain.periods, data.head, data.tail, data.table)
        self._changes = Sweep(elimination.changes(), chain.periods, data.head)
        columns, own = self._curve + 1, chain.nodes.shape[1]
        self._strokes, self._angles = (output.reshape(-1, columns) for output in self._following.outputs[2:4])
        # First the rows of base nodes, which do not move; then those of the nodes in order.
        self._moving = np.zeros(((chain.periods + 1) * own, 3, columns))
        if len(self._following.outputs) > 4:
            self._following.bind_output(4, self._moving[own:])
        else:
            self._moving = self._following.carry.reshape(self._moving.shape)
        self._moved = self._moving[own:].reshape(-1, columns)
        self._one = np.ones(columns)

    def functions(self) -> dict[str, ca.Function]:
        """See :class:`ChainSolver`."""
        graphs = self._graphs
        return {
            "eliminate": graphs.factor(),
            "changes": self.elimination.changes(),
            "close": graphs.hold(),
        }

    def closing(self) -> ChainClosing:
        """See :class:`ChainSolver`: keeps the stations on the curve, too."""
        return ChainClosing(self.chain, self._graphs.hold(), self.data.head, self._following.outputs[1])

    def _columns(self, nodes: Index, coefficients: Array, curve: Array) -> Array:
        moved = self._moving.take(self.node_at[nodes], axis=0)
        rows = np.einsum("rqc,rqcn->nr", coefficients, moved[..., :-1]) + curve.T
        return np.asarray(dtrtrs(self._factor, rows, lower=1)[0])

    def _least(self, combined: Array) -> tuple[DisplacementsAt, Array, Array]:
        self._free = -dtrtrs(self._factor, self._rhs + combined, lower=1, trans=1)[0]
        self._one[:-1] = self._free
        return self._moved_by, (self._strokes @ self._one).take(self._among_actuated), np.zeros(0)

    def _moved_by(self, nodes: Index) -> Array:
        return self._moving.take(self.node_at[nodes], axis=0) @ self._one

    def displacements(self) -> Array:
        """See ``ChainSolver``."""
        moved = self._moving.reshape(-1, len(self._one)) @ self._one
        return moved.reshape(-1, 3).take(self.node_at, axis=0)

    def _eliminate(self) -> None:
        """Follow the curve from the base to the tip and factorise the Hessian in its coordinates."""
        self._following()
        if not np.all(np.isfinite(self._moved[-1])):
            raise SolverError(SINGULAR)
        weights, moved, strokes, angles = self.layout.weights, self._moved, self._strokes, self._angles
        hessian, gradient = self.data.polygon_terms()
        whole = weights.node_rate * (moved.T @ moved) + weights.tangent * (angles.T @ angles)
        whole += weights.actuators * (strokes.T @ strokes)
        try:
            self._factor = np.linalg.cholesky(hessian + whole[:-1, :-1])
        except np.linalg.LinAlgError as error:
            raise SolverError(SINGULAR) from error
        gradient += whole[:-1, -1] + self.data.part["actuator_gradient"].reshape(-1) @ strokes[:, :-1]
        self._rhs = dtrtrs(self._factor, gradient, lower=1)[0]

    def _residuals(
        self, nodes: Array, vertices: Array, strokes: Array, nodal: Array, forces: Array
    ) -> tuple[Array, Array]:
        chain, sweep = self.chain, self._changes
        order = chain.nodes.reshape(-1)
        nodes.take(order, axis=0, out=sweep.inputs[2].reshape(-1, 3), mode="clip")
        sweep()
        changed = sweep.outputs[1]
        changed[self.strokes_at] -= strokes
        gap, tilt = self.data.misfit(vertices, sweep.outputs[2].reshape(-1, 5))
        dual = nodal.take(order, axis=0).reshape(-1) @ self._moved[:, :-1]
        dual += forces[:, chain.actuated].reshape(-1) @ self._strokes[:, :-1]
        dual += self.layout.weights.tangent * tilt.reshape(-1) @ self._angles[:, :-1]
        dual += self.data.polygon_gradient(vertices)
        return np.concatenate([changed, gap.reshape(-1)]), dual
