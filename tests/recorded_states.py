"""Records the states that maneuvers and control loops pass, and compares them with those on record.

What a change of the package's inside must not change: every state of these cases, to 1e-9 m on any machine, and how
each of them ends. Only names that a user has are used here.

    python tests/recorded_states.py write [--to FILE] [CASE ...]     runs the cases and records them
    python tests/recorded_states.py compare [--with FILE] [CASE ...] runs them and says what differs
    python tests/recorded_states.py between FILE FILE [CASE ...]     compares two records, running nothing
    python tests/recorded_states.py list                             names the cases and their tolerances

``compare`` and ``between`` end with 1 where anything differs by more than the tolerance of its case. A case is
chosen such that rounding does not grow in it: recorded with and without a C compiler and with other BLAS kernels, its
states are the same to less than its tolerance.
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import vgtm_qp as vq

Array = NDArray[np.float64]
Arrays = dict[str, Array]

RECORD = Path(__file__).parent / "data" / "recorded_states.npz"
WEDGE = RECORD.with_name("wedge.obj")
SERIAL = RECORD.with_name("serial_scenes.json")
"""Problems of serial arms, drawn once by ``vgtm_qp.study.serial_scenes`` from seed 77 and rounded."""
PROBLEMS = Path(__file__).parent.parent / "problems"

TOLERANCE = 1e-9
"""How far states may be from those on record, m (and rad, s)."""

ITERATIVE = 1e-6
"""The same where the QP is solved by iterations that end at a tolerance."""

WHERE_ROUNDING_GROWS = {
    "bundled actuator_jams": 1e-8,
    "bundled longeron_past_a_cube": 1e-7,
    "bundled station_arm_past_a_module": 1e-5,
    "loop longeron 5, accelerations, no curve": 1e-6,
    "snake_past_a_cube, elastic tip, no curve": 1e-8,
}
"""The same of cases in which a difference of 1e-12 m at one state becomes this much at a later one, at most.

An elastic tip's great penalty costs DAQP some digits at once.
"""

MEASURED = 1e-6
"""How far the certificate's values may be, relative where they are greater than 1: some are bounds to 1e-6 m."""

KEPT = 16
"""States of a maneuver that are recorded, the first and the last among them; of a loop twice as many."""

BY_CLOSED_FORMS = (
    "octahedral 4, far goal, jams",
    "bundled five_bay_blocked_by_wall",
    "octahedral 5",
    "double-octahedral 4",
    "longeron 5, hard tip",
    "octahedral 6, pointing",
    "octahedral 6, jams",
    "hexapod 5, jams",
    "hexapod 5, no curve",
    "longeron 4, far goal, hard tip",
    "loop octahedral 5",
    "loop hexapod 4, vertex goals",
    "loop octahedral 6, locks",
)
"""Cases with no rows by FCL: its iterations at the rim of a cylinder end at some 1e-5 of the normal, wherever rounding
leads them, and which of two members that touch in one node is named first is rounding too."""

BY_ELASTIC_TRACKING = (
    "bundled five_bay_blocked_by_wall",
    "bundled longeron_past_a_cube",
    "loop octahedral 6, locks",
    "loop octahedral 6, pointing",
    "octahedral 4, far goal",
    "octahedral 4, far goal, jams",
    "octahedral 4, osqp",
    "octahedral 4, piqp",
    "octahedral 5, elastic tip",
    "octahedral 6, jams",
    "octahedral 6, pointing",
    "tetrahedral 5, two actuated",
    "octahedral 6, moving obstacle",
    "loop octahedral 5",
)
"""Cases of elastic tracking: on the curve exactly rounding grows in them, or limits tie for the first place."""

HEIGHT = {
    "octahedral": 0.8165,
    "double-octahedral": 1.6330,
    "hexapod": 0.8165,
    "longeron": 1.0,
    "tetrahedral": 0.9487,
}
"""Of a bay at home, m."""


@dataclass(frozen=True)
class Case:
    """A problem, and what is done with it.

    Attributes
    ----------
    name : str
    problem : dict
        In the form of a problem file; or its changes by key path where `file` names a bundled one.
    file : str
        Name of a bundled problem, or empty.
    loop : dict
        How a resolver is driven; empty where the problem is solved as a maneuver.
    tolerance : float
        How far its states may be from those on record, m.
    """

    name: str
    problem: dict[str, Any]
    file: str = ""
    loop: dict[str, Any] = field(default_factory=dict)
    tolerance: float = TOLERANCE

    def load(self) -> vq.Problem:
        """Return the problem."""
        changes = {"clearance.distance": "exact"} if self.name in BY_CLOSED_FORMS else {}
        if self.name in BY_ELASTIC_TRACKING:
            changes["method.tracking_mode"] = "elastic"
        if self.file:
            return vq.load_problem(PROBLEMS / f"{self.file}.toml").replace(self.problem | changes)
        return vq.Problem.from_dict(self.problem).replace(changes)


