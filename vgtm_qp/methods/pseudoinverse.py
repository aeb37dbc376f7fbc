"""Generalised inverses, eqs. (5), (6) and (28): Moore-Penrose, weighted, damped and truncated, as pure functions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky, solve_triangular

from vgtm_qp.arrays import Array
from vgtm_qp.errors import SolverError

TRUNCATION = 1e-10
"""Singular values below this fraction of the greatest one are rounding, which every inverse leaves out."""


class Inverse(NamedTuple):
    """A generalised inverse (n, m) of a matrix (m, n), and the rank of that matrix."""

    matrix: Array
    rank: int


class Cost(NamedTuple):
    """A quadratic cost 1/2 d' hessian d + gradient . d of displacements d (n,)."""

    hessian: Array
    gradient: Array


def moore_penrose(J: Array, *, truncation: float = TRUNCATION) -> Inverse:
    """Return J^+ (n, m), eq. (6), by singular values; those below `truncation` times the greatest count as zero.

    J J^+ = 1 holds at full row rank only. A `truncation` that is not small gives the truncated inverse, which
    leaves out the directions of large displacements.
    """
    u, sigma, vt = np.linalg.svd(J, full_matrices=False)
    kept = sigma > truncation * max(float(sigma[0]), np.finfo(float).tiny)
    return Inverse(np.asarray((vt[kept].T / sigma[kept]) @ u[:, kept].T), int(np.count_nonzero(kept)))


def weighted(J: Array, weight: Array, *, damping: float = 0.0) -> Inverse:
    """Return W^-1 J' (J W^-1 J' + damping^2 1)^-1 (n, m) for a positive definite `weight` W (n, n).

    With W = 1 and a damping it is the damped least-squares inverse of Nakamura & Hanafusa, J. Dyn. Syst. 108
    (1986), and of Wampler, IEEE Trans. SMC 16 (1986).

    Raises
    ------
    SolverError
        W is not positive definite, or there is no damping and J has not full row rank.
    """
    try:
        lower = cholesky(weight, lower=True)
        scaled = solve_triangular(lower, J.T, lower=True)
        gram = scaled.T @ scaled
        gram[np.diag_indices_from(gram)] += damping**2
        factor = cho_factor(gram, lower=True)
    except LinAlgError:
        raise SolverError("the rows of J are dependent, or the weight is not positive definite") from None
    pivots = np.abs(np.diag(factor[0]))
    if float(pivots.min()) <= np.sqrt(np.finfo(float).eps) * float(pivots.max()) * 1e-1 and not damping:
        raise SolverError("the rows of J are dependent to working precision: the pose is singular")
    right = cho_solve(factor, np.eye(len(gram)))
    return Inverse(np.asarray(solve_triangular(lower, scaled, lower=True, trans="T") @ right), len(gram))


def projector(inverse: Inverse, J: Array) -> Array:
    """Return the null-space projector 1 - J^+ J of eq. (5), (n, n)."""
    return np.asarray(np.eye(J.shape[1]) - inverse.matrix @ J)


def null_space_vector(N: Array, start: Array, objective: Cost) -> Array:
    """Return the null-space vector v whose image N v minimises `objective` at start + N v.

    ``v = (N'HN + c (1 - N))^-1 N' (-gradient - H start)``; the second term, with c the scale of H, makes the
    matrix regular and, for an orthogonal projector N, does not change N v. So J^+ x + N v is the minimiser of
    `objective` under J d = x: the answer of a quadratic program with these rows alone.
    """
    H = objective.hessian
    scale = float(np.trace(H)) / len(H)
    system = N.T @ H @ N + scale * (np.eye(len(H)) - N)
    return np.asarray(np.linalg.solve(system, -N.T @ (objective.gradient + H @ start)), dtype=np.float64)
