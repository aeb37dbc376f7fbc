"""What the studies' figures share: one style, side views of trusses and curves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from numpy.typing import NDArray

Array = NDArray[np.float64]


def panels(
    rows: int = 1, columns: int = 1, *, width: float = 3.4, height: float = 2.9
) -> tuple[Figure, list[Axes]]:
    """Return a figure of panels of the same size, in inches."""
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    axes = np.ravel(figure.subplots(rows, columns, squeeze=False)).tolist()
    for one in axes:
        one.tick_params(labelsize=7)
    return figure, axes


def label(axes: Axes, x: str, y: str, title: str = "", *, legend: bool = True) -> None:
    """Name the axes."""
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)
    if title:
        axes.set_title(title, fontsize=8)
    if legend:
        axes.legend(fontsize=6.5, frameon=False)


def mark_bays(axes: Axes, bays: Sequence[int]) -> None:
    """Mark the numbers of bays on a logarithmic axis, and no others."""
    axes.set_xticks(sorted(set(bays)), [str(n) for n in sorted(set(bays))])
    axes.xaxis.set_minor_locator(NullLocator())


def draw_truss(axes: Axes, nodes: Array, members: Array, actuated: Array, shade: float = 1.0) -> None:
    """Draw members (M, 2) between `nodes` (N, 3) as seen along y: fixed ones grey, actuated ones blue."""
    ends = np.asarray(nodes)[np.asarray(members, dtype=int)][:, :, [0, 2]]
    on = np.asarray(actuated, dtype=bool)
    axes.add_collection(LineCollection(list(ends[~on]), colors="0.4", linewidths=0.7, alpha=shade))
    axes.add_collection(LineCollection(list(ends[on]), colors="tab:blue", linewidths=0.9, alpha=shade))
    axes.set_aspect("equal")
    axes.autoscale_view()


MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")
