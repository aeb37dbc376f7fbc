"""Every key of a problem file does something: the result or its certificate changes with it, or it is refused.

No key may stand in the schema in name only. Each has a case here: a problem, and the same with another value.
"""

from __future__ import annotations

import typing
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np
import pytest
from arms import UNEQUAL

import vgtm_qp as vq
from vgtm_qp.methods import with_method
from vgtm_qp.problem import Problem
from vgtm_qp.problem.method import CURVE_TERMS, SERVED, TRUSS_TERMS
from vgtm_qp.problem.table import Table
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.checks import find_warnings

WAYS = {
    "coupled": "qp",
    "none": "qp-none",
    "bays": "qp-recursive",
    "pseudoinverse": "pseudoinverse",
    "curve-pseudoinverse": "curve-pseudoinverse",
}
"""A preset for each of the ways in which arms are moved."""

BASE: dict[str, Any] = {
    "truss": {"module": "octahedral", "bays": 4},
    "curve": {"control_vertices": 4},
    "maneuver": {"steps": 3, "waypoint": [{"time": 3.0, "position": [0.3, 0.1, 3.1]}]},
    "obstacle": [{"name": "ball", "shape": "sphere", "center": [1.0, 0.0, 2.2], "radius": 0.25}],
}
MOVED = [{"time": 1.0, "position": [0.05, 0.0, 0.0], "rotation_vector": [0.0, 0.05, 0.0]}]
SEGMENTS = {
    "curve": {
        "family": "segments",
        "control_vertices": 3,
        "breaks": [0.0, 0.5, 1.0],
        "extraction": [[[1, 0, 0], [0.5, 0.5, 0], [0, 1, 0]], [[0, 1, 0], [0, 0.5, 0.5], [0, 0, 1]]],
    }
}
GOALS = [{"index": 2, "position": [0.3, 0.0, 1.4]}]
SNAKE = {
    "arm": {
        "joint": [
            {"name": f"j{k}", "axis": [[1, 0, 0], [0, 1, 0]][k % 2], "home": 0.1, "position": [0, 0, 0.4]}
            for k in range(6)
        ],
        "tip": [0.0, 0.0, 0.4],
    },
    "maneuver": {"steps": 3, "waypoint": [{"time": 3.0, "position": [0.2, -0.6, 2.5]}]},
}
CSV = "t,x,y,z\n1.0,0.05,0.0,3.26\n2.0,0.1,0.0,3.25\n3.0,0.15,0.0,3.24\n"
OBJ = "v 0 0 0\nv 0.2 0 0\nv 0 0.2 0\nv 0 0 0.2\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def snake_urdf(length: float) -> str:
    """Return the snake as a URDF file; its links are wedges from a package."""
    mesh = '<collision><geometry><mesh filename="package://snake/wedge.obj"/></geometry></collision>'
    parts = [f'<link name="l0">{mesh}</link>']
    for k in range(6):
        axis = ("1 0 0", "0 1 0")[k % 2]
        parts.append(
            f'<joint name="j{k}" type="continuous"><parent link="l{k}"/><child link="l{k + 1}"/>'
            f'<origin xyz="0 0 {length}"/><axis xyz="{axis}"/></joint><link name="l{k + 1}">{mesh}</link>'
        )
    tool = f'<joint name="j" type="fixed"><parent link="l6"/><child link="tip"/><origin xyz="0 0 {length}"/></joint>'
    return f'<robot name="snake">{"".join(parts)}{tool}<link name="tip"/></robot>'


def graph() -> dict[str, Any]:
    """An octahedral bay between unequal triangles, and a tip of three nodes."""
    pairs = ["g1 m1", "g2 m1", "g2 m2", "g3 m2", "g3 m3", "g1 m3", "m1 m2", "m2 m3", "m3 m1"]
    members: list[dict[str, Any]] = [
        {"name": pair.replace(" ", "-"), "nodes": pair.split(), "actuated": pair.count("m") == 2}
        for pair in pairs
    ]
    for member in members[6:]:
        member["stroke"] = [0.6, 3.0]
    nodes = [{"name": name, "position": place, "fixed": name[0] == "g"} for name, place in UNEQUAL.items()]
    for name, others in {"m1": ["m2", "m3"], "g1": ["g2", "g3"]}.items():
        next(node for node in nodes if node["name"] == name)["joint"] = others
    tip = ["m1", "m2", "m3"]
    return {
        "truss": {
            "module": "graph",
            "node": nodes,
            "member": members,
            "tip": tip,
            "faces": [["g1", "g2", "g3"], tip],
            "stroke": [0.5, 3.0],
        },
        "curve": {"control_vertices": 3},
        "maneuver": {"steps": 3, "waypoint": [{"time": 3.0, "position": [0.1, 0.1, 0.95]}]},
    }


