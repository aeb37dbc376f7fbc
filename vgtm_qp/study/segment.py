"""Figure 7: a segment of an arm tracks a curve that moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from vgtm_qp.comparison.tables import markdown_table
from vgtm_qp.methods.presets import with_method
from vgtm_qp.study.arms import bending_problem, built_truss, moving_curve
from vgtm_qp.study.drawing import draw_arm, panels
from vgtm_qp.study.workers import Row, Task

_FRAMES = 4
_FACES = (3, 6)


def tasks(short: bool) -> list[Task]:
    """Return one task a module."""
    modules = ("octahedral",) if short else ("octahedral", "hexapod", "longeron")
    return [{"module": module, "steps": 12 if short else 50} for module in modules]


def run(module: str, steps: int) -> Row:
    """Return frames of the bays between two faces and of the curve, gaps, m, and angles, degrees."""
    problem = with_method(
        bending_problem(8, steps=steps, module=module, stroke=[0.3, 2.0]), "curve-pseudoinverse-corrected"
    )
    truss = built_truss(problem)
    inside = set(truss.faces[_FACES[0] : _FACES[1] + 1].ravel().tolist())
    members = [k for k, (a, b) in enumerate(truss.members.tolist()) if a in inside and b in inside]
    wanted = {round(k * steps / (_FRAMES - 1)) for k in range(_FRAMES)}
    frames, gap, angle = [], 0.0, 0.0
    for step, resolver in enumerate(moving_curve(problem)):
        faces = np.array([segment.station for segment in resolver.tracker.segments])
        s = resolver.motion.s[faces]
        centres = resolver.setup.arm.stations.centres(resolver.state.nodes)[faces]
        gap = max(gap, float(np.abs(centres - resolver.curve.position(s)).max()))
        normals = resolver.setup.kinematics.station_rotation[faces][:, :, 2]
        cosine = np.einsum("kc,kc->k", normals, resolver.curve.tangent(s))
        angle = max(angle, float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max()))
        if step in wanted:
            curve = resolver.curve.position(np.linspace(0.0, 1.0, 101))
            frames.append({"step": step, "nodes": resolver.state.nodes.tolist(), "curve": curve.tolist()})
    return {
        "greatest_gap": gap,
        "greatest_angle": angle,
        "frames": frames,
        "members": truss.members[members].tolist(),
        "actuated": truss.actuated[members].tolist(),
    }


def draw(rows: Sequence[Row]) -> Figure:
    """Draw the segment at four times, a row a module."""
    figure, axes = panels(len(rows), _FRAMES, height=2.6)
    for i, row in enumerate(rows):
        for j, frame in enumerate(row["frames"]):
            panel, title = axes[_FRAMES * i + j], f"{row['module']}, step {frame['step']}"
            draw_arm(panel, frame["nodes"], row, title, frame["curve"], xlim=(-1.2, 3.8), ylim=(-0.3, 8.4))
    return figure


def text(rows: Sequence[Row]) -> str:
    """Say how well the end faces stay on the curve."""
    table = markdown_table(
        ("module", "face centre off the curve [m]", "face normal off the tangent [degrees]"),
        [(row["module"], f"{row['greatest_gap']:.1e}", f"{row['greatest_angle']:.1f}") for row in rows],
    )
    return (
        f"Bays {_FACES[0] + 1} to {_FACES[1]} of an eight-bay arm while its curve bends. Every segment meets its "
        "curve node exactly; a bay of three free motions meets the position alone, so that its normal may lean.\n\n"
        f"{table}"
    )
