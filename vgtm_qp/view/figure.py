"""Frames of a maneuver on paper, like the paper's figure 8."""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import Normal, Stroke
from numpy.typing import NDArray

from vgtm_qp.errors import ResultError, VgtmError
from vgtm_qp.result.result import Result
from vgtm_qp.view.drawing import (
    CURVE_COLOUR,
    FIXED_COLOUR,
    OBSTACLE_COLOUR,
    PATH_COLOUR,
    POLYGON_COLOUR,
    Drawing,
    drawing_of_maneuver,
    stroke_colours,
)
from vgtm_qp.view.projection import ProjectedMesh, Projection, layers, pieces

Array = NDArray[np.float64]

SUFFIXES = (".pdf", ".png", ".svg")
_STYLE: Any = {"font.size": 8.0, "font.family": "sans-serif", "pdf.fonttype": 42, "svg.fonttype": "none"}
_WIDTH = 7.1
_GREATEST_HEIGHT = 9.0
_MARGIN, _GAP, _TITLE, _FOOT = 0.42, 0.16, 0.24, 0.95
_POINTS_PER_INCH = 72.0
_DARK = (0.12, 0.12, 0.14)
_GRID = (0.80, 0.80, 0.82)
_PIECES, _MANY_MEMBERS, _SLICES = 8, 1500, 12
_THINNEST, _CASING = 0.5, 0.7
_ABOVE = 100.0
_LABELS = {
    "x": ((0.0, -2.5), (0.0, -10.5), "center", "top"),
    "y": ((4.0, -1.0), (13.0, -5.0), "left", "center"),
    "z": ((-3.0, 0.0), (-13.0, 0.0), "right", "center"),
}
"""Where numbers and name of an axis stand, points from their places, and how they are aligned."""
_POLYGON: dict[str, Any] = {"linewidth": 0.7, "linestyle": (0, (4, 2)), "zorder": _ABOVE}
_GOAL: dict[str, Any] = {"marker": "x", "markersize": 4.5, "markeredgewidth": 1.1, "linestyle": "none"}


def plot_frames(
    maneuver: Result,
    *,
    frames: int | Sequence[int] = 6,
    azimuth: float | None = None,
    elevation: float = 0.21,
) -> Figure:
    """Return a figure of states of a maneuver side by side, all in the same view and scale.

    Members are drawn as thick as they are, grey where fixed and coloured by length where actuated; with them
    the reference curve, its control polygon, the obstacles, the tip's path so far and the rest of it.

    Parameters
    ----------
    maneuver
        What `solve` or `load_result` returns.
    frames
        How many states, evenly spread, or which ones.
    azimuth, elevation
        Where the view is taken from, rad; by default across the path of the tip.

    Raises
    ------
    VgtmError
        There is no such state.
    """
    drawing = drawing_of_maneuver(maneuver)
    rows = _rows(maneuver, frames)
    projection = Projection.looking(_across(maneuver) if azimuth is None else azimuth, elevation)
    surfaces = [ProjectedMesh(mesh, projection) for mesh in drawing.obstacles]
    view = _view(maneuver, drawing, rows, projection, surfaces)
    columns = min(3, len(rows)) if len(rows) != 4 else 4
    with mpl.rc_context(_STYLE):
        figure, panels, scale = _panels(view, len(rows), columns)
        for k, (row, axes) in enumerate(zip(rows, panels, strict=True)):
            at_left, at_bottom = k % columns == 0, k + columns >= len(rows)
            _draw_floor(axes, view, projection, scale, ruler=at_left, labels=at_left and at_bottom)
            _draw_state(axes, maneuver, drawing, row, projection, surfaces, scale)
            _draw_tip(axes, maneuver, row, projection)
            letter = f"({chr(ord('a') + k)}) " if 1 < len(rows) <= 26 else ""
            title = f"{letter}step {row}, {maneuver.time[row]:.3g} s"
            axes.set_title(title, fontsize=8.0, pad=3.0)
        _draw_legend(figure, drawing, bool(len(surfaces)))
    return figure


