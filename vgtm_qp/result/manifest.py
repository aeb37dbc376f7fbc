"""The manifest of a result file: problem, arm, outcome and versions as strict JSON data."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from vgtm_qp.errors import ResultError
from vgtm_qp.machine import versions
from vgtm_qp.result.certificate import Certificate

SCHEMA_VERSION = 1
"""Version of the result file that this package writes and reads."""

STATUSES = ("solved", "blocked", "infeasible")

_PACKAGES = ("vgtm-qp", "numpy", "casadi", "daqp", "osqp", "piqp", "python-fcl", "qpsolvers", "trimesh")
_MANIFEST_KEYS = ("schema_version", "problem", "arm", "status", "reached", "blocked_by", "versions")


def make_manifest(
    problem: Mapping[str, Any],
    arm: Mapping[str, Any],
    *,
    status: str,
    reached: float,
    blocked_by: Iterable[str] = (),
    stop: Mapping[str, Any] | None = None,
    way_out: str = "",
    recovered: Mapping[str, float] | None = None,
    method: str,
    solver: str | None,
    setup_time: float,
    directory: str | Path = ".",
    meshes: Mapping[str, Mapping[str, Any]] | None = None,
) -> dict[str, Any]:
    """Return the manifest of a result file.

    Parameters
    ----------
    problem, arm : mapping
        The whole problem as JSON data, in the form of the problem file; what the arm's `record` returns.
    status, reached, blocked_by
        One of `STATUSES`, the share of the path covered, 0 to 1, and the names of what stopped it.
    stop : mapping, optional
        What ``Stop.to_dict`` returns.
    way_out : str
        The change of the problem with which a retry came further, empty if there was none.
    recovered : mapping, optional
        Pairs below their clearance in the home pose, ``member / obstacle`` or ``member / member``, and their
        distances there, m.
    method, solver, setup_time
        As in the problem's ``[method]``; what solved the QPs, None where the method solves none; s.
    directory : path
        Where the relative paths of the problem start.
    meshes : mapping, optional
        What `mesh_record` returns for each mesh obstacle, by the obstacle's name.
    """
    return {
        "schema_version": SCHEMA_VERSION,
        "problem": dict(problem),
        "arm": dict(arm),
        "status": status,
        "reached": float(reached),
        "blocked_by": list(blocked_by),
        "stop": None if stop is None else dict(stop),
        "way_out": way_out,
        "recovered": [
            {"pair": pair, "distance": float(apart)} for pair, apart in sorted((recovered or {}).items())
        ],
        "method": method,
        "solver": solver,
        "setup_time": float(setup_time),
        "directory": str(Path(directory).resolve()),
        "meshes": {name: dict(record) for name, record in (meshes or {}).items()},
        "versions": _versions(),
        "certificate": None,
    }


def mesh_record(path: str | Path, triangles: int) -> dict[str, Any]:
    """Return what ties a result to a mesh file: its SHA-256 and the number of its triangles."""
    return {"sha256": hashlib.sha256(Path(path).read_bytes()).hexdigest(), "triangles": int(triangles)}


def _versions() -> dict[str, str]:
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
    if copy["status"] not in STATUSES:
        raise ResultError(f"manifest.status is {copy['status']!r}; expected one of {', '.join(STATUSES)}")
    reached = copy["reached"]
    if isinstance(reached, bool) or not isinstance(reached, int | float) or not 0.0 <= reached <= 1.0:
        raise ResultError(f"manifest.reached is {reached!r}; expected a number from 0 to 1")
    names = copy["blocked_by"]
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ResultError("manifest.blocked_by is not a list of names")
    if copy.get("certificate") is not None:
        if not isinstance(copy["certificate"], dict):
            raise ResultError("manifest.certificate is not a JSON object")
        Certificate.from_dict(copy["certificate"])
    return copy


def dump_manifest(manifest: Mapping[str, Any]) -> str:
    """Return the canonical text of `manifest`; ResultError if strict JSON cannot hold it."""
    try:
        return json.dumps(
            manifest, allow_nan=False, sort_keys=True, separators=(",", ":"), ensure_ascii=False
        )
    except (TypeError, ValueError) as error:
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
