"""Exact distance from a segment to each shape: a closed form, or Newton's iteration in a bracket.

Vectors are columns of CasADi SX, and choices are without branches. A segment is its two ends (6,). A piece is
the vector that :class:`vgtm_qp.geometry.shapes.Obstacle` describes, or the ends of another segment. Squared
distance to a convex set is convex along a segment, so that its derivative changes sign once, between two of
its break points.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import casadi as ca

PARALLEL = 0.02
"""A second contact is given where a body's distance grows by less than this fraction of its length."""

FAR = 1e30

FURTHEST = 1e60
"""Positions this far away, m, count as infinite: their fourth powers overflow, and no bound holds."""

_TINY = 1e-13
"""Shorter vectors have no direction."""

_AXES = ca.DM.ones(3, 3) * ca.DM.eye(3)


class SymbolicContact(NamedTuple):
    """Nearest points of a segment and a piece: signed distance, parameter, unit normal (3,) from piece to segment.

    The last number is the parameter on the piece if the piece is a segment too.
    """

    distance: Any
    t: Any
    normal: Any
    s: Any = 0.0


Formula = Callable[[Any, Any], tuple[SymbolicContact, SymbolicContact]]
"""From a segment and a piece to their contact, and that at the other end of an interval, or the same."""


def clip(t: Any) -> Any:
    """Return `t` kept in [0, 1]."""
    return ca.fmin(ca.fmax(t, 0.0), 1.0)


def ratio(numerator: Any, denominator: Any, otherwise: Any = 0.0) -> Any:
    """Return the quotient, or `otherwise` where the denominator is zero."""
    zero = denominator == 0
    return ca.if_else(zero, otherwise, numerator / ca.if_else(zero, 1.0, denominator))


def norm(a: Any) -> Any:
    """Return |a|."""
    return ca.sqrt(ca.dot(a, a))


def _least(candidates: list[Any]) -> Any:
    """Return the column whose first entry is least."""
    best = candidates[0]
    for candidate in candidates[1:]:
        best = ca.if_else(candidate[0] < best[0], candidate, best)
    return best


def _unit(a: Any, fallback: Any) -> Any:
    """Return a/|a|, or `fallback` where `a` has no direction."""
    length = norm(a)
    usable = length > _TINY
    return ca.if_else(usable, a / ca.if_else(usable, length, 1.0), fallback)


def _perpendicular(u: Any) -> Any:
    """Return a unit vector normal to `u`: its cross product with the axis it is least aligned with."""
    x, y, z = ca.vertsplit(ca.fabs(u))
    axis = ca.if_else(ca.logic_and(x <= y, x <= z), _AXES[:, 0], ca.if_else(y <= z, _AXES[:, 1], _AXES[:, 2]))
    return _unit(ca.cross(u, axis), _AXES[:, 2])


def _blend(a: Any, b: Any, t: Any) -> Any:
    """Return (1 - t) a + t b; exactly `a` and `b` at t = 0 and 1."""
    return (1.0 - t) * a + t * b


def _second(t: Any, distance: Any, length: Any, candidates: list[tuple[Any, Any]]) -> Any:
    """Return the parameter farthest from `t` among the candidates (t, distance) that are almost as near."""
    best = t
    for other, other_distance in candidates:
        near = other_distance <= distance + PARALLEL * length
        farther = ca.fabs(other - t) > ca.fabs(best - t)
        best = ca.if_else(ca.logic_and(near, farther), other, best)
    return best


def _bracket(slopes: list[tuple[Any, Any]]) -> tuple[Any, Any]:
    """Return the last parameter at which the slope is negative and the first at which it is not."""
    low: Any = 0.0
    high: Any = 1.0
    for t, slope in slopes:
        low = ca.fmax(low, ca.if_else(slope < 0, t, 0.0))
        high = ca.fmin(high, ca.if_else(slope < 0, 1.0, t))
    return low, high


