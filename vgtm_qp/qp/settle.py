"""The small correction after a step's QP: the tip returns to its path without another QP.

The QP was linearised at the predicted middle of the step, so that the remaining tip error is of third order. Newton
iterations with a constant Jacobian remove it: the least motion of the nodes, in the QP's metric, that moves the tip by
the error while actuators at a bound stay there. Clearance rows can be left out: their margin exceeds the motion.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv, dposv

from vgtm_qp.arrays import Array

WORST_CONDITION = 1e8
SETTLING_STEPS = 6
SETTLED = 1e-11
"""Tip error below which settling stops, m or rad."""

LEFT = 1e-8
"""Remaining path of the tip, m or rad, that counts as zero."""

AT_BOUND = 1e-6
"""Distance from a bound below which an actuator counts as held there, m."""


def held(displacement: Array, lower: Array, upper: Array) -> NDArray[np.bool_]:
    """Return which actuators (n_a,) a QP left at a bound, by their position: multipliers may vanish there."""
    return np.asarray((displacement < lower + AT_BOUND) | (displacement > upper - AT_BOUND))


def settling_gain(
    response: Array, tip: Array, free: NDArray[np.bool_], node_rate: float, actuator_rate: float
) -> Array | None:
    """Return the actuator displacements (n_a, n_e) per unit of tip error; None where too few actuators are free.

    Parameters
    ----------
    response : (3 (N - N_c), n_a)
        Node displacements per actuator displacement.
    tip : (n_e, n_a)
        The tip's rows.
    free : (n_a,)
        Actuators that may move.
    node_rate, actuator_rate : float
        The QP's weights on node and actuator displacements.
    """
    if np.count_nonzero(free) < len(tip):
        return None
    moving, rows = response[:, free], tip[:, free]
    hessian = node_rate * (moving.T @ moving)
    hessian.flat[:: len(hessian) + 1] += actuator_rate
    _, answer, failed = dposv(hessian, rows.T)
    if failed:
        return None
    normal = rows @ answer
    _, _, shares, failed = dgesv(normal, np.eye(len(tip)))
    if failed or not np.abs(shares).max() * np.abs(normal).max() < WORST_CONDITION:
        return None
    gain = np.zeros((len(free), len(tip)))
    gain[free] = answer @ shares
    return gain