def each_frame(
    maneuver: Result, rows: Sequence[int], *, azimuth: float | None = None, elevation: float = 0.21
) -> Iterator[Figure]:
    """Yield one figure for each of the states `rows`, all in the view that holds the whole maneuver.

    Raises
    ------
    VgtmError
        There is no such state.
    """
    drawing = drawing_of_maneuver(maneuver)
    projection = Projection.looking(_across(maneuver) if azimuth is None else azimuth, elevation)
    surfaces = [ProjectedMesh(mesh, projection) for mesh in drawing.obstacles]
    view = _view(maneuver, drawing, list(range(len(maneuver.time))), projection, surfaces)
    for row in _rows(maneuver, rows):
        with mpl.rc_context(_STYLE):
            figure, panels, scale = _panels(view, 1, 1)
            _draw_floor(panels[0], view, projection, scale, ruler=True, labels=True)
            _draw_state(panels[0], maneuver, drawing, row, projection, surfaces, scale)
            _draw_tip(panels[0], maneuver, row, projection)
            panels[0].set_title(f"{maneuver.time[row]:.2f} s", fontsize=8.0, pad=3.0)
            _draw_legend(figure, drawing, bool(len(surfaces)))
        yield figure


def save_figure(figure: Figure, path: str | Path) -> Path:
    """Write a figure in the format of the suffix of `path`, one of `SUFFIXES`, and return the path.

    Raises
    ------
    VgtmError
        The suffix is another one, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise VgtmError(f'{path}: a figure cannot be "{path.suffix}"; choices: {", ".join(SUFFIXES)}')
    scratch = path.with_name(f".{path.name}.{secrets.token_hex(8)}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with mpl.rc_context(_STYLE):
                figure.savefig(scratch, dpi=220)
            scratch.replace(path)
        finally:
            scratch.unlink(missing_ok=True)
    except OSError as error:
        raise ResultError(f"{path}: cannot be written: {error.strerror or error}") from None
    return path


@dataclass(frozen=True, eq=False)
class _View:
    """What a panel shows, m.

    Attributes
    ----------
    low, high : (2,)
        Corners of the paper.
    floor : (2, 2)
        Corners of the floor, in x and y.
    ground, top : float
        Height of the floor, and of the highest tick.
    step : float
        Distance of the floor's lines and of the ticks.
    """

    low: Array
    high: Array
    floor: Array
    ground: float
    top: float
    step: float


def _rows(maneuver: Result, frames: int | Sequence[int]) -> list[int]:
    count = len(maneuver.time)
    if isinstance(frames, int):
        if frames < 1:
            raise VgtmError(f"{frames} frames; expected 1 or more")
        return [int(row) for row in np.unique(np.linspace(0, count - 1, frames).round())]
    wrong = [row for row in frames if not 0 <= row < count]
    if wrong or not len(frames):
        raise VgtmError(f"frames {list(frames)}; expected some of the states 0 to {count - 1}")
    return [int(row) for row in frames]


def _across(maneuver: Result) -> float:
    """Return the azimuth, rad, from which the tip goes to the right and a little towards the viewer."""
    way = maneuver.tip_position - maneuver.tip_position[0]
    farthest = way[int(np.argmax(np.linalg.norm(way[:, :2], axis=1)))]
    heading = float(np.arctan2(farthest[1], farthest[0])) if np.hypot(*farthest[:2]) > 1e-9 else 0.0
    return float(heading - np.radians(70.0))


def _view(
    maneuver: Result, drawing: Drawing, rows: list[int], projection: Projection, surfaces: list[ProjectedMesh]
) -> _View:
    """Return what holds the arm in all frames and, of the obstacles, what is near it."""
    arm = maneuver.nodes[rows].reshape(-1, 3)
    low, high = arm.min(axis=0), arm.max(axis=0)
    step = _round_step(float((high - low).max()) / 6.0)
    ground = float(maneuver.nodes[0, drawing.arm.base, 2].min())
    floor = _floor(low, high, step, [surface.mesh.vertices + surface.mesh.center for surface in surfaces])
    corners = np.array([[x, y, ground] for x in floor[:, 0] for y in floor[:, 1]])
    inside = projection.flat(np.concatenate([arm, corners, maneuver.tip_target_position]))
    least, most = inside.min(axis=0), inside.max(axis=0)
    room = 0.3 * (most - least).max()
    bounds = least - room, most + room
    for surface in surfaces:
        for row in rows:
            around = np.concatenate(surface.polygons(float(maneuver.time[row])))
            least = np.minimum(least, np.clip(around.min(axis=0), *bounds))
            most = np.maximum(most, np.clip(around.max(axis=0), *bounds))
    pad = 0.03 * float((most - least).max())
    return _View(least - pad, most + pad, floor, ground, float(high[2]), step)


def _floor(low: Array, high: Array, step: float, obstacles: list[Array]) -> Array:
    """Return the corners (2, 2) of the floor below the arm, `low` to `high` (3,), and obstacles near it."""
    room = 0.4 * float((high - low).max())
    least, most = low[:2], high[:2]
    for vertices in obstacles:
        least = np.minimum(least, np.clip(vertices.min(axis=0)[:2], low[:2] - room, high[:2]))
        most = np.maximum(most, np.clip(vertices.max(axis=0)[:2], low[:2], high[:2] + room))
    return np.asarray(np.stack([np.floor(least / step + 0.2), np.ceil(most / step - 0.2)]) * step)


def _round_step(size: float) -> float:
    """Return the least of 1, 2, 5 times a power of ten that is not less than `size`."""
    power = 10.0 ** np.floor(np.log10(size))
    return float(
        next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= size * (1 - 1e-9))
    )


def _panels(view: _View, count: int, columns: int) -> tuple[Figure, list[Axes], float]:
    """Return the figure, one axes a frame at equal scale, and that scale, points a metre."""
    lines = -(-count // columns)
    extent = view.high - view.low
    room = (_WIDTH - 2 * _MARGIN - (columns - 1) * _GAP) / columns
    height = (_GREATEST_HEIGHT - _FOOT - lines * (_TITLE + _GAP)) / lines
    inches = min(room / extent[0], height / extent[1])
    width, tall = extent * inches
    total = _FOOT + lines * (tall + _TITLE + _GAP)
    left = (_WIDTH - columns * width - (columns - 1) * _GAP) / 2
    figure = Figure(figsize=(_WIDTH, total))
    panels = []
    for k in range(count):
        line, column = divmod(k, columns)
        x = left + column * (width + _GAP)
        y = total - (line + 1) * (tall + _TITLE + _GAP) + _GAP
        axes = figure.add_axes((x / _WIDTH, y / total, width / _WIDTH, tall / total))
        axes.set_xlim(view.low[0], view.high[0])
        axes.set_ylim(view.low[1], view.high[1])
        axes.set_axis_off()
        panels.append(axes)
    return figure, panels, float(inches * _POINTS_PER_INCH)


def _draw_floor(
    axes: Axes, view: _View, projection: Projection, scale: float, *, ruler: bool, labels: bool
) -> None:
    """Draw the floor's lines, and ticks in metres: along x and y with `labels`, along z with `ruler`."""
    x = np.arange(view.floor[0, 0], view.floor[1, 0] + view.step / 2, view.step)
    y = np.arange(view.floor[0, 1], view.floor[1, 1] + view.step / 2, view.step)
    ends = [[[u, y[0], view.ground], [u, y[-1], view.ground]] for u in x]
    ends += [[[x[0], v, view.ground], [x[-1], v, view.ground]] for v in y]
    axes.add_collection(
        LineCollection(list(projection.flat(np.array(ends))), colors=[_GRID], linewidths=0.5, zorder=0.1)
    )
    toward = projection.axes[2]
    front = np.array([x[-1] if toward[0] > 0 else x[0], y[-1] if toward[1] > 0 else y[0]])
    if labels:
        along_x = np.stack([x, np.full_like(x, front[1]), np.full_like(x, view.ground)], axis=1)
        along_y = np.stack([np.full_like(y, front[0]), y, np.full_like(y, view.ground)], axis=1)
        for name, values, places in (("x", x, along_x), ("y", y, along_y)):
            _label(axes, name, values, projection.flat(places), scale)
    if ruler:
        corners = np.array([[u, v, view.ground] for u in (x[0], x[-1]) for v in (y[0], y[-1])])
        foot = corners[int(np.argmin(projection.flat(corners)[:, 0]))]
        z = view.ground + np.arange(0.0, view.top - view.ground + view.step / 2, view.step)
        places = projection.flat(np.column_stack([np.tile(foot[:2], (len(z), 1)), z]))
        axes.plot(*places.T, color=_GRID, linewidth=0.7, marker="_", markersize=3.0, zorder=0.1)
        _label(axes, "z", z, places, scale)


