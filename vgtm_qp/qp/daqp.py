"""DAQP, the dense active-set solver: the one place that calls it."""

from __future__ import annotations

from typing import NamedTuple

import daqp
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array
from vgtm_qp.qp.numbers import beyond, norm
from vgtm_qp.qp.residual import InfeasibleStepError, refuse_large, relative

EQUALITY = 5
"""DAQP's mark for a row that is always active."""

FEASIBILITY = 1e-10


class DenseAnswer(NamedTuple):
    """DAQP's answer to a QP, not checked yet.

    Attributes
    ----------
    x : (n,)
    multipliers : (n + m,)
        Of bounds, then of rows: positive at an upper, negative at a lower bound.
    flag, iterations : int
    """

    x: Array
    multipliers: Array
    flag: int
    iterations: int

    @property
    def name(self) -> str:
        """Solver and exit flag."""
        return f"daqp (exit flag {self.flag})"


def ask(
    hessian: Array,
    gradient: Array,
    constraint: Array,
    lower: Array,
    upper: Array,
    sense: NDArray[np.int32],
) -> DenseAnswer:
    """Return DAQP's answer to min 1/2 x'Hx + g'x with lower <= [x; C x] <= upper.

    Parameters
    ----------
    hessian, gradient : (n, n), (n,)
    constraint : (m, n)
    lower, upper, sense : (n + m,)
        Bounds, first of the unknowns; infinite ones are ``numbers.UNBOUNDED``. `sense` is ``EQUALITY`` or 0.

    Raises
    ------
    InfeasibleStepError
        The rows contradict one another.
    """
    x, _, flag, info = daqp.solve(
        hessian, gradient, constraint, upper, lower, sense, primal_tol=FEASIBILITY, eps_prox=0.0
    )
    if flag == -1:
        raise InfeasibleStepError("the hard rows of the step contradict one another")
    return DenseAnswer(x, np.asarray(info["lam"]), flag, int(info["iterations"]))


def check(
    answer: DenseAnswer, hessian: Array, gradient: Array, constraint: Array, lower: Array, upper: Array
) -> None:
    """Refuse an answer whose residuals are too large; arguments as of :func:`ask`.

    Raises
    ------
    AnswerError
        See :func:`vgtm_qp.qp.residual.refuse_large`.
    """
    x, y = answer.x, answer.multipliers
    size = len(x)
    with np.errstate(invalid="ignore"):  # An answer may be NaN.
        primal = norm(beyond(np.concatenate((x, constraint @ x)), lower, upper))
        stationarity = hessian @ x
        stationarity += gradient
        stationarity += y[:size]
        stationarity += y[size:] @ constraint
    refuse_large(primal, relative(norm(stationarity), gradient, y), answer.name)
