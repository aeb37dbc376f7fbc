"""Dense QPs of a step: what a solver is asked, what it answers, and the check of its answer.

    minimise  1/2 x' H x + g' x   subject to   lower <= [x; C x] <= upper

The bounds are those of the first unknowns, usually of all, then those of the rows C.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array
from vgtm_qp.qp.numbers import beyond, norm
from vgtm_qp.qp.residual import AnswerError, InfeasibleStepError, loose, refuse_large, relative

EQUALITY = 5
"""DAQP's mark for a row that is always active."""

_GREATEST = 1e100
"""Greatest number of an answer: squares of much greater ones overflow, and residuals over infinity would be zero."""


class DenseQP(NamedTuple):
    """What a solver is asked.

    Attributes
    ----------
    hessian, gradient : (n, n), (n,)
    constraint : (m, n)
    lower, upper, sense : (b + m,)
        Bounds, first of b unknowns; infinite ones are ``numbers.UNBOUNDED``. `sense` is ``EQUALITY`` or 0.
    """

    hessian: Array
    gradient: Array
    constraint: Array
    lower: Array
    upper: Array
    sense: NDArray[np.int32]

    @property
    def bounded(self) -> int:
        """Number b of unknowns with bounds."""
        return len(self.lower) - len(self.constraint)


class DenseAnswer(NamedTuple):
    """A solver's answer to a dense QP.

    Attributes
    ----------
    x : (n,)
    multipliers : (b + m,)
        Of bounds, then of rows: positive at an upper, negative at a lower bound.
    iterations : int
    status : str
        Name of the solver, and how it ended.
    is_solved : bool
        Whether the solver says that it solved the QP.
    """

    x: Array
    multipliers: Array
    iterations: int
    status: str
    is_solved: bool = True


class DenseSolver(Protocol):
    """Solves dense QPs.

    Attributes
    ----------
    accuracy : float
        Greatest violation of a row by its answers, m or rad.
    is_in_c : bool
        Whether ``native/qp.c`` calls the same solver by itself.
    """

    accuracy: float
    is_in_c: bool = False

    def ask(self, qp: DenseQP) -> DenseAnswer:
        """Return the answer, in new arrays; who asks checks it, see :func:`answered`.

        Raises
        ------
        InfeasibleStepError
            The rows contradict one another.
        AnswerError
            The solver failed.
        """
        ...


def residuals(answer: DenseAnswer, qp: DenseQP) -> tuple[float, float]:
    """Return the primal residual of an answer, m or rad, and the dual one, relative to the objective's forces.

    The dual residual is the greater of two norms: of H x + g + multipliers, and of what is :func:`loose`.
    """
    x, y = answer.x, answer.multipliers
    # A comparison with NaN is false, too.
    if not (np.abs(x).max(initial=0.0) < _GREATEST and np.abs(y).max(initial=0.0) < _GREATEST):
        return np.nan, np.nan
    values = np.concatenate((x[: qp.bounded], qp.constraint @ x))
    stationarity = qp.hessian @ x
    stationarity += qp.gradient
    stationarity[: qp.bounded] += y[: qp.bounded]
    stationarity += y[qp.bounded :] @ qp.constraint
    dual = relative(max(norm(stationarity), loose(y, values, qp.lower, qp.upper)), qp.gradient, y)
    return norm(beyond(values, qp.lower, qp.upper)), dual


def answered(solver: DenseSolver, qp: DenseQP) -> DenseAnswer:
    """Return the answer of a solver, whatever its status, if its residuals are small enough.

    Raises
    ------
    InfeasibleStepError, AnswerError
        See :meth:`DenseSolver.ask` and :func:`vgtm_qp.qp.residual.refuse_large`.
    """
    answer = solver.ask(qp)
    refuse_large(*residuals(answer, qp), answer.status)
    return answer


def check_question(solver: str, qp: DenseQP) -> None:
    """Refuse a QP that an iterative solver must not get, since NaN would stay in it.

    Raises
    ------
    AnswerError
        A number is infinite or NaN.
    InfeasibleStepError
        A lower bound is above its upper bound.
    """
    if not all(math.isfinite(array.sum()) for array in qp):
        raise AnswerError(f"{solver} was not asked: the QP has an infinite number or NaN")
    if (qp.lower > qp.upper).any():
        raise InfeasibleStepError("a lower bound is above its upper bound")
