"""Random serial arms among obstacles, and the least distance that sampling finds, which shares nothing with a proof."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import numpy as np
from geometry_reference import POINT
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import vgtm_qp as vq
from vgtm_qp.arm.arm import Arm
from vgtm_qp.arm.build import make_arm

Array = NDArray[np.float64]
SAFE = 0.02
RADIUS = 0.03


def serial_problem(
    rng: np.random.Generator, joints: int = 7, obstacles: int = 10, *, slides: bool = False, **tables: Any
) -> vq.Problem:
    """An arm of joints about random axes, some of them two in one place, among obstacles of all kinds."""
    listed = []
    for j in range(joints):
        slide = slides and rng.random() < 0.3
        listed.append(
            {
                "name": f"j{j + 1}",
                "kind": "prismatic" if slide else "revolute",
                "axis": rng.normal(size=3).tolist(),
                "position": [0.0, 0.0, 0.0]
                if j and rng.random() < 0.2
                else (rng.normal(size=3) * 0.05 + [0, 0, 0.3]).tolist(),
                "rotation_vector": (0.3 * rng.normal(size=3)).tolist(),
                "limits": [-0.3, 0.3] if slide else [-9.0, 9.0],
            }
        )
    data = {
        "schema_version": 1,
        "arm": {"joint": listed, "tip": [0.0, 0.0, 0.3], "link_radius": RADIUS},
        "maneuver": {"waypoint": [{"time": 1.0, "position": [0.1, 0.1, 1.0]}]},
        "obstacle": [obstacle(rng, k) for k in range(obstacles)],
        "clearance": {"safe": SAFE, "self_collision": False, "influence": 0.6},
    }
    return vq.Problem.from_dict(data | tables)


def obstacle(rng: np.random.Generator, k: int) -> dict[str, Any]:
    away = rng.normal(size=3)
    center = away / np.linalg.norm(away) * rng.uniform(0.4, 1.8) + [0.0, 0.0, 0.8]
    table = {"name": f"o{k}", "center": center.tolist()}
    if rng.random() < 0.5:
        table["velocity"] = (0.05 * rng.normal(size=3)).tolist()
    turn = {"rotation_vector": rng.normal(size=3).tolist()}
    match k % 3:
        case 0:
            return {**table, **turn, "shape": "box", "size": rng.uniform(0.1, 0.4, 3).tolist()}
        case 1:
            return {**table, "shape": "sphere", "radius": float(rng.uniform(0.05, 0.2))}
    sizes = {"radius": float(rng.uniform(0.05, 0.2)), "height": float(rng.uniform(0.1, 0.5))}
    return {**table, **turn, "shape": "cylinder", **sizes}


def random_rows(rng: np.random.Generator, problem: vq.Problem, rows: int, step: float) -> tuple[Array, Array]:
    """Times and joint values of a random walk."""
    assert problem.arm is not None
    walk = np.cumsum(step * rng.normal(size=(rows, len(problem.arm.joint))), axis=0)
    slides = [joint.kind == "prismatic" for joint in problem.arm.joint]
    walk[:, slides] = np.clip(0.2 * walk[:, slides], -0.3, 0.3)
    return np.cumsum(rng.uniform(0.5, 1.5, size=rows)), walk


@cache
def _arm(table: str) -> Arm:
    waypoint = {"waypoint": [{"time": 1.0, "position": [0.1, 0.1, 1.0]}]}
    return make_arm(vq.Problem.from_dict({"arm": json.loads(table), "maneuver": waypoint}))


def axes_at(problem: vq.Problem, joints: Array) -> Array:
    """(T, B, 2, 3) the ends of the links' axes, by the code that moves the arm."""
    arm = _arm(json.dumps(problem.to_dict()["arm"]))
    nodes = np.array([arm.nodes(np.concatenate([q, np.zeros(6)])) for q in joints])
    return nodes[:, arm.bodies.points]


def sampled_clearance(problem: vq.Problem, times: Array, joints: Array, samples: int) -> float:
    """Least distance from an obstacle of points on the links' axes at many instants, less the radius: never too low."""
    shares = np.linspace(0.0, 1.0, samples)
    at = np.concatenate([times[:-1, None] + shares * np.diff(times)[:, None]]).reshape(-1)
    values = np.stack([np.interp(at, times, column) for column in joints.T], axis=1)
    ends = axes_at(problem, values)
    along = np.linspace(0.0, 1.0, 33)[:, None]
    points = ends[:, :, None, 0] + along * (ends[:, :, None, 1] - ends[:, :, None, 0])
    least = np.inf
    for entry in problem.to_dict()["obstacle"]:
        center = np.array(entry["center"]) + np.outer(at, entry.get("velocity", np.zeros(3)))
        turn = Rotation.from_rotvec(entry.get("rotation_vector", np.zeros(3))).as_matrix()
        match entry["shape"]:
            case "box":
                sizes = np.array(entry["size"]) / 2
            case "sphere":
                sizes = np.array([entry["radius"]])
            case _:
                sizes = np.array([entry["radius"], entry["height"] / 2])
        middle = [] if entry["shape"] == "sphere" else turn.reshape(-1)
        piece = np.concatenate([np.zeros(3), middle, sizes])
        if entry["shape"] == "sphere":
            piece = np.concatenate([np.zeros(12), sizes])
        local = points - center[:, None, None]
        least = min(least, max(float(POINT[entry["shape"]](local, piece).min()), 0.0) - RADIUS)
    return least


def planted(
    rng: np.random.Generator, problem: vq.Problem, depth: float
) -> tuple[vq.Problem, Array, Array] | None:
    """A ball that the arm comes nearer to than `SAFE` by `depth`, m, in the middle of a segment and at no row."""
    times, joints = random_rows(rng, problem, int(rng.integers(2, 6)), float(rng.choice([0.05, 0.2])))
    k, share, h = int(rng.integers(len(times) - 1)), rng.uniform(0.2, 0.8), 1e-3
    way = joints[k] + (share + h * np.array([[-1.0], [0.0], [1.0]])) * (joints[k + 1] - joints[k])
    ends = axes_at(problem, way)
    link, at = int(rng.integers(ends.shape[1])), rng.uniform()
    path = ends[:, link, 0] + at * (ends[:, link, 1] - ends[:, link, 0])
    axis = ends[1, link, 1] - ends[1, link, 0]
    outward = -(path[0] - 2.0 * path[1] + path[2])
    outward -= axis * (axis @ outward) / (axis @ axis)
    if np.linalg.norm(outward) < 1e-12:
        return None
    radius = float(rng.choice([0.005, 0.1]))
    center = path[1] + outward / np.linalg.norm(outward) * (RADIUS + radius + SAFE - depth)
    ball = {"name": "ball", "shape": "sphere", "center": center.tolist(), "radius": radius}
    changed = problem.replace({"obstacle": [ball]})
    ends = axes_at(changed, joints)
    points = ends[:, :, None, 0] + np.linspace(0, 1, 201)[:, None] * (
        ends[:, :, None, 1] - ends[:, :, None, 0]
    )
    clear = np.linalg.norm(points - center, axis=-1).min() - radius - RADIUS
    return (changed, times, joints) if clear > SAFE + 1e-5 else None
