"""Braking: how an arm with limited accelerations comes to rest on its path, proven before each step is taken.

A moving arm with limited accelerations cannot stay where it is. It is let into a state only if steps are known that
bring it from there to rest, each within the limits and clear, so that what lies ahead can never trap it: where no
other step is found the arm takes the first of those.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.step.attempt import Attempt
from vgtm_qp.step.linearise import Target
from vgtm_qp.step.path import Path
from vgtm_qp.step.state import State

Array = NDArray[np.float64]
Box = tuple[Array, Array]

_MOST_STEPS = 60
_SPARE_STEPS = 4
"""Steps that braking may take, at most, and beyond those that the fastest actuator needs by itself."""


@dataclass(frozen=True, eq=False)
class Braking:
    """Steps that bring an arm to rest from `origin` along `path`: states, and the path's values there."""

    origin: State
    path: Path
    steps: list[tuple[State, float]] = field(default_factory=list)

    @property
    def rest(self) -> Braking:
        """What is left after the first step."""
        return Braking(self.steps[0][0], self.path, self.steps[1:])


def find_braking(
    attempt: Attempt,
    actuators: NDArray[np.int64],
    state: State,
    path: Path,
    value: float,
    piece: float,
    box: Callable[[State], Box],
    target: Callable[[State, Path, float, float, Box], Target],
) -> Braking | None:
    """Return the steps that bring an arm from `state` to where it may stay, or None where they were not found.

    The tip stays on `path`, at most by `piece` beyond its `value` in each step. The steps aim at where the tip is, from
    further along the path: progress along it is what they avoid.

    Parameters
    ----------
    box
        Least and greatest lengths of the actuators, m, after a step from a state.
    target
        What a step is asked for: from a state along a path, from one of its values to another, within a box.
    """
    origin, found = state, list[tuple[State, float]]()
    most = _MOST_STEPS
    for count in range(_MOST_STEPS):
        limits = box(state)
        lengths = state.lengths[actuators]
        beyond = np.maximum(limits[0] - lengths, lengths - limits[1])
        if not beyond.max() > 0.0:
            return Braking(origin, path, found)
        if not count:
            # Each step takes as much off the fastest actuator as its box is wide on either side of its middle.
            speed = np.abs(0.5 * (limits[0] + limits[1]) - lengths)
            width = np.maximum(0.5 * (limits[1] - limits[0]), 1e-12)
            most = min(_MOST_STEPS, int(np.ceil((speed / width).max())) + _SPARE_STEPS)
        if count >= most:
            return None
        ahead = min(value + piece, path.end)
        outcome = attempt.run(state, target(state, path, ahead, value, limits), progress=1.0)
        if not outcome.accepted:
            return None
        value = ahead + outcome.progress * (value - ahead)
        state = outcome.state_after(state)
        found.append((state, value))
    return None
