"""Kinematics of a truss by CasADi: lengths, face frames, tip pose and their Jacobians (paper, section 3.3).

One member and one face are written as CasADi graphs, differentiated by CasADi, mapped over the truss and compiled.
"""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from vgtm_qp.arm.truss.joints import Array, Index
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


def face_frame(nodes: ca.SX, cosines: ca.SX, sines: ca.SX, sense: ca.SX | float = 1.0) -> ca.SX:
    """Return the rotation (3, 3) that fits the reference polygon with the given polar angles best to (3, K) `nodes`.

    z is the unit area vector; x is the closed solution of the two-dimensional orthogonal Procrustes problem in the
    plane normal to it. No node is preferred, so a variable triangle gains no false authority over roll.
    `sense` is -1 where the nodes are named the other way round.
    """
    count = nodes.shape[1]
    centred = nodes - ca.repmat(ca.sum2(nodes) / count, 1, count)
    area, x = ca.SX.zeros(3), ca.SX.zeros(3)
    for j in range(count):
        area += ca.cross(centred[:, j], centred[:, (j + 1) % count])
    z = area * (sense / ca.norm_2(area))
    for j in range(count):
        x += cosines[j] * centred[:, j] + sines[j] * ca.cross(centred[:, j], z)
    x -= z * ca.dot(z, x)
    x *= 1.0 / ca.norm_2(x)
    return ca.horzcat(x, ca.cross(z, x), z)


def frame_function(count: int) -> ca.Function:
    """Return (nodes (3, K), cosines, sines, alignment) -> rotation R (3, 3) and spin S (3, 3K), dR = [S d nodes]x R."""
    nodes, cosines, sines = (
        ca.SX.sym("nodes", 3, count),
        ca.SX.sym("cosines", count),
        ca.SX.sym("sines", count),
    )
    alignment = ca.SX.sym("alignment", 3, 3)
    fitted = face_frame(nodes, cosines, sines)
    spin = ca.SX.zeros(3, 3 * count)
    for c in range(3):
        spin += ca.skew(fitted[:, c]) @ ca.jacobian(fitted[:, c], ca.vec(nodes)) / 2
    return ca.Function("frame", [nodes, cosines, sines, alignment], [fitted @ alignment, ca.densify(spin)])


def frame_constants(home: Array, rotation: Array) -> tuple[Array, Array, Array]:
    """Return the polar angles' cosines and sines, and the alignment that makes the frame at `home` equal `rotation`."""
    centred = home - home.mean(axis=0)
    normal = np.sum(np.cross(centred, np.roll(centred, -1, axis=0)), axis=0)
    normal /= np.linalg.norm(normal)
    first = rotation[:, 0] - normal * (normal @ rotation[:, 0])
    if np.linalg.norm(first) < 1e-6:
        first = centred[0]
    first = first / np.linalg.norm(first)
    second = np.cross(normal, first)
    angles = np.arctan2(centred @ second, centred @ first)
    return np.cos(angles), np.sin(angles), np.stack([first, second, normal], axis=0) @ rotation


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
    ends = [
        nodes[:, 3 * e] + joint_frame(*(nodes[:, 3 * e + c] for c in range(3))) @ offsets[:, e]
        for e in range(2)
    ]
    length = ca.norm_2(ends[0] - ends[1])
    return ca.Function("member", [nodes, offsets], [length, ca.gradient(length, nodes)])


def member_nodes(truss: Truss) -> Index:
    """Return (M, Q) the nodes that each member's length depends on: two for pin joints, six for offset joints."""
    if truss.joints is None:
        return truss.members
    return truss.joints.triangle[truss.members].reshape(truss.member_count, 6)


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
        """Overwrite ends and Jacobians with those at node positions `X` (N, 3), m."""
        self._kernel.inputs[0][:] = X[self.nodes].reshape(-1)
        self._kernel()


