"""Random scenes of every module, solved by this package and, where asked for, by IPOPT step by step as a yardstick."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from time import process_time
from typing import Any

from matplotlib.figure import Figure

from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.maneuver.solve import solve
from vgtm_qp.methods.compare import markdown_table
from vgtm_qp.step.resolver import Resolver
from vgtm_qp.study.drawing import label, panels
from vgtm_qp.study.ipopt import IpoptStepper
from vgtm_qp.study.scenes import Scene, random_scene
from vgtm_qp.study.statistics import wilson_interval
from vgtm_qp.study.workers import Row, Task

TITLE = "Robustness: random scenes of every module"
TIMED = False
SEED = 1991

_THROUGH = 1.0 - 1e-9


def tasks(
    short: bool, *, scenes: int | None = None, seed: int = SEED, steps: int = 30, ipopt: bool = False
) -> list[Task]:
    """Return one task a scene."""
    count = scenes if scenes is not None else 10 if short else 1000
    return [{"seed": seed, "number": k, "steps": steps, "ipopt": ipopt} for k in range(count)]


def run(seed: int, number: int, steps: int, ipopt: bool) -> Row:
    """Solve one scene and return its row.

    Keys: what the scene is (``module``, ``bays``, ``cubes``, ``directed``, ``reachable``); what came of it
    (``status``, ``reached``, ``states``, ``failures`` of the independent check, ``stop``, ``blocked_by``, CPU
    ``seconds``); and ``ipopt_reached``, ``ipopt_seconds``.
    """
    scene = random_scene(seed, number, steps=steps)
    started = process_time()
    maneuver = solve(scene.problem)
    manifest = maneuver.manifest
    stop = manifest["stop"]
    row = _describe(scene) | {
        "status": manifest["status"],
        "reached": manifest["reached"],
        "states": len(maneuver.time),
        "failures": list(maneuver.certificate.failures()) if maneuver.certificate else ["not verified"],
        "stop": stop["kind"] if stop else "",
        "blocked_by": manifest["blocked_by"],
        "way_out": manifest["way_out"],
        "seconds": process_time() - started,
    }
    if ipopt:
        started = process_time()
        resolver = Resolver(scene.problem)
        plan = make_plan(scene.problem, *resolver.tip())
        _, values = IpoptStepper(resolver.arm).run(plan)
        row["ipopt_reached"] = (values[-1] - plan.path.start) / (plan.path.end - plan.path.start)
        row["ipopt_seconds"] = process_time() - started
    return row


def _describe(scene: Scene) -> dict[str, Any]:
    truss = scene.problem.to_dict()["truss"]
    return {
        "module": truss["module"],
        "bays": truss["bays"],
        "cubes": len(scene.problem.obstacle),
        "directed": "pointing" in scene.problem.end_effector.track,
        "reachable": scene.reachable,
    }


def draw(rows: Sequence[Row]) -> Figure:
    """Draw how far the scenes that were not solved came, by what stopped them."""
    figure, axes = panels(1, 1, width=5.6, height=3.2)
    kinds = sorted({row["stop"] for row in rows if row["stop"]}) or ["nothing"]
    for k, kind in enumerate(kinds):
        reached = sorted(row["reached"] for row in rows if row["stop"] == kind)
        places = [k + 0.6 * i / len(reached) for i in range(len(reached))]
        axes[0].plot(reached, places, "o", markersize=3, label=kind)
    axes[0].set_yticks(range(len(kinds)), kinds)
    axes[0].set_xlim(0.0, 1.0)
    label(axes[0], "part of the path", "stopped by")
    return figure


def text(rows: Sequence[Row]) -> str:
    """Give what was solved, what broke, what stopped the rest, and the comparison with IPOPT."""
    if not rows:
        return "No scene was run."
    broken = sum(bool(row["failures"]) for row in rows)
    parts = [
        f"Seed {rows[0]['seed']}, scenes 0 to {max(row['number'] for row in rows)}, {rows[0]['steps']} steps each. "
        f"{_of(rows)} solved; states that break a tolerance by the independent check: in {broken} scenes.",
        markdown_table(
            ("", "solved"),
            [
                ("goal reachable by construction", _of([row for row in rows if row["reachable"]])),
                ("any goal", _of([row for row in rows if not row["reachable"]])),
                ("with a direction of the tip", _of([row for row in rows if row["directed"]])),
                *(
                    (module, _of([row for row in rows if row["module"] == module]))
                    for module in sorted({row["module"] for row in rows})
                ),
            ],
        ),
    ]
    ways = Counter(row["way_out"] for row in rows if row["way_out"] and row["status"] == "solved")
    if ways:
        parts.append(
            "Solved by another way out: " + ", ".join(f"{way} {n}" for way, n in ways.most_common()) + "."
        )
    stops = Counter(row["stop"] for row in rows if row["stop"])
    if stops:
        parts.append(
            "The others stopped by: " + ", ".join(f"{kind} {n}" for kind, n in stops.most_common()) + "."
        )
    measured = [row for row in rows if "ipopt_reached" in row]
    if measured:
        theirs = [row for row in measured if row["ipopt_reached"] >= _THROUGH]
        ours = [row for row in measured if row["status"] == "solved"]
        seconds = [sum(row[key] for row in measured) for key in ("seconds", "ipopt_seconds")]
        parts.append(
            f"IPOPT step by step comes through in {len(theirs)} of {len(measured)}; of these {_of(theirs)} are solved "
            f"here, and {len([row for row in ours if row['ipopt_reached'] < _THROUGH])} more. "
            f"CPU time {seconds[0]:.0f} s against {seconds[1]:.0f} s."
        )
    return "\n\n".join(parts)


def _of(rows: Sequence[Row]) -> str:
    if not rows:
        return "none of 0"
    done = sum(row["status"] == "solved" for row in rows)
    low, high = wilson_interval(done, len(rows))
    return f"{done} of {len(rows)} ({100 * low:.1f}-{100 * high:.1f} %)"
