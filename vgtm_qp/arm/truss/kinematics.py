"""Kinematics of a truss by CasADi: lengths, face frames, tip pose and their Jacobians (paper, section 3.3).

One member and one face are written as CasADi graphs, differentiated by CasADi, mapped over the truss and compiled.
"""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from vgtm_qp.arm.frames import frames_at
from vgtm_qp.arm.truss.joints import Array
from vgtm_qp.arm.truss.lengths import LengthRows
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.compiled import Kernel
from vgtm_qp.errors import TrussError


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
    """Return a member as a CasADi function: nodes and end offsets -> length, eq. (12), and gradient, eq. (19).

    Ideal pin joints: (3, 2) positions of the two nodes. Offset joints, eq. (13): (3, 6) positions of both
    joints' triangles and (3, 2) offsets in the joint frames.
    """
    if truss.joints is None:
        nodes = ca.SX.sym("nodes", 3, 2)
        length = ca.norm_2(nodes[:, 0] - nodes[:, 1])
        return ca.Function("member", [nodes], [length, ca.gradient(length, nodes)])
    nodes, offsets = ca.SX.sym("nodes", 3, 6), ca.SX.sym("offsets", 3, 2)
    ends = [
        nodes[:, 3 * e] + joint_frame(*(nodes[:, 3 * e + c] for c in range(3))) @ offsets[:, e]
        for e in range(2)
    ]
    length = ca.norm_2(ends[0] - ends[1])
    return ca.Function("member", [nodes, offsets], [length, ca.gradient(length, nodes)])


_FEW_FACES = 20
"""Another compiled function without the faces does not pay for so few."""


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

    def __init__(self, truss: Truss, *, compiled: bool = True) -> None:
        if truss.joints is None:
            raise TrussError("this truss has pin joints: its members end in the nodes")
        self.nodes = truss.joints.triangle[truss.members]
        corners, offset = ca.SX.sym("corners", 3, 3), ca.SX.sym("offset", 3)
        end = corners[:, 0] + joint_frame(*(corners[:, c] for c in range(3))) @ offset
        one = ca.Function("end", [corners, offset], [end, ca.densify(ca.jacobian(end, ca.vec(corners)))])
        count = 2 * truss.member_count
        self._kernel = Kernel(one.map(count), compiled=compiled)
        self._kernel.inputs[1][:] = truss.joints.offset.reshape(-1)
        self.ends = self._kernel.outputs[0].reshape(-1, 2, 3)
        self.jacobian = self._kernel.outputs[1].reshape(-1, 2, 9, 3).transpose(0, 1, 3, 2)

    def evaluate(self, X: Array) -> None:
        """Overwrite ends and their Jacobians, eqs. (20)-(21), with those at node positions `X` (N, 3), m."""
        self._kernel.inputs[0][:] = X[self.nodes].reshape(-1)
        self._kernel()


class TrussKinematics:
    """A truss at one configuration, in arrays that are overwritten by `evaluate`; see ``arm.Kinematics``.

    Attributes
    ----------
    quantities : (M,)
        Member lengths, m.
    gradient : (M, Q, 3)
        d length / d (positions of ``Truss.member_nodes``).
    station_rotation, station_spin : (F, 3, 3), (F, 3, 9)
        Face frames and their angular-velocity rows with respect to the face's nodes.
    tip_rotation, tip_spin : (3, 3), (3, 3K)
        The same for the end effector; identity and zeros where the tip has fewer than three nodes.
    """

    def __init__(self, truss: Truss, *, compiled: bool = True) -> None:
        self.truss = truss
        self._compiled = compiled
        self._kernel = Kernel(_whole(truss), compiled=compiled)
        outputs = self._kernel.outputs
        members, faces, tips = truss.member_count, len(truss.faces), len(truss.tip)
        has_tip_frame = tips >= 3
        self.quantities = outputs[0]
        self.gradient = outputs[1].reshape(members, -1, 3)
        self.station_rotation = outputs[2].reshape(faces, 3, 3).transpose(0, 2, 1)
        self.station_spin = outputs[3].reshape(faces, 9, 3).transpose(0, 2, 1)
        self.tip_rotation = outputs[4].reshape(3, 3).T if has_tip_frame else np.eye(3)
        self.tip_spin = outputs[5].reshape(3 * tips, 3).T if has_tip_frame else np.zeros((3, 3 * tips))

    def evaluate(self, X: Array) -> None:
        """Overwrite every attribute with its value at node positions `X` (N, 3), m."""
        self._kernel.inputs[0][:] = X.reshape(-1)
        self._kernel()

    @cached_property
    def _without_faces(self) -> Kernel:
        """The same without the faces, writing to the same arrays."""
        kernel = Kernel(_whole(self.truss, faces=False), compiled=self._compiled)
        for k in (0, 1, 4, 5):
            kernel.bind_output(k, self._kernel.outputs[k])
        return kernel

    def evaluate_quantities(self, X: Array) -> None:
        """Overwrite lengths, gradient and tip alone, at a quarter of the cost for a long arm; `X` (N, 3), m."""
        kernel = self._kernel if len(self.truss.faces) <= _FEW_FACES else self._without_faces
        kernel.inputs[0][:] = X.reshape(-1)
        kernel()

    def motion(self) -> LengthRows:
        """Return how the nodes move at the configuration evaluated last; see ``arm.Kinematics``."""
        return LengthRows(self.truss, self.gradient.copy(), np.zeros(self.truss.member_count))


def _whole(truss: Truss, *, faces: bool = True) -> ca.Function:
    """Return positions (3, N) -> member lengths and gradients, face frames and spins, tip frame and spin."""
    X = ca.MX.sym("X", 3, truss.node_count)
    columns = X[:, truss.member_nodes.reshape(-1).tolist()]
    member = member_function(truss).map(truss.member_count)
    if truss.joints is None:
        lengths, gradients = member(columns)
    else:
        lengths, gradients = member(columns, ca.DM(truss.joints.offset.reshape(-1, 3).T))
    shown = truss.faces if faces else truss.faces[:0]
    frames = frames_at(X, truss.home[shown], truss.face_frames[: len(shown)], shown)
    tips = truss.tip[None] if len(truss.tip) >= 3 else truss.tip[None][:0]
    tip = frames_at(X, truss.home[tips], truss.tip_frame[None][: len(tips)], tips)
    return ca.Function("truss" if faces else "members", [X], [lengths, gradients, *frames, *tip])
