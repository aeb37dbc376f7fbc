"""All segments at once: factorised together at one configuration, chained by small products (block condensation)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Kinematics
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.errors import SolverError
from vgtm_qp.methods.segment_system import Entries
from vgtm_qp.methods.segments import Segment
from vgtm_qp.qp.layout import Layout

Array = NDArray[np.float64]
Index = NDArray[np.int64]


THREADED = 2000
"""Bays from which factorisations are shared out to threads: a few milliseconds of work; for less it does not pay."""


class CurveNodes(NamedTuple):
    """Where the curve nodes are: positions (S, 3), m, and frames (S, 3, 3), one of each per segment."""

    position: Array
    frame: Array


class _Group:
    """Segments of one shape, with the map from the kernel's values to their stacked matrices."""

    def __init__(self, layout: Layout, segments: Sequence[Segment], members: list[int]) -> None:
        truss = truss_of(layout.arm)
        own = [segments[k] for k in members]
        self.members = np.array(members)
        self.tracks, self.columns = own[0].tracks, own[0].columns
        self.is_square = own[0].rows == own[0].columns
        self.fixed = np.stack([segment.fixed for segment in own])
        self.faces = np.array([segment.face for segment in own])
        self.targets = np.array([segment.start for segment in own])[:, None] + np.arange(self.columns)
        entries = [Entries(layout, segment) for segment in own]
        self.shape = (len(own), *entries[0].shape)
        size = self.shape[1] * self.shape[2]
        per_member = 3 * truss.member_nodes.shape[1]
        weights = truss.member_count * per_member
        turns = weights + truss.face_weights.size
        source, target = [], []
        for i, (segment, entry) in enumerate(zip(own, entries, strict=True)):
            row, rest = np.divmod(entry.member_source, per_member)
            source += [
                segment.fixed[row] * per_member + rest,
                weights + 3 * segment.face + entry.weight_source,
                turns + 27 * segment.face + entry.turn_source,
            ]
            target.append(i * size + entry.target)
        self._source, self._target = np.concatenate(source), np.concatenate(target)

    def matrices(self, values: Array) -> tuple[Array, Array]:
        """Return the derivatives by own nodes (K, r, c) and by those before (K, r, b)."""
        flat = np.bincount(self._target, weights=values[self._source], minlength=int(np.prod(self.shape)))
        stacked = flat.reshape(self.shape).astype(np.float64, copy=False)
        return stacked[:, :, : self.columns], stacked[:, :, self.columns :]

    def stacked(self, lengths: Array, moved: Array, turned: Array) -> Array:
        """Return right-hand sides (K, r) from changes of fixed lengths, displacements and turns."""
        rows = [lengths, moved]
        if self.tracks != "position":
            rows.append(turned[:, :2] if self.tracks == "pointing" else turned)
        return np.concatenate(rows, axis=1)


