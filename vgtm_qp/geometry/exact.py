"""Exact distances between a segment and a convex piece, as branch-free CasADi SX functions.

Each formula takes the segment as six numbers (both ends) and a piece as a flat parameter vector, and returns
the signed distance of the member's axis: the capsule's radius is subtracted by the caller. Squared distance
to a convex set is convex along a segment, so its derivative changes sign once: between two break points of
that derivative.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import casadi as ca

SHAPES = ("box", "sphere", "cylinder", "triangle", "segment")
"""Kinds of pieces; a segment is the axis of another member."""

WIDTH = 15
"""Numbers that describe an obstacle piece, see :func:`parameters_of`."""

PARALLEL = 0.02
"""A second contact is given where a member's distance grows by less than this fraction of its length."""

_DISTANCE_OUTPUTS = ("distance", "t", "normal", "point", "t_second", "distance_second", "normal_second")
_FAR = 1e30
_TINY = 1e-13

Vector = list[Any]


def parameters_of(shape: str) -> str:
    """Return what the parameter vector of `shape` holds, in order."""
    return {
        "box": "center (3), rotation (9, row-major, columns are the box's axes), half sizes (3)",
        "sphere": "center (3), radius",
        "cylinder": "center (3), rotation (9, third column is the axis), radius, half height",
        "triangle": "three vertices (9), counter-clockwise seen from outside",
        "segment": "two ends (6)",
    }[shape]


def _dot(a: Vector, b: Vector) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _add(a: Vector, b: Vector, factor: Any = 1.0) -> Vector:
    return [x + factor * y for x, y in zip(a, b, strict=True)]


def _between(a: Vector, b: Vector) -> Vector:
    return _add(b, a, -1.0)


def _norm(a: Vector) -> Any:
    return ca.sqrt(_dot(a, a))


def _pick(condition: Any, yes: Any, no: Any) -> Any:
    """Choose between scalars or, entry by entry, between lists of them."""
    if isinstance(yes, list):
        return [_pick(condition, y, n) for y, n in zip(yes, no, strict=True)]
    return ca.if_else(condition, yes, no)


def _clip(t: Any) -> Any:
    return ca.fmin(ca.fmax(t, 0.0), 1.0)


def _ratio(numerator: Any, denominator: Any, otherwise: Any = 0.0) -> Any:
    zero = denominator == 0
    return ca.if_else(zero, otherwise, numerator / ca.if_else(zero, 1.0, denominator))


def _least(candidates: list[list[Any]]) -> list[Any]:
    """Return the candidate whose first entry is least."""
    best = candidates[0]
    for candidate in candidates[1:]:
        best = _pick(candidate[0] < best[0], candidate, best)
    return best


def _unit(a: Vector, fallback: Vector) -> Vector:
    length = _norm(a)
    usable = length > _TINY
    scaled: Vector = _pick(usable, [x / ca.if_else(usable, length, 1.0) for x in a], fallback)
    return scaled


def _perpendicular(u: Vector) -> Vector:
    """Return a unit vector normal to `u`: its cross product with the axis it is least aligned with."""
    x, y, z = (ca.fabs(c) for c in u)
    first, second = ca.logic_and(x <= y, x <= z), y <= z
    axis = [
        ca.if_else(first, 1.0, 0.0),
        ca.if_else(first, 0.0, ca.if_else(second, 1.0, 0.0)),
        ca.if_else(first, 0.0, ca.if_else(second, 0.0, 1.0)),
    ]
    return _unit(_cross(u, axis), [0.0, 0.0, 1.0])


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
    inside = low + (high - low) * _ratio(-slope_low, slope_high - slope_low)
    return ca.if_else(slope_low >= 0, low, ca.if_else(slope_high <= 0, high, inside))


def _into_frame(rotation: Vector, center: Vector, x: Vector) -> Vector:
    return _rotate_back(rotation, _between(center, x))


def _rotate_back(rotation: Vector, x: Vector) -> Vector:
    return [rotation[c] * x[0] + rotation[3 + c] * x[1] + rotation[6 + c] * x[2] for c in range(3)]


