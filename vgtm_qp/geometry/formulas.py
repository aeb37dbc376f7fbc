"""Exact distance from a segment to each shape: a closed form, or Newton's iteration in a bracket."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import casadi as ca

from vgtm_qp.geometry.symbolic import (
    TINY,
    Vector,
    add,
    at,
    between,
    blend,
    clip,
    cross,
    dot,
    into_frame,
    least,
    norm,
    perpendicular,
    pick,
    ratio,
    rotate,
    unit,
)

PARALLEL = 0.02
"""A second contact is given where a body's distance grows by less than this fraction of its length."""

FAR = 1e30

FURTHEST = 1e60
"""Positions this far away, m, are not finite numbers: their fourth powers overflow, and no bound holds."""


class SymbolicContact(NamedTuple):
    """The nearest points of a segment and a piece; scalars and vectors (3) of SX.

    Attributes
    ----------
    distance, distance_second
        Signed, at the witness point and at the other end of a contact interval.
    t, t_second
        Parameters of those points on the segment.
    normal, normal_second
        Unit, from the piece to the segment.
    s, s_second
        Parameters on the piece where that is a segment too.
    """

    distance: Any
    distance_second: Any
    t: Any
    t_second: Any
    normal: Vector
    normal_second: Vector
    s: Any = 0.0
    s_second: Any = 0.0


def _second(t: Any, distance: Any, length: Any, candidates: list[tuple[Any, Any]]) -> Any:
    """Return the parameter farthest from `t` of the candidates (t, distance) that are almost as near."""
    best = t
    for other, other_distance in candidates:
        near = other_distance <= distance + PARALLEL * length
        farther = ca.fabs(other - t) > ca.fabs(best - t)
        best = ca.if_else(ca.logic_and(near, farther), other, best)
    return best


def _bracket(slopes: list[tuple[Any, Any]]) -> tuple[Any, Any]:
    """Return the last of the parameters where the slope is negative and the first where it is not."""
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


def _box_excess(x: Vector, half: Vector) -> Vector:
    return [
        ca.if_else(c > 0, ca.fmax(c - h, 0.0), -ca.fmax(-c - h, 0.0)) for c, h in zip(x, half, strict=True)
    ]


def _box_depth(a: Vector, u: Vector, half: Vector) -> list[Any]:
    """Return least depth, parameter and exit normal (3) of a segment that cuts a box.

    The faces of the Minkowski difference of box and segment are the box's six and those spanned by the
    segment and a box edge; the depth is the least over their normals.
    """
    candidates: list[list[Any]] = []
    b = add(a, u)
    for c in range(3):
        axis = [1.0 if i == c else 0.0 for i in range(3)]
        first = ca.if_else(a[c] <= b[c], 0.0, 1.0)
        candidates.append([half[c] - ca.fmin(a[c], b[c]), first, *axis])
        candidates.append([half[c] + ca.fmax(a[c], b[c]), 1.0 - first, *[-x for x in axis]])
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
        normal: list[Any] = [0.0, 0.0, 0.0]
        normal[i], normal[j] = ni, nj
        candidates.append([ca.if_else(usable, depth, FAR), t, *normal])
    return least(candidates)


def _segment_box(ends: Vector, piece: Vector, *, apart: bool = False) -> SymbolicContact:
    """Return the contact for a box.

    The squared distance is piecewise quadratic with at most six break points, where a coordinate crosses a
    face.
    """
    center, rotation, half = piece[0:3], piece[3:12], piece[12:15]
    a, b = into_frame(rotation, center, ends[0:3]), into_frame(rotation, center, ends[3:6])
    u = between(a, b)

    def excess(t: Any) -> Vector:
        return _box_excess(blend(a, b, t), half)

    def slope(t: Any) -> Any:
        return dot(excess(t), u)

    breaks: list[Any] = [0.0, 1.0]
    breaks += [clip(ratio(side * half[c] - a[c], u[c])) for c in range(3) for side in (-1.0, 1.0)]
    low, high = _bracket([(t, slope(t)) for t in breaks])
    t_outside = _secant(low, high, slope(low), slope(high))
    depth = None if apart else _box_depth(a, u, half)
    return _solid_contact(a, b, rotation, excess, t_outside, depth, breaks)


def _solid_contact(
    a: Vector,
    b: Vector,
    rotation: Vector,
    excess: Callable[[Any], Vector],
    t_outside: Any,
    depth: list[Any] | None,
    breaks: list[Any],
) -> SymbolicContact:
    """Return the contact of a segment a-b given in the frame of a solid piece.

    Parameters
    ----------
    excess
        From a parameter to the vector from the piece to that point of the segment; zero inside.
    t_outside
        Parameter of the nearest point where the two do not intersect.
    depth
        Depth, parameter and exit normal (3) where they do; None where that is not wanted.
    breaks
        Parameters where a contact interval may end.
    """
    gap = excess(t_outside)
    outside = norm(gap)
    cut = outside <= TINY
    if depth is None:
        depth = [0.0, t_outside, 0.0, 0.0, 1.0]
    distance = ca.if_else(cut, -ca.fmax(depth[0], 0.0), outside)
    t = ca.if_else(cut, depth[1], t_outside)
    normal = pick(cut, depth[2:5], [x / ca.if_else(cut, 1.0, outside) for x in gap])
    others = [(s, norm(excess(s))) for s in breaks]
    t_second = ca.if_else(cut, t, _second(t, outside, norm(between(a, b)), others))
    gap_second = excess(t_second)
    return SymbolicContact(
        distance,
        ca.if_else(cut, distance, norm(gap_second)),
        t,
        t_second,
        rotate(rotation, normal),
        rotate(rotation, pick(cut, normal, unit(gap_second, normal))),
    )


