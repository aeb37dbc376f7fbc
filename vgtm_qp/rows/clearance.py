"""Rows that keep a clearance: the distance of a near pair, linearised at its witness points."""

from __future__ import annotations

from typing import Any

import casadi as ca
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


def allowed(missing: Any, most: Any, nearer: Any, share: Any, least: Any, *, of: Any = np) -> Any:
    """Return lower bounds, m, of how a step that moves the arm parts pairs: of arrays, or of symbols with `of` CasADi.

    They ask for the `missing` clearance, but for no more than `most`, and for the way that an obstacle comes `nearer`
    in the step. A pair uses no more than a `share` of the clearance that then remains, or `least` if that is more and
    as far as it remains.
    """
    lower = of.fmin(missing, most) + nearer
    return of.fmax(lower, of.fmin(share * lower, -least))


def allowed_function() -> ca.Function:
    """Return the function (missing, most, nearer, share, least) of one pair, see :func:`allowed`."""
    arguments = [ca.SX.sym(name) for name in ("missing", "most", "nearer", "share", "least")]
    return ca.Function("allowed", arguments, [allowed(*arguments, of=ca)])
