"""The order in which the nodes of a truss can be placed, by matching members to nodes."""

from __future__ import annotations

import heapq

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components, maximum_bipartite_matching

from vgtm_qp.arrays import Index, Mask
from vgtm_qp.errors import TrussError


def placement_stages(base: Mask, members: Index) -> Index:
    """Return (N,) the stage of each node, -1 for base nodes; the stages are the smallest possible ones.

    Every node is given three members that place it, and so depends on the other nodes of these members. The
    strong components of that relation are the stages: one node that hangs on three nodes placed before, or
    all three nodes of a face that must be placed at once. The components are the same for every such choice
    of members (Dulmage & Mendelsohn, Can. J. Math. 10, 1958).

    `base` (N,) says which nodes are given; `members` (M, Q) are the nodes that each member's length depends on, its own
    two first, M = 3 (number of other nodes).

    Raises
    ------
    TrussError
        The members cannot be shared out so that every node has three.
    """
    free = np.flatnonzero(~base)
    place = np.full(len(base), -1, dtype=np.int64)
    place[free] = np.arange(len(free))
    owner = _owners(place[members[:, :2]], len(free))

    other = place[members]
    source = np.broadcast_to(owner[:, None], other.shape)
    linked = (other >= 0) & (other != source)
    links = sparse.csr_array(
        (np.ones(int(linked.sum())), (source[linked], other[linked])), shape=(len(free), len(free))
    )
    count, component = connected_components(links, connection="strong")

    start, end = links.nonzero()
    pairs = np.unique(np.stack([component[start], component[end]]), axis=1)
    pairs = pairs[:, pairs[0] != pairs[1]]
    needs = np.bincount(pairs[0], minlength=count)
    serves: list[list[int]] = [[] for _ in range(count)]
    for later, earlier in pairs.T.tolist():
        serves[earlier].append(later)
    first = np.full(count, len(free))
    np.minimum.at(first, component, np.arange(len(free)))
    ready = [(int(first[c]), int(c)) for c in np.flatnonzero(needs == 0)]
    heapq.heapify(ready)
    order = np.empty(count, dtype=np.int64)
    for position in range(count):
        _, done = heapq.heappop(ready)
        order[done] = position
        for c in serves[done]:
            needs[c] -= 1
            if not needs[c]:
                heapq.heappush(ready, (int(first[c]), c))

    stage = np.full(len(base), -1, dtype=np.int64)
    stage[free] = order[component]
    return stage


def _owners(ends: Index, count: int) -> Index:
    """Return (M,) the free node that each member places, three to a node; `ends` are -1 at base nodes."""
    rows, columns = np.nonzero(ends >= 0)
    nodes = ends[rows, columns]
    thrice = 3 * nodes[:, None] + np.arange(3)
    graph = sparse.csr_array(
        (np.ones(thrice.size), (np.repeat(rows, 3), thrice.reshape(-1))), shape=(len(ends), 3 * count)
    )
    match = maximum_bipartite_matching(graph, perm_type="column")
    if len(ends) != 3 * count or (match < 0).any():
        raise TrussError(
            "the members cannot be shared out three to each free node: some part of the truss has too many"
        )
    return np.asarray(match // 3, dtype=np.int64)
