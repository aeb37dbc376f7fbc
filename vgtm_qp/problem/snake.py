"""Snakes: the ``[arm]`` table of a serial arm of any number of universal joints."""

from __future__ import annotations

from typing import Any


def snake(
    universal: int,
    *,
    length: float = 4.0,
    radius: float = 0.03,
    bend: float = 1.0,
    limit: float = 1.0,
    rate: float = 0.5,
) -> dict[str, Any]:
    """Return the ``[arm]`` table of a snake; each of its `universal` joints is two joints in one place.

    At home the snake is a gentle arc, since a straight snake is singular.

    Parameters
    ----------
    length, radius
        Of the whole snake and of its links, m.
    bend
        Turn of its end at home, rad.
    limit, rate
        Of every joint, rad to either side, and rad/s.
    """
    link, home = length / universal, bend / universal
    # The arc leaves its plane: otherwise the joints could not move the tip in every direction.
    kinds = (("pitch", [1.0, 0.0, 0.0], 0.6 * home, link), ("yaw", [0.0, 1.0, 0.0], home, 0.0))
    joints = [
        {
            "name": f"{name}-{k + 1}",
            "axis": axis,
            "position": [0.0, 0.0, apart if k else 0.0],
            "limits": [-limit, limit],
            "home": value,
            "rate": rate,
        }
        for k in range(universal)
        for name, axis, value, apart in kinds
    ]
    return {"joint": joints, "tip": [0.0, 0.0, link], "link_radius": radius}
