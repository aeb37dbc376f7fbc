"""Random scenes of every module, solved by this package and, where asked for, by IPOPT step by step as a yardstick."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from time import process_time
from typing import Any

from matplotlib.figure import Figure

from vgtm_qp.comparison.markdown import markdown_table
from vgtm_qp.ipopt.separating import IpoptStepper
from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.maneuver.solve import solve
from vgtm_qp.step.resolver import Resolver
from vgtm_qp.study.drawing import label, panels
from vgtm_qp.study.scenes import RandomScene, random_scene
from vgtm_qp.study.statistics import wilson_interval
from vgtm_qp.study.workers import Row, Task

TITLE = "Robustness: random scenes of every module"
TIMED = False
SEED = 1991

_THROUGH = 1.0 - 1e-9
_FURTHER = 0.01


def tasks(
    short: bool, *, scenes: int | None = None, seed: int = SEED, steps: int = 30, ipopt: bool = False
) -> list[Task]:
    """Return one task for each scene and solver: a yardstick that was measured once stays."""
    count = scenes if scenes is not None else 10 if short else 1000
    solvers = ("vgtm", "ipopt") if ipopt else ("vgtm",)
    return [
        {"seed": seed, "number": k, "steps": steps, "solver": solver}
        for k in range(count)
        for solver in solvers
    ]


def run(seed: int, number: int, steps: int, solver: str) -> Row:
    """Solve one scene by this package, ``vgtm``, or by ``ipopt`` and return its row.

    Keys: what the scene is (``module``, ``bays``, ``cubes``, ``directed``, ``reachable``), the part of the path that
    was ``reached`` and CPU ``seconds``; of this package also ``status``, ``states``, ``failures`` of the independent
    check, ``stop``, ``blocked_by`` and ``way_out``.
    """
    scene = random_scene(seed, number, steps=steps)
    started = process_time()
    found = _by_ipopt(scene) if solver == "ipopt" else _here(scene)
    return _describe(scene) | found | {"seconds": process_time() - started}


def _here(scene: RandomScene) -> Row:
    maneuver = solve(scene.problem)
    manifest = maneuver.manifest
    stop = manifest["stop"]
    return {
        "status": manifest["status"],
        "reached": manifest["reached"],
        "states": len(maneuver.time),
        "failures": list(maneuver.certificate.failures()) if maneuver.certificate else ["not verified"],
        "stop": stop["kind"] if stop else "",
        "blocked_by": manifest["blocked_by"],
        "way_out": manifest["way_out"],
    }


def _by_ipopt(scene: RandomScene) -> Row:
    resolver = Resolver(scene.problem)
    plan = make_plan(scene.problem, *resolver.tip())
    _, values = IpoptStepper(resolver.setup).run(plan)
    return {"reached": (values[-1] - plan.path.start) / (plan.path.end - plan.path.start)}


def _describe(scene: RandomScene) -> dict[str, Any]:
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
    rows = _of_solver(rows, "vgtm")
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
    yardstick = {row["number"]: row for row in _of_solver(rows, "ipopt")}
    rows = _of_solver(rows, "vgtm")
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
    measured = [row for row in rows if row["number"] in yardstick]
    if measured:
        theirs = [row for row in measured if yardstick[row["number"]]["reached"] >= _THROUGH]
        ours = [row for row in measured if row["status"] == "solved"]
        behind = [
            row
            for row in measured
            if row["status"] != "solved" and yardstick[row["number"]]["reached"] > row["reached"] + _FURTHER
        ]
        seconds = [sum(row["seconds"] for row in many) for many in (measured, yardstick.values())]
        parts.append(
            f"IPOPT step by step comes through in {len(theirs)} of {len(measured)}; of these {_of(theirs)} are solved "
            f"here, and {len(ours) - sum(row['status'] == 'solved' for row in theirs)} more. "
            f"It comes further in {len(behind)} of those that are not solved here. "
            f"CPU time {seconds[0]:.0f} s against {seconds[1]:.0f} s."
        )
    return "\n\n".join(parts)


def _of_solver(rows: Sequence[Row], solver: str) -> list[Row]:
    return [row for row in rows if row["solver"] == solver]


def _of(rows: Sequence[Row]) -> str:
    if not rows:
        return "none of 0"
    done = sum(row["status"] == "solved" for row in rows)
    low, high = wilson_interval(done, len(rows))
    return f"{done} of {len(rows)} ({100 * low:.1f}-{100 * high:.1f} %)"
