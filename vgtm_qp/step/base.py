"""A base that moves as it is told, eqs. (7)-(8): its pose, and where its nodes are, as functions of time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.problem.truss import BasePose
from vgtm_qp.step.path import Path, rotation_from_vector

Array = NDArray[np.float64]


class BaseMotion:
    """Poses of the base frame over time, joined by straight lines and single-axis rotations.

    The base is in its home pose at time 0 and stays in the last pose that it reaches.

    Parameters
    ----------
    poses : sequence of BasePose
        At least one, in the order of time.
    truss : Truss
        Whose base nodes move.
    """

    def __init__(self, poses: Sequence[BasePose], truss: Truss) -> None:
        self._path = Path(
            np.array([0.0, *(pose.time for pose in poses)]),
            np.array([np.zeros(3), *(pose.position for pose in poses)], dtype=float),
            np.stack([np.eye(3), *(rotation_from_vector(pose.rotation_vector) for pose in poses)]),
        )
        self._home = truss.home

    @property
    def end(self) -> float:
        """Time from which the base rests, s."""
        return self._path.end

    def rotation(self, time: float) -> Array:
        """Return (3, 3) the rotation of the base frame at `time`, s."""
        return self._path.at(time).rotation

    def nodes(self, time: float) -> Array:
        """Return (N, 3) home positions moved with the base to its pose at `time`, s: rho_c where nodes are given, m."""
        pose = self._path.at(time)
        return np.asarray(self._home @ pose.rotation.T + pose.position)

    def carried(self, points: Array, before: float, after: float) -> Array:
        """Return where `points` (K, 3), m, are at the time `after`, s, if they move with the base from `before` on."""
        was, now = self._path.at(before), self._path.at(after)
        return np.asarray((points - was.position) @ (now.rotation @ was.rotation.T).T + now.position)
