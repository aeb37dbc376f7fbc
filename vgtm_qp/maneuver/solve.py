"""The maneuver loop: steps along the plan until it is done or no safe step is left; also for many problems at once."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import islice
from time import perf_counter

import numpy as np

from vgtm_qp.compiled import finish_compiling
from vgtm_qp.machine import THREADS, environment
from vgtm_qp.maneuver.log import Log
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.maneuver.retries import DeadEnd, retries
from vgtm_qp.methods import Resolver
from vgtm_qp.problem import Problem
from vgtm_qp.problem.problem import check_is_problem
from vgtm_qp.qp.terms import Inequality, Objective
from vgtm_qp.result.manifest import problem_digests
from vgtm_qp.step.checks import check_problem
from vgtm_qp.step.remedies import Remedy
from vgtm_qp.step.state import State
from vgtm_qp.step.step import Step, StepStatus
from vgtm_qp.step.stops import Stop, StopKind
from vgtm_qp.verify import verify as check

STALLED_PROGRESS = 1e-2
"""Share of a step below which its progress counts as stalled; the arm gives up after so many such steps."""
STALLED_STEPS = 5
_NOTHING_LEFT = 1e-9
"""Share of the path below which a piece counts as covered."""
_FURTHER = 1e-3
"""Share of the whole path by which a retry must get further than the best so far to replace it."""

_SHORTEST = 1 / 8
"""Share of a step that is tried last if the tip may not be late."""
_TRIED_STEPS = 10
_PART = 0.25
"""Share of a remedy's progress to first order from which on the arm counts as going on with it."""
_MORE = (1.0, 2.0, 4.0, 8.0, 16.0)
_BETWEEN = 0.75
"""Factors of a remedy's amounts that are tried; and the share of the first that suffices which is tried after it."""

_NOTHING = Remedy((), 1.0)
"""No change: with it the arm goes on as it is."""

Progress = Callable[[float, Step], None]


def solve(
    problem: Problem,
    *,
    progress: Progress | None = None,
    verify: bool = True,
    objectives: Sequence[Objective] = (),
    rows: Sequence[Inequality] = (),
) -> Maneuver:
    """Solve a problem by its method and return the maneuver, certified unless `verify` is False.

    Parameters
    ----------
    problem
        What `load_problem` returns.
    progress
        Called after each step with the share of the path covered, 0 to 1, and the step. An interrupt ends the
        maneuver with the steps made so far.
    verify
        Check the result again from its nodes alone.
    objectives, rows
        Objectives of the user's own, which choose among the motions that the problem leaves free; and rows, which each
        step keeps. The certificate is not about them; ``manifest["own"]`` has the least value of each row.

    Raises
    ------
    ProblemError
        The problem cannot be set up, or is not a Problem; no step was made.
    PartError
        As of `Resolver`.
    """
    check_is_problem(problem)
    started = perf_counter()
    # Digests of the files as they were read: they may have changed by the end.
    files = {"file": problem.source, "path": getattr(problem.maneuver, "path", None)}
    digests = problem_digests(
        problem.to_dict(), **files, urdf=None if problem.arm is None else problem.arm.urdf
    )
    resolver = Resolver(problem, objectives=objectives, rows=rows)
    mistakes = check_problem(problem, resolver.setup)
    if mistakes:
        raise problem.error(mistakes)
    attempt = ManeuverAttempt(problem, resolver)
    setup_time = perf_counter() - started

    way = ""
    try:
        with problem.blaming(("maneuver",), "a path that steps can follow"):
            stop = attempt.run(progress)
            if stop is not None:
                way, attempt, stop = _retry(problem, attempt, stop, progress)
                stop = attempt.resumed(stop, progress)
                stop = None if stop is None else replace(stop, remedies=helpful_remedies(attempt, stop))
    except KeyboardInterrupt:
        stop = Stop(StopKind.INTERRUPTED)
    maneuver = attempt.log.maneuver(
        problem, stop, problem_digests=digests, way_out=way, setup_time=setup_time
    )
    return maneuver.with_certificate(check(maneuver)) if verify else maneuver


