"""Random scenes of all that a problem may contain: what is solved, what breaks, what stops the rest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from time import process_time
from typing import Literal

from matplotlib.figure import Figure

from vgtm_qp.comparison.tables import markdown_table, wilson_interval
from vgtm_qp.errors import ProblemError
from vgtm_qp.machine import environment
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.maneuver.solve import ManeuverAttempt, solve
from vgtm_qp.methods.ipopt import NonlinearResolver
from vgtm_qp.problem import Problem
from vgtm_qp.step.checks import check_problem
from vgtm_qp.study.drawing import label, panels, select
from vgtm_qp.study.varied import Arms, varied_scene
from vgtm_qp.study.workers import Row, Task
from vgtm_qp.verify import verify

Against = Literal["ipopt"]

SEED = 1991
_APART = 10
"""Of this many scenes one is also solved without a compiler, where steps take ten times as long."""


def tasks(
    short: bool,
    *,
    scenes: int | None = None,
    seed: int = SEED,
    steps: int = 30,
    arms: Arms = "trusses",
    without_compiler: int = _APART,
    against: Against | None = None,
) -> list[Task]:
    """Return one task a scene, and for every `without_compiler`-th scene a second one, without a compiler.

    There is one more for each scene if it is also to be solved by the method that it is held `against`.
    """
    count = scenes if scenes is not None else 10 if short else 1000
    scene = {"seed": seed, "steps": steps, "arms": arms}
    ways: list[Task] = [{"compiler": True}, *([{"compiler": True, "against": against}] if against else [])]
    return [
        {**scene, "number": k, **way}
        for k in range(count)
        for way in (*ways, *([{"compiler": False}] if k % without_compiler == 0 else []))
    ]


def run(
    seed: int,
    number: int,
    steps: int,
    compiler: bool,
    arms: Arms = "trusses",
    against: Against | None = None,
) -> Row:
    """Solve one scene, with a `compiler` or without, or by the method that it is held `against`, and return its row.

    Keys: what the scene is, see :func:`features`; ``status``, the part of the path that was ``reached``, ``states``,
    ``failures`` of the independent check, those ``between`` states, ``stop``, ``blocked_by``, the number of
    ``remedies``, ``way_out`` and CPU ``seconds``. Where IPOPT is without a curve that is kept in every step,
    ``without_curve`` says whether we solve the scene without it, too.
    """
    problem = varied_scene(seed, number, steps=steps, arms=arms)
    found: Row = {"module": kind_of(problem), "features": features(problem)}
    if against and problem.method.holds_curve and not problem.method.gives_way:
        found["without_curve"] = _is_solved_without_curve(problem)
    started = process_time()
    try:
        with nullcontext() if compiler else environment({"VGTM_CC": "none"}):
            maneuver = solve_by_ipopt(problem) if against else solve(problem)
    except ProblemError as error:
        nothing: Row = {
            "status": "refused",
            "reached": 0.0,
            "failures": [],
            "between": [],
            "blocked_by": str(error),
            "way_out": "",
            "remedies": 0,
        }
        return {**found, **nothing, "states": 0, "stop": "", "seconds": process_time() - started}
    summary, stop = maneuver.summary(), maneuver.manifest["stop"]
    return {
        **found,
        **{key: summary[key] for key in ("status", "reached", "failures", "blocked_by", "way_out")},
        "between": [line for line in summary["failures"] if "between:" in line],
        "states": len(maneuver.time),
        "remedies": len(maneuver.remedies),
        "stop": stop["kind"] if stop else "",
        "seconds": process_time() - started,
    }


def solve_by_ipopt(problem: Problem) -> Maneuver:
    """Return the maneuver that IPOPT finds step by step: without the curve, and by exact distances.

    Raises
    ------
    ProblemError
        As ``solve``, but for what only a curve asks for.
    """
    problem = _without_curve(problem).replace({"clearance.distance": "exact"})
    resolver = NonlinearResolver(problem)
    if mistakes := check_problem(problem, resolver.setup):
        raise problem.error(mistakes)
    attempt = ManeuverAttempt(problem, resolver)
    stop = attempt.run(None)
    maneuver = attempt.log.maneuver(problem, stop, problem_digests={}, way_out="", setup_time=0.0)
    return maneuver.with_certificate(verify(maneuver))


def _without_curve(problem: Problem) -> Problem:
    return problem.replace({"method": problem.method.kept_by("qp", "none"), "curve.control_vertex_goals": []})


def _is_solved_without_curve(problem: Problem) -> bool:
    try:
        maneuver = solve(_without_curve(problem))
    except ProblemError:
        return False
    return maneuver.status == "solved" and not maneuver.summary()["failures"]


def kind_of(problem: Problem) -> str:
    """Return the module of a truss, or the kind of a serial arm's joints."""
    if problem.truss is not None:
        return str(problem.to_dict()["truss"]["module"])
    assert problem.arm is not None
    if problem.arm.joint[0].name.startswith("pitch"):
        return "snake"
    has_slides = any(joint.kind == "prismatic" for joint in problem.arm.joint)
    return "joints that turn or slide" if has_slides else "joints that turn"


