"""Exact distances between a segment and a convex piece, as branch-free CasADi SX functions.

Each formula takes the segment as six numbers (both ends) and a piece as a flat parameter vector, and returns
the signed distance of the body's axis: the capsule's radius is subtracted by the caller. Squared distance
to a convex set is convex along a segment, so its derivative changes sign once: between two break points of
that derivative.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca

from vgtm_qp.geometry.formulas import FAR, FORMULAS
from vgtm_qp.geometry.symbolic import Vector, add, at, between, dot, norm, ratio, rotate_back

SHAPES = ("box", "sphere", "cylinder", "triangle", "segment")
"""Kinds of pieces; a segment is the axis of another body."""


_LEAST_SQUARE = 0.1
"""Least |n|^2 of a normal between two others that still gives a plane."""

WIDTH = 15
"""Numbers that describe an obstacle piece, see :func:`parameters_of`."""

CONTACT = 13
"""Numbers that describe a contact, see :func:`follow_function`."""

KNOWN = WIDTH + 4
"""Numbers that describe a pair before a motion, see :func:`follow_function`."""

SECOND_CONTACT = 0.2
"""Two contacts of a body with one piece are apart by at least this fraction of the body's length."""


def parameters_of(shape: str) -> str:
    """Return what the parameter vector of `shape` holds, in order."""
    return {
        "box": "center (3), rotation (9, row-major, columns are the box's axes), half sizes (3)",
        "sphere": "center (3), radius",
        "cylinder": "center (3), rotation (9, third column is the axis), radius, half height",
        "triangle": "three vertices (9), counter-clockwise seen from outside",
        "segment": "two ends (6)",
    }[shape]


def _support(shape: str, piece: Vector, normal: Vector) -> Any:
    """Return the greatest n.x over the points x of the piece."""
    if shape == "box":
        turned = rotate_back(piece[3:12], normal)
        spread = sum(ca.fabs(x) * h for x, h in zip(turned, piece[12:15], strict=True))
        return dot(normal, piece[0:3]) + spread
    if shape == "sphere":
        return dot(normal, piece[0:3]) + piece[3]
    if shape == "cylinder":
        turned = rotate_back(piece[3:12], normal)
        across = ca.sqrt(turned[0] ** 2 + turned[1] ** 2)
        return dot(normal, piece[0:3]) + across * piece[12] + ca.fabs(turned[2]) * piece[13]
    corners = [piece[i : i + 3] for i in range(0, 9 if shape == "triangle" else 6, 3)]
    highest = dot(normal, corners[0])
    for corner in corners[1:]:
        highest = ca.fmax(highest, dot(normal, corner))
    return highest


def width(shape: str) -> int:
    """Return the length of the parameter vector of a piece."""
    return 6 if shape == "segment" else WIDTH


@cache
def distance_function(shape: str) -> ca.Function:
    """Return the exact distance from a segment to a piece.

    Inputs ``segment (6,)`` and ``piece (width(shape),)``. Outputs

    - ``distance``: from the segment to the piece, m. Where they intersect: minus the depth (the least
      translation that parts them) for boxes and spheres, zero for the other shapes. It changes by no more
      than the ends move;
    - ``distance_second``: at the other end of a contact interval, where it is larger by less than
      ``PARALLEL`` times the length; the same as the first where there is none;
    - ``t``, ``t_second``: parameters in [0, 1] of those points on the segment;
    - ``normal (3,)``, ``normal_second (3,)``: unit, from the piece to the segment, or the way out where they
      intersect;
    - ``point (3,)``, ``point_second (3,)``: the witness points on the piece, ``segment(t) - distance
      normal``;
    - ``s``, ``s_second``: parameters on the piece where that is a segment, else zero.

    Raises
    ------
    KeyError
        `shape` is not one of ``SHAPES``.
    """
    segment, piece = ca.SX.sym("segment", 6), ca.SX.sym("piece", width(shape))
    ends = ca.vertsplit(segment)
    contact = FORMULAS[shape](ends, ca.vertsplit(piece))
    outputs = {
        "distance": contact.distance,
        "distance_second": contact.distance_second,
        "t": contact.t,
        "t_second": contact.t_second,
        "normal": ca.vertcat(*contact.normal),
        "normal_second": ca.vertcat(*contact.normal_second),
        "point": ca.vertcat(*add(at(ends, contact.t), contact.normal, -contact.distance)),
        "point_second": ca.vertcat(
            *add(at(ends, contact.t_second), contact.normal_second, -contact.distance_second)
        ),
        "s": contact.s,
        "s_second": contact.s_second,
    }
    return ca.Function(
        f"distance_{shape}",
        [segment, piece],
        [ca.densify(ca.SX(x)) for x in outputs.values()],
        ["segment", "piece"],
        list(outputs),
    )


