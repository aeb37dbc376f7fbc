"""One offline HTML file with a play bar: the maneuver in three dimensions, for anyone with a browser."""

from __future__ import annotations

from collections.abc import Callable
from html import escape

import numpy as np

from vgtm_qp.result.result import Result
from vgtm_qp.view.drawing import camera_for, drawing_of_maneuver, off_curve, resampled
from vgtm_qp.view.scene import ArmScene
from vgtm_qp.view.server import viser_server

_LONGEST = 20.0
_FRAMES = 200


def html_text(maneuver: Result, progress: Callable[[float], None] | None = None) -> str:
    """Return a page that needs no network and no server; it plays in real time, longer maneuvers in 20 s.

    Between states the nodes move on straight lines, as the certificate assumes. Links are drawn by the URDF file of the
    problem where it is still there; bodies that are kept clear can be shown instead in the page's tree of the scene.
    """
    drawing = drawing_of_maneuver(maneuver)
    time, nodes, vertices = maneuver.time, maneuver.nodes, maneuver.control_vertices
    at = np.linspace(time[0], time[-1], _FRAMES) if len(time) > 1 else time
    moving, curves = resampled(time, nodes, at), resampled(time, vertices, at)
    configurations = resampled(time, maneuver.configurations, at)
    # The clearance shown is that of the last state: between states it does not change linearly.
    rows = np.searchsorted(time, at + 1e-9, side="right") - 1
    off = off_curve(maneuver)
    tip = maneuver.tip_position

    with viser_server() as server:
        scene = ArmScene(server, drawing, nodes[0], vertices[0])
        if len(tip) > 1:
            scene.add_path("/tip path", tip)
        scene.look(camera_for(drawing, nodes, tip))
        top = nodes[..., 2].max() + 0.12 * np.ptp(nodes[..., 2])
        label = server.scene.add_label(
            "/read-out", "", position=(*nodes[0].mean(axis=0)[:2], top), anchor="bottom-center"
        )
        recording = server.get_scene_serializer()
        pause = min(float(time[-1] - time[0]), _LONGEST) / max(len(at) - 1, 1)
        for k, (moment, row) in enumerate(zip(at, rows, strict=True)):
            scene.move(moving[k], curves[k], float(moment), q=configurations[k], coarse=True)
            label.text = read_out(maneuver, float(moment), float(maneuver.clearance[row]), off[row])
            recording.insert_sleep(pause)
            if progress is not None:
                progress((k + 1) / len(at))
        page: str = recording.as_html()
    title = escape(f"{drawing.name or 'maneuver'} ({maneuver.status})")
    return page.replace("<title>Viser</title>", f"<title>{title}</title>", 1)


def read_out(maneuver: Result, time: float, clearance: float, off: str = "") -> str:
    """Return the line over the arm: time, clearance, what else is told of the state, and why the maneuver ends."""
    text = f"{time:.1f} s"
    if np.isfinite(clearance):
        text += f"   clearance {1000.0 * clearance:.0f} mm"
    if off:
        text += f"   {off}"
    if time >= maneuver.time[-1] and maneuver.status != "solved":
        text += f"   {maneuver.status}: {maneuver.why_not}"
    return text
