"""What it costs to ignore the offset of the joints: the tip error of an arm that is modelled with pin joints."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Kinematics
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.comparison.markdown import markdown_table
from vgtm_qp.maneuver.solve import solve
from vgtm_qp.problem import load_problem
from vgtm_qp.step.build import build_arm
from vgtm_qp.study.drawing import MARKS, label, panels
from vgtm_qp.study.workers import Row, Task

Array = NDArray[np.float64]

TITLE = "Offset joints: what ignoring them costs"
TIMED = False

_PROBLEMS = ("five_bay_free", "five_bay_two_cubes", "ten_bay_round_a_cube")
_TOLERANCE = 1e-11


def tasks(short: bool) -> list[Task]:
    """Return one task a problem and offset."""
    offsets = (0.02, 0.1) if short else (0.005, 0.01, 0.02, 0.04, 0.06, 0.08, 0.1, 0.15)
    return [{"problem": p, "offset": o} for p in (_PROBLEMS[:1] if short else _PROBLEMS) for o in offsets]


def run(problem: str, offset: float) -> Row:
    """Solve with pin joints, then give the strokes to an arm with offset joints; return the error of its tip, m."""
    loaded = load_problem(problem)
    maneuver = solve(loaded, verify=False)
    setup = build_arm(
        loaded.replace({"truss.joint_offset": offset, "truss.stroke": None, "method.solver": "piqp"})
    )
    kinematics, truss = setup.kinematics, setup.truss
    X = np.array(truss.home)
    errors = []
    for row in range(len(maneuver.time)):
        change = maneuver.member_lengths[row] - maneuver.member_lengths[0]
        if not _place(kinematics, truss, X, setup.arm.home_quantities + change):
            break
        errors.append(float(np.linalg.norm(setup.arm.end_effector.position(X) - maneuver.tip_position[row])))
    return {"tip_error": max(errors), "posed": len(errors) - 1, "steps": maneuver.steps}


def _place(kinematics: Kinematics, truss: Truss, X: Array, lengths: Array) -> bool:
    """Move the nodes in place until all members have their lengths (Newton, damped); whether they can."""
    free = truss.free
    for _ in range(60):
        kinematics.evaluate(X)
        error = lengths - kinematics.quantities
        worst = float(np.abs(error).max())
        if worst < _TOLERANCE:
            return True
        J = truss.scatter.dense(kinematics.gradient)
        X[free] += min(1.0, 0.2 / worst) * np.linalg.solve(J, error).reshape(-1, 3)
    return False


def draw(rows: Sequence[Row]) -> Figure:
    """Draw the tip error against the offset."""
    figure, axes = panels(1, 1, width=4.2, height=3.2)
    for mark, problem in zip(MARKS, _PROBLEMS, strict=False):
        mine = [row for row in rows if row["problem"] == problem and row["posed"] == row["steps"]]
        if mine:
            offsets, errors = [row["offset"] for row in mine], [row["tip_error"] for row in mine]
            axes[0].loglog(offsets, errors, "--", marker=mark, markersize=4, label=problem)
    label(axes[0], "joint offset [m]", "greatest tip error [m]")
    return figure


def text(rows: Sequence[Row]) -> str:
    """Give the table."""
    offsets = sorted({row["offset"] for row in rows})
    table = []
    for problem in _PROBLEMS:
        mine = {row["offset"]: row for row in rows if row["problem"] == problem}
        if mine:
            table.append((problem, *[_cell(mine[o]) if o in mine else "-" for o in offsets]))
    header = ("greatest tip error [mm]", *[f"{1e3 * o:g} mm" for o in offsets])
    return (
        "Strokes found for ideal pin joints are given to an arm whose members end the given distance from the nodes, "
        "along the member at home. At home both have the same Jacobian; off it they differ. Members are 1 m long. "
        "Where no pose near the last one has the strokes any more, the step is given.\n\n"
        f"{markdown_table(header, table)}"
    )


def _cell(row: Row) -> str:
    if row["posed"] < row["steps"]:
        return f"none from step {row['posed'] + 1}"
    return f"{1e3 * row['tip_error']:.1f}"