def joints(**keys: Any) -> dict[str, Any]:
    """Return the snake with some keys of its second joint."""
    rows = [dict(row) for row in SNAKE["arm"]["joint"]]
    rows[1] |= keys
    return {"arm.joint": rows}


def nodes(index: int, **keys: Any) -> dict[str, Any]:
    """Return the graph with some keys of a node."""
    rows = [dict(row) for row in graph()["truss"]["node"]]
    rows[index] |= keys
    return {"truss.node": rows}


def members(index: int, **keys: Any) -> dict[str, Any]:
    """Return the graph with some keys of a member."""
    rows = [dict(row) for row in graph()["truss"]["member"]]
    rows[index] |= keys
    return {"truss.member": rows}


def obstacle(**keys: Any) -> dict[str, Any]:
    """Return the ball with some keys, without those that are None."""
    ball = {**BASE["obstacle"][0], **keys}
    return {"obstacle": [{key: value for key, value in ball.items() if value is not None}]}


def waypoint(**keys: Any) -> dict[str, Any]:
    return {"maneuver.waypoint": [{**BASE["maneuver"]["waypoint"][0], **keys}]}


def box(**keys: Any) -> dict[str, Any]:
    """Return a box in its place."""
    return obstacle(**{"shape": "box", "radius": None, "size": 0.4, **keys})