def _segment_sphere(ends: Vector, piece: Vector, *, apart: bool = False) -> SymbolicContact:  # noqa: ARG001
    a, u = ends[0:3], between(ends[0:3], ends[3:6])
    t = clip(ratio(dot(between(a, piece[0:3]), u), dot(u, u)))
    gap = between(piece[0:3], at(ends, t))
    normal = unit(gap, perpendicular(u))
    distance = norm(gap) - piece[3]
    return SymbolicContact(distance, distance, t, t, normal, normal)


def _cylinder_excess(x: Vector, radius: Any, half: Any) -> Vector:
    rho = ca.sqrt(x[0] ** 2 + x[1] ** 2)
    scale = ratio(ca.fmax(rho - radius, 0.0), rho)
    along = ca.if_else(x[2] > 0, ca.fmax(x[2] - half, 0.0), -ca.fmax(-x[2] - half, 0.0))
    return [scale * x[0], scale * x[1], along]


def _segment_cylinder(ends: Vector, piece: Vector, *, apart: bool = False) -> SymbolicContact:
    """Return the contact for a solid cylinder with flat ends.

    Only over the rim is the derivative not linear or of known sign; there Newton's iteration runs inside the
    bracket, by halves where it leaves it.
    """
    center, rotation, radius, half = piece[0:3], piece[3:12], piece[12], piece[13]
    a, b = into_frame(rotation, center, ends[0:3]), into_frame(rotation, center, ends[3:6])
    u = between(a, b)

    def excess(t: Any) -> Vector:
        return _cylinder_excess(blend(a, b, t), radius, half)

    def slope(t: Any) -> Any:
        return dot(excess(t), u)

    square = u[0] ** 2 + u[1] ** 2
    product = a[0] * u[0] + a[1] * u[1]
    root = ca.sqrt(ca.fmax(product**2 - square * (a[0] ** 2 + a[1] ** 2 - radius**2), 0.0))
    breaks: list[Any] = [0.0, 1.0]
    breaks += [clip(ratio(side * half - a[2], u[2])) for side in (-1.0, 1.0)]
    t_axis = clip(ratio(-product, square))
    breaks += [t_axis, clip(ratio(-product - root, square)), clip(ratio(-product + root, square))]
    low, high = _bracket([(t, slope(t)) for t in breaks])
    slope_low, slope_high = slope(low), slope(high)
    t = _secant(low, high, slope_low, slope_high)
    settled = ca.logic_or(slope_low >= 0, slope_high <= 0)
    for _ in range(9):
        x = blend(a, b, t)
        rho = ca.sqrt(x[0] ** 2 + x[1] ** 2)
        gap = _cylinder_excess(x, radius, half)
        value = dot(gap, u)
        low, high = ca.if_else(value < 0, t, low), ca.if_else(value < 0, high, t)
        rate = ratio(x[0] * u[0] + x[1] * u[1], rho)
        over_side, over_end = rho > radius, ca.fabs(x[2]) > half
        curvature = ca.if_else(over_side, rate**2 + ratio(rho - radius, rho) * (square - rate**2), 0.0)
        curvature += ca.if_else(over_end, u[2] ** 2, 0.0)
        newton = t - ratio(value, curvature, FAR)
        inside = ca.logic_and(newton >= low, newton <= high)
        t = ca.if_else(settled, t, ca.if_else(inside, newton, 0.5 * (low + high)))
    if apart:
        return _solid_contact(a, b, rotation, excess, t, None, breaks)
    first = ca.if_else(a[2] <= b[2], 0.0, 1.0)
    x = blend(a, b, t_axis)
    rho = ca.sqrt(x[0] ** 2 + x[1] ** 2)
    radial = unit([x[0], x[1], 0.0], unit([u[1], -u[0], 0.0], [1.0, 0.0, 0.0]))
    way_out = least(
        [
            [half - ca.fmin(a[2], b[2]), first, 0.0, 0.0, 1.0],
            [half + ca.fmax(a[2], b[2]), 1.0 - first, 0.0, 0.0, -1.0],
            [radius - rho, t_axis, *radial],
        ]
    )
    return _solid_contact(a, b, rotation, excess, t, [0.0, *way_out[1:]], breaks)


