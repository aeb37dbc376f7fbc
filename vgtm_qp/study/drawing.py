"""Common parts of the studies' figures: rows by their values, panels, lines with marks, labelled axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from numpy.typing import ArrayLike

from vgtm_qp.comparison.figure import draw_members
from vgtm_qp.study.workers import Row

MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")


def select(rows: Sequence[Row], **wanted: Any) -> list[Row]:
    """Return the rows that have the `wanted` values."""
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def panels(rows: int, columns: int, *, width: float, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure of panels of the same size, in inches."""
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    axes = np.ravel(figure.subplots(rows, columns, squeeze=False)).tolist()
    for one in axes:
        one.tick_params(labelsize=7)
    return figure, axes


def draw_arm(
    axes: Axes, nodes: ArrayLike, row: Row, title: str, curve: ArrayLike = (), **limits: tuple[float, float]
) -> None:
    """Draw an arm with the members of a row, and points (P, 3) of its curve, as seen along y."""
    if len(points := np.reshape(curve, (-1, 3))):
        axes.plot(*points[:, [0, 2]].T, color="tab:red", linewidth=0.9)
    draw_members(axes, nodes, row["members"], row["actuated"])
    label(axes, "x [m]", "z [m]", title, legend=False)
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
        xs, ys = [row[x] for row in rows], [factor * row[y] for row in rows]
        axes.plot(xs, ys, style, color=f"C{k}", marker=MARKS[k], markersize=4, label=name)


def label(axes: Axes, x: str, y: str, title: str = "", *, legend: bool = True, log: str = "") -> None:
    """Name the axes; those in `log`, a part of ``"xy"``, are logarithmic."""
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)
    axes.set_title(title, fontsize=8)
    for axis in log:
        axes.set(**{f"{axis}scale": "log"})
    if legend:
        axes.legend(fontsize=6.5, frameon=False)


def mark_bays(axes: Axes, bays: Sequence[int]) -> None:
    """Mark the numbers of bays on a logarithmic axis, and no others."""
    ticks = sorted(set(bays))
    axes.set_xticks(ticks, [str(n) for n in ticks])
    axes.xaxis.set_minor_locator(NullLocator())
