"""Timing: one resolver by itself over whole maneuvers, then in turn with a baseline, by blocks of steps.

A step is ``Resolver.step(position=...)``, with ``pointing`` where a direction is tracked, as a control loop
calls it: from the state of the last step to the next mark of the maneuver, there and back. An arm that is
stuck goes home and on from there. All is warm: the kernels are compiled, and nothing is done for the first
time.

In turn, both take the same steps from the states that the resolver reached: the resolver takes ten, then the
baseline those ten, and at the end the resolver ten more. A machine that slows down slows both, and the ratio
of their medians stays the same. Steps of one block are as warm as in a control loop: right after a large
baseline a step may take twice as long, because the processor's caches are filled with other things. Ratios
are those of the thread's CPU time, because longer steps are interrupted more often. Garbage is collected as
usual.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter, thread_time
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.bench.contestants import Contestant
from vgtm_qp.bench.tour import Goal, Tour
from vgtm_qp.compiled import finish_compiling
from vgtm_qp.errors import VgtmError
from vgtm_qp.methods import Resolver
from vgtm_qp.step.state import State
from vgtm_qp.step.step import Step

_Answer = TypeVar("_Answer")

_BY_CLOCK = ("median", "p95", "p99", "max")
_BY_CPU = ("cpu", "cpu_p95", "cpu_p99", "cpu_max")
_LEAST_STEPS = 10
_BLOCK = 10
"""Steps of one contestant before the other has its turn."""
_INTERRUPTED = 1.05
"""Ratio of a step's time by the clock to its CPU time, from which on it counts as interrupted."""
_OVERRUN = 5.0
"""A run ends after this many times its duration, however few steps it had."""


class StepTime(NamedTuple):
    """Wall-clock time, and CPU time of the thread, of a step, s."""

    wall: float
    cpu: float


def timing(spent: Sequence[StepTime]) -> dict[str, float]:
    """Return seconds of one or more steps, and their number ``steps``.

    ``median``, ``p95``, ``p99`` and ``max`` are by the clock; ``cpu``, ``cpu_p95``, ``cpu_p99`` and ``cpu_max`` the
    same of the thread's CPU time.
    """
    found: dict[str, float] = {}
    for names, times in zip((_BY_CLOCK, _BY_CPU), np.array(spent, dtype=float).T, strict=True):
        found |= zip(names, np.percentile(times, (50, 95, 99, 100)).tolist(), strict=True)
    return found | {"steps": len(spent)}