def _rotate(rotation: Vector, x: Vector) -> Vector:
    return [_dot(rotation[3 * r : 3 * r + 3], x) for r in range(3)]


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
    b = _add(a, u)
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
        t = _clip(((edge_i - a[i]) * u[i] + (edge_j - a[j]) * u[j]) / length**2)
        normal: list[Any] = [0.0, 0.0, 0.0]
        normal[i], normal[j] = ni, nj
        candidates.append([ca.if_else(usable, depth, _FAR), t, *normal])
    return _least(candidates)


def _segment_box(ends: Vector, piece: Vector) -> Vector:
    """Return the outputs of :func:`distance_function` for a box.

    The squared distance is piecewise quadratic with at most six break points, where a coordinate crosses a
    face.
    """
    center, rotation, half = piece[0:3], piece[3:12], piece[12:15]
    a, b = _into_frame(rotation, center, ends[0:3]), _into_frame(rotation, center, ends[3:6])
    u = _between(a, b)

    def at(t: Any) -> Vector:
        # Written from both ends, so that t = 1 gives b without rounding.
        return [(1.0 - t) * x + t * y for x, y in zip(a, b, strict=True)]

    breaks: list[Any] = [0.0, 1.0]
    breaks += [_clip(_ratio(side * half[c] - a[c], u[c])) for c in range(3) for side in (-1.0, 1.0)]
    excesses = [_box_excess(at(t), half) for t in breaks]
    low, high = _bracket([(t, _dot(e, u)) for t, e in zip(breaks, excesses, strict=True)])
    slope_low, slope_high = _dot(_box_excess(at(low), half), u), _dot(_box_excess(at(high), half), u)
    t_outside = _secant(low, high, slope_low, slope_high)
    gap = _box_excess(at(t_outside), half)
    outside = _norm(gap)
    depth = _box_depth(a, u, half)
    cut = outside <= _TINY
    distance = ca.if_else(cut, -ca.fmax(depth[0], 0.0), outside)
    t = ca.if_else(cut, depth[1], t_outside)
    normal = _pick(cut, depth[2:5], [x / ca.if_else(cut, 1.0, outside) for x in gap])
    t_second = _second(
        t, ca.fmax(distance, 0.0), _norm(u), [(s, _norm(e)) for s, e in zip(breaks, excesses, strict=True)]
    )
    gap_second = _box_excess(at(t_second), half)
    distance_second = _norm(gap_second)
    normal_second = _unit(gap_second, normal)
    t_second = ca.if_else(cut, t, t_second)
    distance_second = ca.if_else(cut, distance, distance_second)
    return _outputs(
        ends,
        distance,
        t,
        _rotate(rotation, normal),
        t_second,
        distance_second,
        _rotate(rotation, normal_second),
    )


def _segment_sphere(ends: Vector, piece: Vector) -> Vector:
    a, u = ends[0:3], _between(ends[0:3], ends[3:6])
    t = _clip(_ratio(_dot(_between(a, piece[0:3]), u), _dot(u, u)))
    gap = _between(piece[0:3], _at(ends, t))
    normal = _unit(gap, _perpendicular(u))
    distance = _norm(gap) - piece[3]
    return _outputs(ends, distance, t, normal, t, distance, normal)


def _cylinder_excess(x: Vector, radius: Any, half: Any) -> Vector:
    rho = ca.sqrt(x[0] ** 2 + x[1] ** 2)
    scale = _ratio(ca.fmax(rho - radius, 0.0), rho)
    along = ca.if_else(x[2] > 0, ca.fmax(x[2] - half, 0.0), -ca.fmax(-x[2] - half, 0.0))
    return [scale * x[0], scale * x[1], along]


