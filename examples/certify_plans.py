"""What three others have planned, each clear at all of its own points, and what certify says of it."""

from collections.abc import Sequence
from pathlib import Path

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
before, after = [-0.9, 0.3, 0.2], [0.9, 0.3, 0.2]


def is_clear(row: Sequence[float]) -> bool:
    """Return whether the arm is clear in one pose, as planners ask."""
    return vq.certify(problem, [0.0], [row]).certified


def spline(times: list[float], waypoints: list[list[float]]) -> vq.Verdict:
    """Join waypoints by a cubic spline, and certify its rows at 100 Hz."""
    print(f"a spline, clear at all of its {len(times)} waypoints: {all(map(is_clear, waypoints))}")
    rows = np.linspace(0.0, times[-1], int(100 * times[-1]) + 1)
    return vq.certify(problem, rows, CubicSpline(times, waypoints, bc_type="clamped")(rows))


print(
    spline(
        [0.0, 1.0, 2.0, 3.0, 4.0, 5.0],
        [before, [-0.6, 0.3, 0.2], [-0.25, 0.1, 0.0], [0.25, 0.1, 0.0], [0.6, 0.3, 0.2], after],
    )
)
folded = [
    before,
    [-0.6, 0.3, 0.2],
    [-0.4, 0.9, 0.3],
    [0.0, 1.4, 0.3],
    [0.4, 0.9, 0.3],
    [0.6, 0.3, 0.2],
    after,
]
print(spline([0.0, 1.5, 3.0, 4.5, 6.0, 7.5, 9.0], folded))

# A trajectory for a controller of ROS 2, as `ros2 topic echo` writes it; a recorded bag (.mcap) is read alike.
points = "".join(
    f"- positions: {row}\n  time_from_start: {{sec: {2 * k}, nanosec: 0}}\n" for k, row in enumerate(folded)
)
out = Path("out")
out.mkdir(exist_ok=True)
recorded = out / "recorded.yaml"
recorded.write_text(f"joint_names: [shoulder, elbow, wrist]\npoints:\n{points}")
try:
    print(f"from ROS: {vq.Certifier(problem).certify_file(recorded)}")
except vq.MissingExtraError as error:
    print(f"from ROS: {error}")

# A planner that looks at states so far apart that the arm may jump over the post: pip install ompl.
try:
    from ompl import base, geometric, util
except ImportError:
    print("from OMPL: it is not installed")
else:
    util.setLogLevel(util.LogLevel.LOG_WARN)
    space, bounds = base.RealVectorStateSpace(3), base.RealVectorBounds(3)
    bounds.setLow(-2.5)
    bounds.setHigh(2.5)
    space.setBounds(bounds)
    space.setLongestValidSegmentFraction(0.1)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(lambda state: is_clear([state[k] for k in range(3)]))
    ends = space.allocState(), space.allocState()
    for state, row in zip(ends, (before, after), strict=True):
        for k, value in enumerate(row):
            state[k] = value
    setup.setStartAndGoalStates(*ends)
    setup.solve(5.0)
    plan = np.array([[state[k] for k in range(3)] for state in setup.getSolutionPath().getStates()])
    # As fast as the joints may turn, and a little slower.
    times = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(plan, axis=0)).max(axis=1) / 1.8)])
    print(f"OMPL, clear at all of its {len(plan)} states: {all(map(is_clear, plan.tolist()))}")
    print(vq.certify(problem, times, plan))
