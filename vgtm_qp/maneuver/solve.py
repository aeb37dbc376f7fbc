"""The maneuver loop: steps along the plan until it is done or no safe step is left; also for many problems at once."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from vgtm_qp.compiled import finish_compiling
from vgtm_qp.machine import THREADS, environment
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.maneuver.retries import DeadEnd, retries
from vgtm_qp.methods import Resolver
from vgtm_qp.problem import Problem
from vgtm_qp.problem.problem import check_is_problem
from vgtm_qp.result.manifest import SCHEMA_VERSION, mesh_record, problem_digests, recorded_versions
from vgtm_qp.step.checks import check_problem
from vgtm_qp.step.remedies import Remedy
from vgtm_qp.step.state import State
from vgtm_qp.step.step import Step, StepStatus
from vgtm_qp.step.stops import Stop, StopKind
from vgtm_qp.verify import verify as check

STALLED_PROGRESS = 1e-2
"""Progress of a step, as a share of it, below which the arm hardly moves; it gives up after so many such steps."""
STALLED_STEPS = 5
_FURTHER = 1e-3
"""Share of the whole path by which a retry must get further than another to be the better one."""

_TRIED_STEPS = 10
_PART = 0.25
"""Share of the progress that a remedy promises to first order, from which on the arm goes on with it."""
_MORE = (1.0, 2.0, 4.0)
"""Factors of a remedy's amounts that are tried."""

Progress = Callable[[float, Step], None]