def solve_many(
    problems: Iterable[Problem], *, workers: int | None = None, verify: bool = True
) -> Iterator[Maneuver]:
    """Solve problems in separate processes and yield their maneuvers in order.

    Each process solves one problem after another with a resolver of its own and one BLAS thread. A kernel is compiled
    once for all of them, into the cache that they share; none of them waits for it.

    Parameters
    ----------
    problems
        What `load_problem` returns.
    workers
        Number of processes; that of the processors by default.
    verify
        Check each result again from its nodes alone.

    Raises
    ------
    VgtmError
        What `solve` raises for a problem, when its turn comes; the maneuvers before it were yielded.
    concurrent.futures.process.BrokenProcessPool
        A process was killed from outside.
    """
    context = multiprocessing.get_context("spawn")
    one = environment(dict.fromkeys(THREADS, "1"))
    with one, ProcessPoolExecutor(workers, mp_context=context) as pool:
        tasks = [pool.submit(solve, problem, verify=verify) for problem in problems]
        try:
            for task in tasks:
                yield task.result()
        finally:
            for task in tasks:
                task.cancel()


def compile_steps(problem: Problem) -> None:
    """Compile the kernels of a problem's steps and wait for it, so that no time is measured without them.

    A resolver of its own takes the first step for this.

    Raises
    ------
    ProblemError
        As `solve`.
    """
    resolver = Resolver(problem)
    plan = make_plan(problem, *resolver.tip())
    resolver.follow(plan.path, plan.path.start, float(plan.marks[0]))
    finish_compiling()


class ManeuverAttempt:
    """A resolver on its way along the path of a problem, and the log of its states."""

    def __init__(self, problem: Problem, resolver: Resolver) -> None:
        self.resolver, self.plan = resolver, make_plan(problem, *resolver.tip())
        self.value = self.plan.path.start
        self.stalled = 0
        self.log = Log(resolver, self.plan.path.pose(self.value))

    @property
    def progress(self) -> float:
        """Share of the path covered, 0 to 1."""
        path = self.plan.path
        return (self.value - path.start) / (path.end - path.start)

    def run(self, progress: Progress | None, *, patience: int = STALLED_STEPS) -> Stop | None:
        """Step along the plan; return why the arm stopped for good, or None if it reached the end.

        It gives up after `patience` steps in a row without progress.
        """
        resolver, plan, arm = self.resolver, self.plan, self.resolver.setup.arm
        last = float(plan.marks[-1])
        keeps_moving = bool(np.isfinite(arm.acceleration[arm.actuators]).any())
        while self.value < last:
            aim, dt = self._next_mark(self.value, keeps_moving=keeps_moving)
            before = resolver.state
            with self.log.clock():
                aim, dt, step = self._follow(aim, dt)
            if step.status is StepStatus.BLOCKED:
                return self._explain(aim, dt, step)
            stop = self._explain(aim, dt, step, before) if self._gives_up(step) else None
            if stop is not None and step.left_path:
                # Further braking would leave the path: its states do not belong to the maneuver.
                return stop
            self._advance(aim, step)
            if stop is not None:
                self._come_to_rest()
                return stop
            self.stalled = self.stalled + 1 if step.progress < STALLED_PROGRESS else 0
            if self.stalled >= patience:
                return self._explain(aim, dt, step)
            if progress is not None:
                progress(self.progress, step)
        return None

    @property
    def _may_be_late(self) -> bool:
        return self.resolver.setup.tip_mode == "scaled"

    def _next_mark(self, value: float, *, keeps_moving: bool = False) -> tuple[float, float]:
        """Return the target of the step from `value` of the path, and its duration, s: for a tip on time the rest."""
        aim, dt = self.plan.next_mark(value, keeps_moving=keeps_moving)
        return aim, dt if self._may_be_late else aim - value

    def _follow(self, aim: float, dt: float) -> tuple[float, float, Step]:
        """Return the step towards `aim`, its aim and duration, s; a tip on time tries halves of a blocked one."""
        resolver, path, shortest = self.resolver, self.plan.path, _SHORTEST * dt
        step = resolver.follow(path, self.value, aim, dt=dt)
        whole = aim, dt, step
        while step.status is StepStatus.BLOCKED and not self._may_be_late and dt > shortest:
            dt /= 2.0
            aim = self.value + dt
            step = resolver.follow(path, self.value, aim, dt=dt)
        return (aim, dt, step) if step.moved else whole

    def resumed(self, stop: Stop | None, progress: Progress | None) -> Stop | None:
        """Go on from a stop at which the arm stalled, wherever a later step is free; return the stop that stays.

        An arm may move by millimetres off its curve for several steps, without progress, and then be free. It has the
        steps that :meth:`goes_on` tries for it, and gives up where it gains next to nothing.
        """
        patience = STALLED_STEPS + _TRIED_STEPS
        while stop is not None and self.stalled >= STALLED_STEPS and self.goes_on(_NOTHING):
            before, self.stalled = self.progress, 0
            stop = self.run(progress, patience=patience)
            if self.progress <= before + _FURTHER:
                break
        return stop

    def goes_on(self, remedy: Remedy) -> bool:
        """Return whether a remedy takes the arm past the place of its stop; the attempt stays as it is."""
        resolver, plan, value = self.resolver.relaxed(remedy), self.plan, self.value
        if resolver is None:
            return False
        aim, dt = self._next_mark(value)
        enough = value + _PART * remedy.progress * (aim - value)
        for _ in range(_TRIED_STEPS):
            step = resolver.follow(plan.path, value, aim, dt=dt)
            if not step.moved or self._gives_up(step):
                break
            value += step.progress * (aim - value)
            if value >= enough:
                return True
        return False

    def _explain(self, aim: float, dt: float, step: Step, state: State | None = None) -> Stop:
        return self.resolver.explain(self.plan.path, self.value, aim, dt=dt, last=step, state=state)

    def _gives_up(self, step: Step) -> bool:
        """Return whether a step in which the arm braked ends the maneuver.

        With a hard tip, which may not be late, any braking does. With a scaled one it does if the tip left
        the path.
        """
        mode = self.resolver.setup.tip_mode
        return step.braked and (mode == "hard" or (mode != "elastic" and step.left_path))

    def _come_to_rest(self) -> None:
        """Take the steps in which the arm comes to rest on its path."""
        path = self.plan.path
        while self.value < path.end:
            with self.log.clock():
                step = self.resolver.brake(path, self.value, path.end)
            if step is None or step.left_path:
                return
            self._advance(path.end, step)

    def _advance(self, aim: float, step: Step) -> None:
        """Record a step towards `aim`."""
        path, rest = self.plan.path, (1.0 - step.progress) * (aim - self.value)
        # An arm that covers half of the rest in each step would never arrive.
        is_there = step.status is StepStatus.REACHED or rest <= _NOTHING_LEFT * (path.end - path.start)
        self.value = aim if is_there else self.value + step.progress * (aim - self.value)
        self.log.add(step, path.pose(self.value), self.progress)


