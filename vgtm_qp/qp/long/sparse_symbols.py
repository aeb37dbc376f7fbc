"""Linear algebra on CasADi symbols that keeps their sparsity: no pivot is chosen by value."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import casadi as ca
import numpy as np
from numpy.typing import NDArray


def range_and_null(A: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return G and N with A G = 1, A N = 0, G' N = 0, N' N = 1 for a wide `A`, by reflections of A'.

    The pivots follow the sparsity: a row reflects only the coordinates that it depends on.
    """
    rows, size = A.shape
    reflected = ca.horzcat(ca.sparsify(A).T, ca.SX.eye(size))
    free, pivots = list(range(size)), []
    for j in range(rows):
        touched = [i for i in free if reflected.sparsity().has_nz(i, j)]
        v, rest = reflected[touched, j], reflected[touched, j + 1 :]
        signed = ca.copysign(ca.norm_2(v), v[0])
        v[0] += signed
        reflected[touched, j + 1 :] = rest - (v / (signed * v[0])) @ (v.T @ rest)
        reflected[touched, j] = ca.SX(len(touched), 1)
        reflected[touched[0], j] = -signed
        reflected = ca.sparsify(reflected)
        pivots.append(touched[0])
        free.remove(touched[0])
    triangle, turned = reflected[pivots, :rows], reflected[:, rows:]
    inverse = ca.solve(triangle, ca.SX.eye(rows))
    return ca.sparsify(turned[pivots, :].T @ inverse.T), turned[free, :].T


def small_inverse(A: ca.SX) -> ca.SX:
    """Return the inverse of a square `A` of a few rows, by reflections."""
    return range_and_null(A)[0]


def inverse_factor(A: ca.SX) -> ca.SX:
    """Return the upper triangular C^-T of A = C C'."""
    return ca.solve(ca.chol(A), ca.SX.eye(A.shape[0]))


def nonzeros(A: ca.SX) -> ca.SX:
    """Return the nonzeros of `A` as a column."""
    column: ca.SX = ca.vec(A.nz[:])
    return column


def symmetric(A: ca.SX) -> ca.SX:
    """Return `A`, known to be symmetric, with the expressions of its upper half in the lower half too."""
    return ca.triu2symm(ca.triu(A))


def offsets(sizes: Iterable[int]) -> list[int]:
    """Return the offsets at which pieces of these sizes begin, and the end of the last."""
    return [0, *np.cumsum(list(sizes)).tolist()]


def sparsity_of(pattern: NDArray[np.bool_]) -> ca.Sparsity:
    """Return the sparsity of that pattern."""
    return ca.sparsify(ca.DM(pattern.astype(float))).sparsity()


def symbols_like(sparsities: Sequence[ca.Sparsity], name: str) -> tuple[ca.SX, list[ca.SX]]:
    """Return one vector of symbols, and matrices of those sparsities that it fills column by column."""
    ends = offsets(sparsity.nnz() for sparsity in sparsities)
    vector = ca.SX.sym(name, ends[-1])
    pieces = ca.vertsplit(vector, ends)
    return vector, [ca.SX(sparsity, piece) for sparsity, piece in zip(sparsities, pieces, strict=True)]


def dense_function(name: str, inputs: Sequence[ca.SX], outputs: Sequence[ca.SX]) -> ca.Function:
    """Return the function of these `outputs`, dense."""
    return ca.Function(name, inputs, [ca.densify(output) for output in outputs])
