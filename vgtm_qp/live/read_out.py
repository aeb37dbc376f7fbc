"""The live page's instruments as HTML: outcome, clearance, step time, active constraints and strokes."""

from __future__ import annotations

from html import escape

import numpy as np

from vgtm_qp.live.session import Session
from vgtm_qp.view.drawing import stroke_colours

_COLOURS = {"at rest": "#6b7280", "moving": "#0b7a5b", "slowed": "#b45309", "blocked": "#b91c1c"}
_MOST_ACTIVE = 6


def read_out(session: Session, message: str) -> str:
    """Return the instruments of `session` as HTML, under `message` where there is one."""
    reading = session.reading()
    safe = session.problem.clearance.safe
    step_time = f"{1000 * reading.step_time:.2f} ms" if reading.step_time else "-"
    rows = [
        ("clearance", _distance(reading.clearance, safe), reading.nearest),
        (f"{session.drawing.arm.body}s apart", _distance(reading.self_clearance, -np.inf), ""),
        ("tip to target", f"{1000 * float(np.linalg.norm(session.target - session.tip)):.1f} mm", ""),
        ("step", step_time, session.problem.method.name),
    ]
    cells = "".join(
        f"<tr><td style='color:#6b7280;padding-right:0.8em'>{name}</td>"
        f"<td style='text-align:right;white-space:nowrap'><b>{value}</b></td>"
        f"<td style='color:#6b7280;padding-left:0.8em'>{escape(more)}</td></tr>"
        for name, value, more in rows
    )
    stopped = ", ".join(reading.stopped_by[:3]) if reading.outcome in ("slowed", "blocked") else ""
    outcome = f"<b style='color:{_COLOURS[reading.outcome]}'>{reading.outcome}</b>"
    if stopped:
        outcome += f" <span id='stopped-by'>by {escape(stopped)}</span>"
    active = "".join(f"<li>{escape(name)}</li>" for name in reading.active[:_MOST_ACTIVE]) or "<li>none</li>"
    if len(reading.active) > _MOST_ACTIVE:
        active += f"<li>and {len(reading.active) - _MOST_ACTIVE} more</li>"
    notice = f"<div style='color:#b91c1c'>{escape(message)}</div>" if message else ""
    return (
        "<div style='font-size:0.8rem;line-height:1.35;padding:0.2em 0.8em'>"
        f"{notice}<div style='min-height:2.7em'>{outcome}</div><table>{cells}</table>"
        f"<div style='color:#6b7280;margin-top:0.4em'>strokes, least to greatest</div>{_strokes(session)}"
        f"<div style='color:#6b7280;margin-top:0.4em'>active constraints</div>"
        f"<ul style='margin:0;padding-left:1.2em;min-height:5.4em'>{active}</ul></div>"
    )


def _distance(distance: float, least: float) -> str:
    if not np.isfinite(distance):
        return "-"
    colour = "#b91c1c" if distance < least - 1e-6 else "inherit"
    return f"<span style='color:{colour}'>{1000 * distance:.1f} mm</span>"


def _strokes(session: Session) -> str:
    """Return a bar for each actuator: how much of its stroke is out."""
    share = session.drawing.stroke_share(session.state.quantities)
    colours = np.round(255 * stroke_colours(np.nan_to_num(share))).astype(int)
    bars = "".join(
        f"<div title='{escape(name)}' style='flex:1;height:{max(2.0, 100.0 * part):.1f}%;"
        f"background:rgb({red},{green},{blue})'></div>"
        for name, part, (red, green, blue) in zip(
            session.drawing.arm.quantity_names, share.tolist(), colours.tolist(), strict=True
        )
        if not np.isnan(part)
    )
    return (
        "<div style='display:flex;align-items:flex-end;gap:1px;height:2.6em;"
        f"border-top:1px dashed #9ca3af;border-bottom:1px solid #9ca3af'>{bars}</div>"
    )
