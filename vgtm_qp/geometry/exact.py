"""CasADi functions of one pair: its contacts, and bounds of its distance over a motion.

A pair is a body and a piece, or two bodies. It is one vector: both ends of the body's axis (6), the piece
(15) or the ends of the other body (6), and the radius of the body or the sum of both radii. Distances are
from surface to surface, m. A contact is ``CONTACT`` numbers: signed distance; weights (4) of the four ends in
its change (of the body, then of the other body, zero for a piece); the unit normal (3) from the piece to the
body, which leads out where the two intersect; and 1 if it is the only contact of its pair, else 0.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import casadi as ca

from vgtm_qp.geometry.formulas import (
    APART,
    FAR,
    FORMULAS,
    SymbolicContact,
    clip,
    nearest_of_cylinder,
    norm,
    ratio,
)

WIDTH = 15
"""Numbers that describe an obstacle piece, see :class:`vgtm_qp.geometry.shapes.Obstacle`."""

CONTACT = 9
"""Numbers that describe a contact."""

NORMAL = slice(-4, -1)
"""The numbers of a contact that are its normal."""

PROOF = 1e-6
"""Greatest flaw, over the unit of length, of an answer of FCL that counts as proven."""

NORMAL_FROM = 1e-3
"""Distance of two axes, over the unit of length, below which the normal is mostly rounding."""

SECOND_CONTACT = 0.2
"""Two contacts of a body with one piece are apart by at least this fraction of the body's length."""

_LEAST_SQUARE = 0.1
"""Least |n|^2 of a normal between two others that still gives a plane."""
_MOST_TURNED = 4.0 * (1.0 - _LEAST_SQUARE)
"""Greatest |n_1 - n_0|^2 of two normals with such a plane all the way between them."""


def width(shape: str) -> int:
    """Return the length of the parameter vector of a piece."""
    return 6 if shape == "segment" else WIDTH


@cache
def distance_function(shape: str) -> ca.Function:
    """Return the exact contacts of a pair.

    Input ``pair``, output ``contacts (18,)``: the nearest points, and those at the other end of a contact
    interval, where the distance is larger by less than ``PARALLEL`` times the body's length. The second
    distance is ``FAR`` if that contact needs no row. Where axis and piece intersect, the distance of the axis
    is minus the depth (the least translation that parts them) for boxes and spheres, zero for the other
    shapes. A distance changes by no more than the ends move.

    Raises
    ------
    KeyError
        `shape` is not one of ``FORMULAS``.
    """
    pair = ca.SX.sym("pair", 7 + width(shape))
    contacts = _rows(FORMULAS[shape](pair[:6], pair[6:-1]), pair[-1], shape)
    return ca.Function(f"distance_{shape}", [pair], [ca.cse(ca.densify(contacts))], ["pair"], ["contacts"])


def _rows(contacts: tuple[SymbolicContact, SymbolicContact], radius: Any, shape: str) -> Any:
    """Return both contacts of a body of that radius as numbers (18,)."""
    needed = ca.fabs(contacts[1].t - contacts[0].t) >= SECOND_CONTACT
    first, second = (
        ca.vertcat(c.distance - radius, _weights(shape, c.t, c.s), c.normal, ca.logic_not(needed))
        for c in contacts
    )
    return ca.vertcat(first, ca.if_else(needed, second[0], FAR), second[1:])


def _weights(shape: str, t: Any, s: Any) -> Any:
    """Return the weights (4,) of the ends, for the parameters on the body and on the other body."""
    share = 1.0 if shape == "segment" else 0.0
    return ca.vertcat(1.0 - t, t, share * (s - 1.0), -share * s)


@cache
def proof_function(shape: str) -> ca.Function:
    """Return the contact of an answer of FCL, and its flaw: the error that cannot be excluded.

    Inputs ``pair``, whose body may be a point, and ``answer (7,)``: a distance d, a point of the body and one of the
    other. Output ``contact (9,)``, whose last number is the flaw, m; NaN where a number is not finite or the two
    points coincide.

    With x the point of the body nearest to the answer's, y the other point, and n = (x - y) / |x - y|: the two are no
    nearer to each other than the gap g between their supporting planes along n, and no further apart than x and y. The
    flaw is |d - g| + ||x - y| - d|, and how far the answer's point is from x, and y from the other. The contact has
    the distance g, less the radius; its normal is mostly rounding where g is below `NORMAL_FROM`.

    Beside a cylinder FCL's distance is exact, but rounding decides how far its points are from the nearest ones.
    Newton's iteration leads from them to the nearest ones, whose flaw is added.
    """
    pair, answer = ca.SX.sym("pair", 7 + width(shape)), ca.SX.sym("answer", 7)
    body, other, claimed, y = pair[:6], pair[6:-1], answer[0], answer[4:]
    t, off = _projected(answer[1:4], body)
    if shape == "segment":
        s, stray = _projected(y, other)
    else:
        s, stray = 0.0, ca.fmax(APART[shape](ca.vertcat(y, y), other)[0].distance, 0.0)
    gap, normal, flaw = _between_planes(shape, body, other, (1.0 - t) * body[:3] + t * body[3:] - y, claimed)
    flaw += off + stray
    if shape == "cylinder":
        t, away = nearest_of_cylinder(t, body, other)
        gap, normal, further = _between_planes(shape, body, other, away, claimed)
        flaw += further
    contact = ca.cse(ca.vertcat(gap - pair[-1], _weights(shape, t, s), normal, flaw))
    return ca.Function(
        f"proof_{shape}", [pair, answer], [ca.densify(contact)], ["pair", "answer"], ["contact"]
    )


