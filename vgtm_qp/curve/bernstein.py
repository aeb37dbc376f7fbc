"""Polynomials in Bernstein form on [0, 1]: basis tables, subdivision and products."""

from __future__ import annotations

from functools import cache
from math import comb, perm

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@cache
def _difference(size: int, order: int) -> Array:
    """(size - order, size) matrix of the `order`-th forward difference."""
    return np.asarray(np.diff(np.eye(size), n=order, axis=0))


@cache
def _binomials(degree: int) -> Array:
    return np.array([comb(degree, j) for j in range(degree + 1)], dtype=float)


def basis(degree: int, u: ArrayLike, order: int = 0) -> Array:
    """Bernstein basis of `degree`, or its derivative of `order`, at `u` of any shape: (..., degree + 1)."""
    u = np.asarray(u, dtype=float)[..., None]
    if order > degree:
        return np.zeros((*u.shape[:-1], degree + 1))
    low = degree - order
    j = np.arange(low + 1)
    table = _binomials(low) * u**j * (1.0 - u) ** (low - j)
    if order == 0:
        return np.asarray(table)
    return np.asarray(perm(degree, order) * (table @ _difference(degree + 1, order)))


def split(coefficients: Array, u: ArrayLike) -> tuple[Array, Array]:
    """Cut polynomials (..., d + 1) at `u` of shape (...), by de Casteljau: coefficients of the two parts."""
    u = np.asarray(u, dtype=float)[..., None]
    row = np.asarray(coefficients + 0.0 * u)
    left, right = np.empty_like(row), np.empty_like(row)
    size = int(coefficients.shape[-1])
    for j in range(size):
        left[..., j] = row[..., 0]
        right[..., size - 1 - j] = row[..., -1]
        row = (1.0 - u) * row[..., :-1] + u * row[..., 1:]
    return left, right


@cache
def _product(p: int, q: int) -> Array:
    """(p + q + 1, p + 1, q + 1) tensor that multiplies polynomials of degrees p and q."""
    tensor = np.zeros((p + q + 1, p + 1, q + 1))
    for i in range(p + 1):
        for j in range(q + 1):
            tensor[i + j, i, j] = comb(p, i) * comb(q, j) / comb(p + q, i + j)
    return tensor


def inner_product(a: Array, b: Array) -> Array:
    """Dot product (..., p + q + 1) of the vector polynomials (..., p + 1, n) and (..., q + 1, n)."""
    return np.asarray(
        np.einsum("kij,...ij->...k", _product(a.shape[-2] - 1, b.shape[-2] - 1), a @ np.swapaxes(b, -1, -2))
    )
