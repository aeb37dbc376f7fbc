"""One figure for a comparison: the end state of every method, and its clearance and drift along the path."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from vgtm_qp.arrays import Array
from vgtm_qp.comparison.row import MethodRow
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.view.figure import FOOT, MARGIN, View, panels_from
from vgtm_qp.view.style import BOUND_COLOUR, COLOURS, DARK, DASHES, FORBIDDEN, MARKS, RC, WIDTH

_COLUMNS, _TALLEST, _SMALLEST = 5, 2.6, 1.2
"""Most panels side by side, and the greatest height and least width of one, inches."""
_LINE, _LETTER = 8.6, 3.6
"""Points: height of a line above a panel, and mean width of a letter in it."""
_MOST_LINES = 5
_CURVES, _AXES = 2.35, (1.9, 1.75)
"""Inches: height of the plots at the foot, and the size of one."""
_FLOOR, _LEAST_TOP = 1e-16, 1e-12
_VERDICTS = {"solved": "#006B4F", "keeps all but drifts": "#9A6700", "failed": BOUND_COLOUR}


class _Block(NamedTuple):
    """The panels of one problem: its rows, their maneuvers, the view, and the words above each panel with colours."""

    rows: list[MethodRow]
    maneuvers: list[Maneuver | None]
    view: View | None
    size: Array
    columns: int
    words: list[list[tuple[str, Any]]]

    @property
    def title(self) -> float:
        """Height of the words above a panel, inches."""
        return (max(map(len, self.words)) + 0.6) * _LINE / 72.0

    @property
    def height(self) -> float:
        """Inches."""
        return -(-len(self.rows) // self.columns) * (float(self.size[1]) + self.title + 0.16)


def plot_comparison(rows: Sequence[MethodRow], maneuvers: Mapping[tuple[str, str], Maneuver]) -> Figure:
    """Return the figure: one panel a maneuver with its last state, as in frames; below, clearance and drift."""
    problems = list(dict.fromkeys(row.problem for row in rows))
    blocks = []
    for problem in problems:
        mine = [row for row in rows if row.problem == problem]
        blocks.append(_block(mine, [maneuvers.get((problem, row.method)) for row in mine], len(problems) > 1))
    total = _CURVES + FOOT + sum(block.height for block in blocks)
    with mpl.rc_context(RC):
        figure, top = Figure(figsize=(WIDTH, total)), total
        for block in blocks:
            _draw_block(figure, block, top)
            top -= block.height
        views = [block.view for block in blocks if block.view is not None]
        if views:
            # One legend for all: that of an arm with the most to explain.
            most = max(views, key=lambda view: (view.drawing.arm.stretches.any(), len(view.surfaces)))
            most.draw_legend(figure, _CURVES)
        _draw_curves(figure, problems, [(row, maneuvers.get((row.problem, row.method))) for row in rows])
    return figure


def _block(rows: list[MethodRow], maneuvers: list[Maneuver | None], named: bool) -> _Block:
    columns = min(_COLUMNS, max(len(rows), 3))
    found = [maneuver for maneuver in maneuvers if maneuver is not None]
    view = _view(found) if found else None
    size = np.array([_SMALLEST, _SMALLEST]) if view is None else view.size(columns, _TALLEST)
    letters = int((max(float(size[0]), _SMALLEST) + 0.14) * 72.0 / _LETTER)
    return _Block(rows, maneuvers, view, size, columns, [_words(row, letters, named) for row in rows])


def _view(maneuvers: list[Maneuver]) -> View:
    """Return the view of all maneuvers of a problem: home, last states, and the tips' ways."""
    first = maneuvers[0]
    home = first.nodes[0]
    reach = float(np.linalg.norm(np.ptp(home, axis=0)))
    points = np.concatenate([m.nodes[-1] for m in maneuvers] + [m.tip_position for m in maneuvers])
    # A method that breaks down may throw nodes far away: these are out of the picture.
    near = np.all((points > home.min(axis=0) - reach) & (points < home.max(axis=0) + reach), axis=1)
    return View(first, [0], others=points[near])


def _words(row: MethodRow, letters: int, named: bool) -> list[tuple[str, Any]]:
    """Return the lines above a panel with their colours: the method, its verdict, and what is wrong."""
    verdict = "solved" if row.solved else "keeps all but drifts" if row.kept else "failed"
    text = " ".join(row.reason.split())
    parts: list[tuple[str, Any]] = [
        *([(row.problem, DARK)] if named else []),
        (row.method, DARK),
        (f"{verdict}, {100 * row.reached:.0f} % of the path", _VERDICTS[verdict]),
        *([] if row.solved else [(text, DARK)]),
    ]
    return [
        (line, colour)
        for part, colour in parts
        for line in textwrap.wrap(part, letters, max_lines=_MOST_LINES, placeholder=" ...")
    ]


