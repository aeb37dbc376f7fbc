"""A spline that is clear at its waypoints and not between them, and what certify says of it."""

import numpy as np
from scipy.interpolate import CubicSpline

import vgtm_qp as vq

joints = [
    {"name": name, "axis": [0, 0, 1], "position": [x, 0, 0], "limits": [-2.5, 2.5], "rate": 2.0}
    for name, x in (("shoulder", 0.0), ("elbow", 0.5), ("wrist", 0.4))
]
problem = vq.Problem(
    name="arm in a plane, past a post",
    arm={"joint": joints, "tip": [0.2, 0.0, 0.0], "link_radius": 0.03},
    maneuver={"waypoint": [{"time": 5.0, "position": [0.8, 0.4, 0.0]}]},
    obstacle=[
        {"name": "post", "shape": "cylinder", "center": [1.12, 0.0, 0.0], "radius": 0.05, "height": 1.0}
    ],
    clearance={"safe": 0.03},
)


def plan(times: list[float], waypoints: list[list[float]]) -> vq.Verdict:
    """Join the waypoints by a spline, as many planners do, and certify it at 100 Hz."""
    spline = CubicSpline(times, waypoints, bc_type="clamped")
    at_waypoints = all(vq.certify(problem, [0.0], [row]).certified for row in waypoints)
    print(f"clear at all of its {len(times)} waypoints: {at_waypoints}")
    rows = np.linspace(0.0, times[-1], int(100 * times[-1]) + 1)
    return vq.certify(problem, rows, spline(rows))


times = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
waypoints = [
    [-0.9, 0.3, 0.2],
    [-0.6, 0.3, 0.2],
    [-0.25, 0.1, 0.0],
    [0.25, 0.1, 0.0],
    [0.6, 0.3, 0.2],
    [0.9, 0.3, 0.2],
]
print(plan(times, waypoints))

# Slower, and folded where it passes the post.
times = [0.0, 1.5, 3.0, 4.5, 6.0, 7.5, 9.0]
folded = plan(times, [*waypoints[:2], [-0.4, 0.9, 0.3], [0.0, 1.4, 0.3], [0.4, 0.9, 0.3], *waypoints[4:]])
print(f"through 7 waypoints: {folded}")
