"""The curve on its own, section 4.4: eqs. (37)-(38) with base conditions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.curve.closest import closest_to_point
from vgtm_qp.curve.curve import Curve
from vgtm_qp.curve.redundancy import BASE_ROWS, degree_of_redundancy
from vgtm_qp.errors import SolverError
from vgtm_qp.methods.objectives import potential_curvature, potential_slope
from vgtm_qp.methods.pseudoinverse import Cost, moore_penrose, null_space_vector, projector
from vgtm_qp.methods.resolver import MAX_CORRECTIONS, TIP_TOLERANCE
from vgtm_qp.problem import Problem
from vgtm_qp.rotation import rotation_from_vector
from vgtm_qp.rows.curve import polygon_bending, spacings
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.setup import Setup

DEFAULT_TERMS = ("curve_rate", "spacing", "smoothness")

_SAMPLES = 400
"""Number of pieces of the curve; the nearest point to a node is searched among their ends."""


class CurveMotion:
    """Moves a reference curve so that its end follows the path.

    Its nodes are at the parameters `s` (F,), one a station: at home the nearest points of the curve to the stations.
    The frame of its end times the constant rotation `roll` (3, 3) is that of the end effector: at home they agree.

    Raises
    ------
    ProblemError
        The curve has too few control vertices for its base and the end effector, or no torsion for the tip's roll.
    """

    def __init__(self, problem: Problem, setup: Setup) -> None:
        method, spec, arm = problem.method, problem.curve, setup.arm
        family = setup.layout.family
        assert family is not None, "an arm with stations is laid out with its curve"
        self._setup, self._task = setup, setup.task
        mistakes, rows = [], len(setup.task.row_names)
        spare = degree_of_redundancy(spec.control_vertices, rows, spec.torsion_vertices)
        if spare < 0:
            least = spec.control_vertices + -(spare // 3)
            text = f"{least} or more: base and tip fix {BASE_ROWS + rows} coordinates"
            mistakes.append(problem.mistake(("curve", "control_vertices"), text))
        if setup.task.turns == "orientation" and not spec.torsion_vertices:
            text = "1 or more, since the orientation of the tip is tracked"
            mistakes.append(problem.mistake(("curve", "torsion_vertices"), text))
        if mistakes:
            raise problem.error(mistakes)
        centres, base = arm.stations.centres(arm.home), arm.stations.frames[0]
        self.home = Curve(family, setup.control_vertices, np.zeros(spec.torsion_vertices), base)
        between = [float(closest_to_point(self.home, centre).s[0]) for centre in centres[1:-1]]
        self.s = np.maximum.accumulate([0.0, *between, 1.0])
        self.roll = np.eye(3)
        if setup.task.turns == "orientation":
            x = arm.end_effector.frame[:, 0] @ self.home.frame(1.0)
            self.roll = rotation_from_vector((0.0, 0.0, float(np.arctan2(x[1], x[0]))))
        # The curve's end is a constant combination of its vertices.
        self._end = family.weights(1.0)
        self._end_rows = self.home.position_jacobian(1.0)[self._task.axes]
        names = DEFAULT_TERMS if method.null_space is None else method.null_space
        gains = method.gains
        self._terms = {name: float(getattr(gains, name)) for name in names}
        self._node_rows = self.home.position_jacobian(self.s)
        self._spacing = np.linalg.norm(np.diff(centres, axis=0), axis=1)
        self._bending = np.kron(polygon_bending(spec.control_vertices), np.eye(3))
        self._base_rows = np.zeros((BASE_ROWS, self.home.coordinates))
        self._base_rows[:3, :3] = np.eye(3)
        self._base_rows[3:, 3:6] = base[:, :2].T
        s = np.linspace(0.0, 1.0, _SAMPLES + 1)
        squares = ((self.home.position(s)[None] - arm.points(arm.home_configuration)[:, None]) ** 2).sum(
            axis=2
        )
        self._point_s = s[np.argmin(squares, axis=1)]

    def follow(self, curve: Curve, goal: TipGoal, time: float, q: Array, *, correct: bool) -> Curve:
        """Return the curve after a step by eq. (38) to a goal; the goal's rates are the displacement to it.

        Without `correct` the end moves by that displacement to first order, as in the paper; with it the step
        ends exactly at the goal. `q` is the arm's configuration, for the obstacle potential alone.

        Raises
        ------
        SolverError
            The tip's and base's rows are dependent, or the correction does not converge.
        """
        error, rate, across = self._missing(curve, goal)
        J = self._rows(curve, across)
        x = np.concatenate([error if correct else rate, np.zeros(BASE_ROWS)])
        inverse = moore_penrose(J)
        if inverse.rank < len(J):
            raise SolverError(f"the {len(J)} rows of the curve's tip and base have rank {inverse.rank}")
        dp = inverse.matrix @ x
        if self._terms:
            N = projector(inverse, J)
            dp = dp + N @ null_space_vector(N, dp, self.objective(curve, q, time))
        curve = displaced(curve, dp)
        return self.corrected(curve, goal) if correct else curve

    def corrected(self, curve: Curve, goal: TipGoal) -> Curve:
        """Return the curve that ends at `goal`, by Newton's method and least displacements.

        Raises
        ------
        SolverError
            Newton's method does not converge.
        """
        for _ in range(MAX_CORRECTIONS):
            error, _, across = self._missing(curve, goal)
            if float(np.max(np.abs(error), initial=0.0)) <= TIP_TOLERANCE:
                return curve
            x = np.concatenate([error, np.zeros(BASE_ROWS)])
            curve = displaced(curve, moore_penrose(self._rows(curve, across)).matrix @ x)
        raise SolverError("Newton's method on the curve's tip does not converge")

    def objective(self, curve: Curve, q: Array, time: float) -> Cost:
        """Return the null-space terms as a quadratic cost of the displacements (D,) of the curve's coordinates."""
        p = curve.control_vertices
        vertices, size = p.size, curve.coordinates
        hessian, gradient = np.zeros((size, size)), np.zeros(size)
        rate = self._terms.get("curve_rate", 0.0)
        rate = rate or (1.0 if set(self._terms) <= {"obstacle_potential"} else 1e-9)
        area = self._setup.arm.unit**2
        hessian[np.diag_indices_from(hessian)] += rate * np.where(np.arange(size) < vertices, 1.0, area)
        if gain := self._terms.get("spacing"):
            distance, rows = spacings(curve.position(self.s), self._node_rows)
            hessian += gain * rows.T @ rows
            gradient += gain * rows.T @ (distance - self._spacing)
        if gain := self._terms.get("smoothness"):
            hessian[:vertices, :vertices] += gain * self._bending
            gradient[:vertices] += gain * self._bending @ (p - self.home.control_vertices).ravel()
        if gain := self._terms.get("obstacle_potential"):
            rows, distance = self._near(curve, q, time)
            gain *= area
            stiffness = gain * potential_curvature(distance, self._setup.influence)
            hessian[:vertices, :vertices] += (rows.T * stiffness) @ rows
            gradient[:vertices] += gain * potential_slope(distance, self._setup.influence) @ rows
        return Cost(hessian, gradient)

    def _missing(self, curve: Curve, goal: TipGoal) -> tuple[Array, Array, Array]:
        """Return the error x_e - x(1), eq. (34), and the goal's rates, (n_e,) each; and the turned axes (r, 3)."""
        rotation = curve.frame(1.0) @ self.roll if self._task.turns else np.eye(3)
        error, rate, across, _ = self._task.residual(self._end @ curve.control_vertices, rotation, goal)
        return error, rate, across

    def _rows(self, curve: Curve, across: Array) -> Array:
        """Return J_s(1) of eq. (37), its turns about the axes `across`, then the rows of the base: (n_e + 5, D)."""
        rows = [self._end_rows]
        if self._task.turns:
            rows.append(across @ curve.orientation_jacobian(1.0))
        return np.concatenate([*rows, self._base_rows])

    def _near(self, curve: Curve, q: Array, time: float) -> tuple[Array, Array]:
        """Return rows (R, 3 V) of d distance / d p, and distances (R,), m, of the bodies near obstacles.

        A body is assumed to move with its nearest point of the curve.
        """
        setup = self._setup
        pairs = setup.monitor.near(setup.carrier.points(q), time, setup.influence)
        # What the arm carries has no place on the curve.
        kept = np.flatnonzero(~pairs.is_self & (pairs.body < len(setup.arm.bodies)))
        # The weights of the obstacle's points are zero.
        spanned, weights, normal = pairs.points[kept], pairs.weights[kept], pairs.normal[kept]
        s = np.clip(np.einsum("rk,rk->r", weights, self._point_s[spanned]), 0.0, 1.0)
        witness = np.einsum("rk,rkc->rc", weights, setup.arm.points(q)[spanned])
        slopes = curve.derivative(s)
        length = np.linalg.norm(slopes, axis=1, keepdims=True)
        tangent = slopes / length
        # A witness point off the axis turns with the tangent: d q = d r + (t x d t) x (q - r).
        lever = np.cross(witness - curve.position(s), normal)
        turning = np.cross(lever, tangent)
        table, slope = curve.family.weights(s), curve.family.weights(s, 1)
        across = (turning - np.einsum("rc,rc->r", turning, tangent)[:, None] * tangent) / length
        rows = np.einsum("rv,rc->rvc", table, normal) + np.einsum("rv,rc->rvc", slope, across)
        return rows.reshape(len(s), 3 * table.shape[1]), pairs.distance[kept]


def displaced(curve: Curve, d: Array) -> Curve:
    """Return the curve after a displacement `d` (D,) of its coordinates."""
    size = curve.control_vertices.size
    return replace(
        curve,
        control_vertices=curve.control_vertices + d[:size].reshape(-1, 3),
        torsion=curve.torsion + d[size:],
    )
