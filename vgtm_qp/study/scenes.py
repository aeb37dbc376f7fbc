"""Random scenes from a seed: an arm, cubes, and a tip goal of a clear shape of the same arm, or any goal at all."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.arrays import Array
from vgtm_qp.geometry import shapes
from vgtm_qp.geometry.bodies import capsules
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.problem import Problem
from vgtm_qp.rotation import rotation_from_vector
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.setup import Setup
from vgtm_qp.study.arms import bring_lengths, least_singular_value

MODULES = ("octahedral", "double-octahedral", "hexapod", "longeron", "tetrahedral")
SAFE = 0.08
_ROOM = 0.02
_SHARES = 20
_LEAST_SINGULAR_VALUE = 0.1


class RandomScene(NamedTuple):
    """A random problem; if `reachable`, its goal is the tip pose of a `shape` (N, 3), m.

    The shape keeps limits and clearances. It need not be reachable along the straight path.
    """

    reachable: bool
    problem: Problem
    shape: Array | None


def random_scene(seed: int, number: int, *, steps: int = 30) -> RandomScene:
    """Return scene `number` of a `seed`: the same but for last digits, whatever scenes were made before it."""
    random = np.random.default_rng([seed, number])
    truss = _truss(random)
    directed = bool(random.random() < 0.4)
    reachable = bool(random.random() < 0.75)
    waypoint: dict[str, Any] = {"time": 10.0, "position": [0, 0, 1]}
    if directed:
        waypoint["pointing"] = [0, 0, 1]
    problem: dict[str, Any] = {
        "name": f"scene {seed}-{number}",
        "truss": truss,
        "curve": {"family": "bezier", "control_vertices": min(8, truss["bays"] + 1)},
        "end_effector": {"track": ["position", "pointing"] if directed else ["position"]},
        "maneuver": {"steps": steps, "waypoint": [waypoint]},
        "clearance": {"safe": SAFE, "influence": 0.5},
    }
    # Compiled while scenes are drawn, its kernels would change their last digits.
    setup = build_arm(Problem.from_dict(problem), solves=False)
    shape = random_shape(setup, random)
    setup.kinematics.evaluate(shape if reachable else setup.arm.home)
    position, pointing = setup.arm.end_effector.position(shape), setup.kinematics.tip_rotation[:, 2]
    if not reachable:
        aim = random.normal(size=3)
        aim[2] = abs(aim[2])
        reach = setup.arm.height * random.uniform(0.3, 1.2)
        position = aim * (reach / np.linalg.norm(aim))
    waypoint["position"] = position.tolist()
    if directed:
        waypoint["pointing"] = (pointing if reachable else pointing + 0.5 * random.normal(size=3)).tolist()
    problem["obstacle"] = _cubes(setup, random, shape if reachable else None, int(random.integers(1, 9)))
    return RandomScene(reachable, Problem.from_dict(problem), shape if reachable else None)


def _truss(random: np.random.Generator) -> dict[str, Any]:
    truss: dict[str, Any] = {
        "module": str(random.choice(MODULES)),
        "bays": int(random.integers(5, 13)),
        "member_radius": 0.03,
    }
    if random.random() < 0.3:
        truss["rate"] = float(random.uniform(0.1, 0.5))
    if random.random() < 0.15:
        truss["joint_offset"] = float(random.uniform(0.02, 0.08))
    return truss


def random_shape(setup: Setup, random: np.random.Generator) -> Array:
    """Return node positions (N, 3) of a bent shape within the strokes whose members keep their clearance, m.

    Actuator lengths vary smoothly along and around the arm; they are approached from home by Newton's method, and
    the result is the furthest shape that is neither nearly singular nor in self-collision.
    """
    truss, kinematics = truss_of(setup.arm), setup.kinematics
    actuators = truss.actuators
    least, most = 0.15 * truss.height, random.uniform(0.3, 0.9) * truss.height
    furthest = truss.home
    kinematics.evaluate(truss.home)
    singular = _LEAST_SINGULAR_VALUE * least_singular_value(setup)
    for _ in range(20):
        X = truss.home.copy()
        wanted = _random_lengths(setup, random)
        good = X.copy()
        for share in np.arange(1, _SHARES + 1) / _SHARES:
            goal = setup.arm.home_quantities.copy()
            goal[actuators] += share * (wanted - goal[actuators])
            if not bring_lengths(setup, X, goal, tries=8, singular=singular):
                break
            if setup.monitor.least(setup.arm.points(X), among="members")[0] < SAFE:
                break
            good = X.copy()
            if _tip_motion(setup, good) > most:
                break
        if _tip_motion(setup, good) > _tip_motion(setup, furthest):
            furthest = good
        if _tip_motion(setup, furthest) >= least:
            break
    kinematics.evaluate(furthest)
    return np.asarray(furthest)


def _tip_motion(setup: Setup, X: Array) -> float:
    tip = setup.arm.end_effector
    return float(np.linalg.norm(tip.position(X) - tip.position(setup.arm.home)))


def _random_lengths(setup: Setup, random: np.random.Generator) -> Array:
    """Return (n_a,) lengths that change smoothly along and around the arm, m."""
    truss = truss_of(setup.arm)
    actuators = truss.actuators
    middle = truss.home[truss.members[actuators]].mean(axis=1)
    z = middle[:, 2] / truss.height
    angle = np.arctan2(middle[:, 1], middle[:, 0])
    turn = random.uniform(0.0, 2.0 * np.pi, 3)
    wave = random.normal(0.0, 0.3) + random.normal(0.0, 0.2, len(actuators))
    for k in range(3):
        wave = wave + random.normal() * np.cos(np.pi * k * z) * np.cos(angle - turn[k])
    wave *= random.uniform(0.3, 0.95) / max(float(np.abs(wave).max()), 1e-9)
    home = setup.arm.home_quantities[actuators]
    room = np.where(wave > 0.0, truss.stroke[actuators, 1] - home, home - truss.stroke[actuators, 0])
    return np.asarray(home + wave * room)


def _cubes(
    setup: Setup, random: np.random.Generator, shape: Array | None, count: int
) -> list[dict[str, Any]]:
    """Return `count` cubes, or as many as find a place, near the arm and clear of its home and goal shapes.

    The straight path of the tip to a goal that can be reached is kept free of them, for the tip's face at least.
    """
    truss = truss_of(setup.arm)
    states = [truss.home] if shape is None else [truss.home, shape]
    tips = np.stack([state[truss.tip] for state in states])
    share = np.linspace(0.0, 1.0, 21)[:, None, None]
    passage = (tips[0] + share * (tips[-1] - tips[0])).reshape(-1, 3)
    cubes: list[dict[str, Any]] = []
    for _ in range(60):
        if len(cubes) == count:
            break
        state = states[int(random.integers(len(states)))]
        anchor = state[int(random.choice(truss.free))]
        offset = random.normal(size=3)
        edge = float(random.uniform(0.3, 1.1))
        center = anchor + offset * (random.uniform(0.1, 1.2) + edge / 2) / np.linalg.norm(offset)
        vector = random.normal(size=3) * (random.random() < 0.5)
        cube = shapes.box("", center.tolist(), edge, rotation_from_vector(vector))
        if not all(is_clear(truss, cube, X) for X in states):
            continue
        local = np.abs((passage - center) @ rotation_from_vector(vector)) - edge / 2
        if float(np.linalg.norm(np.maximum(local, 0.0), axis=1).min()) < SAFE + 0.1:
            continue
        pose = {"center": center.tolist(), "rotation_vector": vector.tolist()}
        cubes.append({"name": f"cube {len(cubes) + 1}", "shape": "box", "size": edge, **pose})
    return cubes


def is_clear(truss: Truss, obstacle: shapes.Obstacle, X: Array) -> bool:
    """Whether members between nodes at `X` (N, 3) keep the safe distance from an obstacle, and some more."""
    members = capsules(truss.members, truss.radius)
    monitor = Clearance(members, [obstacle], safe=SAFE, influence=0.5, self_collision=False, by_fcl=False)
    return monitor.least(X)[0] >= SAFE + _ROOM
