"""The manifest of a result file: problem, arm, outcome and versions as strict JSON data.

Its keys are:

- `schema_version`; `problem`, in the form of its file; `problem_digests`, see the function of that name;
- `arm`, from ``Arm.record``; `curve`, from ``Layout.record``, null without a curve;
- `status`, one of ``STATUSES``; `reached`, the share of the path covered, 0 to 1;
- `blocked_by`, the names of what stopped the arm; `stop`, from ``Stop.to_dict``; `way_out`, the name of the
  retry that came further;
- `recovered`, pairs below their clearance in the home pose, and their distances there, m;
- `method`; `solver`; `setup_time`, s; `versions`; `jacobian_rank`, of the last step if the method reveals it;
- `directory`, in which relative paths of the problem start; `meshes`, from ``mesh_record`` for each mesh;
- `scenes`, where the scene changed while the arm ran: from each `row` on, to the next one's, the tables of `obstacle`,
  `safe` and `self_safe` of ``[clearance]``, `meshes` and `recovered` as above, and what is `carried` at the tip;
- `certificate`, null before verification;
- `clearance_rows`, numbers of rows by `fcl` and of `exact` ones in the QPs that moved the arm; where FCL is asked for
  the rows that press alone, of these.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from vgtm_qp.errors import ProblemError, ResultError
from vgtm_qp.machine import versions
from vgtm_qp.result.certificate import Certificate

if TYPE_CHECKING:
    from vgtm_qp.problem import Problem

SCHEMA_VERSION = 1
"""Version of the result file that this package writes and reads."""

STATUSES = ("solved", "blocked", "infeasible")
"""Solved: the whole path is covered, and verification, if done, found no fault. Blocked: the arm stopped
before its end. Infeasible: the whole path is covered, but verification found a fault.
"""

WHOLE_PATH = 1.0 - 1e-9
"""Share of the path from which on the arm counts as arrived."""

_PACKAGES = ("vgtm-qp", "numpy", "casadi", "daqp", "osqp", "piqp", "python-fcl", "qpsolvers", "trimesh")
_MANIFEST_KEYS = ("schema_version", "problem", "arm", "status", "reached", "blocked_by", "versions")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e15


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**53


def _is_table(value: Any, is_right: Callable[[Any], bool]) -> bool:
    return isinstance(value, dict) and all(is_right(entry) for entry in value.values())


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_mesh(value: Any) -> bool:
    return isinstance(value, dict) and _is_text(value.get("sha256")) and _is_count(value.get("triangles"))


def _is_pair(value: Any) -> bool:
    return isinstance(value, dict) and _is_text(value.get("pair")) and _is_number(value.get("distance"))


def _is_list(value: Any, is_right: Callable[[Any], bool]) -> bool:
    return isinstance(value, list) and all(is_right(entry) for entry in value)


def _is_stop(value: Any) -> bool:
    if not isinstance(value, dict) or not _is_text(value.get("text", "")):
        return False
    return _is_list(
        value.get("remedies", []), lambda changes: _is_list(changes, lambda x: isinstance(x, dict))
    )


def _is_scene(value: Any) -> bool:
    return (
        isinstance(value, dict)
        and _is_count(value.get("row"))
        and _is_list(value.get("obstacle"), lambda table: isinstance(table, dict))
        and all(_is_number(value.get(key)) for key in ("safe", "self_safe"))
        and all(_VALUES[key][0](value.get(key)) for key in ("meshes", "recovered"))
        and _is_list(value.get("carried", []), _is_carried)
    )


def _is_carried(value: Any) -> bool:
    """Whether a value has a body's table, and capsules; their numbers are checked when they are read."""
    return (
        isinstance(value, dict)
        and isinstance(value.get("body"), dict)
        and _is_text(value["body"].get("name"))
        and all(isinstance(value.get(key), list) for key in ("ends", "radius"))
    )


_VALUES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "blocked_by": (lambda value: _is_list(value, _is_text), "a list of names"),
    "curve": (lambda value: isinstance(value, dict), "a JSON object, or null"),
    "stop": (_is_stop, "a JSON object, its text a string, its remedies lists of objects; or null"),
    "way_out": (_is_text, "a string"),
    "recovered": (lambda value: _is_list(value, _is_pair), "a list of pairs and distances"),
    "scenes": (lambda value: _is_list(value, _is_scene), "a list of scenes, each with the row it begins at"),
    "problem_digests": (
        lambda value: _is_table(value, lambda x: x is None or _is_text(x)),
        "SHA-256 by name",
    ),
    "method": (_is_text, "a string"),
    "solver": (_is_text, "a string"),
    "setup_time": (_is_number, "a number"),
    "directory": (_is_text, "a string"),
    "meshes": (lambda value: _is_table(value, _is_mesh), "SHA-256 and number of triangles by obstacle"),
    "versions": (lambda value: _is_table(value, _is_text), "strings by name"),
    "jacobian_rank": (_is_count, "a count"),
    "clearance_rows": (lambda value: _is_table(value, _is_count), "numbers of rows by name"),
    "digest": (_is_text, "a string"),
}
"""Checks of values that are not null, each with its expectation; `check_manifest` checks the other keys."""


def mesh_record(path: str | Path, triangles: int) -> dict[str, Any]:
    """Return SHA-256 and number of triangles of a mesh file, by which a result is tied to it."""
    return {"sha256": hashlib.sha256(Path(path).read_bytes()).hexdigest(), "triangles": int(triangles)}