def _retry(
    problem: Problem, first: ManeuverAttempt, stop: Stop, progress: Progress | None
) -> tuple[str, ManeuverAttempt, Stop | None]:
    """Return name, attempt and stop of the retry that gets furthest; the name is empty for the first attempt."""
    arm, state = first.resolver.setup.arm, first.resolver.state
    heading = first.plan.path.at(first.value).velocity
    best: tuple[str, ManeuverAttempt, Stop | None] = ("", first, stop)
    for name, other in retries(problem, DeadEnd(stop, state.control_vertices, arm.height, heading)):
        resolver = first.resolver.again(other)
        if resolver is None:
            break
        attempt = ManeuverAttempt(other, resolver)
        found = attempt.run(progress)
        if problem.method.gives_way and not other.method.gives_way and found is not None:
            way, attempt, found = _retry(other, attempt, found, progress)
            name = way or name
        if found is None:
            return name, attempt, None
        if attempt.progress > best[1].progress + _FURTHER:
            best = (name, attempt, found)
    return best


def helpful_remedies(attempt: ManeuverAttempt, stop: Stop) -> tuple[Remedy, ...]:
    """Return the remedies of a stop with which the arm goes on, enlarged as far as needed.

    If there are none, the first of its resorts that helps.
    """

    def enough(remedy: Remedy) -> Remedy | None:
        for factor in _MORE:
            if attempt.goes_on(more := remedy.times(factor)):
                less = remedy.times(_BETWEEN * factor)
                return less if factor > 1.0 and attempt.goes_on(less) else more
        return None

    helpful = tuple(more for remedy in stop.remedies if (more := enough(remedy)))
    return helpful or tuple(islice((more for remedy in stop.resorts if (more := enough(remedy))), 1))
