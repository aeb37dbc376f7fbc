"""Partition of an arm into segments (figure 6): the coordinates that each owns, and what its end tracks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from vgtm_qp.arm.arm import Arm, Kinematics, has_full_rank
from vgtm_qp.arm.joint_space import JointSpaceArm
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import CurveError
from vgtm_qp.qp.layout import Layout

ROWS = {"position": 3, "pointing": 5, "orientation": 6}
"""Number of coordinates that a station tracks on the curve."""

_JOINED = 3
"""Bays of a segment that turns its end face: one or two straight octahedral bays would also move it."""

_WEAKEST = 0.01
"""Least ratio of singular values of a segment's joints: nearly straight links would need more for any stretch."""

_BENDS, _NOTHING = 0.1, 1e-9
"""Mean turn of joints from home, rad, and derivative of a node's position below which a joint does not move it."""


@dataclass(frozen=True, eq=False)
class Segment:
    """Consecutive bays or joints that track one curve node with their end station.

    See eq. (39). Its coordinates are displacements, m: of nodes, three to a node; or of joints, angles times the arm's
    unit.

    Attributes
    ----------
    name : str
        Its bays or joints, as messages call them.
    number : int
        Place among the segments, from the base on.
    station : int
        The one at its end.
    tracks : str
        ``"position"``, ``"pointing"`` (and position) or ``"orientation"`` (and position).
    start, columns : int
        The first of its own coordinates, which are contiguous, and their number.
    first : int
        First coordinate, up to `start`, that any of its equations depends on.
    fixed : (m,) int
        Fixed members whose last node it places.
    """

    name: str
    number: int
    station: int
    tracks: str
    start: int
    columns: int
    first: int = 0
    fixed: Index = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    @property
    def end(self) -> int:
        """The coordinate after its last own one."""
        return self.start + self.columns

    @property
    def rows(self) -> int:
        """Number of equations: fixed members and tracked coordinates."""
        return len(self.fixed) + ROWS[self.tracks]

    @property
    def is_square(self) -> bool:
        """Whether there are as many equations as unknowns, and so one answer."""
        return self.rows == self.columns


def make_segments(layout: Layout, kinematics: Kinematics, turns: str | None) -> tuple[Segment, ...]:
    """Return the segments of an arm whose end effector tracks `turns` ("pointing", "orientation" or None).

    Of a truss, every ``face_stride``-th face tracks all that the module can, see ``Truss.trackable``. Bays
    that are left over are next to the base, and track positions. If the end effector has to turn and a single
    bay cannot, the last bays are joined until they can. For arms in joint space see :func:`_joint_segments`.
    Overwrites `kinematics`.

    Raises
    ------
    CurveError
        The arm has no stations, does not end in its end effector, or a segment has more equations than motions.
    """
    arm = layout.arm
    if len(arm.stations) < 2:
        raise CurveError(f"an arm without {arm.stations.word}s cannot track a curve")
    if sorted(arm.stations.nodes[-1]) != sorted(arm.end_effector.nodes):
        raise CurveError(
            f"the curve ends at the last {arm.stations.word}, so the end effector must be that one"
        )
    if isinstance(arm, JointSpaceArm):
        return tuple(_joint_segments(arm, kinematics, turns))
    return tuple(_bay_segments(layout, _bays(arm, turns)))


def _bays(arm: Arm, turns: str | None) -> list[tuple[int, str]]:
    """Return the end face of each segment of a truss, and what it tracks."""
    truss = truss_of(arm)
    last, most, stride = len(truss.faces) - 1, truss.trackable[-1], truss.face_stride
    ends = range(last % stride or stride, last + 1, stride)
    partition = [(face, most) for face in ends]
    if last % stride:
        partition = [(face, "position") for face in range(1, ends[0] + 1)] + partition[1:]
    if turns and ROWS[turns] > ROWS[most]:
        if last < _JOINED:
            raise CurveError(f'"{turns}" at the tip takes {_JOINED} bays of this module; it has {last}')
        partition = [*partition[: max(len(partition) - _JOINED, 0)], (last, turns)]
    return partition


def _bay_segments(layout: Layout, partition: list[tuple[int, str]]) -> list[Segment]:
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
        name, count = f"bays up to face {face}", 3 * len(nodes)
        segment = Segment(name, len(segments), face, tracks, start, count, min(first, start), members)
        if segment.rows > segment.columns:
            raise CurveError(
                f"the {name} have {segment.columns - len(members)} free motions and cannot track "
                f"{ROWS[tracks]} coordinates"
            )
        segments.append(segment)
        before = last
    return segments