def _draw_block(figure: Figure, block: _Block, top: float) -> None:
    panels = panels_from(figure, top, block.size, block.title, len(block.rows), block.columns)
    for k, (axes, maneuver, words) in enumerate(zip(panels, block.maneuvers, block.words, strict=True)):
        for i, (text, colour) in enumerate(reversed(words)):
            at, style = (0.0, 3.0 + _LINE * i), {"ha": "center", "fontsize": 6.5, "color": colour}
            axes.annotate(text, (0.5, 1.0), at, "axes fraction", textcoords="offset points", **style)
        if maneuver is None or block.view is None:
            axes.set_axis_off()
            continue
        at_left, at_bottom = k % block.columns == 0, k + block.columns >= len(panels)
        last, labels = len(maneuver.time) - 1, at_left and at_bottom
        block.view.of(maneuver).draw(axes, last, block.size, ruler=at_left, labels=labels)


def _draw_curves(figure: Figure, problems: list[str], pairs: list[tuple[MethodRow, Maneuver | None]]) -> None:
    """Draw clearance and drift along the path: a colour and a mark a method, a dash a problem."""
    width, high = _AXES
    total = float(figure.get_figheight())
    clearance, drift = (
        figure.add_axes((x / WIDTH, 0.42 / total, width / WIDTH, high / total)) for x in (0.55, 3.15)
    )
    methods = list(dict.fromkeys(row.method for row, _ in pairs))
    styles = {method: _style(k) for k, method in enumerate(methods)}
    safe = set()
    for row, maneuver in pairs:
        if maneuver is None:
            continue
        # Marks at places of their own, so that lines upon one another are told apart.
        every, first = max(len(maneuver.time) // 4, 1), methods.index(row.method) * len(maneuver.time) // 50
        dash = DASHES[problems.index(row.problem) % len(DASHES)]
        look = {**styles[row.method], "linestyle": dash, "markevery": (first, every)}
        fixed = ~maneuver.member_actuated
        off = np.abs(maneuver.member_lengths - maneuver.member_lengths[0])[:, fixed].max(axis=1, initial=0.0)
        near = np.where(np.isfinite(maneuver.clearance), 1000.0 * maneuver.clearance, np.nan)
        clearance.plot(maneuver.progress, near, **look)
        drift.semilogy(maneuver.progress, np.maximum(off, _FLOOR), **look)
        if np.isfinite(near).any():
            safe.add(1000.0 * float(maneuver.manifest["problem"]["clearance"]["safe"]))
    if safe:
        floor = min(0.0, clearance.get_ylim()[0])
        clearance.axhspan(floor, min(safe), **FORBIDDEN)
        clearance.set_ylim(bottom=floor)
    else:
        clearance.set_yticks([])
        clearance.text(0.5, 0.5, "no obstacles", ha="center", color=DARK, transform=clearance.transAxes)
    for one in safe:
        clearance.axhline(one, color=BOUND_COLOUR, linewidth=0.6)
    clearance.set(xlim=(0.0, 1.0), xlabel="part of the path", ylabel="clearance at the states (mm)")
    # Over less than a few decades ticks have long labels, which do not fit between the plots.
    drift.set_ylim(top=max(drift.get_ylim()[1], _LEAST_TOP))
    drift.set(xlim=(0.0, 1.0), xlabel="part of the path", ylabel="change of a fixed member (m)")
    handles = [Line2D([], [], label=method, **look) for method, look in styles.items()]
    if len(problems) > 1:
        handles += [
            Line2D(
                [],
                [],
                label="\n".join(textwrap.wrap(name, 30)),
                color=DARK,
                linestyle=DASHES[k % len(DASHES)],
            )
            for k, name in enumerate(problems)
        ]
    corner = (1.0 - 0.6 * MARGIN / WIDTH, (0.42 + high) / total)
    figure.legend(handles=handles, loc="upper right", bbox_to_anchor=corner, fontsize=6.0, borderaxespad=0.0)


def _style(k: int) -> dict[str, Any]:
    """Return the look of the k-th method's lines; more than there are colours have hollow marks."""
    return {
        "color": COLOURS[k % len(COLOURS)],
        "marker": MARKS[k % len(MARKS)],
        "markerfacecolor": COLOURS[k % len(COLOURS)] if k < len(COLOURS) else "white",
        "markersize": 3.0,
        "linewidth": 1.0,
    }
