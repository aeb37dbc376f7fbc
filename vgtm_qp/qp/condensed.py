"""The step's QP condensed onto the actuators.

The node displacements are K d_a + r, so that fixed quantities hold by construction and limits of actuators are bounds
on single unknowns. The unknowns left are the actuator displacements, the free coordinates of the curve and the progress
along the path.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.qp import daqp
from vgtm_qp.qp.daqp import EQUALITY
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import UNBOUNDED, CurveNumbers, StepNumbers, StepSolution, slack_curvature

Array = NDArray[np.float64]


class CondensedSolver:
    """Solves the QP of a step in the unknowns (d_a, free curve coordinates, d_alpha) with DAQP.

    The curve's base conditions are eliminated: d_p[0] follows the base and d_p[1] - d_p[0] moves along the base normal.
    """

    knows_gain = False

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        arm, weights = layout.arm, layout.weights
        nodes, actuators, vertices = layout.node_columns, len(arm.actuators), layout.vertices
        curve_nodes = len(layout.tracked)
        self._free_curve = layout.free_curve
        self._size = actuators + self._free_curve + 1
        self._centres = np.zeros((curve_nodes, 3, nodes))
        stations = arm.stations
        for k, face in enumerate(layout.tracked):
            for node, weight in zip(stations.nodes[face], stations.weights[face], strict=True):
                column = layout.node_column[node]
                if column >= 0:
                    self._centres[k, range(3), range(column, column + 3)] = weight
        self._face_columns = (
            layout.node_column[stations.nodes[layout.tracked]] if vertices else np.zeros((0, 3), int)
        )
        count = nodes + (3 + layout.turns) * curve_nodes + layout.spacings
        self._rows = np.zeros((count, self._size))
        self._rhs = np.zeros(count)
        self._row_weight = np.concatenate(
            [
                np.full(nodes, weights.node_rate),
                np.full(3 * curve_nodes, weights.tracking),
                layout.turn_weights,
                np.full(layout.spacings, weights.spacing),
            ]
        )
        self._row_weight[nodes : nodes + layout.hard_rows] = 0.0
        self._constant_hessian = np.zeros((self._size, self._size))
        index = np.arange(actuators)
        self._constant_hessian[index, index] = weights.actuator_rate + weights.stroke_centring
        coordinates = 3 * vertices + layout.torsion
        self._curve_hessian = weights.curve_rate * np.eye(coordinates)
        self._curve_hessian[: 3 * vertices, : 3 * vertices] = np.kron(layout.vertex_hessian, np.eye(3))

    def solve(self, numbers: StepNumbers) -> StepSolution:
        """Solve one QP.

        Raises
        ------
        InfeasibleStepError
            The hard rows contradict one another.
        SolverError
            The arm is in a singular pose, or the answer failed the residual check.
        """
        layout, arm = self.layout, self.layout.arm
        count, size, nodes = len(arm.actuators), self._size, layout.node_columns
        response, particular = numbers.motion.response()

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
            curve_hessian = self._curve_hessian @ curve
            hessian[block, block] += curve.T @ curve_hessian
            gradient[block] += curve_offset @ curve_hessian
            gradient[block] += numbers.vertex_gradient.reshape(-1) @ curve[: numbers.vertex_gradient.size]
        hessian[-1, -1] += numbers.progress_curvature
        gradient[-1] += numbers.progress_gradient

        constraint, lower, upper, sense = self._constraints(numbers, response, particular)
        if layout.elastic_tip:
            tip, penalty = len(numbers.tip_rhs), layout.weights.end_effector
            hessian, gradient, constraint, lower, upper, sense = _with_slacks(
                hessian, gradient, constraint, lower, upper, sense, tip, penalty
            )
        answer = daqp.ask(hessian, gradient, constraint, lower, upper, sense)
        daqp.check(answer, hessian, gradient, constraint, lower, upper)
        x, multipliers = answer.x, answer.multipliers

        displacement = np.zeros((len(arm.node_names), 3))
        displacement[arm.free] = (response @ x[:count] + particular).reshape(-1, 3)
        moved = curve @ x[count : size - 1] + curve_offset
        vertices = moved[: 3 * layout.vertices].reshape(-1, 3)
        clearance = len(numbers.clearance)
        return StepSolution(
            nodes=displacement,
            actuators=x[:count].copy(),
            vertices=vertices,
            progress=float(x[size - 1]),
            actuator_multipliers=multipliers[:count].copy(),
            clearance_multipliers=-multipliers[len(multipliers) - clearance :],
            iterations=answer.iterations,
            torsion=moved[3 * layout.vertices :],
            tip_slack=float(np.max(x[size:], initial=0.0)),
        )

    def gain(self, held: NDArray[np.bool_]) -> Array | None:  # noqa: ARG002
        """See ``solvers.StepSolver``."""
        return None

    def _curve_basis(self, numbers: StepNumbers) -> tuple[Array, Array]:
        """Return the basis (D, q) of the free displacements of the curve's coordinates, and the offset (D,)."""
        coordinates, free = 3 * self.layout.vertices + self.layout.torsion, self._free_curve
        basis, offset = np.zeros((coordinates, free)), np.zeros(coordinates)
        if coordinates:
            basis[3:6, 0] = np.cross(numbers.base_axes[0], numbers.base_axes[1])
            basis[6:, 1:] = np.eye(free - 1)
            offset[:3] = numbers.base_displacement
            offset[3:6] = numbers.base_displacement + numbers.base_rhs @ numbers.base_axes
        return basis, offset

    def _fill_tracking(
        self, numbers: StepNumbers, response: Array, particular: Array, curve: Array, curve_offset: Array
    ) -> None:
        layout = self.layout
        tracked, count, nodes = len(layout.tracked), response.shape[1], layout.node_columns
        if not tracked:
            return
        rows = numbers.curve or self._tabled(numbers)
        turns, spacings = layout.turns * tracked, layout.spacings
        gap, turn = slice(nodes, nodes + 3 * tracked), slice(nodes + 3 * tracked, nodes + 3 * tracked + turns)
        centres = self._centres.reshape(3 * tracked, nodes)
        position = rows.position.reshape(3 * tracked, -1)
        self._rows[gap, :count] = centres @ response
        self._rows[gap, count:-1] = -position @ curve
        self._rhs[gap] = numbers.position_rhs.reshape(-1) + centres @ particular - position @ curve_offset
        columns = self._face_columns
        present = np.repeat(columns >= 0, 3, axis=1)[:, None, :]
        flat = (np.maximum(columns, 0)[:, :, None] + np.arange(3)).reshape(tracked, 9)
        face = rows.turn_face * present
        turned = rows.turn_curve.reshape(turns, -1)
        self._rows[turn, :count] = np.einsum("kaf,kfn->kan", face, response[flat]).reshape(turns, count)
        self._rows[turn, count:-1] = turned @ curve
        self._rhs[turn] = (
            rows.turn_rhs.reshape(-1)
            + np.einsum("kaf,kf->ka", face, particular[flat]).reshape(-1)
            + turned @ curve_offset
        )
        if spacings:
            self._rows[-spacings:, count:-1] = rows.spacing @ curve
            self._rhs[-spacings:] = rows.spacing_rhs + rows.spacing @ curve_offset

    def _tabled(self, numbers: StepNumbers) -> CurveNumbers:
        """Return the rows of a curve that is no more than its tables of weights."""
        layout = self.layout
        size = 3 * layout.vertices
        position = layout.curve_weights[:, None, :, None] * np.eye(3)[:, None, :]
        turn = numbers.tangent_curve[:, :, None, :] * layout.curve_slopes[:, None, :, None]
        return CurveNumbers(
            position=position.reshape(-1, 3, size),
            turn_face=numbers.tangent_face,
            turn_curve=turn.reshape(-1, 2, size),
            turn_rhs=numbers.tangent_rhs,
            spacing=np.zeros((0, size)),
            spacing_rhs=np.zeros(0),
        )

    def _constraints(
        self, numbers: StepNumbers, response: Array, particular: Array
    ) -> tuple[Array, Array, Array, NDArray[np.int32]]:
        layout, count, size = self.layout, response.shape[1], self._size
        tip, clearance = len(numbers.tip_rhs), numbers.clearance
        hard = layout.hard_rows
        total = tip + hard + len(clearance)
        constraint = np.zeros((total, size))
        lower, upper = np.full(size + total, -UNBOUNDED), np.full(size + total, UNBOUNDED)
        lower[:count], upper[:count] = numbers.lower, numbers.upper
        lower[size - 1], upper[size - 1] = numbers.progress_lower, numbers.progress_upper

        columns = layout.node_column[layout.arm.end_effector.nodes]
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
            lower[size + tip + hard :] = clearance.lower - np.einsum(
                "rsc,rsc->r", coefficients, particular[flat]
            )
        sense = np.zeros(size + total, dtype=np.int32)
        sense[size : size + tip + hard] = EQUALITY
        return constraint, lower, upper, sense


