"""The step's QP of a long arm whose faces stay on the curve exactly: only the curve's coordinates are free.

Where a period's fixed members and its faces' positions are as many as its coordinates, one pass from the base
to the tip gives all nodes as a linear function of the control vertices.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtrtrs

from vgtm_qp.errors import SolverError
from vgtm_qp.qp.long.chain import Chain
from vgtm_qp.qp.long.chain_data import ChainData
from vgtm_qp.qp.long.closing import ChainClosing
from vgtm_qp.qp.long.elimination import Elimination, Positions
from vgtm_qp.qp.long.sparse_symbols import nonzeros, offsets, small_inverse
from vgtm_qp.qp.long.staged import SINGULAR
from vgtm_qp.qp.long.sweep import Sweep
from vgtm_qp.qp.long.working_set import Point, RowNumbers, RowTable, solve_rows
from vgtm_qp.qp.numbers import StepNumbers, StepSolution, beyond, norm
from vgtm_qp.qp.residual import refuse_large, relative

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Following:
    """The graphs of a period that follows the curve.

    Where its faces are to be somewhere, a period's displacements are u = placed + B (gap - C placed): `placed` by its
    fixed members alone, C the Jacobian of the faces' centres, B of the free motions that shift them.
    """

    def __init__(self, elimination: Elimination) -> None:
        self._elimination, chain = elimination, elimination.chain
        motions = ca.SX(len(elimination.live), 0)
        for stage, (G, N) in zip(elimination.stages, elimination.split, strict=True):
            free = ca.SX(motions.shape[0], stage.freedom)
            followed = G @ (elimination.transfer(stage) @ motions)
            motions = ca.vertcat(ca.horzcat(motions, free), ca.horzcat(followed, N))
        self._faces = range(chain.faces.shape[1])
        self._centre = ca.vertcat(*[elimination.centre_row(k) for k in self._faces])
        inverse = small_inverse(self._centre @ motions)
        self._gains = [*(G for G, _ in elimination.split), ca.sparsify(motions @ inverse)]

    def _placed(self, before: ca.SX, rhs: list[ca.SX], gains: list[ca.SX], gap: ca.SX) -> ca.SX:
        """Return (3w + 3m, c) displacements behind those `before` (3w, c), for each stage's `rhs` and for `gap`."""
        moved = before
        for stage, G, wanted in zip(self._elimination.stages, gains[:-1], rhs, strict=True):
            moved = ca.vertcat(moved, G @ (self._elimination.transfer(stage) @ moved + wanted))
        return moved + gains[-1] @ (gap - self._centre @ moved)

    def response(self) -> ca.Function:
        """Return (carry, head, tail, table) -> (carry, gains, D, R, U): what follows from the curve.

        D (soft, 3V - 5 + 1), strokes, R (2f, ...), angles, and U (3m, ...), displacements, are stored row by row, as
        is the carry, the displacements of the live nodes; their last columns are constants. U is left out where the
        next period uses all nodes of this one in order. The gains are those of :meth:`hold`.
        """
        elimination, inputs = self._elimination, self._elimination.inputs
        columns = elimination.curve + 1
        before = ca.SX.sym("carry", columns, len(elimination.live))
        rhs = []
        for stage in elimination.stages:
            wanted = ca.SX(len(stage.hard), columns)
            wanted[:, -1] = elimination.hard_rhs(stage)
            rhs.append(wanted)
        gap = ca.vertcat(
            *[
                ca.horzcat(elimination.curve_columns(inputs.weights[k, :]), -inputs.gap[k, :].T)
                for k in self._faces
            ]
        )
        moved = self._placed(before.T, rhs, self._gains, gap)
        strokes = inputs.jacobian[elimination.soft, :] @ moved
        strokes[:, -1] -= inputs.rhs[elimination.soft]
        angles = ca.vertcat(
            *[
                elimination.tangent_row(k) @ moved
                + ca.horzcat(
                    inputs.tangent_curve[k] @ elimination.curve_columns(inputs.slopes[k, :]),
                    inputs.tilt[k, :].T,
                )
                for k in self._faces
            ]
        )
        own = list(range(elimination.chain.before, elimination.size))
        outputs = [moved[elimination.live, :].T, strokes.T, angles.T]
        if elimination.live != own:
            outputs.append(moved[own, :].T)
        gains = ca.vertcat(*[nonzeros(part) for part in self._gains])
        return ca.Function(
            "following",
            [before, inputs.head, inputs.tail, inputs.table],
            [ca.densify(outputs[0]), gains, *(ca.densify(output) for output in outputs[1:])],
        )

    def hold(self) -> ca.Function:
        """Return (carry, head, gains, X, aim, curve) -> (carry, X, lengths): one step towards right lengths and faces.

        As ``Elimination.close``, but that fixed members are aimed at their lengths `aim` (3m,) and the faces' centres
        at their points (3f,) of the curve; actuated members take the lengths that follow.
        """
        elimination = self._elimination
        ends = offsets(part.nnz() for part in self._gains)
        vector, at = ca.SX.sym("gains", ends[-1]), Positions(elimination)
        pieces = ca.vertsplit(vector, ends)
        gains = [ca.SX(part.sparsity(), v) for part, v in zip(self._gains, pieces, strict=True)]
        aim = ca.SX.sym("aim", elimination.chain.own)
        curve = ca.SX.sym("curve", 3 * len(self._faces))
        rhs = [aim[stage.hard] - at.lengths[stage.hard] for stage in elimination.stages]
        gap = curve - ca.vertcat(*[at.centre(k) for k in self._faces])
        u = self._placed(at.moved, rhs, gains, gap)
        return at.function("hold", [elimination.inputs.head, vector], [aim, curve], u, ca.vertcat(*rhs, gap))


