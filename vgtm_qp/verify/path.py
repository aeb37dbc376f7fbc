"""Whether the tip targets of a maneuver lie on its problem's path, and the tip on its targets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import ProblemError
from vgtm_qp.result.result import Result
from vgtm_qp.result.rotation import rotation_matrix

Array = NDArray[np.float64]

_DIRECTION_TOLERANCE = 1e-6
_POSITION_TOLERANCE = 1e-6


@dataclass(frozen=True)
class PathCheck:
    """What was asked of the tip, and how far the targets are from it.

    Attributes
    ----------
    maneuver : Result
        Holds the targets.
    axes : tuple of int
        The tracked coordinates of the position.
    tracks_pointing, tracks_orientation : bool
        Whether a direction or the whole attitude was tracked.
    is_elastic : bool
        Whether the tip may leave its targets at a cost.
    target_error : (T,) or None
        Distance of each position target from the path, m.
    contradictions, notes : tuple of str
        As in the certificate.
    """

    maneuver: Result
    axes: tuple[int, ...]
    tracks_pointing: bool
    tracks_orientation: bool
    is_elastic: bool
    target_error: Array | None
    contradictions: tuple[str, ...]
    notes: tuple[str, ...]

    def tip_error(self, tip: Array) -> Array | None:
        """Return (T,) distances of the tip (T, 3) from its targets over the tracked axes, m."""
        if not self.axes:
            return None
        axes = list(self.axes)
        return np.asarray(np.linalg.norm(tip[:, axes] - self.maneuver.tip_target_position[:, axes], axis=1))

    def direction_error(self, rotation: Array) -> Array | None:
        """Return (T,) angles of the tip's attitude (T, 3, 3) or z axis from its targets, rad."""
        errors = []
        if self.tracks_orientation and self.maneuver.tip_target_rotation is not None:
            errors.append(_rotation_angle(rotation, self.maneuver.tip_target_rotation))
        if self.tracks_pointing and self.maneuver.tip_target_pointing is not None:
            errors.append(_angle(rotation[:, :, 2], self.maneuver.tip_target_pointing))
        return np.max(errors, axis=0) if errors else None


def check_path(maneuver: Result, tip: Array) -> PathCheck:
    """Return what the problem of `maneuver` asks of the tip, whose positions (T, 3), m, are `tip`."""
    manifest = maneuver.manifest
    problem = manifest["problem"]
    effector = problem.get("end_effector") or {}
    track = tuple(effector.get("track") or ("position",))
    axes = (0, 1, 2) if "position" in track else tuple(k for k, axis in enumerate("xyz") if axis in track)
    wanted = problem.get("maneuver") or {}
    contradictions: list[str] = []
    notes: list[str] = []
    for kind, stored in (
        ("orientation", maneuver.tip_target_rotation),
        ("pointing", maneuver.tip_target_pointing),
    ):
        if kind in track and stored is None:
            array = "tip_target_rotation" if kind == "orientation" else "tip_target_pointing"
            contradictions.append(f"{kind} is tracked, but there is no array {array}")

    corners = None
    if wanted.get("kind") == "deployment":
        notes.append("a deployment has no path to check the targets against")
    elif axes:
        try:
            corners = _corners(manifest, tip[0])
        except (ProblemError, ValueError) as error:
            contradictions.append(f"the path cannot be read: {error}")
    target_error = None
    if corners is not None:
        targets = maneuver.tip_target_position
        target_error = _to_polyline(targets[:, axes], corners[:, axes])
        missed = float(np.linalg.norm(targets[-1, axes] - corners[-1, axes]))
        if maneuver.status == "solved" and missed > _POSITION_TOLERANCE:
            contradictions.append(f"solved, but the last target is {missed:.3g} m from the end of the path")
    contradictions += _last_direction(maneuver, wanted, track)
    return PathCheck(
        maneuver,
        axes,
        "pointing" in track,
        "orientation" in track,
        effector.get("mode") == "elastic",
        target_error,
        tuple(contradictions),
        tuple(notes),
    )


def _corners(manifest: Mapping[str, Any], home: Array) -> Array | None:
    """Return (C, 3) the corners of the path, from the home tip on; None if no position is asked for."""
    wanted = manifest["problem"].get("maneuver") or {}
    points: Any
    if manifest.get("path"):
        points = manifest["path"]
    elif wanted.get("path"):
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


def _last_direction(maneuver: Result, wanted: Mapping[str, Any], track: tuple[str, ...]) -> list[str]:
    """Return whether a solved maneuver ends in another direction than the last waypoint that names one."""
    if maneuver.status != "solved":
        return []
    found = []
    waypoints = wanted.get("waypoint") or ()
    pointing = [entry["pointing"] for entry in waypoints if entry.get("pointing")]
    if pointing and "pointing" in track and maneuver.tip_target_pointing is not None:
        off = float(_angle(maneuver.tip_target_pointing[-1:], np.array([pointing[-1]], dtype=float))[0])
        if off > _DIRECTION_TOLERANCE:
            found.append(f"solved, but the last pointing target is {off:.3g} rad from the problem's")
    turned = [entry["rotation_vector"] for entry in waypoints if entry.get("rotation_vector")]
    if turned and "orientation" in track and maneuver.tip_target_rotation is not None:
        goal = rotation_matrix(np.asarray(turned[-1], dtype=np.float64))
        off = float(_rotation_angle(maneuver.tip_target_rotation[-1:], goal[None])[0])
        if off > _DIRECTION_TOLERANCE:
            found.append(f"solved, but the last orientation target is {off:.3g} rad from the problem's")
    return found


def _angle(first: Array, second: Array) -> Array:
    """Return (T,) the angles between vectors (T, 3), rad, accurate near 0."""
    across = np.linalg.norm(np.cross(first, second), axis=1)
    return np.asarray(np.arctan2(across, np.sum(first * second, axis=1)))


def _rotation_angle(first: Array, second: Array) -> Array:
    """Return (T,) the angles between rotations (T, 3, 3), rad: |A - B| = 2 sqrt(2) sin(angle / 2)."""
    apart = np.linalg.norm(first - second, axis=(1, 2))
    return np.asarray(2.0 * np.arcsin(np.clip(apart / np.sqrt(8.0), 0.0, 1.0)))