def _secant(low: Any, high: Any, slope_low: Any, slope_high: Any) -> Any:
    """Return the zero of the line through two points of a rising slope, kept between them."""
    inside = low + (high - low) * ratio(-slope_low, slope_high - slope_low)
    return ca.if_else(slope_low >= 0, low, ca.if_else(slope_high <= 0, high, inside))


def _beyond(x: Any, half: Any) -> Any:
    """Return how far each coordinate is outside -half to half, with its sign."""
    return ca.if_else(x > 0, ca.fmax(x - half, 0.0), -ca.fmax(-x - half, 0.0))


def _box_depth(a: Any, b: Any, half: Any) -> Any:
    """Return least depth, parameter and exit normal (3) of a segment a-b that cuts a box.

    The faces of the Minkowski difference of box and segment are the box's six and those spanned by the
    segment and a box edge; the depth is the least over their normals.
    """
    candidates, u = [], b - a
    for c in range(3):
        first = ca.if_else(a[c] <= b[c], 0.0, 1.0)
        candidates.append(ca.vertcat(half[c] - ca.fmin(a[c], b[c]), first, _AXES[:, c]))
        candidates.append(ca.vertcat(half[c] + ca.fmax(a[c], b[c]), 1.0 - first, -_AXES[:, c]))
        i, j = (c + 1) % 3, (c + 2) % 3
        square = u[i] ** 2 + u[j] ** 2
        usable = square > 1e-20
        length = ca.sqrt(ca.if_else(usable, square, 1.0))
        value = (u[j] * a[i] - u[i] * a[j]) / length
        sign = ca.if_else(value < 0, -1.0, 1.0)
        ni, nj = sign * u[j] / length, -sign * u[i] / length
        depth = ca.fabs(ni) * half[i] + ca.fabs(nj) * half[j] - ca.fabs(value)
        edge_i, edge_j = ca.if_else(ni < 0, -half[i], half[i]), ca.if_else(nj < 0, -half[j], half[j])
        t = clip(((edge_i - a[i]) * u[i] + (edge_j - a[j]) * u[j]) / length**2)
        normal = ni * _AXES[:, i] + nj * _AXES[:, j]
        candidates.append(ca.vertcat(ca.if_else(usable, depth, FAR), t, normal))
    return _least(candidates)


def _in_frame(ends: Any, piece: Any) -> tuple[Any, Any, Any]:
    """Return both ends of a segment in the frame of a piece, and the matrix that turns vectors back."""
    turn = ca.reshape(piece[3:12], 3, 3)
    return turn @ (ends[:3] - piece[:3]), turn @ (ends[3:] - piece[:3]), turn.T


def _segment_box(ends: Any, piece: Any, *, apart: bool = False) -> tuple[SymbolicContact, SymbolicContact]:
    """Return the contacts for a box.

    The squared distance is piecewise quadratic with at most six break points, where a coordinate crosses a face.
    """
    a, b, turn = _in_frame(ends, piece)
    half, u = piece[12:15], b - a

    def excess(t: Any) -> Any:
        return _beyond(_blend(a, b, t), half)

    def slope(t: Any) -> Any:
        return ca.dot(excess(t), u)

    breaks: list[Any] = [0.0, 1.0]
    breaks += [clip(ratio(side * half[c] - a[c], u[c])) for c in range(3) for side in (-1.0, 1.0)]
    low, high = _bracket([(t, slope(t)) for t in breaks])
    t = _secant(low, high, slope(low), slope(high))
    return _solid_contacts(u, turn, excess, t, None if apart else _box_depth(a, b, half), breaks)


