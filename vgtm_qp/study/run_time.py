"""Figure 9: run time of 50 steps against the number of bays, for every method."""

from __future__ import annotations

from collections.abc import Sequence
from time import thread_time

import numpy as np
from matplotlib.figure import Figure

from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.comparison.tables import crossed_table, exponent
from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.maneuver.solve import compile_steps
from vgtm_qp.methods import Resolver, with_method
from vgtm_qp.study.arms import bending_problem
from vgtm_qp.study.drawing import draw_line, label, legend_above, mark_bays, panels, select
from vgtm_qp.study.workers import Row, Task

_STEPS = 50
_REACH = 1.2
_NAMES = {
    "pseudoinverse": "eq. (28), dense, SVD",
    "pseudoinverse-weighted": "eq. (28), dense, Cholesky",
    "pseudoinverse-sparse": "eq. (28), sparse KKT",
    "curve-pseudoinverse": "curve, recursive",
    "curve-pseudoinverse-parallel": "curve, parallel",
    "qp": "QP, certified",
}
_WITH_CUBES = {
    "pseudoinverse-obstacles": "eq. (28), sparse, potential, corrected",
    "curve-pseudoinverse-obstacles": "curve, parallel, potential, corrected",
    "qp": "QP, certified",
}
_DENSE_BAYS = 80
_FIT_FROM = 10


def tasks(short: bool) -> list[Task]:
    """Return one task a method and number of bays, without and with cubes."""
    bays = (2, 5) if short else (2, 5, 10, 20, 40, 80, 160)
    found = [
        {"bays": n, "method": method, "cubes": False}
        for method in _NAMES
        for n in bays
        if n <= _DENSE_BAYS or method not in ("pseudoinverse", "pseudoinverse-weighted")
    ]
    return found + [{"bays": n, "method": m, "cubes": True} for m in _WITH_CUBES for n in bays if n >= 5]


def run(bays: int, method: str, cubes: bool) -> Row:
    """Return the processor time of 50 steps, s: fifty times their median, and their sum."""
    height = bays * np.sqrt(2.0 / 3.0)
    part = min(_REACH / height, 0.3)
    goal = (part, 0.3 * part, -0.4 * part)
    # At most two vertices more than bays: a curve with many more motions than the arm cannot be tracked.
    problem = bending_problem(bays, steps=_STEPS, goal=goal, vertices=min(6, bays + 2), cubes=cubes)
    changed = with_method(problem, method)
    # Kernels are compiled, and memory is touched, in a step of another arm, which does not count.
    compile_steps(changed)
    resolver = Resolver(changed)
    plan = make_plan(problem, *resolver.tip())
    times: list[float] = []
    value, reason = plan.path.start, ""
    for mark in plan.marks:
        while value < mark and not reason and len(times) < 4 * _STEPS:
            clock = thread_time()
            step = resolver.follow(plan.path, value, float(mark))
            times.append(thread_time() - clock)
            reason = step.reason
            value = (
                float(mark) if step.progress >= 1.0 - 1e-9 else value + step.progress * (float(mark) - value)
            )
    fixed = truss_of(resolver.setup.arm).fixed
    drift = np.abs(resolver.state.quantities - resolver.setup.arm.home_quantities)[fixed].max()
    return {
        "time": _STEPS * float(np.median(times)),
        "sum": float(np.sum(times)),
        "steps": len(times),
        "reached": float((value - plan.path.start) / (plan.path.end - plan.path.start)),
        "reason": reason,
        "drift": float(drift),
    }


def draw(rows: Sequence[Row]) -> Figure:
    """Draw time against bays, without and with cubes."""
    figure, axes = panels(1, 2, height=3.3)
    for panel, cubes, names in zip(axes, (False, True), (_NAMES, _WITH_CUBES), strict=True):
        for k, (method, name) in enumerate(names.items()):
            style = "-" if method == "qp" else "--" if method.startswith("curve") else ":"
            draw_line(panel, k, name, _of(rows, method, cubes), "bays", "time", style=style)
        title = "two cubes, clearance watched" if cubes else "no obstacles"
        label(panel, "bays", f"processor time of {_STEPS} steps (s)", log="xy", legend=False)
        legend_above(panel, 1, title)
        mark_bays(panel, [row["bays"] for row in select(rows, cubes=cubes)])
    return figure


def text(rows: Sequence[Row]) -> str:
    """Say how the times grow, and whether the curve is still faster than a sparse solver."""
    parts = [
        f"{_STEPS} steps of a free octahedral arm, the tip moving by at most {_REACH} m; {_STEPS} times the median "
        "step, in processor time of one thread. The pseudoinverse methods do not correct drift, keep no limits and "
        "know no obstacles, as in the paper; the QP keeps limits and clearances and proves them between the states."
    ]
    for cubes, names in ((False, _NAMES), (True, _WITH_CUBES)):
        bays = sorted({row["bays"] for row in select(rows, cubes=cubes)})
        if not bays:
            continue
        lines = {}
        for method, name in names.items():
            mine = _of(rows, method, cubes)
            cells = {row["bays"]: f"{1e3 * row['time']:.0f}" + "*" * bool(row["reason"]) for row in mine}
            fit = [(row["bays"], row["time"]) for row in mine if row["bays"] >= _FIT_FROM]
            growth = f"n^{exponent(*zip(*fit, strict=True)):.2f}" if len(fit) > 1 else "-"
            lines[(name,)] = cells | {"growth": growth}
        corner = "with two cubes [ms]" if cubes else "no obstacles [ms]"
        columns = {n: f"{n} bays" for n in bays} | {"growth": "growth"}
        parts.append(crossed_table((corner,), columns, lines))
    parts.append(
        f"Growth fitted from {_FIT_FROM} bays on; * broke down on the way. All run from Python: with few bays its "
        "calls take the time, not the arithmetic. The QP's step and the kinematics are compiled; the recursive form is "
        "a Python loop over the bays, and the parallel form the same work in few calls."
    )
    parts.append(_verdict(rows))
    return "\n\n".join(parts)


def _verdict(rows: Sequence[Row]) -> str:
    times = {name: {row["bays"]: row["time"] for row in _of(rows, name, False)} for name in _NAMES}
    lines, sparse = [], []
    for method, algebra in (("pseudoinverse", "dense algebra"), ("pseudoinverse-sparse", "a sparse solver")):
        gains = []
        for way in ("curve-pseudoinverse", "curve-pseudoinverse-parallel"):
            if shared := times[way].keys() & times[method].keys():
                most = max(shared)
                gain = times[method][most] / times[way][most]
                digits, form = int(gain < 10.0), _NAMES[way].removeprefix("curve, ")
                gains.append(f"{gain:.{digits}f} times as fast in the {form} form")
                if method == "pseudoinverse-sparse":
                    sparse.append(gain)
        if gains:
            lines.append(f"Against {algebra} the curve method is {' and '.join(gains)}, at {most} bays.")
    if sparse and max(sparse) < 1.0:
        lines.append(
            "The advantage that the paper reports is over dense algebra; over a sparse solver there is none."
        )
    elif sparse and min(sparse) < 1.0:
        lines.append("Over a sparse solver nothing is left of the recursive form's advantage.")
    return " ".join(lines)


def _of(rows: Sequence[Row], method: str, cubes: bool) -> list[Row]:
    return sorted(select(rows, method=method, cubes=cubes), key=lambda row: int(row["bays"]))
