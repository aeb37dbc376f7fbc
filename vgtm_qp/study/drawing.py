"""Common parts of the studies' figures: rows by their values, panels, lines with marks, labelled axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import NullLocator
from numpy.typing import ArrayLike

from vgtm_qp.study.workers import Row
from vgtm_qp.view.drawing import CURVE_COLOUR, FIXED_COLOUR, OBSTACLE_COLOUR, stroke_colours
from vgtm_qp.view.style import CASING, COLOURS, DARK, MARKS, WIDTH

OBSTACLE: Any = {"facecolor": (*OBSTACLE_COLOUR, 0.3), "edgecolor": tuple(0.6 * c for c in OBSTACLE_COLOUR)}
"""Options of the outline of an obstacle, as in frames."""
_MEMBER = 1.7
"""Width of a member, points."""


def select(rows: Sequence[Row], **wanted: Any) -> list[Row]:
    """Return the rows that have the `wanted` values."""
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def panels(
    rows: int, columns: int, *, height: float, width: float | None = None
) -> tuple[Figure, list[Axes]]:
    """Return a figure of panels of the same size, in inches; by default they share the width of a page."""
    wide = WIDTH if width is None else width * columns
    figure = Figure(figsize=(wide, height * rows), layout="constrained")
    axes = np.ravel(figure.subplots(rows, columns, squeeze=False)).tolist()
    return figure, axes


def draw_arm(
    axes: Axes, nodes: ArrayLike, row: Row, title: str, curve: ArrayLike = (), **limits: tuple[float, float]
) -> None:
    """Draw an arm with the members of a row, and points (P, 3) of its curve, as seen along y."""
    ends = np.asarray(nodes)[np.asarray(row["members"], dtype=int)]
    # What is farther away, with greater y, is drawn first; a dark line below each member separates it from the rest.
    order = np.argsort(-ends[..., 1].mean(axis=1), kind="stable")
    actuated = np.asarray(row["actuated"], dtype=bool)[order, None]
    colours = np.repeat(np.where(actuated, stroke_colours(np.array(0.5)), FIXED_COLOUR), 2, axis=0)
    colours[::2] = DARK
    widths = np.tile([_MEMBER + CASING, _MEMBER], len(order))
    lines = np.repeat(ends[order][..., [0, 2]], 2, axis=0)
    axes.add_collection(LineCollection(list(lines), colors=colours, linewidths=widths, capstyle="round"))
    if len(points := np.reshape(curve, (-1, 3))):
        halo = [Stroke(linewidth=2.4, foreground="white"), Normal()]
        axes.plot(*points[:, [0, 2]].T, color=CURVE_COLOUR, linewidth=1.2, path_effects=halo, zorder=3.0)
    axes.set_aspect("equal")
    axes.autoscale_view()
    label(axes, "x (m)", "z (m)", title, legend=False)
    axes.set(**limits)


def draw_line(
    axes: Axes,
    k: int,
    name: str,
    rows: Sequence[Row],
    x: str,
    y: str,
    *,
    style: str = "--",
    factor: float = 1.0,
) -> None:
    """Draw the k-th line of a panel, in a mark and colour of its own: `y` times `factor` over `x` of rows."""
    if rows:
        look: Any = {"color": COLOURS[k % len(COLOURS)], "marker": MARKS[k % len(MARKS)], "markersize": 4.0}
        xs, ys = [row[x] for row in rows], [factor * row[y] for row in rows]
        axes.plot(xs, ys, style, label=name, **look)


def legend_above(axes: Axes, columns: int = 2, title: str = "") -> None:
    """Put the legend above the axes, where nothing is drawn, and the title above the legend."""
    place: Any = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.3}
    axes.legend(ncol=columns, title=title or None, alignment="left", **place)


def label(axes: Axes, x: str, y: str, title: str = "", *, legend: bool = True, log: str = "") -> None:
    """Name the axes; those in `log`, a part of ``"xy"``, are logarithmic."""
    axes.set(xlabel=x, ylabel=y, title=title)
    for axis in log:
        axes.set(**{f"{axis}scale": "log"})
    if legend:
        axes.legend()


def mark_bays(axes: Axes, bays: Sequence[int]) -> None:
    """Mark the numbers of bays on a logarithmic axis, and no others."""
    ticks = sorted(set(bays))
    axes.set_xticks(ticks, [str(n) for n in ticks])
    axes.xaxis.set_minor_locator(NullLocator())