def _solid_contacts(
    u: Any, turn: Any, excess: Callable[[Any], Any], t_outside: Any, depth: Any | None, breaks: list[Any]
) -> tuple[SymbolicContact, SymbolicContact]:
    """Return the contacts of a segment along `u` (3,) in a solid piece's frame; `turn` turns vectors back.

    `excess` is the vector from the piece to the segment at a parameter, zero inside. `t_outside` is the
    parameter of the nearest point if the two do not intersect; `depth` is depth, parameter and exit normal
    (5,) if they do, or None if these are not wanted. A contact interval may end at the parameters `breaks`.
    """
    gap = excess(t_outside)
    outside = norm(gap)
    cut = outside <= _TINY
    if depth is None:
        depth = ca.vertcat(0.0, t_outside, _AXES[:, 2])
    distance = ca.if_else(cut, -ca.fmax(depth[0], 0.0), outside)
    t = ca.if_else(cut, depth[1], t_outside)
    normal = ca.if_else(cut, depth[2:5], gap / ca.if_else(cut, 1.0, outside))
    others = [(s, norm(excess(s))) for s in breaks]
    t_second = ca.if_else(cut, t, _second(t, outside, norm(u), others))
    gap_second = excess(t_second)
    normal_second = ca.if_else(cut, normal, _unit(gap_second, normal))
    return (
        SymbolicContact(distance, t, turn @ normal),
        SymbolicContact(ca.if_else(cut, distance, norm(gap_second)), t_second, turn @ normal_second),
    )


def _segment_sphere(ends: Any, piece: Any) -> tuple[SymbolicContact, SymbolicContact]:
    a, u = ends[:3], ends[3:] - ends[:3]
    t = clip(ratio(ca.dot(piece[:3] - a, u), ca.dot(u, u)))
    gap = _blend(a, ends[3:], t) - piece[:3]
    contact = SymbolicContact(norm(gap) - piece[12], t, _unit(gap, _perpendicular(u)))
    return contact, contact


class _BesideCylinder:
    """A segment in the frame of a solid cylinder with flat ends, and how its distance changes along it."""

    def __init__(self, ends: Any, piece: Any) -> None:
        self.a, self.b, self.turn = _in_frame(ends, piece)
        self.radius, self.half, self.u = piece[12], piece[13], self.b - self.a

    def excess(self, t: Any) -> Any:
        """Return the vector (3,) from the cylinder to the segment at a parameter, zero inside."""
        x = _blend(self.a, self.b, t)
        rho = norm(x[:2])
        return ca.vertcat(ratio(ca.fmax(rho - self.radius, 0.0), rho) * x[:2], _beyond(x[2], self.half))

    def slope(self, t: Any) -> Any:
        """Return half the derivative of the squared distance."""
        return ca.dot(self.excess(t), self.u)

    def newton(self, t: Any, otherwise: Any) -> Any:
        """Return the parameter after a step of Newton's iteration; less by `otherwise` where there is no curvature."""
        x, u = _blend(self.a, self.b, t), self.u
        rho = norm(x[:2])
        rate = ratio(ca.dot(x[:2], u[:2]), rho)
        across = rate**2 + ratio(rho - self.radius, rho) * (ca.dot(u[:2], u[:2]) - rate**2)
        curvature = ca.if_else(rho > self.radius, across, 0.0)
        curvature += ca.if_else(ca.fabs(x[2]) > self.half, u[2] ** 2, 0.0)
        return t - ratio(self.slope(t), curvature, otherwise)


def nearest_of_cylinder(t: Any, ends: Any, piece: Any) -> tuple[Any, Any]:
    """Return a parameter nearer to that of a segment's nearest point than `t`, which is near to it, and the gap there.

    The gap is the vector (3,) from the piece, m. Two of Newton's steps have four times the digits of `t`.
    """
    beside = _BesideCylinder(ends, piece)
    for _ in range(2):
        t = clip(beside.newton(t, 0.0))
    return t, beside.turn @ beside.excess(t)