class Kinematics:
    """Everything the QP needs of the truss at one configuration, in arrays that are overwritten by `evaluate`.

    Attributes
    ----------
    lengths : (M,)
        Member lengths, m.
    gradient : (M, Q, 3)
        d length / d (positions of ``member_nodes``).
    face_rotation, face_spin : (F, 3, 3), (F, 3, 9)
        Face frames and their angular-velocity rows with respect to the face's nodes.
    tip_rotation, tip_spin : (3, 3), (3, 3K)
        The same for the end effector; identity and empty where the tip has fewer than three nodes.
    """

    def __init__(self, truss: Truss, *, compiled: bool = True) -> None:
        self.truss = truss
        self.member_nodes = member_nodes(truss)
        self.has_tip_frame = len(truss.tip) >= 3
        self._kernel = Kernel(_whole(truss), compiled=compiled)
        self._compiled = compiled
        outputs = self._kernel.outputs
        members, faces, tips = truss.member_count, len(truss.faces), len(truss.tip)
        self.lengths = outputs[0]
        self.gradient = outputs[1].reshape(members, -1, 3)
        self.face_rotation = outputs[2].reshape(faces, 3, 3).transpose(0, 2, 1)
        self.face_spin = outputs[3].reshape(faces, 9, 3).transpose(0, 2, 1)
        self.tip_rotation = outputs[4].reshape(3, 3).T if self.has_tip_frame else np.eye(3)
        self.tip_spin = outputs[5].reshape(3 * tips, 3).T if self.has_tip_frame else np.zeros((3, 3 * tips))

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

    def evaluate_members(self, X: Array) -> None:
        """Overwrite lengths, gradient and tip alone, at a quarter of the cost for a long arm; `X` (N, 3), m."""
        kernel = self._without_faces
        kernel.inputs[0][:] = X.reshape(-1)
        kernel()

    def face_centres(self, X: Array) -> Array:
        """Return (F, 3) the points of the arm's axis that the faces stand for, m."""
        return np.asarray(np.einsum("fk,fkc->fc", self.truss.face_weights, X.take(self.truss.faces, axis=0)))

    def tip_position(self, X: Array) -> Array:
        """Return (3,) the position of the end effector, m."""
        return np.asarray(self.truss.tip_weights @ X[self.truss.tip])


def _whole(truss: Truss, *, faces: bool = True) -> ca.Function:
    """Return positions (3, N) -> member lengths and gradients, face frames and spins, tip frame and spin."""
    X = ca.MX.sym("X", 3, truss.node_count)
    nodes = member_nodes(truss)
    columns = X[:, nodes.reshape(-1).tolist()]
    member = member_function(truss).map(truss.member_count)
    if truss.joints is None:
        lengths, gradients = member(columns)
    else:
        lengths, gradients = member(columns, ca.DM(truss.joints.offset.reshape(-1, 3).T))

    face_count = len(truss.faces) if faces else 0
    face_results = _frames(
        truss.home[truss.faces[:face_count]], truss.face_frames[:face_count], X, truss.faces
    )
    tip_count = 1 if len(truss.tip) >= 3 else 0
    tip = _frames(truss.home[truss.tip][None][:tip_count], truss.tip_frame[None], X, truss.tip[None])
    return ca.Function("truss" if faces else "members", [X], [lengths, gradients, *face_results, *tip])


def _frames(home: Array, rotations: Array, X: ca.MX, nodes: Index) -> list[ca.MX]:
    """Return rotations (3, 3F) and spins (3, 3KF) of F faces with K nodes each."""
    if not len(home):
        return [ca.MX(0, 0), ca.MX(0, 0)]
    constants = [frame_constants(points, rotation) for points, rotation in zip(home, rotations, strict=False)]
    cosines, sines, alignments = (np.stack(column) for column in zip(*constants, strict=True))
    function = frame_function(home.shape[1]).map(len(home))
    arguments = [ca.DM(cosines.T), ca.DM(sines.T), ca.DM(np.concatenate(alignments, axis=1))]
    return list(function(X[:, nodes[: len(home)].reshape(-1).tolist()], *arguments))
