"""Whether the tip targets of a maneuver lie on its problem's path, and the tip on its targets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.errors import ProblemError
from vgtm_qp.result.manifest import file_digest
from vgtm_qp.result.poses import rotation_matrix
from vgtm_qp.result.result import Result

TIP_TOLERANCE = 1e-6
"""Tolerance of the tip's position and of its target's distance from the path, over the mean member or link."""
DIRECTION_TOLERANCE = 1e-6
"""Tolerance of the tip's direction and orientation, rad."""

_DIRECTIONS = {
    "orientation": ("tip_target_rotation", "rotation_vector"),
    "pointing": ("tip_target_pointing", "pointing"),
}
"""The array of targets and the key of a waypoint for each kind of direction that can be tracked."""


def tip_error(maneuver: Result, tip: Array) -> Array | None:
    """Return (T,) distances of the tip (T, 3) from its targets over the tracked axes, m; None without any."""
    axes = _tracked_axes(maneuver)
    if not axes:
        return None
    return np.asarray(np.linalg.norm(tip[:, axes] - maneuver.tip_target_position[:, axes], axis=1))


def direction_error(maneuver: Result, rotation: Array) -> Array | None:
    """Return (T,) angles of the tip's attitude (T, 3, 3) or z axis from its targets, rad; None if not tracked."""
    directions = {"orientation": rotation, "pointing": rotation[:, :, 2]}
    found = _direction_targets(maneuver).items()
    errors = [angles(directions[kind], targets) for kind, targets in found if targets is not None]
    return np.max(errors, axis=0) if errors else None


def check_path(maneuver: Result, tip: Array, tolerance: float) -> tuple[Array | None, list[str], list[str]]:
    """Check the targets of a maneuver whose tip was at `tip` (T, 3), m, to a tolerance, m.

    Return the distance (T,) of each position target from the path, m, or None without a path of positions;
    and contradictions and notes, as in the certificate.
    """
    wanted = maneuver.manifest["problem"].get("maneuver") or {}
    axes = _tracked_axes(maneuver)
    contradictions = [
        f"{kind} is tracked, but there is no array {_DIRECTIONS[kind][0]}"
        for kind, targets in _direction_targets(maneuver).items()
        if targets is None
    ]
    notes: list[str] = []
    corners = None
    if axes:
        try:
            corners = _corners(maneuver.manifest, tip[0])
        except (ProblemError, ValueError) as error:
            contradictions.append(f"the path cannot be read: {error}")
    if wanted.get("path") and (recorded := (maneuver.manifest.get("problem_digests") or {}).get("path")):
        file = Path(maneuver.manifest.get("directory") or ".") / str(wanted["path"])
        if file_digest(file) != recorded:
            contradictions.append(f"maneuver.path: {file} is not the file that the result was made with")
    target_error = None
    if corners is not None:
        targets = maneuver.tip_target_position
        target_error = _to_polyline(targets[:, axes], corners[:, axes])
        missed = float(np.linalg.norm(targets[-1, axes] - corners[-1, axes]))
        if maneuver.arrived and missed > tolerance:
            contradictions.append(f"arrived, but the last target is {missed:.3g} m from the end of the path")
    contradictions += _last_direction(maneuver, wanted.get("waypoint") or ())
    return target_error, contradictions, notes


def _tracked(maneuver: Result) -> tuple[str, ...]:
    """Return the coordinates of the tip that its problem tracks."""
    return tuple((maneuver.manifest["problem"].get("end_effector") or {}).get("track") or ("position",))


def _tracked_axes(maneuver: Result) -> list[int]:
    track = _tracked(maneuver)
    return [k for k, axis in enumerate("xyz") if axis in track or "position" in track]


def _direction_targets(maneuver: Result) -> dict[str, Array | None]:
    """Return the targets of each kind of direction that is tracked; None if the result lacks them."""
    kinds = (kind for kind in _DIRECTIONS if kind in _tracked(maneuver))
    return {kind: getattr(maneuver, _DIRECTIONS[kind][0]) for kind in kinds}


def _corners(manifest: Mapping[str, Any], home: Array) -> Array | None:
    """Return (C, 3) the corners of the path, from the home tip on; None if no position is asked for."""
    wanted = manifest["problem"].get("maneuver") or {}
    points: Any
    if wanted.get("path"):
        from vgtm_qp.problem.path_file import read_path

        points = read_path(Path(manifest.get("directory") or ".") / str(wanted["path"])).position
    else:
        points = [entry["position"] for entry in wanted.get("waypoint") or () if entry.get("position")]
    return np.vstack([home, np.asarray(points, dtype=np.float64)]) if len(points) else None


def _to_polyline(points: Array, corners: Array) -> Array:
    """Return (T,) the distances of points (T, A) from the polyline through corners (C, A)."""
    start, along = corners[:-1], np.diff(corners, axis=0)
    square = np.maximum(np.sum(along * along, axis=1), np.finfo(np.float64).tiny)
    best = np.full(len(points), np.inf)
    for k in range(len(start)):
        share = np.clip((points - start[k]) @ along[k] / square[k], 0.0, 1.0)
        apart = np.linalg.norm(points - start[k] - share[:, None] * along[k], axis=1)
        best = np.minimum(best, apart)
    return best


def _last_direction(maneuver: Result, waypoints: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a contradiction if a maneuver arrives in another direction than its last waypoint has."""
    for kind, targets in _direction_targets(maneuver).items():
        key = _DIRECTIONS[kind][1]
        goals = [np.asarray(entry[key], dtype=np.float64) for entry in waypoints if entry.get(key)]
        if maneuver.arrived and goals and targets is not None:
            goal = rotation_matrix(goals[-1]) if kind == "orientation" else goals[-1]
            off = float(angles(targets[-1:], goal[None])[0])
            if off > DIRECTION_TOLERANCE:
                yield f"arrived, but the last {kind} target is {off:.3g} rad from the problem's"


def angles(first: Array, second: Array) -> Array:
    """Return (T,) the angles between vectors (T, 3) or rotations (T, 3, 3), rad, accurate near 0."""
    if first.ndim == 3:
        # |A - B| = 2 sqrt(2) sin(angle / 2).
        apart = np.linalg.norm(first - second, axis=(1, 2))
        return np.asarray(2.0 * np.arcsin(np.clip(apart / np.sqrt(8.0), 0.0, 1.0)))
    across = np.linalg.norm(np.cross(first, second), axis=1)
    return np.asarray(np.arctan2(across, np.sum(first * second, axis=1)))