def _segment_cylinder(
    ends: Any, piece: Any, *, apart: bool = False
) -> tuple[SymbolicContact, SymbolicContact]:
    """Return the contacts for a solid cylinder with flat ends.

    The derivative is linear or of known sign everywhere but over the rim. There Newton's iteration runs
    inside a bracket, with bisection where it would leave the bracket.
    """
    beside = _BesideCylinder(ends, piece)
    a, b, u, radius, half, slope = beside.a, beside.b, beside.u, beside.radius, beside.half, beside.slope
    square = ca.dot(u[:2], u[:2])
    product = ca.dot(a[:2], u[:2])
    root = ca.sqrt(ca.fmax(product**2 - square * (ca.dot(a[:2], a[:2]) - radius**2), 0.0))
    breaks: list[Any] = [0.0, 1.0]
    breaks += [clip(ratio(side * half - a[2], u[2])) for side in (-1.0, 1.0)]
    t_axis = clip(ratio(-product, square))
    breaks += [t_axis, clip(ratio(-product - root, square)), clip(ratio(-product + root, square))]
    low, high = _bracket([(t, slope(t)) for t in breaks])
    slope_low, slope_high = slope(low), slope(high)
    t = _secant(low, high, slope_low, slope_high)
    settled = ca.logic_or(slope_low >= 0, slope_high <= 0)
    for _ in range(9):
        value, newton = slope(t), beside.newton(t, FAR)
        low, high = ca.if_else(value < 0, t, low), ca.if_else(value < 0, high, t)
        inside = ca.logic_and(newton >= low, newton <= high)
        t = ca.if_else(settled, t, ca.if_else(inside, newton, 0.5 * (low + high)))
    if apart:
        return _solid_contacts(u, beside.turn, beside.excess, t, None, breaks)
    first = ca.if_else(a[2] <= b[2], 0.0, 1.0)
    x = _blend(a, b, t_axis)
    radial = _unit(ca.vertcat(x[:2], 0.0), _unit(ca.vertcat(u[1], -u[0], 0.0), _AXES[:, 0]))
    way_out = _least(
        [
            ca.vertcat(half - ca.fmin(a[2], b[2]), first, _AXES[:, 2]),
            ca.vertcat(half + ca.fmax(a[2], b[2]), 1.0 - first, -_AXES[:, 2]),
            ca.vertcat(radius - norm(x[:2]), t_axis, radial),
        ]
    )
    return _solid_contacts(u, beside.turn, beside.excess, t, ca.vertcat(0.0, way_out[1:]), breaks)


def _segment_pair(a: Any, b: Any, c: Any, d: Any) -> list[Any]:
    """Return candidates (distance, t on a-b, s on c-d), among them the nearest pair of points.

    Each is a distance between true points of the two segments, so that rounding can only choose a worse one.
    The cross product keeps the interior solution accurate where the two are almost parallel.
    """
    u, v, w = b - a, d - c, c - a
    normal = ca.cross(u, v)
    square = ca.dot(normal, normal)
    uu, vv = ca.dot(u, u), ca.dot(v, v)
    pairs = [
        (
            clip(ratio(ca.dot(ca.cross(w, v), normal), square)),
            clip(ratio(ca.dot(ca.cross(w, u), normal), square)),
        ),
        (0.0, clip(ratio(-ca.dot(w, v), vv))),
        (1.0, clip(ratio(ca.dot(b - c, v), vv))),
        (clip(ratio(ca.dot(w, u), uu)), 0.0),
        (clip(ratio(ca.dot(d - a, u), uu)), 1.0),
    ]
    return [ca.vertcat(norm(_blend(a, b, t) - _blend(c, d, s)), t, s) for t, s in pairs]


