"""Rotations as matrices and as rotation vectors."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.arrays import Array


def rotation_from_vector(vector: ArrayLike) -> Array:
    """Return the (3, 3) rotation by |vector| about `vector` (3,), rad (Rodrigues)."""
    v = np.asarray(vector, dtype=float)
    angle = float(np.linalg.norm(v))
    if angle < 1e-12:
        return np.eye(3) + _cross_matrix(v)
    axis = _cross_matrix(v / angle)
    return np.asarray(np.eye(3) + np.sin(angle) * axis + (1.0 - np.cos(angle)) * axis @ axis)


def quaternion(rotation: Array) -> Array:
    """Return the quaternions w, x, y, z (..., 4) of rotations (..., 3, 3), one or a row of them."""
    from scipy.spatial.transform import Rotation

    return np.asarray(np.roll(Rotation.from_matrix(rotation).as_quat(), 1, axis=-1))


def vector_from_rotation(rotation: Array) -> Array:
    """Return the rotation vector (3,), rad, of a (3, 3) rotation; accurate up to half a turn inclusive."""
    twist = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sine, cosine = float(np.linalg.norm(twist)) / 2, (float(np.trace(rotation)) - 1) / 2
    angle = float(np.arctan2(sine, cosine))
    if sine > 1e-7:
        return np.asarray(twist * (angle / (2 * sine)))
    if cosine > 0:
        return np.asarray(twist / 2)
    outer = (rotation + np.eye(3)) / 2
    axis = outer[:, int(np.argmax(np.diag(outer)))]
    return np.asarray(angle * axis / np.linalg.norm(axis))


def vector_near(rotation: Array, near: Array) -> Array:
    """Return the rotation vector (3,), rad, of a (3, 3) rotation that is nearest to the vector `near` (3,).

    So the vector of a continuing rotation does not jump at half a turn.
    """
    vector = vector_from_rotation(rotation)
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 1e-9 else near / max(float(np.linalg.norm(near)), 1e-9)
    return np.asarray(vector + 2.0 * np.pi * np.round((near - vector) @ axis / (2.0 * np.pi)) * axis)


def turn_between(start: Array, end: Array) -> Array:
    """Return the least rotation vector (3,), rad, that takes unit vector `start` to unit vector `end`."""
    axis = _cross_matrix(start) @ end
    sine = float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, float(start @ end)))
    if sine > 1e-12:
        return np.asarray(axis * (angle / sine))
    if angle < 1.0:
        return np.asarray(axis)
    across = np.eye(3)[int(np.argmin(np.abs(start)))]
    axis = np.cross(start, across)
    return np.asarray(angle * axis / np.linalg.norm(axis))


def _cross_matrix(v: Array) -> Array:
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
