"""Roots: Newton's method in brackets, and every sign change of polynomials in Bernstein form."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.curve.bernstein import Array, basis, split

_NEWTON_STEPS = 100
_CONVERGED = 1e-13
_HALVINGS = 32
_NOTHING = 1e-18


def increasing_roots(function: Callable[[Array], tuple[Array, Array]], low: Array, high: Array) -> Array:
    """Roots of many functions at once, each negative at its `low` and positive at its `high`.

    Newton's method, held within the brackets, with bisection wherever a step shrinks by less than half.

    Parameters
    ----------
    function : callable
        Maps x of shape (n,) to values and slopes, both (n,).
    low, high : (n,)
        Brackets.
    """
    x = (low + high) / 2
    previous = high - low
    for _ in range(_NEWTON_STEPS):
        value, slope = function(x)
        low, high = np.where(value < 0, x, low), np.where(value < 0, high, x)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            newton = np.clip(x - value / slope, low, high)
        step = np.abs(newton - x)
        # Where the function falls, Newton's step leads away from the root. And a step as small as
        # rounding must not throw the root back to the middle of its bracket.
        good = (slope > 0) & (step <= np.maximum(previous / 2, _CONVERGED))
        new = np.where(good, newton, (low + high) / 2)
        previous = np.abs(new - x)
        x = new
        if np.all(previous <= _CONVERGED):
            break
    return np.asarray(x)


class Pieces(NamedTuple):
    """Polynomials in Bernstein form, (n, d + 1), each on its own interval of s, (n,) and (n,)."""

    coefficients: Array
    start: Array
    end: Array

    def take(self, which: NDArray[np.bool_]) -> Pieces:
        """Return the pieces where `which` (n,) is True."""
        return Pieces(self.coefficients[which], self.start[which], self.end[which])

    def halves(self) -> Pieces:
        """Cut every piece in the middle: (2 n) pieces, all first halves and then all second halves."""
        left, right = split(self.coefficients, 0.5)
        middle = (self.start + self.end) / 2
        return Pieces(
            np.concatenate([left, right]),
            np.concatenate([self.start, middle]),
            np.concatenate([middle, self.end]),
        )


def sign_changes(coefficients: Array) -> tuple[Array, Array, Array]:
    """First sign, last sign and number of changes in (n, d + 1) coefficients, zeros left out; each (n,)."""
    signs = np.sign(coefficients)
    if not signs.all():
        for j in range(1, signs.shape[1]):
            signs[:, j] = np.where(signs[:, j] == 0, signs[:, j - 1], signs[:, j])
        for j in range(signs.shape[1] - 2, -1, -1):
            signs[:, j] = np.where(signs[:, j] == 0, signs[:, j + 1], signs[:, j])
    return signs[:, 0], signs[:, -1], np.count_nonzero(np.diff(signs, axis=1), axis=1)


def crossings(pieces: Pieces, *, rising_only: bool = False) -> Array:
    """Find every s inside a piece where its polynomial changes sign; in no order.

    A polynomial has at most as many roots as its Bernstein coefficients have sign changes, and an odd or an
    even number as they have (Descartes' rule): a piece without a change has no root, one with a single
    change has one, and all others are cut in halves. Roots closer together than 2^-32 of the piece count as
    one.

    Parameters
    ----------
    rising_only : bool
        Find only changes from negative to positive.
    """
    found = []
    for _ in range(_HALVINGS):
        first, last, changes = sign_changes(pieces.coefficients)
        single = (changes == 1) & (first < 0) if rising_only else changes == 1
        found.append(_single_roots(pieces.take(single), -first[single]))
        pieces = pieces.take(changes > 1)
        count = len(pieces.start)
        if count == 0:
            return np.concatenate(found)
        pieces = pieces.halves()
        first, last, _ = sign_changes(pieces.coefficients)
        # A root in the very middle is in neither half: the nonzero coefficients beside it differ in sign.
        middle = _changes(last[:count], first[count:], rising_only) & (pieces.coefficients[count:, 0] == 0)
        found.append(pieces.start[count:][middle])
    first, last, _ = sign_changes(pieces.coefficients)
    found.append(pieces.start[_changes(first, last, rising_only)])
    return np.concatenate(found)


def minima(chain: Pieces) -> Array:
    """Parameters of all local minima of a continuous function, ends included, in no order.

    Parameters
    ----------
    chain : Pieces
        Its derivative, or that times a positive factor, on adjoining intervals in order. It may jump
        between them. A stretch where the derivative is zero counts as the one point at its end.
    """
    first, last, _ = sign_changes(chain.coefficients)
    for k in np.flatnonzero(first == 0):
        first[k] = last[k] = last[k - 1] if k else -1.0
    before, after = np.append(-1.0, last), np.append(first, 1.0)
    joints = np.append(chain.start[0], chain.end)
    return np.concatenate([crossings(chain, rising_only=True), joints[(before < 0) & (after > 0)]])


def _changes(before: Array, after: Array, rising_only: bool) -> NDArray[np.bool_]:
    rising = (before < 0) & (after > 0)
    return rising if rising_only else rising | ((before > 0) & (after < 0))


def _single_roots(pieces: Pieces, orientation: Array) -> Array:
    """Roots of pieces with one sign change each, rising once multiplied by their orientation (n,)."""
    coefficients = pieces.coefficients * orientation[:, None]
    degree = coefficients.shape[1] - 1
    # A root at an end of the piece is not the one that is sought: it is moved out by less than rounding.
    nothing = _NOTHING * np.abs(coefficients).max(axis=1, initial=0.0)
    coefficients[:, 0] = np.where(coefficients[:, 0] == 0.0, -nothing, coefficients[:, 0])
    coefficients[:, -1] = np.where(coefficients[:, -1] == 0.0, nothing, coefficients[:, -1])
    low, high = coefficients[:, :-1], coefficients[:, 1:]

    def polynomial(u: Array) -> tuple[Array, Array]:
        table = basis(degree - 1, u)
        value = (1.0 - u) * np.sum(table * low, axis=1) + u * np.sum(table * high, axis=1)
        return value, degree * np.sum(table * (high - low), axis=1)

    size = len(pieces.start)
    if size == 0:
        return np.empty(0)
    u = increasing_roots(polynomial, np.zeros(size), np.ones(size))
    return np.asarray(pieces.start + u * (pieces.end - pieces.start))
