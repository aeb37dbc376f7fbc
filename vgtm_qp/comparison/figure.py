"""One figure for a comparison: the end state of every method, and its clearance and drift along the path."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull

from vgtm_qp.arrays import Array
from vgtm_qp.comparison.row import Row
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.view.drawing import drawing_of_maneuver

_COLUMNS = 5
_FLOOR = 1e-16


def plot_comparison(rows: Sequence[Row], maneuvers: Mapping[tuple[str, str], Maneuver]) -> Figure:
    """Return the figure: one panel a maneuver with its start, middle and end; below, clearance and drift."""
    keys = [(row.problem, row.method) for row in rows]
    lines = -(-len(keys) // _COLUMNS)
    figure = Figure(figsize=(11.0, 3.1 * lines + 3.0), layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=[3.1 * lines, 3.0]).ravel()
    panels = upper.subplots(lines, min(_COLUMNS, len(keys)), squeeze=False).ravel()
    for axes in panels[len(keys) :]:
        axes.set_axis_off()
    limits = _limits(list(maneuvers.values()))
    for axes, key, row in zip(panels, keys, rows, strict=False):
        _draw_maneuver(axes, row, maneuvers.get(key), limits)
    several = len({problem for problem, _ in keys}) > 1
    _draw_curves(lower, rows, maneuvers, several)
    return figure


def _draw_maneuver(axes: Axes, row: Row, maneuver: Maneuver | None, limits: tuple[Array, Array]) -> None:
    verdict = "solved" if row.solved else "keeps all but drifts" if row.kept else "failed"
    colour = {"solved": "tab:green", "failed": "tab:red"}.get(verdict, "tab:orange")
    axes.set_title(
        f"{row.method}\n{verdict}, {100 * row.reached:.0f} % of the path", fontsize=7.5, color=colour
    )
    axes.set(aspect="equal", **dict(zip(("xlim", "ylim"), np.transpose(limits), strict=True)))
    axes.tick_params(labelsize=6.5)
    if maneuver is None:
        axes.text(0.5, 0.5, _folded(row.reason), transform=axes.transAxes, ha="center", fontsize=6.5)
        return
    for outline in _outlines(maneuver):
        axes.fill(*outline.T, color="0.75", zorder=0)
    last = len(maneuver.time) - 1
    for index, shade in ((0, 0.25), (last // 2, 0.45), (last, 1.0)):
        draw_members(axes, maneuver.nodes[index], maneuver.members, maneuver.member_actuated, shade)
    axes.plot(*maneuver.tip_position[:, [0, 2]].T, color="tab:red", linewidth=0.8)
    if not row.solved:
        axes.set_xlabel(_folded(row.reason), fontsize=6.0)


def draw_members(
    axes: Axes, nodes: ArrayLike, members: ArrayLike, actuated: ArrayLike, shade: float = 1.0
) -> None:
    """Draw members (M, 2) between `nodes` (N, 3) as seen along y: fixed ones grey, actuated ones blue."""
    ends = np.asarray(nodes)[np.asarray(members, dtype=int)][:, :, [0, 2]]
    on = np.asarray(actuated, dtype=bool)
    for some, colour, width in ((~on, "0.4", 0.7), (on, "tab:blue", 0.9)):
        axes.add_collection(LineCollection(list(ends[some]), colors=colour, linewidths=width, alpha=shade))
    axes.set_aspect("equal")
    axes.autoscale_view()


def _draw_curves(
    area: Any, rows: Sequence[Row], maneuvers: Mapping[tuple[str, str], Maneuver], several: bool
) -> None:
    clearance, drift = area.subplots(1, 2)
    handles = []
    for k, row in enumerate(rows):
        maneuver = maneuvers.get((row.problem, row.method))
        if maneuver is None:
            continue
        dashes = ("-", "--", ":")[k // 10 % 3]
        style: dict[str, Any] = {"color": f"C{k % 10}", "linestyle": dashes, "linewidth": 1.1}
        fixed = ~maneuver.member_actuated
        off = np.abs(maneuver.member_lengths - maneuver.member_lengths[0])[:, fixed].max(axis=1, initial=0.0)
        near = np.where(np.isfinite(maneuver.clearance), maneuver.clearance, np.nan)
        clearance.plot(maneuver.progress, near, **style)
        drift.semilogy(maneuver.progress, np.maximum(off, _FLOOR), **style)
        label = f"{row.problem}: {row.method}" if several else row.method
        handles.append(Line2D([], [], label=label, **style))
        safe = maneuver.manifest["problem"]["clearance"]["safe"]
        clearance.axhline(safe, color="0.5", linewidth=0.6)
    clearance.set_ylabel("clearance at the states [m]", fontsize=8)
    drift.set_ylabel("worst fixed member [m]", fontsize=8)
    for axes in (clearance, drift):
        axes.set_xlabel("part of the path", fontsize=8)
        axes.tick_params(labelsize=7)
    area.legend(handles=handles, loc="outside right center", fontsize=7, frameon=False)


def _outlines(maneuver: Maneuver) -> list[Array]:
    """Return the outlines (K, 2) of the obstacles at the end, seen along y."""
    outlines = []
    for mesh in drawing_of_maneuver(maneuver).obstacles:
        points = (mesh.vertices + mesh.position(float(maneuver.time[-1])))[:, [0, 2]]
        outlines.append(points[ConvexHull(points).vertices])
    return outlines


def _limits(maneuvers: list[Maneuver]) -> tuple[Array, Array]:
    points = [maneuver.nodes[:, :, [0, 2]].reshape(-1, 2) for maneuver in maneuvers]
    stacked = np.concatenate(points) if points else np.zeros((1, 2))
    # A method that breaks down may throw nodes far away: the view shows nearly all points, not all.
    low, high = np.percentile(stacked, (0.5, 99.5), axis=0)
    for outline in (outline for maneuver in maneuvers for outline in _outlines(maneuver)):
        low, high = np.minimum(low, outline.min(axis=0)), np.maximum(high, outline.max(axis=0))
    margin = 0.08 * float(np.max(high - low)) + 1e-9
    return low - margin, high + margin


def _folded(text: str) -> str:
    return "\n".join(textwrap.wrap(text, 36)[:3])
