"""Quantities of a maneuver over time: clearance, strokes, tip error, gap to the curve and step time."""

from __future__ import annotations

from collections.abc import Callable

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from vgtm_qp.arrays import Array
from vgtm_qp.result.result import Result
from vgtm_qp.verify.arm import arm_of
from vgtm_qp.verify.curve import TRACKING_TOLERANCE, greatest_gaps
from vgtm_qp.verify.path import TIP_TOLERANCE, tip_error
from vgtm_qp.verify.scenes import SELF_SHARE
from vgtm_qp.view.style import BOUND_COLOUR, COLOURS, DASHES, FORBIDDEN, RC

_SIZE = (4.6, 2.7)
_NAMED = 5
_SMALLEST = 1e-17


def _draw_clearance(axes: Axes, maneuver: Result) -> None:
    """Draw the least distances to obstacles and between bodies over time, mm, above those that are forbidden."""
    rules = maneuver.manifest["problem"]["clearance"]
    safe, own = 1000.0 * float(rules["safe"]), rules.get("self_safe")
    bodies = f"between {arm_of(maneuver).body}s"
    both = {"to obstacles": maneuver.clearance, bodies: maneuver.self_clearance}
    shown = [(name, values) for name, values in both.items() if np.isfinite(values).any()]
    for (name, values), colour, dash in zip(shown, COLOURS, DASHES, strict=False):
        axes.plot(maneuver.time, 1000.0 * values, color=colour, linestyle=dash, label=name)
    floor = min(0.0, *(1100.0 * float(values.min()) for _, values in shown)) if shown else 0.0
    if any(name == "to obstacles" for name, _ in shown):
        kept = np.full(len(maneuver.time), safe)
        for scene in maneuver.manifest.get("scenes") or ():
            kept[scene["row"] :] = 1000.0 * scene["safe"]
        if np.ptp(kept) > 0.0:
            label = f"too near an obstacle: below {kept.min():g} to {kept.max():g} mm"
            axes.fill_between(maneuver.time, floor, kept, step="post", label=label, **FORBIDDEN)
        else:
            axes.axhspan(floor, safe, label=f"too near an obstacle: below {safe:g} mm", **FORBIDDEN)
    if rules.get("self_collision", True) and any(name == bodies for name, _ in shown):
        least = SELF_SHARE * safe if own is None else 1000.0 * float(own)
        axes.axhline(least, color=COLOURS[1], linestyle=":", label=f"least {bodies}: {least:g} mm")
    axes.set_ylim(bottom=floor)
    axes.set_ylabel("least clearance (mm)")
    # Above the axes, where nothing is drawn.
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncol=2, borderaxespad=0.3)


def _draw_strokes(axes: Axes, maneuver: Result) -> None:
    """Draw the lengths of the actuated members over time, between their limits.

    The unit is m if all have the same stroke, otherwise % of the stroke. The members that come nearest to a
    limit are named; the others are grey.
    """
    arm = arm_of(maneuver)
    limited = np.isfinite(arm.stroke[arm.actuated]).all(axis=1)
    actuators = np.flatnonzero(arm.actuated)[limited]
    low, high = arm.stroke[actuators].T
    lengths = maneuver.actuator_values[:, limited]
    share = (lengths - low) / np.where(high > low, high - low, 1.0)
    alike = bool(len(actuators)) and np.ptp(low) == 0.0 and np.ptp(high) == 0.0
    values, bottom, top = (lengths, low[0], high[0]) if alike else (100.0 * share, 0.0, 100.0)
    order = np.argsort(np.minimum(share, 1.0 - share).min(axis=0), kind="stable")
    for k in order[_NAMED:][::-1]:
        axes.plot(maneuver.time, values[:, k], color="0.78", linewidth=0.8)
    for k, colour, dash in zip(order[:_NAMED], COLOURS, DASHES, strict=False):
        name = arm.quantity_names[actuators[k]]
        axes.plot(maneuver.time, values[:, k], color=colour, linestyle=dash, label=name)
    room = 0.08 * (top - bottom)
    axes.axhspan(bottom - room, bottom, **FORBIDDEN)
    axes.axhspan(top, top + room, **FORBIDDEN)
    axes.set_ylim(bottom - room, top + room)
    unit = "length (m)" if maneuver.joints is None else "value (rad or m)"
    axes.set_ylabel(f"actuator {unit}" if alike else "part of the stroke (%)")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), title="nearest a limit")


def _draw_tip_error(axes: Axes, maneuver: Result) -> None:
    """Draw the distance of the tip from its target over the tracked axes, m."""
    error = tip_error(maneuver, maneuver.tip_position)
    _draw_error(axes, maneuver, error, TIP_TOLERANCE)
    axes.set_ylabel("tip error (m)")


def _draw_gap(axes: Axes, maneuver: Result) -> None:
    """Draw the greatest distance of a station from its node of the reference curve over time, m."""
    _draw_error(axes, maneuver, greatest_gaps(maneuver), TRACKING_TOLERANCE)
    axes.set_ylabel("greatest gap to the curve (m)")


def _draw_error(axes: Axes, maneuver: Result, error: Array | None, tolerance: float) -> None:
    """Draw errors (T,), m, if there are any, and their tolerance, which is relative to the arm's size."""
    if error is not None:
        shown = np.maximum(error, _SMALLEST)
        axes.semilogy(maneuver.time, shown, color=COLOURS[0], marker=".", markersize=3.0)
    level = tolerance * arm_of(maneuver).size
    axes.axhline(level, color=BOUND_COLOUR, linestyle="--", linewidth=0.9, label="tolerance")
    axes.set_ylim(bottom=_SMALLEST / 2.0)
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.3)


def _draw_step_time(axes: Axes, maneuver: Result) -> None:
    """Draw the computing time of each step by phase, ms, and median and 99th percentile of the whole."""
    steps = np.arange(1, len(maneuver.time))
    phases = 1000.0 * maneuver.phase_time[1:]
    total = 1000.0 * maneuver.step_time[1:]
    below = np.zeros(len(steps))
    for values, name, colour in zip(phases.T, maneuver.phase_names, COLOURS, strict=False):
        axes.bar(steps, values, bottom=below, width=1.0, color=colour, label=str(name))
        below += values
    axes.bar(steps, np.maximum(total - below, 0.0), bottom=below, width=1.0, color="0.8", label="the rest")
    if len(steps):
        for quantile, name, dash in ((50, "median", "-"), (99, "99 %", ":")):
            value = float(np.percentile(total, quantile))
            axes.axhline(value, color="0.15", linestyle=dash, linewidth=0.9, label=f"{name}: {value:.2g} ms")
        axes.set_xlim(0.5, len(steps) + 0.5)
    axes.set(xlabel="step", ylabel="computing time (ms)")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


_DRAW: dict[str, Callable[[Axes, Result], None]] = {
    "clearance": _draw_clearance,
    "strokes": _draw_strokes,
    "tip error": _draw_tip_error,
    "tracking gap": _draw_gap,
    "step time": _draw_step_time,
}


def plot(quantity: str, maneuver: Result, axes: Axes | None) -> Figure:
    """Draw a quantity of a maneuver into `axes`, or those of a new figure unknown to pyplot; return the figure."""
    with mpl.rc_context(RC):
        if axes is None:
            axes = Figure(figsize=_SIZE, layout="constrained").add_subplot()
        axes.set_xlabel("time (s)")
        if len(maneuver.time) > 1:
            axes.set_xlim(maneuver.time[0], maneuver.time[-1])
        _DRAW[quantity](axes, maneuver)
    figure = axes.get_figure(root=True)
    assert figure is not None
    return figure
