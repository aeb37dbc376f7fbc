"""How far a truss reaches in any pose, and how near to the axis of a member its tip is."""

from __future__ import annotations

import math

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from vgtm_qp.arm.truss.truss import Array, Index, Truss


def longest_ways(truss: Truss, sources: Index) -> Array:
    """Return (S, N) bounds of the distances from nodes `sources` (S,) to all nodes in any pose, m.

    The shortest way along members that are all as long as they can be, joint offsets included; inf where
    there is none.
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
    if (
        len(tip) == 3
        and np.count_nonzero(between) == 3
        and np.allclose(truss.tip_weights, 1.0 / 3.0)
        and not offset
    ):
        return float(truss.stroke[between, 1].max()) / (2.0 * math.sqrt(3.0))
    return float((longest_ways(truss, tip)[:, tip] @ np.abs(truss.tip_weights)).min()) + offset
