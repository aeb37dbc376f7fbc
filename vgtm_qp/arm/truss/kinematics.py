"""Kinematics of a truss by CasADi: lengths, face frames, tip pose and their Jacobians (paper, section 3.3).

One member and one face are written as CasADi graphs, differentiated by CasADi, mapped over the truss and compiled.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from vgtm_qp.arm.truss.joints import Array, Index, Joints
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.compiled import Kernel


def joint_frame(node: ca.SX, first: ca.SX, second: ca.SX) -> ca.SX:
    """Return the (3, 3) rotation of an offset joint from its triangle's nodes (see ``truss.Joints``).

    z is the triangle's normal, x the outward bisector of the two members that meet at the node.
    """
    to_first = (first - node) / ca.norm_2(first - node)
    to_second = (second - node) / ca.norm_2(second - node)
    z = ca.cross(to_first, to_second)
    z /= ca.norm_2(z)
    x = -(to_first + to_second)
    x /= ca.norm_2(x)
    return ca.horzcat(x, ca.cross(z, x), z)


def member_function(truss: Truss) -> ca.Function:
    """Return one member as a CasADi function: its nodes' positions and end offsets -> length and gradient.

    Ideal pin joints: (3, 2) positions of the two nodes. Offset joints, eqs. (12)-(13): (3, 6) positions of both
    joints' triangles and (3, 2) offsets in the joint frames.
    """
    if truss.joints is None:
        nodes = ca.SX.sym("nodes", 3, 2)
        length = ca.norm_2(nodes[:, 0] - nodes[:, 1])
        return ca.Function("member", [nodes], [length, ca.gradient(length, nodes)])
    nodes, offsets = ca.SX.sym("nodes", 3, 6), ca.SX.sym("offsets", 3, 2)
    length = ca.norm_2(_end(nodes[:, :3], offsets[:, 0]) - _end(nodes[:, 3:], offsets[:, 1]))
    return ca.Function("member", [nodes, offsets], [length, ca.gradient(length, nodes)])


def length_gradients(truss: Truss, X: Array) -> Array:
    """Return (M, Q, 3) the gradients of the lengths by the nodes of ``Truss.member_nodes`` at positions `X` (N, 3)."""
    arguments = [X[truss.member_nodes].reshape(-1, 3).T]
    if truss.joints is not None:
        arguments.append(truss.joints.offset.reshape(-1, 3).T)
    _, gradients = member_function(truss).map(truss.member_count)(*arguments)
    return np.asarray(gradients).T.reshape(truss.member_count, -1, 3)


def _end(corners: ca.SX, offset: ca.SX) -> ca.SX:
    """Return a member's end at `offset` (3,) in the joint at `corners` (3, 3), see ``joints.joint_ends``."""
    return corners[:, 0] + joint_frame(*ca.horzsplit(corners)) @ offset


class EndKinematics:
    """The ends r_ik of members in offset joints and their Jacobians, eqs. (13), (20) and (21), at one configuration.

    Attributes
    ----------
    nodes : (M, 2, 3) int
        The triangle that places each end, its own node first.
    ends : (M, 2, 3)
        m; overwritten by `evaluate`, as is the next.
    jacobian : (M, 2, 3, 9)
        d end / d (positions of ``nodes``).
    """

    def __init__(self, members: Index, joints: Joints, *, compiled: bool = True) -> None:
        self.nodes = joints.triangle[members]
        corners, offset = ca.SX.sym("corners", 3, 3), ca.SX.sym("offset", 3)
        end = _end(corners, offset)
        one = ca.Function("end", [corners, offset], [end, ca.densify(ca.jacobian(end, ca.vec(corners)))])
        self._kernel = Kernel(one.map(2 * len(members)), compiled=compiled)
        self._kernel.inputs[1][:] = joints.offset.reshape(-1)
        self.ends = self._kernel.outputs[0].reshape(-1, 2, 3)
        self.jacobian = self._kernel.outputs[1].reshape(-1, 2, 9, 3).transpose(0, 1, 3, 2)

    def evaluate(self, X: Array) -> None:
        """Overwrite ends and Jacobians with those at node positions `X` (N, 3), m."""
        self._kernel.inputs[0][:] = X[self.nodes].reshape(-1)
        self._kernel()
