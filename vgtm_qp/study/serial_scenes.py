"""Random serial arms among obstacles: snakes and chains of joints of any kind, with a goal or any goal at all."""

from __future__ import annotations

from typing import Any

import numpy as np

from vgtm_qp.arm.build import make_arm
from vgtm_qp.arm.serial.arm import SerialArm
from vgtm_qp.arrays import Array
from vgtm_qp.errors import ProblemError
from vgtm_qp.geometry import shapes
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.problem import Problem
from vgtm_qp.problem.snake import snake
from vgtm_qp.rotation import rotation_from_vector, vector_from_rotation
from vgtm_qp.step.build import build_arm

SAFE, _ROOM = 0.04, 0.02
_SHARES, _TRIES = 20, 60
_TRACKED = (["position"], ["position", "pointing"], ["position", "orientation"])


def random_serial_scene(seed: int, number: int, *, steps: int = 30) -> Problem:
    """Return scene `number` of a `seed`: always the same, whatever scenes were made before it.

    Three goals of four are the tip's pose in a configuration that keeps limits and clearances. It need not be
    reachable along the straight path.
    """
    random = np.random.default_rng([seed, number, 3])
    while True:
        try:
            return _scene(random, f"serial scene {seed}-{number}", steps)
        except ProblemError:
            # For example, the tip cannot leave its home pose in every direction.
            continue


def _scene(random: np.random.Generator, name: str, steps: int) -> Problem:
    is_snake = bool(random.random() < 0.35)
    table = _snake(random) if is_snake else _chain(random)
    many = len(table["joint"]) >= 7
    track = _TRACKED[int(random.choice(3, p=[0.5, 0.3, 0.2] if many else [0.8, 0.2, 0.0]))]
    waypoint: dict[str, Any] = {"time": 10.0, "position": [0.0, 0.0, 1.0]}
    data: dict[str, Any] = {
        "name": name,
        "arm": table,
        "curve": {"family": "bezier", "control_vertices": int(random.integers(4, 8))},
        "end_effector": {"track": track},
        "maneuver": {"steps": steps, "waypoint": [waypoint]},
        "clearance": {"safe": SAFE, "influence": 0.4},
    }
    arm = make_arm(Problem.from_dict({**data, "end_effector": {"track": ["position"]}}))
    assert isinstance(arm, SerialArm)
    home, shape = arm.home_configuration, _shape(arm, random)
    reachable = bool(random.random() < 0.75)
    kinematics = arm.kinematics(compiled=False)
    kinematics.evaluate(shape)
    position, rotation = arm.end_effector.position(placed(arm, shape)), kinematics.tip_rotation
    if not reachable:
        away = random.normal(size=3)
        position = position + away * (0.3 * arm.height * random.random() / np.linalg.norm(away))
    waypoint["position"] = position.tolist()
    if "pointing" in track:
        waypoint["pointing"] = rotation[:, 2].tolist()
    if "orientation" in track:
        waypoint["rotation_vector"] = vector_from_rotation(rotation).tolist()
    states = [home, shape] if reachable else [home]
    data["obstacle"] = _cubes(arm, random, states, int(random.integers(1, 9)))
    problem = Problem.from_dict(data)
    build_arm(problem, solves=False)
    return problem


def _snake(random: np.random.Generator) -> dict[str, Any]:
    return snake(
        int(random.integers(4, 16)),
        length=float(random.uniform(1.5, 4.0)),
        radius=float(random.uniform(0.02, 0.05)),
        bend=float(random.uniform(0.4, 1.5)),
        limit=float(random.uniform(0.7, 1.6)),
        rate=float(random.uniform(0.2, 1.0)),
    )


def _chain(random: np.random.Generator) -> dict[str, Any]:
    joints = [_joint(random, k) for k in range(int(random.integers(4, 11)))]
    end = [*(0.1 * random.normal(size=2)).tolist(), float(random.uniform(0.1, 0.4))]
    table: dict[str, Any] = {"joint": joints, "tip": end, "link_radius": float(random.uniform(0.02, 0.05))}
    if random.random() < 0.4:
        places = [*(joint["position"] for joint in joints[1:]), end]
        table["body"] = [
            {
                "name": f"body {k + 1}",
                "joint": joint["name"],
                "points": [(0.03 * random.normal(size=3)).tolist(), place] if any(place) else [place],
                "radius": float(random.uniform(0.02, 0.06)),
            }
            for k, (joint, place) in enumerate(zip(joints, places, strict=True))
        ]
        if random.random() < 0.5:
            for body in table["body"]:
                body["points"] = _hull(random, np.array([body["points"][0], body["points"][-1]]))
                body["radius"] *= float(random.random() < 0.3)
    if random.random() < 0.3:
        table["tip_rotation_vector"] = (0.5 * random.normal(size=3)).tolist()
    if random.random() < 0.2:
        table["every"] = int(random.integers(1, len(joints)))
    return table


