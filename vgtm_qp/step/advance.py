"""Pieces of path are halved until a step is accepted from which a moving arm can still brake."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vgtm_qp.step.actuation import INSTANT, Actuation, within
from vgtm_qp.step.attempt import FURTHER, Attempt, Tracking
from vgtm_qp.step.braking import ANY_RANK, Brakes, Braking
from vgtm_qp.step.setup import TOO_LONG
from vgtm_qp.step.shaping import Shaping
from vgtm_qp.step.state import State
from vgtm_qp.step.step import WHOLE, Step, StepStatus
from vgtm_qp.step.stops import CANNOT_BRAKE
from vgtm_qp.step.target import Target

SMALLEST = 1 / 64
"""Least share of a piece of path that an arm at rest tries."""

TRUST = 0.2
"""Greatest change of an actuator per share of the step, rad or a share of the arm's unit, after the whole step failed.
"""

_LONGER = 2.0
"""Greatest ratio of an actuator's change to the displacement of its nodes."""

_BEYOND = 60.0
"""Length of the continuation on which an arm at the end of its path may brake, over the path's last piece."""

_LEAST_HELD = 0.5
"""Least share of a piece of path for which stations that may leave the curve stay on it."""

_LEAST_CRAWL = 0.1
"""Share of a piece below which progress with stations on the curve does not count: next to a dead end the
last digits would decide where the arm goes.
"""

_OFF_PATH = "the arm could brake after it only off its path"


class Advance(NamedTuple):
    """The step over a piece of path, and the braking that follows it if the arm must brake."""

    step: Step
    braking: Braking | None

    @property
    def rank(self) -> int:
        """Rank of the braking; 0 if the arm need not brake."""
        return 0 if self.braking is None else self.braking.rank


