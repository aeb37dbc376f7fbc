"""The sparse form of eq. (28): its KKT system, banded once and for all by the order of the bays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg.lapack import dgbsv
from scipy.sparse.csgraph import reverse_cuthill_mckee

from vgtm_qp.errors import SolverError

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class BandedSystem:
    """A square sparse system of constant pattern, ordered to a narrow band, whose values change.

    Parameters
    ----------
    rows, columns : (E,) int
        Place of each entry; entries of one place are added up.
    size : int
        Number of unknowns.
    """

    def __init__(self, rows: Index, columns: Index, size: int) -> None:
        pattern = sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(size, size))
        order = reverse_cuthill_mckee(sparse.csr_array(pattern + pattern.T), symmetric_mode=True)
        place = np.empty(size, dtype=np.int64)
        place[order] = np.arange(size)
        i, j = place[rows], place[columns]
        self.size = size
        self.lower = int(np.max(i - j, initial=0))
        self.upper = int(np.max(j - i, initial=0))
        self._order = order
        self._height = 2 * self.lower + self.upper + 1
        self._flat = (self.lower + self.upper + i - j) * size + j

    def solve(self, values: Array, rhs: Array) -> Array:
        """Return the solution (size,) for entries `values` (E,) in the order of `rows`, by LU with pivoting.

        Raises
        ------
        SolverError
            The matrix is singular to working precision.
        """
        band = np.bincount(self._flat, weights=values, minlength=self._height * self.size)
        factors, _, solution, info = dgbsv(
            self.lower, self.upper, band.reshape(self._height, self.size), rhs[self._order]
        )
        pivots = np.abs(factors[self.lower + self.upper])
        if info != 0 or not float(pivots.min()) > 1e-14 * float(pivots.max()):
            raise SolverError("the KKT matrix of eq. (28) is singular to working precision")
        x = np.empty(self.size)
        x[self._order] = solution
        return x
