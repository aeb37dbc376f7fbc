"""The maneuver loop: step after step along the plan until it is done or no safe step is left."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import ProblemError
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.maneuver.plan import Plan, make_plan
from vgtm_qp.maneuver.retries import DeadEnd, retries
from vgtm_qp.methods import make_resolver
from vgtm_qp.problem import Problem
from vgtm_qp.problem.problem import check_is_problem
from vgtm_qp.result.manifest import make_manifest, mesh_record
from vgtm_qp.step.checks import check_problem
from vgtm_qp.step.mover import Mover
from vgtm_qp.step.state import State
from vgtm_qp.step.step import Step, StepStatus
from vgtm_qp.step.stops import Stop, StopKind
from vgtm_qp.verify import verify as check

Array = NDArray[np.float64]

_STALLED_PROGRESS = 1e-3
_STALLED_STEPS = 10

Progress = Callable[[float, Step], None]


@dataclass
class _Record:
    """The rows of the result, grown step by step."""

    rows: dict[str, list[Any]] = field(default_factory=dict)

    def add(self, **values: Any) -> None:
        for name, value in values.items():
            self.rows.setdefault(name, []).append(value)

    def array(self, name: str) -> Array:
        return np.asarray(self.rows[name], dtype=float)


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
    ProblemError, TrussError, SolverError
        The problem cannot be set up, or is not a Problem; no step was made.
    """
    check_is_problem(problem)
    started = perf_counter()
    resolver = make_resolver(problem)
    mistakes = check_problem(problem, resolver.setup)
    if mistakes:
        raise ProblemError(str(problem.source or problem.name), mistakes)
    plan = make_plan(problem, *resolver.tip())
    record = _Record()
    _add_state(record, resolver, plan, 0.0, 0.0, dict.fromkeys(resolver.phases, 0.0))
    setup_time = perf_counter() - started

    way = ""
    try:
        stop = _run(resolver, plan, record, progress)
        if stop is not None:
            value = plan.path.start + record.rows["progress"][-1] * (plan.path.end - plan.path.start)
            dead_end = DeadEnd(
                stop,
                resolver.state.control_vertices,
                resolver.setup.arm.height,
                plan.path.at(value).velocity,
            )
            way, record, stop = _retry(problem, resolver, record, dead_end, progress)
    except KeyboardInterrupt:
        stop = Stop(StopKind.INTERRUPTED)
    maneuver = _assemble(problem, resolver, record, stop, setup_time, way)
    return maneuver.with_certificate(check(maneuver)) if verify else maneuver


def _retry(
    problem: Problem, first: Mover, record: _Record, dead_end: DeadEnd, progress: Progress | None
) -> tuple[str, _Record, Stop | None]:
    """Return name, record and stop of the attempt that comes furthest; the name is empty for the first attempt."""
    best: tuple[str, _Record, Stop | None] = ("", record, dead_end.stop)
    for name, other in retries(problem, dead_end):
        resolver = first.again(other)
        if resolver is None:
            break
        plan = make_plan(other, *resolver.tip())
        tried = _Record()
        _add_state(tried, resolver, plan, 0.0, 0.0, dict.fromkeys(resolver.phases, 0.0))
        found = _run(resolver, plan, tried, progress)
        if found is None:
            return name, tried, None
        if tried.rows["progress"][-1] > best[1].rows["progress"][-1] + _STALLED_PROGRESS:
            best = (name, tried, found)
    return best


def _run(resolver: Mover, plan: Plan, record: _Record, progress: Progress | None) -> Stop | None:
    """Step along the plan; return why the arm stopped for good, or None if it reached the end."""
    value, start, end = plan.path.start, plan.path.start, plan.path.end
    stalled, last = 0, float(plan.marks[-1])
    keeps_moving = bool(np.isfinite(resolver.setup.arm.acceleration[resolver.setup.arm.actuators]).any())
    while value < last:
        aim, dt = plan.next_mark(value, keeps_moving=keeps_moving)
        before, known, clock = resolver.state, dict(resolver.phases), perf_counter()
        step = resolver.follow(plan.path, value, aim, dt=dt)
        seconds = perf_counter() - clock
        if step.status is StepStatus.BLOCKED:
            return resolver.explain(plan.path, value, aim, dt=dt, last=step)
        stop = _given_up(resolver, plan, value, aim, dt, step, before)
        if stop is not None and step.left_path:
            # From here on the arm would brake off the path; those states do not belong to the maneuver.
            return stop
        value = aim if step.status is StepStatus.REACHED else value + step.progress * (aim - value)
        phases = {name: total - known[name] for name, total in resolver.phases.items()}
        _add_state(record, resolver, plan, value, seconds, phases)
        if stop is not None:
            _come_to_rest(resolver, plan, record, value)
            return stop
        stalled = stalled + 1 if step.progress < _STALLED_PROGRESS else 0
        if stalled >= _STALLED_STEPS:
            return resolver.explain(plan.path, value, aim, dt=dt, last=step)
        if progress is not None:
            progress((value - start) / (end - start), step)
    return None