def breakdown(spent: Sequence[StepTime], phases: Mapping[str, ArrayLike]) -> dict[str, Any]:
    """Return where the time of S steps goes: mean seconds in each of the ``phases`` (S,), which sum to the ``total``.

    Of the steps that the system did not interrupt, by clock and CPU time, the mean is that of the middle half in the
    order of their time. Phase ``other`` is what the resolver does outside its phases.
    """
    wall, cpu = np.array(spent, dtype=float).T
    delay = wall / np.maximum(cpu, 1e-9)
    kept = np.argsort(delay, kind="stable")[: max(int(np.sum(delay < _INTERRUPTED)), _LEAST_STEPS)]
    kept, count = kept[np.argsort(wall[kept], kind="stable")], len(kept)
    middle = kept[count // 4 : max(count - count // 4, count // 4 + 1)]
    total = float(wall[middle].mean())
    means = {name: float(np.asarray(values, dtype=float)[middle].mean()) for name, values in phases.items()}
    return {"total": total, "phases": means | {"other": total - sum(means.values())}}


@dataclass
class Steps:
    """Steps that the resolver took by itself: seconds of each in every phase, its QPs, and rows by FCL and exact ones.

    ``covered`` is the greatest share of the maneuver that the arm covered, 0 to 1; ``stopped_by`` what stopped it
    first, empty if nothing did.
    """

    spent: list[StepTime] = field(default_factory=list)
    phases: dict[str, list[float]] = field(default_factory=dict)
    qps: list[int] = field(default_factory=list)
    fcl_rows: list[int] = field(default_factory=list)
    exact_rows: list[int] = field(default_factory=list)
    covered: float = 0.0
    stopped_by: str = ""


@dataclass
class PairedTimes:
    """Times of a baseline and of the resolver over the same steps; `failed` counts steps without answer."""

    theirs: list[StepTime] = field(default_factory=list)
    ours: list[StepTime] = field(default_factory=list)
    failed: int = 0

    @property
    def ratio(self) -> float:
        """Median CPU time of the baseline over that of the resolver."""
        return timing(self.theirs)["cpu"] / timing(self.ours)["cpu"]

    def add(self, baseline: Contestant, block: list[tuple[State, Goal, StepTime]]) -> None:
        """Let the baseline take steps that the resolver took, from the states where they began."""
        for state, goal, ours in block:
            theirs, answered = _take(baseline, state, goal)
            if answered:
                self.theirs.append(theirs)
                self.ours.append(ours)
            else:
                self.failed += 1


class _Walk:
    """A resolver on a tour from home."""

    def __init__(self, resolver: Resolver, goals: list[Goal]) -> None:
        self._resolver, self.tour = resolver, Tour(goals)
        self.restart()

    def restart(self) -> None:
        """Go home."""
        self._resolver.state = self._resolver.setup.home_state()
        self.tour.restart()

    def step(self) -> tuple[StepTime, Step]:
        """Take a step; return its time, and the step."""
        take, goal = self._resolver.step, self.tour.goal
        spent, step = _timed(lambda: take(position=goal.pose.position, pointing=goal.pointing))
        self.tour.advance(step)
        return spent, step

    def repeat(self, seconds: float, steps: int) -> Iterator[int]:
        """Count up to `steps` steps until `seconds` have passed; an arm that is stuck goes home.

        ``_LEAST_STEPS`` are counted even after `seconds`, up to ``_OVERRUN`` times as long. The count ends at
        an arm that is stuck at home.
        """
        started = perf_counter()
        for count in range(steps):
            limit = seconds * (_OVERRUN if count < _LEAST_STEPS else 1.0)
            if count and perf_counter() - started >= limit:
                return
            yield count
            if self.tour.stuck and self.tour.covered == 0.0:
                return
            if self.tour.stuck:
                self.restart()


def run_alone(resolver: Resolver, goals: list[Goal], *, seconds: float, steps: int) -> Steps:
    """Return up to `steps` steps, as many as `seconds` suffice for, after one tour there and back as a warm-up."""
    walk, found = _Walk(resolver, goals), Steps()
    for _ in walk.repeat(seconds, min(steps, walk.tour.round_trip)):
        walk.step()
    finish_compiling()
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
        found.stopped_by = found.stopped_by or walk.tour.stuck
    found.covered = walk.tour.covered
    return found


def run_in_turn(
    resolver: Resolver, baseline: Contestant, goals: list[Goal], *, seconds: float, steps: int
) -> PairedTimes:
    """Return the times of baseline and resolver over the same steps, by blocks in turn, a resolver's last."""
    walk, found = _Walk(resolver, goals), PairedTimes()
    _take(baseline, resolver.state, walk.tour.goal)
    finish_compiling()
    block: list[tuple[State, Goal, StepTime]] = []
    for count in walk.repeat(seconds, steps):
        state, goal = resolver.state, walk.tour.goal
        ours, _ = walk.step()
        block.append((state, goal, ours))
        if len(block) == _BLOCK or count == steps - 1:
            found.add(baseline, block)
            block = []
    found.add(baseline, block)
    found.ours += [walk.step()[0] for _ in walk.repeat(seconds, min(steps, _BLOCK))]
    return found


def _take(contestant: Contestant, state: State, goal: Goal) -> tuple[StepTime, bool]:
    """Let a baseline take a step from a state; return its time and whether it found an answer."""
    contestant.place(state)

    def answers() -> bool:
        try:
            return contestant.step(goal)
        except (VgtmError, np.linalg.LinAlgError):
            return False

    return _timed(answers)


def _timed(take: Callable[[], _Answer]) -> tuple[StepTime, _Answer]:
    wall, cpu = perf_counter(), thread_time()
    answer = take()
    return StepTime(perf_counter() - wall, thread_time() - cpu), answer
