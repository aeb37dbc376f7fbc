"""Bounds for a truss in any pose: its reach, and how far members' ends leave their chords in a motion."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

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


class _Bounds(NamedTuple):
    """Bounds of the first two derivatives of a unit vector, one per node; inf if unbounded."""

    first: Array
    second: Array


def chord_deviation(truss: Truss, start: Array, end: Array) -> float:
    """Return a bound, m, of how far a member's end is from its chord where nodes (N, 3) move straight; inf without one.

    An end is r = rho + R o, eq. (13), and the axes of the joint's frame R are unit vectors of polynomials w of the
    share of the motion. From |w| >= m, |w'| <= a and |w''| <= b follow |(w/|w|)'| <= a/m and
    |(w/|w|)''| <= b/m + 3 (a/m)^2, and a curve is no further from its chord than an eighth of the greatest second
    derivative.
    """
    joints = truss.joints
    if joints is None:
        return 0.0
    before, after = (_sides(X[joints.triangle]) for X in (start, end))
    change = after - before
    greatest = np.maximum(_norm(before), _norm(after))
    unit = [_unit(before[k], after[k], _norm(change[k]), np.zeros(len(change[k]))) for k in range(2)]
    normalised = [sides / _norm(sides)[..., None] for sides in (before, after)]
    x = _unit(
        normalised[0].sum(axis=0),
        normalised[1].sum(axis=0),
        unit[0].first + unit[1].first,
        unit[0].second + unit[1].second,
    )
    moved = _norm(change)
    z = _unit(
        np.cross(before[0], before[1]),
        np.cross(after[0], after[1]),
        moved[0] * greatest[1] + moved[1] * greatest[0],
        2.0 * moved[0] * moved[1],
    )
    with np.errstate(invalid="ignore"):
        y = z.second + 2.0 * z.first * x.first + x.second
        node = truss.members
        offset = np.abs(joints.offset)
        bend = offset[..., 0] * x.second[node] + offset[..., 1] * y[node] + offset[..., 2] * z.second[node]
    bend[offset.max(axis=2) == 0.0] = 0.0
    return float(np.nan_to_num(bend, nan=np.inf).max(initial=0.0)) / 8.0


def frame_deviation(start: Array, end: Array, cosines: Array, sines: Array) -> float:
    """Return a bound of how far a point fixed to a fitted frame leaves its chord where the nodes (K, 3) move straight.

    It is over the point's distance from the origin of the frame, that of ``frames.fitted_frame``; inf without one.
    z is the direction of a polynomial A of the share of the motion. The sums c = sum cos s and d = sum sin s of the
    nodes from their middle are polynomials, too, and x is the direction of v = c + d x z less its part along z, which a
    triangle has not.
    """
    before, after = (nodes - nodes.mean(axis=0) for nodes in (start, end))
    change = after - before

    def area(first: Array, second: Array) -> Array:
        return np.asarray(np.cross(first, np.roll(second, -1, axis=0)).sum(axis=0))

    # A = A(0) + share * slope + share^2 * area(change, change)
    slope, square = area(before, change) + area(change, before), area(change, change)
    ends = area(before, before), area(after, after)
    z = _unit(
        ends[0][None], ends[1][None], max(_size(slope), _size(slope + 2.0 * square)), 2.0 * _size(square)
    )
    z1, z2 = float(z.first[0]), float(z.second[0])
    if not z2 < math.inf:
        return math.inf
    c, d = ([weights @ nodes for nodes in (before, after, change)] for weights in (cosines, sines))
    c0, d0 = (max(_size(way[0]), _size(way[1])) for way in (c, d))
    c1, d1 = _size(c[2]), _size(d[2])
    v0, v1, v2 = c0 + d0, c1 + d1 + d0 * z1, 2.0 * d1 * z1 + d0 * z2
    if len(start) > 3:
        v1, v2 = v1 + 2.0 * z1 * v0, v2 + 4.0 * z1 * v1 + 2.0 * (z2 + z1**2) * v0
    across = []
    for k, w in enumerate(ends):
        normal = w / _size(w)
        v = c[k] + np.cross(d[k], normal)
        across.append((v - normal * (normal @ v))[None])
    x = _unit(across[0], across[1], v1, v2)
    x1, x2 = float(x.first[0]), float(x.second[0])
    y2 = z2 + 2.0 * z1 * x1 + x2
    return math.sqrt(x2**2 + y2**2 + z2**2) / 8.0 if x2 < math.inf else math.inf


def _size(vector: Array) -> float:
    return float(np.linalg.norm(vector))


def _unit(before: Array, after: Array, first: Array | float, second: Array | float) -> _Bounds:
    """Return the bounds for w/|w| from w (N, 3) at both ends and bounds of its derivatives (N,)."""
    least = (_norm(before) + _norm(after) - first) / 2.0
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = first / least
        bend = second / least + 3.0 * relative**2
    held = least > 0.0
    return _Bounds(np.where(held, relative, np.inf), np.where(held, bend, np.inf))


def _sides(corner: Array) -> Array:
    """Return (2, N, 3) the sides of the joints' triangles that meet at their nodes."""
    return np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]])


def _norm(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=-1))
