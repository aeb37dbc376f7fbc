"""Frames of a maneuver on paper, like the paper's figure 8."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

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

from vgtm_qp.arrays import Array
from vgtm_qp.errors import VgtmError
from vgtm_qp.result.file import replacing
from vgtm_qp.result.result import Result
from vgtm_qp.view.drawing import (
    CARRIED_COLOUR,
    CURVE_COLOUR,
    FIXED_COLOUR,
    OBSTACLE_COLOUR,
    PATH_COLOUR,
    POLYGON_COLOUR,
    ObstacleMesh,
    drawing_of_maneuver,
    heading,
    off_curve,
    resampled,
    stroke_colours,
    with_surroundings,
)
from vgtm_qp.view.projection import ProjectedMesh, Projection, layers, pieces
from vgtm_qp.view.style import CASING, DARK, RC, WIDTH

SUFFIXES = (".pdf", ".png", ".svg")
_GREATEST_HEIGHT = 9.0
MARGIN, FOOT = 0.42, 0.95
"""Inches at the sides of a figure of panels, and at its foot for the legend."""
_GAP, _TITLE, _NOTE = 0.16, 0.24, 0.16
_POINTS_PER_INCH = 72.0
_GRID = (0.80, 0.80, 0.82)
_PIECES, _MANY_MEMBERS, _SLICES = 8, 1500, 12
_THINNEST = 0.5
_NUMBERS, _NAME, _ASLANT, _STEEP = 2.5, 11.5, 0.3, 0.4
"""Points from an axis to its numbers and to its name; shares of a direction above which texts stand at its side."""
_CHARACTER = 4.0
"""Points that a character of a number is wide."""
_ABOVE = 100.0
_MANY_GOALS = 20
"""Greatest number of waypoints that are marked: a record of a loop has one a step."""
_NOTHING = np.zeros((0, 3))
_STAGE = 4.2
"""Greatest height of the panel of an animation, inches."""


class _Shown(NamedTuple):
    """What is drawn at a `time`, s: nodes, lengths and control vertices, and the tip's way so far and ahead, m."""

    time: float
    nodes: Array
    lengths: Array
    vertices: Array
    behind: Array
    ahead: Array

    @classmethod
    def at(cls, maneuver: Result, time: float) -> _Shown:
        """Return it at any time of a maneuver, between two states on straight lines."""

        def now(values: Array) -> Array:
            return np.asarray(resampled(maneuver.time, values, np.array([time]))[0])

        tip, target = maneuver.tip_position, maneuver.tip_target_position
        return cls(
            time,
            now(maneuver.nodes),
            now(maneuver.member_lengths),
            now(maneuver.control_vertices),
            np.concatenate([tip[maneuver.time <= time], now(tip)[None]]),
            np.concatenate([now(target)[None], target[maneuver.time > time]]),
        )


class _Balls(NamedTuple):
    """Balls: centres (K, 3), m, diameters (K,), points, colours (K, 3), and how far above the bodies each is drawn."""

    centre: Array
    diameter: Array
    colour: Array
    above: Array

    def draw(self, axes: Axes, projection: Projection, chosen: Any, order: float) -> None:
        """Draw the `chosen` ones beside bodies of the `order`."""
        for above in np.unique(self.above[chosen]):
            some = chosen[self.above[chosen] == above]
            x, y = projection.flat(self.centre[some]).T
            sizes: Any = {"s": self.diameter[some] ** 2, "c": self.colour[some], "linewidths": 0.0}
            axes.scatter(x, y, marker="o", zorder=order + above / _SLICES, **sizes)


def _style(label: str, colour: Any, order: int, **more: Any) -> dict[str, Any]:
    """Return the options of a line that nothing hides, and its name in the legend."""
    return {"label": label, "color": colour, "zorder": _ABOVE + order, **more}


