"""One check of every answer: its residuals by one norm and one tolerance, whatever the solver's status."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import SolverError
from vgtm_qp.qp.numbers import norm

if TYPE_CHECKING:
    from vgtm_qp.qp.full import StepQP


TOLERANCE = 1e-6
"""Greatest residual of an answer, in m or rad; the dual residual is relative to the objective's forces.

DAQP and the eliminations stay below 1e-12. OSQP reaches this value: settling removes the rest, and the new state is
checked separately, to 1e-10 m.
"""


CONTRADICTION = "the hard rows of the step contradict one another"


class FailedStepError(SolverError):
    """The QP of a step has no answer, or no accurate one was found.

    Attributes
    ----------
    qp : StepQP or None
        The QP that failed, built on first access.
    """

    build: Callable[[], StepQP] | None = None

    @property
    def qp(self) -> StepQP | None:
        """The QP that failed; None if it is unknown."""
        return None if self.build is None else self.build()


class InfeasibleStepError(FailedStepError):
    """No displacement satisfies every hard row of a step's QP."""


class AnswerError(FailedStepError):
    """A solver gave no accurate answer, which does not mean that the step is infeasible."""


class NoAnswerError(AnswerError, InfeasibleStepError):
    """A solver found no answer, and does not say whether there is one."""


def loose(multipliers: Array, values: Array, lower: Array, upper: Array) -> float:
    """Return the norm of multipliers times the distances of `values` from their bounds, each at most 1.

    A positive multiplier belongs to an upper, a negative one to a lower bound.
    """
    apart = np.where(multipliers > 0.0, upper - values, values - lower)
    return norm(multipliers * np.minimum(np.maximum(apart, 0.0), 1.0))


def relative(stationarity: float, *forces: Array) -> float:
    """Return the norm of the stationarity residual, relative to the norms of objective forces and multipliers."""
    return stationarity / (1.0 + sum(norm(force) for force in forces))


def refuse_large(primal: float, dual: float, solver: str) -> None:
    """Raise AnswerError where a residual is above ``TOLERANCE``, or NaN.

    Parameters
    ----------
    primal, dual
        See :func:`vgtm_qp.qp.numbers.beyond` and :func:`relative`.
    solver
        Name of the solver and its exit status.
    """
    if not (primal <= TOLERANCE and dual <= TOLERANCE):
        raise AnswerError(
            f"{solver} left a primal residual of {primal:.1e} m and a dual residual of {dual:.1e}"
        )