def _between_planes(shape: str, body: Any, other: Any, away: Any, claimed: Any) -> tuple[Any, Any, Any]:
    """Return the gap between supporting planes across the vector `away`, that one's unit vector, and the flaw."""
    apart = norm(away)
    normal = away / apart
    gap = ca.fmin(ca.dot(normal, body[:3]), ca.dot(normal, body[3:])) - _support(shape, other, normal)
    return gap, normal, ca.fabs(claimed - gap) + ca.fabs(apart - claimed)


def _projected(x: Any, segment: Any) -> tuple[Any, Any]:
    """Return the parameter of the point of a segment that is nearest to x (3,), and its distance."""
    along = segment[3:] - segment[:3]
    t = clip(ratio(ca.dot(x - segment[:3], along), ca.dot(along, along)))
    return t, norm(x - (1.0 - t) * segment[:3] - t * segment[3:])


@cache
def sweep_function(shape: str) -> ca.Function:
    """Return a lower bound of the distance of a pair while its ends move simultaneously on straight lines.

    Inputs ``start`` and ``end``, the pair before and after; a piece is at rest. Output ``bounds (3,)``: the
    bound over the motion, and the exact distances before and after it.

    The bound is the better of two: that of :func:`_turning_gap` between the contacts at both ends, and the
    fact that a distance changes by no more than the ends of the segments move.
    """
    pairs = [ca.SX.sym(name, 7 + width(shape)) for name in ("start", "end")]
    bodies, others = [pair[:6] for pair in pairs], [pair[6:-1] for pair in pairs]
    if shape != "segment":
        others[1] = others[0]
    contacts = [FORMULAS[shape](body, other)[0] for body, other in zip(bodies, others, strict=True)]
    motion = _travel(*bodies)
    if shape == "segment":
        motion += _travel(*others)
    bound = 0.5 * (contacts[0].distance + contacts[1].distance - motion)
    bound = ca.fmax(bound, _turning_gap(shape, bodies, others, [contact.normal for contact in contacts]))
    bounds = ca.vertcat(bound, *(contact.distance for contact in contacts)) - pairs[0][-1]
    return ca.Function(f"sweep_{shape}", pairs, [ca.cse(bounds)], ["start", "end"], ["bounds"])


def _travel(a: Any, b: Any) -> Any:
    return ca.fmax(norm(b[:3] - a[:3]), norm(b[3:] - a[3:]))


@cache
def follow_function(shape: str) -> ca.Function:
    """Return the contacts of a pair after a straight motion, and a lower bound of its distance meanwhile.

    Inputs ``ends (24,)``: two of the body and two of the other body before the motion, then the same after
    it; those of the other are ignored for an obstacle, in whose frame the ends are. And ``known (19,)``: the piece (15;
    ignored for two bodies), the radius or sum of radii, and a unit normal (3), preferably that of the contact
    before the motion.

    Output ``contacts (19,)``: those of :func:`distance_function` after the motion, and the bound of
    :func:`_turning_gap` over the motion. Where axis and piece intersect, the distance is minus the radius and
    the other numbers have no meaning.
    """
    both, known = ca.SX.sym("ends", 24), ca.SX.sym("known", WIDTH + 4)
    states = both[:12], both[12:]
    piece, radius, normal = known[:WIDTH], known[WIDTH], known[WIDTH + 1 :]
    bodies = [state[:6] for state in states]
    others = [state[6:] for state in states] if shape == "segment" else [piece, piece]
    contacts = APART[shape](bodies[1], others[1])
    bound = _turning_gap(shape, bodies, others, [normal, contacts[0].normal]) - radius
    found = ca.cse(ca.vertcat(_rows(contacts, radius, shape), bound))
    return ca.Function(f"follow_{shape}", [both, known], [ca.densify(found)], ["ends", "known"], ["contacts"])


