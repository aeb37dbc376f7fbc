"""A document as a chart: where the time of a step goes, scene by scene."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vgtm_qp.bench.report import LEAST_BAYS
from vgtm_qp.bench.tables import phase_names, time_text
from vgtm_qp.view.style import COLOURS, RC, WIDTH

_BAR, _REST = 0.21, 0.62
"""Inches: of a bar and the gap to the next, and of axis and title of a panel."""


def plot_phases(document: dict[str, Any]) -> Figure:
    """Return bars of the mean time of a step, made of its phases; long arms have an axis of their own."""
    scenes = document["scenes"]
    names = phase_names(scenes)
    short = [scene for scene in scenes if scene["bays"] < LEAST_BAYS]
    long = [scene for scene in scenes if scene["bays"] >= LEAST_BAYS]
    groups = [group for group in (short, long) if group]
    with mpl.rc_context(RC):
        heights = [_REST + _BAR * len(group) for group in groups]
        figure = Figure(figsize=(WIDTH, sum(heights) + 0.3), layout="constrained")
        panels = figure.subplots(len(groups), squeeze=False, height_ratios=heights).ravel()
        for axes, group in zip(panels, groups, strict=True):
            _draw(axes, group, names)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncol=len(names))
    return figure


def _draw(axes: Axes, scenes: list[dict[str, Any]], names: list[str]) -> None:
    longest = max(scene["breakdown"]["total"] for scene in scenes)
    factor, unit = (1e3, "ms") if longest >= 1e-3 else (1e6, "us")
    places = range(len(scenes))
    left = [0.0] * len(scenes)
    for k, name in enumerate(names):
        parts = [factor * scene["breakdown"]["phases"].get(name, 0.0) for scene in scenes]
        axes.barh(places, parts, left=left, height=0.72, color=COLOURS[k % len(COLOURS)], label=name)
        left = [at + part for at, part in zip(left, parts, strict=True)]
    for place, end, scene in zip(places, left, scenes, strict=True):
        axes.annotate(
            time_text(scene["breakdown"]["total"]),
            (end, place),
            (3.0, 0.0),
            textcoords="offset points",
            va="center",
        )
    axes.set_yticks(places, [scene["name"] for scene in scenes])
    axes.invert_yaxis()
    axes.set_xlim(0.0, 1.12 * factor * longest)
    axes.set_xlabel(f"mean time of a step ({unit})")
    axes.tick_params(axis="y", length=0.0)