@dataclass(frozen=True)
class Recording:
    """What a case came to: arrays of its states, and plain data that says how it went."""

    arrays: Arrays
    facts: dict[str, Any]


# ---------------------------------------------------------------------------------------------- the cases


def _bundled() -> Iterator[Case]:
    steps = {
        "five_bay_blocked_by_wall": {"maneuver.steps": 40, "method.retries": False},
        "five_bay_free": {"maneuver.steps": 25},
        "hexapod_past_a_cube": {"maneuver.steps": 20},
        "tetrahedral_truss_circle": {},
        "snake_past_a_cube": {"maneuver.steps": 25},
        "station_arm_past_a_module": {"maneuver.steps": 30},
    }
    for path in sorted(PROBLEMS.glob("*.toml")):
        yield Case(f"bundled {path.stem}", steps.get(path.stem, {}), file=path.stem)


def _scene(
    seed: int,
    module: str,
    bays: int,
    steps: int = 12,
    *,
    reach: float = 0.4,
    level: float = 0.7,
    near: float = 0.66,
    **changes: Any,
) -> dict[str, Any]:
    """Return a problem of one arm that goes past an obstacle or two, from a seed; `changes` by key path.

    The first obstacle stands in the way of the body, the second beside or behind it. `reach` and `level` say how far
    the goal is to the side and up, in heights of the arm; `near`, m, how near the obstacles are to its axis besides
    their own size. Keys of `changes` have ``__`` for the dots.
    """
    random = np.random.default_rng([2024, seed])
    height = HEIGHT[module] * bays
    heading = float(random.uniform(-np.pi, np.pi))
    aside, across = (
        np.array([np.cos(heading + turn), np.sin(heading + turn), 0.0]) for turn in (0.0, np.pi / 2)
    )
    goal = (reach * aside + (level + float(random.uniform(-0.03, 0.03))) * np.array([0.0, 0.0, 1.0])) * height
    obstacles = []
    for k in range(int(random.integers(1, 3))):
        size = float(random.uniform(0.12, 0.17)) * min(height, 5.0)
        up = float(random.uniform(0.42, 0.55)) * height
        side = aside if k == 0 else float(random.choice([-1.0, 1.0])) * across
        away = near + 0.75 * size + float(random.uniform(0.0, 0.08))
        shape = str(random.choice(["box", "box", "sphere", "cylinder"]))
        edges: dict[str, Any] = {
            "box": {"size": [size, size, 1.2 * size], "rotation_vector": random.normal(0.0, 0.4, 3).tolist()},
            "sphere": {"radius": 0.6 * size},
            "cylinder": {"radius": 0.5 * size, "height": 1.2 * size},
        }[shape]
        place = away * side + np.array([0.0, 0.0, up])
        obstacles.append({"name": f"{shape} {k + 1}", "shape": shape, "center": place.tolist(), **edges})
    problem: dict[str, Any] = {
        "schema_version": 1,
        "name": f"scene {seed}: {module} {bays}",
        "truss": {
            "module": module,
            "bays": bays,
            "stroke": [0.6, 1.5],
            "rate": float(random.choice([0.15, 0.5])),
        },
        "curve": {"family": "bezier", "control_vertices": min(6, bays + 1)},
        "end_effector": {"track": ["position"]},
        "maneuver": {"steps": steps, "waypoint": [{"time": 8.0, "position": goal.tolist()}]},
        "obstacle": obstacles,
        "clearance": {"safe": 0.05, "influence": 0.4},
        "method": {"retries": False},
    }
    for key, value in changes.items():
        _put(problem, key.split("__"), value)
    return problem


def _put(table: dict[str, Any], key: Sequence[str], value: Any) -> None:
    for part in key[:-1]:
        table = table.setdefault(part, {})
    table[key[-1]] = value


def _free(seed: int, module: str, bays: int, steps: int = 10, **changes: Any) -> dict[str, Any]:
    """Return a problem without obstacles or limits that are met: for the methods that know none of them."""
    wide: dict[str, Any] = {"truss__stroke": [0.2, 3.0], "clearance__self_collision": False, "obstacle": []}
    wide["truss__rate"] = 5.0
    return _scene(seed, module, bays, steps, reach=0.15, level=0.9, **{**wide, **changes})


def _with_wedge(problem: dict[str, Any]) -> dict[str, Any]:
    """Return a problem with a wedge from a file in the place of its first obstacle."""
    first = problem["obstacle"][0]
    mesh = {"name": "wedge", "shape": "mesh", "center": first["center"], "file": str(WEDGE), "scale": 0.5}
    problem["obstacle"][0] = mesh
    return problem


