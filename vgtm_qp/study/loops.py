"""Control loops with random goals among obstacles at rest and in motion, checked independently."""

from __future__ import annotations

from collections.abc import Sequence
from time import process_time
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vgtm_qp.arm.arm import Pose
from vgtm_qp.arrays import Array
from vgtm_qp.comparison.tables import markdown_table
from vgtm_qp.errors import ProblemError
from vgtm_qp.maneuver.log import Log
from vgtm_qp.methods import Resolver
from vgtm_qp.problem import Problem
from vgtm_qp.rotation import rotation_from_vector, vector_from_rotation
from vgtm_qp.step.step import Step, StepStatus
from vgtm_qp.step.stops import Stop, StopKind
from vgtm_qp.study.drawing import label, legend_above, panels, select
from vgtm_qp.study.robustness import SEED, features, kind_of
from vgtm_qp.study.varied import Arms, varied_scene
from vgtm_qp.study.workers import Row, Task
from vgtm_qp.verify import verify

_PERIODS = (0.02, 0.05, 0.1, 0.3)
"""Durations of a loop's steps, s."""
_FURTHEST = 0.4
"""Distance of goals from the tip's home, as a share of the arm's height."""
_PATIENCE = 25
"""Greatest number of steps before another goal is set."""
_GLIDES = 0.5
"""Share of goals that glide to their place instead of being set there; all do if a tip may not be late."""
_STRIDE = (1e-4, 1e-2)
"""Least and greatest motion of a gliding goal in a step, as shares of the arm's height."""


def tasks(
    short: bool, *, scenes: int | None = None, seed: int = SEED, steps: int = 250, arms: Arms = "trusses"
) -> list[Task]:
    """Return one task a loop of so many steps."""
    count = scenes if scenes is not None else 3 if short else 400
    scene = {"seed": seed, "steps": min(steps, 40) if short else steps, "arms": arms}
    return [{**scene, "number": k} for k in range(count)]


def run(seed: int, number: int, steps: int, arms: Arms = "trusses") -> Row:
    """Run one loop and return its row.

    Keys: ``module``, ``features`` of the scene; numbers of steps ``reached``, ``slowed`` and ``blocked``;
    number of ``goals`` that were met; ``failures`` of the independent check of all states and motions; and
    CPU ``seconds`` of the steps alone.
    """
    problem = varied_scene(seed, number, arms=arms)
    found: Row = {"module": kind_of(problem), "features": features(problem)}
    random, started = np.random.default_rng([seed, number, 2]), process_time()
    dt = float(random.choice(_PERIODS))
    if {"limited accelerations", "a moving base"} <= set(found["features"]):
        # Such an arm looks ahead until its base rests: in short steps that takes seconds.
        dt = _PERIODS[-1]
    counts = dict.fromkeys((*(str(status) for status in StepStatus), "goals"), 0)
    try:
        resolver = Resolver(problem)
    except ProblemError:
        return {**found, **counts, "failures": [], "seconds": 0.0}
    log, targets = Log(resolver, _pose(resolver)), list[Pose]()
    goals = _Goals(resolver, random)
    for k in range(steps):
        goal = goals.next()
        path = resolver.setup.task.path_to(resolver.tip(), **goal)
        with log.clock():
            step = resolver.step(**goal, dt=dt)
        counts[step.status] += 1
        counts["goals"] += goals.note(step)
        if step.moved:
            # An arm that brakes is still moving to the goal before.
            targets.append(_pose(resolver) if step.braked else path.pose(step.progress))
            log.add(step, targets[-1], (k + 1) / (steps + 1))
    seconds = process_time() - started
    if not targets:
        return {**found, **counts, "failures": [], "seconds": seconds}
    certificate = verify(log.maneuver(problem_along(problem, targets), Stop(StopKind.INTERRUPTED)))
    return {**found, **counts, "failures": certificate.failures(), "seconds": seconds}


