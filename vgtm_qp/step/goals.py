"""From what a control loop asks for to the piece of path that a step follows."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vgtm_qp.errors import GoalError
from vgtm_qp.rotation import rotation_from_vector, turn_between
from vgtm_qp.step.path import Path
from vgtm_qp.step.task import TipTask

Array = NDArray[np.float64]

_UNCHANGED = "the state of the arm is unchanged"

_SHORTEST, _LONGEST = 1e-8, 1e8
"""Durations of a step, s: shorter ones are lost in the rounding of the time and of the rates."""


def path_to(
    task: TipTask,
    tip: tuple[Array, Array],
    position: ArrayLike | None,
    pointing: ArrayLike | None,
    rotation_vector: ArrayLike | None,
) -> Path:
    """Return the straight way from the tip's pose, (3,) and (3, 3), to a goal.

    Raises
    ------
    GoalError
        The goal is not three finite numbers, or is for coordinates that no row of the QP steers, or two for one.
    """
    served = {
        "position": (position, bool(len(task.axes))),
        "pointing": (pointing, bool(task.turns)),
        "rotation_vector": (rotation_vector, bool(task.turns)),
    }
    for name, (value, is_tracked) in served.items():
        if value is not None and not is_tracked:
            raise GoalError(f"{name} is not tracked, only {', '.join(task.track)}; {_UNCHANGED}")
    if pointing is not None and rotation_vector is not None:
        raise GoalError(f"give pointing or rotation_vector, not both; {_UNCHANGED}")
    here, rotation = tip
    there = here if position is None else vector(position, "position")
    turned = rotation
    if pointing is not None:
        wanted = vector(pointing, "pointing")
        norm = float(np.linalg.norm(wanted))
        if norm < 1e-9:
            raise GoalError(f"pointing must not be the zero vector; {_UNCHANGED}")
        turned = rotation_from_vector(turn_between(rotation[:, 2], wanted / norm)) @ rotation
    elif rotation_vector is not None:
        turned = rotation_from_vector(vector(rotation_vector, "rotation_vector"))
    return Path(np.array([0.0, 1.0]), np.stack([here, there]), np.stack([rotation, turned]))


def duration(dt: float) -> float:
    """Return a step's duration, s; raise GoalError where it is not a positive number."""
    try:
        seconds = float(dt)
    except (TypeError, ValueError):
        seconds = math.nan
    if not _SHORTEST <= seconds <= _LONGEST:
        raise GoalError(
            f"dt must be a positive number of seconds, from {_SHORTEST:g} to {_LONGEST:g}, not {dt!r}; {_UNCHANGED}"
        )
    return seconds


def vector(value: ArrayLike, name: str) -> Array:
    """Return three finite numbers; raise GoalError where they are not."""
    try:
        numbers = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.shape != (3,) or not np.all(np.isfinite(numbers)):
        raise GoalError(f"{name} must be three finite numbers, not {value!r}; {_UNCHANGED}")
    return numbers