@cache
def sweep_function(shape: str) -> ca.Function:
    """Return a lower bound of the distance while the segment's ends move on straight lines, both at once.

    Inputs ``segment_a``, ``segment_b`` (6,), and the piece, which rests, or ``piece_a`` and ``piece_b`` for
    another segment that moves likewise. Outputs ``bound`` and the exact distances ``at_a`` and ``at_b``.

    The bound is the best of two: the planes of :func:`_turning_gap` between the contacts at both ends, and that a
    distance changes by no more than the ends of the segments move.
    """
    other = shape == "segment"
    a, b = ca.SX.sym("segment_a", 6), ca.SX.sym("segment_b", 6)
    piece_a = ca.SX.sym("piece_a", width(shape))
    piece_b = ca.SX.sym("piece_b", 6) if other else piece_a
    segments, pieces = (ca.vertsplit(a), ca.vertsplit(b)), (ca.vertsplit(piece_a), ca.vertsplit(piece_b))
    contacts = [FORMULAS[shape](s, p) for s, p in zip(segments, pieces, strict=True)]
    motion = _travel(*segments)
    if other:
        motion += _travel(*pieces)
    bound = 0.5 * (contacts[0].distance + contacts[1].distance - motion)
    bound = ca.fmax(bound, _turning_gap(shape, segments, pieces, (contacts[0].normal, contacts[1].normal)))
    inputs, names = [a, b, piece_a], ["segment_a", "segment_b", "piece"]
    if other:
        inputs, names = [a, b, piece_a, piece_b], ["segment_a", "segment_b", "piece_a", "piece_b"]
    outputs = [ca.densify(x) for x in (bound, *(contact.distance for contact in contacts))]
    return ca.Function(f"sweep_{shape}", inputs, outputs, names, ["bound", "at_a", "at_b"])


