"""Newton's step on the lengths of members: node displacements for given changes, at linear cost."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from vgtm_qp.arm.arm import Bays
from vgtm_qp.errors import SolverError
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.long.chain import Chain, find_chain
from vgtm_qp.qp.long.sparse_symbols import range_and_null, symbols_of
from vgtm_qp.qp.long.sweep import Sweep

Array = NDArray[np.float64]

_DENSE = 150
"""Up to so many node coordinates LAPACK is faster than any use of the structure."""

_SINGULAR = "the length Jacobian is singular: the truss is in a singular pose"


class LengthSolver:
    """Solves J d_rho = error with the length Jacobian J: dense, along the chain of bays, or sparse."""

    def __init__(self, layout: Layout, bays: Bays) -> None:
        self._bays = bays
        size = layout.node_columns
        chain = find_chain(layout) if size > _DENSE else None
        self._chain = None if chain is None else _ChainSubstitution(chain)
        self._jacobian = np.zeros((size, size) if size <= _DENSE else (0, 0))

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
        scatter = self._bays.scatter
        if self._chain is not None:
            step = self._chain.solve(gradient, error)
        elif len(self._jacobian):
            try:
                step = np.asarray(
                    np.linalg.solve(scatter.dense(gradient, self._jacobian), error), dtype=float
                )
            except np.linalg.LinAlgError as reason:
                raise SolverError(_SINGULAR) from reason
        else:
            step = _sparse_solution(scatter.sparse(gradient), error)
        return _finite(step)


class StationSolver:
    """Newton's step on fixed lengths and places of the stations, where they determine the nodes."""

    def __init__(self, layout: Layout, bays: Bays) -> None:
        stations, scatter = layout.arm.stations, bays.scatter
        self._columns_count = layout.node_columns
        fixed = np.flatnonzero(~bays.actuated)
        row = np.full(bays.member_count, -1, dtype=np.int64)
        row[fixed] = np.arange(len(fixed))
        kept = np.flatnonzero(row[scatter.member] >= 0)
        self._flat = scatter.flat[kept]
        nodes = stations.nodes[layout.tracked]
        face, corner = np.nonzero(layout.node_column[nodes] >= 0)
        axis = np.arange(3)
        first = layout.node_column[nodes[face, corner]]
        self._rows = np.concatenate(
            [row[scatter.member[kept]], (len(fixed) + 3 * face[:, None] + axis).ravel()]
        )
        self._columns = np.concatenate([scatter.column[kept], (first[:, None] + axis).ravel()])
        self._weights = np.repeat(stations.weights[layout.tracked[face], corner], 3)

    def solve(self, gradient: Array, error: Array, gap: Array) -> Array:
        """Return displacements of the free nodes (N - N_c, 3), m.

        Parameters
        ----------
        gradient : (M, Q, 3)
            d length / d (positions of ``Bays.member_nodes``).
        error : (n_l,)
            Wanted changes of the fixed members' lengths, m.
        gap : (K, 3)
            Wanted displacements of the tracked stations, m.

        Raises
        ------
        SolverError
            The truss is in a pose where these do not determine the nodes.
        """
        values = np.concatenate([gradient.reshape(-1)[self._flat], self._weights])
        shape = (len(error) + gap.size, self._columns_count)
        matrix = sparse.csc_matrix((values, (self._rows, self._columns)), shape=shape)
        return _finite(_sparse_solution(matrix, np.concatenate([error, gap.reshape(-1)])))


def _sparse_solution(matrix: sparse.csc_matrix, rhs: Array) -> Array:
    try:
        return np.asarray(splu(matrix).solve(rhs))
    except RuntimeError as reason:
        raise SolverError(_SINGULAR) from reason


def _finite(step: Array) -> Array:
    if not np.isfinite(step).all():
        raise SolverError(_SINGULAR)
    return step.reshape(-1, 3)


class _ChainSubstitution:
    """Bay after bay: each stage's members place its nodes on those before."""

    def __init__(self, chain: Chain) -> None:
        self._chain = chain
        self._sweep = Sweep(_substitution(chain), chain.periods)
        place = np.empty(chain.bays.node_count, dtype=np.int64)
        place[chain.nodes.reshape(-1)] = np.arange(chain.nodes.size)
        self._order = place[chain.bays.free]

    def solve(self, gradient: Array, error: Array) -> Array:
        chain, sweep = self._chain, self._sweep
        sweep.inputs[1][:] = chain.gather @ gradient.reshape(-1)
        sweep.inputs[2][:] = error[chain.members].reshape(-1)
        sweep()
        return sweep.outputs[1].reshape(-1, 3)[self._order]


def _substitution(chain: Chain) -> ca.Function:
    """Return (carry, Jacobian's nonzeros, error) -> (carry, displacements) of one period."""
    pattern = chain.coordinate_pattern
    carry, values = ca.SX.sym("carry", chain.before), ca.SX.sym("values", int(pattern.sum()))
    error = ca.SX.sym("error", chain.own)
    jacobian, u, done = symbols_of(pattern, values), carry, 0
    for count in chain.stage_sizes:
        own = list(range(done, done + 3 * count))
        columns_before = chain.before + done
        block = jacobian[own, list(range(columns_before, columns_before + 3 * count))]
        inverse, _ = range_and_null(block)
        u = ca.vertcat(u, inverse @ (error[own] - jacobian[own, list(range(columns_before))] @ u))
        done += 3 * count
    live = [chain.before + 3 * place + axis for place in chain.carried.tolist() for axis in range(3)]
    return ca.Function(
        "lengths", [carry, values, error], [ca.densify(u[live]), ca.densify(u[chain.before :])]
    )