def _segment_cylinder(ends: Vector, piece: Vector) -> Vector:
    """Return the outputs of :func:`distance_function` for a solid cylinder with flat ends.

    Only over the rim is the derivative not linear or of known sign; there Newton's iteration runs inside the
    bracket, by halves where it leaves it.
    """
    center, rotation, radius, half = piece[0:3], piece[3:12], piece[12], piece[13]
    a, b = _into_frame(rotation, center, ends[0:3]), _into_frame(rotation, center, ends[3:6])
    u = _between(a, b)

    def at(t: Any) -> Vector:
        return [(1.0 - t) * x + t * y for x, y in zip(a, b, strict=True)]

    def excess(t: Any) -> Vector:
        return _cylinder_excess(at(t), radius, half)

    def slope(t: Any) -> Any:
        return _dot(excess(t), u)

    square = u[0] ** 2 + u[1] ** 2
    product = a[0] * u[0] + a[1] * u[1]
    root = ca.sqrt(ca.fmax(product**2 - square * (a[0] ** 2 + a[1] ** 2 - radius**2), 0.0))
    breaks: list[Any] = [0.0, 1.0]
    breaks += [_clip(_ratio(side * half - a[2], u[2])) for side in (-1.0, 1.0)]
    t_axis = _clip(_ratio(-product, square))
    breaks += [t_axis, _clip(_ratio(-product - root, square)), _clip(_ratio(-product + root, square))]
    excesses = [excess(t) for t in breaks]
    low, high = _bracket([(t, _dot(e, u)) for t, e in zip(breaks, excesses, strict=True)])
    slope_low, slope_high = slope(low), slope(high)
    t = _secant(low, high, slope_low, slope_high)
    settled = ca.logic_or(slope_low >= 0, slope_high <= 0)
    for _ in range(9):
        x = at(t)
        rho = ca.sqrt(x[0] ** 2 + x[1] ** 2)
        gap = _cylinder_excess(x, radius, half)
        value = _dot(gap, u)
        low, high = ca.if_else(value < 0, t, low), ca.if_else(value < 0, high, t)
        rate = _ratio(x[0] * u[0] + x[1] * u[1], rho)
        over_side, over_end = rho > radius, ca.fabs(x[2]) > half
        curvature = ca.if_else(over_side, rate**2 + _ratio(rho - radius, rho) * (square - rate**2), 0.0)
        curvature += ca.if_else(over_end, u[2] ** 2, 0.0)
        newton = t - _ratio(value, curvature, _FAR)
        inside = ca.logic_and(newton >= low, newton <= high)
        t = ca.if_else(settled, t, ca.if_else(inside, newton, 0.5 * (low + high)))
    gap = excess(t)
    outside = _norm(gap)
    first = ca.if_else(a[2] <= b[2], 0.0, 1.0)
    x = at(t_axis)
    rho = ca.sqrt(x[0] ** 2 + x[1] ** 2)
    sideways = _perpendicular([u[0], u[1], 0.0])
    across = _cross([u[0], u[1], 0.0], [0.0, 0.0, 1.0])
    radial = _unit([x[0], x[1], 0.0], _unit(across, sideways))
    depth = _least(
        [
            [half - ca.fmin(a[2], b[2]), first, 0.0, 0.0, 1.0],
            [half + ca.fmax(a[2], b[2]), 1.0 - first, 0.0, 0.0, -1.0],
            [radius - rho, t_axis, *radial],
        ]
    )
    cut = outside <= _TINY
    distance = ca.if_else(cut, -ca.fmax(depth[0], 0.0), outside)
    t = ca.if_else(cut, depth[1], t)
    normal = _pick(cut, depth[2:5], [g / ca.if_else(cut, 1.0, outside) for g in gap])
    t_second = _second(
        t, ca.fmax(distance, 0.0), _norm(u), [(s, _norm(e)) for s, e in zip(breaks, excesses, strict=True)]
    )
    gap_second = excess(t_second)
    distance_second = ca.if_else(cut, distance, _norm(gap_second))
    normal_second = _unit(gap_second, normal)
    t_second = ca.if_else(cut, t, t_second)
    return _outputs(
        ends,
        distance,
        t,
        _rotate(rotation, normal),
        t_second,
        distance_second,
        _rotate(rotation, normal_second),
    )


