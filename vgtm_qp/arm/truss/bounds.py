"""Bounds for a truss in any pose: its reach, and how far members' ends leave their chords in a motion."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from vgtm_qp.arm.symbols import Bound, Constants
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.arrays import Array, Index


def longest_paths(truss: Truss, sources: Index) -> Array:
    """Return (S, N) bounds of the distances from nodes `sources` (S,) to all nodes in any pose, m.

    The shortest path along members at their greatest lengths, joint offsets included; inf if no path exists.
    """
    longest = truss.stroke[:, 1].copy()
    if truss.joints is not None:
        longest += np.linalg.norm(truss.joints.offset, axis=2).sum(axis=1)
    first, second = truss.members.T
    graph = sparse.coo_array((longest, (first, second)), shape=(truss.node_count, truss.node_count))
    return np.asarray(dijkstra(graph.tocsr(), directed=False, indices=sources))


def hollow(truss: Truss) -> float:
    """Return a bound of the distance from the tip's centre to the nearest point on the axis of a member, m.

    A tip of one node is on its members but for their joint offsets. The centroid of a triangle is no farther
    from its nearest edge than a third of the height of an equilateral one with edges as long as the longest;
    any other tip is bounded by its nodes.
    """
    tip = truss.tip
    offset = 0.0 if truss.joints is None else float(np.linalg.norm(truss.joints.offset, axis=2).max())
    if len(tip) == 1:
        return offset
    between = np.isin(truss.members, tip).all(axis=1)
    is_triangle = len(tip) == 3 and np.count_nonzero(between) == 3
    if is_triangle and np.allclose(truss.tip_weights, 1.0 / 3.0) and not offset:
        return float(truss.stroke[between, 1].max()) / (2.0 * math.sqrt(3.0))
    return float((longest_paths(truss, tip)[:, tip] @ np.abs(truss.tip_weights)).min()) + offset


def bend_function(truss: Truss) -> Bound:
    """Return the function of a bound of |r''| of all members' ends where nodes move straight, given twice, m.

    Arguments: nodes (3, N) at both ends of the motion. An end is r = rho + R o, eq. (13), and the axes of the joint's
    frame R are unit vectors of polynomials w of the share of the motion. From |w| >= m, |w'| <= a and |w''| <= b follow
    |(w/|w|)'| <= a/m and |(w/|w|)''| <= b/m + 3 (a/m)^2. Infinite where one has no bound.
    """
    assert truss.joints is not None
    constants = Constants()
    ends = [ca.MX.sym(name, 3, truss.node_count) for name in ("start", "end")]
    corners = [X[:, truss.joints.triangle.reshape(-1).tolist()] for X in ends]
    axes = _axes_bend().map(truss.node_count)(*corners)
    offsets = constants.add("offsets", np.abs(truss.joints.offset).reshape(-1, 3))
    bend, offset = ca.SX.sym("bend", 3), ca.SX.sym("offset", 3)
    bound = ca.dot(offset, bend)
    # Infinity times zero is no number.
    bound = ca.if_else(ca.mmax(offset) > 0.0, ca.if_else(bound < np.inf, bound, np.inf), 0.0)
    of_end = ca.Function("of_end", [bend, offset], [bound])
    worst = ca.mmax(of_end.map(2 * truss.member_count)(axes[:, truss.members.reshape(-1).tolist()], offsets))
    return constants.bound("bend", ends, [ca.vertcat(worst, worst)])


def _axes_bend() -> ca.Function:
    """Return corners (3, 3) of a joint's triangle, before and after -> bounds of the second derivatives of its axes."""
    corners = [ca.SX.sym("before", 3, 3), ca.SX.sym("after", 3, 3)]
    before, after = ([ring[:, k] - ring[:, 0] for k in (1, 2)] for ring in corners)
    sides = list(zip(before, after, strict=True))
    moved = [ca.norm_2(side[1] - side[0]) for side in sides]
    longest = [ca.fmax(ca.norm_2(side[0]), ca.norm_2(side[1])) for side in sides]
    units = [_unit_bounds(*side, way, ca.SX(0.0)) for side, way in zip(sides, moved, strict=True)]
    across = [ring[0] / ca.norm_2(ring[0]) + ring[1] / ca.norm_2(ring[1]) for ring in (before, after)]
    x1, x2 = _unit_bounds(across[0], across[1], units[0][0] + units[1][0], units[0][1] + units[1][1])
    rate = moved[0] * longest[1] + moved[1] * longest[0]
    normals = [ca.cross(ring[0], ring[1]) for ring in (before, after)]
    z1, z2 = _unit_bounds(normals[0], normals[1], rate, 2.0 * moved[0] * moved[1])
    return ca.Function("axes_bend", corners, [ca.vertcat(x2, z2 + 2.0 * z1 * x1 + x2, z2)])


