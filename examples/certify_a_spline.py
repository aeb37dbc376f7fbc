"""A cubic spline that is clear at its waypoints and hits a post between them, and what `certify` says of both."""

import numpy as np
from scipy.interpolate import CubicSpline

import vgtm_qp as vq

joints = [
    {"name": "shoulder", "axis": [0, 0, 1], "limits": [-3.0, 3.0], "rate": 2.0},
    {"name": "elbow", "axis": [0, 0, 1], "position": [1.0, 0.0, 0.0], "limits": [-2.8, 2.8], "rate": 2.0},
    {"name": "wrist", "axis": [0, 0, 1], "position": [0.8, 0.0, 0.0], "limits": [-2.8, 2.8], "rate": 2.0},
]
problem = vq.Problem(
    arm={"joint": joints, "tip": [0.4, 0.0, 0.0], "link_radius": 0.04},
    obstacle=[
        {"name": "post", "shape": "cylinder", "center": [1.45, 1.45, 0.0], "radius": 0.1, "height": 1.0},
        {"name": "wall", "shape": "box", "center": [-0.9, 0.0, 0.0], "size": [0.1, 4.0, 1.0]},
    ],
    clearance={"safe": 0.02, "influence": 0.5},
    maneuver={"waypoint": [{"time": 6.0, "position": [0.0, 2.0, 0.0]}]},
)

waypoints = np.array([[-0.3, 0.2, 0.2], [0.45, 0.3, 0.4], [1.1, 0.4, 0.5], [1.4, 0.2, 0.3]])
plan = CubicSpline([0.0, 2.0, 4.0, 6.0], waypoints, bc_type="clamped")

at_waypoints = [vq.certify(problem, [2.0 * k], [pose]).answer for k, pose in enumerate(waypoints)]
print("at the waypoints:", ", ".join(at_waypoints))

times = np.linspace(0.0, 6.0, 61)
verdict = vq.certify(problem, times, plan(times))
print("between them:", verdict.answer)
for finding in verdict.violations:
    print(" ", finding)

bent = waypoints + np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.3], [0.0, 0.9, 0.2], [0.0, 0.0, 0.0]])
detour = CubicSpline([0.0, 2.0, 4.0, 6.0], bent, bc_type="clamped")
verdict = vq.certify(problem, times, detour(times))
print("with a bent elbow:", verdict)
