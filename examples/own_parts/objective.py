"""An objective of one's own: the third face of the arm stays level, as far as the tip's way allows."""

import numpy as np

import vgtm_qp as vq

FACE = ["n3-1", "n3-2", "n3-3"]


def slopes(nodes: dict) -> list:
    """Return the differences in height of the nodes of the face, expressions of CasADi, m."""
    first, second, third = (nodes[name][2] for name in FACE)
    return [second - first, third - first]


level = vq.Objective("third face level", slopes, weight=2.0, unit="m")
problem = vq.load_problem("five_bay_free").replace({"method.tracking": "none"})
for objectives in ([], [level]):
    maneuver = vq.solve(problem, objectives=objectives)
    face = maneuver.nodes[:, [list(vq.build_truss(problem.truss).node_names).index(name) for name in FACE]]
    print(
        f"{len(objectives)} objectives: {maneuver.status}, {maneuver.certificate.ok}; "
        f"out of level by at most {np.ptp(face[:, :, 2], axis=1).max():.3f} m"
    )