def _segment_pair(a: Vector, b: Vector, c: Vector, d: Vector) -> list[list[Any]]:
    """Return candidates [distance, t on a-b, s on c-d], among them the nearest pair of points.

    Each is a distance between true points of the two segments, so that rounding can only choose a worse one.
    The cross product keeps the interior solution accurate where the two are almost parallel.
    """
    u, v, w = _between(a, b), _between(c, d), _between(a, c)
    normal = _cross(u, v)
    square = _dot(normal, normal)
    uu, vv = _dot(u, u), _dot(v, v)
    pairs = [
        (
            _clip(_ratio(_dot(_cross(w, v), normal), square)),
            _clip(_ratio(_dot(_cross(w, u), normal), square)),
        ),
        (0.0, _clip(_ratio(-_dot(w, v), vv))),
        (1.0, _clip(_ratio(_dot(_between(c, b), v), vv))),
        (_clip(_ratio(_dot(w, u), uu)), 0.0),
        (_clip(_ratio(_dot(_between(a, d), u), uu)), 1.0),
    ]
    return [[_norm(_between(_blend(c, d, s), _blend(a, b, t))), t, s] for t, s in pairs]


def _blend(a: Vector, b: Vector, t: Any) -> Vector:
    return [(1.0 - t) * x + t * y for x, y in zip(a, b, strict=True)]


def _at(ends: Vector, t: Any) -> Vector:
    return _blend(ends[0:3], ends[3:6], t)


def _segment_segment(ends: Vector, piece: Vector) -> Vector:
    a, b, c, d = ends[0:3], ends[3:6], piece[0:3], piece[3:6]
    u, v = _between(a, b), _between(c, d)
    candidates = _segment_pair(a, b, c, d)
    distance, t, s = _least(candidates)
    normal = _unit(_between(_blend(c, d, s), _at(ends, t)), _unit(_cross(u, v), _perpendicular(u)))
    t_second = _second(t, distance, _norm(u), [(k[1], k[0]) for k in candidates[1:]])
    s_second = _clip(_ratio(_dot(_between(c, _at(ends, t_second)), v), _dot(v, v)))
    gap = _between(_blend(c, d, s_second), _at(ends, t_second))
    outputs = _outputs(ends, distance, t, normal, t_second, _norm(gap), _unit(gap, normal))
    return [*outputs, [s], [s_second]]


def _segment_triangle(ends: Vector, piece: Vector) -> Vector:
    """Return the outputs of :func:`distance_function` for a triangle.

    The nearest pair is an end over the face, or a point of an edge, or a piercing point.
    """
    a, b = ends[0:3], ends[3:6]
    u = _between(a, b)
    corners = [piece[0:3], piece[3:6], piece[6:9]]
    raw = _cross(_between(corners[0], corners[1]), _between(corners[0], corners[2]))
    area = _norm(raw)
    flat = area > 1e-14
    face = [x / ca.if_else(flat, area, 1.0) for x in raw]
    height_a, height_b = _dot(face, _between(corners[0], a)), _dot(face, _between(corners[0], b))

    def over(x: Vector) -> Any:
        inside = flat
        for i in range(3):
            edge = _between(corners[i], corners[(i + 1) % 3])
            inside = ca.logic_and(inside, _dot(_cross(edge, _between(corners[i], x)), face) >= 0)
        return inside

    candidates = []
    for t, x, height in ((0.0, a, height_a), (1.0, b, height_b)):
        candidates.append([ca.if_else(over(x), ca.fabs(height), _FAR), t, *_add(x, face, -height)])
    for i in range(3):
        c, d = corners[i], corners[(i + 1) % 3]
        distance, t, s = _least(_segment_pair(a, b, c, d))
        candidates.append([distance, t, *_blend(c, d, s)])
    t_plane = _clip(_ratio(height_a, height_a - height_b))
    pierces = ca.logic_and(height_a * height_b < 0, over(_at(ends, t_plane)))
    distance, t, *point = _least(candidates)
    cut = ca.logic_or(pierces, distance <= _TINY)
    t = ca.if_else(pierces, t_plane, t)
    upward = _pick(flat, face, _perpendicular(u))
    normal = _pick(cut, upward, _unit(_between(point, _at(ends, t)), upward))
    distance = ca.if_else(cut, 0.0, distance)
    t_second = _second(t, distance, _norm(u), [(k[1], k[0]) for k in candidates])
    x = _at(ends, t_second)
    height = _dot(face, _between(corners[0], x))
    nearest = [[ca.if_else(over(x), ca.fabs(height), _FAR), *_add(x, face, -height)]]
    for i in range(3):
        c, d = corners[i], corners[(i + 1) % 3]
        edge = _between(c, d)
        foot = _blend(c, d, _clip(_ratio(_dot(_between(c, x), edge), _dot(edge, edge))))
        nearest.append([_norm(_between(foot, x)), *foot])
    distance_second, *foot = _least(nearest)
    normal_second = _unit(_between(foot, x), normal)
    alone = ca.logic_or(cut, t_second == t)
    return _outputs(
        ends,
        distance,
        t,
        normal,
        ca.if_else(alone, t, t_second),
        ca.if_else(alone, distance, distance_second),
        _pick(alone, normal, normal_second),
    )


