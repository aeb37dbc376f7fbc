"""Three bays and boxes beside them, for the tests of arms that are too near and of meshes."""

from __future__ import annotations

from typing import Any

import vgtm_qp as vq

BASE = {
    "name": "three bays",
    "truss": {"module": "octahedral", "bays": 3, "stroke": [0.6, 1.5]},
    "curve": {"control_vertices": 4},
    "maneuver": {"steps": 20, "waypoint": [{"time": 4.0, "position": [0.0, 0.5, 2.2]}]},
    "clearance": {"safe": 0.08, "influence": 0.5},
    "method": {"retries": False},
}


def problem(**changes: Any) -> vq.Problem:
    """The problem with changes by key path."""
    found = vq.Problem.from_dict(BASE)
    return found.replace(changes) if changes else found


def box(name: str, center: list[float], size: Any, **more: Any) -> dict[str, Any]:
    """The table of a box."""
    return {"name": name, "shape": "box", "center": center, "size": size, **more}