Changes = dict[str, Any]
NEAR = obstacle(center=[0.95, 0.0, 2.7])
"""The ball where the arm comes near to it on its way."""
TETRAHEDRAL = {
    "truss.module": "tetrahedral",
    "truss.actuated": [1, 2, 3],
    "maneuver.waypoint": [{"time": 3.0, "position": [0.5, 0.2, 1.2]}],
    "obstacle": [],
}
ELASTIC = {"method.tracking_mode": "elastic"}
PULLED = {"truss.base_motion": MOVED}
POINTED = {"end_effector.track": ["position", "pointing"]}
CASES: dict[str, tuple[Changes, Changes]] = {
    "schema_version": ({}, {"schema_version": 2}),
    "name": ({}, {"name": "another"}),
    "truss.module": ({}, {"truss.module": "longeron"}),
    "truss.rate": ({}, {"truss.rate": 0.01}),
    "truss.acceleration": ({}, {"truss.acceleration": 0.02}),
    "truss.member_radius": ({}, {"truss.member_radius": 0.05}),
    "truss.joint_offset": ({}, {"truss.joint_offset": 0.05}),
    "truss.locked.member": ({"truss.locked": ["B2-1"]}, {"truss.locked": ["B3-1"]}),
    "truss.locked.time": ({"truss.locked": ["B2-1"]}, {"truss.locked": [{"member": "B2-1", "time": 1.5}]}),
    "truss.base_motion.time": (PULLED, {"truss.base_motion": [{**MOVED[0], "time": 2.0}]}),
    "truss.base_motion.position": (
        PULLED,
        {"truss.base_motion": [{**MOVED[0], "position": [0.0, 0.1, 0.0]}]},
    ),
    "truss.base_motion.rotation_vector": (
        PULLED,
        {"truss.base_motion": [{**MOVED[0], "rotation_vector": [0.0, 0.0, 0.1]}]},
    ),
    "truss.bays": ({}, {"truss.bays": 5}),
    "truss.longeron": ({}, {"truss.longeron": 1.05}),
    "truss.batten": ({}, {"truss.batten": 0.95}),
    "truss.stroke": ({}, {"truss.stroke": [0.99, 1.01]}),
    "truss.actuated": (TETRAHEDRAL, {"truss.actuated": [2, 3]}),
    "curve.family": ({"curve.control_vertices": 6}, {"curve.family": "b-spline"}),
    "curve.degree": ({"curve.family": "b-spline", "curve.degree": 2}, {"curve.degree": 3}),
    "curve.bias": ({"curve.family": "beta-spline"}, {"curve.bias": 2.0}),
    "curve.tension": ({"curve.family": "beta-spline"}, {"curve.tension": 2.0}),
    "curve.breaks": (SEGMENTS, {"curve.breaks": [0.0, 0.3, 1.0]}),
    "curve.extraction": (
        SEGMENTS,
        {"curve.extraction": [[[1, 0, 0], [0.6, 0.4, 0], [0, 1, 0]], *SEGMENTS["curve"]["extraction"][1:]]},
    ),
    "curve.control_vertices": ({}, {"curve.control_vertices": 5}),
    "curve.torsion_vertices": ({}, {"curve.torsion_vertices": 1}),
    "curve.nodes": ({}, {"curve.nodes": "arc-length"}),
    "curve.control_vertex_goals.index": (
        {"curve.control_vertex_goals": GOALS},
        {"curve.control_vertex_goals": [{**GOALS[0], "index": 3}]},
    ),
    "curve.control_vertex_goals.position": (
        {"curve.control_vertex_goals": GOALS},
        {"curve.control_vertex_goals": [{**GOALS[0], "position": [0.0, 0.3, 1.4]}]},
    ),
    "end_effector.track": ({}, {"end_effector.track": ["x", "y"]}),
    "end_effector.mode": ({"truss.rate": 0.02}, {"end_effector.mode": "hard"}),
    "maneuver.kind": ({}, {"maneuver.kind": "goal"}),
    "maneuver.steps": ({}, {"maneuver.steps": 4}),
    "maneuver.path": ({"maneuver": {"path": "one.csv"}}, {"maneuver.path": "two.csv"}),
    "maneuver.approach_steps": ({"maneuver": {"path": "one.csv"}}, {"maneuver.approach_steps": 2}),
    "maneuver.approach_time": (
        {"maneuver": {"path": "one.csv", "approach_steps": 2}},
        {"maneuver.approach_time": 3.0},
    ),
    "maneuver.waypoint.time": ({}, waypoint(time=2.0)),
    "maneuver.waypoint.position": ({}, waypoint(position=[0.2, 0.1, 3.1])),
    "maneuver.waypoint.pointing": (
        {**POINTED, **waypoint(pointing=[0.1, 0.0, 1.0])},
        waypoint(pointing=[0.2, 0.0, 1.0]),
    ),
    "maneuver.waypoint.rotation_vector": (
        {**POINTED, **waypoint(rotation_vector=[0.1, 0.0, 0.0])},
        waypoint(rotation_vector=[0.2, 0.0, 0.0]),
    ),
    "obstacle.name": ({}, obstacle(name="globe")),
    "obstacle.shape": ({}, {"obstacle": [{**BASE["obstacle"][0], "shape": "cylinder", "height": 0.5}]}),
    "obstacle.center": ({}, obstacle(center=[1.1, 0.0, 2.2])),
    "obstacle.radius": ({}, obstacle(radius=0.3)),
    "obstacle.velocity": ({}, obstacle(velocity=[0.02, 0.0, 0.0])),
    "obstacle.size": (box(), box(size=0.5)),
    "obstacle.rotation_vector": (box(), box(rotation_vector=[0.0, 0.4, 0.0])),
    "obstacle.height": (
        obstacle(shape="cylinder", height=0.5, rotation_vector=[0.0, 1.5, 0.0]),
        obstacle(shape="cylinder", height=0.6, rotation_vector=[0.0, 1.5, 0.0]),
    ),
    "obstacle.file": (
        obstacle(shape="mesh", radius=None, file="one.obj"),
        obstacle(shape="mesh", radius=None, file="two.obj"),
    ),
    "obstacle.scale": (
        obstacle(shape="mesh", radius=None, file="one.obj"),
        obstacle(shape="mesh", radius=None, file="one.obj", scale=1.5),
    ),
    "clearance.safe": ({}, {"clearance.safe": 0.1}),
    "clearance.influence": ({}, {"clearance.influence": 0.06}),
    "clearance.distance": (NEAR, {"clearance.distance": "exact"}),
    "clearance.margin": (NEAR, {"clearance.margin": 0.02}),
    "clearance.self_collision": ({}, {"clearance.self_collision": False}),
    "clearance.self_safe": ({}, {"clearance.self_safe": 0.3}),
    "clearance.minimum_angle": ({}, {"clearance.minimum_angle": 0.9}),
    "method.name": ({}, {"method.name": "pseudoinverse"}),
    "method.tracking": ({}, {"method.tracking": "recursive"}),
    "method.tracking_mode": ({}, {"method.tracking_mode": "elastic"}),
    "method.hard_coordinates": (
        {"truss.module": "hexapod", "method.tracking_mode": "hard"},
        {"method.hard_coordinates": ["position", "pointing"]},
    ),
    "method.solver": ({}, {"method.solver": "piqp"}),
    "method.retries": (
        {"end_effector.mode": "hard", "method.step_limit": 0.1},
        {"method.retries": False},
    ),
    "method.slow_approach": (NEAR, {"method.slow_approach": False}),
    "method.step_limit": ({}, {"method.step_limit": 0.05}),
    "method.variant": ({}, {"method.variant": "weighted"}),
    "method.algebra": ({}, {"method.algebra": "sparse"}),
    "method.correct": ({}, {"method.correct": True}),
    "method.null_space": ({}, {"method.null_space": ["obstacle_potential"]}),
    "method.damping": ({"method.variant": "damped"}, {"method.damping": 0.1}),
    "method.truncation": ({"method.variant": "truncated"}, {"method.truncation": 0.5}),
    "method.weights.node_rate": ({}, {"method.weights.node_rate": 0.1}),
    "method.weights.actuator_rate": ({}, {"method.weights.actuator_rate": 1.0}),
    "method.weights.stroke_centring": ({}, {"method.weights.stroke_centring": 1.0}),
    "method.weights.curve_rate": ({}, {"method.weights.curve_rate": 1.0}),
    "method.weights.tracking": (ELASTIC, {"method.weights.tracking": 1.0}),
    "method.weights.tangent": (ELASTIC, {"method.weights.tangent": 1.0}),
    "method.weights.roll": ({"curve.torsion_vertices": 1, **ELASTIC}, {"method.weights.roll": 1.0}),
    "method.weights.spacing": ({}, {"method.weights.spacing": 1.0}),
    "method.weights.smoothness": ({}, {"method.weights.smoothness": 1.0}),
    "method.weights.vertex_goal": (
        {"curve.control_vertex_goals": GOALS},
        {"method.weights.vertex_goal": 0.1},
    ),
    "method.weights.obstacle_potential": ({}, {"method.weights.obstacle_potential": 1e-3}),
    "method.weights.end_effector": ({"end_effector.mode": "elastic"}, {"method.weights.end_effector": 1e-3}),
    "method.weights.progress": ({}, {"method.weights.progress": 1e-3}),
    "method.gains.spacing": ({}, {"method.gains.spacing": 0.1}),
    "method.gains.smoothness": ({}, {"method.gains.smoothness": 1.0}),
    "method.gains.curve_rate": ({}, {"method.gains.curve_rate": 0.1}),
    "method.gains.obstacle_potential": ({}, {"method.gains.obstacle_potential": 0.1}),
}
GRAPH_CASES: dict[str, tuple[Changes, Changes]] = {
    "truss.tip": ({}, {"truss.tip": ["m2", "m3", "m1"]}),
    "truss.faces": ({}, {"truss.faces": [["g1", "g2", "g3"], ["m2", "m3", "m1"]]}),
    "truss.node.name": ({}, nodes(0, name="another")),
    "truss.node.position": ({}, nodes(0, position=[1.0, 0.2, 0.0])),
    "truss.node.fixed": ({}, nodes(0, fixed=False)),
    "truss.node.joint": ({"truss.joint_offset": 0.05}, nodes(3, joint=["m3", "m2"])),
    "truss.member.name": ({}, members(8, name="another")),
    "truss.member.nodes": ({}, members(0, nodes=["g2", "m3"])),
    "truss.member.actuated": ({}, members(0, actuated=True)),
    "truss.member.length": ({}, members(8, length=1.8)),
    "truss.member.stroke": ({}, members(8, stroke=[1.6, 1.9])),
    "truss.member.rate": ({}, members(8, rate=0.01)),
    "truss.member.acceleration": ({}, members(8, acceleration=0.01)),
    "truss.member.radius": ({}, members(8, radius=0.05)),
    "truss.member.offsets": ({}, members(0, offsets=[[0.0, 0.0, 0.05], [0.0, 0.0, 0.05]])),
}
FILE: Changes = {
    "arm": {"urdf": "one.urdf", "home": [0.1] * 6, "package_path": ["one"]},
    "maneuver.waypoint": [{"time": 3.0, "position": [0.2, -0.5, 1.8]}],
}
BODY = {"name": "fin", "joint": "j3", "points": [[0.0, 0.1, 0.0], [0.0, 0.1, 0.3]], "radius": 0.05}


