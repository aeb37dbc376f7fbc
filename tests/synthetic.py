"""Maneuvers made by hand, without the solver: tripods whose apices follow from lengths in closed form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.truss.arm import TrussArm
from vgtm_qp.arm.truss.joints import Joints
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.result.manifest import SCHEMA_VERSION, recorded_versions

Array = NDArray[np.float64]

NAMES = ("leg-1", "leg-2", "leg-3", "mast-1", "mast-2", "mast-3")
MEMBERS = np.array([[0, 3], [1, 3], [2, 3], [1, 4], [2, 4], [3, 4]])
RADIUS = 0.02


def trilaterate(centers: Array, lengths: Array, above: float) -> Array:
    """Return the point at three distances from three points, on the side that `above` has the sign of."""
    x = centers[1] - centers[0]
    d = np.linalg.norm(x)
    x = x / d
    i = x @ (centers[2] - centers[0])
    y = centers[2] - centers[0] - i * x
    y /= np.linalg.norm(y)
    j = y @ (centers[2] - centers[0])
    p = (lengths[0] ** 2 - lengths[1] ** 2 + d**2) / (2 * d)
    q = (lengths[0] ** 2 - lengths[2] ** 2 + i**2 + j**2 - 2 * i * p) / (2 * j)
    r = np.sqrt(lengths[0] ** 2 - p**2 - q**2) * np.sign(above)
    return centers[0] + p * x + q * y + r * np.cross(x, y)


def place(lengths: Array) -> Array:
    """Return (5, 3) nodes of the two-storey tripod for its six member lengths."""
    base = np.array([[1.0, 0.0, 0.0], [-0.5, 0.8660254, 0.0], [-0.5, -0.8660254, 0.0]])
    apex = trilaterate(base, lengths[:3], 1.0)
    top = trilaterate(np.array([base[1], base[2], apex]), lengths[3:], 1.0)
    return np.vstack([base, apex, top])


def tripod(joints: Joints | None = None, home_lengths: Array | None = None) -> Truss:
    """Two stacked tetrahedra: base nodes 0-2, an apex and a tip, one actuated member each."""
    home = place(np.array([1.4, 1.4, 1.4, 1.5, 1.5, 0.9]) if home_lengths is None else home_lengths)
    lengths = np.linalg.norm(home[MEMBERS[:, 0]] - home[MEMBERS[:, 1]], axis=1)
    actuated = np.array([True, False, False, False, False, True])
    stroke = np.stack([lengths, lengths], axis=1)
    stroke[actuated] = [0.7, 1.8]
    limits = np.where(actuated, 0.2, np.inf)
    return Truss(
        module="graph",
        node_names=("n1", "n2", "n3", "n4", "n5"),
        member_names=NAMES,
        home=home,
        base=np.array([True, True, True, False, False]),
        members=MEMBERS,
        actuated=actuated,
        stroke=stroke,
        rate=limits,
        acceleration=limits,
        radius=np.full(6, RADIUS),
        faces=np.zeros((0, 3), dtype=int),
        face_weights=np.zeros((0, 3)),
        face_frames=np.zeros((0, 3, 3)),
        tip=np.array([4]),
        tip_weights=np.ones(1),
        tip_frame=np.eye(3),
        stage=np.array([-1, -1, -1, 0, 1]),
        joints=joints,
    )


def graph_table(truss: Truss) -> dict[str, Any]:
    """Return the table of a truss as a graph."""
    nodes = zip(truss.node_names, truss.home.tolist(), truss.base.tolist(), strict=True)
    members = []
    for k, name in enumerate(truss.member_names):
        ends = [truss.node_names[i] for i in truss.members[k]]
        moves = {"actuated": True, "stroke": truss.stroke[k].tolist()} if truss.actuated[k] else {}
        limits = (
            {"rate": 0.2, "acceleration": 0.2} if truss.actuated[k] and np.isfinite(truss.rate[k]) else {}
        )
        members.append({"name": name, "nodes": ends, **moves, **limits})
    return {
        "module": "graph",
        "member_radius": float(truss.radius[0]),
        "node": [{"name": name, "position": at, "fixed": fixed} for name, at, fixed in nodes],
        "member": members,
        "tip": [truss.node_names[i] for i in truss.tip],
    }


def problem_of(truss: Truss, changes: dict[str, Any]) -> dict[str, Any]:
    """Return a problem of `truss` as JSON data, with `changes`; those of a graph are added to its table."""
    problem: dict[str, Any] = {
        "schema_version": 1,
        "name": "tripod",
        "truss": graph_table(truss),
        "end_effector": {"track": ["position"], "mode": "scaled"},
        "obstacle": [],
        "clearance": {"safe": 0.05, "self_collision": True},
    }
    table = changes.get("truss", {})
    if table.get("module", "graph") == "graph":
        changes = {**changes, "truss": {**problem["truss"], **table}}
    return problem | changes


def maneuver_of(
    nodes: Array,
    time: Array,
    truss: Truss,
    *,
    clearance: Array | None = None,
    self_clearance: Array | None = None,
    status: str = "solved",
    reached: float = 1.0,
    targets: Array | None = None,
    meshes: dict[str, Any] | None = None,
    directory: str = ".",
    problem: dict[str, Any] | None = None,
) -> Maneuver:
    """Return the maneuver through those states, to targets where its tip is if none are given."""
    count = len(nodes)
    tip = nodes[:, truss.tip].mean(axis=1)
    ends = nodes[:, truss.members]
    lengths = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2)
    waypoints = [{"time": float(t), "position": p.tolist()} for t, p in zip(time[1:], tip[1:], strict=True)]
    whole = {"maneuver": {"steps": count - 1, "waypoint": waypoints}, **problem_of(truss, problem or {})}
    manifest = {
        "schema_version": SCHEMA_VERSION,
        "problem": whole,
        "arm": TrussArm(truss).record(),
        "status": status,
        "reached": reached,
        "blocked_by": [],
        "method": "qp",
        "solver": "daqp",
        "setup_time": 0.1,
        "directory": str(Path(directory).resolve()),
        "meshes": meshes or {},
        "versions": recorded_versions(),
        "certificate": None,
    }
    infinite = np.full(count, np.inf)
    return Maneuver(
        time=time,
        nodes=nodes,
        members=truss.members,
        member_names=np.array(truss.member_names),
        member_actuated=truss.actuated,
        member_lengths=lengths,
        control_vertices=np.zeros((count, 0, 3)),
        tip_position=tip,
        tip_rotation=np.tile(truss.tip_frame, (count, 1, 1)),
        tip_target_position=tip if targets is None else targets,
        clearance=infinite if clearance is None else clearance,
        self_clearance=infinite if self_clearance is None else self_clearance,
        progress=np.linspace(0.0, reached, count),
        step_time=np.r_[0.0, np.full(count - 1, 1e-3)],
        phase_names=np.array(["QP", "distance"]),
        phase_time=np.full((count, 2), 4e-4),
        manifest=manifest,
    )


LENGTHS = np.array([1.4, 1.4, 1.4, 1.5, 1.5, 0.9])


def swing(states: int = 11, duration: float = 6.0) -> tuple[Array, Array]:
    """Return nodes (T, 5, 3) and times (T,) of a smooth motion of both actuators from rest to rest."""
    share = np.linspace(0.0, 1.0, states)
    share = 3 * share**2 - 2 * share**3
    lengths = np.tile(LENGTHS, (states, 1))
    lengths[:, 0] += 0.2 * share
    lengths[:, 5] += 0.15 * share
    return np.stack([place(row) for row in lengths]), np.linspace(0.0, duration, states)


def found_clearances(maneuver: Maneuver) -> Maneuver:
    """Return `maneuver` with the clearances that its own certificate can agree with."""
    from dataclasses import replace
    from pathlib import Path

    from vgtm_qp.verify.arm import RecordedArm
    from vgtm_qp.verify.clearance import AgainstBody, AgainstMembers, RecordedMotion
    from vgtm_qp.verify.obstacles import read_obstacles

    manifest = maneuver.manifest
    motion = RecordedMotion(RecordedArm(manifest["arm"], maneuver.members), maneuver.time, maneuver.nodes)
    bodies, _, _ = read_obstacles(manifest["problem"], manifest["meshes"], Path(manifest["directory"]))
    states = range(len(maneuver.time))
    bodily = [AgainstBody(motion, body) for body in bodies]
    each = [pairs.at_states() for pairs in bodily]
    clear = [min([found[k].value for found in each], default=np.inf) for k in states]
    own = [least.value for least in AgainstMembers(motion).at_states()]
    return replace(maneuver, clearance=np.array(clear), self_clearance=np.array(own))


def good_maneuver(**changes: Any) -> Maneuver:
    """Return a maneuver that deserves its certificate."""
    nodes, time = swing()
    return found_clearances(maneuver_of(nodes, time, tripod(), **changes))
