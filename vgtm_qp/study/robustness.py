"""Random scenes of every module: how many are solved, what breaks, and what stops the rest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from time import process_time

from matplotlib.figure import Figure

from vgtm_qp.comparison.tables import markdown_table, wilson_interval
from vgtm_qp.maneuver.solve import solve
from vgtm_qp.study.drawing import label, panels, select
from vgtm_qp.study.scenes import random_scene
from vgtm_qp.study.workers import Row, Task

SEED = 1991


def tasks(short: bool, *, scenes: int | None = None, seed: int = SEED, steps: int = 30) -> list[Task]:
    """Return one task a scene."""
    count = scenes if scenes is not None else 10 if short else 1000
    return [{"seed": seed, "number": k, "steps": steps} for k in range(count)]


def run(seed: int, number: int, steps: int) -> Row:
    """Solve one scene and return its row.

    Keys: what the scene is (``module``, ``bays``, ``cubes``, ``directed``, ``reachable``), ``status``, the part of the
    path that was ``reached``, ``states``, ``failures`` of the independent check, ``stop``, ``blocked_by``, ``way_out``
    and CPU ``seconds``.
    """
    scene = random_scene(seed, number, steps=steps)
    problem = scene.problem
    truss = problem.to_dict()["truss"]
    started = process_time()
    maneuver = solve(problem)
    summary, stop = maneuver.summary(), maneuver.manifest["stop"]
    return {
        "module": truss["module"],
        "bays": truss["bays"],
        "cubes": len(problem.obstacle),
        "directed": "pointing" in problem.end_effector.track,
        "reachable": scene.reachable,
        **{key: summary[key] for key in ("status", "reached", "failures", "blocked_by", "way_out")},
        "states": len(maneuver.time),
        "stop": stop["kind"] if stop else "",
        "seconds": process_time() - started,
    }


def draw(rows: Sequence[Row]) -> Figure:
    """Draw how far the scenes that were not solved came, by what stopped them."""
    figure, axes = panels(1, 1, width=5.6, height=3.2)
    kinds = sorted({row["stop"] for row in rows if row["stop"]}) or ["nothing"]
    for k, kind in enumerate(kinds):
        reached = sorted(row["reached"] for row in select(rows, stop=kind))
        places = [k + 0.6 * i / len(reached) for i in range(len(reached))]
        axes[0].plot(reached, places, "o", markersize=3, label=kind)
    axes[0].set_yticks(range(len(kinds)), kinds)
    axes[0].set_xlim(0.0, 1.0)
    label(axes[0], "part of the path", "stopped by")
    return figure


def text(rows: Sequence[Row]) -> str:
    """Give what was solved, what broke, and what stopped the rest."""
    if not rows:
        return "No scene was run."
    broken = sum(bool(row["failures"]) for row in rows)
    groups = {
        "goal reachable by construction": select(rows, reachable=True),
        "any goal": select(rows, reachable=False),
        "with a direction of the tip": select(rows, directed=True),
    }
    for module in sorted({row["module"] for row in rows}):
        groups[module] = select(rows, module=module)
    parts = [
        f"Seed {rows[0]['seed']}, scenes 0 to {max(row['number'] for row in rows)}, {rows[0]['steps']} steps each. "
        f"{share_of(rows)} solved; states that break a tolerance by the independent check: in {broken} scenes.",
        markdown_table(("", "solved"), [(name, share_of(some)) for name, some in groups.items()]),
    ]
    solved = select(rows, status="solved")
    for words, key, some in (
        ("Solved by another way out", "way_out", solved),
        ("The others stopped by", "stop", rows),
    ):
        counts = Counter(row[key] for row in some if row[key]).most_common()
        if counts:
            parts.append(f"{words}: {', '.join(f'{name} {count}' for name, count in counts)}.")
    return "\n\n".join(parts)


def share_of(rows: Sequence[Row]) -> str:
    """Return how many rows were solved, of how many, with the interval of 95 % for the share."""
    if not rows:
        return "none of 0"
    done = len(select(rows, status="solved"))
    low, high = wilson_interval(done, len(rows))
    return f"{done} of {len(rows)} ({100 * low:.1f}-{100 * high:.1f} %)"
