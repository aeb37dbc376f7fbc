"""The equations of one segment, evaluated on its own: its fixed members and what its end face tracks, eq. (39)."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.frames import frame_constants, frame_function
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.arm.truss.kinematics import member_function
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.compiled import Kernel
from vgtm_qp.methods.segments import Segment
from vgtm_qp.qp.layout import Layout
from vgtm_qp.rotation import turn_between, vector_from_rotation

Array = NDArray[np.float64]
Index = NDArray[np.int64]


class Entries:
    """Where the values of one segment's kernel stand in its matrix (rows, own columns then those before)."""

    def __init__(self, layout: Layout, segment: Segment) -> None:
        truss = truss_of(layout.arm)
        column = layout.node_column[truss.member_nodes[segment.fixed]]
        row, slot = np.nonzero(column >= 0)
        axis = np.arange(3)
        self.member_source = ((row * column.shape[1] + slot)[:, None] * 3 + axis).ravel()
        member_target = row[:, None], column[row, slot][:, None] + axis
        face_column = layout.node_column[truss.faces[segment.face]]
        (corner,) = np.nonzero(face_column >= 0)
        self.weight_source = np.repeat(corner, 3)
        first = len(segment.fixed)
        face_target = first + axis[None, :], face_column[corner][:, None] + axis
        turns = segment.rows - first - 3
        self.turn_source = (
            np.arange(turns)[:, None] * 9 + (3 * corner[:, None] + axis).reshape(1, -1)
        ).ravel()
        turn_target = (
            first + 3 + np.arange(turns)[:, None],
            (face_column[corner][:, None] + axis).reshape(1, -1),
        )
        width = segment.columns + segment.start - segment.first

        def flat(row: Index, column: Index) -> Index:
            own = column >= segment.start
            local = np.where(own, column - segment.start, column - segment.first + segment.columns)
            return np.asarray(row * width + local).ravel()

        self.target = np.concatenate([flat(*member_target), flat(*face_target), flat(*turn_target)])
        self.shape = segment.rows, width


class SegmentSystem:
    """One segment at one configuration; kernels of segments of the same shape are shared.

    Parameters
    ----------
    kernels : dict
        The kernels made so far, by shape; a new one is added.
    """

    def __init__(
        self, layout: Layout, segment: Segment, home_lengths: Array, kernels: dict[tuple[int, bool], Kernel]
    ) -> None:
        truss = truss_of(layout.arm)
        self.segment = segment
        self._nodes = truss.member_nodes[segment.fixed].ravel()
        self._home = home_lengths[segment.fixed]
        self._face, self._weights = truss.faces[segment.face], truss.face_weights[segment.face]
        self._entries = Entries(layout, segment)
        turns = segment.tracks != "position"
        home = truss.home[self._face]
        cosines, sines, alignment = frame_constants(home, truss.face_frames[segment.face])
        self._constants = [cosines, sines, alignment.T.ravel()] if turns else []
        if truss.joints is not None:
            self._constants.append(truss.joints.offset[segment.fixed].ravel())
        shape = len(segment.fixed), turns
        if shape not in kernels:
            kernels[shape] = Kernel(_function(truss, *shape))
        self._kernel = kernels[shape]
        self._centre = np.zeros(3)

    def evaluate(self, X: Array) -> None:
        """Evaluate at node positions `X` (N, 3): everything else is of that configuration, until the next one."""
        inputs = self._kernel.inputs
        inputs[0][:] = X[self._nodes].ravel()
        inputs[1][:] = X[self._face].ravel()
        for given, constant in zip(inputs[2:], self._constants, strict=True):
            given[:] = constant
        self._kernel()
        self._centre = self._weights @ X[self._face]

    @property
    def frame(self) -> Array:
        """(3, 3) rotation of the end face."""
        return self._kernel.outputs[2].reshape(3, 3).T

    def matrices(self) -> tuple[Array, Array]:
        """Return the derivatives by the segment's own nodes (r, c), and by those before it (r, b)."""
        outputs, entries, segment = self._kernel.outputs, self._entries, self.segment
        values = [outputs[1][entries.member_source], self._weights[entries.weight_source]]
        if segment.tracks != "position":
            spin = outputs[3].reshape(9, 3).T
            turning = spin if segment.tracks == "orientation" else self.frame[:, :2].T @ spin
            values.append(turning.ravel()[entries.turn_source])
        rows, width = entries.shape
        flat = np.bincount(entries.target, weights=np.concatenate(values), minlength=rows * width)
        matrix = flat.reshape(rows, width).astype(np.float64, copy=False)
        return matrix[:, : segment.columns], matrix[:, segment.columns :]

    def displacement(self, moved: Array, turned: Array) -> Array:
        """Return the right-hand side (r,) of a curve node that moves by `moved`, m, and turns by `turned`, rad."""
        return np.concatenate([np.zeros(len(self._home)), moved, self._turning(turned)])

    def residual(self, position: Array, frame: Array) -> Array:
        """Return (r,) what is missing: in fixed lengths and to the curve node's `position` (3,) and `frame` (3, 3)."""
        tracks = self.segment.tracks
        turn = np.zeros(3)
        if tracks == "orientation":
            turn = vector_from_rotation(frame @ self.frame.T)
        elif tracks == "pointing":
            turn = turn_between(self.frame[:, 2], frame[:, 2])
        lengths = self._home - self._kernel.outputs[0][: len(self._home)]
        return np.concatenate([lengths, position - self._centre, self._turning(turn)])

    def _turning(self, turn: Array) -> Array:
        if self.segment.tracks == "position":
            return np.zeros(0)
        return turn if self.segment.tracks == "orientation" else np.asarray(self.frame[:, :2].T @ turn)


def _function(truss: Truss, members: int, turns: bool) -> ca.Function:
    """Return (member nodes (3, Q m), face nodes, constants) -> lengths, gradients and, if it turns, frame and spin."""
    slots = truss.member_nodes.shape[1]
    nodes, face = ca.MX.sym("nodes", 3, slots * members), ca.MX.sym("face", 3, 3)
    inputs, outputs = [nodes, face], []
    frame = [ca.MX.sym("cosines", 3), ca.MX.sym("sines", 3), ca.MX.sym("alignment", 3, 3)] if turns else []
    inputs += frame
    arguments = [nodes]
    if truss.joints is not None:
        offsets = ca.MX.sym("offsets", 3, 2 * members)
        inputs.append(offsets)
        arguments.append(offsets)
    outputs += list(member_function(truss).map(members)(*arguments)) if members else [ca.MX(0, 0)] * 2
    if turns:
        outputs += list(frame_function(3)(face, *frame))
    return ca.Function("segment", inputs, outputs)