def _turned(problem: dict[str, Any], track: Sequence[str], **goal: Sequence[float]) -> dict[str, Any]:
    """Return a problem whose end effector also has a direction to keep or an attitude to turn to."""
    problem["end_effector"]["track"] = list(track)
    for waypoint in problem["maneuver"]["waypoint"]:
        waypoint.update({key: list(value) for key, value in goal.items()})
    return problem


def _mast(seed: int, layers: int = 4, **changes: Any) -> dict[str, Any]:
    """Return a problem of a graph: uneven triangles joined by fixed zigzags, with actuated rings."""
    random = np.random.default_rng([2025, seed])
    nodes, members, faces = [], [], []
    for level in range(layers + 1):
        names = [f"n{level}{c}" for c in "abc"]
        faces.append(names)
        for k, name in enumerate(names):
            angle = 2.0 * np.pi * k / 3.0 + np.pi / 3.0 * level
            point = np.array([0.6 * np.cos(angle), 0.6 * np.sin(angle), 0.8 * level])
            point += random.uniform(-0.05, 0.05, 3)
            nodes.append({"name": name, "position": point.tolist(), "fixed": level == 0})
        if level:
            below = faces[level - 1]
            for k, name in enumerate(names):
                members.append({"name": f"ring {name}", "nodes": [name, names[k - 2]], "actuated": True})
                for other in (below[k], below[(k + 1) % 3]):
                    members.append({"name": f"{other}-{name}", "nodes": [other, name]})
    height = 0.8 * layers
    heading = float(random.uniform(-np.pi, np.pi))
    goal = np.array([0.3 * np.cos(heading), 0.3 * np.sin(heading), 0.85]) * height
    ball = np.array([1.15 * np.cos(heading), 1.15 * np.sin(heading), 0.5 * height])
    problem: dict[str, Any] = {
        "schema_version": 1,
        "name": f"mast {seed}",
        "truss": {
            "module": "graph",
            "tip": faces[-1],
            "faces": faces,
            "stroke": [0.5, 1.7],
            "rate": 0.4,
            "node": nodes,
            "member": members,
        },
        "curve": {"control_vertices": 5},
        "maneuver": {"steps": 12, "waypoint": [{"time": 6.0, "position": goal.tolist()}]},
        "obstacle": [{"name": "ball", "shape": "sphere", "center": ball.tolist(), "radius": 0.3}],
        "clearance": {"safe": 0.04, "influence": 0.4},
        "method": {"retries": False},
    }
    for key, value in changes.items():
        _put(problem, key.split("__"), value)
    return problem


def _platform() -> dict[str, Any]:
    """Return a problem of a platform on six legs that lifts, slides and tilts."""

    def triangle(radius: float, height: float, turned: float) -> list[list[float]]:
        angles = turned + 2.0 * np.pi * np.arange(3) / 3.0
        return [[radius * float(np.cos(a)), radius * float(np.sin(a)), height] for a in angles]

    ground, platform = triangle(1.0, 0.0, 0.0), triangle(0.6, 1.2, np.pi / 3.0)
    nodes = [{"name": f"g{k}", "position": point, "fixed": True} for k, point in enumerate(ground)]
    nodes += [{"name": f"p{k}", "position": point} for k, point in enumerate(platform)]
    legs = [(k, j) for k in range(3) for j in (k, (k + 2) % 3)]
    members: list[dict[str, Any]] = [
        {"name": f"leg {k}-{j}", "nodes": [f"g{k}", f"p{j}"], "actuated": True, "stroke": [1.0, 2.2]}
        for k, j in legs
    ]
    members += [{"name": f"edge {k}", "nodes": [f"p{k}", f"p{(k + 1) % 3}"]} for k in range(3)]
    goal = {"time": 4.0, "position": [0.25, 0.1, 1.35], "rotation_vector": [0.2, -0.15, 0.3]}
    return {
        "schema_version": 1,
        "name": "platform on six legs",
        "truss": {"module": "graph", "tip": ["p0", "p1", "p2"], "node": nodes, "member": members},
        "end_effector": {"track": ["position", "orientation"]},
        "maneuver": {"steps": 12, "waypoint": [goal]},
        "clearance": {"safe": 0.01, "influence": 0.2},
        "method": {"tracking": "none"},
    }


_TRAVEL = [
    {"time": 4.0, "position": [0.1, -0.05, 0.1], "rotation_vector": [0.05, 0.05, 0.1]},
    {"time": 8.0, "position": [0.2, 0.0, 0.05], "rotation_vector": [0.0, 0.0, 0.2]},
]
_UP = (0.0, 0.0, 1.0)


def _scenes() -> Iterator[Case]:
    yield from _coupled_scenes()
    yield from _other_scenes()
    yield from _serial()
    yield from _methods()


