"""Rotations, and the base's poses by the problem, for checks without the code that moved the arm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vgtm_qp.arrays import Array


def rotations(vectors: Array) -> Array:
    """Return (P, 3, 3) the rotations by |v| about each of the vectors (P, 3), rad."""
    angle = np.linalg.norm(vectors, axis=-1)[:, None, None]
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)
    # sinc is sin(pi x) / (pi x).
    return np.asarray(
        np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (cross @ cross)
    )


def rotation_matrix(vector: Array) -> Array:
    """Return (3, 3) the rotation by |vector| rad about `vector` (3,)."""
    return np.asarray(rotations(vector[None])[0])


def arm_table(problem: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the table of a problem, as JSON data, that describes its arm; empty if it has none."""
    return problem.get("truss") or problem.get("arm") or {}


def base_poses(problem: Mapping[str, Any], times: Array) -> Array:
    """Return (T, 6) position, m, and rotation vector, rad, of the base relative to home at `times` (T,), s.

    From its home pose at time 0 on, a moving base goes from pose to pose on straight lines and single-axis
    rotations. It stays in the last pose.
    """
    poses = arm_table(problem).get("base_motion") or ()
    found = np.zeros((len(times), 6))
    if not poses:
        return found
    from scipy.spatial.transform import Rotation

    still = (0.0, 0.0, 0.0)
    shift = np.array([still, *(pose.get("position") or still for pose in poses)], dtype=float)
    turn = Rotation.from_rotvec([still, *(pose.get("rotation_vector") or still for pose in poses)])
    knots = np.array([0.0, *(float(pose["time"]) for pose in poses)])
    k = np.clip(np.searchsorted(knots, times, side="right") - 1, 0, len(knots) - 2)
    share = np.clip((times - knots[k]) / (knots[k + 1] - knots[k]), 0.0, 1.0)[:, None]
    found[:, :3] = (1.0 - share) * shift[k] + share * shift[k + 1]
    between = (turn[k + 1] * turn[k].inv()).as_rotvec()
    vector = np.zeros(3)
    for row, turned in enumerate((Rotation.from_rotvec(share * between) * turn[k]).as_rotvec()):
        found[row, 3:] = vector = _continued(turned, vector)
    return found


def _continued(vector: Array, before: Array) -> Array:
    """Return the rotation vector (3,), rad, of the same rotation that continues the one `before` (3,)."""
    axis = vector if np.any(vector) else before
    if not np.any(axis):
        return vector
    axis = axis / np.linalg.norm(axis)
    return np.asarray(vector + 2.0 * np.pi * np.round(axis @ (before - vector) / (2.0 * np.pi)) * axis)
