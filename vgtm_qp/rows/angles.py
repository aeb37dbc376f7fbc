"""Rows that keep angles between bodies that meet at a joint."""

from __future__ import annotations

import numpy as np

from vgtm_qp.arrays import Array, Index

_LEAST_SINE = 1e-6
"""Least denominator of an angle's gradient, which is infinite for parallel bodies."""


def angles(first: Array, second: Array) -> Array:
    """Return the angles (K,), rad, between vectors (K, 3) and (K, 3)."""
    sine = np.linalg.norm(np.cross(first, second), axis=1)
    return np.asarray(np.arctan2(sine, np.einsum("kc,kc->k", first, second)))


def angle_gradients(angle: Array, first: Array, second: Array) -> Array:
    """Return the gradients (K, 3, 3) of angles (K,), rad, with respect to three points each, rad/m.

    The points are the common one, and those at the far ends of the vectors `first` and `second` (K, 3), m.
    """
    lengths = [np.linalg.norm(w, axis=1, keepdims=True) for w in (first, second)]
    u, v = first / lengths[0], second / lengths[1]
    sine, cosine = np.sin(angle)[:, None], np.cos(angle)[:, None]
    turn_u = -(v - cosine * u) / (lengths[0] * np.maximum(sine, _LEAST_SINE))
    turn_v = -(u - cosine * v) / (lengths[1] * np.maximum(sine, _LEAST_SINE))
    return np.stack([-turn_u - turn_v, turn_u, turn_v], axis=1)


def corners(joints: Index) -> Index:
    """Return (K, 2, 2) the pairs of bodies that meet at a joint: number and meeting end of each body.

    `joints` (B, 2) are the joints at the two ends of each body.
    """
    at: dict[int, list[tuple[int, int]]] = {}
    for body, ends in enumerate(joints.tolist()):
        for end, joint in enumerate(ends):
            at.setdefault(joint, []).append((body, end))
    found = [(a, b) for meeting in at.values() for k, a in enumerate(meeting) for b in meeting[k + 1 :]]
    return np.array(found, dtype=np.int64).reshape(-1, 2, 2)