def _coupled_scenes() -> Iterator[Case]:
    """Yield the scenes of the QP of truss and curve together, as most people use it."""
    yield Case("octahedral 5", _scene(1, "octahedral", 5))
    yield Case("octahedral 8", _scene(2, "octahedral", 8))
    yield Case("double-octahedral 4", _scene(3, "double-octahedral", 4))
    yield Case("hexapod 5", _scene(4, "hexapod", 5))
    yield Case("longeron 6", _scene(5, "longeron", 6))
    yield Case("tetrahedral 4", _scene(6, "tetrahedral", 4))
    two = {"truss__actuated": [2, 3], "curve__control_vertices": 4}
    yield Case("tetrahedral 5, two actuated", _scene(7, "tetrahedral", 5, **two), tolerance=ITERATIVE)
    yield Case("octahedral 5, hard tip", _scene(8, "octahedral", 5, end_effector__mode="hard", reach=0.1))
    yield Case("octahedral 5, elastic tip", _scene(9, "octahedral", 5, end_effector__mode="elastic"))
    yield Case("hexapod 4, elastic tip", _scene(10, "hexapod", 4, end_effector__mode="elastic"))
    yield Case("longeron 5, hard tip", _scene(11, "longeron", 5, end_effector__mode="hard", reach=0.2))
    hard = {"method__tracking_mode": "hard", "curve__control_vertices": 5}
    yield Case("hexapod 5, hard tracking", _scene(12, "hexapod", 5, **hard))
    pointed = {**hard, "method__hard_coordinates": ["position", "pointing"]}
    yield Case("hexapod 4, hard tracking of pointing", _scene(13, "hexapod", 4, **pointed))
    yield Case("tetrahedral 4, hard tracking", _scene(14, "tetrahedral", 4, **hard))
    upright = _turned(_scene(415, "octahedral", 6), ["position", "pointing"], pointing=_UP)
    yield Case("octahedral 6, pointing", upright)
    leaning = _turned(_scene(16, "longeron", 6), ["position", "pointing"], pointing=(0.3, -0.2, 1.0))
    yield Case("longeron 6, pointing", leaning)
    posed = _scene(17, "hexapod", 5, curve__torsion_vertices=2)
    yield Case(
        "hexapod 5, orientation, torsion",
        _turned(posed, ["position", "orientation"], rotation_vector=(0.2, -0.3, 0.4)),
    )
    posed = _scene(18, "tetrahedral", 4, curve__torsion_vertices=1)
    yield Case("tetrahedral 4, torsion", posed)
    yield Case("octahedral 5, one axis", _scene(19, "octahedral", 5, end_effector__track=["x", "z"]))
    yield Case("octahedral 5, offset joints", _scene(20, "octahedral", 5, truss__joint_offset=0.05))
    yield Case("hexapod 4, offset joints", _scene(21, "hexapod", 4, truss__joint_offset=0.04))
    arc = {"curve__family": "b-spline", "curve__nodes": "arc-length"}
    yield Case("octahedral 6, B-spline, arc length", _scene(22, "octahedral", 6, **arc))
    arc = {"curve__nodes": "arc-length", "curve__torsion_vertices": 1}
    yield Case("hexapod 5, arc length, torsion", _scene(23, "hexapod", 5, **arc))
    beta = {"curve__family": "beta-spline", "curve__bias": 1.1, "curve__tension": 2.0}
    yield Case("longeron 6, Beta-spline", _scene(24, "longeron", 6, **beta))
    goals = [{"index": 3, "position": [0.4, 0.3, 2.6]}]
    yield Case("octahedral 5, vertex goal", _scene(25, "octahedral", 5, curve__control_vertex_goals=goals))
    yield Case("octahedral 5, moving base", _scene(26, "octahedral", 5, truss__base_motion=_TRAVEL))
    yield Case("hexapod 4, moving base", _scene(27, "hexapod", 4, truss__base_motion=_TRAVEL))
    moving = _scene(228, "octahedral", 6)
    moving["obstacle"][0]["velocity"] = [0.02, -0.03, 0.04]
    yield Case("octahedral 6, moving obstacle", moving)
    jam = {"truss__locked": ["B4-1", {"member": "B2-1", "time": 2.5}]}
    yield Case("octahedral 6, jams", _scene(29, "octahedral", 6, **jam))
    jam = {"truss__locked": [{"member": "L2-3", "time": 3.1}, "L4-5"]}
    yield Case("hexapod 5, jams", _scene(30, "hexapod", 5, **jam))


