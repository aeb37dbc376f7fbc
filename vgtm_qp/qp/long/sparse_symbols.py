"""Linear algebra on CasADi symbols that keeps their sparsity: no pivot is chosen by value."""

from __future__ import annotations

from collections.abc import Iterable

import casadi as ca
import numpy as np
from numpy.typing import NDArray


def range_and_null(A: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return G and N with A G = 1, A N = 0, G' N = 0, N' N = 1 for a wide `A`, by reflections of A'.

    The pivots follow the sparsity: a row reflects only the coordinates that it depends on.
    """
    rows, size = A.shape
    pattern = np.zeros((size, rows), dtype=bool)
    entry: dict[tuple[int, int], ca.SX] = {}
    row_index, column_index = A.sparsity().get_triplet()
    for i, j in zip(row_index, column_index, strict=True):
        pattern[j, i], entry[j, i] = True, A[i, j]
    Q = {(i, i): ca.SX(1.0) for i in range(size)}
    free = list(range(size))
    pivots: list[int] = []
    for j in range(rows):
        touched = [i for i in free if pattern[i, j]]
        pivot = touched[0]
        norm = ca.sqrt(sum(entry[i, j] ** 2 for i in touched))
        signed = ca.copysign(norm, entry[pivot, j])
        v = {i: entry[i, j] for i in touched}
        v[pivot] = v[pivot] + signed
        scale = 1.0 / (signed * v[pivot])
        for k in range(j + 1, rows):
            common = [i for i in touched if pattern[i, k]]
            if common:
                factor = scale * sum(v[i] * entry[i, k] for i in common)
                for i in touched:
                    entry[i, k] = entry[i, k] - factor * v[i] if pattern[i, k] else -factor * v[i]
                    pattern[i, k] = True
        for i in range(size):
            common = [k for k in touched if (i, k) in Q]
            if common:
                factor = scale * sum(Q[i, k] * v[k] for k in common)
                for k in touched:
                    Q[i, k] = Q[i, k] - factor * v[k] if (i, k) in Q else -factor * v[k]
        entry[pivot, j] = -signed
        free.remove(pivot)
        pivots.append(pivot)
    G = ca.SX(size, rows)
    for j in reversed(range(rows)):
        column = _column(Q, size, pivots[j])
        for k in range(j + 1, rows):
            if pattern[pivots[j], k]:
                column -= G[:, k] * entry[pivots[j], k]
        G[:, j] = column / entry[pivots[j], j]
    return ca.sparsify(G), ca.sparsify(ca.horzcat(ca.SX(size, 0), *[_column(Q, size, i) for i in free]))


def _column(entries: dict[tuple[int, int], ca.SX], size: int, j: int) -> ca.SX:
    column = ca.SX(size, 1)
    for i in range(size):
        if (i, j) in entries:
            column[i] = entries[i, j]
    return column


def nonzeros(A: ca.SX) -> ca.SX:
    """Return the nonzeros of `A` as a column."""
    column: ca.SX = ca.vec(A.nz[:])
    return column


def symmetric(A: ca.SX) -> ca.SX:
    """Return `A`, known to be symmetric, with its lower half the very expressions of the upper one."""
    return ca.triu2symm(ca.triu(A))


def inverse_factor(A: ca.SX) -> ca.SX:
    """Return the upper triangular C^-T of A = C C'."""
    n = A.shape[0]
    C, inverse = ca.SX(n, n), ca.SX(n, n)
    for j in range(n):
        for i in range(j, n):
            rest = A[i, j] - sum(C[i, k] * C[j, k] for k in range(j))
            C[i, j] = ca.sqrt(rest) if i == j else rest / C[j, j]
    for j in range(n):
        inverse[j, j] = 1.0 / C[j, j]
        for i in range(j):
            inverse[i, j] = -sum(C[j, k] * inverse[i, k] for k in range(i, j)) / C[j, j]
    return inverse


def small_inverse(A: ca.SX) -> ca.SX:
    """Return the inverse of a square `A` of a few rows, by reflections as in :func:`range_and_null`."""
    return range_and_null(ca.sparsify(A))[0] if A.shape[0] else ca.SX(0, 0)


def offsets(sizes: Iterable[int]) -> list[int]:
    """Return where pieces of these sizes begin, and where the last one ends."""
    return [0, *np.cumsum(list(sizes)).tolist()]


def symbols_of(pattern: NDArray[np.bool_], values: ca.SX) -> ca.SX:
    """Return a matrix of that sparsity with the nonzeros `values`, column by column."""
    rows, columns = np.nonzero(pattern)
    count, width = (int(size) for size in pattern.shape)
    return ca.SX(ca.Sparsity.triplet(count, width, rows.tolist(), columns.tolist()), values)