def _turning_gap(shape: str, bodies: list[Any], others: list[Any], normals: list[Any]) -> Any:
    """Return a lower bound of the distance over a straight motion, by a plane that turns with it.

    With n(s) = (1 - s) n_0 + s n_1 between two unit normals, the gap of a point x(s) = (1 - s) x_0 + s x_1 to a convex
    piece of support function S is

        n.x - S(n) >= (1 - s) (n_0.x_0 - S(n_0)) + s (n_1.x_1 - S(n_1)) - w (n_1 - n_0).(x_1 - x_0),   w = s (1 - s),

    since S is convex, and |n|^2 = 1 - w |n_1 - n_0|^2. Let m be the lesser of both gaps and c the last
    product, or 0 if that is negative. Then the distance along n/|n| is at least the least value of
    (m - c w) / |n| over 0 <= w <= 1/4. If the normals are those of the contacts at both ends, m is the lesser
    of the two distances.
    """
    turn = normals[1] - normals[0]
    square = ca.dot(turn, turn)
    ends = (slice(0, 3), slice(3, 6))
    supports: list[Any] = [0.0, 0.0]
    points = [[body[end] for body in bodies] for end in ends]
    if shape == "segment":
        points = [
            [x - other[end] for x, other in zip(point, others, strict=True)]
            for point in points
            for end in ends
        ]
    else:
        supports = [_support(shape, piece, normal) for piece, normal in zip(others, normals, strict=True)]
    bound: Any = FAR
    for start, end in points:
        gap = ca.fmin(ca.dot(normals[0], start) - supports[0], ca.dot(normals[1], end) - supports[1])
        bound = ca.fmin(bound, _least_gap(gap, ca.dot(turn, end - start), square))
    # Normals that are further apart may be opposite: between them there is no plane.
    return ca.if_else(square <= _MOST_TURNED, bound, -FAR)


def _least_gap(gap: Any, bend: Any, square: Any) -> Any:
    """Return the least value of (m - c w) / |n| in :func:`_turning_gap`.

    `gap` is m, `bend` the product of which c is the part above 0, `square` |n_1 - n_0|^2.
    """
    bend = ca.fmax(bend, 0.0)
    # (m - c w) / sqrt(1 - k w) falls up to this w and rises after it.
    lowest = ratio(2.0 * bend - square * gap, bend * square, 1.0)
    w = ca.fmin(ca.fmax(lowest, 0.0), 0.25)
    along = (gap - bend * w) / ca.sqrt(ca.fmax(1.0 - square * w, _LEAST_SQUARE))
    return ca.fmin(gap, along)


@cache
def turning_function(_: str) -> ca.Function:
    """Return :func:`_least_gap` as a function, whatever the shape.

    Input ``known (3,)``: gap, bend and square. Output ``bound (1,)``, minus ``FAR`` where there is no plane.
    """
    known = ca.SX.sym("known", 3)
    bound = ca.if_else(known[2] <= _MOST_TURNED, _least_gap(known[0], known[1], known[2]), -FAR)
    return ca.Function("turning", [known], [bound], ["known"], ["bound"])


@cache
def support_function(shape: str) -> ca.Function:
    """Return the point of a piece that is furthest along a direction.

    Inputs ``piece (15,)`` and ``normal (3,)``, a unit vector. Output ``point (3,)``, m.
    """
    piece, normal = ca.SX.sym("piece", WIDTH), ca.SX.sym("normal", 3)
    if shape == "triangle":
        corners = [piece[i : i + 3] for i in (0, 3, 6)]
        point = corners[0]
        for corner in corners[1:]:
            point = ca.if_else(ca.dot(normal, corner - point) > 0.0, corner, point)
    elif shape == "sphere":
        point = piece[:3] + piece[12] * normal
    else:
        turn = ca.reshape(piece[3:12], 3, 3)
        own = turn @ normal
        if shape == "box":
            furthest = ca.sign(own) * piece[12:15]
        else:
            rim = ratio(piece[12], norm(own[:2])) * own[:2]
            furthest = ca.vertcat(rim, ca.sign(own[2]) * piece[13])
        point = piece[:3] + turn.T @ furthest
    return ca.Function(
        f"support_{shape}", [piece, normal], [ca.densify(point)], ["piece", "normal"], ["point"]
    )


def _support(shape: str, piece: Any, normal: Any) -> Any:
    """Return the greatest n.x over the points x of the piece."""
    if shape == "segment":
        return ca.fmax(ca.dot(normal, piece[:3]), ca.dot(normal, piece[3:]))
    if shape == "triangle":
        heights = [ca.dot(normal, piece[i : i + 3]) for i in (0, 3, 6)]
        return ca.fmax(ca.fmax(heights[0], heights[1]), heights[2])
    if shape == "sphere":
        return ca.dot(normal, piece[:3]) + piece[12]
    turned = ca.reshape(piece[3:12], 3, 3) @ normal
    if shape == "box":
        return ca.dot(normal, piece[:3]) + ca.dot(ca.fabs(turned), piece[12:15])
    across = norm(turned[:2])
    return ca.dot(normal, piece[:3]) + across * piece[12] + ca.fabs(turned[2]) * piece[13]