def _joint_segments(arm: JointSpaceArm, kinematics: Kinematics, turns: str | None) -> Iterator[Segment]:
    """Yield the segments of an arm in joint space: few joints each, as many as their station needs at home.

    All track positions; the last one tracks the end effector's turns too. A station ends a segment if the joints
    beyond the segment before can move it well in every direction, and if no joint before it follows one beyond it.
    Joints of other stations belong to the next segment. The last segment grows towards the base until it can do its
    part.

    Raises
    ------
    CurveError
        The whole arm cannot move its end effector in every tracked direction at home.
    """
    last, bent = len(arm.stations) - 1, arm.home_configuration.copy()
    # Joints that do not move a station at home may move it in other poses.
    bent[:-6] += _BENDS * (1.0 + np.sin(np.arange(len(bent) - 6)))
    kinematics.evaluate(bent)
    moving = np.abs(moved_by_joints(arm, kinematics)[arm.stations.nodes[:, 0]]).max(axis=1) > _NOTHING
    kinematics.evaluate(arm.home_configuration)
    by_joints = moved_by_joints(arm, kinematics)
    starts, stations = [0], []
    for k in range(1, last):
        # If joints in between do not move it, a joint before the station follows one beyond.
        end = int(np.count_nonzero(moving[k]))
        is_whole = bool(moving[k, :end].all())
        if is_whole and _moves_well(by_joints[arm.stations.nodes[k, 0]][:, starts[-1] : end]):
            stations.append(k)
            starts.append(end)
    tracks = turns or "position"
    rows = tip_rows(arm, kinematics, by_joints, tracks)
    rows[3:] *= arm.unit
    if not has_full_rank(rows):
        raise CurveError(
            f"the joints cannot move the {ROWS[tracks]} tracked coordinates of the tip independently at home"
        )
    while stations and not _moves_well(rows[:, starts[-1] :]):
        stations.pop()
        starts.pop()
    kinds = ["position"] * len(stations) + [tracks]
    names = [arm.node_names[k] for k in arm.stations.nodes[:, 0]]
    ends = [*starts[1:], len(arm.actuators)]
    for number, (k, kind, start, end) in enumerate(zip([*stations, last], kinds, starts, ends, strict=True)):
        yield Segment(f"joints up to {names[k]}", number, k, kind, start, end - start)


def _moves_well(rows: Array) -> bool:
    """Whether the joints of a Jacobian (r, c) can move all r coordinates, none with much greater turns than another."""
    if rows.shape[1] < len(rows):
        return False
    values = np.linalg.svd(rows, compute_uv=False)
    return bool(values[-1] > _WEAKEST * values[0])


def moved_by_joints(arm: JointSpaceArm, kinematics: Kinematics) -> Array:
    """Return (N, 3, n_a) derivatives of the nodes where `kinematics` was evaluated, by the coordinates of segments."""
    response, _ = kinematics.motion().response()
    every = np.zeros((len(arm.node_names), 3, response.shape[1]))
    every[arm.free] = (response / arm.levers).reshape(len(arm.free), 3, -1)
    return every


def tip_rows(arm: JointSpaceArm, kinematics: Kinematics, by_joints: Array, tracks: str) -> Array:
    """Return (r, n_a) the rows of the end effector: its position, and its turns as far as it `tracks` them."""
    nodes = arm.end_effector.nodes
    turned = kinematics.tip_spin @ by_joints[nodes].reshape(3 * len(nodes), -1)
    position = np.einsum("k,kcj->cj", arm.end_effector.weights, by_joints[nodes])
    return np.concatenate([position, tracked_turns(tracks, kinematics.tip_rotation[None], turned[None])[0]])


def tracked_turns(tracks: str, rotation: Array, turns: Array) -> Array:
    """Return the tracked rows (K, t, n) of turns (K, 3, n).

    t = 0, 3, or 2 about the x- and y-axes of stations with a `rotation` (K, 3, 3).
    """
    if tracks == "position":
        return turns[:, :0]
    return turns if tracks == "orientation" else np.asarray(np.swapaxes(rotation[:, :, :2], 1, 2) @ turns)