def _label(axes: Axes, name: str, values: Array, places: Array, scale: float) -> None:
    """Write numbers at ticks (K, 2) of an axis, as many as there is room for, and its name with the unit."""
    apart = scale * float(np.linalg.norm(places[-1] - places[0])) / max(len(values) - 1, 1)
    every = int(np.ceil((9.0 if name == "z" else 13.0) / max(apart, 1e-3)))
    shift, name_shift, ha, va = _LABELS[name]
    text: dict[str, Any] = {"textcoords": "offset points", "ha": ha, "va": va, "color": _DARK}
    # The corner where x and y meet is named once, on x.
    first = 1 if name == "y" else 0
    for value, place in list(zip(values, places, strict=True))[first::every]:
        axes.annotate(f"{value:g}", place, shift, fontsize=6.5, **text)
    axes.annotate(
        f"{name} (m)", places.mean(axis=0), name_shift, fontsize=7.0, rotation=90.0 * (name == "z"), **text
    )


def _draw_state(
    axes: Axes,
    maneuver: Result,
    drawing: Drawing,
    row: int,
    projection: Projection,
    surfaces: list[ProjectedMesh],
    scale: float,
) -> None:
    """Draw arm and obstacles, farthest first."""
    time, nodes = float(maneuver.time[row]), maneuver.nodes[row]
    surfaces = sorted(surfaces, key=lambda surface: surface.depth(time))
    for k, surface in enumerate(surfaces, start=1):
        _draw_surface(axes, surface, time, 2.0 * k)
    ends = drawing.ends(nodes)
    cuts = _PIECES if len(ends) <= _MANY_MEMBERS else 1
    cut = pieces(ends, cuts)
    width = np.repeat(np.maximum(2.0 * drawing.arm.radius * scale, _THINNEST), cuts)
    colour = np.repeat(drawing.colours(maneuver.member_lengths[row]), cuts, axis=0)
    middles = cut.mean(axis=1)
    depth, layer = projection.depth(middles), layers(middles, surfaces, time)
    node_depth, node_layer = projection.depth(nodes), layers(nodes, surfaces, time)
    for k in range(len(surfaces) + 1):
        order = np.flatnonzero(layer == k)
        order = order[np.argsort(depth[order], kind="stable")]
        balls = np.flatnonzero(node_layer == k)
        slices = [part for part in np.array_split(order, _SLICES) if len(part)]
        borders = np.array([depth[part[-1]] for part in slices[:-1]])
        slot = np.searchsorted(borders, node_depth[balls])
        for j, part in enumerate(slices):
            # A dark line below each member, a little wider, parts it from what is behind it.
            lines = np.repeat(projection.flat(cut[part]), 2, axis=0)
            widths = np.repeat(width[part], 2)
            widths[::2] += _CASING
            colours = np.repeat(colour[part], 2, axis=0)
            colours[::2] = _DARK
            zorder = 2.0 * k + 1.0 + j / (2.0 * _SLICES)
            axes.add_collection(
                LineCollection(list(lines), colors=colours, linewidths=widths, capstyle="butt", zorder=zorder)
            )
            places = projection.flat(nodes[balls[slot == j]])
            size = (1.15 * float(np.median(width)) + _CASING) ** 2
            axes.scatter(
                places[:, 0],
                places[:, 1],
                s=size,
                color=[_DARK],
                linewidths=0.0,
                zorder=zorder + 0.1 / _SLICES,
            )
    if drawing.curve_weights.size:
        vertices = projection.flat(maneuver.control_vertices[row])
        curve = projection.flat(drawing.curve(maneuver.control_vertices[row]))
        axes.plot(*vertices.T, color=POLYGON_COLOUR, marker="s", markersize=2.4, **_POLYGON)
        effects = [Stroke(linewidth=2.6, foreground="white"), Normal()]
        axes.plot(*curve.T, color=CURVE_COLOUR, linewidth=1.4, zorder=_ABOVE + 1, path_effects=effects)


