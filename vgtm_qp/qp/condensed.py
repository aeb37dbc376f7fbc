"""The step's QP condensed onto the actuators: the fast exact path for short arms.

The truss is statically determinate, so the node displacements are K d_a + r with the columns of J^-1 that belong to
actuated members; fixed members hold by construction and stroke and rate limits are bounds on single unknowns. The
unknowns left are the actuator displacements, the free coordinates of the curve and the progress along the path.
"""

from __future__ import annotations

import daqp
import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgetrf, dgetrs

from vgtm_qp.errors import SolverError
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import StepNumbers, StepSolution

Array = NDArray[np.float64]

UNBOUNDED = 1e30
FEASIBILITY = 1e-10


class InfeasibleStepError(SolverError):
    """No displacement satisfies every hard row of a step's QP."""


class CondensedSolver:
    """Solves the QP of a step in the unknowns (d_a, free curve coordinates, d_alpha) with DAQP.

    The curve's base conditions are eliminated: d_p[0] follows the base and d_p[1] - d_p[0] moves along the base normal.
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        truss, weights = layout.truss, layout.weights
        nodes, actuators, vertices = layout.node_columns, len(truss.actuators), layout.vertices
        curve_nodes = len(layout.tracked)
        self._free_curve = 3 * vertices - 5 if vertices else 0
        self._size = actuators + self._free_curve + 1
        self._jacobian = np.zeros((nodes, nodes))
        self._selection = np.zeros((nodes, actuators + 1))
        self._selection[truss.actuators, np.arange(actuators)] = 1.0

        self._centres = np.zeros((curve_nodes, 3, nodes))
        for k, face in enumerate(layout.tracked):
            for node, weight in zip(truss.faces[face], truss.face_weights[face], strict=True):
                column = layout.node_column[node]
                if column >= 0:
                    self._centres[k, range(3), range(column, column + 3)] = weight
        self._face_columns = layout.node_column[truss.faces[layout.tracked]] if vertices else np.zeros((0, 3), int)
        self._rows = np.zeros((nodes + 5 * curve_nodes, self._size))
        self._rhs = np.zeros(nodes + 5 * curve_nodes)
        self._row_weight = np.concatenate(
            [
                np.full(nodes, weights.node_rate),
                np.full(3 * curve_nodes, weights.tracking),
                np.full(2 * curve_nodes, weights.tangent),
            ]
        )
        if layout.hard_tracking:
            self._row_weight[nodes : nodes + 3 * curve_nodes] = 0.0
        self._constant_hessian = np.zeros((self._size, self._size))
        index = np.arange(actuators)
        self._constant_hessian[index, index] = weights.actuator_rate + weights.stroke_centring
        self._vertex_hessian = weights.curve_rate * np.eye(vertices) + weights.smoothness * layout.polygon_bending

    def solve(self, numbers: StepNumbers) -> StepSolution:
        """Solve one QP.

        Raises
        ------
        InfeasibleStepError
            The hard rows contradict one another.
        SolverError
            The length Jacobian is singular, or the answer failed the residual check.
        """
        layout, truss = self.layout, self.layout.truss
        count, size, nodes = len(truss.actuators), self._size, layout.node_columns
        layout.length_jacobian(numbers.gradient, self._jacobian)
        self._selection[:, -1] = numbers.length_rhs
        factors, pivots, info = dgetrf(self._jacobian)
        if info != 0:
            raise SolverError("the length Jacobian is singular: the truss is in a singular pose")
        inverse, _ = dgetrs(factors, pivots, self._selection)
        response, particular = inverse[:, :-1], inverse[:, -1]

        rows, rhs = self._rows, self._rhs
        rows[:nodes, :count] = response
        rhs[:nodes] = particular
        curve, curve_offset = self._curve_basis(numbers)
        self._fill_tracking(numbers, response, particular, curve, curve_offset)

        hessian = (rows.T * self._row_weight) @ rows
        hessian += self._constant_hessian
        gradient = rows.T @ (self._row_weight * rhs)
        gradient[:count] += numbers.actuator_gradient
        if self._free_curve:
            block = slice(count, count + self._free_curve)
            curve_hessian = np.einsum("ij,jcq->icq", self._vertex_hessian, curve)
            hessian[block, block] += np.einsum("icp,icq->pq", curve, curve_hessian)
            gradient[block] += np.einsum("icq,ic->q", curve_hessian, curve_offset)
            gradient[block] += np.einsum("icq,ic->q", curve, numbers.vertex_gradient)
        hessian[-1, -1] += numbers.progress_curvature
        gradient[-1] += numbers.progress_gradient

        constraint, lower, upper, sense = self._constraints(numbers, response, particular)
        x, _, flag, info = daqp.solve(
            hessian, gradient, constraint, upper, lower, sense, primal_tol=FEASIBILITY, eps_prox=0.0
        )
        if flag == -1:
            raise InfeasibleStepError("the hard rows of the step contradict one another")
        multipliers = np.asarray(info["lam"])
        check_answer(x, multipliers, flag, hessian, gradient, constraint, lower, upper)

        displacement = np.zeros((truss.node_count, 3))
        displacement[truss.free] = (response @ x[:count] + particular).reshape(-1, 3)
        vertices = np.einsum("icq,q->ic", curve, x[count:-1]) + curve_offset
        clearance = len(numbers.clearance)
        return StepSolution(
            nodes=displacement,
            actuators=x[:count].copy(),
            vertices=vertices,
            progress=float(x[-1]),
            actuator_multipliers=multipliers[:count].copy(),
            clearance_multipliers=-multipliers[len(multipliers) - clearance :],
            iterations=int(info["iterations"]),
        )

    def _curve_basis(self, numbers: StepNumbers) -> tuple[Array, Array]:
        """Return the basis (V, 3, q) of the free control vertex displacements and the offset (V, 3)."""
        vertices, free = self.layout.vertices, self._free_curve
        basis, offset = np.zeros((vertices, 3, free)), np.zeros((vertices, 3))
        if vertices:
            normal = np.cross(numbers.base_axes[0], numbers.base_axes[1])
            basis[1, :, 0] = normal
            axes = np.arange(3)
            for i in range(2, vertices):
                basis[i, axes, 1 + 3 * (i - 2) + axes] = 1.0
            offset[0] = numbers.base_displacement
            offset[1] = numbers.base_displacement + numbers.base_rhs @ numbers.base_axes
        return basis, offset

    def _fill_tracking(
        self, numbers: StepNumbers, response: Array, particular: Array, curve: Array, curve_offset: Array
    ) -> None:
        layout = self.layout
        tracked, count, nodes = len(layout.tracked), response.shape[1], layout.node_columns
        if not tracked:
            return
        gap = slice(nodes, nodes + 3 * tracked)
        centres = self._centres.reshape(3 * tracked, nodes)
        self._rows[gap, :count] = centres @ response
        self._rows[gap, count:-1] = -np.einsum("kv,vcq->kcq", layout.curve_weights, curve).reshape(3 * tracked, -1)
        self._rhs[gap] = (
            numbers.position_rhs.reshape(-1)
            + centres @ particular
            - (layout.curve_weights @ curve_offset).reshape(-1)
        )
        tangent = slice(nodes + 3 * tracked, nodes + 5 * tracked)
        columns = self._face_columns
        present = np.repeat(columns >= 0, 3, axis=1)[:, None, :]
        flat = (np.maximum(columns, 0)[:, :, None] + np.arange(3)).reshape(tracked, 9)
        face = numbers.tangent_face * present
        self._rows[tangent, :count] = np.einsum("kaf,kfn->kan", face, response[flat]).reshape(2 * tracked, count)
        slope = np.einsum("kv,vcq->kcq", layout.curve_slopes, curve)
        self._rows[tangent, count:-1] = np.einsum("kac,kcq->kaq", numbers.tangent_curve, slope).reshape(2 * tracked, -1)
        self._rhs[tangent] = (
            numbers.tangent_rhs
            + np.einsum("kaf,kf->ka", face, particular[flat])
            + np.einsum("kac,kc->ka", numbers.tangent_curve, layout.curve_slopes @ curve_offset)
        ).reshape(-1)

    def _constraints(
        self, numbers: StepNumbers, response: Array, particular: Array
    ) -> tuple[Array, Array, Array, NDArray[np.int32]]:
        layout, count, size = self.layout, response.shape[1], self._size
        tip, clearance = len(numbers.tip_rhs), numbers.clearance
        hard = 3 * len(layout.tracked) if layout.hard_tracking else 0
        total = tip + hard + len(clearance)
        constraint = np.zeros((total, size))
        lower, upper = np.full(size + total, -UNBOUNDED), np.full(size + total, UNBOUNDED)
        lower[:count], upper[:count] = numbers.lower, numbers.upper
        lower[size - 1], upper[size - 1] = numbers.progress_lower, numbers.progress_upper

        columns = layout.node_column[layout.truss.tip]
        present = columns >= 0
        flat = (columns[present][:, None] + np.arange(3)).reshape(-1)
        jacobian = numbers.tip_jacobian[:, np.repeat(present, 3)]
        constraint[:tip, :count] = jacobian @ response[flat]
        constraint[:tip, -1] = -numbers.tip_rate
        value = numbers.tip_rhs - jacobian @ particular[flat]
        lower[size : size + tip] = upper[size : size + tip] = value
        if hard:
            rows = slice(layout.node_columns, layout.node_columns + hard)
            constraint[tip : tip + hard] = self._rows[rows]
            lower[size + tip : size + tip + hard] = upper[size + tip : size + tip + hard] = -self._rhs[rows]
        if len(clearance):
            columns = layout.node_column[clearance.nodes]
            coefficients = clearance.coefficients * (columns >= 0)[..., None]
            flat = np.maximum(columns, 0)[..., None] + np.arange(3)
            constraint[tip + hard :, :count] = np.einsum("rsc,rscn->rn", coefficients, response[flat])
            lower[size + tip + hard :] = clearance.lower - np.einsum("rsc,rsc->r", coefficients, particular[flat])
        sense = np.zeros(size + total, dtype=np.int32)
        sense[size : size + tip + hard] = 5
        return constraint, lower, upper, sense


def check_answer(
    x: Array, y: Array, flag: int, hessian: Array, gradient: Array, constraint: Array, lower: Array, upper: Array
) -> None:
    """Refuse an answer of DAQP whose primal or dual residual is too large, whatever status it came with.

    Raises
    ------
    SolverError
        A residual is above 1e-8, the dual one relative to the greatest gradient or multiplier.
    """
    size = len(x)
    values = np.concatenate((x, constraint @ x))
    primal = max(float((values - upper).max()), float((lower - values).max()))
    stationarity = hessian @ x
    stationarity += gradient
    stationarity += y[:size]
    stationarity += y[size:] @ constraint
    dual = _largest(stationarity) / (1.0 + _largest(gradient) + _largest(y))
    if not (primal <= 1e-8 and dual <= 1e-8):
        raise SolverError(
            f"daqp (exit flag {flag}) left a primal residual of {primal:.1e} m and a dual residual of {dual:.1e}"
        )


def _largest(vector: Array) -> float:
    return max(float(vector.max()), -float(vector.min()))
