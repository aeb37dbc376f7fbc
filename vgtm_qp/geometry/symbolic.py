"""Three-vectors of CasADi SX scalars, and choices without branches."""

from __future__ import annotations

from typing import Any

import casadi as ca

Vector = list[Any]

TINY = 1e-13
"""Shorter vectors have no direction."""


def dot(a: Vector, b: Vector) -> Any:
    """Return a.b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Return a x b."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def add(a: Vector, b: Vector, factor: Any = 1.0) -> Vector:
    """Return a + factor b."""
    return [x + factor * y for x, y in zip(a, b, strict=True)]


def between(a: Vector, b: Vector) -> Vector:
    """Return the vector from `a` to `b`."""
    return add(b, a, -1.0)


def norm(a: Vector) -> Any:
    """Return |a|."""
    return ca.sqrt(dot(a, a))


def pick(condition: Any, yes: Any, no: Any) -> Any:
    """Choose between scalars or, entry by entry, between lists of them."""
    if isinstance(yes, list):
        return [pick(condition, y, n) for y, n in zip(yes, no, strict=True)]
    return ca.if_else(condition, yes, no)


def clip(t: Any) -> Any:
    """Return `t` kept in [0, 1]."""
    return ca.fmin(ca.fmax(t, 0.0), 1.0)


def ratio(numerator: Any, denominator: Any, otherwise: Any = 0.0) -> Any:
    """Return the quotient, or `otherwise` where the denominator is zero."""
    zero = denominator == 0
    return ca.if_else(zero, otherwise, numerator / ca.if_else(zero, 1.0, denominator))


def least(candidates: list[list[Any]]) -> list[Any]:
    """Return the candidate whose first entry is least."""
    best = candidates[0]
    for candidate in candidates[1:]:
        best = pick(candidate[0] < best[0], candidate, best)
    return best


def unit(a: Vector, fallback: Vector) -> Vector:
    """Return a/|a|, or `fallback` where `a` has no direction."""
    length = norm(a)
    usable = length > TINY
    scaled: Vector = pick(usable, [x / ca.if_else(usable, length, 1.0) for x in a], fallback)
    return scaled


def perpendicular(u: Vector) -> Vector:
    """Return a unit vector normal to `u`: its cross product with the axis it is least aligned with."""
    x, y, z = (ca.fabs(c) for c in u)
    first, second = ca.logic_and(x <= y, x <= z), y <= z
    axis = [
        ca.if_else(first, 1.0, 0.0),
        ca.if_else(first, 0.0, ca.if_else(second, 1.0, 0.0)),
        ca.if_else(first, 0.0, ca.if_else(second, 0.0, 1.0)),
    ]
    return unit(cross(u, axis), [0.0, 0.0, 1.0])


def blend(a: Vector, b: Vector, t: Any) -> Vector:
    """Return (1 - t) a + t b, which is `a` and `b` without rounding at the ends."""
    return [(1.0 - t) * x + t * y for x, y in zip(a, b, strict=True)]


def at(ends: Vector, t: Any) -> Vector:
    """Return the point of a segment at parameter `t`."""
    return blend(ends[0:3], ends[3:6], t)


def into_frame(rotation: Vector, center: Vector, x: Vector) -> Vector:
    """Return the coordinates of point `x` in a frame."""
    return rotate_back(rotation, between(center, x))


def rotate_back(rotation: Vector, x: Vector) -> Vector:
    """Return the transposed of `rotation` (9, row-major) times `x`."""
    return [rotation[c] * x[0] + rotation[3 + c] * x[1] + rotation[6 + c] * x[2] for c in range(3)]


def rotate(rotation: Vector, x: Vector) -> Vector:
    """Return `rotation` (9, row-major) times `x`."""
    return [dot(rotation[3 * r : 3 * r + 3], x) for r in range(3)]