def _draw_surface(axes: Axes, surface: ProjectedMesh, time: float, zorder: float) -> None:
    polygons = surface.polygons(time)
    axes.add_collection(
        PolyCollection(polygons, facecolors=[OBSTACLE_COLOUR], alpha=0.30, linewidths=0.0, zorder=zorder)
    )
    edge: Any = tuple(0.6 * channel for channel in OBSTACLE_COLOUR)
    for seen, width, style in ((False, 0.5, (0, (1.5, 2.0))), (True, 0.8, "solid")):
        edges = list(surface.edges(time, seen=seen))
        axes.add_collection(
            LineCollection(edges, colors=[edge], linewidths=width, linestyles=[style], zorder=zorder + 0.1)
        )
    if surface.is_convex:
        outline = PolyCollection(
            polygons, facecolors="none", edgecolors=[edge], linewidths=0.8, zorder=zorder
        )
        axes.add_collection(outline)


def _draw_tip(axes: Axes, maneuver: Result, row: int, projection: Projection) -> None:
    ahead = projection.flat(maneuver.tip_target_position[row:])
    behind = projection.flat(maneuver.tip_position[: row + 1])
    axes.plot(*ahead.T, color=PATH_COLOUR, linewidth=0.9, linestyle=(0, (1, 1.6)), zorder=_ABOVE + 2)
    axes.plot(*behind.T, color=PATH_COLOUR, linewidth=1.2, zorder=_ABOVE + 2)
    axes.plot(*behind[-1], marker="o", markersize=3.4, color=PATH_COLOUR, zorder=_ABOVE + 3)
    waypoints = maneuver.manifest["problem"]["maneuver"].get("waypoint") or ()
    goals = np.array([w["position"] for w in waypoints if w.get("position")]).reshape(-1, 3)
    axes.plot(*projection.flat(goals).T, color=PATH_COLOUR, zorder=_ABOVE + 3, **_GOAL)


