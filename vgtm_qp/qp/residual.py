"""One check of every answer: its residuals, by one norm and one tolerance, whatever status the solver returned."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from vgtm_qp.arrays import Array
from vgtm_qp.errors import SolverError
from vgtm_qp.qp.numbers import norm

if TYPE_CHECKING:
    from vgtm_qp.qp.full import StepQP


TOLERANCE = 1e-6
"""Greatest residual of an answer: m or rad, and for the dual one relative to the objective's forces.

DAQP and the eliminations stay below 1e-12. This is what OSQP can keep, too: what it leaves is closed afterwards, and
the state that comes of it is checked by itself, to 1e-10 m.
"""


class FailedStepError(SolverError):
    """The QP of a step has no answer, or none was found that is good enough.

    Attributes
    ----------
    qp : StepQP or None
        The QP that failed, built when it is asked for.
    """

    build: Callable[[], StepQP] | None = None

    @property
    def qp(self) -> StepQP | None:
        """The QP that failed; None where nobody kept it."""
        return None if self.build is None else self.build()


class InfeasibleStepError(FailedStepError):
    """No displacement satisfies every hard row of a step's QP."""


class AnswerError(FailedStepError):
    """A solver gave no answer that is good enough, which says nothing about the step."""


class NoAnswerError(AnswerError, InfeasibleStepError):
    """A solver found no answer, and does not say whether there is one."""


def relative(stationarity: float, *forces: Array) -> float:
    """Return the norm of what is left of stationarity, relative to those of the objective's forces and multipliers."""
    return stationarity / (1.0 + sum(norm(force) for force in forces))


def refuse_large(primal: float, dual: float, solver: str) -> None:
    """Raise AnswerError where a residual is above ``TOLERANCE``, or NaN.

    Parameters
    ----------
    primal, dual
        See :func:`vgtm_qp.qp.numbers.beyond` and :func:`relative`.
    solver
        What gave the answer, and how it ended.
    """
    if not (primal <= TOLERANCE and dual <= TOLERANCE):
        raise AnswerError(
            f"{solver} left a primal residual of {primal:.1e} m and a dual residual of {dual:.1e}"
        )
