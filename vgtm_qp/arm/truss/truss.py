"""A truss as data: nodes, members, faces, tip, and the order of its bays (paper, section 3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from vgtm_qp.arm.truss.joints import Joints
from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.errors import TrussError, nearest
from vgtm_qp.rows.members import LengthScatter, length_nodes, member_ends


@dataclass(frozen=True, eq=False)
class Truss:
    """A statically determinate truss.

    Attributes
    ----------
    module : str
        Name of the module it was made from, or ``"graph"``.
    node_names, member_names : tuple of str
        Length N and M.
    home : (N, 3)
        Home positions of the nodes, m.
    base : (N,) bool
        True where a node is given, eq. (7); the others are the unknowns of eq. (9).
    members : (M, 2) int
        The two nodes of each member.
    actuated : (M,) bool
        True where a member changes its length.
    stroke : (M, 2)
        Least and greatest length, m; the home length twice where a member is fixed.
    rate, acceleration : (M,)
        Greatest |dl/dt|, m/s, and |d2l/dt2|, m/s^2, of actuated members; inf where there is no limit.
    radius : (M,)
        Radius of the capsule that bounds each member, m.
    faces : (F, 3) int
        The triangles that the curve's nodes are tracked by, the base face first; (0, 3) where there are none.
    face_weights : (F, 3)
        Weights whose mean of a face's nodes is the point on the arm's axis; thirds but for the tetrahedral module.
    face_frames : (F, 3, 3)
        Rotation of each face at home, columns x, y, z in the base frame; z along the arm.
    tip : (K,) int
        Nodes whose centroid is the end effector; with three or more it has a frame too.
    tip_weights : (K,)
        Weights of that centroid.
    tip_frame : (3, 3)
        Rotation of the end effector at home.
    stage : (N,) int
        The stage in which a node is placed, going out from the base: base nodes are in stage -1. Every member joins
        nodes of its own or earlier stages, and each stage has three members for each of its nodes where the truss
        allows it, so that the square length Jacobian is block lower triangular.
    trackable : tuple of str
        What every `face_stride`-th face of this truss can track at once, to first order: ``"position"``,
        ``"pointing"``, ``"orientation"``, each with those before it.
    face_stride : int
        1, or 2 where only every second face has the motions that `trackable` needs (the longeron module); the faces
        between can track a position as long as no orientation is asked for.
    joints : Joints or None
        Offset joints; None for ideal pin joints.
    """

    module: str
    node_names: tuple[str, ...]
    member_names: tuple[str, ...]
    home: Array
    base: Mask
    members: Index
    actuated: Mask
    stroke: Array
    rate: Array
    acceleration: Array
    radius: Array
    faces: Index
    face_weights: Array
    face_frames: Array
    tip: Index
    tip_weights: Array
    tip_frame: Array
    stage: Index
    trackable: tuple[str, ...] = ("position",)
    face_stride: int = 1
    joints: Joints | None = field(default=None)

    @property
    def node_count(self) -> int:
        """Number of nodes N."""
        return len(self.node_names)

    @property
    def member_count(self) -> int:
        """Number of members M, fixed and actuated."""
        return len(self.member_names)

    @cached_property
    def bays(self) -> int:
        """Number of bays: one before each face but the base, one a stage where there are no faces."""
        return len(self.faces) - 1 if len(self.faces) else int(self.stage.max()) + 1

    @cached_property
    def free(self) -> Index:
        """(N - N_c,) indices of the nodes that are unknowns, eqs. (9)-(10), in stage order."""
        free = np.flatnonzero(~self.base)
        return free[np.argsort(self.stage[free], kind="stable")]

    @cached_property
    def actuators(self) -> Index:
        """(n_a,) indices of the actuated members."""
        return np.flatnonzero(self.actuated)

    @cached_property
    def fixed(self) -> Index:
        """(n_l,) indices of the fixed members."""
        return np.flatnonzero(~self.actuated)

    @cached_property
    def member_nodes(self) -> Index:
        """(M, Q) nodes that each length depends on."""
        return length_nodes(self.members, None if self.joints is None else self.joints.triangle)

    @cached_property
    def scatter(self) -> LengthScatter:
        """Where the gradients of the lengths stand in the length Jacobian."""
        return LengthScatter(self.member_nodes, self.free, self.node_count)

    def member_ends(self, X: Array) -> Array:
        """Return (M, 2, 3) where each member's ends r_ik are for node positions `X` (N, 3), m."""
        if self.joints is None:
            return np.asarray(X[self.members])
        return member_ends(X, self.members, self.joints.triangle, self.joints.offset)

    @cached_property
    def home_lengths(self) -> Array:
        """(M,) member lengths at home, m, joint offsets included (nominal: between the nodes less the offsets)."""
        ends = self.member_ends(self.home)
        return np.asarray(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1))

    @cached_property
    def height(self) -> float:
        """Length of the axis from the base face to the tip at home, m: the reach of the arm in a straight pose."""
        centres = np.einsum("fk,fkc->fc", self.face_weights, self.home[self.faces])
        tip = self.tip_weights @ self.home[self.tip]
        start = centres if len(centres) else self.home[self.base].mean(axis=0, keepdims=True)
        return float(np.linalg.norm(np.diff(np.vstack([start, tip]), axis=0), axis=1).sum())

    def member(self, name: str) -> int:
        """Return the index of the member called `name`.

        Raises
        ------
        TrussError
            No member has that name.
        """
        try:
            return self.member_names.index(name)
        except ValueError:
            raise TrussError(f'no member is called "{name}"{nearest(name, self.member_names)}') from None


def check_stroke(name: str, length: float, stroke: Sequence[float]) -> None:
    """Refuse a home length, m, outside its stroke."""
    least, greatest = stroke
    if not least - 1e-9 <= length <= greatest + 1e-9:
        raise TrussError(
            f"the home length of member {name}, {length:g} m, is outside its stroke [{least:g}, {greatest:g}] m"
        )
