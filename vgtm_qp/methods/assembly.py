"""The equations of segments at one configuration: fixed members, and tracked coordinates of end stations, eq. (39)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from vgtm_qp.arm.arm import Kinematics
from vgtm_qp.arm.frames import frame_function, frame_tables
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.arrays import Array, Index
from vgtm_qp.compiled import Kernel
from vgtm_qp.methods.segments import Segment, tracked_turns
from vgtm_qp.qp.layout import Layout
from vgtm_qp.rotation import vector_from_rotation
from vgtm_qp.rows.members import member_function


class CurveNodes(NamedTuple):
    """Where the curve nodes are: positions (S, 3), m, and frames (S, 3, 3), one of each per segment."""

    position: Array
    frame: Array

    def of(self, numbers: Index) -> CurveNodes:
        """Return those of some segments (K,)."""
        return CurveNodes(self.position.take(numbers, axis=0), self.frame.take(numbers, axis=0))


class SegmentKinematics:
    """Kinematics of a truss as in ``arm.Kinematics``, evaluated for one segment at a time."""

    def __init__(self, truss: Truss) -> None:
        faces = len(truss.faces)
        self._truss = truss
        self._frame_tables = frame_tables(truss.home[truss.faces], truss.face_frames)
        self._members: dict[int, Kernel] = {}
        self.quantities = np.zeros(truss.member_count)
        self.gradient = np.zeros((*truss.member_nodes.shape, 3))
        self.station_rotation, self.station_spin = np.zeros((faces, 3, 3)), np.zeros((faces, 3, 9))

    @cached_property
    def _frame(self) -> Kernel:
        return Kernel(frame_function(3))

    def evaluate(self, X: Array, segment: Segment) -> None:
        """Overwrite the values of a segment's fixed members and end face with those at `X` (N, 3), m."""
        truss, fixed, face = self._truss, segment.fixed, segment.station
        if len(fixed):
            if len(fixed) not in self._members:
                member = member_function(has_offsets=truss.joints is not None)
                self._members[len(fixed)] = Kernel(member.map(len(fixed)))
            members = self._members[len(fixed)]
            members.inputs[0][:] = X.take(truss.member_nodes[fixed].ravel(), axis=0).ravel()
            if truss.joints is not None:
                members.inputs[1][:] = truss.joints.offset[fixed].ravel()
            members()
            self.quantities[fixed] = members.outputs[0]
            self.gradient[fixed] = members.outputs[1].reshape(len(fixed), -1, 3)
        if segment.tracks != "position":
            cosines, sines, alignments = self._frame_tables
            given = (
                X[truss.faces[face]].ravel(),
                cosines[face],
                sines[face],
                alignments[3 * face : 3 * face + 3].ravel(),
            )
            for argument, value in zip(self._frame.inputs, given, strict=True):
                argument[:] = value
            self._frame()
            self.station_rotation[face] = self._frame.outputs[0].reshape(3, 3).T
            self.station_spin[face] = self._frame.outputs[1].reshape(9, 3).T