def _with_slacks(
    hessian: Array,
    gradient: Array,
    constraint: Array,
    lower: Array,
    upper: Array,
    sense: NDArray[np.int32],
    tip: int,
    penalty: float,
) -> tuple[Array, Array, Array, Array, Array, NDArray[np.int32]]:
    """Return the QP with two slacks more for each of its first `tip` rows, at an exact penalty.

    The penalty is linear in the slacks, so that a row holds exactly while `penalty` exceeds its multiplier; their
    curvature is there for a solver of strictly convex QPs alone.
    """
    size, slacks = len(gradient), 2 * tip
    wide = np.zeros((len(constraint), size + slacks))
    wide[:, :size] = constraint
    wide[:tip, size : size + tip], wide[:tip, size + tip :] = np.eye(tip), -np.eye(tip)
    larger = np.zeros((size + slacks, size + slacks))
    larger[:size, :size] = hessian
    larger[size:, size:] = slack_curvature(penalty) * np.eye(slacks)

    def with_bounds(bounds: Array, of_slacks: float) -> Array:
        return np.concatenate([bounds[:size], np.full(slacks, of_slacks), bounds[size:]])

    return (
        larger,
        np.concatenate([gradient, np.full(slacks, penalty)]),
        wide,
        with_bounds(lower, 0.0),
        with_bounds(upper, UNBOUNDED),
        with_bounds(sense.astype(float), 0.0).astype(np.int32),
    )