_POLYGON = _style(
    "control polygon", POLYGON_COLOUR, 0, linewidth=0.7, linestyle=(0, (4, 2)), marker="s", markersize=2.4
)
_CURVE = _style("reference curve", CURVE_COLOUR, 1, linewidth=1.4)
_AHEAD = _style("way ahead", PATH_COLOUR, 2, linewidth=0.9, linestyle=(0, (1, 1.6)))
_BEHIND = _style("tip and its way", PATH_COLOUR, 2, linewidth=1.2, marker="o", markersize=3.4)
_GOAL = _style("waypoint", PATH_COLOUR, 3, linestyle="none", marker="x", markersize=4.5, markeredgewidth=1.1)


def plot_frames(
    maneuver: Result,
    *,
    frames: int | Sequence[int] = 6,
    azimuth: float | None = None,
    elevation: float = 0.21,
) -> Figure:
    """Return a figure of states of a maneuver side by side, all in the same view and scale.

    Members are drawn in their true thickness: fixed ones grey, actuated ones coloured by length. The
    reference curve, its control polygon, the obstacles, the tip's path so far and its rest are drawn as well.
    If stations are off the curve, the title says how far.

    Parameters
    ----------
    maneuver
        What `solve` or `load_result` returns.
    frames
        Number of states, evenly spread, or the states themselves.
    azimuth, elevation
        Azimuth of the view, rad; by default across the path of the tip.

    Raises
    ------
    VgtmError
        There is no such state.
    """
    rows = _rows(maneuver, frames)
    titles = [f"step {row}, {maneuver.time[row]:.3g} s" for row in rows]
    if 1 < len(rows) <= 26:
        titles = [f"({chr(ord('a') + k)}) {title}" for k, title in enumerate(titles)]
    off = off_curve(maneuver)
    titles = [f"{title}\n{off[row]}".strip() for title, row in zip(titles, rows, strict=True)]
    return View(maneuver, rows, azimuth, elevation).figure(rows, titles, _off_somewhere(maneuver, off))


def each_picture(maneuver: Result, times: Array, dots_per_inch: int) -> Iterator[NDArray[np.uint8]]:
    """Yield one picture (H, W, 3) for each of the `times`, s, in the view that holds the whole maneuver.

    Between two states everything is on straight lines, as in the certificate. What stays in all pictures is drawn once.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    view = View(maneuver, range(len(maneuver.time)))
    with mpl.rc_context(RC):
        figure, axes, size = view.stage()
        figure.set_dpi(dots_per_inch)
        canvas: Any = FigureCanvasAgg(figure)
        canvas.draw()
        background, staying = canvas.copy_from_bbox(figure.bbox), set(axes.get_children())
        for time in times.tolist():
            canvas.restore_region(background)
            view.draw_at(axes, time, size)
            axes.annotate(
                f"{time:.2f} s", (0.5, 1.0), (0.0, 3.0), "axes fraction", "offset points", ha="center"
            )
            added = [artist for artist in axes.get_children() if artist not in staying]
            for artist in sorted(added, key=lambda artist: artist.get_zorder()):
                axes.draw_artist(artist)
            yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
            for artist in added:
                artist.remove()


def save_figure(figure: Figure, path: str | Path) -> Path:
    """Write a figure in the format of the suffix of `path`, one of `SUFFIXES`, and return the path.

    VgtmError for another suffix, or if the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise VgtmError(f'{path}: a figure cannot be "{path.suffix}"; choices: {", ".join(SUFFIXES)}')
    with replacing(path) as scratch, mpl.rc_context(RC):
        figure.savefig(scratch, dpi=220, format=path.suffix[1:].lower())
    return path


def _off_somewhere(maneuver: Result, off: Sequence[str]) -> str:
    """Return in words the states with stations off the curve, and the greatest distance; or nothing."""
    certificate, count = maneuver.certificate, sum(map(bool, off[1:]))
    if certificate is None or not count:
        return ""
    gap = certificate.tracking_gap
    most = f"{1000.0 * (gap.value or 0.0):.3g} mm at most ({gap.where})"
    return f"stations are off the curve in {count} of {len(off) - 1} states, by {most}"


