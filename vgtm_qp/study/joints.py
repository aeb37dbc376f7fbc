"""The cost of ignoring the offset of joints: the tip error of an arm that is modelled with pin joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from vgtm_qp.comparison.tables import crossed_table
from vgtm_qp.maneuver.solve import solve
from vgtm_qp.problem import load_problem
from vgtm_qp.step.build import build_arm
from vgtm_qp.study.arms import bring_lengths
from vgtm_qp.study.drawing import draw_line, label, panels, select
from vgtm_qp.study.workers import Row, Task

_PROBLEMS = ("five_bay_free", "five_bay_two_cubes", "ten_bay_round_a_cube")


def tasks(short: bool) -> list[Task]:
    """Return one task a problem and offset."""
    offsets = (0.02, 0.1) if short else (0.005, 0.01, 0.02, 0.04, 0.06, 0.08, 0.1, 0.15)
    return [{"problem": p, "offset": o} for p in (_PROBLEMS[:1] if short else _PROBLEMS) for o in offsets]


def run(problem: str, offset: float) -> Row:
    """Solve with pin joints, then give the strokes to an arm with offset joints; return the error of its tip, m."""
    loaded = load_problem(problem)
    maneuver = solve(loaded, verify=False)
    offsets = loaded.replace({"truss.joint_offset": offset, "truss.stroke": None})
    setup = build_arm(offsets, solves=False)
    X = np.array(setup.arm.home)
    errors = []
    for lengths, tip in zip(maneuver.member_lengths, maneuver.tip_position, strict=True):
        wanted = setup.arm.home_quantities + (lengths - maneuver.member_lengths[0])
        if not bring_lengths(setup, X, wanted, tries=60, longest=0.2):
            break
        errors.append(float(np.linalg.norm(setup.arm.end_effector.position(X) - tip)))
    return {"tip_error": max(errors), "posed": len(errors) - 1, "steps": maneuver.steps}


def draw(rows: Sequence[Row]) -> Figure:
    """Draw the tip error against the offset."""
    figure, axes = panels(1, 1, width=4.2, height=3.2)
    for k, problem in enumerate(_PROBLEMS):
        mine = [row for row in select(rows, problem=problem) if row["posed"] == row["steps"]]
        draw_line(axes[0], k, problem, mine, "offset", "tip_error")
    label(axes[0], "joint offset (m)", "greatest tip error (m)", log="xy")
    return figure


def text(rows: Sequence[Row]) -> str:
    """Give the table."""
    table = crossed_table(
        ("greatest tip error [mm]",),
        {offset: f"{1e3 * offset:g} mm" for offset in sorted({row["offset"] for row in rows})},
        {(p,): {row["offset"]: _cell(row) for row in select(rows, problem=p)} for p in _PROBLEMS},
    )
    return (
        "Strokes found for ideal pin joints are given to an arm whose members end the given distance from the nodes, "
        "along the member at home. At home both have the same Jacobian; off it they differ. Members are 1 m long. "
        f"Where no pose near the last one has the strokes any more, the step is given.\n\n{table}"
    )


def _cell(row: Row) -> str:
    if row["posed"] < row["steps"]:
        return f"none from step {row['posed'] + 1}"
    return f"{1e3 * row['tip_error']:.1f}"