def _given_up(
    resolver: Mover, plan: Plan, value: float, mark: float, dt: float, step: Step, before: State
) -> Stop | None:
    """Return why the maneuver ends with a step in which the arm braked; None if it goes on afterwards.

    A hard tip may not be late, so braking ends it; any tip but an elastic one ends when it leaves the path.
    """
    mode = resolver.setup.tip_mode
    if not step.braked or mode == "elastic":
        return None
    if mode != "hard" and not step.left_path:
        return None
    return resolver.explain(plan.path, value, mark, dt=dt, last=step, state=before)


def _come_to_rest(resolver: Mover, plan: Plan, record: _Record, value: float) -> None:
    """Record the steps in which the arm comes to rest on its path."""
    end = plan.path.end
    while value < end:
        known, clock = dict(resolver.phases), perf_counter()
        step = resolver.brake(plan.path, value, end)
        if step is None or step.left_path:
            return
        value += step.progress * (end - value)
        phases = {name: total - known[name] for name, total in resolver.phases.items()}
        _add_state(record, resolver, plan, value, perf_counter() - clock, phases)


def _add_state(
    record: _Record, resolver: Mover, plan: Plan, value: float, seconds: float, phases: dict[str, float]
) -> None:
    state, setup = resolver.state, resolver.setup
    position, rotation = resolver.tip()
    target = plan.path.at(value)
    record.add(
        time=state.time,
        configuration=state.q,
        quantities=state.quantities,
        control_vertices=state.control_vertices,
        tip_position=position,
        tip_rotation=rotation,
        tip_target_position=target.position,
        tip_target_rotation=target.rotation,
        clearance=setup.least_clearance(state.q, state.time, "obstacles"),
        self_clearance=setup.least_clearance(state.q, state.time, "members"),
        progress=(value - plan.path.start) / (plan.path.end - plan.path.start),
        step_time=seconds,
        phase_time=list(phases.values()),
    )


def _assemble(
    problem: Problem,
    resolver: Mover,
    record: _Record,
    stop: Stop | None,
    setup_time: float,
    way: str,
) -> Maneuver:
    setup = resolver.setup
    task = setup.task
    meshes = {
        obstacle.name: mesh_record(obstacle.file, len(pieces.pieces))
        for obstacle, pieces in zip(problem.obstacle, setup.monitor.obstacles, strict=True)
        if obstacle.shape == "mesh"
    }
    reached = float(record.rows["progress"][-1])
    manifest = make_manifest(
        problem.to_dict(),
        setup.arm.record(),
        status="solved" if stop is None else "blocked",
        reached=reached,
        blocked_by=() if stop is None else stop.names,
        stop=None if stop is None else stop.to_dict(),
        way_out=way,
        recovered=_too_near(resolver),
        method=problem.method.name,
        solver=resolver.solver,
        setup_time=setup_time,
        directory=Path(problem.source).parent if problem.source else Path.cwd(),
        meshes=meshes,
    )
    # Of the Jacobian of eq. (26) in the last step, where the method reveals it: eq. (6) holds at full row rank only.
    manifest["jacobian_rank"] = resolver.rank
    rotation = record.array("tip_target_rotation")
    count = len(record.rows["time"])
    return Maneuver(
        time=record.array("time"),
        control_vertices=record.array("control_vertices").reshape(count, -1, 3),
        tip_position=record.array("tip_position"),
        tip_rotation=record.array("tip_rotation"),
        tip_target_position=record.array("tip_target_position"),
        clearance=record.array("clearance"),
        self_clearance=record.array("self_clearance"),
        progress=record.array("progress"),
        step_time=record.array("step_time"),
        phase_names=np.array(list(resolver.phases)),
        phase_time=record.array("phase_time"),
        manifest=manifest,
        tip_target_rotation=rotation if task.turns == "orientation" else None,
        tip_target_pointing=rotation[:, :, 2] if task.turns == "pointing" else None,
        **setup.arm.recorded(record.array("configuration"), record.array("quantities")),
    )


def _too_near(resolver: Mover) -> dict[str, float]:
    """Return the pairs below their clearance in the home pose that the method drives apart, and their distances, m."""
    names, kind = resolver.setup.monitor.names, resolver.setup.arm.bodies.kind
    found: dict[str, float] = {}
    for pair, distance in resolver.too_near(resolver.setup.home_state()).items():
        name = names.clearance(pair).removeprefix(f"clearance: {kind} ").replace(f"/ {kind} ", "/ ")
        found[name] = min(found.get(name, np.inf), distance)
    return found
