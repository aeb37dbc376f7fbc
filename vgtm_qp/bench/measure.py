"""Timing: one resolver by itself over whole maneuvers, then in turn with a baseline, step by step.

In turn, both take each step from the state that the resolver had reached, and which of them is first alternates:
a machine that slows down slows both, and the ratio of their medians holds. The content of the processor's caches
differs: after a large baseline the smaller contestant may take half as long again. Ratios are those of CPU time,
because longer steps are interrupted more often. Garbage is collected as usual.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter, process_time
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.bench.contestants import Contestant
from vgtm_qp.errors import VgtmError
from vgtm_qp.maneuver.plan import Plan
from vgtm_qp.methods import Resolver
from vgtm_qp.step.state import State
from vgtm_qp.step.step import Step, StepStatus

_Answer = TypeVar("_Answer")

_LEAST_STEPS = 10
_WARM_UP = 5
_STALLED_PROGRESS, _STALLED_STEPS = 1e-3, 10
_OVERRUN = 5.0
"""A run ends after this many times its duration, however few steps it had."""


class Spent(NamedTuple):
    """Wall-clock and CPU time of a step, s."""

    wall: float
    cpu: float


def timing(spent: Sequence[Spent]) -> dict[str, float]:
    """Return seconds of one or more steps: ``median``, ``p95`` and ``p99`` by the clock, median ``cpu``; ``steps``."""
    wall, cpu = np.array(spent, dtype=float).T
    median, p95, p99 = (float(value) for value in np.percentile(wall, (50, 95, 99)))
    return {"median": median, "p95": p95, "p99": p99, "cpu": float(np.median(cpu)), "steps": len(wall)}


def breakdown(seconds: ArrayLike, phases: Mapping[str, ArrayLike]) -> dict[str, Any]:
    """Return where the time of steps (S,) goes: mean seconds in each of the ``phases``, which sum to the ``total``.

    The mean is that of the middle half of the steps in the order of their time, so that one which the system
    interrupted does not decide. Phase ``other`` is what the resolver does outside its phases.
    """
    times = np.asarray(seconds, dtype=float)
    count = len(times)
    middle = np.argsort(times, kind="stable")[count // 4 : max(count - count // 4, count // 4 + 1)]
    total = float(times[middle].mean())
    means = {name: float(np.asarray(values, dtype=float)[middle].mean()) for name, values in phases.items()}
    return {"total": total, "phases": means | {"other": total - sum(means.values())}}


@dataclass
class Steps:
    """Steps that the resolver took by itself: seconds of each in every phase, its QPs, and rows by FCL and exact ones.

    ``covered`` is the greatest share of the maneuver that one pass covered, 0 to 1; ``stopped_by`` what blocked the
    arm, empty if nothing did.
    """

    spent: list[Spent] = field(default_factory=list)
    phases: dict[str, list[float]] = field(default_factory=dict)
    qps: list[int] = field(default_factory=list)
    fcl_rows: list[int] = field(default_factory=list)
    exact_rows: list[int] = field(default_factory=list)
    covered: float = 0.0
    stopped_by: str = ""


@dataclass
class Pairs:
    """Times of a baseline and of the resolver, of the same steps; `failed` counts steps without an answer."""

    theirs: list[Spent] = field(default_factory=list)
    ours: list[Spent] = field(default_factory=list)
    failed: int = 0

    @property
    def ratio(self) -> float:
        """Median CPU time of the baseline over that of the resolver, of the same steps."""
        return timing(self.theirs)["cpu"] / timing(self.ours)["cpu"]


class _Place(NamedTuple):
    """Where a step begins: the state, its piece of the path, and its duration, s."""

    state: State
    start: float
    end: float
    dt: float


class _Walk:
    """A resolver that repeats a plan from home, by the steps that a maneuver takes."""

    def __init__(self, resolver: Resolver, plan: Plan) -> None:
        self._resolver, self._plan = resolver, plan
        self.restart()

    def restart(self) -> None:
        """Go home."""
        self._resolver.state = self._resolver.setup.home_state()
        self._value, self._stalled, self.stuck = self._plan.path.start, 0, ""

    @property
    def covered(self) -> float:
        """The part of the path behind the arm, 0 to 1."""
        path = self._plan.path
        return (self._value - path.start) / (path.end - path.start)

    @property
    def place(self) -> _Place:
        """Where the next step begins."""
        return _Place(self._resolver.state, self._value, *self._plan.next_mark(self._value))

    def step(self) -> tuple[Spent, Step]:
        """Take a step; return what it took, and the step."""
        _, start, end, dt = self.place
        spent, step = _timed(lambda: self._resolver.follow(self._plan.path, start, end, dt=dt))
        self._stalled = self._stalled + 1 if step.progress < _STALLED_PROGRESS else 0
        if step.status is StepStatus.BLOCKED or self._stalled == _STALLED_STEPS:
            self.stuck = ", ".join(step.blocked_by) or "nothing that has a name"
        elif step.status is StepStatus.SLOWED:
            self._value += step.progress * (end - start)
        else:
            self._value = end
        return spent, step

    def repeat(self, seconds: float, steps: int) -> Iterator[int]:
        """Count steps to take, from home again where the plan ends, until there are so many or `seconds` have passed.

        A few are counted at least, unless they are too slow; an arm that is stuck at home takes no other.
        """
        started = perf_counter()
        for count in range(steps):
            limit = seconds * (_OVERRUN if count < _LEAST_STEPS else 1.0)
            if count and perf_counter() - started >= limit:
                return
            yield count
            if self.stuck and self.covered == 0.0:
                return
            if self.stuck or self._value >= self._plan.marks[-1]:
                self.restart()


def run_alone(resolver: Resolver, plan: Plan, *, seconds: float, steps: int) -> Steps:
    """Return up to `steps` steps of whole maneuvers, as many as `seconds` suffice for, after a warm-up."""
    walk, found = _Walk(resolver, plan), Steps()
    for _ in walk.repeat(seconds, _WARM_UP):
        walk.step()
    walk.restart()
    before = dict(resolver.phases)
    for _ in walk.repeat(seconds, steps):
        spent, step = walk.step()
        found.spent.append(spent)
        found.qps.append(step.qps)
        found.fcl_rows.append(step.fcl_rows)
        found.exact_rows.append(step.exact_rows)
        now = dict(resolver.phases)
        for name, total in now.items():
            found.phases.setdefault(name, []).append(total - before[name])
        before = now
        found.covered = max(found.covered, walk.covered)
        found.stopped_by = found.stopped_by or walk.stuck
    return found


def run_in_turn(resolver: Resolver, baseline: Contestant, plan: Plan, *, seconds: float, steps: int) -> Pairs:
    """Return the times of a baseline and of the resolver over the same steps, in alternation."""
    walk, found = _Walk(resolver, plan), Pairs()
    _take(baseline, walk.place, plan)
    for count in walk.repeat(seconds, steps):
        place = walk.place
        if count % 2:
            ours, _ = walk.step()
            theirs, answered = _take(baseline, place, plan)
        else:
            theirs, answered = _take(baseline, place, plan)
            ours, _ = walk.step()
        if answered:
            found.theirs.append(theirs)
            found.ours.append(ours)
        else:
            found.failed += 1
    return found


def _take(contestant: Contestant, place: _Place, plan: Plan) -> tuple[Spent, bool]:
    """Let a baseline take the step at `place`; return what it took and whether it found an answer."""
    contestant.place(place.state)

    def answers() -> bool:
        try:
            return contestant.step(plan.path, place.start, place.end, place.dt)
        except (VgtmError, np.linalg.LinAlgError):
            return False

    return _timed(answers)


def _timed(take: Callable[[], _Answer]) -> tuple[Spent, _Answer]:
    wall, cpu = perf_counter(), process_time()
    answer = take()
    return Spent(perf_counter() - wall, process_time() - cpu), answer
