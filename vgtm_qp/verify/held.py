"""The problem against which a maneuver is checked: the one in its manifest, or a given one."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vgtm_qp.result.manifest import dump_manifest, file_digest, problem_digests, stored_problem
from vgtm_qp.result.result import Result

if TYPE_CHECKING:
    from vgtm_qp.problem import Problem
    from vgtm_qp.problem.table import Place

_HOW_SOLVED: tuple[Place, ...] = (
    ("method",),
    ("maneuver", "steps"),
    ("clearance", "influence"),
    ("clearance", "margin"),
    ("clearance", "distance"),
)
"""Keys that say how a maneuver is solved, not what it has to satisfy."""
_FILES = ("file", "path", "urdf")
"""Keys of files: the content of these is compared where it is read, not their paths."""
_MISSING = object()


def held_against(maneuver: Result, problem: Problem | None) -> tuple[Result, list[str], list[str]]:
    """Return the maneuver with the problem that it is checked against, contradictions, and notes.

    ResultError if the problem in the manifest is malformed.
    """
    manifest = maneuver.manifest
    recorded = manifest.get("problem_digests") or {}
    wrong: list[str] = []
    notes: list[str] = []
    if recorded and problem_digests(manifest["problem"])["problem"] != recorded.get("problem"):
        wrong.append("the problem in the result was altered: its SHA-256 is not the recorded one")
    if problem is None:
        return maneuver, wrong, []
    from vgtm_qp.problem.table import key_path, shown

    if changes := manifest.get("scenes"):
        wrong.append(
            f"the scene changed {len(changes)} times while the arm ran, of which the problem says nothing"
        )

    real = json.loads(dump_manifest(problem.to_dict()))
    for place, found, wanted in _differences(stored_problem(manifest["problem"]).to_dict(), real):
        if place[-1] in _FILES:
            continue
        key = key_path(problem, place)
        line = f"{key}: {_text(shown, found)} in the result, {_text(shown, wanted)} in the problem"
        is_how = any(place[: len(how)] == how for how in _HOW_SOLVED)
        (notes if is_how else wrong).append(line)
    directory = str((problem.source.parent if problem.source else Path.cwd()).resolve())
    return replace(maneuver, manifest={**manifest, "problem": real, "directory": directory}), wrong, notes


def describe_problem(maneuver: Result, problem: Problem | None) -> dict[str, Any]:
    """Return the problem against which `verify` checks a maneuver, as JSON data.

    Keys: ``problem`` is the file, None for the problem in the result; ``sha256`` is that of the file, or of
    the problem in the result; ``solved_from`` is the SHA-256 of the file that the result was solved from,
    None if it is unknown.
    """
    solved_from = (maneuver.manifest.get("problem_digests") or {}).get("file")
    if problem is None:
        digest = problem_digests(maneuver.manifest["problem"])["problem"]
        return {"problem": None, "sha256": digest, "solved_from": solved_from}
    return {
        "problem": str(problem.source or problem.name),
        "sha256": file_digest(problem.source),
        "solved_from": solved_from,
    }


def _differences(found: Any, wanted: Any, place: Place = ()) -> Iterator[tuple[Place, Any, Any]]:
    """Yield the places where two problems differ, as JSON data, and the two values there."""
    if isinstance(found, Mapping) and isinstance(wanted, Mapping):
        for key in dict.fromkeys((*wanted, *found)):
            yield from _differences(found.get(key, _MISSING), wanted.get(key, _MISSING), (*place, key))
    elif isinstance(found, list) and isinstance(wanted, list) and len(found) == len(wanted):
        for k, (one, other) in enumerate(zip(found, wanted, strict=True)):
            yield from _differences(one, other, (*place, k))
    elif found != wanted:
        yield place, found, wanted


def _text(shown: Any, value: Any) -> str:
    return "nothing" if value is _MISSING else str(shown(value))
