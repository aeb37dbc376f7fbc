"""The length Jacobian of a truss at one configuration, eqs. (16)-(24), and what follows from it for the nodes."""

from __future__ import annotations

import numpy as np
from scipy.linalg.lapack import dgetrf, dgetrs
from scipy.sparse.linalg import splu

from vgtm_qp.arm.truss.truss import Array, Truss
from vgtm_qp.errors import SolverError

_DENSE = 150
"""Up to so many node coordinates LAPACK is faster than any use of the structure."""

SINGULAR = "the length Jacobian is singular: the truss is in a singular pose"


class LengthRows:
    """J d_rho - E d_a = rhs, eqs. (22)-(24) with the actuated members beside the fixed ones; see ``arm.MotionRows``.

    Attributes
    ----------
    gradient : (M, Q, 3)
    rhs : (M,)
        m.
    """

    def __init__(self, truss: Truss, gradient: Array, rhs: Array) -> None:
        self.truss, self.gradient, self.rhs = truss, gradient, rhs

    @property
    def values(self) -> Array:
        truss = self.truss
        gradients = self.gradient.reshape(-1)[truss.scatter.flat]
        return np.concatenate([gradients, np.full(len(truss.actuators), -1.0)])

    def jacobian(self) -> Array:
        """Return the dense length Jacobian (M, 3 (N - N_c))."""
        return self.truss.scatter.dense(self.gradient)

    def response(self) -> tuple[Array, Array]:
        """Return K and r with J K = E, J r = rhs; see ``arm.MotionRows``."""
        truss = self.truss
        members, count = truss.member_count, len(truss.actuators)
        known = np.zeros((members, count + 1))
        known[truss.actuators, np.arange(count)] = 1.0
        known[:, -1] = self.rhs
        if members <= _DENSE:
            factors, pivots, failed = dgetrf(self.jacobian())
            if failed:
                raise SolverError(SINGULAR)
            answer, _ = dgetrs(factors, pivots, known)
        else:
            try:
                answer = splu(truss.scatter.sparse(self.gradient)).solve(known)
            except RuntimeError as reason:
                raise SolverError(SINGULAR) from reason
        if not np.isfinite(answer).all():
            raise SolverError(SINGULAR)
        return answer[:, :-1], answer[:, -1]
