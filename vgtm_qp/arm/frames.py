"""Rotations of stations and end effector, fitted to their nodes, and the angular velocity that the nodes give them."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import casadi as ca
import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.rotation import rotation_from_vector, turn_between


def fitted_frame(nodes: ca.SX, cosines: ca.SX, sines: ca.SX) -> ca.SX:
    """Return the rotation (3, 3) that fits the reference polygon with the given polar angles best to (3, K) `nodes`.

    z is the unit area vector; x is the closed solution of the two-dimensional orthogonal Procrustes problem in the
    plane normal to it. No node is preferred: otherwise a change of the triangle's shape would count as roll.
    """
    count = nodes.shape[1]
    centred = nodes - ca.repmat(ca.sum2(nodes) / count, 1, count)
    area, x = ca.SX.zeros(3), ca.SX.zeros(3)
    for j in range(count):
        area += ca.cross(centred[:, j], centred[:, (j + 1) % count])
    z = area / ca.norm_2(area)
    for j in range(count):
        x += cosines[j] * centred[:, j] + sines[j] * ca.cross(centred[:, j], z)
    x -= z * ca.dot(z, x)
    x *= 1.0 / ca.norm_2(x)
    return ca.horzcat(x, ca.cross(z, x), z)


def turning(fitted: ca.SX, nodes: ca.SX, axes: ca.SX) -> ca.SX:
    """Return (R, 3K) the components along `axes` (R, 3) of a fitted frame's angular velocity, by those of its nodes.

    Half the sum of r x dr over the frame's axes r, by one reverse sweep for each row.
    """
    across = [-ca.skew(fitted[:, c]) @ axes.T / 2 for c in range(3)]
    return ca.jtimes(ca.vec(fitted), ca.vec(nodes), ca.vertcat(*across), True).T


def frames_along(points: Array) -> Array:
    """Return (F, 3, 3) frames at `points` (F, 3) of a polyline; the first is the identity.

    Each z-axis points from the previous point to its own; the least rotation leads from one frame to the
    next. A point in the place of the previous one has that point's frame.
    """
    frames = [np.eye(3)]
    for before, after in pairwise(points):
        way, length = after - before, float(np.linalg.norm(after - before))
        turn = turn_between(frames[-1][:, 2], way / length) if length > 0.0 else np.zeros(3)
        frames.append(rotation_from_vector(turn) @ frames[-1])
    return np.stack(frames)


def _polygon(count: int) -> tuple[ca.SX, list[ca.SX], ca.SX, ca.SX]:
    """Return symbols: K nodes (3, K), cosines and sines of polar angles, the rotation fitted to them, an alignment."""
    nodes, angles = ca.SX.sym("nodes", 3, count), [ca.SX.sym(name, count) for name in ("cosines", "sines")]
    return nodes, angles, fitted_frame(nodes, *angles), ca.SX.sym("alignment", 3, 3)


@cache
def rotation_function(count: int) -> ca.Function:
    """Return (nodes (3, K), cosines, sines, alignment) -> rotation R (3, 3)."""
    nodes, angles, fitted, alignment = _polygon(count)
    return ca.Function("rotation", [nodes, *angles, alignment], [fitted @ alignment])


@cache
def frame_function(count: int) -> ca.Function:
    """Return (nodes (3, K), cosines, sines, alignment) -> rotation R (3, 3) and spin S (3, 3K), dR = [S d nodes]x R."""
    nodes, angles, fitted, alignment = _polygon(count)
    spin = turning(fitted, nodes, ca.SX.eye(3))
    return ca.Function("frame", [nodes, *angles, alignment], [fitted @ alignment, ca.densify(spin)])


def frame_constants(home: Array, rotations: Array) -> tuple[Array, Array, Array]:
    """Return the constants of F frames of :func:`frame_function` which have the `rotations` (F, 3, 3) at home.

    Cosines and sines (F, K) of the polar angles of the nodes at `home` (F, K, 3), and the alignments (F, 3, 3).
    """
    centred = home - home.mean(axis=1, keepdims=True)
    normal = np.cross(centred, np.roll(centred, -1, axis=1)).sum(axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    x = rotations[:, :, 0]
    first = x - normal * np.sum(normal * x, axis=1, keepdims=True)
    first = np.where(np.linalg.norm(first, axis=1, keepdims=True) < 1e-6, centred[:, 0], first)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    axes = np.stack([first, np.cross(normal, first), normal], axis=1)
    angles = np.arctan2(*(np.einsum("fkc,fc->fk", centred, axes[:, axis]) for axis in (1, 0)))
    return np.cos(angles), np.sin(angles), axes @ rotations


def frame_tables(home: Array, rotations: Array) -> tuple[Array, Array, Array]:
    """Return :func:`frame_constants` as rows: cosines and sines (F, K), and the alignments' columns (3 F, 3)."""
    cosines, sines, alignments = frame_constants(home, rotations)
    return cosines, sines, alignments.transpose(0, 2, 1).reshape(-1, 3)


def frame_spins(X: Array, home: Array, rotations: Array, nodes: Index) -> Array:
    """Return the spins (F, 3, 3K) of F frames of nodes (F, K), with `rotations` (F, 3, 3) at `home`; nodes (N, 3)."""
    function = frame_function(nodes.shape[1]).map(len(nodes))
    tables = (table.T for table in frame_tables(home[nodes], rotations))
    _, spins = function(X[nodes].reshape(-1, 3).T, *tables)
    return np.asarray(spins).reshape(3, len(nodes), -1).transpose(1, 0, 2)