def _segment_segment(ends: Any, piece: Any) -> tuple[SymbolicContact, SymbolicContact]:
    a, b, c, d = ends[:3], ends[3:], piece[:3], piece[3:]
    u, v = b - a, d - c
    candidates = _segment_pair(a, b, c, d)
    distance, t, s = ca.vertsplit(_least(candidates))
    normal = _unit(_blend(a, b, t) - _blend(c, d, s), _unit(ca.cross(u, v), _perpendicular(u)))
    t_second = _second(t, distance, norm(u), [(k[1], k[0]) for k in candidates[1:]])
    x = _blend(a, b, t_second)
    s_second = clip(ratio(ca.dot(x - c, v), ca.dot(v, v)))
    gap = x - _blend(c, d, s_second)
    return (
        SymbolicContact(distance, t, normal, s),
        SymbolicContact(norm(gap), t_second, _unit(gap, normal), s_second),
    )


def _segment_triangle(ends: Any, piece: Any) -> tuple[SymbolicContact, SymbolicContact]:
    """Return the contacts for a triangle.

    The nearest pair is an end over the face, or a point of an edge, or a piercing point.
    """
    a, b = ends[:3], ends[3:]
    u = b - a
    corners = [piece[0:3], piece[3:6], piece[6:9]]
    edges = [(corners[i], corners[(i + 1) % 3]) for i in range(3)]
    raw = ca.cross(corners[1] - corners[0], corners[2] - corners[0])
    area = norm(raw)
    flat = area > 1e-14
    face = raw / ca.if_else(flat, area, 1.0)

    def height(x: Any) -> Any:
        return ca.dot(face, x - corners[0])

    def over(x: Any) -> Any:
        inside = flat
        for c, d in edges:
            inside = ca.logic_and(inside, ca.dot(ca.cross(d - c, x - c), face) >= 0)
        return inside

    def above(x: Any) -> Any:
        """Return the distance of a point that is over the face, else `FAR`."""
        return ca.if_else(over(x), ca.fabs(height(x)), FAR)

    candidates = [ca.vertcat(above(x), t, x - height(x) * face) for t, x in ((0.0, a), (1.0, b))]
    for c, d in edges:
        distance, t, s = ca.vertsplit(_least(_segment_pair(a, b, c, d)))
        candidates.append(ca.vertcat(distance, t, _blend(c, d, s)))
    t_plane = clip(ratio(height(a), height(a) - height(b)))
    pierces = ca.logic_and(height(a) * height(b) < 0, over(_blend(a, b, t_plane)))
    nearest = _least(candidates)
    distance, t, point = nearest[0], nearest[1], nearest[2:]
    cut = ca.logic_or(pierces, distance <= _TINY)
    t = ca.if_else(pierces, t_plane, t)
    upward = ca.if_else(flat, face, _perpendicular(u))
    normal = ca.if_else(cut, upward, _unit(_blend(a, b, t) - point, upward))
    distance = ca.if_else(cut, 0.0, distance)
    t_second = _second(t, distance, norm(u), [(k[1], k[0]) for k in candidates])
    x = _blend(a, b, t_second)
    feet = [ca.vertcat(above(x), x - height(x) * face)]
    for c, d in edges:
        foot = _blend(c, d, clip(ratio(ca.dot(x - c, d - c), ca.dot(d - c, d - c))))
        feet.append(ca.vertcat(norm(x - foot), foot))
    nearest = _least(feet)
    alone = ca.logic_or(cut, t_second == t)
    return (
        SymbolicContact(distance, t, normal),
        SymbolicContact(
            ca.if_else(alone, distance, nearest[0]),
            ca.if_else(alone, t, t_second),
            ca.if_else(alone, normal, _unit(x - nearest[1:], normal)),
        ),
    )


FORMULAS: dict[str, Formula] = {
    "box": _segment_box,
    "sphere": _segment_sphere,
    "cylinder": _segment_cylinder,
    "triangle": _segment_triangle,
    "segment": _segment_segment,
}

APART: dict[str, Formula] = FORMULAS | {
    "box": partial(_segment_box, apart=True),
    "cylinder": partial(_segment_cylinder, apart=True),
}
"""The same without depths: where segment and piece intersect, the contacts say only that."""
