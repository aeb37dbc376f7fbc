"""The layout of a step's QP: which columns and rows there are, built once from the truss, the curve and the task."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.problem.method import Weights
from vgtm_qp.truss.kinematics import member_nodes
from vgtm_qp.truss.truss import Truss

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Layout:
    """Index maps of one arm with one curve and one tip task; everything here is constant over a maneuver.

    Attributes
    ----------
    truss : Truss
    curve_weights, curve_slopes : (K, V)
        w_i(s_k) and w_i'(s_k) at the curve nodes; V = 0 where there is no curve.
    tracked : (K,) int
        The faces that track them.
    tip_rows : tuple of str
        Names of the end effector's coordinates.
    hard_tracking : bool
        Position tracking as an equality instead of a penalty.
    elastic_tip : bool
        The end effector's rows may give way at an exact penalty.
    weights : Weights
    """

    truss: Truss
    curve_weights: Array
    curve_slopes: Array
    tracked: Index
    tip_rows: tuple[str, ...]
    weights: Weights
    hard_tracking: bool = False
    elastic_tip: bool = False

    @cached_property
    def node_column(self) -> Index:
        """(N,) first column of each free node's displacement; -1 for base nodes."""
        column = np.full(self.truss.node_count, -1, dtype=np.int64)
        column[self.truss.free] = 3 * np.arange(len(self.truss.free))
        return column

    @property
    def node_columns(self) -> int:
        """Number of node displacement coordinates, 3 (N - N_c)."""
        return 3 * len(self.truss.free)

    @property
    def vertices(self) -> int:
        """Number of control vertices V."""
        return int(self.curve_weights.shape[1])

    @cached_property
    def member_nodes(self) -> Index:
        """(M, Q) nodes that each member's length depends on."""
        return member_nodes(self.truss)

    @property
    def has_tip_frame(self) -> bool:
        """Whether the end effector has an orientation: its tip has three nodes or more."""
        return len(self.truss.tip) >= 3

    @cached_property
    def polygon_bending(self) -> Array:
        """(V, V) D'D with D the second difference of the control vertices."""
        second = np.diff(np.eye(self.vertices), n=2, axis=0) if self.vertices > 2 else np.zeros((0, self.vertices))
        return np.asarray(second.T @ second)

    @cached_property
    def fixed(self) -> Index:
        """(n_l,) indices of the fixed members."""
        return np.flatnonzero(~self.truss.actuated)

    @cached_property
    def length_scatter(self) -> tuple[Index, Index, Index]:
        """Return (member, flat position in the gradient, column) of every entry of the length Jacobian."""
        columns = self.node_column[self.member_nodes]
        member, slot = np.nonzero(columns >= 0)
        axis = np.arange(3)
        flat = ((member * columns.shape[1] + slot)[:, None] * 3 + axis).ravel()
        column = (columns[member, slot][:, None] + axis).ravel()
        return np.repeat(member, 3), flat, column

    def length_jacobian(self, gradient: Array, out: Array | None = None) -> Array:
        """Return the dense length Jacobian (M, 3 (N - N_c)), eq. (24) and its actuated rows, from member gradients."""
        member, flat, column = self.length_scatter
        if out is None:
            out = np.zeros((self.truss.member_count, self.node_columns))
        values = gradient.reshape(-1)[flat]
        if self._has_shared_entries:
            out[:] = 0.0
            np.add.at(out, (member, column), values)
        else:
            out[member, column] = values
        return out

    @cached_property
    def _has_shared_entries(self) -> bool:
        """Whether a member names one node twice, as offset joints do; its gradients then add up."""
        member, _, column = self.length_scatter
        return len(np.unique(member * self.node_columns + column)) < len(member)

    @cached_property
    def _is_base_entry(self) -> Array:
        return (self.node_column[self.member_nodes] < 0).astype(float)

    def base_length_rate(self, gradient: Array, displacement: Array) -> Array:
        """Return (M,) what a displacement (N, 3) of the base nodes alone does to the lengths, eq. (23) negated."""
        moved = displacement[self.member_nodes] * self._is_base_entry[..., None]
        return np.asarray(np.einsum("mqc,mqc->m", gradient, moved))
