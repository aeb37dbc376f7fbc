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
from vgtm_qp.qp.long.elimination import Elimination
from vgtm_qp.qp.long.sparse_symbols import range_and_null
from vgtm_qp.qp.long.staged import RESIDUAL, SINGULAR
from vgtm_qp.qp.long.sweep import Sweep
from vgtm_qp.qp.long.working_set import Point, RowTable, solve_rows
from vgtm_qp.qp.numbers import StepNumbers, StepSolution

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def following(elimination: Elimination) -> ca.Function:
    """Return (carry, data) -> (carry, U, D, R): displacements, strokes and angles as functions of the curve.

    U (3m, 3V - 5 + 1), D (soft, ...) and R (2f, ...) are stored row by row; their last columns are constants.
    """
    inputs, chain = elimination.inputs, elimination.chain
    columns, faces = elimination.curve + 1, range(chain.faces.shape[1])
    carry = ca.SX.sym("carry", len(elimination.live), columns)
    moved, motions = carry, ca.SX(len(elimination.live), 0)
    for stage, (G, N) in zip(elimination.stages, elimination.split, strict=True):
        T = elimination.transfer(stage)
        followed = T @ moved
        followed[:, -1] += elimination.hard_rhs(stage)
        moved = ca.vertcat(moved, G @ followed)
        free = ca.SX(motions.shape[0], stage.freedom)
        motions = ca.vertcat(ca.horzcat(motions, free), ca.horzcat(G @ (T @ motions), N))
    centre = ca.vertcat(*[elimination.centre_row(k) for k in faces])
    wanted = ca.vertcat(
        *[ca.horzcat(elimination.curve_columns(inputs.weights[k, :]), -inputs.gap[k, :].T) for k in faces]
    )
    inverse, _ = range_and_null(ca.sparsify(centre @ motions))
    moved += motions @ (inverse @ (wanted - centre @ moved))
    strokes = inputs.jacobian[elimination.soft, :] @ moved
    strokes[:, -1] -= inputs.rhs[elimination.soft]
    angles = ca.vertcat(
        *[
            elimination.tangent_row(k) @ moved
            + ca.horzcat(
                inputs.tangent_curve[k] @ elimination.curve_columns(inputs.slopes[k, :]), inputs.tilt[k, :].T
            )
            for k in faces
        ]
    )
    outputs = [moved[elimination.live, :], moved[chain.before :, :].T, strokes.T, angles.T]
    return ca.Function("following", [carry, inputs.data], [ca.densify(output) for output in outputs])


