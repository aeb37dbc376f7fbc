"""The wanted motion of the end effector: poses joined by straight lines and single-axis rotations."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vgtm_qp.errors import GoalError

Array = NDArray[np.float64]


def rotation_from_vector(vector: ArrayLike) -> Array:
    """Return the (3, 3) rotation by |vector| about `vector` (3,), rad (Rodrigues)."""
    v = np.asarray(vector, dtype=float)
    angle = float(np.linalg.norm(v))
    if angle < 1e-12:
        return np.eye(3) + _cross_matrix(v)
    axis = _cross_matrix(v / angle)
    return np.asarray(np.eye(3) + np.sin(angle) * axis + (1.0 - np.cos(angle)) * axis @ axis)


def vector_from_rotation(rotation: Array) -> Array:
    """Return the rotation vector (3,), rad, of a (3, 3) rotation; right up to and at half a turn."""
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


def turn_between(start: Array, end: Array) -> Array:
    """Return the rotation vector (3,), rad, that takes unit vector `start` to unit vector `end` the short way."""
    axis = np.cross(start, end)
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
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@dataclass(frozen=True, eq=False)
class PathPoint:
    """A pose on a path and its rate with the path variable.

    Attributes
    ----------
    position, velocity : (3,)
        m, and m per unit of the path variable.
    rotation : (3, 3)
    spin : (3,)
        Angular velocity in the base frame, rad per unit of the path variable.
    """

    position: Array
    rotation: Array
    velocity: Array
    spin: Array


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
        numbers = np.concatenate([np.ravel(self.knots), np.ravel(self.positions), np.ravel(self.rotations)])
        if not np.all(np.isfinite(numbers)):
            raise GoalError("a goal must be made of finite numbers; the state of the arm is unchanged")
        if np.any(np.diff(self.knots) <= 0):
            raise GoalError("the times of a path must increase strictly")
        turns = [vector_from_rotation(b @ a.T) for a, b in pairwise(self.rotations)]
        widths = np.diff(self.knots)[:, None]
        object.__setattr__(self, "_knots", self.knots.tolist())
        object.__setattr__(self, "_turned", [bool(np.any(turn)) for turn in turns])
        object.__setattr__(self, "_velocity", np.diff(self.positions, axis=0) / widths)
        object.__setattr__(self, "_spin", np.stack(turns) / widths)

    @property
    def start(self) -> float:
        """First value of the path variable, s."""
        return float(self.knots[0])

    @property
    def end(self) -> float:
        """Last value of the path variable, s."""
        return float(self.knots[-1])

    def at(self, value: float) -> PathPoint:
        """Return pose and rate at `value`; the rate is that of the piece which follows."""
        knots = self._knots
        k = min(max(bisect_right(knots, value) - 1, 0), len(knots) - 2)
        along = min(max(value, knots[k]), knots[k + 1]) - knots[k]
        rotation = self.rotations[k]
        if self._turned[k]:
            rotation = rotation_from_vector(along * self._spin[k]) @ rotation
        if along == knots[k + 1] - knots[k]:
            position = self.positions[k + 1]
        else:
            position = self.positions[k] + along * self._velocity[k]
        return PathPoint(position, rotation, self._velocity[k], self._spin[k])

    def is_straight(self, start: float, end: float) -> bool:
        """Whether the rates are the same all the way between two values."""
        low, high = (start, end) if start < end else (end, start)
        return bisect_right(self._knots, low) >= bisect_left(self._knots, high)

    def continued(self, pieces: float) -> Path:
        """Return the path that goes on as it ends, for so many times its last piece, but for less than half a turn."""
        width, turn = float(self.knots[-1] - self.knots[-2]), self._spin[-1]
        angle = width * float(np.linalg.norm(turn))
        on = width * min(pieces, 3.0 / angle if angle > 0.0 else np.inf)
        return Path(
            np.append(self.knots, self.knots[-1] + on),
            np.vstack([self.positions, self.positions[-1] + on * self._velocity[-1]]),
            np.concatenate([self.rotations, (rotation_from_vector(on * turn) @ self.rotations[-1])[None]]),
        )

    def length(self) -> float:
        """Return the length of the path of the position, m."""
        return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())
