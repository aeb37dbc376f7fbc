"""Paths of the end effector and of the base: poses joined by straight lines and single-axis rotations."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vgtm_qp.arm.arm import Pose
from vgtm_qp.arrays import Array
from vgtm_qp.errors import GoalError
from vgtm_qp.rotation import rotation_from_vector, vector_from_rotation
from vgtm_qp.rows.tip import TipGoal

_NOT_FINITE = "a goal must be made of finite numbers; the state of the arm is unchanged"

_ROUNDING = 1e-12
"""Share of a piece by which a value beyond its end is still that of the end."""

_UNIT, _AT_REST = np.array([0.0, 1.0]), np.zeros((1, 3))


@dataclass(frozen=True, eq=False)
class Path:
    """Poses at increasing values of the path variable, joined by straight lines and single-axis rotations.

    Attributes
    ----------
    knots : (W,)
        Values of the path variable, s.
    positions : (W, 3)
    rotations : (W, 3, 3)
    """

    knots: Array
    positions: Array
    rotations: Array
    _knots: list[float] = field(init=False, repr=False)
    _turned: list[bool] = field(init=False, repr=False)
    _velocity: Array = field(init=False, repr=False)
    _spin: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        knots, positions, rotations = self.knots, self.positions, self.rotations
        # One entry that is not finite makes the sum not finite.
        if not math.isfinite(knots.sum() + positions.sum() + rotations.sum()):
            raise GoalError(_NOT_FINITE)
        widths = (knots[1:] - knots[:-1])[:, None]
        if not (widths > 0.0).all():
            raise GoalError("the times of a path must increase strictly")
        turned = (rotations[1:] != rotations[:-1]).any(axis=(1, 2)).tolist()
        spin = np.zeros((len(widths), 3))
        for k, turns in enumerate(turned):
            if turns:
                spin[k] = vector_from_rotation(rotations[k + 1] @ rotations[k].T) / widths[k]
        object.__setattr__(self, "_knots", knots.tolist())
        object.__setattr__(self, "_turned", turned)
        object.__setattr__(self, "_velocity", (positions[1:] - positions[:-1]) / widths)
        object.__setattr__(self, "_spin", spin)

    @classmethod
    def straight(cls, position: Array, rotation: Array, to: Array, turned: Array, spin: Array | None) -> Path:
        """Return the path from 0 to 1 from a pose, (3,) and (3, 3), to another; it turns by `spin` (3,), rad, or not.

        Raises
        ------
        GoalError
            A number of a position is not finite.
        """
        # A control loop makes one for each step, so the general way would cost as much as the step's rows.
        path, velocity = object.__new__(cls), to - position
        if not math.isfinite(sum(velocity.tolist())):
            raise GoalError(_NOT_FINITE)
        path.__dict__.update(
            knots=_UNIT,
            positions=np.array([position, to]),
            rotations=np.array([rotation, turned]),
            _knots=[0.0, 1.0],
            _turned=[spin is not None],
            _velocity=velocity[None],
            _spin=_AT_REST if spin is None else spin[None],
        )
        return path

    @property
    def start(self) -> float:
        """First value of the path variable, s."""
        return float(self.knots[0])

    @property
    def end(self) -> float:
        """Last value of the path variable, s."""
        return float(self.knots[-1])

    def at(self, value: float) -> TipGoal:
        """Return pose and rate at `value`; at a knot, the rate of the next piece."""
        knots = self._knots
        k = min(max(bisect_right(knots, value) - 1, 0), len(knots) - 2)
        along = min(max(value, knots[k]), knots[k + 1]) - knots[k]
        if along == 0.0:
            return TipGoal(self.positions[k], self.rotations[k], self._velocity[k], self._spin[k])
        rotation = self.rotations[k]
        if self._turned[k]:
            rotation = rotation_from_vector(along * self._spin[k]) @ rotation
        if along == knots[k + 1] - knots[k]:
            position = self.positions[k + 1]
        else:
            position = self.positions[k] + along * self._velocity[k]
        return TipGoal(position, rotation, self._velocity[k], self._spin[k])

    def pose(self, value: float) -> Pose:
        """Return the pose at `value`; for the path of a base `value` is the time, s."""
        point = self.at(value)
        return Pose(point.position, point.rotation)

    def is_straight(self, start: float, end: float) -> bool:
        """Whether the rates at `start`, see :meth:`at`, lead along the path all the way to `end`."""
        knots = self._knots
        k = min(max(bisect_right(knots, start) - 1, 0), len(knots) - 2)
        low, high = knots[k], knots[k + 1]
        spare = _ROUNDING * (high - low)
        # A comparison with NaN fails.
        return low - spare <= start <= high + spare and low - spare <= end <= high + spare

    def continued(self, pieces: float) -> Path:
        """Return the path extended by `pieces` times its last piece, but by less than half a turn."""
        width, turn = float(self.knots[-1] - self.knots[-2]), self._spin[-1]
        angle = width * float(np.linalg.norm(turn))
        on = width * min(pieces, 3.0 / angle if angle > 0.0 else np.inf)
        return Path(
            np.append(self.knots, self.knots[-1] + on),
            np.vstack([self.positions, self.positions[-1] + on * self._velocity[-1]]),
            np.concatenate([self.rotations, (rotation_from_vector(on * turn) @ self.rotations[-1])[None]]),
        )


def base_motion(poses: Sequence[Any]) -> Path:
    """Return the path of the base frame over time, s, through ``[[base_motion]]`` tables in the order of their times.

    The base is in its home pose at time 0 and stays in the last pose that it reaches.
    """
    return Path(
        np.array([0.0, *(pose.time for pose in poses)]),
        np.array([np.zeros(3), *(pose.position for pose in poses)], dtype=float),
        np.stack([np.eye(3), *(rotation_from_vector(pose.rotation_vector) for pose in poses)]),
    )