def _draw_legend(figure: Figure, drawing: Drawing, obstacles: bool) -> None:
    width, height = figure.get_size_inches()
    arm = drawing.arm
    strokes = np.unique(arm.stroke[arm.actuated].round(9), axis=0)
    low, high = strokes[0] if len(strokes) == 1 else (0.0, 1.0)
    label = "length of actuated members (m)" if len(strokes) == 1 else "actuated members, share of the stroke"
    if arm.stretches.any():
        bar = figure.add_axes((_MARGIN / width, 0.52 / height, 2.3 / width, 0.09 / height))
        colours = ListedColormap(stroke_colours(np.linspace(0.0, 1.0, 256)).tolist())
        scalar = mpl.cm.ScalarMappable(Normalize(low, high), colours)
        figure.colorbar(scalar, cax=bar, orientation="horizontal", label=label)
    handles: list[Any] = [Line2D([], [], color=FIXED_COLOUR, linewidth=2.6, label=arm.rigid_body)]
    if drawing.curve_weights.size:
        handles += [
            Line2D([], [], color=CURVE_COLOUR, linewidth=1.4, label="reference curve"),
            Line2D(
                [], [], color=POLYGON_COLOUR, marker="s", markersize=2.4, label="control polygon", **_POLYGON
            ),
        ]
    handles += [
        Line2D([], [], color=PATH_COLOUR, marker="o", markersize=3.4, linewidth=1.2, label="tip and its way"),
        Line2D([], [], color=PATH_COLOUR, linewidth=0.9, linestyle=(0, (1, 1.6)), label="way ahead"),
        Line2D([], [], color=PATH_COLOUR, label="waypoint", **_GOAL),
    ]
    if obstacles:
        edge: Any = tuple(0.6 * channel for channel in OBSTACLE_COLOUR)
        handles.append(
            Patch(facecolor=(*OBSTACLE_COLOUR, 0.30), edgecolor=edge, linewidth=0.8, label="obstacle")
        )
    figure.legend(
        handles=handles,
        loc="lower right",
        bbox_to_anchor=(1.0 - _MARGIN / width, 0.08 / height),
        ncol=3,
        frameon=False,
        fontsize=7.0,
        handlelength=2.2,
    )
