"""How strictly the arm tracks its curve: exact, hard, elastic, not at all, or after the curve; over random scenes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from time import process_time

import numpy as np
from matplotlib.figure import Figure

from vgtm_qp.comparison.tables import markdown_table
from vgtm_qp.errors import ProblemError
from vgtm_qp.maneuver.solve import solve
from vgtm_qp.problem import Problem
from vgtm_qp.study.drawing import label, panels, select
from vgtm_qp.study.robustness import SEED, share_of
from vgtm_qp.study.scenes import random_scene
from vgtm_qp.study.workers import Row, Task

TRACKINGS = {
    "exact": {"method.tracking_mode": "exact"},
    "hard": {"method.tracking_mode": "hard"},
    "elastic": {"method.tracking_mode": "elastic"},
    "none": {"method.tracking": "none"},
    "recursive": {"method.tracking": "recursive"},
    "parallel": {"method.tracking": "parallel"},
}
"""The changes of each form in a problem."""


def tasks(
    short: bool,
    *,
    scenes: int | None = None,
    seed: int = SEED,
    steps: int = 30,
    forms: Sequence[str] = tuple(TRACKINGS),
) -> list[Task]:
    """Return one task a scene and form of tracking."""
    count = scenes if scenes is not None else 3 if short else 1000
    scene = {"seed": seed, "steps": steps}
    return [{**scene, "number": k, "tracking": form} for k in range(count) for form in forms]


@lru_cache(maxsize=2)
def _scene(seed: int, number: int, steps: int) -> Problem:
    """Return the problem of a scene, which is the same for all forms."""
    return random_scene(seed, number, steps=steps).problem


def run(seed: int, number: int, steps: int, tracking: str) -> Row:
    """Solve one scene with one form of tracking and return its row.

    Keys: ``module``, ``status``, the part of the path that was ``reached``, ``failures`` of the independent
    check, ``way_out``, ``states``; the share of ``exact`` states, with stations within 1e-6 m of the curve,
    and the greatest ``gap`` of all states, m, None without a curve; the ``travel`` of all actuators, m; the
    median ``step``, s, and CPU ``seconds``.
    """
    problem = _scene(seed, number, steps)
    module, started = problem.to_dict()["truss"]["module"], process_time()
    try:
        maneuver = solve(problem.replace(TRACKINGS[tracking]))
    except ProblemError as error:
        nothing = {"reached": 0.0, "failures": [], "way_out": "", "states": 0}
        nothing |= dict.fromkeys(("exact", "gap", "travel", "step"))
        return {"module": module, "status": f"refused: {error}", **nothing, "seconds": 0.0}
    summary, certificate = maneuver.summary(), maneuver.certificate
    assert certificate is not None
    off = certificate.states_off_curve.value
    lengths = maneuver.member_lengths[:, maneuver.member_actuated]
    return {
        "module": module,
        **{key: summary[key] for key in ("status", "reached", "failures", "way_out")},
        "states": len(maneuver.time),
        "exact": None if off is None else 1.0 - off,
        "gap": certificate.tracking_gap.value,
        "travel": float(np.abs(np.diff(lengths, axis=0)).sum()),
        "step": float(np.median(maneuver.step_time[1:])) if len(maneuver.time) > 1 else None,
        "seconds": process_time() - started,
    }


def draw(rows: Sequence[Row]) -> Figure:
    """Draw the number of solved scenes, and the share of their steps that are exact."""
    figure, axes = panels(1, 2, height=2.6)
    forms = [form for form in TRACKINGS if select(rows, tracking=form)]
    solved = [select(rows, tracking=form, status="solved") for form in forms]
    axes[0].bar(forms, [len(some) for some in solved])
    axes[1].bar(forms, [100.0 * (_exact(some) or 0.0) for some in solved])
    for panel, text in zip(axes, ("scenes solved", "steps on the curve to 1e-6 m (%)"), strict=True):
        label(panel, "tracking", text, legend=False)
        panel.tick_params("x", rotation=40)
    return figure


def text(rows: Sequence[Row]) -> str:
    """Give what each form solved, what only others solved, and the stations' distance from the curve."""
    if not rows:
        return "No scene was run."
    solved = {form: select(rows, tracking=form, status="solved") for form in TRACKINGS}
    numbers = {form: {row["number"] for row in some} for form, some in solved.items()}
    lines = []
    for form, some in solved.items():
        every = select(rows, tracking=form)
        if not every:
            continue
        first = sum(not row["way_out"] for row in some)
        both = [row for row in some if row["number"] in numbers["hard"]]
        broken = sum(bool(row["failures"]) for row in every)
        lost = len(numbers["elastic"] - numbers[form])
        lines.append(
            (
                form,
                share_of(every),
                f"{first}",
                f"{lost}",
                f"{broken}",
                _percent(_exact(some)),
                _percent(_exact(both)),
                _median(some, "gap", 1.0, "{:.2g} m"),
                _median(some, "travel", 1.0, "{:.3g} m"),
                _median(some, "step", 1e3, "{:.2g} ms"),
            )
        )
    head = (
        "tracking", "solved", "at first", "lost of elastic", "broken", "exact steps", "the same where hard solves",
        "gap", "travel", "step",
    )  # fmt: skip
    scenes = len({row["number"] for row in rows})
    return (
        f"Seed {rows[0]['seed']}, scenes 0 to {scenes - 1}, {rows[0]['steps']} steps each. Steps are exact with all "
        "stations within 1e-6 m of the curve; gap (the greatest of a maneuver), travel of all actuators and time of a "
        f"step are medians of what was solved.\n\n{markdown_table(head, lines)}"
    )


def _exact(rows: Sequence[Row]) -> float | None:
    """Return the share of exact steps of some rows; None if no row has a curve."""
    known = [row for row in rows if row["exact"] is not None]
    steps = sum(row["states"] - 1 for row in known)
    return sum(row["exact"] * (row["states"] - 1) for row in known) / steps if steps else None


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:.1f} %"


def _median(rows: Sequence[Row], key: str, factor: float, form: str) -> str:
    values = [factor * row[key] for row in rows if row[key] is not None]
    return form.format(float(np.median(values))) if values else "-"