class Condensation:
    """The segments of a truss as one block-bidiagonal system.

    Each segment's matrix is factorised with no knowledge of the others; what remains in sequence is, for each
    segment, the product of a small matrix with the displacement of the nodes that it stands on.
    """

    def __init__(
        self, layout: Layout, kinematics: Kinematics, segments: Sequence[Segment], home: Array
    ) -> None:
        self._layout, self._kinematics, self._segments = layout, kinematics, segments
        self._home = home
        shapes: dict[tuple[int, int, int, str], list[int]] = {}
        for k, segment in enumerate(segments):
            before = segment.start - segment.first
            shapes.setdefault((segment.rows, segment.columns, before, segment.tracks), []).append(k)
        self._groups = [_Group(layout, segments, members) for members in shapes.values()]
        self.is_square = all(group.is_square for group in self._groups)
        self._weights = truss_of(layout.arm).face_weights.ravel()

    def rates(self, moved: Array, turned: Array) -> Array:
        """Return node displacements (3 (N - N_c),) for curve nodes that move and turn, (S, 3) each; lengths stay."""
        rhs = []
        for group in self._groups:
            zeros = np.zeros(group.fixed.shape)
            turn = self._in_face(group, turned[group.members])
            rhs.append(group.stacked(zeros, moved[group.members], turn))
        return self._chained(rhs, None)

    def residuals(self, X: Array, nodes: CurveNodes) -> list[Array]:
        """Return what is missing in each group, (K, r), at node positions `X`, where the kinematics was evaluated."""
        kinematics = self._kinematics
        centres = self._layout.arm.stations.centres(X)
        found = []
        for group in self._groups:
            lengths = self._home[group.fixed] - kinematics.quantities[group.fixed]
            gap = nodes.position[group.members] - centres[group.faces]
            turn = np.zeros((len(group.members), 3))
            frames, wanted = kinematics.station_rotation[group.faces], nodes.frame[group.members]
            if group.tracks == "orientation":
                turn = rotation_vectors(wanted @ np.swapaxes(frames, 1, 2))
            elif group.tracks == "pointing":
                turn = turns_between(frames[:, :, 2], wanted[:, :, 2])
            found.append(group.stacked(lengths, gap, self._in_face(group, turn)))
        return found

    def step(self, rhs: list[Array], travelled: Array) -> Array:
        """Return the displacements that solve all segments for `rhs`; see :meth:`Tracker.track` for `travelled`."""
        return self._chained(rhs, travelled)

    def _in_face(self, group: _Group, turn: Array) -> Array:
        """Return turns (K, 3) with their components along the faces' axes where a direction is tracked."""
        if group.tracks != "pointing":
            return turn
        return np.asarray(np.einsum("kca,kc->ka", self._kinematics.station_rotation[group.faces], turn))

    def _chained(self, rhs: list[Array], travelled: Array | None) -> Array:
        kinematics = self._kinematics
        spin = np.array(kinematics.station_spin)
        for group in self._groups:
            if group.tracks == "pointing":
                axes = np.swapaxes(kinematics.station_rotation[group.faces], 1, 2)
                spin[group.faces] = axes @ kinematics.station_spin[group.faces]
        values = np.concatenate([kinematics.gradient.ravel(), self._weights, spin.ravel()])
        alone = np.zeros(self._layout.node_columns)
        passed: list[Array] = [np.zeros((0, 0))] * len(self._segments)
        for group, right in zip(self._groups, rhs, strict=True):
            own, before = group.matrices(values)
            past = None if travelled is None or group.is_square else travelled[group.targets]
            if past is not None:
                right = right + np.einsum("krc,kc->kr", own, past)
            answers = least_norm(own, np.concatenate([right[:, :, None], before], axis=2))
            alone[group.targets] = answers[:, :, 0] if past is None else answers[:, :, 0] - past
            for k, answer in zip(group.members, answers, strict=True):
                passed[k] = answer[:, 1:]
        for k, segment in enumerate(self._segments):
            if segment.first < segment.start:
                end = segment.start + segment.columns
                alone[segment.start : end] -= passed[k] @ alone[segment.first : segment.start]
        return alone


def least_norm(A: Array, b: Array) -> Array:
    """Return the solution of A x = b, or that of least norm where A (..., r, c) has more columns than rows.

    Raises
    ------
    SolverError
        A has dependent rows.
    """
    rows, columns = A.shape[-2:]
    try:
        if rows == columns:
            return _solve(A, b)
        At = np.swapaxes(A, -1, -2)
        return np.asarray(At @ _solve(A @ At, b))
    except np.linalg.LinAlgError:
        raise SolverError("tracking: a bay is in a singular pose") from None


def _solve(A: Array, b: Array) -> Array:
    """Solve one system or a stack of them; many bays are shared out to threads, which LAPACK lets run side by side."""
    cores = os.cpu_count() or 1
    if A.ndim < 3 or len(A) < THREADED or cores < 2:
        return np.asarray(np.linalg.solve(A, b), dtype=np.float64)
    pieces = np.array_split(np.arange(len(A)), cores)
    with ThreadPoolExecutor(cores) as pool:
        return np.concatenate(list(pool.map(lambda piece: np.linalg.solve(A[piece], b[piece]), pieces)))


def rotation_vectors(rotations: Array) -> Array:
    """Return the rotation vectors (K, 3), rad, of rotations (K, 3, 3) by less than half a turn."""
    twist = np.stack(
        [rotations[:, (k + 2) % 3, (k + 1) % 3] - rotations[:, (k + 1) % 3, (k + 2) % 3] for k in range(3)], 1
    )
    sine = np.linalg.norm(twist, axis=1) / 2.0
    cosine = (np.trace(rotations, axis1=1, axis2=2) - 1.0) / 2.0
    angle = np.arctan2(sine, cosine)
    factor = np.divide(angle, 2.0 * sine, out=np.full_like(sine, 0.5), where=sine > 1e-7)
    return np.asarray(twist * factor[:, None])


def turns_between(start: Array, end: Array) -> Array:
    """Return the rotation vectors (K, 3), rad, that take unit vectors `start` (K, 3) to `end` the short way."""
    axis = np.cross(start, end)
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, np.einsum("kc,kc->k", start, end))
    factor = np.divide(angle, sine, out=np.ones_like(sine), where=sine > 1e-12)
    return np.asarray(axis * factor[:, None])
