"""Success, actuator travel and time against the number of control vertices (section 4.7)."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from vgtm_qp.comparison.compare import run_method
from vgtm_qp.comparison.tables import crossed_table
from vgtm_qp.curve.redundancy import degree_of_redundancy
from vgtm_qp.problem import load_problem
from vgtm_qp.study.drawing import draw_line, label, panels, select
from vgtm_qp.study.workers import Row, Task

_CASES = (
    ("five_bay_two_cubes", "qp"),
    ("ten_bay_round_a_cube", "qp"),
    ("five_bay_free", "curve-pseudoinverse-corrected"),
    ("ten_bay_round_a_cube", "curve-pseudoinverse-obstacles"),
)


def tasks(short: bool) -> list[Task]:
    """Return one task a case and number of vertices."""
    vertices = (4, 6) if short else (3, 4, 5, 6, 7, 8, 9, 10, 12, 14)
    cases = _CASES[2:3] if short else _CASES
    return [{"problem": p, "method": m, "vertices": v} for p, m in cases for v in vertices]


def run(problem: str, method: str, vertices: int) -> Row:
    """Return success, reach, travel and step time with that many control vertices."""
    loaded = load_problem(problem).replace({"curve.control_vertices": vertices})
    row, _ = run_method(loaded, method)
    return {
        "solved": row.solved,
        "reached": row.reached,
        "travel": row.actuator_travel,
        "step_time": row.step_time,
        "reason": row.reason,
        "spare": degree_of_redundancy(vertices, 3),
    }


def draw(rows: Sequence[Row]) -> Figure:
    """Draw reach, travel of the solved maneuvers, and step time."""
    figure, axes = panels(1, 3, height=2.7)
    for k, (problem, method) in enumerate(_CASES):
        name, mine = f"{problem}: {method}", select(rows, problem=problem, method=method)
        timed = [row for row in mine if row["step_time"] is not None]
        draw_line(axes[0], k, name, mine, "vertices", "reached")
        draw_line(axes[1], k, name, select(mine, solved=True), "vertices", "travel")
        draw_line(axes[2], k, name, timed, "vertices", "step_time", factor=1e3)
    label(axes[0], "control vertices", "part of the path", "how far", legend=False)
    label(axes[1], "control vertices", "actuator travel (m)", "solved maneuvers", legend=False)
    label(axes[2], "control vertices", "median step (ms)", "time", legend=False, log="y")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncol=2)
    return figure


def text(rows: Sequence[Row]) -> str:
    """Give the table."""
    vertices = sorted({row["vertices"] for row in rows})
    table = crossed_table(
        ("path covered; travel [m]",),
        {v: f"V = {v} ({degree_of_redundancy(v, 3)})" for v in vertices},
        {
            (f"{p}: {m}",): {row["vertices"]: _cell(row) for row in select(rows, problem=p, method=m)}
            for p, m in _CASES
        },
    )
    return (
        "In brackets the free motions of the curve once base and tip are held, 3 V - 5 - 3. A curve with more of them "
        f"than the arm means nothing to it; one with too few may not pass.\n\n{table}"
    )


def _cell(row: Row) -> str:
    return f"yes; {row['travel']:.2f}" if row["solved"] else f"no, {100 * row['reached']:.0f} %"
