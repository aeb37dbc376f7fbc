"""The small correction after a step's QP: its equalities hold exactly without another QP.

The QP was linearised at the predicted middle of the step, so that the errors of tip and stations are of third
order. Newton iterations with a constant Jacobian remove them: each is the least change in the QP's metric
that corrects the errors while actuators at a bound stay there. Clearance rows can be left out: their margin
exceeds the motion.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular

from vgtm_qp.arm.arm import Arm
from vgtm_qp.arm.symbols import Bound, Constants, goal_after
from vgtm_qp.arrays import Array
from vgtm_qp.qp.answer import Accuracy, StepSolution
from vgtm_qp.qp.graph import StationSymbols, StepGraph
from vgtm_qp.qp.layout import Layout

WORST_CONDITION = 1e8
SETTLING_STEPS = 6
MOST_STEPS = 12
"""Greatest number of Newton steps to exact quantities."""

TOO_FAR = 1e-2
"""Error of a quantity after a QP, over the arm's unit, above which Newton's iteration is not tried."""

LEFT = 1e-8
"""Remaining path of the tip, m or rad, that counts as zero, for arms of a fineness of 1."""

ON_PATH = 1e-6
"""Slack of an elastic tip, m or rad, that counts as zero: the accuracy of solvers."""

AT_BOUND = 1e-6
"""Distance from a bound below which an actuator counts as held there, m or rad, for arms of a fineness of 1."""


_SETTLED = 1e-3
"""Error, over its tolerance, below which settling stops."""

_ROUNDING = float(np.finfo(float).eps)


def enough_length(q: Array, tolerance: float) -> float:
    """Return the error of a quantity at which the iteration stops.

    It is far below `tolerance`, because division by a short step's duration turns it into errors of rates and
    accelerations. For very long arms the rounding of node positions is the limit.
    """
    return max(_SETTLED * tolerance, 8.0 * _ROUNDING * float(np.abs(q).max()))


def enough_tip_error(q: Array, tolerance: float) -> float:
    """Return the tip error, m or rad, at which settling stops; see :func:`enough_length`."""
    return max(_SETTLED * tolerance, 1e3 * _ROUNDING * float(np.abs(q).max()))


def tolerances(arm: Arm) -> dict[str, float]:
    """Return by field what C knows of settling; the fields of :func:`aims` come later."""
    return {
        "at_bound": AT_BOUND * arm.fineness,
        "left": LEFT * arm.fineness,
        "worst_condition": WORST_CONDITION,
        "closing_steps": MOST_STEPS,
        "too_far": TOO_FAR * arm.unit,
    }


def aims(arm: Arm, accuracy: Accuracy) -> dict[str, float]:
    """Return by field to what accuracy C settles."""
    home = arm.home_configuration
    return {
        "member_error": accuracy.member,
        "tip_error": accuracy.tip,
        "start": accuracy.start,
        "enough_length": enough_length(home, accuracy.member),
        "enough_tip": enough_tip_error(home, accuracy.tip),
    }


def held(displacement: Array, lower: Array, upper: Array, fineness: float) -> NDArray[np.bool_]:
    """Return which actuators (n_a,) a QP left at a bound, by their position: multipliers may vanish there."""
    near = AT_BOUND * fineness
    return np.asarray((displacement < lower + near) | (displacement > upper - near))


def settling_gain(hessian: Array, rows: Array, levers: Array, free: NDArray[np.bool_]) -> Array | None:
    """Return (n, m) the least changes of the unknowns that change the values of the `rows` by one each.

    None if the `free` unknowns determine no such changes.

    Parameters
    ----------
    hessian : (n, n)
        Of the QP: the metric in which the changes are least.
    rows : (m, n)
        Equalities: those of the tip, and of stations that are kept on the curve.
    levers : (m,)
        Lengths to compare the rows by, see ``Layout.levers``.
    free : (n,)
        Unknowns that may change.
    """
    if np.count_nonzero(free) < len(rows):
        return None
    try:
        factor = np.linalg.cholesky(hessian[np.ix_(free, free)])
        half = solve_triangular(factor, levers * rows[:, free].T, lower=True)
        normal = np.linalg.cholesky(half.T @ half)
    except (np.linalg.LinAlgError, ValueError):
        return None
    pivots = normal.diagonal()
    if not pivots.max() ** 2 < WORST_CONDITION * pivots.min() ** 2:
        return None
    gain = np.zeros((len(free), len(rows)))
    shares = cho_solve((normal, True), np.eye(len(rows)))
    gain[free] = solve_triangular(factor, half @ shares, lower=True, trans=1) * levers
    return gain


class Gain(NamedTuple):
    """The result (n, m) of :func:`settling_gain`, and the function from changes (n,) to their solution.

    The levers (n,), m or 1, are those by which changes are compared with one another.
    """

    per_missing: Array
    solution: Callable[[Array], StepSolution]
    levers: Array

    def updated(self, change: Array, less: Array) -> Gain:
        """Return Broyden's update after a `change` (n,) that reduced the errors by `less` (m,)."""
        gain = self.per_missing
        along = (self.levers**2 * change) @ gain
        scale = along @ less
        if scale == 0.0:
            return self
        return self._replace(per_missing=gain + np.outer(change - gain @ less, along / scale))


def missing_function(layout: Layout) -> Bound:
    """Return the function for the errors of a step's equalities at a configuration and a curve.

    Arguments: those of ``StepGraph.inputs`` before the constants, with ``motion`` zero; and the progress by
    which the goal has moved on since, along a straight line. Results: the changes (n_e + H) that correct the
    tip's rows and the stations' hard rows, m and rad; position (3) and rotation (3, 3) of the tip.
    """
    constants = Constants()
    graph = StepGraph(layout, layout.arm.symbols(constants), constants)
    missing = [graph.tip_error]
    if layout.vertices:
        station = StationSymbols(layout)
        function = ca.Function("off", station.places, [station.gap, ca.densify(station.turn)])
        gaps, turns = zip(*(function(*graph.station(k)[0]) for k in range(len(layout.tracked))), strict=True)
        missing.append(-ca.vertcat(*gaps, *turns)[layout.hard.tolist()])
    results = [ca.vertcat(*missing), graph.tip_position, graph.tip_rotation]
    gone, inputs = ca.MX.sym("gone"), graph.inputs
    goal = goal_after(graph.goal, graph.turned, graph.velocity, graph.spin, gone)
    results = ca.graph_substitute(results, [graph.goal, graph.turned], list(goal))
    arguments = inputs[: len(inputs) - len(constants.symbols)]
    return constants.bound("missing", [*arguments, gone], results)


def closing_function(layout: Layout) -> Bound:
    """Return the function (q, lower, upper) -> q after one Newton step; the quantities (M) that it is to have; errors.

    Fixed quantities go to their values, actuators into their boxes (n_a); see ``ArmSymbols.closed``. The errors are
    those at q, given by their greatest magnitude, which skips NaN, and by their norm, which keeps it.
    """
    constants, arm = Constants(), layout.arm
    symbols = arm.symbols(constants)
    q, count = ca.MX.sym("q", *symbols.shape), len(arm.actuators)
    lower, upper = ca.MX.sym("lower", count), ca.MX.sym("upper", count)
    quantities = symbols.quantities(q)
    aims = symbols.aims(quantities, lower, upper)
    errors = ca.vertcat(ca.norm_inf(quantities - aims), ca.norm_2(quantities - aims))
    results = [symbols.closed(q, lower, upper), aims, errors]
    return constants.bound("close", [q, lower, upper], results)