def _other_scenes() -> Iterator[Case]:
    """Yield graphs, limited accelerations, no curve, other solvers, and long arms."""
    yield Case("mast", _mast(1))
    yield Case("mast, no curve", _mast(2, 3, method__tracking="none", truss__tip=["n3a"]))
    yield Case(
        "mast, offset joints, elastic tip", _mast(3, truss__joint_offset=0.05, end_effector__mode="elastic")
    )
    yield Case("platform", _platform())
    none = {"method__tracking": "none"}
    yield Case("octahedral 6, no curve", _scene(31, "octahedral", 6, **none))
    yield Case("hexapod 5, no curve", _scene(32, "hexapod", 5, **none))
    yield Case("tetrahedral 5, no curve", _scene(33, "tetrahedral", 5, **none))
    slow = {"truss__acceleration": 0.15, "truss__rate": 0.3}
    yield Case("octahedral 5, accelerations", _scene(34, "octahedral", 5, **slow))
    yield Case("longeron 5, accelerations, no curve", _scene(35, "longeron", 5, **slow, **none))
    elastic = {**slow, "end_effector__mode": "elastic"}
    yield Case("hexapod 4, accelerations, elastic tip", _scene(36, "hexapod", 4, **elastic))
    near = {"clearance__safe": 0.05, "clearance__minimum_angle": 0.35, "clearance__self_safe": 0.03}
    yield Case("octahedral 5, least angle", _scene(37, "octahedral", 5, **near))
    quick = {"method__slow_approach": False}
    yield Case("octahedral 7, no slow approach", _scene(38, "octahedral", 7, **quick))
    yield Case("octahedral 5, too near at home", _scene(38, "octahedral", 5, near=0.6))
    yield Case("octahedral 5, mesh", _with_wedge(_scene(46, "octahedral", 5)))
    again = {"method__retries": True, "method__tracking": "none"}
    yield Case("octahedral 5, ways out", _scene(103, "octahedral", 5, 5, reach=0.55, level=0.65, **again))
    yield Case("octahedral 4, far goal", _scene(71, "octahedral", 4, reach=0.66))
    yield Case(
        "longeron 4, far goal, hard tip", _scene(72, "longeron", 4, reach=0.7, end_effector__mode="hard")
    )
    yield Case("hexapod 4, far goal", _scene(73, "hexapod", 4, reach=0.9, level=0.6))
    far = _scene(74, "octahedral", 5, reach=0.65, **slow)
    yield Case("octahedral 5, far goal, accelerations", far)
    yield Case("tetrahedral 4, far goal", _scene(75, "tetrahedral", 4, reach=0.9, level=0.6))
    locked = {"truss__locked": [{"member": f"B{k}-1", "time": 3.0} for k in (1, 2, 3, 4)]}
    yield Case("octahedral 4, far goal, jams", _scene(277, "octahedral", 4, reach=0.5, **locked))
    for solver in ("osqp", "piqp"):
        for seed, module in ((240, "octahedral"), (41, "hexapod")):
            problem = _scene(seed, module, 4, 8, method__solver=solver)
            yield Case(f"{module} 4, {solver}", problem, tolerance=ITERATIVE)
    yield Case(
        "octahedral 30", _scene(42, "octahedral", 30, 6, reach=0.1, level=0.92, curve__control_vertices=8)
    )
    yield Case(
        "octahedral 60", _scene(43, "octahedral", 60, 3, reach=0.05, level=0.95, curve__control_vertices=8)
    )
    yield Case("hexapod 30", _scene(44, "hexapod", 30, 4, reach=0.08, level=0.92, curve__control_vertices=8))
    yield Case("tetrahedral 20, no curve", _scene(45, "tetrahedral", 20, 4, reach=0.1, level=0.9, **none))


def _serial() -> Iterator[Case]:
    """Yield serial arms: random ones as they were drawn, and the bundled ones with other keys."""
    for problem in json.loads(SERIAL.read_text(encoding="utf-8")):
        yield Case(problem["name"], problem)
    few = {"maneuver.steps": 12, "method.retries": False}

    def changed(name: str, file: str, changes: dict[str, Any]) -> Case:
        return Case(f"{file}, {name}", few | changes, file=file)

    snake, twelve = "snake_past_a_cube", "twelve_joints_past_a_crate"
    yield changed("hard tip", snake, {"end_effector.mode": "hard"})
    leaving = {"end_effector.mode": "elastic", "method.tracking": "none"}
    yield changed("elastic tip, no curve", snake, leaving)
    yield changed("osqp", snake, {"method.solver": "osqp"})
    yield changed("moving base", snake, {"arm.base_motion": _TRAVEL})
    yield changed("arc length", snake, {"curve.nodes": "arc-length"})
    yield changed("no curve", twelve, {"method.tracking": "none"})
    yield changed("exact distances", twelve, {"clearance.distance": "exact"})
    yield changed("elastic tracking", twelve, {"method.tracking_mode": "elastic"})
    yield changed("locks", twelve, {"arm.locked": ["yaw-3", {"joint": "pitch-7", "time": 2.5}]})
    free = {
        "obstacle": [],
        "maneuver.steps": 20,
        "maneuver.waypoint": [{"time": 5.0, "position": [1.776, -0.878, 3.202]}],
        "method": {"name": "pseudoinverse", "correct": True, "retries": False},
    }
    yield Case(f"{snake}, pseudoinverse", free, file=snake)
    for tracking in ("recursive", "parallel"):
        first = {**free["method"], "name": "curve-pseudoinverse", "tracking": tracking}
        yield Case(f"{snake}, curve-pseudoinverse, {tracking}", free | {"method": first}, file=snake)
    joints = vq.load_problem(PROBLEMS / f"{snake}.toml").to_dict()["arm"]["joint"]
    slow = [joint | {"acceleration": 0.4} for joint in joints]
    yield changed("accelerations", snake, {"arm.joint": slow})
    led = {"yaw-5": {"joint": "yaw-4"}, "pitch-8": {"joint": "pitch-7", "multiplier": 0.6, "offset": 0.02}}
    following = [joint | ({"mimic": led[joint["name"]]} if joint["name"] in led else {}) for joint in joints]
    yield changed("followers", snake, {"arm.joint": following})


