"""A snake of fifteen universal joints past two cubes: one QP a step beside the pseudoinverse."""

import sys

import vgtm_qp as vq
from vgtm_qp.problem.snake import snake

# A hundred joints: python snakes.py 50
JOINTS = int(sys.argv[1]) if len(sys.argv) > 1 else 15

problem = vq.Problem(
    name=f"snake of {JOINTS} universal joints",
    arm=snake(JOINTS, length=6.0),
    curve={"control_vertices": 6},
    maneuver={"steps": 50, "waypoint": [{"time": 10.0, "position": [3.6, -2.2, 2.8]}]},
    obstacle=[
        {"name": "lower cube", "shape": "box", "center": [1.9, -0.6, 2.4], "size": 0.8},
        {"name": "upper cube", "shape": "box", "center": [3.6, -1.5, 4.6], "size": 0.8},
    ],
    clearance={"safe": 0.08},
)
print(vq.compare(problem, methods=["qp", "pseudoinverse-corrected", "pseudoinverse-obstacles"]))