def features(problem: Problem) -> list[str]:
    """Return in words what makes a scene harder than an arm of pin joints among cubes at rest."""
    table = problem.to_dict()
    arm, curve, method = table.get("truss") or table["arm"], table["curve"], table["method"]
    shapes = {obstacle["shape"] for obstacle in table["obstacle"]}
    found = {
        "a direction of the tip": "pointing" in table["end_effector"]["track"],
        "an attitude of the tip": "orientation" in table["end_effector"]["track"],
        "offset joints": arm.get("joint_offset", 0.0) > 0.0,
        "limited accelerations": (arm.get("joint") or [arm])[0].get("acceleration") is not None,
        "jams": bool(arm["locked"]),
        "a moving base": bool(arm["base_motion"]),
        "moving obstacles": any(any(obstacle["velocity"]) for obstacle in table["obstacle"]),
        **{f"obstacles: {shape}": shape in shapes for shape in ("sphere", "cylinder", "mesh")},
        f"curve: {curve['family']}": method["tracking"] != "none",
        "a general curve": curve["nodes"] == "arc-length" or curve["torsion_vertices"] > 0,
        "no curve": method["tracking"] == "none",
        f"tip: {table['end_effector']['mode']}": True,
    }
    return [words for words, is_there in found.items() if is_there]


def draw(rows: Sequence[Row]) -> Figure:
    """Draw how far the scenes that were not solved came, by what stopped them."""
    rows = [row for row in rows if not row.get("against")]
    figure, axes = panels(1, 1, width=5.6, height=2.6)
    kinds = sorted({row["stop"] for row in rows if row["stop"]}) or ["nothing"]
    for k, kind in enumerate(kinds):
        reached = sorted(row["reached"] for row in select(rows, stop=kind))
        places = [k + 0.6 * i / len(reached) for i in range(len(reached))]
        axes[0].plot(reached, places, "o", markersize=3, label=kind)
    axes[0].set_yticks(range(len(kinds)), kinds)
    axes[0].set_xlim(0.0, 1.0)
    label(axes[0], "part of the path", "stopped by", legend=False)
    return figure


