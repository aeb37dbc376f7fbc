"""Where the numbers of the length Jacobian stand, eq. (24)."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy import sparse

from vgtm_qp.arrays import Array, Index


class LengthScatter:
    """Where the gradients of a truss's lengths stand in its length Jacobian.

    Attributes
    ----------
    member, flat, column : (E,) int
        Row, place in the flattened gradient (M, Q, 3), and column of every entry; a member in offset joints may have
        two entries in one place, which add up.
    shape : (M, 3 (N - N_c))
    """

    def __init__(self, member_nodes: Index, free: Index, node_count: int) -> None:
        first = np.full(node_count, -1, dtype=np.int64)
        first[free] = 3 * np.arange(len(free))
        columns = first[member_nodes]
        member, slot = np.nonzero(columns >= 0)
        axis = np.arange(3)
        self.member: Index = np.repeat(member, 3)
        self.flat: Index = ((member * columns.shape[1] + slot)[:, None] * 3 + axis).ravel()
        self.column: Index = (columns[member, slot][:, None] + axis).ravel()
        self.shape = len(member_nodes), 3 * len(free)
        self._is_base = (columns < 0).astype(float)
        self._nodes = member_nodes

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
        """Return the same as a sparse matrix."""
        return sparse.csc_matrix(
            (gradient.reshape(-1)[self.flat], (self.member, self.column)), shape=self.shape
        )

    def base_rate(self, gradient: Array, displacement: Array) -> Array:
        """Return (M,) what a displacement (N, 3) of the base nodes alone does to the lengths, eq. (23) negated."""
        moved = displacement[self._nodes] * self._is_base[..., None]
        return np.asarray(np.einsum("mqc,mqc->m", gradient, moved))
