"""An arm as a chain of equal periods, each standing on the one before."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import permutations

import numpy as np

from vgtm_qp.arm.arm import Bays
from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.qp.layout import Layout

_LONGEST_PERIOD = 6
_MOST_NODES = 12
_MOST_LOCKED = 24
_MOST_BASE_NODES = 4


@dataclass(frozen=True, eq=False)
class Chain:
    """Periods of p stages; members and stations of one use its own nodes and those of the period before.

    Places within a period: first the w nodes that it uses of the period before, then its own m nodes by
    stage. If the arm allows it, nodes and members of every period are ordered so that all periods are alike.

    Attributes
    ----------
    bays : Bays
        Of the arm of `layout`.
    nodes, members : (n, m) int, (n, 3m) int
        Of each period, in the order of its stages.
    stage_sizes : tuple of int
        Nodes of each of the p stages.
    node_period, node_place : (N,) int
        The period of each node, negative for base nodes, and its place in that period, 0 to m - 1.
    carried : (w,) int
        Which of a period's nodes the next period uses.
    window : (n, w + m) int
        The node at each place. Places before the first period hold base nodes if all periods are alike, else
        any node.
    pattern : (3m, 3w + 3m) bool
        Coordinates that a member's length depends on in at least one period.
    member_places : (3m, 2) int or None
        The places that a period's members join; None if the periods are not alike.
    actuated : (3m,) bool
        The places of actuated members.
    locked : (l,) int
        Fixed members at places where other periods have an actuated member.
    stations : (n, f) int
        Positions in ``layout.tracked`` of the stations that each period completes.
    station_places, station_weights : (f, 3) int, (f, 3)
        Places of those stations' nodes, in rising order, and their weights.
    station_order : (n, f, 3) int
        Which of a station's nodes are at those places.
    """

    layout: Layout
    bays: Bays
    nodes: Index
    members: Index
    stage_sizes: tuple[int, ...]
    node_period: Index
    node_place: Index
    carried: Index
    window: Index
    pattern: Mask
    member_places: Index | None
    actuated: Mask
    locked: Index
    stations: Index
    station_places: Index
    station_order: Index
    station_weights: Array

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
        """Number of displacement coordinates that a period uses of the period before, 3w."""
        return 3 * len(self.carried)

    @cached_property
    def entry(self) -> Index:
        """(3m, 3w + 3m) the place of each coordinate among a period's nonzeros, column by column; -1 elsewhere."""
        entry = np.full(self.pattern.shape, -1, dtype=np.int64)
        entry.T[self.pattern.T] = np.arange(int(self.pattern.sum()))
        return entry

    @cached_property
    def gathered(self) -> Index:
        """(E,) places of the entries of ``LengthScatter`` among the nonzeros of all periods."""
        scatter = self.bays.scatter
        period, row = np.divmod(np.argsort(self.members.reshape(-1))[scatter.member], self.own)
        node = self.bays.free[scatter.column // 3]
        place = _places(self.node_period[node], self.node_place[node], period, self.carried)
        found = period * int(self.pattern.sum()) + self.entry[row, 3 * place + scatter.column % 3]
        return np.asarray(found)

    @property
    def is_square(self) -> bool:
        """Whether a period's fixed members and its stations' positions determine its nodes, given the curve."""
        stations = self.stations.shape[1]
        return stations > 0 and int(self.actuated.sum()) == 3 * stations and not len(self.locked)


@lru_cache(maxsize=4)
def find_chain(layout: Layout) -> Chain | None:
    """Return the chain of `layout` with the shortest period; None if the arm is not a chain."""
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


def _chain(layout: Layout, bays: Bays, stages: int, length: int) -> Chain | None:
    """Return the chain of periods of `length` stages; None if the arm is not a chain of these."""
    periods = stages // length
    counts = np.bincount(bays.stage[bays.free], minlength=stages)
    member_stage = bays.stage[bays.member_nodes].max(axis=1)
    if not len(member_stage) or member_stage.min() < 0 or len(bays.free) > _MOST_NODES * periods:
        return None
    repeats = counts.min() > 0 and (counts.reshape(-1, length) == counts[:length]).all()
    if not repeats or (np.bincount(member_stage, minlength=stages) != 3 * counts).any():
        return None
    sizes = tuple(counts[:length].tolist())
    nodes = bays.free.reshape(periods, -1)
    members = np.argsort(member_stage, kind="stable").reshape(periods, -1)
    orders = [_alike(bays, nodes, members, sizes), (np.zeros(0, dtype=np.int64), nodes, members)]
    found = (_of_ordered(layout, bays, sizes, *order) for order in orders if order is not None)
    return next((chain for chain in found if chain is not None), None)


def _alike(
    bays: Bays, nodes: Index, members: Index, sizes: tuple[int, ...]
) -> tuple[Index, Index, Index] | None:
    """Return base nodes, nodes (n, m) and members (n, 3m) ordered so that all periods are alike, or None.

    Base nodes are those of a period before the first one. Nodes of a stage are distinguished by the nodes
    that they stand on: a bay that mirrors the one before has its nodes in another order.
    """
    base = np.flatnonzero(bays.base).tolist()
    if bays.joints is not None or len(nodes) < 2 or len(base) > _MOST_BASE_NODES:
        return None
    if len(base) != nodes.shape[1]:
        return None
    hung = list(zip(nodes.tolist(), members.tolist(), bays.member_nodes[members].tolist(), strict=True))
    for order in permutations(base):
        before, first = list(order), None
        ordered, listed = [], []
        for names, own, ends in hung:
            before, found, joined = _ordered_period(before, names, own, ends, sizes)
            first = joined if first is None else first
            if not joined or joined != first:
                break
            ordered.append(before)
            listed.append(found)
        else:
            return np.array(order, dtype=np.int64), np.array(ordered), np.array(listed)
    return None


def _ordered_period(
    before: list[int], names: list[int], members: list[int], ends: list[list[int]], sizes: tuple[int, ...]
) -> tuple[list[int], list[int], list[tuple[int, int]]]:
    """Return a period's nodes and members in order, and the places that members join.

    All are empty if members reach further back than `before`. Places of nodes `before` are negative; places
    of a period's own nodes count from zero.
    """
    place = dict(zip(before, range(-len(before), 0), strict=True))
    hangs: dict[int, list[int]] = {node: [] for node in (*before, *names)}
    for first, second in ends:
        if first not in hangs or second not in hangs:
            return [], [], []
        hangs[first].append(second)
        hangs[second].append(first)
    done = 0
    for count in sizes:
        keys = {
            node: (sorted(place[other] for other in hangs[node] if other in place), node)
            for node in names[done : done + count]
        }
        place |= {node: done + k for k, node in enumerate(sorted(keys, key=keys.__getitem__))}
        done += count
    joined = {
        member: (max(place[a], place[b]), min(place[a], place[b]))
        for member, (a, b) in zip(members, ends, strict=True)
    }
    listed = sorted(members, key=joined.__getitem__)
    return sorted(names, key=place.__getitem__), listed, [joined[member] for member in listed]


def _of_ordered(
    layout: Layout, bays: Bays, sizes: tuple[int, ...], base: Index, nodes: Index, members: Index
) -> Chain | None:
    """Return the chain of these periods after the nodes `base`; None if they do not form one."""
    poses, (periods, own) = layout.arm.stations, nodes.shape
    period, place = np.full(bays.node_count, -2, dtype=np.int64), np.zeros(bays.node_count, dtype=np.int64)
    period[base], place[base] = -1, np.arange(len(base))
    period[nodes], place[nodes] = np.arange(periods)[:, None], np.arange(own)
    here = np.arange(periods)[:, None, None]
    completed = period[poses.nodes[layout.tracked]].max(axis=1, initial=-2)
    order = np.argsort(completed, kind="stable")
    count = len(order) // periods
    if not np.array_equal(completed[order], np.repeat(np.arange(periods), count)):
        return None
    stations = order.reshape(periods, count)
    station_used, used = poses.nodes[layout.tracked[stations]], bays.member_nodes[members]
    station_order = np.argsort(place[station_used] + np.where(period[station_used] == here, own, 0), axis=2)
    station_used = np.take_along_axis(station_used, station_order, axis=2)
    carried: set[int] = set()
    for nodes_used in (used, station_used):
        if ((period[nodes_used] >= 0) & (period[nodes_used] < here - 1)).any():
            return None
        carried |= set(place[nodes_used][period[nodes_used] == here - 1].tolist())
    handed = np.array(sorted(carried), dtype=np.int64)
    places = np.sort(_places(period[used], place[used], here, handed), axis=2)
    station_places = _places(period[station_used], place[station_used], here, handed)
    weights = np.take_along_axis(poses.weights[layout.tracked[stations]], station_order, axis=2)
    if (
        (station_places != station_places[0]).any()
        or (station_places < 0).any()
        or (weights != weights[0]).any()
    ):
        return None
    pattern = np.zeros((3 * own, len(handed) + own), dtype=bool)
    pattern[np.nonzero(places >= 0)[1], places[places >= 0]] = True
    each = bays.actuated[members]
    actuated = each.mean(axis=0) > 0.5
    locked = members[~each & actuated]
    if (each & ~actuated).any() or len(locked) > _MOST_LOCKED:
        return None
    before = np.vstack([np.zeros_like(nodes[:1]), nodes[:-1]])
    before[0, : len(base)] = base
    is_alike = (places >= 0).all() and (places == places[0]).all()
    return Chain(
        layout=layout,
        bays=bays,
        nodes=nodes,
        members=members,
        stage_sizes=sizes,
        node_period=period,
        node_place=place,
        carried=handed,
        window=np.hstack([before[:, handed], nodes]),
        pattern=np.repeat(pattern, 3, axis=1),
        member_places=places[0] if is_alike else None,
        actuated=actuated,
        locked=locked,
        stations=stations,
        station_places=station_places[0],
        station_order=station_order,
        station_weights=weights[0],
    )