class TrackedSolver:
    """Solves the QP of a step in the curve's coordinates.

    Parameters
    ----------
    chain : Chain
        With hard tracking; ``chain.is_square``.
    """

    def __init__(self, chain: Chain) -> None:
        self.layout, self.chain = chain.layout, chain
        elimination = Elimination(chain)
        self._numbers = ChainData(chain, elimination.inputs.sizes)
        self._following = Sweep(following(elimination), chain.periods)
        self._following.bind_input(1, self._numbers.data)
        self._curve = elimination.curve
        outputs = [output.reshape(-1, self._curve + 1) for output in self._following.outputs[1:]]
        self._moved, self._strokes, self._angles = outputs
        self._place = chain.node_period * chain.nodes.shape[1] + chain.node_place
        self._soft = chain.members[:, chain.soft].reshape(-1)
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
        self._eliminate(numbers)
        table = RowTable.of(self.layout, numbers, self.chain.locked)
        answer = solve_rows(self, self._curve + 1, table, self._active)
        self._check(table, answer.point, answer.multipliers)
        self._active = answer.active
        return answer.solution()

    def columns(self, table: RowTable, rows: Index) -> Array:
        """Return (size, len(rows)) L^-1 A' of the given rows A, where H = L L'."""
        nodes, coefficients, progress = table.coefficients(rows)
        coefficients[self.chain.node_period[nodes] < 0] = 0.0
        moved = self._moved.reshape(-1, 3, self._curve + 1)[self._place[nodes]]
        columns = np.empty((self._curve + 1, len(rows)))
        columns[:-1] = np.einsum("rqc,rqcn->nr", coefficients, moved[..., :-1])
        columns[-1] = progress * self._progress_scale
        columns[:-1] = dtrtrs(self._factor, columns[:-1], lower=1)[0]
        return columns

    def point(self, table: RowTable, combined: Array) -> Point:
        """Return the point that minimises the Lagrangian, given columns times multipliers (size,)."""
        truss, chain = self.layout.truss, self.chain
        free = -dtrtrs(self._factor, self._rhs + combined[:-1], lower=1, trans=1)[0]
        progress = -self._progress_scale * (self._progress_rhs + float(combined[-1]))
        unknowns = np.append(free, 1.0)
        nodes, lengths = np.zeros((truss.node_count, 3)), np.zeros(truss.member_count)
        nodes[chain.nodes] = (self._moved @ unknowns).reshape(*chain.nodes.shape, 3)
        lengths[self._soft] = self._strokes @ unknowns
        values = table.values(nodes, lengths, progress)
        return Point(nodes, lengths, self._numbers.vertices(free), progress, values)

    def _eliminate(self, numbers: StepNumbers) -> None:
        """Follow the curve from the base to the tip and factorise the Hessian in its coordinates."""
        self._numbers.fill(numbers)
        self._following()
        if not np.all(np.isfinite(self._moved[-1])) or not numbers.progress_curvature > 0.0:
            raise SolverError(SINGULAR)
        self._progress_scale = 1.0 / np.sqrt(numbers.progress_curvature)
        self._progress_rhs = self._progress_scale * numbers.progress_gradient
        weights = self.layout.weights
        hessian, gradient = self._numbers.polygon_terms()
        stiffness = weights.actuator_rate + weights.stroke_centring
        whole = weights.node_rate * (self._moved.T @ self._moved) + stiffness * (
            self._strokes.T @ self._strokes
        )
        whole += weights.tangent * (self._angles.T @ self._angles)
        try:
            self._factor = np.linalg.cholesky(hessian + whole[:-1, :-1])
        except np.linalg.LinAlgError as error:
            raise SolverError(SINGULAR) from error
        gradient += whole[:-1, -1] + self._numbers.actuator_gradient @ self._strokes[:, :-1]
        self._rhs = dtrtrs(self._factor, gradient, lower=1)[0]

    def _check(self, table: RowTable, point: Point, multipliers: Array) -> None:
        """Refuse an answer whose primal or dual residual is too large."""
        numbers, weights, layout = table.numbers, self.layout.weights, self.layout
        changed = (
            np.einsum("mqc,mqc->m", numbers.gradient, point.nodes[layout.member_nodes]) - numbers.length_rhs
        )
        gap, tilt = self._numbers.misfit(point.vertices, self._numbers.face_parts(point.nodes, numbers))
        primal = max(
            float(np.max(np.abs(changed - point.lengths))),
            float(np.max(np.abs(gap))),
            float(np.max(table.violation(point.values))),
        )
        nodal = weights.node_rate * point.nodes + table.nodal_forces(multipliers)
        actuator = (weights.actuator_rate + weights.stroke_centring) * point.lengths[layout.truss.actuators]
        actuator += numbers.actuator_gradient + multipliers[table.actuators]
        force = np.zeros(len(point.lengths))
        force[layout.truss.actuators] = actuator
        residual = nodal[self.chain.nodes].reshape(-1) @ self._moved[:, :-1]
        residual += force[self._soft] @ self._strokes[:, :-1]
        residual += weights.tangent * tilt.reshape(-1) @ self._angles[:, :-1]
        residual += self._numbers.polygon_gradient(point.vertices)
        scale = 1.0 + float(np.max(np.abs(force))) + float(np.max(np.abs(multipliers)))
        dual = float(np.max(np.abs(residual))) / scale
        if not (primal <= RESIDUAL and dual <= RESIDUAL):
            raise SolverError(
                f"the elimination left a primal residual of {primal:.1e} m and a dual residual of {dual:.1e}"
            )
