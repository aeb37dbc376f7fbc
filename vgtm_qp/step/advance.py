"""How far a step gets: pieces of path are halved until one is accepted, and after which a moving arm can brake."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.step.actuation import Actuation, Box
from vgtm_qp.step.attempt import Attempt, Outcome
from vgtm_qp.step.braking import Brakes, Braking
from vgtm_qp.step.path import Path
from vgtm_qp.step.state import State
from vgtm_qp.step.stops import CANNOT_BRAKE
from vgtm_qp.step.target import Target

Array = NDArray[np.float64]

_TRUST = 0.2
"""An actuator moves by no more than this times the share of the step that is tried, m, where the whole one failed."""

_BEYOND = 60.0
"""An arm that is at the end of its path may brake beyond it, within so many times its last piece."""

_INSTANT = 1e-9

_OFF_PATH = "the arm could brake after it only off its path"

ANY_RANK = 2
"""The rank of braking in any way at all."""


class Piece(NamedTuple):
    """A piece of path, from its value `start` to `end`, in `dt` seconds; no share below `smallest` is tried."""

    path: Path
    start: float
    end: float
    dt: float
    smallest: float


class Advance(NamedTuple):
    """The share of a piece that was tried, what came of it, and how the arm brakes afterwards if it must."""

    share: float
    outcome: Outcome
    braking: Braking | None


class Advancer:
    """Finds the step that an arm takes along a piece of path.

    Parameters
    ----------
    attempt, actuation
        Of one arm.
    brakes
        From a duration, s, to how the arm brakes in steps of that.
    target
        From a state, `dt`, path, start, end and box to the target of a step.
    tip_mode
        How strictly the tip follows its path: ``scaled``, ``hard`` or ``elastic``.
    """

    def __init__(
        self,
        attempt: Attempt,
        actuation: Actuation,
        brakes: Callable[[float], Brakes],
        target: Callable[[State, float, Path, float, float, Box], Target],
        tip_mode: str,
    ) -> None:
        self._attempt, self._actuation, self._brakes = attempt, actuation, brakes
        self._target, self._tip_mode = target, tip_mode

    def first_accepted(self, state: State, piece: Piece, box: Box, worst: int = ANY_RANK) -> Advance:
        """Return the first attempt at a piece of path or a share of it that is accepted, or else the last.

        An attempt after which the arm brakes in a better way comes before others, and one of a rank beyond the `worst`,
        as good as the arm could brake now, does not count.
        """
        best: Advance | None = None
        for found in self._attempts(state, piece, box):
            rank = 0 if found.braking is None else found.braking.rank
            if found.outcome.accepted and rank <= worst:
                best, worst = found, rank - 1
                if not rank:
                    break
        if best is not None:
            return best
        refused = replace(found.outcome, accepted=False, reason=found.outcome.reason or _OFF_PATH)
        return Advance(found.share, refused, None)

    def _attempts(self, state: State, piece: Piece, box: Box) -> Iterator[Advance]:
        """Yield the attempts at a piece: the whole, halves of it where the tip may be slow, and creeping."""
        share, values = 1.0, self._actuation.values(state)
        yield self._try(state, piece, box)
        while share > piece.smallest and self._tip_mode == "scaled":
            share /= 2
            near = _within(values, share * _TRUST, *box)
            end = piece.start + share * (piece.end - piece.start)
            yield self._try(state, piece._replace(end=end), near, share)
        if not self._actuation.starts_at_once:
            slow = self._actuation.creeping(state, box, piece.dt)
            if slow is not None:
                yield self._try(state, piece, slow)

    def _try(self, state: State, piece: Piece, box: Box, share: float = 1.0) -> Advance:
        """Return what comes of a step over a piece, a `share` of the one that was asked for."""
        path, start, reach, dt, _ = piece
        braking: Braking | None = None
        outcome = self._attempt.run(state, self._target(state, dt, path, start, reach, box), share)
        if outcome.accepted and outcome.progress < 1.0 - 1e-9 and self._tip_mode != "scaled":
            # The tip stays on time: no part of the path will do.
            outcome = replace(outcome, accepted=False, reason="the tip cannot stay on time")
        if outcome.accepted and not self._actuation.starts_at_once:
            covered = outcome.progress * (reach - start)
            if start + covered >= path.end - _INSTANT:
                # The path beyond its end is unknown.
                path = path.continued(_BEYOND)
            after = outcome.state_after(self._attempt.arm, state)
            braking = self._brakes(dt).find(after, path, start + covered, 2.0 * covered)
            if braking is None:
                # A step may be too short to rest in what the longer one before it allowed.
                shorter = dt < (1.0 - 1e-9) * state.duration
                why = f"{CANNOT_BRAKE} in {dt:g} s, less than the last step took" if shorter else CANNOT_BRAKE
                outcome = replace(outcome, accepted=False, reason=why)
        return Advance(share, outcome, braking)


def _within(value: Array, trust: float, lower: Array, upper: Array) -> Box:
    """Return the part of the boxes (n_a,) that is no further than `trust` from the present values."""
    return np.minimum(np.maximum(lower, value - trust), upper), np.maximum(
        np.minimum(upper, value + trust), lower
    )