def frame_deviation(count: int) -> ca.Function:
    """Return a bound of how far a point fixed to a fitted frame leaves its chord where `count` nodes move straight.

    Arguments: the nodes (3, K) at both ends of the motion, cosines and sines (K) of their angles, see
    ``frames.fitted_frame``. The bound is the result times the point's distance from the origin of the frame; inf
    without one. z is the direction of A, a polynomial of the share of the motion. With s a node's place from the middle
    of all, the sums c = sum cos s and d = sum sin s over the nodes are polynomials too. x is the direction of
    v = c + d x z without its part along z, which is zero for a triangle.
    """
    ends = [ca.SX.sym("start", 3, count), ca.SX.sym("end", 3, count)]
    cosines, sines = ca.SX.sym("cosines", count), ca.SX.sym("sines", count)
    before, after = (nodes - ca.repmat(ca.sum2(nodes) / count, 1, count) for nodes in ends)
    change = after - before

    def area(ring: ca.SX) -> ca.SX:
        return sum((ca.cross(ring[:, j], ring[:, (j + 1) % count]) for j in range(count)), ca.SX.zeros(3))

    # A = A(0) + share * slope + share^2 * square
    areas, square = [area(before), area(after)], area(change)
    slope = areas[1] - areas[0] - square
    rate = ca.fmax(ca.norm_2(slope), ca.norm_2(slope + 2.0 * square))
    z1, z2 = _unit_bounds(areas[0], areas[1], rate, 2.0 * ca.norm_2(square))
    c, d = ([nodes @ weights for nodes in (before, after, change)] for weights in (cosines, sines))
    c0, d0 = (ca.fmax(ca.norm_2(way[0]), ca.norm_2(way[1])) for way in (c, d))
    c1, d1 = ca.norm_2(c[2]), ca.norm_2(d[2])
    v0, v1, v2 = c0 + d0, c1 + d1 + d0 * z1, 2.0 * d1 * z1 + d0 * z2
    if count > 3:
        v1, v2 = v1 + 2.0 * z1 * v0, v2 + 4.0 * z1 * v1 + 2.0 * (z2 + z1**2) * v0
    across = []
    for k, w in enumerate(areas):
        normal = w / ca.norm_2(w)
        v = c[k] + ca.cross(d[k], normal)
        across.append(v - normal * ca.dot(normal, v))
    x1, x2 = _unit_bounds(across[0], across[1], v1, v2)
    bound = ca.norm_2(ca.vertcat(x2, z2 + 2.0 * z1 * x1 + x2, z2)) / 8.0
    return ca.Function("frame_deviation", [*ends, cosines, sines], [bound])


def _unit_bounds(before: ca.SX, after: ca.SX, first: ca.SX, second: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return bounds of the first two derivatives of w/|w|; inf where w may vanish.

    Given are w (3) at both ends of the motion, and bounds of its first two derivatives.
    """
    least = (ca.norm_2(before) + ca.norm_2(after) - first) / 2.0
    relative = ca.if_else(least > 0.0, first / least, np.inf)
    return relative, ca.if_else(least > 0.0, second / least + 3.0 * relative**2, np.inf)