def _methods() -> Iterator[Case]:
    """Yield the pseudoinverse methods, and the curve solved before the truss."""
    for tracking in ("recursive", "parallel"):
        yield Case(f"octahedral 5, {tracking}", _free(51, "octahedral", 5, method__tracking=tracking))
        yield Case(f"hexapod 4, {tracking}", _free(52, "hexapod", 4, method__tracking=tracking))
        name = {"method__name": "curve-pseudoinverse", "method__tracking": tracking}
        yield Case(f"longeron 5, curve-pseudoinverse, {tracking}", _free(53, "longeron", 5, **name))
    corrected = {
        "method__name": "curve-pseudoinverse",
        "method__tracking": "recursive",
        "method__correct": True,
    }
    yield Case("octahedral 5, curve-pseudoinverse, corrected", _free(54, "octahedral", 5, **corrected))
    plain = {"method__name": "pseudoinverse"}
    yield Case("octahedral 5, pseudoinverse", _free(55, "octahedral", 5, **plain))
    damped = {**plain, "method__variant": "damped", "method__correct": True}
    yield Case("tetrahedral 3, pseudoinverse, damped", _free(56, "tetrahedral", 3, **damped))
    banded = {**plain, "method__variant": "weighted", "method__algebra": "sparse"}
    yield Case("hexapod 4, pseudoinverse, sparse", _free(57, "hexapod", 4, **banded))


def _loops() -> Iterator[Case]:
    """Yield the control loops: goals that wander at random from a seed."""
    yield Case("loop octahedral 5", _free(62, "octahedral", 5), loop={"steps": 50, "seed": 7, "size": 0.1})
    yield Case(
        "loop hexapod 4, vertex goals",
        _scene(62, "hexapod", 4),
        loop={
            "steps": 40,
            "seed": 2,
            "size": 0.15,
            "vertex_goals": {8: (3, [0.3, -0.2, 1.7]), 26: (3, None)},
        },
    )
    yield Case(
        "loop octahedral 6, locks",
        _scene(63, "octahedral", 6),
        loop={"steps": 40, "seed": 7, "locks": {12: "B2-1", 30: "B5-3"}},
    )
    turned = _turned(_scene(64, "octahedral", 6), ["position", "pointing"], pointing=_UP)
    yield Case("loop octahedral 6, pointing", turned, loop={"steps": 40, "seed": 4, "pointing": True})
    slow = {"truss__acceleration": 1.0, "method__tracking": "none"}
    yield Case(
        "loop longeron 5, accelerations, no curve",
        _scene(65, "longeron", 5, **slow),
        loop={"steps": 40, "seed": 5, "size": 0.1},
    )
    moving = _scene(66, "tetrahedral", 4, end_effector__mode="elastic")
    moving["obstacle"][0]["velocity"] = [0.01, 0.02, 0.0]
    yield Case("loop tetrahedral 4, elastic tip", moving, loop={"steps": 30, "seed": 6, "size": 0.15})
    yield Case("loop snake", {}, file="snake_past_a_cube", loop={"steps": 40, "seed": 8, "size": 0.1})
    yield Case(
        "loop twelve joints, pointing, locks",
        {},
        file="twelve_joints_past_a_crate",
        loop={"steps": 40, "seed": 9, "locks": {14: "yaw-5", 27: "roll-10"}, "pointing": True},
    )


def _all() -> Iterator[Case]:
    for case in (*_bundled(), *_scenes(), *_loops()):
        yield replace(case, tolerance=WHERE_ROUNDING_GROWS.get(case.name, case.tolerance))


CASES: dict[str, Case] = {case.name: case for case in _all()}


# ---------------------------------------------------------------------------------------------- recording


def record(case: Case) -> Recording:
    """Run a case and return what came of it."""
    return _record_loop(case) if case.loop else _record_maneuver(case)


