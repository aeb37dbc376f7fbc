"""A truss of one's own, from a graph: a platform on six legs that lifts, slides and tilts."""

import numpy as np

import vgtm_qp as vq


def triangle(radius: float, height: float, turned: float) -> list[list[float]]:
    """Return three points of a horizontal triangle, m."""
    angles = turned + 2.0 * np.pi * np.arange(3) / 3.0
    return [[radius * float(np.cos(a)), radius * float(np.sin(a)), height] for a in angles]


ground, platform = triangle(1.0, 0.0, 0.0), triangle(0.6, 1.2, np.pi / 3.0)
nodes = [{"name": f"g{k}", "position": point, "fixed": True} for k, point in enumerate(ground)]
nodes += [{"name": f"p{k}", "position": point} for k, point in enumerate(platform)]

legs = [(k, j) for k in range(3) for j in (k, (k + 2) % 3)]
members = [
    {"name": f"leg {k}-{j}", "nodes": [f"g{k}", f"p{j}"], "actuated": True, "stroke": [1.0, 2.2]}
    for k, j in legs
]
members += [{"name": f"edge {k}", "nodes": [f"p{k}", f"p{(k + 1) % 3}"]} for k in range(3)]

problem = vq.Problem.from_dict(
    {
        "schema_version": 1,
        "name": "platform on six legs",
        "truss": {
            "module": "graph",
            "member_radius": 0.03,
            "tip": ["p0", "p1", "p2"],
            "node": nodes,
            "member": members,
        },
        "end_effector": {"track": ["position", "orientation"]},
        "maneuver": {
            "steps": 40,
            "waypoint": [{"time": 4.0, "position": [0.25, 0.1, 1.35], "rotation_vector": [0.2, -0.15, 0.3]}],
        },
        "clearance": {"safe": 0.01, "influence": 0.2},
        "method": {"tracking": "none"},
    }
)
print(vq.describe(vq.build_truss(problem.truss)))

maneuver = vq.solve(problem)
print(f"{maneuver.status}; verified: {maneuver.certificate.ok}")
for name, length in zip(maneuver.member_names, maneuver.member_lengths[-1], strict=True):
    print(f"  {name:8s} {length:.4f} m")
