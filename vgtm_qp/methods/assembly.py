"""The equations of segments at one configuration: fixed members, and tracked coordinates of end faces, eq. (39)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from vgtm_qp.arm.arm import Kinematics
from vgtm_qp.arm.frames import frame_function, frame_tables
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.arrays import Array, Index
from vgtm_qp.compiled import Kernel
from vgtm_qp.methods.segments import Segment
from vgtm_qp.qp.layout import Layout
from vgtm_qp.rotation import vector_from_rotation
from vgtm_qp.rows.members import member_function


class CurveNodes(NamedTuple):
    """Where the curve nodes are: positions (S, 3), m, and frames (S, 3, 3), one of each per segment."""

    position: Array
    frame: Array


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
        truss, fixed, face = self._truss, segment.fixed, segment.face
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


class SegmentGroup:
    """The equations of K segments of one shape, stacked: r rows over c own columns and b columns before them.

    ``numbers`` (K,) are those of the segments; ``columns`` (K, c) are the columns of their nodes in the
    layout.
    """

    def __init__(
        self, layout: Layout, segments: Sequence[Segment], kinematics: Kinematics | SegmentKinematics
    ) -> None:
        truss, one = truss_of(layout.arm), segments[0]
        self.is_square = one.is_square
        self.numbers = np.array([segment.number for segment in segments])
        self._tracks, self._kinematics = one.tracks, kinematics
        self._fixed = np.stack([segment.fixed for segment in segments])
        self._home, self._still = layout.arm.home_quantities[self._fixed], np.zeros(self._fixed.shape)
        self._face = np.array([segment.face for segment in segments])
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
            self._tracked(kinematics.station_spin[self._face]).ravel(),
        ]
        flat = np.bincount(self._places, weights=np.concatenate(values), minlength=self._size)
        stacked = flat.reshape(self._shape).astype(np.float64, copy=False)
        return stacked[:, :, : self._own], stacked[:, :, self._own : self._width]

    def displacements(self, moved: Array, turned: Array) -> Array:
        """Return the right-hand sides (K, r) for curve nodes that move and turn, (S, 3) each, m and rad."""
        moved, turned = moved.take(self.numbers, axis=0), turned.take(self.numbers, axis=0)
        return self._stacked(self._still, moved, turned)

    def residuals(self, X: Array, nodes: CurveNodes) -> Array:
        """Return (K, r) errors of lengths and of end faces against `nodes`, at the evaluated configuration `X`."""
        lengths = self._home - self._kinematics.quantities.take(self._fixed)
        gap = (
            nodes.position.take(self.numbers, axis=0) - (self._weights @ X.take(self._corners, axis=0))[:, 0]
        )
        if self._tracks == "position":
            return np.concatenate([lengths, gap], axis=1)
        frames, wanted = self._kinematics.station_rotation[self._face], nodes.frame[self.numbers]
        if self._tracks == "orientation":
            turn = rotation_vectors(wanted @ np.swapaxes(frames, 1, 2))
        else:
            turn = _turns_between(frames[:, :, 2], wanted[:, :, 2])
        return self._stacked(lengths, gap, turn)

    def _stacked(self, lengths: Array, moved: Array, turned: Array) -> Array:
        if self._tracks == "position":
            return np.concatenate([lengths, moved], axis=1)
        return np.concatenate([lengths, moved, self._tracked(turned[:, :, None])[:, :, 0]], axis=1)

    def _tracked(self, turns: Array) -> Array:
        """Return the tracked rows (K, t, n) of turns (K, 3, n): t = 0, 3, or 2 about the face's x and y."""
        if self._tracks == "position":
            return turns[:, :0]
        if self._tracks == "orientation":
            return turns
        axes = self._kinematics.station_rotation[self._face][:, :, :2]
        return np.asarray(np.swapaxes(axes, 1, 2) @ turns)


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