def _record_maneuver(case: Case) -> Recording:
    maneuver = vq.solve(case.load())
    kept = _kept(len(maneuver.time))
    names = (
        "time",
        "nodes",
        "member_lengths" if maneuver.joints is None else "joints",
        "control_vertices",
        "tip_position",
        "tip_rotation",
        "clearance",
    )
    stop = maneuver.manifest["stop"]
    facts = {
        "states": len(maneuver.time),
        "status": str(maneuver.status),
        "reached": float(maneuver.manifest["reached"]),
        "stop": str(stop["kind"]) if stop else "",
        "blocked_by": sorted(map(str, maneuver.manifest["blocked_by"])),
        "member_names": [str(name) for name in maneuver.member_names],
        "certificate": maneuver.certificate.to_dict(),
    }
    return Recording({name: np.array(getattr(maneuver, name))[kept] for name in names}, facts)


def _record_loop(case: Case) -> Recording:
    loop = case.loop
    random = np.random.default_rng([2026, loop["seed"]])
    resolver = vq.Resolver(case.load())
    start = _tip(resolver)
    aim = start.copy()
    states, progress, told = [resolver.state], [], []
    for k in range(loop["steps"]):
        if k in loop.get("vertex_goals", {}):
            resolver.set_control_vertex_goal(*loop["vertex_goals"][k])
        if k in loop.get("locks", {}):
            resolver.lock(loop["locks"][k])
        # The goal wanders, and is drawn back so that it stays within reach.
        aim = aim + loop.get("size", 0.06) * random.normal(size=3) + 0.05 * (start - aim) - [0.0, 0.0, 0.02]
        goal: dict[str, Any] = {"position": aim}
        if loop.get("pointing"):
            goal["pointing"] = [*random.uniform(-0.2, 0.2, 2).tolist(), 1.0]
        step = resolver.step(**goal, dt=float(random.choice([0.1, 0.2, 0.4])))
        states.append(step.state)
        progress.append(step.progress)
        told.append([str(step.status), *([] if str(step.status) == "reached" else sorted(step.blocked_by))])
    names = ["nodes"] if case.load().truss else ["nodes", "quantities"]
    kept = [states[k] for k in _kept(len(states), 2 * KEPT)]
    arrays = {name: np.array([getattr(state, name) for state in kept]) for name in names}
    return Recording({**arrays, "progress": np.array(progress)}, {"steps": told})


def _tip(resolver: vq.Resolver) -> Array:
    """Return where the end effector is, m."""
    return np.array(resolver.tip()[0])


def _kept(count: int, most: int = KEPT) -> NDArray[np.int64]:
    """Return the rows that are recorded of so many: some, evenly spaced, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def save(path: Path, recordings: Mapping[str, Recording]) -> None:
    """Write recordings into one file."""
    content: dict[str, Any] = {}
    for name, recording in recordings.items():
        content |= {f"{name}|{key}": array for key, array in recording.arrays.items()}
    facts = {name: recording.facts for name, recording in recordings.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, facts=np.array(json.dumps(facts, sort_keys=True)), **content)


def load(path: Path = RECORD) -> dict[str, Recording]:
    """Read the recordings of a file by the names of their cases."""
    with np.load(path, allow_pickle=False) as file:
        facts = json.loads(str(file["facts"]))
        found = {name: Recording({}, fact) for name, fact in facts.items()}
        for key in file.files:
            if key != "facts":
                name, _, array = key.rpartition("|")
                found[name].arrays[array] = file[key]
    return found


# ---------------------------------------------------------------------------------------------- comparing


def worst(recorded: Recording, found: Recording) -> tuple[float, str]:
    """Return the greatest difference of two recordings' arrays, and where it is; inf where shapes differ."""
    greatest, where = 0.0, "nothing differs"
    for name, array in recorded.arrays.items():
        other = found.arrays.get(name)
        if other is None or other.shape != array.shape:
            return (
                np.inf,
                f"{name} has shape {None if other is None else other.shape}, on record {array.shape}",
            )
        with np.errstate(invalid="ignore"):
            apart = np.where(other == array, 0.0, np.abs(other - array))
        if not apart.size:
            continue
        apart = np.where(np.isnan(apart), np.inf, apart)
        place = np.unravel_index(int(np.argmax(apart)), apart.shape)
        if apart[place] > greatest:
            greatest, where = float(apart[place]), f"{name}[{', '.join(map(str, place))}]"
    return greatest, where


def differences(case: Case, recorded: Recording, found: Recording) -> list[str]:
    """Return what differs by more than the tolerance of the case, one line each; none where nothing does."""
    lines = []
    greatest, where = worst(recorded, found)
    if not greatest <= case.tolerance:
        lines.append(f"{where} differs by {greatest:.3g}, more than {case.tolerance:g}")
    for key, value in recorded.facts.items():
        other = found.facts.get(key)
        if key == "certificate":
            lines += _certificates_apart(value, other or {}, max(MEASURED, case.tolerance))
        elif key == "reached":
            if other is None or abs(other - value) > case.tolerance:
                lines.append(f"reached is {other!r}, on record {value!r}")
        elif other != value:
            lines.append(f"{key}: {_first_difference(value, other)}")
    return lines