def _outputs(
    ends: Vector,
    distance: Any,
    t: Any,
    normal: Vector,
    t_second: Any,
    distance_second: Any,
    normal_second: Vector,
) -> Vector:
    point = _add(_at(ends, t), normal, -distance)
    return [[distance], [t], normal, point, [t_second], [distance_second], normal_second]


def _support(shape: str, piece: Vector, normal: Vector) -> Any:
    """Return the greatest n.x over the points x of the piece."""
    if shape == "box":
        turned = _rotate_back(piece[3:12], normal)
        spread = sum(ca.fabs(x) * h for x, h in zip(turned, piece[12:15], strict=True))
        return _dot(normal, piece[0:3]) + spread
    if shape == "sphere":
        return _dot(normal, piece[0:3]) + piece[3]
    if shape == "cylinder":
        turned = _rotate_back(piece[3:12], normal)
        across = ca.sqrt(turned[0] ** 2 + turned[1] ** 2)
        return _dot(normal, piece[0:3]) + across * piece[12] + ca.fabs(turned[2]) * piece[13]
    corners = [piece[i : i + 3] for i in range(0, 9 if shape == "triangle" else 6, 3)]
    highest = _dot(normal, corners[0])
    for corner in corners[1:]:
        highest = ca.fmax(highest, _dot(normal, corner))
    return highest


_FORMULAS: dict[str, Callable[[Vector, Vector], Vector]] = {
    "box": _segment_box,
    "sphere": _segment_sphere,
    "cylinder": _segment_cylinder,
    "triangle": _segment_triangle,
    "segment": _segment_segment,
}


def width(shape: str) -> int:
    """Return the length of the parameter vector of a piece."""
    return 6 if shape == "segment" else WIDTH


@cache
def distance_function(shape: str) -> ca.Function:
    """Return the exact distance from a segment to a piece.

    Inputs ``segment (6,)`` and ``piece (width(shape),)``. Outputs

    - ``distance``: from the segment to the piece, m. Where they intersect: minus the depth, which is the
      least translation that parts them for boxes and spheres, at least that for cylinders (the least along
      its axis or radius), and zero for triangles and segments;
    - ``t``: parameter in [0, 1] of the witness point on the segment (the first of several equally near ones);
    - ``normal (3,)``: unit, from the piece to the segment, or the way out where they intersect;
    - ``point (3,)``: the witness point on the piece, ``segment(t) - distance normal``;
    - ``t_second``, ``distance_second``, ``normal_second``: the other end of a contact interval, where the
    distance is
      larger by less than ``PARALLEL`` times the length; equal to the first where there is none;
    - for another segment also ``s`` and ``s_second``, the parameters on it.

    Raises
    ------
    KeyError
        `shape` is not one of ``SHAPES``.
    """
    segment, piece = ca.SX.sym("segment", 6), ca.SX.sym("piece", width(shape))
    outputs = _FORMULAS[shape](ca.vertsplit(segment), ca.vertsplit(piece))
    names = [*_DISTANCE_OUTPUTS, *(("s", "s_second") if shape == "segment" else ())]
    return ca.Function(
        f"distance_{shape}",
        [segment, piece],
        [ca.densify(ca.vertcat(*output)) for output in outputs],
        ["segment", "piece"],
        names,
    )


