"""Static determinacy: as many members as unknown coordinates, and a regular length Jacobian (section 3).

A wrong truss is refused with the motion that no member hinders, or the members that hold one another in
stress.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import qr
from scipy.sparse.linalg import LinearOperator, eigsh, splu

from vgtm_qp.arm.arm import rank
from vgtm_qp.arm.truss.kinematics import length_gradients
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.arrays import Array
from vgtm_qp.errors import TrussError

_REGULAR = 1e-10
"""Singular values of a whole truss below this fraction of the greatest one count as zero: many bays have small ones."""

_DENSE_LIMIT = 450
"""Above this many unknown coordinates, Lanczos iteration on a sparse LU beats the dense decomposition."""

_NAMED = 6
"""How many nodes or members a message names before it only counts the others."""


@dataclass(frozen=True)
class DeterminacyReport:
    """How regular the square length Jacobian of a statically determinate truss is."""

    members: int
    coordinates: int
    """Unknown node coordinates 3 (N - N_c), as many as members."""
    rank: int
    smallest_singular_value: float
    """The least change of length, m, per metre of node displacement, of any motion."""
    condition: float


def length_jacobian(truss: Truss, X: Array | None = None) -> sparse.csc_array:
    """Return d lengths / d unknown node coordinates, (M, 3 (N - N_c)), its columns in the order of ``free``.

    `X` (N, 3) are node positions, m, home if not given; offset joints are differentiated through their frames, eqs.
    (19)-(21).
    """
    X = truss.home if X is None else X
    return sparse.csc_array(truss.scatter.sparse(length_gradients(truss, X)))


def check_determinacy(truss: Truss, X: Array | None = None) -> DeterminacyReport:
    """Return the report of a statically determinate truss; refuse any other.

    `X` (N, 3) are node positions, m, home if not given. The stages of the truss need not be set.

    Raises
    ------
    TrussError
        The number of members is not 3 (N - N_c) or the length Jacobian is singular. The message names the
        nodes of a free motion with their directions, and the members of a state of self-stress.
    """
    matrix = length_jacobian(truss, X)
    members, coordinates = matrix.shape
    if coordinates == 0:
        raise TrussError("every node is fixed: nothing can move; expected at least one node that is not")
    if members == coordinates:
        smallest, greatest = _extreme_singular_values(matrix)
        if smallest > _REGULAR * greatest:
            return DeterminacyReport(members, coordinates, coordinates, smallest, greatest / smallest)
    raise TrussError(_refusal(truss, matrix))


def _extreme_singular_values(J: sparse.csc_array) -> tuple[float, float]:
    """Smallest and greatest singular value of a square matrix; 0 for the smallest of a singular one."""
    size = J.shape[0]
    if size <= _DENSE_LIMIT:
        values = np.linalg.svd(J.toarray(), compute_uv=False)
        return float(values[-1]), float(values[0])
    # A fixed start makes the answer the same at every call.
    start = np.random.default_rng(0).standard_normal(size)
    gram = LinearOperator((size, size), matvec=lambda v: J.T @ (J @ v), dtype=np.float64)
    greatest = float(np.sqrt(eigsh(gram, k=1, v0=start, tol=1e-4, return_eigenvectors=False)[0]))
    try:
        factor = splu(J)
    except RuntimeError:
        return 0.0, greatest
    inverse = LinearOperator(
        (size, size), matvec=lambda v: factor.solve(factor.solve(v, trans="T")), dtype=np.float64
    )
    largest = float(eigsh(inverse, k=1, v0=start, tol=1e-8, return_eigenvectors=False)[0])
    return float(1.0 / np.sqrt(largest)) if np.isfinite(largest) and largest > 0.0 else 0.0, greatest


def _refusal(truss: Truss, J: sparse.csc_array) -> str:
    """Return the message for a truss that is not determinate, with its free motion and self-stress."""
    members, coordinates = J.shape
    motions, stresses = _null_spaces(J)
    parts = [
        f"the truss has {members} members for {coordinates} unknown coordinates (3 for each free node); "
        "statically determinate is as many of both and no free motion"
    ]
    if motions.shape[1]:
        motion = _localised(motions).reshape(-1, 3)
        size = np.linalg.norm(motion, axis=1)
        free = [truss.node_names[i] for i in truss.free]
        names = _largest(size, "nodes", lambda i: f"node {free[i]} along {in_words(motion[i] / size[i])}")
        parts.append(f"{motions.shape[1]} free motion(s), one of them {names}: a member has to hinder it")
    if stresses.shape[1]:
        names = _largest(np.abs(_localised(stresses)), "members", truss.member_names.__getitem__)
        parts.append(f"{stresses.shape[1]} redundant member(s), one of them among {names}: it has to go")
    return ". ".join(parts)


def _null_spaces(J: sparse.csc_array) -> tuple[Array, Array]:
    """Return bases (columns) of free motions and states of self-stress; of large trusses a few only."""
    if max(J.shape) > _DENSE_LIMIT:
        return _sparse_null_space(J), _sparse_null_space(sparse.csc_array(J.T))
    left, values, right = np.linalg.svd(J.toarray())
    kept = rank(values, _REGULAR)
    return right[kept:].T, left[:, kept:]


def _sparse_null_space(J: sparse.csc_array) -> Array:
    """Return up to ``_NAMED`` null vectors of J (columns), by Lanczos iteration on (J' J + small I)^-1."""
    size = J.shape[1]
    factor = splu(sparse.csc_array(J.T @ J + 1e-13 * sparse.eye_array(size)))
    inverse = LinearOperator((size, size), matvec=factor.solve, dtype=np.float64)
    start = np.random.default_rng(0).standard_normal(size)
    _, vectors = eigsh(inverse, k=_NAMED, v0=start)
    return np.asarray(vectors[:, np.linalg.norm(J @ vectors, axis=0) < 1e-8])


def _localised(basis: Array) -> Array:
    """Return the vector with the fewest entries in the echelon form of a null space's `basis` (columns).

    A singular vector mixes all the motions of a null space; the echelon form tells them apart.
    """
    _, _, pivots = qr(basis.T, pivoting=True, mode="economic")
    echelon = basis @ np.linalg.inv(basis[pivots[: basis.shape[1]]])
    echelon = echelon / np.abs(echelon).max(axis=0)
    return np.asarray(echelon[:, np.argmin(np.count_nonzero(np.abs(echelon) > 1e-6, axis=0))])


def _largest(size: Array, what: str, name: Callable[[int], str]) -> str:
    """Return the names of the greatest entries of `size` (K,); entries equal to rounding keep their order."""
    greatest = float(size.max())
    order = np.argsort(-np.round(size / greatest, 9), kind="stable")
    order = order[size[order] > 1e-6 * greatest]
    more = f" and {len(order) - _NAMED} more {what}" if len(order) > _NAMED else ""
    return ", ".join(name(k) for k in order[:_NAMED].tolist()) + more


def in_words(vector: Array) -> str:
    """Return ``"(x, y, z)"`` to three decimals."""
    x, y, z = np.round(vector, 3) + 0.0
    return f"({x:g}, {y:g}, {z:g})"