def body(**changes: Any) -> Changes:
    """Change the one body of an arm."""
    return {"arm.body": [{**BODY, **changes}]}


ARM_CASES: dict[str, tuple[Changes, Changes]] = {
    "arm.base_motion.time": ({"arm.base_motion": MOVED}, {"arm.base_motion": [{**MOVED[0], "time": 2.0}]}),
    "arm.base_motion.position": (
        {"arm.base_motion": MOVED},
        {"arm.base_motion": [{**MOVED[0], "position": [0.0, 0.1, 0.0]}]},
    ),
    "arm.base_motion.rotation_vector": (
        {"arm.base_motion": MOVED},
        {"arm.base_motion": [{**MOVED[0], "rotation_vector": [0.0, 0.0, 0.1]}]},
    ),
    "arm.every": ({}, {"arm.every": 2}),
    "arm.link_radius": ({}, {"arm.link_radius": 0.05}),
    "arm.locked.joint": ({"arm.locked": ["j1"]}, {"arm.locked": ["j2"]}),
    "arm.locked.time": ({"arm.locked": ["j1"]}, {"arm.locked": [{"joint": "j1", "time": 1.5}]}),
    "arm.tip": ({}, {"arm.tip": [0.05, 0.0, 0.4]}),
    "arm.joint.name": ({}, joints(name="another")),
    "arm.joint.kind": (joints(limits=[-1.0, 1.0]), joints(kind="prismatic", limits=[-1.0, 1.0])),
    "arm.joint.axis": ({}, joints(axis=[0.0, 1.0, 0.1])),
    "arm.joint.position": ({}, joints(position=[0.0, 0.0, 0.45])),
    "arm.joint.rotation_vector": ({}, joints(rotation_vector=[0.0, 0.1, 0.0])),
    "arm.joint.limits": ({}, joints(limits=[0.09, 0.11])),
    "arm.joint.home": ({}, joints(home=0.2)),
    "arm.joint.rate": ({}, joints(rate=0.01)),
    "arm.joint.acceleration": ({}, joints(acceleration=0.01)),
    "arm.joint.effort": (joints(mass=2.0, effort=100.0), joints(mass=2.0, effort=0.01)),
    "arm.joint.mass": (joints(effort=0.01), joints(mass=2.0, effort=0.01)),
    "arm.joint.center_of_mass": (
        joints(mass=2.0, effort=0.01),
        joints(mass=2.0, effort=0.01, center_of_mass=[0.1, 0.1, 0.1]),
    ),
    "arm.joint.mimic.joint": (joints(mimic={"joint": "j2"}), joints(mimic={"joint": "j4"})),
    "arm.joint.mimic.multiplier": (
        joints(mimic={"joint": "j3"}),
        joints(mimic={"joint": "j3", "multiplier": -1.0}),
    ),
    "arm.joint.mimic.offset": (joints(mimic={"joint": "j3"}), joints(mimic={"joint": "j3", "offset": 0.1})),
    "arm.urdf": (FILE, {"arm.urdf": "two.urdf"}),
    "arm.package_path": (FILE, {"arm.package_path": ["two"]}),
    "arm.base_link": (FILE, {"arm.base_link": "l1", "arm.home": [0.1] * 5}),
    "arm.tip_link": (FILE, {"arm.tip_link": "l5", "arm.home": [0.1] * 5}),
    "arm.home": (FILE, {"arm.home": [0.12] * 6}),
    "arm.bodies": (FILE, {"arm.bodies": "capsule"}),
    "arm.tip_rotation_vector": ({}, {"arm.tip_rotation_vector": [0.1, 0.0, 0.0]}),
    "arm.body.name": (body(), body(name="sail")),
    "arm.body.joint": (body(), body(joint="j4")),
    "arm.body.points": (body(), body(points=[[0.0, 0.2, 0.0]])),
    "arm.body.radius": (body(), body(radius=0.08)),
}


