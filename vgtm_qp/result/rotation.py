"""Rotations from rotation vectors, for what is checked without the code that moved the arm."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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


def continued(vector: Array, before: Array) -> Array:
    """Return of all rotation vectors (3,) of a rotation, rad, the one that continues the one `before` (3,)."""
    axis = vector if np.any(vector) else before
    if not np.any(axis):
        return vector
    axis = axis / np.linalg.norm(axis)
    return np.asarray(vector + 2.0 * np.pi * np.round(axis @ (before - vector) / (2.0 * np.pi)) * axis)
