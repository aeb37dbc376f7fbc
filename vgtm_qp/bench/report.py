"""The document of a measurement: every scene's numbers, growth with the bays, ratios to an older one."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from vgtm_qp.bench import BaselineName
from vgtm_qp.bench.between import Walker, least_by_resolver, least_by_walker
from vgtm_qp.bench.contestants import BASELINES, make_baseline
from vgtm_qp.bench.fresh import measure_fresh, measure_start
from vgtm_qp.bench.measure import breakdown, run_alone, run_in_turn, timing
from vgtm_qp.bench.scenes import BenchScene
from vgtm_qp.bench.tour import Goal, make_goals
from vgtm_qp.comparison.tables import exponent
from vgtm_qp.compiled import compiler
from vgtm_qp.errors import ResultError, VgtmError
from vgtm_qp.machine import commit, machine_record, versions
from vgtm_qp.methods import Resolver

_PACKAGES = ("vgtm-qp", "numpy", "scipy", "casadi", "daqp", "osqp", "piqp", "qpsolvers", "python-fcl")
_PEERS = ("mink", "mujoco", "pin-pink", "pin")

SCHEMA_VERSION = 2
"""In version 1 a step was ``Resolver.follow``, and CPU time that of the process."""
_ALONE = 30.0
LEAST_BAYS = 50
"""Least number of bays in the fit of growth: below it, the constant cost of a step hides the growth."""


def measure_scene(
    scene: BenchScene, names: Sequence[BaselineName], *, seconds: float, steps: int, cold: bool = False
) -> dict[str, Any]:
    """Measure one scene: alone, in turn with each of the baselines, and in fresh processes; seconds and bytes.

    Keys of what is returned: ``name``, ``kind``, ``bays``, ``tracking`` and ``distance`` of the scene; the numbers of
    ``members`` (bodies of any arm), ``actuators`` and ``obstacles``; ``covered``, the share of the maneuver that the
    arm covered, 0 to 1; ``stopped_by``, what stopped it, empty where nothing did; ``step`` and ``breakdown``, see
    `measure.py`; ``qps``, QPs a step; ``fcl_rows`` and ``exact_rows``, clearance rows a step by FCL and by closed
    forms; ``warm`` and ``cold``, what `measure_fresh` returns, with ``cold`` None if it was not asked for;
    ``baselines``, what `_against` returns, by name; ``safe``, the clearance asked for, and ``between``, the least one
    at and between the steps of the maneuver, m, None where no baseline can be compared in it.

    Each run ends after so many `steps`, or earlier: in turn with a baseline after `seconds`, alone after 30
    times as long.
    """
    problem = scene.problem
    resolver = Resolver(problem)
    goals = make_goals(problem, resolver)
    alone = run_alone(resolver, goals, seconds=_ALONE * seconds, steps=steps)
    baselines = {name: _against(scene, name, resolver, goals, seconds=seconds, steps=steps) for name in names}
    data, arm = problem.to_dict(), resolver.setup.arm
    compared = any(found["between"] is not None for found in baselines.values())
    return {
        "name": scene.name,
        "kind": scene.kind,
        "bays": scene.bays,
        "tracking": scene.tracking,
        "distance": scene.distance,
        "members": len(arm.bodies),
        "actuators": len(arm.actuators),
        "obstacles": len(problem.obstacle),
        "covered": alone.covered,
        "stopped_by": alone.stopped_by,
        "step": timing(alone.spent),
        "breakdown": breakdown(alone.spent, alone.phases),
        "qps": float(np.mean(alone.qps)),
        "fcl_rows": float(np.mean(alone.fcl_rows)),
        "exact_rows": float(np.mean(alone.exact_rows)),
        "warm": measure_fresh(data),
        "cold": measure_fresh(data, cold=True) if cold else None,
        "baselines": baselines,
        "safe": problem.clearance.safe,
        "between": least_by_resolver(resolver, goals) if compared else None,
    }


def _against(
    scene: BenchScene,
    name: BaselineName,
    resolver: Resolver,
    goals: list[Goal],
    *,
    seconds: float,
    steps: int,
) -> dict[str, Any]:
    """Return a baseline's ``step``, see `timing`, and its ``ratio`` to ``ours``, median CPU times of the same steps, s.

    These are None if the baseline was not measured, and ``skipped`` says why; ``failed`` counts the steps
    without its answer, which are not in the times. ``between`` is the least clearance, m, at and between the steps of a
    baseline that goes the whole way by itself, and None for all others.
    """
    missing = {"step": None, "ours": None, "ratio": None, "failed": 0, "skipped": "", "between": None}
    try:
        baseline = make_baseline(name, scene.problem, scene.bays)
    except VgtmError as error:
        return missing | {"skipped": str(error).splitlines()[0]}
    pairs = run_in_turn(resolver, baseline, goals, seconds=seconds, steps=steps)
    if not pairs.theirs:
        return missing | {"failed": pairs.failed, "skipped": "found no answer to any step"}
    step, ours = timing(pairs.theirs), timing(pairs.ours)["cpu"]
    found = {"step": step, "ours": ours, "ratio": pairs.ratio, "failed": pairs.failed}
    if scene.problem.obstacle and isinstance(baseline, Walker):
        found["between"] = least_by_walker(resolver.setup, goals, baseline)
    return missing | found


def measure(
    scenes: Iterable[BenchScene],
    names: Sequence[BaselineName],
    *,
    seconds: float,
    steps: int,
    cold: bool = False,
    pinned: bool = True,
    progress: Callable[[BenchScene], None] | None = None,
) -> dict[str, Any]:
    """Measure scenes against baselines and return the document, plain data for JSON; see :func:`measure_scene`.

    `pinned` says whether BLAS was held to one thread; `progress` is called before each scene.
    """
    document: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": commit(),
        "machine": machine_record() | {"compiler": compiler()},
        "versions": versions(_PACKAGES + _PEERS),
        "settings": {"seconds": seconds, "steps": steps, "cold": cold, "one_blas_thread": pinned},
        "baselines": {name: BASELINES[name].title for name in names},
        "start": measure_start(),
        "scenes": [],
    }
    for scene in scenes:
        if progress is not None:
            progress(scene)
        document["scenes"].append(measure_scene(scene, names, seconds=seconds, steps=steps, cold=cold))
    document["growth"] = growth(document["scenes"])
    return document


def growth(scenes: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the exponents of bays or joints in the CPU time of a step among cubes, by method and tracking, with FCL.

    Fitted by least squares of the logarithms over trusses of 50 bays and more, and over snakes, if there are at least
    two.
    """
    points: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for scene in scenes:
        kind = scene["kind"]
        grows = kind == "snake" or (kind == "cubes" and scene["bays"] >= LEAST_BAYS)
        if not grows or scene["distance"] != "fcl":
            continue
        medians = {"qp": scene["step"]["cpu"]}
        medians |= {name: found["step"]["cpu"] for name, found in scene["baselines"].items() if found["step"]}
        for method, median in medians.items():
            points.setdefault((kind, method, scene["tracking"]), []).append((scene["bays"], median))
    return [
        {
            "kind": kind,
            "method": method,
            "tracking": tracking,
            "bays": [bays for bays, _ in found],
            "exponent": exponent(*zip(*found, strict=True)),
        }
        for (kind, method, tracking), found in points.items()
        if len({bays for bays, _ in found}) > 1
    ]