class View:
    """The part of space in all panels, m: the arm in the states `seen`, `others` (K, 3), and near parts of obstacles.

    The paper goes from `low` to `high` (2,). The `floor` (2, 2), least and greatest x and y, is at the height `ground`
    and has lines every `step`; ticks with the same spacing go up to `top`.
    """

    def __init__(
        self,
        maneuver: Result,
        seen: Sequence[int],
        azimuth: float | None = None,
        elevation: float = 0.21,
        others: Array = _NOTHING,
    ) -> None:
        self.maneuver, self.drawing = maneuver, drawing_of_maneuver(maneuver)
        if azimuth is None:
            # The tip goes to the right and a little towards the viewer.
            azimuth = heading(maneuver.tip_position) - np.radians(70.0)
        self.projection = projection = Projection(azimuth, elevation)
        self.surfaces = [ProjectedMesh(mesh, projection) for mesh in self.drawing.obstacles]
        # Surfaces count, not axes alone.
        thick, ends = self.drawing.arm.radius[:, None, None], self.drawing.arm.ends(maneuver.nodes[seen])
        skins = [(ends + side * thick).reshape(-1, 3) for side in (-1.0, 1.0)]
        arm = np.concatenate([maneuver.nodes[seen].reshape(-1, 3), *skins, others])
        size = float(np.ptp(arm, axis=0).max())
        self.step = _round_step(size / 6.0)
        self.ground = float(maneuver.nodes[0, self.drawing.arm.base, 2].min())
        self.top = float(arm[:, 2].max())
        around = [vertices[:, :2] for vertices in self.drawing.surfaces()]
        least, most = with_surroundings(arm[:, :2], around, 0.4 * size) / self.step
        self.floor = np.stack([np.floor(least + 0.2), np.ceil(most - 0.2)]) * self.step
        corners = np.array([[x, y, self.ground] for x in self.floor[:, 0] for y in self.floor[:, 1]])
        inside = projection.flat(np.concatenate([arm, corners, maneuver.tip_target_position]))
        times = maneuver.time[seen]
        around = [
            place for time in times for surface in self._there(time) for place in surface.polygons(time)
        ]
        least, most = with_surroundings(inside, around, 0.3 * np.ptp(inside, axis=0).max())
        pad = 0.03 * float((most - least).max())
        self.low, self.high = least - pad, most + pad

    def _there(self, time: float) -> list[ProjectedMesh]:
        """Return the surfaces that are there at `time`, s, as they are then."""
        return [surface.at(time) for surface in self.surfaces if surface.mesh.is_there(time)]

    def of(self, maneuver: Result) -> View:
        """Return the same view of another maneuver among the same obstacles."""
        view = copy(self)
        view.maneuver, view.drawing = maneuver, drawing_of_maneuver(maneuver)
        return view

    def figure(self, rows: Sequence[int], titles: Sequence[str], note: str = "") -> Figure:
        """Return a figure of states side by side, with a note at its foot."""
        columns = min(3, len(rows)) if len(rows) != 4 else 4
        lines = -(-len(rows) // columns)
        with mpl.rc_context(RC):
            title = _TITLE * (1 + max(title.count("\n") for title in titles))
            room = _NOTE if note else 0.0
            size = self.size(columns, (_GREATEST_HEIGHT - FOOT - room) / lines - title - _GAP)
            total = FOOT + room + lines * (size[1] + title + _GAP)
            figure = Figure(figsize=(WIDTH, total))
            panels = panels_from(figure, total, size, title, len(rows), columns)
            for k, (row, axes, text) in enumerate(zip(rows, panels, titles, strict=True)):
                at_left, at_bottom = k % columns == 0, k + columns >= len(rows)
                self.draw(axes, row, size, ruler=at_left, labels=at_left and at_bottom)
                axes.set_title(text, fontsize=8.0, pad=3.0)
            self.draw_legend(figure, room)
            if note:
                at = 1.0 - MARGIN / WIDTH, 0.06 / total
                figure.text(*at, note, ha="right", va="bottom", fontsize=7.0, color=DARK)
        return figure

    def size(self, columns: int, tallest: float) -> Array:
        """Return (2,) the size of a panel if there are so many `columns` and none may be taller, inches."""
        extent = self.high - self.low
        room = (WIDTH - 2 * MARGIN - (columns - 1) * _GAP) / columns
        return np.asarray(extent * min(room / extent[0], tallest / extent[1]))

    def stage(self) -> tuple[Figure, Axes, Array]:
        """Return a figure with a floor and a legend and no state, its one panel and the panel's size, inches."""
        size = self.size(1, _STAGE)
        total = float(FOOT + size[1] + _TITLE + _GAP)
        figure = Figure(figsize=(WIDTH, total))
        (axes,) = panels_from(figure, total, size, _TITLE, 1, 1)
        self._draw_floor(axes, size, ruler=True, labels=True)
        self.draw_legend(figure, 0.0)
        return figure, axes, size

    def draw(self, axes: Axes, row: int, size: Array, *, ruler: bool, labels: bool) -> None:
        """Draw a state into a panel of a `size`, inches; ticks along z with a `ruler`, along x and y with `labels`."""
        self._draw_floor(axes, size, ruler=ruler, labels=labels)
        self.draw_at(axes, float(self.maneuver.time[row]), size)

    def draw_at(self, axes: Axes, time: float, size: Array) -> None:
        """Draw arm, obstacles and the tip's way at a time, s, into a panel with a floor."""
        shown = _Shown.at(self.maneuver, time)
        self._draw_state(axes, shown, self._scale(size))
        axes.plot(*self.projection.flat(shown.ahead).T, **_AHEAD)
        axes.plot(*self.projection.flat(shown.behind).T, markevery=[-1], **_BEHIND)
        axes.plot(*self.projection.flat(self._goals).T, **_GOAL)

    def _scale(self, size: Array) -> float:
        """Return the points a metre in a panel of a size, inches."""
        return float(size[0] * _POINTS_PER_INCH / (self.high - self.low)[0])

    def _draw_floor(self, axes: Axes, size: Array, *, ruler: bool, labels: bool) -> None:
        """Draw the floor's lines, and ticks in metres: along x and y with `labels`, along z with `ruler`."""
        axes.set_xlim(self.low[0], self.high[0])
        axes.set_ylim(self.low[1], self.high[1])
        axes.set_axis_off()
        flat, ground, scale = self.projection.flat, self.ground, self._scale(size)
        x, y = (np.arange(low, high + self.step / 2, self.step) for low, high in self.floor.T)
        ends = [[[u, y[0], ground], [u, y[-1], ground]] for u in x]
        ends += [[[x[0], v, ground], [x[-1], v, ground]] for v in y]
        lines = list(flat(np.array(ends)))
        axes.add_collection(LineCollection(lines, colors=[_GRID], linewidths=0.5, zorder=0.1))
        toward = self.projection.axes[2]
        front = np.array([x[-1] if toward[0] > 0 else x[0], y[-1] if toward[1] > 0 else y[0]])
        crowded = False
        if labels:
            along_x = np.stack([x, np.full_like(x, front[1]), np.full_like(x, ground)], axis=1)
            along_y = np.stack([np.full_like(y, front[0]), y, np.full_like(y, ground)], axis=1)
            middle = flat(np.array([*self.floor.mean(axis=0), ground]))
            for name, values, places in (("x", x, along_x), ("y", y, along_y)):
                # The corner that both have in common has its number once, on x.
                once = np.ones(len(values), dtype=bool) if name == "x" else ~np.isclose(y, front[1])
                aside = _aside(flat(places), middle)
                crowded = crowded or bool(aside[0] < -_STEEP)
                _label(axes, name, values[once], flat(places[once]), aside, scale)
        if ruler:
            corners = np.array([[u, v, ground] for u in (x[0], x[-1]) for v in (y[0], y[-1])])
            foot = corners[int(np.argmin(flat(corners)[:, 0]))]
            z = ground + np.arange(0.0, self.top - ground + 1e-9 * self.step, self.step)
            places = flat(np.column_stack([np.tile(foot[:2], (len(z), 1)), z]))
            axes.plot(*places.T, color=_GRID, linewidth=0.7, marker="_", markersize=3.0, zorder=0.1)
            # Where numbers of the floor stand at the left of its corner, the one of z there would lie upon them.
            _label(axes, "z", z[crowded:], places[crowded:], np.array([-1.0, 0.0]), scale)

    def _draw_state(self, axes: Axes, shown: _Shown, scale: float) -> None:
        """Draw arm and obstacles, farthest first."""
        drawing, projection, time, nodes = self.drawing, self.projection, shown.time, shown.nodes
        surfaces = sorted(self._there(time), key=lambda surface: surface.depth(time))
        for k, surface in enumerate(surfaces, start=1):
            _draw_surface(axes, surface, time, 2.0 * k)
        self._draw_hulls(axes, shown, surfaces)
        drawn = ~drawing.arm.is_hull
        ends = drawing.arm.ends(nodes)[drawn, :2]
        cuts = _PIECES if len(ends) <= _MANY_MEMBERS else 1
        cut, bare = pieces(ends, cuts), pieces(ends, cuts, overlap=0.0)
        width = np.repeat(np.maximum(2.0 * drawing.arm.radius[drawn] * scale, _THINNEST), cuts)
        balls = self._balls(nodes, scale)
        colour = np.repeat(drawing.colours(shown.lengths)[drawn], cuts, axis=0)
        middles = cut.mean(axis=1)
        depth, layer = projection.depth(middles), layers(middles, surfaces, time)
        ball_depth, ball_layer = projection.depth(balls.centre), layers(balls.centre, surfaces, time)
        for k in range(len(surfaces) + 1):
            order = np.flatnonzero(layer == k)
            order = order[np.argsort(depth[order], kind="stable")]
            here = np.flatnonzero(ball_layer == k)
            slices = [part for part in np.array_split(order, _SLICES) if len(part)]
            borders = np.array([depth[part[-1]] for part in slices[:-1]])
            slot = np.searchsorted(borders, ball_depth[here])
            for j, part in enumerate(slices):
                # A dark line below each member, a little wider, separates it from things behind it. It ends where its
                # piece does, so that the next piece hides its end.
                lines = np.repeat(projection.flat(cut[part]), 2, axis=0)
                lines[::2] = projection.flat(bare[part])
                widths = np.repeat(width[part], 2)
                widths[::2] += CASING
                colours = np.repeat(colour[part], 2, axis=0)
                colours[::2] = DARK
                style: Any = {"capstyle": "butt", "zorder": 2.0 * k + 1.0 + j / (2.0 * _SLICES)}
                axes.add_collection(LineCollection(list(lines), colors=colours, linewidths=widths, **style))
                balls.draw(axes, projection, here[slot == j], style["zorder"])
        if drawing.curve_weights.size:
            vertices = shown.vertices
            effects = [Stroke(linewidth=2.6, foreground="white"), Normal()]
            axes.plot(*projection.flat(vertices).T, **_POLYGON)
            axes.plot(*projection.flat(drawing.curve(vertices)).T, path_effects=effects, **_CURVE)

    def _draw_hulls(self, axes: Axes, shown: _Shown, surfaces: list[ProjectedMesh]) -> None:
        """Draw the bodies that are hulls, farthest first."""
        if not (hulls := self.drawing.hulls):
            return
        still = np.zeros(3), np.zeros(3)
        solids = [
            ProjectedMesh(ObstacleMesh("", hull.placed(shown.nodes), hull.faces, *still), self.projection)
            for hull in hulls
        ]
        middles = np.stack([solid.vertices.mean(axis=0) for solid in solids])
        layer, depth = layers(middles, surfaces, shown.time), [solid.depth(0.0) for solid in solids]
        for rank, k in enumerate(np.argsort(depth).tolist()):
            zorder = 2.0 * float(layer[k]) + 1.0 + rank / (2.0 * len(solids))
            face: Any = {"facecolors": [FIXED_COLOUR], "edgecolors": [DARK], "linewidths": 0.5 * CASING}
            axes.add_collection(PolyCollection(solids[k].polygons(0.0), zorder=zorder, **face))
            edges = list(solids[k].edges(0.0, seen=True))
            axes.add_collection(LineCollection(edges, colors=[DARK], linewidths=0.3, zorder=zorder))

    def _balls(self, nodes: Array, scale: float) -> _Balls:
        """Return the nodes of a truss; of a serial arm the round ends of its links, and small marks at its joints."""
        arm = self.drawing.arm
        drawn = ~arm.is_hull
        width = np.maximum(2.0 * arm.radius[drawn] * scale, _THINNEST)
        if arm.stretches.any():
            same = np.full(len(nodes), 1.15 * float(np.median(width)) + CASING)
            return _Balls(nodes, same, np.tile(DARK, (len(nodes), 1)), np.full(len(nodes), 0.1))
        joints = nodes[1 : len(arm.quantity_names) + 1]
        mark = np.full(len(joints), 0.35 * float(np.median(width if len(width) else _THINNEST)) + CASING)
        ends, twice = arm.ends(nodes)[drawn, :2].reshape(-1, 3), np.repeat(width, 2)
        colour = np.tile(FIXED_COLOUR, (len(ends), 1))
        # The dark casing of each end, the end itself, below the links; the marks above them.
        return _Balls(
            np.concatenate([ends, ends, joints]),
            np.concatenate([twice + CASING, twice, mark]),
            np.concatenate([np.tile(DARK, (len(ends), 1)), colour, np.tile(DARK, (len(joints), 1))]),
            np.repeat([-0.2, -0.1, 0.1], [len(ends), len(ends), len(joints)]),
        )

    @cached_property
    def _goals(self) -> Array:
        """Positions (K, 3) of the waypoints, m; none if there are many."""
        waypoints = self.maneuver.manifest["problem"]["maneuver"].get("waypoint") or ()
        goals = np.array([w["position"] for w in waypoints if w.get("position")]).reshape(-1, 3)
        return goals if len(goals) <= _MANY_GOALS else goals[:0]

    def draw_legend(self, figure: Figure, room: float) -> None:
        """Draw the meaning of colours and marks, above some `room` at the foot, inches."""
        width, height = figure.get_size_inches()
        arm = self.drawing.arm
        strokes = np.unique(arm.stroke[arm.actuated].round(9), axis=0)
        if arm.stretches.any():
            alike = len(strokes) == 1
            low, high = strokes[0] if alike else (0.0, 1.0)
            label = "length of actuated members (m)" if alike else "actuated members, share of the stroke"
            bar = figure.add_axes((MARGIN / width, (0.52 + room) / height, 2.3 / width, 0.09 / height))
            colours = ListedColormap(stroke_colours(np.linspace(0.0, 1.0, 256)).tolist())
            scalar = mpl.cm.ScalarMappable(Normalize(low, high), colours)
            figure.colorbar(scalar, cax=bar, orientation="horizontal", label=label)
        body = {"color": FIXED_COLOUR, "linewidth": 2.6, "label": arm.rigid_body}
        styles: list[dict[str, Any]] = [body] if not arm.stretches.all() else []
        styles += [_CURVE, _POLYGON] if self.drawing.curve_weights.size else []
        styles += [_BEHIND, _AHEAD]
        styles += [_GOAL] if len(self._goals) else []
        handles: list[Any] = [Line2D([], [], **style) for style in styles]
        there = {surface.mesh.colour for surface in self.surfaces}
        for colour, label in ((OBSTACLE_COLOUR, "obstacle"), (CARRIED_COLOUR, "carried")):
            if colour in there:
                edge = _edge(colour)
                handles.append(Patch(facecolor=(*colour, 0.30), edgecolor=edge, linewidth=0.8, label=label))
        figure.legend(
            handles=handles,
            loc="lower right",
            bbox_to_anchor=(1.0 - MARGIN / width, (0.08 + room) / height),
            ncol=3,
            handlelength=2.2,
        )


def panels_from(
    figure: Figure, top: float, size: Array, title: float, count: int, columns: int
) -> list[Axes]:
    """Add so many panels of a `size` to a figure, and return them: `columns` side by side, the rest below.

    The first ones have their titles, for which there is a height of `title`, below the `top` above the figure's
    foot; all in inches.
    """
    (width, tall), (whole, high) = size, figure.get_size_inches()
    left = (whole - columns * width - (columns - 1) * _GAP) / 2
    panels = []
    for k in range(count):
        line, column = divmod(k, columns)
        x, y = left + column * (width + _GAP), top - (line + 1) * (tall + title) - line * _GAP
        panels.append(figure.add_axes((x / whole, y / high, width / whole, tall / high)))
    return panels


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


def _round_step(size: float) -> float:
    """Return the least of 1, 2, 5 times a power of ten that is not less than `size`."""
    power = 10.0 ** np.floor(np.log10(size))
    steps = (factor * power for factor in (1.0, 2.0, 5.0, 10.0))
    return float(next(step for step in steps if step >= size * (1 - 1e-9)))


def _aside(places: Array, middle: Array) -> Array:
    """Return (2,) the direction on paper that leads away from a point to an edge (K, 2), at right angles to it."""
    x, y = places[-1] - places[0]
    normal = np.array([-y, x]) / max(float(np.hypot(x, y)), 1e-12)
    return np.asarray(normal if normal @ (places.mean(axis=0) - middle) > 0.0 else -normal)


def _label(axes: Axes, name: str, values: Array, places: Array, aside: Array, scale: float) -> None:
    """Write numbers `aside` of an axis at its ticks (K, 2), as many as fit, and its name with the unit."""
    if not len(values):
        return
    apart = scale * float(np.linalg.norm(places[-1] - places[0])) / max(len(values) - 1, 1)
    every = int(np.ceil((9.0 if name == "z" else 13.0) / max(apart, 1e-3)))
    ha = "center" if abs(aside[0]) < _ASLANT else "left" if aside[0] > 0.0 else "right"
    va = "center" if abs(aside[1]) < _ASLANT else "bottom" if aside[1] > 0.0 else "top"
    text: dict[str, Any] = {"textcoords": "offset points", "ha": ha, "va": va, "color": DARK}
    for value, place in list(zip(values, places, strict=True))[::every]:
        axes.annotate(f"{value:g}", place, tuple(_NUMBERS * aside), fontsize=6.5, **text)
    text |= {"fontsize": 7.0, "rotation": 90.0 * (name == "z")}
    # Beside numbers of more than two characters a name stands further out.
    longest = max(len(f"{value:g}") for value in values[::every])
    away = _NAME + (_CHARACTER * max(longest - 2, 0) if name == "z" else 0.0)
    axes.annotate(f"{name} (m)", places.mean(axis=0), tuple(away * aside), **text)


def _edge(colour: tuple[float, float, float]) -> Any:
    """Return the darker colour of the edges of a surface."""
    return tuple(0.6 * channel for channel in colour)


def _draw_surface(axes: Axes, surface: ProjectedMesh, time: float, zorder: float) -> None:
    polygons = surface.polygons(time)
    colour = surface.mesh.colour
    styles: list[Any] = [{"facecolors": [colour], "alpha": 0.30, "linewidths": 0.0}]
    if surface.is_convex:
        styles.append({"facecolors": "none", "edgecolors": [_edge(colour)], "linewidths": 0.8})
    for style in styles:
        axes.add_collection(PolyCollection(polygons, zorder=zorder, **style))
    for seen, width, dashes in ((False, 0.5, (0, (1.5, 2.0))), (True, 0.8, "solid")):
        line: Any = {"colors": [_edge(colour)], "linewidths": width, "linestyles": [dashes]}
        line["zorder"] = zorder + 0.1
        axes.add_collection(LineCollection(list(surface.edges(time, seen=seen)), **line))
