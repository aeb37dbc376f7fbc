"""The one look of all figures: type, colours, dashes and marks."""

from __future__ import annotations

from typing import Any

from cycler import cycler

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#4D4D4D", "#B3A100")
"""Distinct in every common form of colour blindness (Okabe and Ito, 2008, their yellow darkened)."""
DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)))
MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")

BOUND_COLOUR = "#b91c1c"
FORBIDDEN: Any = {
    "facecolor": "#f3d7d2",
    "edgecolor": BOUND_COLOUR,
    "hatch": "////",
    "linewidth": 0.0,
    "alpha": 0.55,
}
"""Options of a band of values that may not be entered."""

DARK = (0.12, 0.12, 0.14)
"""Colour of outlines and words."""
CASING = 0.7
"""Width of the dark outline of a member, points, on both sides together."""
WIDTH = 7.1
"""Width of a figure over a whole page, inches."""

RC: Any = {
    "font.size": 8.0,
    "font.family": "sans-serif",
    "axes.titlesize": 8.0,
    "axes.labelsize": 8.0,
    "axes.prop_cycle": cycler(color=COLOURS),
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "legend.fontsize": 7.0,
    "legend.title_fontsize": 7.0,
    "legend.frameon": False,
    "pdf.fonttype": 42,
    "svg.fonttype": "none",
}
"""Settings of matplotlib under which every figure is drawn and saved."""