class TrackedSolver:
    """Solves the QP of a step in the curve's coordinates.

    Parameters
    ----------
    chain : Chain
        With hard tracking; ``chain.is_square``.
    """

    knows_gain = False

    def __init__(self, chain: Chain) -> None:
        self.layout, self.chain = chain.layout, chain
        elimination = Elimination(chain)
        self.data = ChainData(chain, elimination.inputs.sizes)
        self._graphs = Following(elimination)
        self._following = Sweep(self._graphs.response(), chain.periods)
        for k, array in enumerate((self.data.head, self.data.tail, self.data.table)):
            self._following.bind_input(1 + k, array)
        self._changes = Sweep(elimination.changes(), chain.periods)
        self._changes.bind_input(1, self.data.head)
        self._curve = elimination.curve
        columns, own = self._curve + 1, chain.nodes.shape[1]
        self._strokes, self._angles = (output.reshape(-1, columns) for output in self._following.outputs[2:4])
        # The first rows are those of the base, whose nodes do not move; then come the nodes in order.
        self._moving = np.zeros(((chain.periods + 1) * own, 3, columns))
        if len(self._following.outputs) > 4:
            self._following.bind_output(4, self._moving[own:])
        else:
            self._moving = self._following.carry.reshape(self._moving.shape)
        self._moved = self._moving[own:].reshape(-1, columns)
        self._place = np.where(chain.node_period >= 0, (chain.node_period + 1) * own + chain.node_place, 0)
        self._nodes = chain.nodes.reshape(-1)
        soft = chain.members[:, chain.soft].reshape(-1)
        self._soft = np.argsort(soft)
        self._free, self._progress = np.ones(self._curve + 1), 0.0
        self._active: set[tuple[object, ...]] = set()

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
        return self.solve_filled(RowNumbers.of(self.chain.bays, numbers))

    def solve_filled(self, numbers: RowNumbers) -> StepSolution:
        """Solve the QP whose other numbers were written to `data`; see :meth:`solve`."""
        self._eliminate(numbers)
        table = RowTable.of(self.layout, numbers, self.chain.locked)
        answer = solve_rows(self, self._curve + 1, table, self._active)
        self._check(table, answer.point, answer.multipliers)
        self._active = answer.active
        return answer.solution()

    def gain(self, held: NDArray[np.bool_]) -> Array | None:  # noqa: ARG002
        """See ``solvers.StepSolver``."""
        return None

    def closing(self) -> ChainClosing:
        """Return what brings fixed members to their lengths and keeps the faces on the curve, as the QP solved last."""
        return ChainClosing(self.chain, self._graphs.hold(), [self.data.head, self._following.outputs[1]])

    def columns(self, table: RowTable, rows: Index) -> Array:
        """Return (size, len(rows)) L^-1 A' of the given rows A, where H = L L'."""
        nodes, coefficients, progress = table.coefficients(rows)
        moved = self._moving.take(self._place[nodes], axis=0)
        columns = np.empty((self._curve + 1, len(rows)))
        columns[:-1] = np.einsum("rqc,rqcn->nr", coefficients, moved[..., :-1])
        columns[-1] = progress * self._progress_scale
        columns[:-1] = dtrtrs(self._factor, columns[:-1], lower=1)[0]
        return columns

    def values(self, table: RowTable, combined: Array) -> Array:
        """Return (total,) the row values where the Lagrangian is least, given columns times multipliers (size,)."""
        self._free[:-1] = -dtrtrs(self._factor, self._rhs + combined[:-1], lower=1, trans=1)[0]
        self._progress = -self._progress_scale * (self._progress_rhs + float(combined[-1]))
        strokes = (self._strokes @ self._free).take(self._soft)
        return table.values(
            lambda nodes: self._moving.take(self._place[nodes], axis=0) @ self._free,
            strokes,
            np.zeros(0),
            self._progress,
        )

    def point(self, values: Array) -> Point:
        """Return the point whose `values` were asked for last."""
        nodes = (
            (self._moving.reshape(-1, self._curve + 1) @ self._free).reshape(-1, 3).take(self._place, axis=0)
        )
        return Point(nodes, self.data.vertices(self._free[:-1]), self._progress, values)

    def _eliminate(self, numbers: RowNumbers) -> None:
        """Follow the curve from the base to the tip and factorise the Hessian in its coordinates."""
        self._following()
        if not np.all(np.isfinite(self._moved[-1])) or not numbers.progress_curvature > 0.0:
            raise SolverError(SINGULAR)
        self._progress_scale = 1.0 / np.sqrt(numbers.progress_curvature)
        self._progress_rhs = self._progress_scale * numbers.progress_gradient
        weights = self.layout.weights
        hessian, gradient = self.data.polygon_terms()
        stiffness = weights.actuator_rate + weights.stroke_centring
        whole = weights.node_rate * (self._moved.T @ self._moved) + stiffness * (
            self._strokes.T @ self._strokes
        )
        whole += weights.tangent * (self._angles.T @ self._angles)
        try:
            self._factor = np.linalg.cholesky(hessian + whole[:-1, :-1])
        except np.linalg.LinAlgError as error:
            raise SolverError(SINGULAR) from error
        gradient += whole[:-1, -1] + self.data.actuator_gradient.reshape(-1) @ self._strokes[:, :-1]
        self._rhs = dtrtrs(self._factor, gradient, lower=1)[0]

    def _check(self, table: RowTable, point: Point, multipliers: Array) -> None:
        """Refuse an answer whose primal or dual residual is too large."""
        weights, chain, sweep = self.layout.weights, self.chain, self._changes
        moved = sweep.inputs[2].reshape(-1, 3)
        point.nodes.take(self._nodes, axis=0, out=moved, mode="clip")
        sweep()
        changed = sweep.outputs[1].reshape(chain.periods, -1)
        strokes = changed[:, chain.soft].reshape(-1)
        gap, tilt = self.data.misfit(point.vertices, sweep.outputs[2].reshape(-1, 5))
        primal = norm(
            np.concatenate(
                [
                    changed[:, ~chain.soft].reshape(-1),
                    strokes[self._soft] - point.values[table.actuators],
                    gap.reshape(-1),
                    beyond(point.values, table.lower, table.upper),
                ]
            )
        )
        nodal = weights.node_rate * moved + table.nodal_forces(multipliers).take(self._nodes, axis=0)
        force = (weights.actuator_rate + weights.stroke_centring) * strokes
        force += self.data.actuator_gradient.reshape(-1)
        force[self._soft] += multipliers[table.actuators]
        residual = nodal.reshape(-1) @ self._moved[:, :-1]
        residual += force @ self._strokes[:, :-1]
        residual += weights.tangent * tilt.reshape(-1) @ self._angles[:, :-1]
        residual += self.data.polygon_gradient(point.vertices)
        refuse_large(primal, relative(norm(residual), force, multipliers), "the elimination")
