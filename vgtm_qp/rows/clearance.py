"""Rows that keep a clearance: the distance of a near pair, linearised at its witness points."""

from __future__ import annotations

import numpy as np

from vgtm_qp.arrays import Array, Mask


def clearance_rows(
    distance: Array,
    normal: Array,
    weights: Array,
    is_self: Mask,
    safe: float,
    self_safe: float,
    *,
    margin: float = 0.0,
    fraction: float = 1.0,
) -> tuple[Array, Array]:
    """Return coefficients (R, 4, 3) and lower bounds (R,), m, of the rows of R contacts.

    Row r is ``sum_k coefficients[r, k] . d x_k >= lower[r]`` over the displacements d x_k of the contact's four
    points, m: the gradient of the distance on the left, the missing clearance on the right.

    Parameters
    ----------
    distance : (R,)
        From surface to surface, m.
    normal : (R, 3)
        Unit, from the obstacle or other body to the body.
    weights : (R, 4)
        Of the velocities of the four points in the velocity of the body's witness point relative to the
        other's.
    is_self : (R,) bool
        Whether `self_safe` is to be kept instead of `safe`.
    safe, self_safe, margin : float
        Distance to keep from obstacles and between bodies, and a margin added to both, m.
    fraction : float
        Place of the contacts on the straight path to the end of the step: a displacement of the end state
        moves the arm there by this share of it.
    """
    pull = normal if fraction == 1.0 else fraction * normal
    coefficients = weights[:, :, None] * pull[:, None, :]
    lower = safe + margin - distance
    lower += (self_safe - safe) * is_self
    return coefficients, lower


def slowed(lower: Array, share: float, least: float) -> Array:
    """Return lower bounds (R,), m, with which a pair uses no more than a `share` of its remaining clearance in a step.

    An approach of `least`, m, is allowed as far as `lower` allows it.
    """
    return np.asarray(np.maximum(lower, np.minimum(share * lower, -least)))