def _segment_pair(a: Vector, b: Vector, c: Vector, d: Vector) -> list[list[Any]]:
    """Return candidates [distance, t on a-b, s on c-d], among them the nearest pair of points.

    Each is a distance between true points of the two segments, so that rounding can only choose a worse one.
    The cross product keeps the interior solution accurate where the two are almost parallel.
    """
    u, v, w = between(a, b), between(c, d), between(a, c)
    normal = cross(u, v)
    square = dot(normal, normal)
    uu, vv = dot(u, u), dot(v, v)
    pairs = [
        (
            clip(ratio(dot(cross(w, v), normal), square)),
            clip(ratio(dot(cross(w, u), normal), square)),
        ),
        (0.0, clip(ratio(-dot(w, v), vv))),
        (1.0, clip(ratio(dot(between(c, b), v), vv))),
        (clip(ratio(dot(w, u), uu)), 0.0),
        (clip(ratio(dot(between(a, d), u), uu)), 1.0),
    ]
    return [[norm(between(blend(c, d, s), blend(a, b, t))), t, s] for t, s in pairs]


def _segment_segment(ends: Vector, piece: Vector, *, apart: bool = False) -> SymbolicContact:  # noqa: ARG001
    a, b, c, d = ends[0:3], ends[3:6], piece[0:3], piece[3:6]
    u, v = between(a, b), between(c, d)
    candidates = _segment_pair(a, b, c, d)
    distance, t, s = least(candidates)
    normal = unit(between(blend(c, d, s), at(ends, t)), unit(cross(u, v), perpendicular(u)))
    t_second = _second(t, distance, norm(u), [(k[1], k[0]) for k in candidates[1:]])
    s_second = clip(ratio(dot(between(c, at(ends, t_second)), v), dot(v, v)))
    gap = between(blend(c, d, s_second), at(ends, t_second))
    return SymbolicContact(distance, norm(gap), t, t_second, normal, unit(gap, normal), s, s_second)


def _segment_triangle(ends: Vector, piece: Vector, *, apart: bool = False) -> SymbolicContact:  # noqa: ARG001
    """Return the contact for a triangle.

    The nearest pair is an end over the face, or a point of an edge, or a piercing point.
    """
    a, b = ends[0:3], ends[3:6]
    u = between(a, b)
    corners = [piece[0:3], piece[3:6], piece[6:9]]
    raw = cross(between(corners[0], corners[1]), between(corners[0], corners[2]))
    area = norm(raw)
    flat = area > 1e-14
    face = [x / ca.if_else(flat, area, 1.0) for x in raw]
    height_a, height_b = dot(face, between(corners[0], a)), dot(face, between(corners[0], b))

    def over(x: Vector) -> Any:
        inside = flat
        for i in range(3):
            edge = between(corners[i], corners[(i + 1) % 3])
            inside = ca.logic_and(inside, dot(cross(edge, between(corners[i], x)), face) >= 0)
        return inside

    candidates = []
    for t, x, height in ((0.0, a, height_a), (1.0, b, height_b)):
        candidates.append([ca.if_else(over(x), ca.fabs(height), FAR), t, *add(x, face, -height)])
    for i in range(3):
        c, d = corners[i], corners[(i + 1) % 3]
        distance, t, s = least(_segment_pair(a, b, c, d))
        candidates.append([distance, t, *blend(c, d, s)])
    t_plane = clip(ratio(height_a, height_a - height_b))
    pierces = ca.logic_and(height_a * height_b < 0, over(at(ends, t_plane)))
    distance, t, *point = least(candidates)
    cut = ca.logic_or(pierces, distance <= TINY)
    t = ca.if_else(pierces, t_plane, t)
    upward = pick(flat, face, perpendicular(u))
    normal = pick(cut, upward, unit(between(point, at(ends, t)), upward))
    distance = ca.if_else(cut, 0.0, distance)
    t_second = _second(t, distance, norm(u), [(k[1], k[0]) for k in candidates])
    x = at(ends, t_second)
    height = dot(face, between(corners[0], x))
    nearest = [[ca.if_else(over(x), ca.fabs(height), FAR), *add(x, face, -height)]]
    for i in range(3):
        c, d = corners[i], corners[(i + 1) % 3]
        edge = between(c, d)
        foot = blend(c, d, clip(ratio(dot(between(c, x), edge), dot(edge, edge))))
        nearest.append([norm(between(foot, x)), *foot])
    distance_second, *foot = least(nearest)
    normal_second = unit(between(foot, x), normal)
    alone = ca.logic_or(cut, t_second == t)
    return SymbolicContact(
        distance,
        ca.if_else(alone, distance, distance_second),
        t,
        ca.if_else(alone, t, t_second),
        normal,
        pick(alone, normal, normal_second),
    )


class Formula(Protocol):
    """From a segment (6) and a piece to their contact; where they intersect and `apart` is set, it means nothing."""

    def __call__(self, ends: Vector, piece: Vector, *, apart: bool = False) -> SymbolicContact:
        """Return the contact."""
        ...


FORMULAS: dict[str, Formula] = {
    "box": _segment_box,
    "sphere": _segment_sphere,
    "cylinder": _segment_cylinder,
    "triangle": _segment_triangle,
    "segment": _segment_segment,
}
