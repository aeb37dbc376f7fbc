"""Distances of an arm's stations from their nodes on the reference curve, and of the curve's end from the tip."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import comb
from typing import Any, NamedTuple

import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import ResultError
from vgtm_qp.result.certificate import Measure
from vgtm_qp.result.poses import base_poses, rotations
from vgtm_qp.result.record import Record
from vgtm_qp.result.result import Result
from vgtm_qp.verify.arm import polygon_frame
from vgtm_qp.verify.path import DIRECTION_TOLERANCE, angles

TRACKING_TOLERANCE = 1e-6
"""Tolerance of stations with exact tracking and of the curve's end, over the mean length of members or links."""

_PIECES, _FEWEST = 1600, 100
"""Number of chords that measure the arc length of a curve, and least number in each Bezier segment."""
_REFINEMENTS = 3

_ROUNDING = 1e-9
_ENDS_AT_TIP = 3
"""Least number of control vertices of a curve that ends in the tip; one more to end along its direction."""


class RecordedCurve(NamedTuple):
    """A curve as the manifest records it: a chain of Bezier segments whose points are averages of control vertices.

    Attributes
    ----------
    breaks : (S + 1,)
        Parameters at which the segments begin and end.
    extraction : (S, d + 1, V)
        Bezier points of each segment as averages of the control vertices.
    nodes : (K,)
        Parameters of the curve nodes, or their shares of the arc length where `by_arc_length`.
    stations, weights : (K, Q) int, (K, Q)
        The nodes whose weighted mean each station is.
    frames : (K or 0, 3, 3)
        Frames at home of stations whose normals are kept along the curve.
    """

    breaks: Array
    extraction: Array
    nodes: Array
    by_arc_length: bool
    stations: Index
    weights: Array
    frames: Array = np.zeros((0, 3, 3))

    @classmethod
    def of(cls, record: Mapping[str, Any], nodes: int, vertices: int) -> RecordedCurve:
        """Read ``Layout.record``; ResultError if it does not fit the number of nodes or control vertices."""
        table = Record(record, "manifest.curve")
        breaks = table.numbers("breaks", (None,))
        if len(breaks) < 2 or (np.diff(breaks) <= 0.0).any():
            raise ResultError("manifest.curve.breaks do not increase from the begin of a segment to its end")
        extraction = table.numbers("extraction", (len(breaks) - 1, None, vertices))
        if extraction.shape[1] < 2:
            raise ResultError("manifest.curve.extraction has less than two points of a segment")
        at = table.numbers("nodes", (None,))
        if not len(at):
            raise ResultError("manifest.curve.nodes is empty")
        stations = table.integers("stations", (len(at), None), nodes)
        weights = table.numbers("weights", stations.shape)
        frames = np.zeros((0, 3, 3))
        # Earlier versions did not record frames.
        if table.has("frames") and record["frames"]:
            frames = table.numbers("frames", (len(at), 3, 3))
        return cls(breaks, extraction, at, table.flag("by_arc_length"), stations, weights, frames)

    def at(self, s: Array, vertices: Array) -> Array:
        """Return (T, K, 3) the points at parameters `s` (T, K) of curves with control vertices (T, V, 3), m."""
        return self._mean(self.extraction, s, vertices)

    def _mean(self, tables: Array, s: Array, vertices: Array) -> Array:
        """Return (T, K, 3) the points at `s` (T, K) of Bezier segments with points `tables` (S, d + 1, V)."""
        segment = np.searchsorted(self.breaks[1:-1], s, side="right")
        u = (s - self.breaks[segment]) / np.diff(self.breaks)[segment]
        degree = tables.shape[1] - 1
        j = np.arange(degree + 1)
        share = (
            np.array([comb(degree, k) for k in j]) * u[..., None] ** j * (1.0 - u[..., None]) ** (degree - j)
        )
        return np.asarray(np.einsum("tkj,tkjv->tkv", share, tables[segment]) @ vertices)

    def points(self, vertices: Array) -> Array:
        """Return (T, K, 3) the curve nodes of curves with control vertices (T, V, 3), m."""
        return self.at(self._parameters(vertices), vertices)

    def tangents(self, vertices: Array) -> Array:
        """Return (T, K, 3) the directions of the curves at their nodes, not of unit length."""
        return self._mean(np.diff(self.extraction, axis=1), self._parameters(vertices), vertices)

    def _parameters(self, vertices: Array) -> Array:
        """Return (T, K) the parameters of the curve nodes."""
        if not self.by_arc_length:
            return np.tile(self.nodes, (len(vertices), 1))
        states = np.arange(len(vertices))[:, None]
        pieces = max(_PIECES // (len(self.breaks) - 1), _FEWEST)
        within = np.arange(2 * pieces) / (2 * pieces)
        fine = (self.breaks[:-1, None] + np.diff(self.breaks)[:, None] * within).reshape(-1)
        fine = np.append(fine, self.breaks[-1])
        points = self.at(np.tile(fine, (len(vertices), 1)), vertices)
        halves = np.linalg.norm(np.diff(points, axis=1), axis=2)
        whole = np.linalg.norm(np.diff(points[:, ::2], axis=1), axis=2)
        # With twice as many chords the error of the length is a quarter: Richardson extrapolation.
        arcs = (4.0 * (halves[:, ::2] + halves[:, 1::2]) - whole) / 3.0
        travelled = np.pad(np.cumsum(arcs, axis=1), ((0, 0), (1, 0)))
        wanted = self.nodes * travelled[:, -1:]
        piece = np.array(
            [np.searchsorted(a[1:-1], w, side="right") for a, w in zip(travelled, wanted, strict=True)]
        )
        left, start, before = wanted - travelled[states, piece], fine[2 * piece], points[states, 2 * piece]
        s = start + (fine[2 * piece + 2] - start) * left / arcs[states, piece]
        for _ in range(_REFINEMENTS):
            chord = np.linalg.norm(self.at(s, vertices) - before, axis=2)
            share = np.divide(left, chord, out=np.ones_like(left), where=chord > 0.0)
            s = np.clip(start + (s - start) * share, 0.0, 1.0)
        return np.asarray(s)

    def end_direction(self, vertices: Array) -> Array:
        """Return (T, 3) the direction in which the curves end."""
        ends = self.extraction[-1, -2:] @ vertices
        return np.asarray(ends[:, 1] - ends[:, 0])


def recorded_curve(maneuver: Result) -> RecordedCurve | None:
    """Return the curve that a maneuver records; None without one."""
    record, vertices = maneuver.manifest.get("curve"), maneuver.control_vertices.shape[1]
    return (
        None
        if record is None or not vertices
        else RecordedCurve.of(record, maneuver.nodes.shape[1], vertices)
    )


def greatest_gaps(maneuver: Result) -> Array | None:
    """Return (T,) the greatest of the gaps in every state, m; None without a curve."""
    curve = recorded_curve(maneuver)
    return None if curve is None else gaps(maneuver, curve).max(axis=1)


def gaps(maneuver: Result, curve: RecordedCurve) -> Array:
    """Return (T, K) the distances of the stations from the nodes of their curve in every state, m."""
    stations = np.einsum("kq,tkqc->tkc", curve.weights, maneuver.nodes[:, curve.stations])
    return np.asarray(np.linalg.norm(stations - curve.points(maneuver.control_vertices), axis=2))


def _turns(maneuver: Result, curve: RecordedCurve) -> Array:
    """Return (T, K) the angles between the stations' normals and the curve in every state, rad."""
    tangents, found = curve.tangents(maneuver.control_vertices), []
    for k, nodes in enumerate(curve.stations):
        polygons = maneuver.nodes[:, nodes]
        home, angle = polygon_frame(polygons[0], None)
        frames = np.stack([polygon_frame(polygon, angle)[0] for polygon in polygons])
        found.append(angles((frames @ home.T @ curve.frames[k])[:, :, 2], tangents[:, k]))
    return np.stack(found, axis=1)


def curve_measures(maneuver: Result, rotation: Array, size: float) -> dict[str, Measure]:
    """Return the measures of a maneuver's curve, whose tip has the attitudes `rotation` (T, 3, 3).

    Tolerances are for members or links whose mean length is `size`, m.
    """
    curve, vertices = recorded_curve(maneuver), maneuver.control_vertices
    if curve is None:
        return {}
    table, tolerance = Record(maneuver.manifest["curve"], "manifest.curve"), TRACKING_TOLERANCE * size
    off = gaps(maneuver, curve)
    # At home the curve is only fitted to the arm, which may be bent.
    moved = off[min(1, len(off) - 1) :]
    row, k = divmod(int(np.argmax(moved)), moved.shape[1])
    row += len(off) - len(moved)
    is_hard = keeps_stations(maneuver.manifest["problem"]) and len(off) > 1
    found = {
        "tracking_gap": Measure(
            float(off[row, k]),
            "m",
            tolerance if is_hard else None,
            "most",
            f"row {row}, station {k + 1}",
        ),
        "states_off_curve": Measure(float(np.mean(moved.max(axis=1) > tolerance)), "of the states"),
    }
    if len(curve.frames):
        turned = _turns(maneuver, curve)
        row, k = divmod(int(np.argmax(turned[-len(moved) :])), moved.shape[1])
        row += len(off) - len(moved)
        found["tracking_angle"] = Measure(
            float(turned[row, k]),
            "rad",
            DIRECTION_TOLERANCE if is_hard else None,
            "most",
            f"row {row}, station {k + 1}",
        )
    if table.has("start"):
        found |= _start(maneuver, table, tolerance)
    ends = {
        "curve_end_gap": ("ends_at_tip", off[:, -1], "m", tolerance),
        "curve_end_angle": (
            "ends_along_tip",
            angles(curve.end_direction(vertices), rotation[:, :, 2]),
            "rad",
            DIRECTION_TOLERANCE,
        ),
    }
    for name, (key, errors, unit, bound) in ends.items():
        if table.flag(key):
            row = int(np.argmax(errors))
            found[name] = Measure(float(errors[row]), unit, bound, "most", f"row {row}")
    return found


def _start(maneuver: Result, table: Record, tolerance: float) -> dict[str, Measure]:
    """Return the distance of the curve's start from the base, m, and its angle to the base's normal, rad."""
    nodes, vertices = maneuver.nodes, maneuver.control_vertices
    start = table.integers("start", (None,), nodes.shape[1])
    weights, normal = table.numbers("start_weights", start.shape), table.numbers("normal", (3,))
    turned = rotations(base_poses(maneuver.manifest["problem"], maneuver.time)[:, 3:]) @ normal
    off = np.linalg.norm(vertices[:, 0] - np.einsum("q,tqc->tc", weights, nodes[:, start]), axis=1)
    found = {"curve_start_gap": (off, "m", tolerance)}
    if vertices.shape[1] > 1:
        aside = angles(vertices[:, 1] - vertices[:, 0], turned)
        found["curve_start_angle"] = (aside, "rad", DIRECTION_TOLERANCE)
    return {
        name: Measure(float(errors.max()), unit, bound, "most", f"row {int(np.argmax(errors))}")
        for name, (errors, unit, bound) in found.items()
    }


def keeps_stations(problem: Mapping[str, Any]) -> bool:
    """Return whether the method of a problem keeps stations on the curve, or else stops the arm."""
    method = problem.get("method") or {}
    # Results of earlier versions lack this key, and do not record their curve.
    if "tracking_mode" not in method or method.get("name") != "qp":
        return False
    tracking = method.get("tracking")
    return tracking in ("recursive", "parallel") or (
        tracking == "coupled" and method["tracking_mode"] == "hard"
    )


def curve_contradictions(maneuver: Result) -> Iterator[str]:
    """Yield contradictions of the recorded curve with its problem, which make its measures meaningless."""
    problem, record = maneuver.manifest["problem"], maneuver.manifest.get("curve")
    truss, vertices = problem.get("truss") or {}, maneuver.control_vertices.shape[1]
    if record is None or not vertices:
        if keeps_stations(problem) and (truss.get("module") != "graph" or truss.get("faces")):
            yield "manifest.curve is missing, but the problem keeps stations on the curve"
        return
    table = Record(record, "manifest.curve")
    curve, held = RecordedCurve.of(record, maneuver.nodes.shape[1], vertices), table.flag("held")
    for name, shares in (("extraction", curve.extraction), ("weights", curve.weights)):
        if np.abs(shares.sum(axis=-1) - 1.0).max() > _ROUNDING:
            yield f"manifest.curve.{name} are not those of means: they do not add up to 1"
    # Two joints in one place may both be stations.
    for name, values, least in (
        ("breaks", curve.breaks, np.nextafter(0.0, 1.0)),
        ("nodes", np.append(0.0, curve.nodes), 0.0),
    ):
        if np.abs(values[[0, -1]] - [0.0, 1.0]).max() > _ROUNDING or (np.diff(values) < least).any():
            yield f"manifest.curve.{name} do not increase to 1"
    if "bays" in truss:
        count = truss["bays"] // (2 if truss["module"] == "longeron" and held else 1)
        if len(curve.nodes) != count:
            yield f"manifest.curve has {len(curve.nodes)} stations; this truss has {count}"
    arm = maneuver.manifest["arm"]
    tip = arm["tip"]
    last = tip["nodes"] if isinstance(tip, Mapping) else [len(arm["joint_names"]) + 1]
    track = (problem.get("end_effector") or {}).get("track") or ()
    if not np.array_equal(np.sort(curve.stations[-1]), np.sort(last)):
        if truss.get("module") != "graph":
            yield "manifest.curve.stations do not end with the end effector"
    elif vertices >= _ENDS_AT_TIP and not table.flag("ends_at_tip"):
        yield "manifest.curve.ends_at_tip is false, but the last station is the end effector"
    elif (
        vertices > _ENDS_AT_TIP
        and {"pointing", "orientation"} & {*track}
        and not table.flag("ends_along_tip")
    ):
        yield "manifest.curve.ends_along_tip is false, but the direction of the tip is tracked"