TERMS = {
    "pseudoinverse": list(TRUSS_TERMS),
    "curve-pseudoinverse": list(CURVE_TERMS),
}
"""All null-space terms of a way, so that each weight and gain has its term."""


@cache
def definitions() -> frozenset[str]:
    """Return the paths of all keys that hold values, from the tables themselves."""

    def tables(annotation: Any) -> Iterator[type[Table]]:
        if isinstance(annotation, type) and issubclass(annotation, Table):
            yield annotation
        for part in typing.get_args(annotation):
            yield from tables(part)

    def keys(table: type[Table], outer: str) -> Iterator[str]:
        for key, field in table.model_fields.items():
            inner = list(tables(field.annotation))
            for other in inner:
                yield from keys(other, f"{outer}{key}.")
            if not inner:
                yield f"{outer}{key}"

    return frozenset(keys(Problem, ""))


ARRAYS = (
    "time",
    "nodes",
    "joints",
    "control_vertices",
    "tip_position",
    "tip_rotation",
    "tip_target_position",
    "clearance",
    "member_lengths",
)


def effect(problem: Problem) -> dict[str, Any]:
    """Return all that is told of a maneuver but the problem itself and what the clock says."""
    maneuver = vq.solve(problem)
    rows: tuple[str, ...] = ()
    if problem.method.name == "qp" and problem.method.tracking in ("coupled", "none"):
        rows = tuple(row.name for row in vq.Resolver(problem).build().rows)
    told = {
        key: value
        for key, value in maneuver.manifest.items()
        if key not in ("problem", "setup_time", "versions", "directory", "certificate")
    }
    arrays = {key: getattr(maneuver, key) for key in ARRAYS if getattr(maneuver, key, None) is not None}
    # What joints bear is told by `vgtm check` and on the page.
    warned = str(find_warnings(problem, build_arm(problem)))
    told |= {"certificate": str(maneuver.certificate), "name": problem.name, "rows": rows, "warnings": warned}
    return told | arrays


