"""Newton's step on the lengths of members, and on the places of stations: displacements for given changes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import LinAlgError, solve_banded
from scipy.sparse.linalg import splu

from vgtm_qp.arm.arm import Bays
from vgtm_qp.errors import SolverError
from vgtm_qp.qp.layout import Layout

Array = NDArray[np.float64]
Index = NDArray[np.int64]

_WIDEST = 200
"""Number of diagonals up to which a band is factorised sooner than a sparse matrix."""

_SINGULAR = "the length Jacobian is singular: the truss is in a singular pose"


class LengthSolver:
    """Solves J d_rho = error with the length Jacobian J."""

    def __init__(self, bays: Bays) -> None:
        scatter = bays.scatter
        self._flat = scatter.flat
        self._system = _Banded(scatter.member, scatter.column, scatter.shape[1])

    def solve(self, gradient: Array, error: Array) -> Array:
        """Return displacements of the free nodes (N - N_c, 3), m, that change the lengths by `error` (M,), m.

        Parameters
        ----------
        gradient : (M, Q, 3)
            d length / d (positions of ``Bays.member_nodes``).

        Raises
        ------
        SolverError
            The truss is in a singular pose.
        """
        return self._system.solve(gradient.reshape(-1)[self._flat], error)


class StationSolver:
    """Newton's step on fixed lengths and places of the stations, where they determine the nodes."""

    def __init__(self, layout: Layout, bays: Bays) -> None:
        stations, scatter = layout.arm.stations, bays.scatter
        fixed = np.flatnonzero(~bays.actuated)
        row = np.full(bays.member_count, -1, dtype=np.int64)
        row[fixed] = np.arange(len(fixed))
        kept = np.flatnonzero(row[scatter.member] >= 0)
        self._flat = scatter.flat[kept]
        nodes = stations.nodes[layout.tracked]
        face, corner = np.nonzero(layout.node_column[nodes] >= 0)
        axis = np.arange(3)
        first = layout.node_column[nodes[face, corner]]
        rows = [row[scatter.member[kept]], (len(fixed) + 3 * face[:, None] + axis).ravel()]
        columns = [scatter.column[kept], (first[:, None] + axis).ravel()]
        self._system = _Banded(np.concatenate(rows), np.concatenate(columns), layout.node_columns)
        self._weights = np.repeat(stations.weights[layout.tracked[face], corner], 3)

    def solve(self, gradient: Array, error: Array) -> Array:
        """Return displacements of the free nodes (N - N_c, 3), m.

        Parameters
        ----------
        gradient : (M, Q, 3)
            d length / d (positions of ``Bays.member_nodes``).
        error : (n_l + 3 K,)
            Wanted changes of the fixed members' lengths, then displacements of the tracked stations, m.

        Raises
        ------
        SolverError
            The truss is in a pose where these do not determine the nodes.
        """
        return self._system.solve(np.concatenate([gradient.reshape(-1)[self._flat], self._weights]), error)


class _Banded:
    """Square systems whose nonzeros come near the diagonal where rows follow their last column, as along an arm."""

    def __init__(self, rows: Index, columns: Index, size: int) -> None:
        last = np.zeros(size, dtype=np.int64)
        np.maximum.at(last, rows, columns)
        self._order = np.argsort(last, kind="stable")
        place = np.argsort(self._order)[rows]
        self._below, self._above = int((place - columns).max()), int((columns - place).max())
        self._width, self._size = self._below + self._above + 1, size
        self._entry = (self._above + place - columns) * size + columns
        self._sparse = place, columns

    def solve(self, values: Array, known: Array) -> Array:
        """Return the solution (size / 3, 3) for nonzeros (E,), which add up where several stand in one place."""
        size, known = self._size, known[self._order]
        try:
            if self._width > _WIDEST:
                step = splu(sparse.csc_matrix((values, self._sparse), shape=(size, size))).solve(known)
            else:
                band = np.bincount(self._entry, values, self._width * size).reshape(self._width, size)
                step = solve_banded((self._below, self._above), band, known, overwrite_ab=True)
        except (LinAlgError, ValueError, RuntimeError) as reason:
            raise SolverError(_SINGULAR) from reason
        if not np.isfinite(step).all():
            raise SolverError(_SINGULAR)
        return np.asarray(step).reshape(-1, 3)
