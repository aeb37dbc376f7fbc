"""The instruments of the page: how the arm moves, what holds it, distances and strokes, as HTML."""

from __future__ import annotations

from html import escape

import numpy as np

from vgtm_qp.live.reading import Reading
from vgtm_qp.live.session import Session
from vgtm_qp.view.drawing import stroke_colours

_GREY, _RED, _AMBER = "#6b7280", "#b91c1c", "#b45309"
_COLOURS = {"at rest": _GREY, "moving": "#0b7a5b", "slowed": _AMBER, "blocked": _RED, "stopped": _RED}
_MOST_ACTIVE, _MOST_NEAR = 6, 2


def read_out(session: Session, message: str, said: str = "", reading: Reading | None = None) -> str:
    """Return the instruments of `session` as HTML.

    Parameters
    ----------
    message
        A notice above all else; empty for none.
    said
        How the way to a goal goes, in words.
    reading
        The session's own by default.
    """
    reading = session.reading() if reading is None else reading
    safe = session.safe
    step_time = f"{1000 * reading.step_time:.2f} ms" if reading.step_time else "-"
    rows = [
        ("clearance", _distance(reading.clearance, safe), reading.nearest),
        (f"{session.drawing.arm.body}s apart", _distance(reading.self_clearance, -np.inf), ""),
        ("off the curve", _distance(reading.gap, -np.inf), _why_off(reading)),
        ("tip to target", f"{1000 * float(np.linalg.norm(session.target - session.tip)):.1f} mm", ""),
        ("step", step_time, session.method),
    ]
    cells = "".join(
        f"<tr><td style='color:{_GREY};padding-right:0.8em'>{name}</td>"
        f"<td style='text-align:right;white-space:nowrap'><b>{value}</b></td>"
        f"<td style='color:{_GREY};padding-left:0.8em'>{escape(more)}</td></tr>"
        for name, value, more in rows
    )
    active = "".join(f"<li>{escape(name)}</li>" for name in reading.active[:_MOST_ACTIVE]) or "<li>none</li>"
    if len(reading.active) > _MOST_ACTIVE:
        active += f"<li>and {len(reading.active) - _MOST_ACTIVE} more</li>"
    return (
        "<div style='font-size:0.8rem;line-height:1.35;padding:0.2em 0.8em'>"
        f"{_notice(message)}<div style='min-height:5.4em'>{_outcome(reading, said)}</div><table>{cells}</table>"
        f"<div style='color:{_GREY};margin-top:0.4em'>strokes, least to greatest</div>{_strokes(session)}"
        f"<div style='color:{_GREY};margin-top:0.4em'>active constraints</div>"
        f"<ul style='margin:0;padding-left:1.2em;height:5.4em;overflow:auto'>{active}</ul></div>"
    )


def _notice(message: str) -> str:
    """Return the notice above the instruments; nothing without a message."""
    if not message:
        return ""
    return (
        f"<div id='notice' style='color:{_RED};border:1px solid {_RED};border-radius:4px;padding:0.3em 0.6em;"
        f"margin-bottom:0.5em;overflow-wrap:anywhere'>{escape(message)}</div>"
    )


def _outcome(reading: Reading, said: str) -> str:
    """Return how the arm moves, what holds it and what would let it go on, and what is too near."""
    text = f"<b style='color:{_COLOURS[reading.outcome]}'>{reading.outcome}</b>"
    if said:
        text += f" <span id='journey'>{escape(said)}</span>"
    if reading.outcome in ("slowed", "blocked", "stopped") and reading.stopped_by:
        text += f" <span id='stopped-by'>by {escape(', '.join(reading.stopped_by[:2]))}</span>"
    if reading.why:
        text += f"<div id='why' style='color:{_RED}'>{escape(reading.why)}</div>"
    for name, distance, least in reading.too_near[:_MOST_NEAR]:
        text += (
            f"<div class='too-near' style='color:{_AMBER}'>{escape(name)}: {1000.0 * distance:.1f} mm, "
            f"{1000.0 * (least - distance):.1f} mm too near</div>"
        )
    if (more := len(reading.too_near) - _MOST_NEAR) > 0:
        text += f"<div class='too-near' style='color:{_AMBER}'>and {more} more</div>"
    return text


def _why_off(reading: Reading) -> str:
    """Return the page's text on stations that left the curve although tracking is exact."""
    return "the curve gave way" if reading.gave_way else ""


def _distance(distance: float, least: float) -> str:
    if not np.isfinite(distance):
        return "-"
    colour = _RED if distance < least - 1e-6 else "inherit"
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