def differs(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Return what differs between two maneuvers, beyond rounding."""
    found = []
    for key in one.keys() | other.keys():
        a, b = one.get(key), other.get(key)
        if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
            same = a.shape == b.shape and np.allclose(a, b, rtol=0.0, atol=1e-8)
        else:
            same = a == b
        found += [] if same else [key]
    return found


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Stand in a folder with the files that the cases name; nothing is compiled for them."""
    monkeypatch.setenv("VGTM_CC", "none")
    monkeypatch.chdir(tmp_path)
    for name, text in {
        "one.csv": CSV,
        "two.csv": CSV.replace("0.15", "0.2"),
        "one.obj": OBJ,
        "two.obj": OBJ.replace("0.2", "0.3"),
        "one.urdf": snake_urdf(0.4),
        "two.urdf": snake_urdf(0.45),
        "one/snake/wedge.obj": OBJ.replace("0.2", "0.1"),
        "two/snake/wedge.obj": OBJ.replace("0.2", "0.12"),
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)


def base(key: str, way: str) -> tuple[Problem, Changes]:
    """Return the problem of a case, moved in one of the ways, and the changes to it."""
    table, problem = next(
        (cases, made)
        for cases, made in ((CASES, BASE), (GRAPH_CASES, graph()), (ARM_CASES, SNAKE))
        if key in cases
    )
    condition, changes = table[key]
    if way == "bays":
        # Bays follow the curve exactly whether or not they are told to.
        condition = {name: value for name, value in condition.items() if name != "method.tracking_mode"}
    found = with_method(Problem(**problem), WAYS[way])
    if way in TERMS and key.startswith(("method.weights.", "method.gains.")):
        found = found.replace({"method.null_space": TERMS[way]})
    return found.replace(condition), changes


_effects: dict[str, dict[str, Any]] = {}


def assert_something_changes(problem: Problem, changes: Changes, key: str) -> None:
    told = repr(problem.to_dict())
    if told not in _effects:
        _effects[told] = effect(problem)
    try:
        found = effect(problem.replace(changes))
    except vq.VgtmError as error:
        told_by_name = key.split(".")[-1] in str(error) or "member" in str(error)
        if not told_by_name:
            raise
        return
    assert differs(_effects[told], found), f"{key} changes nothing"


def test_every_key_has_a_case():
    assert definitions() == CASES.keys() | GRAPH_CASES.keys() | ARM_CASES.keys()
    method = {key.removeprefix("method.") for key in definitions() if key.startswith("method.")}
    assert method == SERVED.keys()


@pytest.mark.dear
@pytest.mark.parametrize("key", [*CASES, *GRAPH_CASES, *ARM_CASES])
def test_a_key_changes_something(key):
    ways = SERVED[key.removeprefix("method.")] if key.startswith("method.") else tuple(WAYS)
    assert_something_changes(*base(key, ways[0]), key)


@pytest.mark.dear
@pytest.mark.parametrize("way", list(WAYS)[1:])
@pytest.mark.parametrize("key", SERVED)
def test_a_key_of_the_method_does_something_in_every_way_or_is_refused(key, way):
    if key in ("name", "tracking") or (key == "retries" and "pseudoinverse" in way):
        # These never try another way, whatever `retries` says.
        return
    if way in SERVED[key]:
        assert_something_changes(*base(f"method.{key}", way), f"method.{key}")
        return
    problem, (_, changes) = with_method(Problem(**BASE), WAYS[way]), CASES[f"method.{key}"]
    with pytest.raises(
        vq.ProblemError, match=f"method.{key}.*: found .*; expected .*, since .* does without this key"
    ):
        problem.replace(changes)


@pytest.mark.dear
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("key", [key for key in CASES if key.startswith(("truss.", "obstacle."))])
def test_arm_and_obstacles_matter_in_every_way(key, way):
    problem, changes = base(key, way)
    try:
        assert_something_changes(problem, changes, key)
    except vq.VgtmError:
        # Arms whose bays or base the curve's methods cannot take are refused with the reason.
        if way not in ("bays", "curve-pseudoinverse"):
            raise


@pytest.mark.parametrize(
    ("changes", "way", "key"),
    [
        ({"curve.control_vertex_goals": GOALS}, "none", "curve.control_vertex_goals"),
        ({"curve.control_vertex_goals": GOALS}, "pseudoinverse", "curve.control_vertex_goals"),
        ({"curve.nodes": "arc-length"}, "curve-pseudoinverse", "curve.nodes"),
        ({"end_effector.mode": "elastic"}, "pseudoinverse", "end_effector.mode"),
        ({"method.tracking": "none"}, "curve-pseudoinverse", "method.tracking"),
        ({"method.null_space": ["node_rate"]}, "bays", "method.null_space"),
        ({"method.tracking": "parallel"}, "pseudoinverse", "method.tracking"),
    ],
)
def test_what_a_method_does_not_do_is_refused_by_key(changes, way, key):
    with pytest.raises(vq.ProblemError, match=f"{key}.*: found .*; expected"):
        with_method(Problem(**BASE), WAYS[way]).replace(changes)


def test_with_method_keeps_what_the_other_method_serves():
    problem = Problem(**BASE).replace(
        {
            "method.solver": "osqp",
            "method.step_limit": 0.2,
            "method.weights.actuator_rate": 0.3,
            "method.weights.curve_rate": 0.4,
        }
    )
    for name in WAYS.values():
        method = with_method(problem, name).method
        assert method.step_limit == 0.2
        assert method.solver == ("osqp" if name in ("qp", "qp-none") else "daqp")
        assert method.weights.actuator_rate == (0.02 if "curve" in name else 0.3)
        assert method.weights.curve_rate == (0.4 if name in ("qp", "qp-recursive") else 0.02)
