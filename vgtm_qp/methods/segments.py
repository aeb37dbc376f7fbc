"""Partition of a truss into segments (figure 6), with the nodes and tracked coordinates of each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.arrays import Index
from vgtm_qp.errors import CurveError
from vgtm_qp.qp.layout import Layout

_ROWS = {"position": 3, "pointing": 5, "orientation": 6}

_JOINED = 3
"""Bays of a segment that turns its end face: one or two straight octahedral bays would also move it."""


@dataclass(frozen=True, eq=False)
class Segment:
    """Consecutive bays that track one curve node with their end face, eq. (39).

    Attributes
    ----------
    number : int
        Place among the segments, from the base on.
    face : int
        The end face.
    tracks : str
        ``"position"``, ``"pointing"`` (and position) or ``"orientation"`` (and position).
    nodes : (K,) int
        Nodes that it places, in the order of the layout's columns.
    start : int
        Column of the first of them; they are contiguous.
    first : int
        First column, up to `start`, that any of its rows depends on.
    fixed : (m,) int
        Fixed members whose last node it places.
    """

    number: int
    face: int
    tracks: str
    nodes: Index
    start: int
    first: int
    fixed: Index

    @property
    def columns(self) -> int:
        """Number of unknowns, three to a node."""
        return 3 * len(self.nodes)

    @property
    def rows(self) -> int:
        """Number of equations: fixed members and tracked coordinates."""
        return len(self.fixed) + _ROWS[self.tracks]

    @property
    def is_square(self) -> bool:
        """Whether there are as many equations as unknowns, and so one answer."""
        return self.rows == self.columns


def make_segments(layout: Layout, turns: str | None) -> tuple[Segment, ...]:
    """Return the segments of a truss whose end effector tracks `turns` ("pointing", "orientation" or None).

    Every ``face_stride``-th face tracks all that the module can, see ``Truss.trackable``. Bays that are left
    over are next to the base, and track positions. If the end effector has to turn and a single bay cannot,
    the last bays are joined until they can.

    Raises
    ------
    CurveError
        The truss has no faces, does not end in its end effector, or a segment has more equations than motions.
    """
    truss = truss_of(layout.arm)
    faces = len(truss.faces)
    if faces < 2:
        raise CurveError("a truss without faces cannot track a curve")
    if sorted(truss.faces[-1]) != sorted(truss.tip):
        raise CurveError("the curve ends at the last face, so the end effector must be that face")
    most = truss.trackable[-1]
    stride = truss.face_stride
    ends = range((faces - 1) % stride or stride, faces, stride)
    partition = [(face, most) for face in ends]
    if (faces - 1) % stride:
        partition = [(face, "position") for face in range(1, ends[0] + 1)] + partition[1:]
    if turns and _ROWS[turns] > _ROWS[most]:
        if faces - 1 < _JOINED:
            raise CurveError(f'"{turns}" at the tip takes {_JOINED} bays of this module; it has {faces - 1}')
        partition = [*partition[: max(len(partition) - _JOINED, 0)], (faces - 1, turns)]
    return tuple(_segments(layout, partition))


def _segments(layout: Layout, partition: list[tuple[int, str]]) -> list[Segment]:
    truss = truss_of(layout.arm)
    last_stage = [int(truss.stage[truss.faces[face]].max()) for face, _ in partition]
    last_stage[-1] = int(truss.stage.max())
    latest = truss.stage[truss.member_nodes].max(axis=1)
    segments: list[Segment] = []
    before = -1
    for (face, tracks), last in zip(partition, last_stage, strict=True):
        nodes = truss.free[(truss.stage[truss.free] > before) & (truss.stage[truss.free] <= last)]
        members = truss.fixed[(latest[truss.fixed] > before) & (latest[truss.fixed] <= last)]
        touched = np.concatenate([truss.member_nodes[members].ravel(), truss.faces[face]])
        columns = layout.node_column[touched]
        start = int(layout.node_column[nodes].min(initial=layout.node_columns))
        first = int(np.min(columns[columns >= 0], initial=start))
        segment = Segment(len(segments), face, tracks, nodes, start, min(first, start), members)
        if segment.rows > segment.columns:
            raise CurveError(
                f"the bays up to face {face} have {segment.columns - len(members)} free motions and cannot track "
                f"{_ROWS[tracks]} coordinates"
            )
        segments.append(segment)
        before = last
    return segments