def _first_difference(recorded: Any, found: Any) -> str:
    if isinstance(recorded, list) and isinstance(found, list) and len(recorded) == len(found):
        k = next(i for i, pair in enumerate(zip(recorded, found, strict=True)) if pair[0] != pair[1])
        return f"entry {k} is {found[k]!r}, on record {recorded[k]!r}"
    return f"{found!r}, on record {recorded!r}"


def _certificates_apart(
    recorded: Mapping[str, Any], found: Mapping[str, Any], tolerance: float
) -> Iterator[str]:
    """Yield what two certificates differ in: the verdict, what was measured, and its values."""
    if found.get("ok") != recorded["ok"]:
        yield f"the certificate's verdict is {found.get('ok')}, on record {recorded['ok']}"
    if len(found.get("contradictions", ())) != len(recorded["contradictions"]):
        yield f"contradictions are {found.get('contradictions')}, on record {recorded['contradictions']}"
    for name, measure in recorded.items():
        # How many rows FCL is asked for depends on what takes the step.
        if not isinstance(measure, Mapping) or name in ("fcl_rows", "exact_rows"):
            continue
        values = measure["value"], found.get(name, {}).get("value")
        if None in values:
            if values[0] is not values[1]:
                yield f"certificate: {name} is {values[1]}, on record {values[0]}"
        elif abs(values[0] - values[1]) > tolerance * max(1.0, abs(values[0])):
            yield f"certificate: {name} is {values[1]:.9g}, on record {values[0]:.9g}"


# ---------------------------------------------------------------------------------------------- the command


def _run(names: Sequence[str]) -> Iterator[tuple[str, Recording, float]]:
    for name in names:
        started = time.perf_counter()
        yield name, record(CASES[name]), time.perf_counter() - started


def _report(name: str, recorded: Recording, found: Recording, seconds: float | None = None) -> bool:
    """Print how two recordings of a case compare; return whether they are the same."""
    lines = differences(CASES[name], recorded, found)
    greatest, where = worst(recorded, found)
    took = "" if seconds is None else f"  {seconds:6.2f} s"
    print(f"{'FAIL' if lines else 'ok  '}{took}  {greatest:9.2e}  {name}  ({where})", flush=True)
    for line in lines:
        print(f"        {line}", flush=True)
    return not lines


def _summary(apart: Mapping[str, float], failed: Sequence[str]) -> int:
    if apart:
        name = max(apart, key=lambda name: apart[name])
        print(f"{len(apart)} cases, {len(failed)} differ; the worst is {name!r}: {apart[name]:.3g}")
    return 1 if failed else 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Record, compare or list the cases."""
    logging.getLogger("vgtm_qp").setLevel(logging.ERROR)
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    for command, files in (("write", "--to"), ("compare", "--with")):
        sub = commands.add_parser(command)
        sub.add_argument(files, dest="file", type=Path, default=RECORD)
        sub.add_argument("cases", nargs="*", metavar="CASE")
    between = commands.add_parser("between")
    between.add_argument("files", nargs=2, type=Path, metavar="FILE")
    between.add_argument("cases", nargs="*", metavar="CASE")
    commands.add_parser("list")
    options = parser.parse_args(arguments)
    if options.command == "list":
        for case in CASES.values():
            print(f"{case.tolerance:7.0e}  {case.name}")
        return 0
    if unknown := [name for name in options.cases if name not in CASES]:
        parser.error(f"no such case: {', '.join(unknown)}; 'list' names them")
    names = options.cases or list(CASES)
    if options.command == "write":
        recordings = load(options.file) if options.cases and options.file.exists() else {}
        for name, recording, seconds in _run(names):
            recordings[name] = recording
            facts = recording.facts
            ended = (
                f"{facts['status']} {facts['reached']:.3f} {facts['stop']}" if "status" in facts else "loop"
            )
            print(f"{seconds:6.2f} s  {name}: {ended}", flush=True)
        save(options.file, {name: recordings[name] for name in CASES if name in recordings})
        return 0
    apart: dict[str, float] = {}
    failed: list[str] = []
    if options.command == "between":
        first, second = (load(path) for path in options.files)
        pairs = ((n, first[n], second[n], None) for n in names if n in first and n in second)
    else:
        first = load(options.file)
        pairs = ((n, first[n], found, seconds) for n, found, seconds in _run(names))
    for name, recorded, found, seconds in pairs:
        apart[name] = worst(recorded, found)[0]
        if not _report(name, recorded, found, seconds):
            failed.append(name)
    return _summary(apart, failed)


if __name__ == "__main__":
    sys.exit(main())
