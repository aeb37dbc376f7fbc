"""Success of every method over seeded random scenes of growing density, with confidence intervals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vgtm_qp.comparison.compare import run_method
from vgtm_qp.comparison.tables import crossed_table, wilson_interval
from vgtm_qp.geometry import shapes
from vgtm_qp.problem import Problem
from vgtm_qp.study.arms import bending_problem, built_truss
from vgtm_qp.study.drawing import label, legend_above, panels, select
from vgtm_qp.study.scenes import is_clear
from vgtm_qp.study.workers import Row, Task
from vgtm_qp.view.style import MARKS

SEED = 1991

_METHODS = (
    "qp",
    "qp-none",
    "qp-parallel",
    "pseudoinverse-corrected",
    "pseudoinverse-obstacles",
    "curve-pseudoinverse-corrected",
    "curve-pseudoinverse-obstacles",
)
_BAYS = 5
_TRIES = 400


def tasks(short: bool) -> list[Task]:
    """Return one task a scene; all methods meet the same scenes."""
    densities = (0, 4) if short else (0, 2, 4, 6, 8, 12)
    count, steps = (2, 20) if short else (24, 40)
    methods = list(_METHODS[::2] if short else _METHODS)
    return [
        {"seed": SEED, "cubes": density, "number": k, "steps": steps, "methods": methods}
        for density in densities
        for k in range(count)
    ]


def scene(seed: int, cubes: int, number: int, steps: int) -> Problem:
    """Return scene `number` with that many cubes: the same for the same arguments, on any machine.

    The goal lies aside of the home tip and somewhat below; the cubes, 0.25 to 0.7 m, stand about the arm, clear of
    its home pose and of the goal. A scene need not have a solution.
    """
    random = np.random.default_rng([seed, cubes, number])
    azimuth, aside = random.uniform(0.0, 2.0 * np.pi), random.uniform(0.15, 0.45)
    goal = (aside * np.cos(azimuth), aside * np.sin(azimuth), -random.uniform(0.3, 0.7) * aside)
    problem = bending_problem(_BAYS, steps=steps, goal=goal)
    truss = built_truss(problem)
    target = np.array(problem.maneuver.waypoint[0].position)  # type: ignore[union-attr]
    found: list[dict[str, Any]] = []
    for _ in range(_TRIES):
        if len(found) == cubes:
            break
        edge = float(random.uniform(0.25, 0.7))
        angle, radius = random.uniform(0.0, 2.0 * np.pi), random.uniform(0.6, 1.8)
        center = [radius * np.cos(angle), radius * np.sin(angle), random.uniform(0.3, 1.05) * truss.height]
        if np.linalg.norm(np.maximum(np.abs(target - center) - edge / 2, 0.0)) < 0.6:
            continue
        if not is_clear(truss, shapes.box("cube", center, edge), truss.home):
            continue
        name = f"cube {len(found) + 1}"
        found.append({"name": name, "shape": "box", "center": [float(c) for c in center], "size": edge})
    return problem.replace({"name": f"clutter {seed}-{cubes}-{number}", "obstacle": found})


def run(seed: int, cubes: int, number: int, steps: int, methods: list[str]) -> Row:
    """Return success of each method, 1 mm of drift allowed, share of the path, and what stopped it."""
    return successes(scene(seed, cubes, number, steps), methods)


def successes(problem: Problem, methods: Sequence[str]) -> Row:
    """Return the result of :func:`run` for a problem."""
    row: Row = {"placed": len(problem.obstacle)}
    for method in methods:
        found, _ = run_method(problem, method)
        row[f"{method}: kept"] = found.kept
        row[f"{method}: reached"] = found.reached
        row[f"{method}: reason"] = found.reason
    return row


def draw(rows: Sequence[Row]) -> Figure:
    """Draw the success of each method against the number of cubes, with 95 % intervals."""
    figure, axes = panels(1, 1, width=5.6, height=3.2)
    densities = sorted({row["cubes"] for row in rows})
    methods = rows[0]["methods"] if rows else []
    for k, (mark, method) in enumerate(zip(MARKS, methods, strict=False)):
        counts = [_count(rows, method, density) for density in densities]
        shares = np.array([done / count for done, count in counts])
        low, high = np.transpose([wilson_interval(*count) for count in counts])
        style: Any = {"marker": mark, "markersize": 4, "linestyle": "--", "capsize": 2, "linewidth": 0.9}
        axes[0].errorbar(
            np.array(densities) + 0.08 * (k - len(methods) / 2),
            shares,
            np.maximum([shares - low, high - shares], 0.0),
            label=method,
            **style,
        )
    axes[0].set_ylim(-0.03, 1.03)
    label(axes[0], "cubes", "part of the scenes solved", legend=False)
    legend_above(axes[0])
    return figure


def text(rows: Sequence[Row]) -> str:
    """Give successes with their intervals."""
    return crossed("Five octahedral bays", rows)


def crossed(arm: str, rows: Sequence[Row]) -> str:
    """Give the successes with their intervals; `arm` names the arm of the scenes in words."""
    if not rows:
        return "No scene was run."
    methods = rows[0]["methods"]
    densities = sorted({row["cubes"] for row in rows})
    table = crossed_table(
        ("solved (95 % interval)",),
        {density: f"{density} cubes, of {_count(rows, methods[0], density)[1]}" for density in densities},
        {
            (method,): {density: _cell(*_count(rows, method, density)) for density in densities}
            for method in methods
        },
    )
    return (
        f"{arm}, seed {rows[0]['seed']}, scenes numbered from 0 at each density. Solved: the whole path, every stroke "
        "and every clearance kept at and between the states, members and tip off by at most 1 mm. No scene is known to "
        f"have a solution, so that the QP's misses are not all its own.\n\n{table}"
    )


def _cell(done: int, count: int) -> str:
    low, high = wilson_interval(done, count)
    return f"{done} ({100 * low:.0f}-{100 * high:.0f} %)"


def _count(rows: Sequence[Row], method: str, density: int) -> tuple[int, int]:
    mine = select(rows, cubes=density)
    return sum(bool(row[f"{method}: kept"]) for row in mine), len(mine)
