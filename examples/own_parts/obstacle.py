"""An obstacle shape of one's own: a capsule, which consists of a cylinder and two balls."""

import vgtm_qp as vq


def capsule(*, radius: float, length: float) -> list[dict]:
    """Return the pieces in the capsule's frame, its axis along z; `length` is that of the axis, m."""
    if radius <= 0.0 or length <= 0.0:
        raise ValueError(f"radius {radius:g} m and length {length:g} m must be greater than 0")
    ends = {"lower end": -0.5 * length, "upper end": 0.5 * length}
    return [
        {"name": "side", "shape": "cylinder", "radius": radius, "height": length},
        *(
            {"name": name, "shape": "sphere", "radius": radius, "center": [0, 0, z]}
            for name, z in ends.items()
        ),
    ]


vq.register("obstacle", "capsule", capsule)
beam = {"shape": "capsule", "name": "beam", "center": [1.1, 0.0, 2.1], "rotation_vector": [1.4, 0.0, 0.0]}
problem = vq.load_problem("five_bay_two_cubes").replace(
    {"obstacle": [{**beam, "radius": 0.3, "length": 1.2}], "maneuver.steps": 25}
)
maneuver = vq.solve(problem)
print(", ".join(obstacle.name for obstacle in problem.obstacle))
clearance = maneuver.certificate.clearance_between
print(f"{maneuver.status}; {clearance.value:.3f} m, {clearance.where}; {maneuver.certificate.ok}")
