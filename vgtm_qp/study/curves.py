"""Figure 4: curves of the three families and their control polygons, and how close to them they run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vgtm_qp.comparison.tables import markdown_table
from vgtm_qp.curve.families import make_family
from vgtm_qp.study.arms import furthest
from vgtm_qp.study.drawing import label, panels
from vgtm_qp.study.workers import Row, Task
from vgtm_qp.view.drawing import CURVE_COLOUR, POLYGON_COLOUR

_POLYGON = ((0.0, 0.0), (0.0, 1.0), (0.9, 1.8), (0.3, 2.9), (1.5, 3.3), (2.4, 2.6))
_FAMILIES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("bezier", {}),
    ("b-spline", {"degree": 3}),
    ("beta-spline", {"bias": 1.0, "tension": 0.0}),
    ("beta-spline", {"bias": 1.0, "tension": 10.0}),
)


def tasks(short: bool) -> list[Task]:
    """Return one task a family."""
    samples = 41 if short else 201
    return [{"family": name, "options": options, "samples": samples} for name, options in _FAMILIES]


def run(family: str, options: dict[str, Any], samples: int) -> Row:
    """Return points of the curve over one control polygon, and its greatest distance from the polygon, m."""
    polygon = np.array(_POLYGON)
    made = make_family(family, len(polygon), **options)
    points = made.weights(np.linspace(0.0, 1.0, samples)) @ polygon
    gap = furthest(points, polygon)
    return {"greatest_gap": gap, "points": points.tolist(), "degree": made.degree}


def draw(rows: Sequence[Row]) -> Figure:
    """Draw each curve with the polygon."""
    figure, axes = panels(1, len(rows), height=2.6)
    for panel, row in zip(axes, rows, strict=True):
        panel.plot(
            *np.array(_POLYGON).T,
            "s--",
            color=POLYGON_COLOUR,
            markersize=2.4,
            linewidth=0.7,
            label="control polygon",
        )
        panel.plot(*np.array(row["points"]).T, color=CURVE_COLOUR, linewidth=1.4, label="curve")
        panel.set_aspect("equal")
        label(panel, "x (m)", "z (m)", _name(row).replace(", ", "\n", 1), legend=row is rows[0])
    return figure


def text(rows: Sequence[Row]) -> str:
    """Say how near to its polygon each curve runs."""
    table = markdown_table(
        ("curve", "degree", "greatest distance from the polygon [m]"),
        [(_name(row), str(row["degree"]), f"{row['greatest_gap']:.3f}") for row in rows],
    )
    return (
        "Six control vertices, the same for all. Every curve stays in the hull of its vertices; how closely it "
        f"follows the polygon depends on the weights alone.\n\n{table}"
    )


def _name(row: Row) -> str:
    options = ", ".join(f"{key} {value:g}" for key, value in row["options"].items() if key != "degree")
    return str(row["family"]) + (f", {options}" if options else "")
