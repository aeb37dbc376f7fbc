"""An arm as a chain of equal periods, each hung on the one before."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import permutations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from vgtm_qp.arm.arm import Bays
from vgtm_qp.qp.layout import Layout

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

_LONGEST_PERIOD = 6
_MOST_NODES = 12
_MOST_LOCKED = 24
_MOST_BASE_NODES = 4


@dataclass(frozen=True, eq=False)
class Chain:
    """Periods of p stages; its members and tracked faces use nodes of it and of the period before.

    Places within a period: first the w nodes that it uses of the one before, then its own m by stage. Where the arm
    allows it, the nodes and members of every period are put in the order in which all periods are alike.

    Attributes
    ----------
    layout : Layout
    bays : Bays
        Of its arm.
    nodes : (n, m) int
        The nodes of each period in stage order.
    members : (n, 3m) int
        The members of each period by the stage they belong to.
    stage_sizes : tuple of int
        Nodes of each of the p stages.
    carried : (w,) int
        Which of a period's nodes the next period uses.
    pattern : (3m, w + m) bool
        Which nodes a member's length depends on, in any of the periods.
    soft : (3m,) bool
        The places of actuated members.
    faces : (n, f) int
        Positions in ``layout.tracked`` of the faces that each period completes.
    face_places : (f, 3) int
        Places of those faces' nodes.
    face_order : (n, f, 3) int
        Which of a face's nodes stand at those places.
    face_weights : (f, 3)
    locked : (l,) int
        Fixed members that stand where other periods have an actuated one.
    window : (n, w + m) int or None
        The node at each place, base nodes included, where every place means the same in all periods; else None.
    member_places : (3m, 2) int
        The places that a period's members join; empty without a window.
    """

    layout: Layout
    bays: Bays
    nodes: Index
    members: Index
    stage_sizes: tuple[int, ...]
    carried: Index
    pattern: Mask
    soft: Mask
    faces: Index
    face_places: Index
    face_order: Index
    face_weights: Array
    locked: Index
    window: Index | None
    member_places: Index

    @property
    def periods(self) -> int:
        """Number of periods n."""
        return len(self.nodes)

    @property
    def own(self) -> int:
        """Number of displacement coordinates of a period's own nodes, 3m."""
        return 3 * int(self.nodes.shape[1])

    @property
    def before(self) -> int:
        """Number of displacement coordinates that a period takes over from the one before, 3w."""
        return 3 * len(self.carried)

    @cached_property
    def node_period(self) -> Index:
        """(N,) the period of each node; -1 for base nodes."""
        period = np.full(self.bays.node_count, -1, dtype=np.int64)
        period[self.nodes] = np.arange(self.periods)[:, None]
        return period

    @cached_property
    def node_place(self) -> Index:
        """(N,) the place of each node within its period, 0 to m - 1."""
        place = np.zeros(self.bays.node_count, dtype=np.int64)
        place[self.nodes] = np.arange(self.nodes.shape[1])
        return place

    @cached_property
    def coordinate_pattern(self) -> Mask:
        """(3m, 3w + 3m) the pattern of a period's rows of the length Jacobian."""
        return np.repeat(self.pattern, 3, axis=1)

    @cached_property
    def gather(self) -> sparse.csr_matrix:
        """The matrix that takes all members' gradients to the Jacobian's nonzeros, period by period."""
        bays, pattern = self.bays, self.coordinate_pattern
        number = np.full(pattern.shape, -1, dtype=np.int64)
        number.T[pattern.T] = np.arange(int(pattern.sum()))
        member, flat, column = bays.scatter.member, bays.scatter.flat, bays.scatter.column
        row = np.empty(bays.member_count, dtype=np.int64)
        period = np.empty_like(row)
        row[self.members] = np.arange(self.members.shape[1])
        period[self.members] = np.arange(self.periods)[:, None]
        node = bays.free[column // 3]
        place = _places(self.node_period[node], self.node_place[node], period[member], self.carried)
        entry = period[member] * int(pattern.sum()) + number[row[member], 3 * place + column % 3]
        shape = (
            self.periods * int(pattern.sum()),
            bays.member_nodes.size * 3,
        )
        return sparse.csr_matrix((np.ones(len(entry)), (entry, flat)), shape=shape)

    @property
    def is_square(self) -> bool:
        """Whether a period's fixed members and its faces' positions determine its nodes, given the curve."""
        return (
            self.faces.shape[1] > 0
            and int(self.soft.sum()) == 3 * self.faces.shape[1]
            and not len(self.locked)
        )


@lru_cache(maxsize=4)
def find_chain(layout: Layout) -> Chain | None:
    """Return the chain of `layout`, with the shortest period; None where the arm is none."""
    bays = layout.arm.bays
    if bays is None:
        return None
    stages = int(bays.stage.max(initial=-1)) + 1
    lengths = (length for length in range(1, min(stages, _LONGEST_PERIOD) + 1) if stages % length == 0)
    return next(
        (chain for length in lengths if (chain := _chain(layout, bays, stages, length)) is not None), None
    )


def _places(period: Index, place: Index, here: Index, carried: Index) -> Index:
    """Return the places of nodes among a period's w + m; -1 if they are neither its own nor carried."""
    position = np.full(max(int(place.max(initial=0)), int(carried.max(initial=0))) + 1, -1, dtype=np.int64)
    position[carried] = np.arange(len(carried))
    return np.where(period == here, len(carried) + place, np.where(period == here - 1, position[place], -1))


def _repeats(counts: Index, length: int) -> bool:
    """Whether `counts` per stage repeat after `length` stages and none is zero."""
    return bool(counts.min() > 0 and (counts.reshape(-1, length) == counts[:length]).all())


def _chain(layout: Layout, bays: Bays, stages: int, length: int) -> Chain | None:
    periods = stages // length
    node_counts = np.bincount(bays.stage[bays.free], minlength=stages)
    member_stage = bays.stage[bays.member_nodes].max(axis=1)
    if not len(member_stage) or member_stage.min() < 0 or not _repeats(node_counts, length):
        return None
    if (np.bincount(member_stage, minlength=stages) != 3 * node_counts).any():
        return None
    if len(bays.free) > _MOST_NODES * periods:
        return None
    nodes = bays.free.reshape(periods, -1)
    members = np.argsort(member_stage, kind="stable").reshape(periods, -1)
    sizes = tuple(node_counts[:length].tolist())
    alike = _alike(bays, nodes, members, sizes) if bays.joints is None else None
    if alike is not None:
        chain = _of_ordered(layout, bays, alike.nodes, alike.members, sizes, alike)
        if chain is not None:
            return chain
    return _of_ordered(layout, bays, nodes, members, sizes, None)


@dataclass(frozen=True, eq=False)
class _Alike:
    """Nodes (n, m) and members (n, 3m) in the order in which all periods are alike.

    `base` are the nodes before the first one; `pairs` (3m, 2) what the members join: places among the nodes of the
    period before, then from m on among a period's own.
    """

    nodes: Index
    members: Index
    base: Index
    pairs: list[tuple[int, int]]


def _alike(bays: Bays, nodes: Index, members: Index, sizes: tuple[int, ...]) -> _Alike | None:
    """Return the order in which all periods of a chain of pin-jointed members are alike; None where there is none.

    Nodes of a stage are told apart by what they hang on, so that a bay that is the mirror image of the one before
    comes in another order of its nodes.
    """
    base = np.flatnonzero(bays.base).tolist()
    if len(nodes) < 2 or len(base) > min(int(nodes.shape[1]), _MOST_BASE_NODES):
        return None
    ends = bays.member_nodes.tolist()
    for order in permutations(base):
        before: list[int] | None = list(order)
        wanted: list[tuple[int, int]] | None = None
        ordered, listed = [before], []
        for names, own in zip(nodes.tolist(), members.tolist(), strict=True):
            assert before is not None
            before, found, pairs = _ordered_period(
                before, names, {member: ends[member] for member in own}, sizes
            )
            wanted = pairs if wanted is None else wanted
            if before is None or pairs != wanted:
                break
            ordered.append(before)
            listed.append(found)
        else:
            assert wanted is not None
            return _Alike(np.array(ordered[1:]), np.array(listed), np.array(ordered[0]), wanted)
    return None


def _ordered_period(
    before: list[int], names: list[int], ends: dict[int, list[int]], sizes: tuple[int, ...]
) -> tuple[list[int] | None, list[int], list[tuple[int, int]]]:
    """Return a period's nodes and members in order and the places that those join; None where they go further back.

    Places are those of the nodes `before`, then from len(names) on the period's own.
    """
    own = len(names)
    place = {node: k for k, node in enumerate(before)}
    hangs: dict[int, list[int]] = {node: [] for node in names}
    for first, second in ends.values():
        for here, there in ((first, second), (second, first)):
            if here in hangs:
                hangs[here].append(there)
    order: list[int] = []
    for count in sizes:
        stage = names[len(order) : len(order) + count]
        keys = {
            node: (sorted(place[other] for other in hangs[node] if other in place), node) for node in stage
        }
        for node in sorted(stage, key=keys.__getitem__):
            place[node] = own + len(order)
            order.append(node)
    if any(node not in place for pair in ends.values() for node in pair):
        return None, [], []
    joined = {member: sorted(place[node] for node in pair) for member, pair in ends.items()}
    listed = sorted(ends, key=lambda member: (joined[member][1], joined[member][0]))
    return order, listed, [(joined[member][0], joined[member][1]) for member in listed]


def _of_ordered(
    layout: Layout, bays: Bays, nodes: Index, members: Index, sizes: tuple[int, ...], alike: _Alike | None
) -> Chain | None:
    """Return the chain of these periods, None where they are none."""
    stations, periods = layout.arm.stations, len(nodes)
    period = np.full(bays.node_count, -2, dtype=np.int64)
    place = np.zeros(bays.node_count, dtype=np.int64)
    period[nodes], place[nodes] = np.arange(periods)[:, None], np.arange(nodes.shape[1])
    here = np.arange(periods)[:, None, None]
    used = bays.member_nodes[members]
    face_used, faces = np.zeros((periods, 0, 3), dtype=np.int64), np.zeros((periods, 0), dtype=np.int64)
    if len(layout.tracked):
        face_nodes = stations.nodes[layout.tracked]
        completed = period[face_nodes].max(axis=1)
        order = np.argsort(completed, kind="stable")
        if (
            len(order) % periods
            or (completed[order] != np.repeat(np.arange(periods), len(order) // periods)).any()
        ):
            return None
        faces = order.reshape(periods, -1)
        face_used = face_nodes[faces]
    face_order = np.broadcast_to(np.arange(3), face_used.shape)
    if alike is not None:
        rank = place[face_used] + np.where(period[face_used] == here, nodes.shape[1], 0)
        face_order = np.argsort(rank, axis=2)
        face_used = np.take_along_axis(face_used, face_order, axis=2)
    for nodes_used in (used, face_used):
        if ((period[nodes_used] >= 0) & (period[nodes_used] < here - 1)).any():
            return None
    carried = np.unique(
        np.concatenate(
            [place[nodes_used][period[nodes_used] == here - 1] for nodes_used in (used, face_used)]
        )
    )
    face_places = _places(period[face_used], place[face_used], here, carried)
    weights = np.take_along_axis(stations.weights[layout.tracked[faces]], face_order, axis=2)
    if (
        (face_places != face_places[:1]).any()
        or (face_places < 0).any()
        or np.ptp(weights, axis=0).max(initial=0.0) > 0
    ):
        return None
    places = _places(period[used], place[used], here, carried)
    pattern = np.zeros((members.shape[1], len(carried) + nodes.shape[1]), dtype=bool)
    _, row, _ = np.nonzero(places >= 0)
    pattern[row, places[places >= 0]] = True
    actuated = bays.actuated[members]
    soft = actuated.mean(axis=0) > 0.5
    locked = members[~actuated & soft]
    if (actuated & ~soft).any() or len(locked) > _MOST_LOCKED:
        return None
    window, member_places = None, np.zeros((0, 2), dtype=np.int64)
    if alike is not None and carried.max(initial=-1) < len(alike.base):
        before = np.concatenate([alike.base[carried][None], nodes[:-1][:, carried]])
        window = np.concatenate([before, nodes], axis=1)
        number = np.full(2 * nodes.shape[1], -1, dtype=np.int64)
        number[carried] = np.arange(len(carried))
        number[nodes.shape[1] :] = len(carried) + np.arange(nodes.shape[1])
        member_places = number[np.array(alike.pairs)]
    return Chain(
        layout=layout,
        bays=bays,
        nodes=nodes,
        members=members,
        stage_sizes=sizes,
        carried=carried,
        pattern=pattern,
        soft=soft,
        faces=faces,
        face_places=face_places[0],
        face_order=face_order,
        face_weights=weights[0],
        locked=locked,
        window=window,
        member_places=member_places,
    )
