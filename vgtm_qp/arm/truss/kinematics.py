"""Rows of all members of a truss at one configuration, and how nodes follow."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from scipy.sparse.linalg import splu

from vgtm_qp.arm.symbols import Bound, Constants
from vgtm_qp.arm.truss.joints import Joints
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.arrays import Array, Index
from vgtm_qp.compiled import Kernel
from vgtm_qp.errors import SolverError
from vgtm_qp.rows.members import member_end, member_end_function, member_function

_DENSE = 150
"""Greatest number of node coordinates for which dense LAPACK is faster than a sparse factorisation."""

SINGULAR = "the length Jacobian is singular: the truss is in a singular pose"


def length_gradients(truss: Truss, X: Array) -> Array:
    """Return (M, Q, 3) the gradients of the lengths by the nodes of ``Truss.member_nodes`` at positions `X` (N, 3)."""
    arguments = [X[truss.member_nodes].reshape(-1, 3).T]
    if truss.joints is not None:
        arguments.append(truss.joints.offset.reshape(-1, 3).T)
    function = member_function(has_offsets=truss.joints is not None)
    _, gradients = function.map(truss.member_count)(*arguments)
    return np.asarray(gradients).T.reshape(truss.member_count, -1, 3)


def place_function(truss: Truss) -> Bound:
    """Return the function from nodes (3, N) to the ends (3, 2 M) of all members in offset joints, m."""
    assert truss.joints is not None
    constants, X = Constants(), ca.MX.sym("X", 3, truss.node_count)
    corners, offset = ca.SX.sym("corners", 3, 3), ca.SX.sym("offset", 3)
    end = ca.Function("end", [corners, offset], [member_end(corners, offset)])
    nodes = truss.joints.triangle[truss.members].reshape(-1).tolist()
    offsets = constants.add("offsets", truss.joints.offset.reshape(-1, 3))
    return constants.bound("ends", [X], [end.map(2 * truss.member_count)(X[:, nodes], offsets)])


class EndKinematics:
    """The Jacobians of the ends r_ik of members in offset joints, at one configuration.

    Attributes
    ----------
    nodes : (M, 2, 3) int
        The triangle that places each end, its own node first.
    jacobian : (M, 2, 3, 9)
        d end / d (positions of ``nodes``); overwritten by `evaluate`.
    """

    def __init__(self, members: Index, joints: Joints) -> None:
        self.nodes = joints.triangle[members]
        self._kernel = Kernel(member_end_function().map(2 * len(members)))
        self._kernel.inputs[1][:] = joints.offset.reshape(-1)
        self.jacobian = self._kernel.outputs[1].reshape(-1, 2, 9, 3).transpose(0, 1, 3, 2)

    def evaluate(self, X: Array) -> None:
        """Overwrite the Jacobians with those at node positions `X` (N, 3), m."""
        self._kernel.inputs[0][:] = X[self.nodes].reshape(-1)
        self._kernel()


class LengthRows:
    """J d_rho - E d_a = rhs for the actuated members beside the fixed ones; see ``arm.MotionRows``.

    Eqs. (22)-(24). J has the gradients (M, Q, 3); `rhs` (M,) is in m.
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
        answer = solved(self._matrix(), known)
        return answer[:, :-1], answer[:, -1]

    def over_actuators(self, rows: Array) -> Array:
        """Return the rows times K by J' y = row'; see ``arm.MotionRows``."""
        return np.ascontiguousarray(solved(self._matrix().T, rows.T)[self.truss.actuators].T)

    def _matrix(self) -> Any:
        """Return the length Jacobian, dense if it is small."""
        truss = self.truss
        return self.jacobian() if truss.member_count <= _DENSE else truss.scatter.sparse(self.gradient)


def solved(jacobian: Any, known: Array) -> Array:
    """Return the solution for the length Jacobian or its transpose, dense or sparse; SolverError in a singular pose."""
    try:
        if isinstance(jacobian, np.ndarray):
            answer = np.asarray(np.linalg.solve(jacobian, known), dtype=float)
        else:
            answer = np.asarray(splu(jacobian.tocsc()).solve(known), dtype=float)
    except (np.linalg.LinAlgError, RuntimeError) as reason:
        raise SolverError(SINGULAR) from reason
    if not np.isfinite(answer).all():
        raise SolverError(SINGULAR)
    return answer
