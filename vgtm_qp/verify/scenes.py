"""Clearances and angles of a maneuver, in each of the scenes that it went through."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import ResultError
from vgtm_qp.result.certificate import Measure
from vgtm_qp.result.manifest import scene_problem
from vgtm_qp.result.result import Result
from vgtm_qp.verify.arm import AnyRecordedArm
from vgtm_qp.verify.carrying import CarryingArm
from vgtm_qp.verify.clearance import (
    BETWEEN_TOLERANCE,
    CLEARANCE_TOLERANCE,
    AgainstBody,
    AgainstMembers,
    Encounters,
    Least,
    RecordedMotion,
    apart_at_home,
)
from vgtm_qp.verify.obstacles import read_obstacles
from vgtm_qp.verify.path import DIRECTION_TOLERANCE, angles
from vgtm_qp.verify.recovery import excuse_recovering

_SAFE = 0.05
"""Default of ``clearance.safe``, m."""
SELF_SHARE = 0.25
"""Default of ``clearance.self_safe``, as a share of ``safe``."""

_NAMED = 8
"""Greatest number of changes of the scene that a note names."""


class Clearances(NamedTuple):
    """Measures by name, clearances and self-clearances at each state (T,), m, contradictions, and notes."""

    measures: dict[str, Measure]
    clearance: Array
    self_clearance: Array
    wrong: list[str]
    notes: list[str]


class _Scene(NamedTuple):
    """States from `first` to `last`, and what holds in the steps between: tables of the manifest, what is carried."""

    first: int
    last: int
    problem: Mapping[str, Any]
    meshes: Mapping[str, Any]
    recovered: Sequence[Mapping[str, Any]]
    arm: CarryingArm | None = None


def clearances_of(maneuver: Result, arm: AnyRecordedArm, motion: RecordedMotion) -> Clearances:
    """Return the clearances of a maneuver whose `arm` moved like `motion`.

    A state at which the scene changed has to keep clear in the scene before; in the one after, pairs that were too near
    at once have to recover.

    Raises
    ------
    ResultError
        A scene in the manifest is malformed.
    """
    scenes = list(_scenes_of(maneuver, arm))
    directory = Path(maneuver.manifest.get("directory") or ".")
    each = [
        _clearances(scene, motion.part(scene.first, scene.last, scene.arm), directory) for scene in scenes
    ]
    first, *others = each
    measures = {name: min((found.measures[name] for found in each), key=_spare) for name in first.measures}
    angle = float((maneuver.manifest["problem"].get("clearance") or {}).get("minimum_angle") or -np.inf)
    measures["member_angle"] = least_measure(_member_angle(motion), angle - DIRECTION_TOLERANCE, "rad")
    # A state at which the scene changed belongs to the scene in which it was reached.
    clearance = [first.clearance, *(found.clearance[1:] for found in others)]
    self_clearance = [first.self_clearance, *(found.self_clearance[1:] for found in others)]
    notes = [line for found in each for line in found.notes]
    if changes := maneuver.manifest.get("scenes"):
        some = ", ".join(str(scene["row"]) for scene in changes[:_NAMED])
        more = f" and {len(changes) - _NAMED} more" if len(changes) > _NAMED else ""
        notes.append(f"the scene changed at states {some}{more}; each step was checked against its own")
    wrong = [*apart_at_home(arm, motion.resolution), *(line for found in each for line in found.wrong)]
    return Clearances(
        measures,
        np.concatenate(clearance),
        np.concatenate(self_clearance),
        list(dict.fromkeys(wrong)),
        list(dict.fromkeys(notes)),
    )


def _scenes_of(maneuver: Result, arm: AnyRecordedArm) -> Iterator[_Scene]:
    """Yield the scenes of a maneuver in the order in which it went through them."""
    manifest = maneuver.manifest
    changes = manifest.get("scenes") or []
    rows = [0, *(scene["row"] for scene in changes), len(maneuver.time) - 1]
    if any(late <= early for early, late in itertools.pairwise(rows[1:])):
        raise ResultError(
            f"manifest.scenes begin at rows {rows[1:-1]}; expected ascending rows before the last one"
        )
    problem = manifest["problem"]
    # A scene from the first row on takes the place of the problem's.
    if not changes or changes[0]["row"]:
        yield _Scene(0, rows[1], problem, manifest.get("meshes") or {}, manifest.get("recovered") or [])
    for scene, first, last in zip(changes, rows[1:-1], rows[2:], strict=True):
        own, carried = scene_problem(problem, scene), scene.get("carried") or []
        carrying = CarryingArm(arm, carried) if carried else None
        yield _Scene(first, last, own, scene.get("meshes") or {}, scene.get("recovered") or [], carrying)


def _spare(measure: Measure) -> float:
    """Return by how much a measure keeps its bound, or its value if it has none."""
    value = np.inf if measure.value is None else measure.value
    return float(value if measure.bound is None else value - measure.bound)


def _clearances(scene: _Scene, motion: RecordedMotion, directory: Path) -> Clearances:
    """Return the clearances in one scene, in which the arm moved like `motion`."""
    bodies, wrong, notes = read_obstacles(scene.problem, scene.meshes, directory)
    rules = scene.problem.get("clearance") or {}
    safe = float(rules.get("safe", _SAFE))
    self_safe = SELF_SHARE * safe if rules.get("self_safe") is None else float(rules["self_safe"])
    if not rules.get("self_collision", True):
        self_safe = -np.inf
    against, members = [AgainstBody(motion, body) for body in bodies], [AgainstMembers(motion)]
    at, between, clearance = _least_clearances(motion, against)
    self_at, self_between, self_clearance = _least_clearances(motion, members)
    if scene.arm is not None:
        uncovered, remarks = scene.arm.contradictions(scene.meshes, directory)
        wrong, notes = [*wrong, *uncovered], [*notes, *remarks]
    if scene.recovered:
        kept = [*((pairs, safe) for pairs in against), *((pairs, self_safe) for pairs in members)]
        nearer, remarks = excuse_recovering(scene.recovered, kept)
        wrong, notes = [*wrong, *nearer], [*notes, *remarks]
        at, between, _ = _least_clearances(motion, against)
        self_at, self_between, _ = _least_clearances(motion, members)
    spare = BETWEEN_TOLERANCE * motion.arm.size
    measures = {
        "clearance": least_measure(at, safe - CLEARANCE_TOLERANCE),
        "clearance_between": least_measure(between, safe - spare),
        "self_clearance": least_measure(self_at, self_safe - CLEARANCE_TOLERANCE),
        "self_clearance_between": least_measure(self_between, self_safe - spare),
    }
    return Clearances(measures, clearance, self_clearance, wrong, notes)


def least_measure(found: Least, bound: float, unit: str = "m") -> Measure:
    """Return a measure whose least value is `found`; an infinite bound is none."""
    return Measure(found.value, unit, bound if np.isfinite(bound) else None, "least", found.where)


def _least_clearances(motion: RecordedMotion, encounters: Sequence[Encounters]) -> tuple[Least, Least, Array]:
    """Return the least clearance at states, a bound of it between them, and the least at each state (T,)."""
    count = len(motion.time)
    found = zip(*(pairs.at_states() for pairs in encounters), strict=True) if encounters else [()] * count
    each = [min(at, key=lambda least: least.value, default=Least()) for at in found]
    at = min(each, key=lambda least: least.value)
    limit, bound = at, Least()
    for pairs in encounters:
        limit, bound = pairs.between(limit, bound)
    # The bound names an interval. If the clearance found is as low, its instant is more precise.
    where = limit.where if bound.value >= limit.value - motion.resolution else bound.where
    between = Least(min(bound.value, limit.value), where)
    return at, between, np.array([least.value for least in each])


def _member_angle(motion: RecordedMotion) -> Least:
    """Return the least angle at any state between two members that share a node, rad."""
    pairs = joined_ends(motion.arm.members)
    least = Least()
    for state, ends in enumerate(motion.ends):
        along = ends[:, 1] - ends[:, 0]
        leaving = np.stack([along, -along], axis=1).reshape(-1, 3)
        between = angles(leaving[pairs[:, 0]], leaving[pairs[:, 1]])
        if len(between) and between.min() < least.value:
            names = " / ".join(motion.arm.member_names[k // 2] for k in pairs[int(np.argmin(between))])
            least = Least(float(between.min()), f"state {state}: {names}")
    return least


def joined_ends(members: Index) -> Index:
    """Return (P, 2) the pairs of ends of members (M, 2) in one node; end e of member m has number 2 m + e."""
    node = members.reshape(-1)
    order = np.argsort(node, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(node[order])) + 1)
    corners = [np.stack(np.triu_indices(len(group), 1), axis=1) for group in groups]
    return np.concatenate([group[pair] for group, pair in zip(groups, corners, strict=True)])