def solve(problem: Problem, *, progress: Progress | None = None, verify: bool = True) -> Maneuver:
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

    Raises
    ------
    ProblemError
        The problem cannot be set up, or is not a Problem; no step was made.
    """
    check_is_problem(problem)
    started = perf_counter()
    # The files as they are when they are read, not as they may be at the end.
    files = {"file": problem.source, "path": getattr(problem.maneuver, "path", None)}
    digests = problem_digests(
        problem.to_dict(), **files, urdf=None if problem.arm is None else problem.arm.urdf
    )
    resolver = Resolver(problem)
    mistakes = check_problem(problem, resolver.setup)
    if mistakes:
        raise problem.error(mistakes)
    attempt = _Attempt(problem, resolver)
    setup_time = perf_counter() - started

    way = ""
    try:
        with problem.blaming(("maneuver",), "a path that steps can follow"):
            stop = attempt.run(progress)
            if stop is not None:
                way, attempt, stop = _retry(problem, attempt, stop, progress)
                stop = None if stop is None else replace(stop, remedies=_tried(attempt, stop))
    except KeyboardInterrupt:
        stop = Stop(StopKind.INTERRUPTED)
    maneuver = _assemble(problem, resolver, attempt, stop, setup_time, way, digests)
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
    """Compile the kernels of a problem's steps and wait for it, so that times are not those of interpreted ones.

    The first step is taken for it by a resolver of its own.

    Raises
    ------
    ProblemError
        As `solve`.
    """
    resolver = Resolver(problem)
    plan = make_plan(problem, *resolver.tip())
    resolver.follow(plan.path, plan.path.start, float(plan.marks[0]))
    finish_compiling()


class _Attempt:
    """A resolver on its way along the path of a problem, and the rows of the result, grown step by step."""

    def __init__(self, problem: Problem, resolver: Resolver) -> None:
        self.resolver, self.plan = resolver, make_plan(problem, *resolver.tip())
        self.value = self.plan.path.start
        self.rows: dict[str, list[Any]] = {}
        self._seconds, self._phases = 0.0, [0.0] * len(resolver.phases)
        self.clearance_rows = {"fcl": 0, "exact": 0}
        self._add_row()

    @property
    def progress(self) -> float:
        """Share of the path covered, 0 to 1."""
        path = self.plan.path
        return (self.value - path.start) / (path.end - path.start)

    def run(self, progress: Progress | None) -> Stop | None:
        """Step along the plan; return why the arm stopped for good, or None if it reached the end."""
        resolver, plan, arm = self.resolver, self.plan, self.resolver.setup.arm
        stalled, last = 0, float(plan.marks[-1])
        keeps_moving = bool(np.isfinite(arm.acceleration[arm.actuators]).any())
        while self.value < last:
            aim, dt = plan.next_mark(self.value, keeps_moving=keeps_moving)
            before = resolver.state
            with self._clock():
                step = resolver.follow(plan.path, self.value, aim, dt=dt)
            if step.status is StepStatus.BLOCKED:
                return self._explain(aim, dt, step)
            stop = self._explain(aim, dt, step, before) if self._gives_up(step) else None
            if stop is not None and step.left_path:
                # Further braking leaves the path: those states do not belong to the maneuver.
                return stop
            self._advance(aim, step)
            if stop is not None:
                self._come_to_rest()
                return stop
            stalled = stalled + 1 if step.progress < STALLED_PROGRESS else 0
            if stalled >= STALLED_STEPS:
                return self._explain(aim, dt, step)
            if progress is not None:
                progress(self.progress, step)
        return None

    def goes_on(self, remedy: Remedy) -> bool:
        """Return whether the arm gets past where it stopped with a remedy; the attempt stays as it is."""
        resolver, plan, value = self.resolver.relaxed(remedy), self.plan, self.value
        if resolver is None:
            return False
        aim, dt = plan.next_mark(value)
        enough = value + _PART * remedy.progress * (aim - value)
        for _ in range(_TRIED_STEPS):
            step = resolver.follow(plan.path, value, aim, dt=dt)
            if step.left_path or not step.moved:
                break
            value += step.progress * (aim - value)
            if value >= enough:
                return True
        return False

    def _explain(self, aim: float, dt: float, step: Step, state: State | None = None) -> Stop:
        return self.resolver.explain(self.plan.path, self.value, aim, dt=dt, last=step, state=state)

    def _gives_up(self, step: Step) -> bool:
        """Return whether the maneuver ends with a step because the arm braked in it.

        A hard tip may not be late, so braking ends it; any tip but an elastic one ends when it leaves the path.
        """
        mode = self.resolver.setup.tip_mode
        return step.braked and (mode == "hard" or (mode != "elastic" and step.left_path))

    def _come_to_rest(self) -> None:
        """Do the steps in which the arm comes to rest on its path."""
        path = self.plan.path
        while self.value < path.end:
            with self._clock():
                step = self.resolver.brake(path, self.value, path.end)
            if step is None or step.left_path:
                return
            self._advance(path.end, step)

    @contextmanager
    def _clock(self) -> Iterator[None]:
        """Record the time of the step in this context, as a whole and by phase."""
        known, started = dict(self.resolver.phases), perf_counter()
        yield
        self._seconds = perf_counter() - started
        self._phases = [total - known[name] for name, total in self.resolver.phases.items()]

    def _advance(self, aim: float, step: Step) -> None:
        """Record a step towards `aim`."""
        reached = step.status is StepStatus.REACHED
        self.value = aim if reached else self.value + step.progress * (aim - self.value)
        self.clearance_rows["fcl"] += step.fcl_rows
        self.clearance_rows["exact"] += step.exact_rows
        self._add_row()

    def _add_row(self) -> None:
        resolver, state, setup = self.resolver, self.resolver.state, self.resolver.setup
        position, rotation = resolver.tip()
        target = self.plan.path.at(self.value)
        row = {
            "time": state.time,
            "configuration": state.q,
            "quantities": state.quantities,
            "control_vertices": state.control_vertices,
            "tip_position": position,
            "tip_rotation": rotation,
            "tip_target_position": target.position,
            "tip_target_rotation": target.rotation,
            "clearance": setup.least_clearance(state.q, state.time, "obstacles"),
            "self_clearance": setup.least_clearance(state.q, state.time, "members"),
            "progress": self.progress,
            "step_time": self._seconds,
            "phase_time": self._phases,
        }
        for name, value in row.items():
            self.rows.setdefault(name, []).append(value)


def _retry(
    problem: Problem, first: _Attempt, stop: Stop, progress: Progress | None
) -> tuple[str, _Attempt, Stop | None]:
    """Return name, attempt and stop of the retry that gets furthest; the name is empty for the first attempt."""
    arm, state = first.resolver.setup.arm, first.resolver.state
    heading = first.plan.path.at(first.value).velocity
    best: tuple[str, _Attempt, Stop | None] = ("", first, stop)
    for name, other in retries(problem, DeadEnd(stop, state.control_vertices, arm.height, heading)):
        resolver = first.resolver.again(other)
        if resolver is None:
            break
        attempt = _Attempt(other, resolver)
        found = attempt.run(progress)
        if problem.method.gives_way and found is not None:
            way, attempt, found = _retry(other, attempt, found, progress)
            name = way or name
        if found is None:
            return name, attempt, None
        if attempt.progress > best[1].progress + _FURTHER:
            best = (name, attempt, found)
    return best


def _tried(attempt: _Attempt, stop: Stop) -> tuple[Remedy, ...]:
    """Return the remedies of a stop with which the arm goes on, by as much as it takes."""
    enough = (next(filter(attempt.goes_on, map(remedy.times, _MORE)), None) for remedy in stop.remedies)
    return tuple(remedy for remedy in enough if remedy is not None)


def _assemble(
    problem: Problem,
    resolver: Resolver,
    attempt: _Attempt,
    stop: Stop | None,
    setup_time: float,
    way: str,
    digests: dict[str, str | None],
) -> Maneuver:
    setup = resolver.setup
    meshes = {
        obstacle.name: mesh_record(obstacle.file, len(pieces.pieces))
        for obstacle, pieces in zip(problem.obstacle, setup.monitor.obstacles, strict=True)
        if obstacle.shape == "mesh"
    }
    manifest = {
        "schema_version": SCHEMA_VERSION,
        "problem": problem.to_dict(),
        "problem_digests": digests,
        "arm": setup.arm.record(),
        "curve": attempt.resolver.setup.layout.record(),
        "status": "solved" if stop is None else "blocked",
        # That of the last whole row: an interrupt may have come before the next.
        "reached": float(attempt.rows["progress"][-1]),
        "blocked_by": [] if stop is None else list(stop.names),
        "stop": None if stop is None else stop.to_dict(),
        "way_out": way,
        "recovered": [
            {"pair": pair, "distance": apart} for pair, apart in sorted(_too_near(resolver).items())
        ],
        "method": problem.method.name,
        "solver": resolver.solver,
        "setup_time": setup_time,
        "directory": str((problem.source.parent if problem.source else Path.cwd()).resolve()),
        "meshes": meshes,
        "versions": recorded_versions(),
        "certificate": None,
        # Of the Jacobian of eq. (26) in the last step, where the method reveals it: eq. (6) holds at full row rank.
        "jacobian_rank": resolver.rank,
        "clearance_rows": attempt.clearance_rows,
    }
    arrays: dict[str, Any] = {name: np.asarray(rows, dtype=float) for name, rows in attempt.rows.items()}
    rotation = arrays.pop("tip_target_rotation")
    arrays |= setup.arm.recorded(arrays.pop("configuration"), arrays.pop("quantities"))
    arrays["control_vertices"] = arrays["control_vertices"].reshape(len(rotation), -1, 3)
    return Maneuver(
        **arrays,
        phase_names=np.array(list(resolver.phases)),
        manifest=manifest,
        tip_target_rotation=rotation if setup.task.turns == "orientation" else None,
        tip_target_pointing=rotation[:, :, 2] if setup.task.turns == "pointing" else None,
    )


def _too_near(resolver: Resolver) -> dict[str, float]:
    """Return the pairs below their clearance in the home pose that the method drives apart, and their distances, m."""
    names, kind = resolver.setup.monitor.names, resolver.setup.arm.bodies.kind
    found: dict[str, float] = {}
    for pair, distance in resolver.too_near(resolver.setup.home_state()).items():
        name = names.clearance(pair).removeprefix(f"clearance: {kind} ").replace(f"/ {kind} ", "/ ")
        found[name] = min(found.get(name, np.inf), distance)
    return found
