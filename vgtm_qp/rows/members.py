"""Rows of members: ends, lengths and their gradients, and the length Jacobian, eqs. (12)-(15) and (19)-(24).

Functions that are mapped over members are in symbols. The ends of all members exist in arrays as well, so
that an accepted state can be measured by code that did not make it.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from scipy import sparse

from vgtm_qp.arrays import Array, Index, Mask


def joint_frame(node: ca.SX, first: ca.SX, second: ca.SX) -> ca.SX:
    """Return the (3, 3) rotation of an offset joint from its own node (3,) and the two others of its triangle.

    z is the triangle's normal, x the outward bisector of the two members that meet at the node.
    """
    to_first, to_second = _unit(first - node), _unit(second - node)
    z, x = _unit(ca.cross(to_first, to_second)), _unit(-(to_first + to_second))
    return ca.horzcat(x, ca.cross(z, x), z)


def _unit(vector: ca.SX) -> ca.SX:
    return vector / ca.norm_2(vector)


def member_end(corners: ca.SX, offset: ca.SX) -> ca.SX:
    """Return a member's end r_ik (3,), eq. (13), at `offset` (3,), m, in the joint at `corners` (3, 3)."""
    return corners[:, 0] + joint_frame(*ca.horzsplit(corners)) @ offset


def length(first: ca.SX, second: ca.SX) -> ca.SX:
    """Return the length of a member from its two ends (3,), eq. (12), m."""
    return ca.norm_2(first - second)


def member_function(*, has_offsets: bool) -> ca.Function:
    """Return a member as a CasADi function: nodes (and end offsets) -> length, m, and its gradient, eq. (19).

    Ideal pin joints: (3, 2) positions of the two nodes. Offset joints: (3, 6) positions of both joints' triangles
    and (3, 2) offsets in the joint frames.
    """
    nodes = ca.SX.sym("nodes", 3, 6 if has_offsets else 2)
    if not has_offsets:
        found = length(nodes[:, 0], nodes[:, 1])
        return ca.Function("member", [nodes], [found, ca.gradient(found, nodes)])
    offsets = ca.SX.sym("offsets", 3, 2)
    found = length(member_end(nodes[:, :3], offsets[:, 0]), member_end(nodes[:, 3:], offsets[:, 1]))
    return ca.Function("member", [nodes, offsets], [found, ca.gradient(found, nodes)])


def member_end_function() -> ca.Function:
    """Return (corners (3, 3), offset (3,)) -> a member's end (3,) and its Jacobian (3, 9), eqs. (20) and (21)."""
    corners, offset = ca.SX.sym("corners", 3, 3), ca.SX.sym("offset", 3)
    end = member_end(corners, offset)
    return ca.Function("end", [corners, offset], [end, ca.densify(ca.jacobian(end, ca.vec(corners)))])


def joint_frames(X: Array, triangle: Index) -> Array:
    """Return (N, 3, 3) joint frames as :func:`joint_frame` in arrays: of triangles (N, 3) of nodes `X` (N, 3), m."""
    corner = X[triangle]
    first, second = _units(corner[:, 1] - corner[:, 0]), _units(corner[:, 2] - corner[:, 0])
    z, x = _units(np.cross(first, second)), _units(-(first + second))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def _units(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def member_ends(X: Array, members: Index, triangle: Index, offset: Array) -> Array:
    """Return (M, 2, 3) the ends of members (M, 2) in offset joints, m, as :func:`member_end` in arrays.

    `triangle` (N, 3) are the nodes that orient each node's joint, `offset` (M, 2, 3) the ends in those frames.
    """
    return np.asarray(X[members] + np.einsum("mexy,mey->mex", joint_frames(X, triangle)[members], offset))


def length_nodes(members: Index, triangle: Index | None) -> Index:
    """Return (M, Q) nodes that each length depends on, eq. (15): two for pin joints, six for offset joints.

    `members` (M, 2) are the nodes of each member; see :func:`member_ends` for `triangle`, None for pin joints.
    """
    return members if triangle is None else triangle[members].reshape(len(members), 6)


def fixed_error(lengths: Any, home: Any, actuated: Mask) -> Any:
    """Return (M, 1) the length errors of fixed members, eq. (14), m; zero for actuated ones."""
    return ca.DM((~actuated).astype(float)) * (home - lengths)


def length_rhs(error: Any, gradients: Any, moved: Any, nodes: Index) -> Any:
    """Return (M, 1) the right-hand sides of J d_rho - E d_a = rhs, eq. (22) beside the actuated members' rows, m.

    The length errors `error` (M, 1) less the changes by the base's displacement `moved` (3, N). `gradients` (3 Q M, 1)
    are those of the lengths by their nodes (M, Q).
    """
    terms = gradients * ca.vec(moved[:, nodes.reshape(-1).tolist()])
    return error - ca.sum1(ca.reshape(terms, 3 * nodes.shape[1], len(nodes))).T


class LengthScatter:
    """Where the gradients of the lengths by their nodes (M, Q) stand in the length Jacobian of N nodes.

    Attributes
    ----------
    member, flat, column : (E,) int
        Row, place in the flattened gradient (M, Q, 3), and column of every entry; a member in offset joints may have
        two entries in one place, which add up.
    shape : (M, 3 (N - N_c))
    """

    def __init__(self, nodes: Index, free: Index, node_count: int) -> None:
        first = np.full(node_count, -1, dtype=np.int64)
        first[free] = 3 * np.arange(len(free))
        columns = first[nodes]
        member, slot = np.nonzero(columns >= 0)
        axis = np.arange(3)
        self.member: Index = np.repeat(member, 3)
        self.flat: Index = ((member * columns.shape[1] + slot)[:, None] * 3 + axis).ravel()
        self.column: Index = (columns[member, slot][:, None] + axis).ravel()
        self.shape = len(nodes), 3 * len(free)
        self._is_base = (columns < 0).astype(float)
        self._nodes = nodes

    @cached_property
    def _adds_up(self) -> bool:
        return len(np.unique(self.member * self.shape[1] + self.column)) < len(self.member)

    def dense(self, gradient: Array, out: Array | None = None) -> Array:
        """Return the dense length Jacobian, eq. (24) and its actuated rows, from member gradients (M, Q, 3)."""
        if out is None:
            out = np.zeros(self.shape)
        values = gradient.reshape(-1)[self.flat]
        if self._adds_up:
            out[:] = 0.0
            np.add.at(out, (self.member, self.column), values)
        else:
            out[self.member, self.column] = values
        return out

    def sparse(self, gradient: Array) -> sparse.csc_matrix:
        """Return the length Jacobian of :meth:`dense` as a sparse matrix."""
        return sparse.csc_matrix(
            (gradient.reshape(-1)[self.flat], (self.member, self.column)), shape=self.shape
        )

    def base_rate(self, gradient: Array, displacement: Array) -> Array:
        """Return (M,) the changes of the lengths by a displacement (N, 3) of the base nodes alone, eq. (23) negated."""
        moved = displacement[self._nodes] * self._is_base[..., None]
        return np.asarray(np.einsum("mqc,mqc->m", gradient, moved))