@cache
def plane_function(shape: str) -> ca.Function:
    """Return a lower bound of the distance from a segment to a piece: their gap along a unit normal.

    Inputs ``segment (6,)``, ``piece``, ``normal (3,)``; output ``gap``. It holds for any unit normal.
    """
    segment, piece, normal = ca.SX.sym("segment", 6), ca.SX.sym("piece", width(shape)), ca.SX.sym("normal", 3)
    gap = _gap(shape, ca.vertsplit(segment), ca.vertsplit(piece), ca.vertsplit(normal))
    return ca.Function(
        f"plane_{shape}", [segment, piece, normal], [gap], ["segment", "piece", "normal"], ["gap"]
    )


def _gap(shape: str, ends: Vector, piece: Vector, normal: Vector) -> Any:
    return ca.fmin(_dot(normal, ends[0:3]), _dot(normal, ends[3:6])) - _support(shape, piece, normal)


@cache
def sweep_function(shape: str) -> ca.Function:
    """Return a lower bound of the distance while the segment's ends move on straight lines, both at once.

    Inputs ``segment_a``, ``segment_b`` (6,), and the piece, which rests, or ``piece_a`` and ``piece_b`` for
    another segment that moves likewise. Outputs ``bound`` and the exact distances ``at_a``, ``at_middle``,
    ``at_b``.

    With a fixed normal the gap is a least of functions linear in time, hence concave: its least value over
    the motion stands at one end. Normals are those at both ends and the middle; beside them stands the motion
    bound: a distance changes by no more than the ends of the segments move.
    """
    other = shape == "segment"
    a, b = ca.SX.sym("segment_a", 6), ca.SX.sym("segment_b", 6)
    piece_a = ca.SX.sym("piece_a", width(shape))
    piece_b = ca.SX.sym("piece_b", 6) if other else piece_a
    segments = [ca.vertsplit(x) for x in (a, 0.5 * (a + b), b)]
    pieces = [ca.vertsplit(x) for x in (piece_a, 0.5 * (piece_a + piece_b) if other else piece_a, piece_b)]
    exact = [_FORMULAS[shape](s, p) for s, p in zip(segments, pieces, strict=True)]
    distances = [output[0][0] for output in exact]
    normals = [output[2] for output in exact]
    motion = _travel(segments[0], segments[2])
    if other:
        motion += _travel(pieces[0], pieces[2])

    def gap(end: int, normal: int) -> Any:
        return _gap(shape, segments[end], pieces[end], normals[normal])

    halves = []
    for start in (0, 1):
        bound = 0.5 * (distances[start] + distances[start + 1] - 0.5 * motion)
        for normal in range(3):
            bound = ca.fmax(bound, ca.fmin(gap(start, normal), gap(start + 1, normal)))
        halves.append(bound)
    inputs, names = [a, b, piece_a], ["segment_a", "segment_b", "piece"]
    if other:
        inputs, names = [a, b, piece_a, piece_b], ["segment_a", "segment_b", "piece_a", "piece_b"]
    outputs = [ca.densify(x) for x in (ca.fmin(*halves), *distances)]
    return ca.Function(f"sweep_{shape}", inputs, outputs, names, ["bound", "at_a", "at_middle", "at_b"])


def _travel(a: Vector, b: Vector) -> Any:
    return ca.fmax(_norm(_between(a[0:3], b[0:3])), _norm(_between(a[3:6], b[3:6])))
