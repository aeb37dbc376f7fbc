"""Maneuvers made by hand, without the solver: a tripod whose apex follows from three lengths in closed form."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.maneuver.manifest import arm_record, make_manifest
from vgtm_qp.maneuver.result import Maneuver
from vgtm_qp.truss.truss import Joints, Truss

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
        bays=1,
        joints=joints,
    )


def problem_of(truss: Truss, tip: Array, time: float, **changes: Any) -> dict[str, Any]:
    """Return a problem as JSON data whose path ends at `tip`."""
    problem: dict[str, Any] = {
        "schema_version": 1,
        "name": "tripod",
        "truss": {"module": "graph", "member_radius": RADIUS, "rate": 0.2, "acceleration": 0.2},
        "end_effector": {"track": ["position"], "mode": "scaled"},
        "maneuver": {"steps": 1, "waypoint": [{"time": time, "position": tip.tolist()}]},
        "obstacle": [],
        "clearance": {"safe": 0.05, "self_collision": True},
    }
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
    **changes: Any,
) -> Maneuver:
    """Return the maneuver through those states; clearances are taken over from `verify` where not given."""
    count = len(nodes)
    tip = nodes[:, truss.tip].mean(axis=1)
    ends = nodes[:, truss.members]
    lengths = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2)
    waypoints = [{"time": float(t), "position": p.tolist()} for t, p in zip(time[1:], tip[1:], strict=True)]
    problem = problem_of(truss, tip[-1], float(time[-1]), **changes)
    problem["maneuver"] = {"steps": count - 1, "waypoint": waypoints}
    manifest = make_manifest(
        problem,
        arm_record(truss),
        status=status,
        reached=reached,
        method="qp",
        solver="daqp",
        setup_time=0.1,
        meshes=meshes,
        directory=directory,
    )
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