def text(rows: Sequence[Row]) -> str:
    """Give what was solved, what broke, what stopped the rest, and what differs without a compiler."""
    theirs = {row["number"]: row for row in rows if row.get("against")}
    every = [row for row in rows if not row.get("against")]
    rows = select(every, compiler=True)
    if not rows:
        return "No scene was run."
    broken, refused = sum(bool(row["failures"]) for row in every), len(select(rows, status="refused"))
    groups = {module: select(rows, module=module) for module in sorted({row["module"] for row in rows})}
    for words in sorted({words for row in rows for words in row["features"]}):
        groups[words] = [row for row in rows if words in row["features"]]
    statuses = {row["number"]: row["status"] for row in rows}
    again = select(every, compiler=False)
    same = sum(statuses.get(row["number"]) == row["status"] for row in again)
    parts = [
        f"Seed {rows[0]['seed']}, scenes 0 to {max(row['number'] for row in rows)}, {rows[0]['steps']} steps each. "
        f"{share_of(rows)} solved, {refused} refused; states that break a tolerance by the independent check: in "
        f"{broken} scenes. Without a compiler {same} of {len(again)} end with the same status.",
        markdown_table(("", "solved"), [(name, share_of(some)) for name, some in groups.items()]),
    ]
    if theirs:
        parts.insert(1, _beside(rows, theirs))
    solved = select(rows, status="solved")
    for words, key, some in (
        ("Solved by another way out", "way_out", solved),
        ("The others stopped by", "stop", rows),
    ):
        counts = Counter(row[key] for row in some if row[key]).most_common()
        if counts:
            parts.append(f"{words}: {', '.join(f'{name} {count}' for name, count in counts)}.")
    stopped = [row for row in rows if row["stop"]]
    if stopped:
        left = [row["stop"] for row in stopped if not row["remedies"]]
        names = ", ".join(f"{name} {count}" for name, count in Counter(left).most_common())
        parts.append(
            f"Of these {len(stopped)} stops {len(stopped) - len(left)} name a change with which the arm was seen to go "
            f"on; without one: {names or 'none'}."
        )
    return "\n\n".join(parts)


def _beside(rows: Sequence[Row], theirs: dict[int, Row]) -> str:
    """Give the scenes that we solve and those that IPOPT solves, without those that neither is asked to solve."""
    pairs = [(row, theirs[row["number"]]) for row in rows if row["number"] in theirs]
    pairs = [pair for pair in pairs if {row["status"] for row in pair} != {"refused"}]

    def solved(rows: Sequence[Row]) -> set[int]:
        # Failures between states are not held against IPOPT, whose steps know nothing of them.
        found = select(rows, status="solved")
        return {row["number"] for row in found if len(row["failures"]) == len(row.get("between", ()))}

    every, by_ipopt = [row for row, _ in pairs], [row for _, row in pairs]
    ours, other = solved(every), solved(by_ipopt)
    below = {row["number"] for row in by_ipopt if row["between"]}
    alike = {row["number"] for row, beside in pairs if beside.get("without_curve", row["number"] in ours)}
    table = [
        ("by us", ours),
        ("by us, without the curves that are kept in every step", alike),
        ("by IPOPT without any curve, each state exact", other),
        ("of these clear between states, too", other - below),
        ("without these curves by us alone", alike - other),
        ("without these curves by IPOPT alone", other - alike),
    ]
    ours_cpu, its_cpu = (sum(row["seconds"] for row in one) / max(len(one), 1) for one in (every, by_ipopt))
    left = f": scenes {', '.join(map(str, sorted(other - alike)))}" if other - alike else ": none"
    return (
        f"Beside IPOPT, one nonlinear program a step. Of {len(pairs)} scenes are solved\n\n"
        f"{markdown_table(('', 'scenes'), [(name, str(len(numbers))) for name, numbers in table])}\n\n"
        f"By IPOPT alone{left}. Of all its maneuvers, solved or not, {len(below)} fall below a clearance between two "
        f"states. CPU a scene with set-up and check: {ours_cpu:.1f} s by us, ways out and remedies included, "
        f"{its_cpu:.1f} s by IPOPT."
    )


def share_of(rows: Sequence[Row]) -> str:
    """Return the number of solved rows, that of all, and the interval of 95 % for the share."""
    if not rows:
        return "none of 0"
    done = len(select(rows, status="solved"))
    low, high = wilson_interval(done, len(rows))
    return f"{done} of {len(rows)} ({100 * low:.1f}-{100 * high:.1f} %)"