class Advancer:
    """Finds an acceptable step along a piece of path."""

    def __init__(self, attempt: Attempt, actuation: Actuation, shaping: Shaping) -> None:
        self._attempt, self._actuation, self._shaping = attempt, actuation, shaping
        self._tip_mode, self._step_limit = shaping.setup.tip_mode, shaping.setup.step_limit
        self._arm = shaping.setup.arm
        self._may_be_usual = actuation.starts_at_once and not self._step_limit < np.inf

    def brakes(self, dt: float) -> Brakes:
        """Return how the arm brakes in steps of `dt`, s."""
        return Brakes(self._shaping, self._attempt, self._actuation, dt)

    def first_accepted(
        self, state: State, target: Target, dt: float, smallest: float, worst: int = ANY_RANK
    ) -> Advance:
        """Return the first accepted attempt at a target or at a share of its piece, or else the last attempt.

        Attempts with a lower rank of braking are preferred. Attempts with a rank above `worst`, the rank of
        braking at once, are refused. The step takes `dt`, s; shares below `smallest` are not tried.
        """
        best: Advance | None = None
        too_long, before = "", self._attempt.qps
        if self._may_be_usual and (usual := self._attempt.usual(state, target)) is not None:
            held = _LEAST_HELD if self._attempt.acceptance.gives_way else 0.0
            if usual.progress >= (held if self._tip_mode == "scaled" else WHOLE):
                return Advance(usual, None)
        for found in self._attempts(state, target, dt, smallest):
            if found.step.reason.startswith(TOO_LONG):
                too_long = found.step.reason
            if found.step.moved and found.rank <= worst:
                best, worst = found, found.rank - 1
                if not found.rank:
                    break
        last = best or Advance(_blocked(found.step, state, too_long or found.step.reason or _OFF_PATH), None)
        count = self._attempt.qps - before
        return last if last.step.qps == count else last._replace(step=replace(last.step, qps=count))

    def _attempts(self, state: State, target: Target, dt: float, smallest: float) -> Iterator[Advance]:
        """Yield the attempts at a target: the whole piece, halves of it if the tip may slow down, and creeping.

        With a limit on the displacement of nodes, pieces longer than that limit are not tried.
        """
        is_slow, first = self._tip_mode == "scaled", self.first_share(target)
        if is_slow and self._attempt.acceptance.gives_way and self._actuation.starts_at_once:
            yield from self._held_or_free(state, target, dt, first, smallest)
        else:
            yield from self._pieces(state, target, dt, first, smallest if is_slow else first, Tracking.EITHER)
        if not self._actuation.starts_at_once:
            slow = self._actuation.creeping(state, (target.lower, target.upper), dt)
            if slow is not None:
                yield self._try(state, replace(target, lower=slow[0], upper=slow[1]), dt)

    def first_share(self, target: Target) -> float:
        """Return the share of a target's piece that is tried first; below 1 if the step limit requires it."""
        is_limited = self._tip_mode == "scaled" and self._step_limit < np.inf
        asked = self._asked(target) if is_limited else 0.0
        return self._step_limit / asked if asked > self._step_limit else 1.0

    def _held_or_free(
        self, state: State, target: Target, dt: float, first: float, smallest: float
    ) -> Iterator[Advance]:
        """Yield attempts with stations on the curve; then others, if these get less than half as far.

        Stations leave the curve only if the arm then gets a quarter further than on it, or hardly moves on it. That may
        lead into a corner, and so is only for arms that can stop at once.
        """
        held: Advance | None = None
        for found in self._pieces(state, target, dt, first, max(smallest, _LEAST_HELD), Tracking.HARD):
            if not found.step.moved or found.step.progress >= _LEAST_HELD * first:
                yield found
            elif found.step.progress >= _LEAST_CRAWL * first:
                held = found if held is None else max(held, found, key=_progress)
        share = first
        for found in self._pieces(state, target, dt, first, smallest, Tracking.ELASTIC):
            if found.step.moved and share < _LEAST_HELD * first:
                on_curve = self._piece(state, target, dt, first, share, Tracking.HARD)
                if on_curve.step.moved and on_curve.step.progress >= _LEAST_CRAWL * first:
                    held = on_curve if held is None else max(held, on_curve, key=_progress)
            # A step without progress is allowed: the arm waits.
            least = -np.inf if held is None else FURTHER * held.step.progress
            if share <= least or (found.step.moved and found.step.progress <= least):
                break
            yield found
            share /= 2.0
        if held is not None:
            yield held

    def _pieces(
        self, state: State, target: Target, dt: float, first: float, smallest: float, tracking: Tracking
    ) -> Iterator[Advance]:
        """Yield the attempts at the `first` share of a piece, and at halves down to `smallest` of it."""
        share = first
        yield self._piece(state, target, dt, first, share, tracking)
        while share > first * smallest:
            share /= 2
            yield self._piece(state, target, dt, first, share, tracking)

    def _piece(
        self, state: State, target: Target, dt: float, first: float, share: float, tracking: Tracking
    ) -> Advance:
        """Return a step towards a `share` of a target; below the `first` share, within a trust region."""
        if share == 1.0:
            return self._try(state, target, dt, tracking=tracking)
        lower, upper = target.lower, target.upper
        if share < first:
            longest = min(TRUST * self._arm.unit, _LONGER * self._step_limit)
            values, trust = self._actuation.values(state), share * longest / self._arm.levers / first
            lower, upper = within((lower, upper), values, trust)
        piece = replace(target.part(share), lower=lower, upper=upper)
        return self._try(state, piece, dt, share, tracking=tracking)

    def _asked(self, target: Target) -> float:
        """Return the displacement of the tip that a target asks for, m."""
        path, axes = target.path, self._shaping.setup.task.axes
        asked = path.at(target.end).position - path.at(target.start).position
        return float(np.linalg.norm(asked[axes]))

    def _try(
        self,
        state: State,
        target: Target,
        dt: float,
        share: float = 1.0,
        *,
        tracking: Tracking = Tracking.EITHER,
    ) -> Advance:
        """Return a step and its braking; the target is a `share` of the one on which progress is counted."""
        enough = _LEAST_HELD if self._tip_mode == "scaled" else WHOLE
        step = self._attempt.run(state, target, share, tracking=tracking, enough=enough)
        if not step.moved:
            return Advance(step, None)
        if step.progress < WHOLE and self._tip_mode != "scaled":
            # The tip must stay on time: part of the path is not enough.
            return Advance(_blocked(step, state, "the tip cannot stay on time"), None)
        braking: Braking | None = None
        if not self._actuation.starts_at_once:
            path, covered = target.path, step.progress * (target.end - target.start)
            reached = target.start + covered
            if reached >= path.end - INSTANT:
                # The path beyond its end is unknown.
                path = path.continued(_BEYOND)
            braking = self.brakes(dt).find(step.state, path, reached, 2.0 * covered)
            if braking is None:
                # A shorter step than the one before it may be too short to stop in.
                shorter = dt < (1.0 - 1e-9) * state.duration
                why = f"{CANNOT_BRAKE} in {dt:g} s, less than the last step took" if shorter else CANNOT_BRAKE
                return Advance(_blocked(step, state, why), None)
        return Advance(step if share == 1.0 else step.over(share, None), braking)


def _progress(advance: Advance) -> float:
    return advance.step.progress


def _blocked(step: Step, state: State, reason: str) -> Step:
    """Return a blocked step in place of one that its QP allowed: the arm stays in `state`."""
    return replace(step, status=StepStatus.BLOCKED, progress=0.0, state=state, reason=reason)
