"""DAQP, the dense active-set solver: the one place of Python that calls it; ``native/qp.c`` has that of C."""

from __future__ import annotations

import daqp
import numpy as np

from vgtm_qp.qp.dense import DenseAnswer, DenseQP, DenseSolver
from vgtm_qp.qp.residual import CONTRADICTION, InfeasibleStepError


class Daqp(DenseSolver):
    """DAQP, for arms of a `fineness`."""

    is_in_c = True

    def __init__(self, fineness: float = 1.0) -> None:
        self.accuracy = 1e-10 * fineness

    def ask(self, qp: DenseQP) -> DenseAnswer:
        """See :class:`vgtm_qp.qp.dense.DenseSolver`."""
        hessian, gradient, constraint, lower, upper, sense = qp
        x, _, flag, info = daqp.solve(
            hessian, gradient, constraint, upper, lower, sense, primal_tol=self.accuracy, eps_prox=0.0
        )
        if flag == -1:
            raise InfeasibleStepError(CONTRADICTION)
        status = f"daqp (exit flag {flag})"
        return DenseAnswer(x, np.asarray(info["lam"]), int(info["iterations"]), status, flag > 0)


DAQP = Daqp()
"""The default solver."""


def fitted(solver: DenseSolver, fineness: float) -> DenseSolver:
    """Return the default solver with the accuracy that arms of a `fineness` need; any other one as it is."""
    return Daqp(fineness) if solver.is_in_c else solver