def problem_digests(problem: Mapping[str, Any], **files: str | Path | None) -> dict[str, str | None]:
    """Return the SHA-256 that tie a result to its problem; None for a file that does not exist.

    They are of the canonical text of `problem` as the manifest holds it, and of `files` by name: ``file``, that of the
    problem, ``path`` and ``urdf``. Those of meshes are in their records. Only the files given here are read.
    """
    text = hashlib.sha256(dump_manifest(problem).encode()).hexdigest()
    return {"problem": text, **{name: file_digest(path) for name, path in files.items()}}


def file_digest(path: str | Path | None) -> str | None:
    """Return the SHA-256 of a file, or None if it cannot be read."""
    try:
        return None if path is None else hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except (OSError, ValueError):
        return None


def recorded_versions() -> dict[str, str]:
    """Return the versions of Python, machine and packages that a result depends on."""
    return {
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        **{name: found or "not installed" for name, found in versions(_PACKAGES).items()},
    }


def check_manifest(manifest: Any) -> dict[str, Any]:
    """Return a copy of `manifest` that is plain strict JSON, or raise ResultError."""
    if not isinstance(manifest, Mapping):
        raise ResultError("the manifest is not a JSON object")
    if manifest.get("schema_version") != SCHEMA_VERSION:
        raise ResultError(
            f"schema version {manifest.get('schema_version')!r}; this package reads version {SCHEMA_VERSION}"
        )
    missing = [key for key in _MANIFEST_KEYS if key not in manifest]
    if missing:
        raise ResultError(f"the manifest lacks {', '.join(missing)}")
    copy: dict[str, Any] = json.loads(dump_manifest(manifest))
    for key in ("problem", "arm", "versions"):
        if not isinstance(copy[key], dict):
            raise ResultError(f"manifest.{key} is not a JSON object")
    if copy["blocked_by"] is None:
        raise ResultError("manifest.blocked_by is null; expected a list of names")
    if copy["status"] not in STATUSES:
        raise ResultError(f"manifest.status is {copy['status']!r}; expected one of {', '.join(STATUSES)}")
    reached = copy["reached"]
    if isinstance(reached, bool) or not isinstance(reached, int | float) or not 0.0 <= reached <= 1.0:
        raise ResultError(f"manifest.reached is {reached!r}; expected a number from 0 to 1")
    for key, (is_right, expected) in _VALUES.items():
        if copy.get(key) is not None and not is_right(copy[key]):
            raise ResultError(f"manifest.{key} is {str(copy[key])[:80]!r}; expected {expected}")
    if copy.get("certificate") is not None:
        if not isinstance(copy["certificate"], dict):
            raise ResultError("manifest.certificate is not a JSON object")
        ok = Certificate.from_dict(copy["certificate"]).ok
        if copy["status"] != "blocked" and reached >= WHOLE_PATH:
            copy["status"] = "solved" if ok else "infeasible"
    return copy


def stored_problem(data: Any) -> Problem:
    """Return the problem of a manifest, checked like a problem file; ResultError names the wrong keys."""
    from vgtm_qp.problem import Problem

    try:
        return Problem.from_dict(_with_present_keys(data), of_result=True)
    except ProblemError as error:
        mistakes = "; ".join(f"manifest.problem.{mistake}" for mistake in error.mistakes[:8])
        raise ResultError(mistakes) from None


def scene_problem(problem: Mapping[str, Any], scene: Mapping[str, Any]) -> dict[str, Any]:
    """Return the problem of a manifest with the obstacles and clearances of one of its scenes.

    What is carried is checked like an obstacle, and no two of all have the same name; ResultError names the wrong keys.
    """
    rules = {**(problem.get("clearance") or {}), "safe": scene["safe"], "self_safe": scene["self_safe"]}
    own = {**problem, "obstacle": scene["obstacle"], "clearance": rules}
    carried = [held["body"] for held in scene.get("carried") or ()]
    stored_problem({**own, "obstacle": [*scene["obstacle"], *carried]})
    return own


def _with_present_keys(data: Any) -> Any:
    """Return a manifest's problem with ``tracking_mode`` instead of ``hard_tracking``, its former key."""
    method = data.get("method") if isinstance(data, Mapping) else None
    if not isinstance(method, Mapping) or not isinstance(method.get("hard_tracking"), bool):
        return data
    present = {key: value for key, value in method.items() if key != "hard_tracking"}
    if (present.get("name", "qp"), present.get("tracking", "coupled")) == ("qp", "coupled"):
        present.setdefault("tracking_mode", "hard" if method["hard_tracking"] else "elastic")
    return {**data, "method": present}


def dump_manifest(manifest: Mapping[str, Any]) -> str:
    """Return the canonical text of `manifest`; ResultError if strict JSON cannot hold it."""
    try:
        return json.dumps(
            manifest, allow_nan=False, sort_keys=True, separators=(",", ":"), ensure_ascii=False
        )
    except (TypeError, ValueError, RecursionError) as error:
        raise ResultError(f"the manifest is not strict JSON: {error}") from None


def parse_manifest(array: NDArray[Any]) -> Any:
    """Return the JSON data in the ``manifest`` array of a result file; ResultError if it is not JSON."""
    if array.dtype.kind != "U" or array.ndim != 0:
        raise ResultError("the manifest is not one string")

    def refuse(constant: str) -> None:
        raise ResultError(f"the manifest holds {constant}, which strict JSON has not")

    try:
        return json.loads(str(array), parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise ResultError(f"the manifest is not JSON: {error}") from None