def _hull(random: np.random.Generator, ends: Array) -> list[list[float]]:
    """Return points of a hull about the axis between two `ends` (2, 3), m: some at each end, at random aside."""
    count = int(random.integers(2, 7))
    points = np.repeat(ends, count, axis=0) + 0.04 * random.normal(size=(2 * count, 3))
    return [[float(x) for x in point] for point in points]


def _joint(random: np.random.Generator, number: int) -> dict[str, Any]:
    """Return a joint: mostly revolute and about an axis of its frame, some at the place of the one before."""
    axis = np.eye(3)[int(random.integers(3))] if random.random() < 0.7 else random.normal(size=3)
    joint: dict[str, Any] = {"name": f"joint {number + 1}", "axis": axis.tolist()}
    if number and random.random() < 0.75:
        aside = 0.05 * random.normal(size=2) * (random.random() < 0.4)
        joint["position"] = [*aside.tolist(), float(random.uniform(0.15, 0.6))]
    else:
        joint["position"] = [0.0, 0.0, 0.0]
    if random.random() < 0.2:
        joint["rotation_vector"] = (0.4 * random.normal(size=3)).tolist()
    if random.random() < 0.12:
        return {**joint, "kind": "prismatic", "limits": [-0.1, 0.4], "home": 0.05, "rate": 0.2}
    joint["home"] = float(random.uniform(-0.6, 0.6))
    if random.random() < 0.85:
        limit = float(random.uniform(0.8, 2.8))
        joint["limits"] = [-limit, limit]
    if random.random() < 0.5:
        joint["rate"] = float(random.uniform(0.2, 1.5))
    return joint


def placed(arm: SerialArm, q: Array) -> Array:
    """Return the nodes, always to the same digits: compiled functions differ in the last ones."""
    return np.asarray(arm.chain.at(q)[0])


def _shape(arm: SerialArm, random: np.random.Generator) -> Array:
    """Return the furthest configuration in a random direction from home whose bodies keep apart."""
    home, actuators = arm.home_configuration, arm.actuators
    low, high = np.maximum(arm.stroke[actuators], -3.0), np.minimum(arm.stroke[actuators], 3.0)
    now = arm.home_quantities[actuators]
    wanted = np.clip(now + random.normal(scale=0.5, size=len(now)), low[:, 0], high[:, 1])
    own = Clearance(arm.bodies, safe=SAFE, influence=0.4, by_fcl=False)
    good = home
    for share in np.arange(1, _SHARES + 1) / _SHARES:
        q = home.copy()
        q[actuators] = now + share * (wanted - now)
        if own.least(placed(arm, q))[0] < SAFE:
            break
        good = q
    return good


def _cubes(
    arm: SerialArm, random: np.random.Generator, states: list[Array], count: int
) -> list[dict[str, Any]]:
    """Return `count` cubes, or as many as find a place, near the arm and clear of it in all `states`."""
    points = [placed(arm, q) for q in states]
    found: list[dict[str, Any]] = []
    for _ in range(_TRIES):
        if len(found) == count:
            break
        at = points[int(random.integers(len(points)))]
        near = at[arm.bodies.points[int(random.integers(len(arm.bodies)))]].mean(axis=0)
        edge = arm.height * float(random.uniform(0.05, 0.25))
        way = random.normal(size=3)
        center = near + way * ((edge + arm.height * random.uniform(0.02, 0.2)) / np.linalg.norm(way))
        vector = random.normal(size=3) * (random.random() < 0.5)
        cube = shapes.box("cube", center, edge, rotation_from_vector(vector))
        monitor = Clearance(arm.bodies, [cube], safe=SAFE, influence=0.4, self_collision=False, by_fcl=False)
        if min(monitor.least(place)[0] for place in points) >= SAFE + _ROOM:
            pose = {"center": center.tolist(), "rotation_vector": vector.tolist()}
            found.append({"name": f"cube {len(found) + 1}", "shape": "box", "size": edge, **pose})
    return found