class BaySegments:
    """The equations of a truss in segments, see ``tracking.SegmentedArm``: coordinates are those of the free nodes.

    `kinematics` evaluates all segments at once.
    """

    def __init__(self, layout: Layout, kinematics: Kinematics) -> None:
        self.coordinates = layout.node_columns
        self.furthest = 2.0 * float(layout.arm.home_quantities.max())
        self._layout, self._kinematics, self._free = layout, kinematics, layout.arm.free
        self._single = SegmentKinematics(truss_of(layout.arm))

    def move(self, q: Array, own: slice, d: Array) -> None:
        """See ``tracking.SegmentedArm``."""
        q[self._free[own.start // 3 : own.stop // 3]] += d.reshape(-1, 3)

    def equations(self, segments: Sequence[Segment]) -> tuple[Callable[[Array], None], list[SegmentGroup]]:
        """See ``tracking.SegmentedArm``."""
        kinematics: Kinematics | SegmentKinematics = self._kinematics
        evaluate: Callable[[Array], None] = self._kinematics.evaluate
        if len(segments) == 1:
            kinematics = self._single
            evaluate = partial(self._single.evaluate, segment=segments[0])
        shapes: dict[tuple[int, int, int, str], list[Segment]] = {}
        for segment in segments:
            before = segment.start - segment.first
            shapes.setdefault((segment.rows, segment.columns, before, segment.tracks), []).append(segment)
        return evaluate, [SegmentGroup(self._layout, alike, kinematics) for alike in shapes.values()]


class SegmentGroup:
    """The equations of K segments of one shape, stacked: see ``tracking.SegmentEquations``."""

    def __init__(
        self, layout: Layout, segments: Sequence[Segment], kinematics: Kinematics | SegmentKinematics
    ) -> None:
        truss, one = truss_of(layout.arm), segments[0]
        self.numbers = np.array([segment.number for segment in segments])
        self._tracks, self._kinematics = one.tracks, kinematics
        self._fixed = np.stack([segment.fixed for segment in segments])
        self._home, self._still = layout.arm.home_quantities[self._fixed], np.zeros(self._fixed.shape)
        self._face = np.array([segment.station for segment in segments])
        self._corners, self._weights = truss.faces[self._face], truss.face_weights[self._face][:, None]
        self._centre_rows = np.repeat(self._weights, 3)
        start = np.array([segment.start for segment in segments])
        self.columns = start[:, None] + np.arange(one.columns)
        self._own, self._width = one.columns, one.columns + one.start - one.first
        count, lengths = self._fixed.shape
        turns = one.rows - lengths - 3
        # Entries of base nodes go to three columns beyond the last, and are cut off.
        self._shape = count, one.rows, self._width + 3
        self._size = int(np.prod(self._shape))

        def columns(nodes: Index) -> Index:
            """Return the columns in the segments' own matrices (K, ..., 3) of nodes (K, ...)."""
            column = layout.node_column[nodes]
            origin = start.reshape(-1, *[1] * (nodes.ndim - 1))
            before = column - origin + (one.start - one.first) + one.columns
            local = np.where(column >= origin, column - origin, before)
            return np.asarray(np.where(column >= 0, local, self._width)[..., None] + np.arange(3))

        def places(row: Index, column: Index) -> Index:
            first = one.rows * np.arange(count).reshape(-1, *[1] * (column.ndim - 1))
            return np.asarray((first + row) * self._shape[2] + column).ravel()

        at_corners = columns(self._corners)
        self._places = np.concatenate(
            [
                places(np.arange(lengths)[:, None, None], columns(truss.member_nodes[self._fixed])),
                places(lengths + np.arange(3), at_corners),
                places(lengths + 3 + np.arange(turns)[:, None], at_corners.reshape(count, 1, 9)),
            ]
        )

    def matrices(self) -> tuple[Array, Array]:
        """Return the derivatives by own nodes (K, r, c) and by those before (K, r, b)."""
        kinematics = self._kinematics
        values = [
            kinematics.gradient.take(self._fixed, axis=0).ravel(),
            self._centre_rows,
            tracked_turns(self._tracks, self._frames, kinematics.station_spin[self._face]).ravel(),
        ]
        flat = np.bincount(self._places, weights=np.concatenate(values), minlength=self._size)
        stacked = flat.reshape(self._shape).astype(np.float64, copy=False)
        return stacked[:, :, : self._own], stacked[:, :, self._own : self._width]

    def displacements(self, moved: Array, turned: Array) -> Array:
        """Return the right-hand sides (K, r) for curve nodes that move and turn, (S, 3) each, m and rad."""
        wanted = station_motions(self._tracks, self._frames, moved[self.numbers], turned[self.numbers])
        return np.concatenate([self._still, wanted], axis=1)

    def residuals(self, X: Array, nodes: CurveNodes) -> Array:
        """Return (K, r) errors of lengths and of end faces against `nodes`, at the evaluated configuration `X`."""
        lengths = self._home - self._kinematics.quantities.take(self._fixed)
        centres = (self._weights @ X.take(self._corners, axis=0))[:, 0]
        gaps = station_gaps(self._tracks, centres, self._frames, nodes.of(self.numbers))
        return np.concatenate([lengths, gaps], axis=1)

    @property
    def _frames(self) -> Array:
        """(K, 3, 3) frames of the end faces."""
        return self._kinematics.station_rotation.take(self._face, axis=0)


def station_gaps(tracks: str, centres: Array, frames: Array, nodes: CurveNodes) -> Array:
    """Return (K, 3 + t) what K stations miss to their curve nodes: positions, m, and tracked turns, rad."""
    gap = nodes.position - centres
    if tracks == "position":
        return gap
    if tracks == "orientation":
        turn = rotation_vectors(nodes.frame @ np.swapaxes(frames, 1, 2))
    else:
        turn = _turns_between(frames[:, :, 2], nodes.frame[:, :, 2])
    return station_motions(tracks, frames, gap, turn)


def station_motions(tracks: str, frames: Array, moved: Array, turned: Array) -> Array:
    """Return (K, 3 + t) the tracked coordinates of displacements `moved`, m, and rotation vectors `turned`, rad."""
    if tracks == "position":
        return moved
    return np.concatenate([moved, tracked_turns(tracks, frames, turned[:, :, None])[:, :, 0]], axis=1)


def rotation_vectors(rotations: Array) -> Array:
    """Return the rotation vectors (K, 3), rad, of rotations (K, 3, 3) by less than half a turn."""
    if len(rotations) == 1:
        return vector_from_rotation(rotations[0])[None]
    skew = rotations - np.swapaxes(rotations, 1, 2)
    twist = skew[:, [2, 0, 1], [1, 2, 0]] / 2.0
    cosine = (np.einsum("kii->k", rotations) - 1.0) / 2.0
    return _along(twist, cosine)


def _turns_between(start: Array, end: Array) -> Array:
    """Return the least rotation vectors (K, 3), rad, that take unit vectors `start` (K, 3) to `end`."""
    return _along(np.cross(start, end), np.einsum("kc,kc->k", start, end))


def _along(twist: Array, cosine: Array) -> Array:
    """Return the rotation vectors (K, 3) of turns with the given axes times sines, (K, 3), and cosines (K,)."""
    sine = np.sqrt(np.einsum("kc,kc->k", twist, twist))
    factor = np.where(sine > 1e-12, np.arctan2(sine, cosine) / np.maximum(sine, 1e-12), 1.0)
    return np.asarray(twist * factor[:, None])
