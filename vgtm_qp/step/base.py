"""A base that moves as it is told, eqs. (7)-(8): its pose as a function of time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.arm.arm import Pose
from vgtm_qp.rotation import rotation_from_vector
from vgtm_qp.step.path import Path


class _TimedPose(Protocol):
    """One ``[[base_motion]]`` table."""

    @property
    def time(self) -> float: ...
    @property
    def position(self) -> ArrayLike: ...
    @property
    def rotation_vector(self) -> ArrayLike: ...


class BaseMotion:
    """Poses of the base frame over time, joined by straight lines and single-axis rotations.

    The base is in its home pose at time 0 and stays in the last pose that it reaches.

    Parameters
    ----------
    poses
        At least one, in the order of time.
    """

    def __init__(self, poses: Sequence[_TimedPose]) -> None:
        self._path = Path(
            np.array([0.0, *(pose.time for pose in poses)]),
            np.array([np.zeros(3), *(pose.position for pose in poses)], dtype=float),
            np.stack([np.eye(3), *(rotation_from_vector(pose.rotation_vector) for pose in poses)]),
        )

    @property
    def end(self) -> float:
        """Time from which the base rests, s."""
        return self._path.end

    def pose(self, time: float) -> Pose:
        """Return where the base is at `time`, s."""
        point = self._path.at(time)
        return Pose(point.position, point.rotation)
