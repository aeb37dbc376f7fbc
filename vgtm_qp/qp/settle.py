"""The small correction after a step's QP: the tip back onto its path without solving another one.

The QP was linearised at the guessed middle of the step, so what is left after it is of third order. It is removed by
Newton iterations whose Jacobian is kept: the least motion of the nodes, in the QP's metric, that moves the tip by the
error while active actuators and active clearances stay where the QP put them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv, dposv

Array = NDArray[np.float64]

MULTIPLIER = 1e-6
"""Rows and bounds whose multiplier is not greater than this count as inactive."""


def settling_gain(
    response: Array, tip: Array, active_rows: Array, free: NDArray[np.bool_], node_rate: float, actuator_rate: float
) -> Array | None:
    """Return the actuator displacements (n_a, n_e) per unit of tip error; None where the active rows leave none.

    Parameters
    ----------
    response : (3 (N - N_c), n_a)
        Node displacements per actuator displacement.
    tip : (n_e, n_a)
        The tip's rows.
    active_rows : (R, n_a)
        Rows that stay as they are.
    free : (n_a,)
        Actuators that may move.
    node_rate, actuator_rate : float
        The QP's weights on node and actuator displacements.
    """
    if np.count_nonzero(free) < len(tip) + len(active_rows):
        return None
    moving = response[:, free]
    hessian = node_rate * (moving.T @ moving)
    hessian.flat[:: len(hessian) + 1] += actuator_rate
    rows = np.concatenate((tip, active_rows))[:, free]
    _, answer, failed = dposv(hessian, rows.T)
    if failed:
        return None
    normal = rows @ answer
    wanted = np.zeros((len(rows), len(tip)))
    wanted.flat[:: len(tip) + 1] = 1.0
    _, _, shares, failed = dgesv(normal, wanted)
    if failed or not np.abs(shares).max() < 1e8 / (1e-300 + np.abs(normal).max()):
        return None
    gain = np.zeros((len(free), len(tip)))
    gain[free] = answer @ shares
    return gain