class _Goals:
    """Random goals of a loop: some are set at once, some move to their place in even steps."""

    def __init__(self, resolver: Resolver, random: np.random.Generator) -> None:
        self._resolver, self._random = resolver, random
        self._home, self._rotation = resolver.tip()
        self._start = self._end = self._home
        self._shares: Array = np.zeros(0)
        self._left = 0
        self._pointing, self._turn = self._rotation[:, 2], np.zeros(3)

    def next(self) -> dict[str, Any]:
        """Return the arguments of the next step."""
        if not self._left:
            self._set()
        position = self._start + self._shares[-self._left] * (self._end - self._start)
        task = self._resolver.setup.task
        goal = {"position": position, "pointing": self._pointing, "rotation_vector": None}
        if not len(task.axes):
            goal["position"] = None
        if task.turns != "pointing":
            goal["pointing"] = None
        if task.turns == "orientation":
            goal["rotation_vector"] = self._turn
        return goal

    def _set(self) -> None:
        random, arm = self._random, self._resolver.setup.arm
        self._left = int(random.integers(1, _PATIENCE + 1))
        way = random.normal(size=3)
        way *= _FURTHEST * arm.height * random.random() / np.linalg.norm(way)
        self._start = self._resolver.tip()[0]
        way += self._home - self._start
        self._shares = np.ones(self._left)
        if self._resolver.setup.tip_mode == "hard" or random.random() < _GLIDES:
            stride = arm.height * np.exp(random.uniform(*np.log(_STRIDE)))
            way *= min(1.0, self._left * stride / float(np.linalg.norm(way)))
            self._shares = np.arange(1, self._left + 1) / self._left
        self._end = self._start + way
        tilt = 0.3 * random.normal(size=3)
        self._pointing = self._rotation[:, 2] + tilt
        self._turn = vector_from_rotation(rotation_from_vector(tilt) @ self._rotation)

    def note(self, step: Step) -> bool:
        """Take note of the step towards the goal of `next`, and return whether it met a goal."""
        met = step.status is StepStatus.REACHED and bool(self._shares[-self._left] == 1.0)
        self._left = 0 if met else self._left - 1
        return met


def _pose(resolver: Resolver) -> Pose:
    return Pose(*resolver.tip())


def problem_along(problem: Problem, targets: Sequence[Pose]) -> Problem:
    """Return the problem with the path of a loop through `targets`, which is known only after it."""
    track = problem.to_dict()["end_effector"]["track"]
    waypoints = [
        {
            "time": float(k + 1),
            "position": target.position.tolist(),
            **({"pointing": target.rotation[:, 2].tolist()} if "pointing" in track else {}),
            **(
                {"rotation_vector": vector_from_rotation(target.rotation).tolist()}
                if "orientation" in track
                else {}
            ),
        }
        for k, target in enumerate(targets)
    ]
    return problem.replace({"maneuver": {"steps": len(targets), "waypoint": waypoints}})


def draw(rows: Sequence[Row]) -> Figure:
    """Draw how the steps of each loop ended."""
    figure, axes = panels(1, 1, width=5.6, height=3.0)
    ordered = sorted(rows, key=lambda row: (row["reached"], row["slowed"]))
    below = np.zeros(len(ordered))
    for status in StepStatus:
        counts = np.array([row[status] for row in ordered], dtype=float)
        axes[0].fill_between(range(len(ordered)), below, below + counts, step="mid", label=str(status))
        below += counts
    label(axes[0], "loops, by steps that reached their goal", "steps", legend=False)
    axes[0].xaxis.set_major_locator(MaxNLocator(integer=True))
    legend_above(axes[0], 3)
    return figure


def text(rows: Sequence[Row]) -> str:
    """Give how the steps ended, and what broke."""
    if not rows:
        return "No loop was run."
    steps = {status: sum(row[status] for row in rows) for status in StepStatus}
    count, goals = sum(steps.values()), sum(row["goals"] for row in rows)
    seconds = sum(row["seconds"] for row in rows)
    broken = [row for row in rows if row["failures"]]
    lines = [
        (module, *(str(sum(row[status] for row in some)) for status in StepStatus), str(len(some)))
        for module in sorted({row["module"] for row in rows})
        for some in [select(rows, module=module)]
    ]
    parts = [
        f"Seed {rows[0]['seed']}, {len(rows)} loops, {count} steps: "
        + ", ".join(f"{steps[status]} {status}" for status in StepStatus)
        + f"; {goals} goals met; {1e3 * seconds / max(count, 1):.1f} ms of CPU a step, set-up included. "
        f"Loops with a state, or a way between two, that breaks a tolerance by the independent check: {len(broken)}.",
        markdown_table(("", *map(str, StepStatus), "loops"), lines),
    ]
    parts += [f"Loop {row['number']}: {'; '.join(row['failures'][:3])}" for row in broken]
    return "\n\n".join(parts)