def load_document(path: Path) -> dict[str, Any]:
    """Return a document that was printed before.

    Raises
    ------
    ResultError
        The file cannot be read, or is not such a document.
    """
    wrong = f"{path} is not what vgtm bench --json prints"
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ResultError(f"{path}: cannot be read: {(error.strerror or str(error)).lower()}") from None
    except ValueError as error:
        raise ResultError(f"{wrong}: {error}") from None
    keys = ("schema_version", "commit", "time", "scenes")
    if not isinstance(document, dict) or any(key not in document for key in keys):
        raise ResultError(f"{wrong}: it has to have {', '.join(keys)}")
    if document["schema_version"] != SCHEMA_VERSION:
        raise ResultError(f"{path} has schema version {document['schema_version']}, not {SCHEMA_VERSION}")
    return document


def compare(new: dict[str, Any], old: dict[str, Any]) -> dict[str, Any]:
    """Return the ratios of a document to an older one, scene by scene, for the scenes that both have.

    ``cpu`` is the ratio of the median CPU times. Between two runs the machine itself may have changed;
    ``corrected`` is that ratio with both times divided by those of the baseline ``by``, the first that both have.
    """
    before = {scene["name"]: scene for scene in old["scenes"]}
    rows = []
    for scene in new["scenes"]:
        other = before.get(scene["name"])
        if other is None:
            continue
        by = next((name for name in BASELINES if _ratio(scene, name) and _ratio(other, name)), None)
        rows.append(
            {
                "name": scene["name"],
                "old": other["step"]["cpu"],
                "new": scene["step"]["cpu"],
                "cpu": scene["step"]["cpu"] / other["step"]["cpu"],
                "p99": scene["step"]["p99"] / other["step"]["p99"],
                "setup": scene["warm"]["setup"] / other["warm"]["setup"],
                "memory": scene["warm"]["peak_memory"] / other["warm"]["peak_memory"],
                "corrected": _ratio(other, by) / _ratio(scene, by) if by else None,
                "by": by,
            }
        )
    return {"commit": old["commit"], "time": old["time"], "scenes": rows}


def _ratio(scene: dict[str, Any], name: str) -> float:
    """Return a baseline's ratio on a scene; 0 if it was not measured."""
    return float(scene["baselines"].get(name, {}).get("ratio") or 0.0)
