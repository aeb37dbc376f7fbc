"""Exact distances between a segment and a convex piece, as branch-free CasADi SX functions.

Each formula takes the segment as six numbers (both ends) and a piece as a flat parameter vector, and returns
the signed distance of the member's axis: the capsule's radius is subtracted by the caller. Squared distance
to a convex set is convex along a segment, so its derivative changes sign once: between two break points of
that derivative.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca

from vgtm_qp.geometry.formulas import FORMULAS
from vgtm_qp.geometry.symbolic import Vector, add, at, between, dot, norm, rotate_back

SHAPES = ("box", "sphere", "cylinder", "triangle", "segment")
"""Kinds of pieces; a segment is the axis of another member."""

WIDTH = 15
"""Numbers that describe an obstacle piece, see :func:`parameters_of`."""


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
    return ca.fmin(dot(normal, ends[0:3]), dot(normal, ends[3:6])) - _support(shape, piece, normal)


@cache
def sweep_function(shape: str) -> ca.Function:
    """Return a lower bound of the distance while the segment's ends move on straight lines, both at once.

    Inputs ``segment_a``, ``segment_b`` (6,), and the piece, which rests, or ``piece_a`` and ``piece_b`` for
    another segment that moves likewise. Outputs ``bound`` and the exact distances ``at_a`` and ``at_b``.

    With a fixed normal the gap is a least of functions linear in time, hence concave: its least value over
    the motion stands at one end. The normals are those at both ends; beside them stands the motion bound: a
    distance changes by no more than the ends of the segments move.
    """
    other = shape == "segment"
    a, b = ca.SX.sym("segment_a", 6), ca.SX.sym("segment_b", 6)
    piece_a = ca.SX.sym("piece_a", width(shape))
    piece_b = ca.SX.sym("piece_b", 6) if other else piece_a
    segments, pieces = [ca.vertsplit(a), ca.vertsplit(b)], [ca.vertsplit(piece_a), ca.vertsplit(piece_b)]
    contacts = [FORMULAS[shape](s, p) for s, p in zip(segments, pieces, strict=True)]
    motion = _travel(*segments)
    if other:
        motion += _travel(*pieces)
    bound = 0.5 * (contacts[0].distance + contacts[1].distance - motion)
    for contact in contacts:
        gaps = [_gap(shape, s, p, contact.normal) for s, p in zip(segments, pieces, strict=True)]
        bound = ca.fmax(bound, ca.fmin(*gaps))
    inputs, names = [a, b, piece_a], ["segment_a", "segment_b", "piece"]
    if other:
        inputs, names = [a, b, piece_a, piece_b], ["segment_a", "segment_b", "piece_a", "piece_b"]
    outputs = [ca.densify(x) for x in (bound, *(contact.distance for contact in contacts))]
    return ca.Function(f"sweep_{shape}", inputs, outputs, names, ["bound", "at_a", "at_b"])


def _travel(a: Vector, b: Vector) -> Any:
    return ca.fmax(norm(between(a[0:3], b[0:3])), norm(between(a[3:6], b[3:6])))