def _turning_gap(
    shape: str,
    segments: tuple[Vector, Vector],
    pieces: tuple[Vector, Vector],
    normals: tuple[Vector, Vector],
) -> Any:
    """Return a lower bound of the distance over a straight motion, by a plane that turns with it.

    With n(s) = (1 - s) n_0 + s n_1 between two unit normals, the gap of a point x(s) = (1 - s) x_0 + s x_1 to a convex
    piece of support function S is

        n.x - S(n) >= (1 - s) (n_0.x_0 - S(n_0)) + s (n_1.x_1 - S(n_1)) - w (n_1 - n_0).(x_1 - x_0),   w = s (1 - s),

    since S is convex, and |n|^2 = 1 - w |n_1 - n_0|^2. With m the lesser of both gaps and c the last product where it
    is positive, the distance along n/|n| is at least the least of (m - c w) / |n| over 0 <= w <= 1/4. Where the normals
    are those of the contacts at both ends, m is the lesser of the two distances.
    """
    turn = between(*normals)
    square = dot(turn, turn)
    if shape == "segment":
        points = [
            (between(y0, x0), between(y1, x1))
            for x0, x1 in zip(_halves(segments[0]), _halves(segments[1]), strict=True)
            for y0, y1 in zip(_halves(pieces[0]), _halves(pieces[1]), strict=True)
        ]
        supports: tuple[Any, Any] = (0.0, 0.0)
    else:
        points = list(zip(_halves(segments[0]), _halves(segments[1]), strict=True))
        supports = (_support(shape, pieces[0], normals[0]), _support(shape, pieces[1], normals[1]))
    bound: Any = FAR
    for start, end in points:
        gap = ca.fmin(dot(normals[0], start) - supports[0], dot(normals[1], end) - supports[1])
        bend = ca.fmax(dot(turn, between(start, end)), 0.0)
        # (m - c w) / sqrt(1 - k w) falls up to this w and rises after it.
        lowest = ratio(2.0 * bend - square * gap, bend * square, 1.0)
        w = ca.fmin(ca.fmax(lowest, 0.0), 0.25)
        along = (gap - bend * w) / ca.sqrt(ca.fmax(1.0 - square * w, _LEAST_SQUARE))
        bound = ca.fmin(bound, ca.fmin(gap, along))
    # Normals that are further apart may be opposite: between them there is no plane.
    return ca.if_else(square <= 4.0 * (1.0 - _LEAST_SQUARE), bound, -FAR)


def _halves(ends: Vector) -> tuple[Vector, Vector]:
    return ends[0:3], ends[3:6]


@cache
def follow_function(shape: str) -> ca.Function:
    """Return the contacts of a pair after a straight motion, and a lower bound of its distance meanwhile.

    Inputs ``ends (24,)``, before and after it for each end of the body, then of the other body (ignored for an
    obstacle, which rests); and ``known (19,)``: the piece (15; ignored for two bodies), the radius or sum of radii, and
    a unit normal (3), best that of the contact before.

    Output ``contacts (26,)``: ``CONTACT`` numbers for each of two contacts after the motion: surface distance, weights
    (4,) of the four ends in the normal velocity, normal (3,), t, witness point (3,), and the bound over the motion of
    :func:`_turning_gap`. The second distance is ``FAR`` where the second contact needs no row, as is the
    second bound. Where axis and piece intersect, the distance is minus the radius and the other numbers mean nothing.
    """
    both, known = ca.SX.sym("ends", 24), ca.SX.sym("known", KNOWN)
    points = ca.reshape(both, 3, 8)
    starts, ends = (ca.vertsplit(ca.vec(points[:, k::2])) for k in (0, 1))
    piece, radius, normal = ca.vertsplit(known[:WIDTH]), known[WIDTH], ca.vertsplit(known[WIDTH + 1 :])
    mutual = shape == "segment"
    others = (starts[6:], ends[6:]) if mutual else (piece, piece)
    c = FORMULAS[shape](ends[:6], others[1], apart=True)
    share = 1.0 if mutual else 0.0

    def contact(distance: Any, t: Any, s: Any, n: Vector) -> list[Any]:
        weights = [1.0 - t, t, share * (s - 1.0), -share * s]
        return [distance - radius, *weights, *n, t, *add(at(ends[:6], t), n, -distance)]

    second = contact(c.distance_second, c.t_second, c.s_second, c.normal_second)
    second[0] = ca.if_else(ca.fabs(c.t_second - c.t) >= SECOND_CONTACT, second[0], FAR)
    bound = _turning_gap(shape, (starts[:6], ends[:6]), others, (normal, c.normal))
    contacts = ca.vertcat(*contact(c.distance, c.t, c.s, c.normal), bound - radius, *second, FAR)
    return ca.Function(
        f"follow_{shape}", [both, known], [ca.densify(ca.cse(contacts))], ["ends", "known"], ["contacts"]
    )


def _travel(a: Vector, b: Vector) -> Any:
    return ca.fmax(norm(between(a[0:3], b[0:3])), norm(between(a[3:6], b[3:6])))
