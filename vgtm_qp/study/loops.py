"""Control loops with random goals among obstacles at rest and in motion, checked independently."""

from __future__ import annotations

from collections.abc import Sequence
from time import process_time, thread_time
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from vgtm_qp.arrays import Array
from vgtm_qp.comparison.tables import markdown_table
from vgtm_qp.errors import GoalError, ProblemError
from vgtm_qp.maneuver.recording import Recording
from vgtm_qp.methods import Resolver
from vgtm_qp.rotation import rotation_from_vector, vector_from_rotation
from vgtm_qp.step.step import Step, StepStatus
from vgtm_qp.study.disturbance import Disturbance
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
    short: bool,
    *,
    scenes: int | None = None,
    seed: int = SEED,
    steps: int = 250,
    arms: Arms = "trusses",
    changes: float = 0.0,
) -> list[Task]:
    """Return one task a loop of so many steps; before a share of these the scene `changes`.

    GoalError if that is no share.
    """
    if not 0.0 <= changes <= 1.0:
        raise GoalError(f"--changes must be from 0 to 1, not {changes:g}")
    count = scenes if scenes is not None else 3 if short else 400
    scene = {"seed": seed, "steps": min(steps, 40) if short else steps, "arms": arms}
    more = {"changes": changes} if changes else {}
    return [{**scene, **more, "number": k} for k in range(count)]


def run(seed: int, number: int, steps: int, arms: Arms = "trusses", changes: float = 0.0) -> Row:
    """Run one loop and return its row.

    Keys: ``module``, ``features`` of the scene; numbers of steps ``reached``, ``slowed`` and ``blocked``;
    number of ``goals`` that were met; ``failures`` of the independent check of all states and motions; CPU ``seconds``
    of the steps alone; and where the scene changes those of ``Disturbance.row``.
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
    recording, goals = Recording(resolver, problem), _Goals(resolver, random)
    disturbance, times = (
        Disturbance(resolver, np.random.default_rng([seed, number, 3]), changes),
        list[float](),
    )
    for _ in range(steps):
        disturbance.before_step()
        goal, clock = goals.next(), thread_time()
        step = resolver.step(**goal, dt=dt)
        times.append(thread_time() - clock)
        counts[step.status] += 1
        counts["goals"] += goals.note(step)
    seconds = process_time() - started
    failures = verify(recording.maneuver()).failures() if len(recording) else []
    row = {**found, **counts, "failures": failures, "seconds": seconds}
    return {**row, **disturbance.row(float(np.median(times)))} if changes else row


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
    if rows[0].get("changes") is not None:
        parts.append(
            f"{sum(row['changes'] for row in rows)} changes of the scene, in the middle of a loop at "
            f"{_middle(rows, 'changes', 'change_cost'):.2g} of its median step's CPU time; "
            f"{sum(row['dear_changes'] for row in rows)} at more than two of them. "
            f"{sum(row.get('carried', 0) for row in rows)} bodies taken up at the tip or let go, at "
            f"{_middle(rows, 'carried', 'carry_cost'):.2g}."
        )
    parts += [f"Loop {row['number']}: {'; '.join(row['failures'][:3])}" for row in broken]
    return "\n\n".join(parts)


def _middle(rows: Sequence[Row], count: str, cost: str) -> float:
    """Return the median cost of those loops in which something was changed."""
    costs = [row[cost] for row in rows if row.get(count)]
    return float(np.median(costs)) if costs else 0.0
