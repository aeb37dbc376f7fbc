"""A curve family of one's own: cubics through all control vertices (Catmull and Rom, 1974)."""

import numpy as np

import vgtm_qp as vq


def catmull_rom(*, control_vertices: int, tension: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return breaks (S + 1,), and the weights (S, 4, V) of the Bezier points of each segment."""
    vertex = np.eye(control_vertices)
    slope = (1.0 - tension) * np.gradient(vertex, axis=0)  # along the first and the last leg at the ends
    segments = [
        [vertex[k], vertex[k] + slope[k] / 3.0, vertex[k + 1] - slope[k + 1] / 3.0, vertex[k + 1]]
        for k in range(control_vertices - 1)
    ]
    return np.linspace(0.0, 1.0, control_vertices), np.array(segments)


vq.register("curve", "catmull-rom", catmull_rom)
table = {"family": "catmull-rom", "control_vertices": 6}
problem = vq.load_problem("five_bay_two_cubes").replace({"curve": table})
for tension in (0.0, 0.2):
    maneuver = vq.solve(problem.replace({"curve.tension": tension}))
    on_curve = maneuver.certificate.tracking_gap.value < 1e-9
    print(f"tension {tension}: {maneuver.status}; on the curve: {on_curve}; {maneuver.certificate.ok}")
