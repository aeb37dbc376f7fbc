"""Mobility of a truss: its counts, free motions, and which coordinates of tip and faces these reach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse.linalg import splu

from vgtm_qp.arm.arm import has_full_rank, rank
from vgtm_qp.arm.frames import frame_spins
from vgtm_qp.arm.truss.determinacy import DeterminacyReport, check_determinacy, in_words, length_jacobian
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.arrays import Array, Index

_ROLL_REASON = (
    ": where the arm is straight, a twist of two faces makes one of a node's two fixed longerons longer "
    "and the other shorter, and no batten can undo that; bent, the arm can roll a little"
)


@dataclass(frozen=True)
class TrussDescription:
    """The counts of a truss and what its free motions reach at one configuration.

    Attributes
    ----------
    module : str
        Name of the module.
    bays, nodes, base_nodes, fixed_members, actuated_members : int
        Counts.
    free_motions : int
        Unknown coordinates less fixed members: the motions that the actuators alone decide.
    trackable, face_stride
        As in :class:`vgtm_qp.arm.truss.truss.Truss`.
    determinacy : DeterminacyReport
        Rank and smallest singular value of the square length Jacobian.
    tip_rank, tip_coordinates : int
        Rank of the tip's Jacobian, and how many coordinates the tip has: 6, or 3 where it has no frame.
    unreachable : tuple of str
        Tip motions that no actuator can start, in words.
    """

    module: str
    bays: int
    nodes: int
    base_nodes: int
    fixed_members: int
    actuated_members: int
    free_motions: int
    trackable: tuple[str, ...]
    face_stride: int
    determinacy: DeterminacyReport
    tip_rank: int
    tip_coordinates: int
    unreachable: tuple[str, ...]

    def __str__(self) -> str:
        report = self.determinacy
        which = "every face" if self.face_stride == 1 else f"every {self.face_stride}nd face"
        lines = [
            f"{self.module}: {self.bays} bays, {self.nodes} nodes ({self.base_nodes} given), "
            f"{self.fixed_members} fixed and {self.actuated_members} actuated members",
            f"statically determinate: {report.members} members, {report.coordinates} coordinates, "
            f"rank {report.rank}, smallest singular value {report.smallest_singular_value:.3g}, "
            f"condition {report.condition:.3g}",
            f"{self.free_motions} free motions; {which} tracks {', '.join(self.trackable) or 'nothing'}",
            f"tip: rank {self.tip_rank} of {self.tip_coordinates} coordinates",
        ]
        lines += [f"  cannot start: {motion}" for motion in self.unreachable]
        return "\n".join(lines)


def pose_response(truss: Truss, nodes: Index, weights: Array, rotations: Array, X: Array) -> Array:
    """Return (F, 6, n_a) twists of F poses for unit rates of each actuator, fixed members kept.

    Three rows for the velocity of each centroid, m/m, and three for its angular velocity, rad/m, both in the
    base frame. Each pose is made of `nodes` (F, K) with `weights` (F, K). If K is 3 or more it has a frame,
    `rotations` (F, 3, 3) at home; otherwise only the first three rows are returned. The nodes of the
    determinate truss are at `X` (N, 3), m.
    """
    count, corners = nodes.shape
    rows = np.zeros((count, 6 if corners >= 3 else 3, truss.node_count, 3))
    every = np.arange(count)[:, None]
    rows[every, :3, nodes] = weights[:, :, None, None] * np.eye(3)
    if corners >= 3:
        spins = frame_spins(X, truss.home, rotations, nodes).reshape(count, 3, corners, 3)
        rows[every, 3:, nodes] = spins.transpose(0, 2, 1, 3)
    unknown = np.ascontiguousarray(rows[:, :, truss.free].reshape(-1, 3 * len(truss.free)).T)
    response = splu(length_jacobian(truss, X)).solve(unknown, trans="T")
    twists: Array = response.T[:, truss.actuators].reshape(count, rows.shape[1], -1)
    return twists


def tip_response(truss: Truss, X: Array | None = None) -> Array:
    """Return :func:`pose_response` (6, n_a) or (3, n_a) of the tip alone, at home if `X` (N, 3) is not given."""
    at = truss.home if X is None else X
    twist = pose_response(truss, truss.tip[None], truss.tip_weights[None], truss.tip_frame[None], at)
    return twist.reshape(-1, len(truss.actuators))


def trackable_coordinates(truss: Truss) -> tuple[str, ...]:
    """Return what every ``face_stride``-th face of a determinate truss can track at home at once, by rank."""
    tracked = slice(truss.face_stride, None, truss.face_stride)
    faces, frames = truss.faces[tracked], truss.face_frames[tracked]
    if not len(faces):
        return ()
    response = pose_response(truss, faces, truss.face_weights[tracked], frames, truss.home)
    turns = np.swapaxes(frames, 1, 2) @ response[:, 3:] * _size(truss)
    local = np.concatenate([response[:, :3], turns], axis=1)
    coordinates: tuple[str, ...] = ()
    for coordinate, count in (("position", 3), ("pointing", 5), ("orientation", 6)):
        if not has_full_rank(local[:, :count].reshape(-1, local.shape[-1])):
            break
        coordinates += (coordinate,)
    return coordinates


def describe(truss: Truss, X: Array | None = None) -> TrussDescription:
    """Return the counts of a truss, its determinacy and what its tip can do, at `X` (N, 3), m, or at home.

    Raises
    ------
    TrussError
        The truss is not statically determinate.
    """
    report = check_determinacy(truss, X)
    response = tip_response(truss, X)
    scaled = response.copy()
    scaled[3:] *= _size(truss)
    left, values, _ = np.linalg.svd(scaled)
    tip_rank = rank(values)
    missing = _roll_first(left[:, tip_rank:], truss)
    fixed = len(truss.fixed)
    return TrussDescription(
        module=truss.module,
        bays=truss.bays,
        nodes=truss.node_count,
        base_nodes=int(np.count_nonzero(truss.base)),
        fixed_members=fixed,
        actuated_members=truss.member_count - fixed,
        free_motions=report.coordinates - fixed,
        trackable=truss.trackable,
        face_stride=truss.face_stride,
        determinacy=report,
        tip_rank=tip_rank,
        tip_coordinates=len(response),
        unreachable=tuple(_twist_in_words(twist, truss) for twist in missing.T),
    )


def _size(truss: Truss) -> float:
    """Length that makes angular velocities comparable with velocities, m."""
    return float(np.ptp(truss.home, axis=0).max())


def _roll_first(missing: Array, truss: Truss) -> Array:
    """Return another orthonormal basis (columns) of the twists `missing`, roll first where it is one of them.

    A singular value decomposition mixes roll with the other missing twists.
    """
    if len(missing) < 6:
        return missing
    roll = np.concatenate([np.zeros(3), truss.tip_frame[:, 2]])
    if np.linalg.norm(roll @ missing) < 1.0 - 1e-9:
        return missing
    basis, _ = np.linalg.qr(np.column_stack([roll, missing]))
    return np.column_stack([roll, basis[:, 1 : missing.shape[1]]])


def _twist_in_words(twist: Array, truss: Truss) -> str:
    """Return the words for a `twist` of the tip: velocity, angular velocity times the truss's size."""
    velocity, spin = twist[:3], twist[3:]
    if np.linalg.norm(spin) < 1e-6:
        return f"motion along {in_words(velocity)}"
    turn = f"a turn about {in_words(spin / np.linalg.norm(spin))}"
    if np.linalg.norm(velocity) > 1e-6:
        return f"{turn} with motion along {in_words(velocity / np.linalg.norm(velocity))}"
    if abs(spin @ truss.tip_frame[:, 2]) < (1.0 - 1e-6) * np.linalg.norm(spin):
        return turn
    return f"roll, {turn}{_ROLL_REASON if 'octahedral' in truss.module else ''}"
