"""Newton's step on lengths of members and places of stations: displacements for given changes."""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.linalg.lapack import dgbsv

from vgtm_qp.arm.arm import Bays
from vgtm_qp.arm.truss.kinematics import SINGULAR, solved
from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import SolverError

WIDEST = 200
"""Number of diagonals from which on sparse LU is faster than banded LU."""


class LengthSolver:
    """Solves J d_rho = error with the length Jacobian J.

    Rows are sorted by their last column, which brings the nonzeros of an arm near the diagonal.

    Parameters
    ----------
    bays : Bays
    members : (m,) int, optional
        Members whose lengths are given; all by default.
    stations : (K, 3) int, (K, 3), optional
        Nodes and weights of stations whose displacements are given too.
    """

    def __init__(
        self,
        bays: Bays,
        members: Index | None = None,
        stations: tuple[Index, Array] | None = None,
    ) -> None:
        scatter, size = bays.scatter, bays.scatter.shape[1]
        members = np.arange(bays.member_count) if members is None else members
        row = np.full(bays.member_count, -1, dtype=np.int64)
        row[members] = np.arange(len(members))
        kept = np.flatnonzero(row[scatter.member] >= 0)
        self._flat, self._weights = scatter.flat[kept], np.zeros(0)
        rows, columns = row[scatter.member[kept]], scatter.column[kept]
        if stations is not None:
            place = np.full(bays.node_count, -1, dtype=np.int64)
            place[bays.free] = np.arange(len(bays.free))
            face, corner = np.nonzero(place[stations[0]] >= 0)
            node, axis = place[stations[0][face, corner]], np.arange(3)
            rows = np.concatenate([rows, (len(members) + 3 * face[:, None] + axis).ravel()])
            columns = np.concatenate([columns, (3 * node[:, None] + axis).ravel()])
            self._weights = np.repeat(stations[1][face, corner], 3)
        last = np.zeros(size, dtype=np.int64)
        np.maximum.at(last, rows, columns)
        self._order = np.argsort(last, kind="stable")
        rows = np.argsort(self._order)[rows]
        self._below, self._above = int((rows - columns).max()), int((columns - rows).max())
        # LAPACK's banded storage, by columns: its first rows are for the fill-in of pivoting.
        self._width, self._size = 2 * self._below + self._above + 1, size
        self._entry = columns * self._width + self._below + self._above + rows - columns
        self._places = rows, columns
        self._is_wide = self._below + self._above >= WIDEST

    def solve(self, gradient: Array, error: Array) -> Array:
        """Return displacements of the free nodes (N - N_c, 3), m.

        Parameters
        ----------
        gradient : (M, Q, 3)
            d length / d (positions of ``Bays.member_nodes``).
        error : (m + 3 K,)
            Wanted changes of the lengths, then displacements of the stations, m.

        Raises
        ------
        SolverError
            The pose is singular: lengths and stations do not determine the nodes.
        """
        values = np.concatenate([gradient.reshape(-1)[self._flat], self._weights])
        size, known = self._size, error[self._order]
        if not np.isfinite(values).all():
            raise SolverError(SINGULAR)
        if self._is_wide:
            return solved(sparse.csc_matrix((values, self._places), shape=(size, size)), known).reshape(-1, 3)
        band = np.bincount(self._entry, values, self._width * size).reshape(size, self._width).T
        step, failed = dgbsv(self._below, self._above, band, known, overwrite_ab=1, overwrite_b=1)[2:]
        if failed or not np.isfinite(step).all():
            raise SolverError(SINGULAR)
        return np.asarray(step).reshape(-1, 3)
