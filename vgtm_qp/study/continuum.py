"""Figure 3: trusses approach the continuum; the gap between arm and curve against the number of bays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.comparison.tables import crossed_table, exponent
from vgtm_qp.methods.presets import with_method
from vgtm_qp.study.arms import bending_problem, furthest, moving_curve
from vgtm_qp.study.drawing import draw_arm, draw_line, label, mark_bays, panels, select
from vgtm_qp.study.workers import Row, Task

_HEIGHT = 4.0
_EXACT = 1e-9
_MODULES = ("octahedral", "hexapod", "longeron")
_MEASURES = {
    "axis": "arm's axis off the curve [m]",
    "radius": "furthest node off the curve [m]",
    "angle": "face normal off the tangent [rad]",
}


def tasks(short: bool) -> list[Task]:
    """Return one task a module and number of bays."""
    bays = (4, 8) if short else (4, 8, 16, 32, 64)
    return [{"module": module, "bays": n, "steps": 50} for module in _MODULES for n in bays]


def run(module: str, bays: int, steps: int) -> Row:
    """Bend an arm of 4 m with that many bays; return its distances from its curve, m."""
    unit = _HEIGHT / bays / (1.0 if module == "longeron" else float(np.sqrt(2.0 / 3.0)))
    sizes: dict[str, Any] = {
        "longeron": unit,
        "batten": unit,
        "stroke": [0.2 * unit, 3.0 * unit],
        "member_radius": 0.0,
    }
    problem = bending_problem(bays, steps=steps, goal=(0.3, 0.1, -0.1), module=module, vertices=5, **sizes)
    *_, resolver = moving_curve(with_method(problem, "curve-pseudoinverse-obstacles"))
    nodes, truss, curve = resolver.state.nodes, truss_of(resolver.setup.arm), resolver.curve
    points = curve.position(np.linspace(0.0, 1.0, 4001))
    centres = resolver.setup.arm.stations.centres(nodes)
    middle = np.linspace(0.0, 1.0, 9)[None, :, None]
    axis = (centres[:-1, None] + middle * np.diff(centres, axis=0)[:, None]).reshape(-1, 3)
    normals = resolver.setup.kinematics.station_rotation[:, :, 2]
    tangents = curve.tangent(resolver.motion.s)
    sine = np.linalg.norm(np.cross(normals, tangents), axis=1)
    frame = {"nodes": nodes.tolist(), "members": truss.members.tolist(), "actuated": truss.actuated.tolist()}
    return {
        "axis": furthest(axis, points),
        "radius": furthest(nodes, points),
        "angle": float(np.arctan2(sine, np.einsum("kc,kc->k", normals, tangents)).max()),
        "curve": points[::100].tolist(),
        **(frame if bays <= 16 else {}),
    }


def draw(rows: Sequence[Row]) -> Figure:
    """Draw arms of one module, and the measures against the number of bays."""
    figure, axes = panels(2, 3, height=2.5)
    shown = [row for row in select(rows, module="octahedral") if "nodes" in row][:3]
    for panel, row in zip(axes, shown, strict=False):
        draw_arm(panel, row["nodes"], row, f"{row['bays']} bays", row["curve"])
    for panel in axes[len(shown) : 3]:
        panel.set_axis_off()
    for panel, (key, name) in zip(axes[3:], _MEASURES.items(), strict=True):
        for k, module in enumerate(_MODULES):
            mine = select(rows, module=module)
            if mine and max(row[key] for row in mine) > _EXACT:
                draw_line(panel, k, module, mine, "bays", key)
        label(panel, "bays", name.translate({91: "(", 93: ")"}), log="xy")
        mark_bays(panel, [row["bays"] for row in rows])
    return figure


def text(rows: Sequence[Row]) -> str:
    """Give the order of convergence of each measure."""
    columns = {n: f"{n} bays" for n in sorted({row["bays"] for row in rows})}
    lines = {}
    for module in _MODULES:
        mine = {row["bays"]: row for row in select(rows, module=module)}
        for key, name in _MEASURES.items():
            values = [row[key] for row in mine.values()]
            order = f"{-exponent(list(mine), values):.2f}" if min(values, default=0.0) > _EXACT else "exact"
            lines[module, name] = {n: f"{row[key]:.1e}" for n, row in mine.items()} | {"order": order}
    table = crossed_table(("module", ""), columns | {"order": "order"}, lines)
    return (
        f"An arm of {_HEIGHT:g} m, bent by 0.3 of its height, with bays the smaller the more there are; its faces "
        "track the curve exactly. The order is that of the fit error = c / bays^order. A bay that meets a position "
        "alone leaves its face's direction free: where that does not converge, the ripple of section 4.5 is seen."
        f"\n\n{table}"
    )
