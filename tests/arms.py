"""Small trusses of every module and the parts of a step's QP at random poses, for the tests of the spine."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import modules
import numpy as np
from modules import graph_truss
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Arm
from vgtm_qp.arm.truss.arm import TrussArm
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.curve.families import bezier
from vgtm_qp.problem import Problem
from vgtm_qp.problem.method import Weights
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.shape import CurveRows, CurveShape
from vgtm_qp.step.task import TipTask

Array = NDArray[np.float64]


UNEQUAL = {
    "g1": [1.0, 0.1, 0.0],
    "g2": [-0.5, 0.9, 0.1],
    "g3": [-0.6, -0.8, 0.0],
    "m1": [0.5, 0.9, 0.8],
    "m2": [-0.9, 0.1, 0.9],
    "m3": [0.45, -0.8, 1.0],
}
"""Nodes of an octahedral bay between unequal triangles."""


def mast(joint_offset: float = 0.0) -> Truss:
    """A graph without symmetry: an octahedral layer between unequal triangles, and a tip of one node."""
    positions = {**UNEQUAL, "top": [0.1, 0.05, 1.9]}
    nodes = [{"name": k, "position": p, "fixed": k[0] == "g"} for k, p in positions.items()]
    zigzag = [("g1", "m1"), ("g2", "m1"), ("g2", "m2"), ("g3", "m2"), ("g3", "m3"), ("g1", "m3")]
    ring = [("m1", "m2"), ("m2", "m3"), ("m3", "m1")]
    stays = [("m1", "top"), ("m2", "top"), ("m3", "top")]
    members = [
        {"name": f"{a}-{b}", "nodes": (a, b), "actuated": (a, b) in ring or (a, b) == stays[2]}
        for a, b in zigzag + ring + stays
    ]
    faces = [("g1", "g2", "g3"), ("m1", "m2", "m3")]
    return graph_truss(nodes, members, ["top"], faces, stroke=[0.3, 3.0], joint_offset=joint_offset)


TRUSSES: dict[str, Callable[..., Truss]] = {
    "octahedral": lambda **kw: modules.octahedral(2, **kw),
    "double-octahedral": lambda **kw: modules.double_octahedral(2, **kw),
    "hexapod": lambda **kw: modules.hexapod(2, **kw),
    "longeron": lambda **kw: modules.longeron(2, **kw),
    "tetrahedral-1": lambda **kw: modules.tetrahedral(2, actuated=(1,), **kw),
    "tetrahedral-2": lambda **kw: modules.tetrahedral(2, actuated=(2,), **kw),
    "tetrahedral-3": lambda **kw: modules.tetrahedral(2, actuated=(3,), **kw),
    "tetrahedral-23": lambda **kw: modules.tetrahedral(2, actuated=(2, 3), **kw),
    "tetrahedral-123": lambda **kw: modules.tetrahedral(2, actuated=(1, 2, 3), longeron=1.1, **kw),
    "graph": mast,
}


def random_pose(truss: Truss, rng: np.random.Generator, size: float = 0.05) -> Array:
    """Node positions off home, base nodes too: no Jacobian row may depend on the members' right lengths."""
    return truss.home + size * rng.normal(size=truss.home.shape)


def make_layout(
    truss: Truss | Arm,
    track: tuple[str, ...] = ("position",),
    *,
    vertices: int = 5,
    hard_tracking: bool = False,
    weights: Weights | None = None,
) -> tuple[Layout, TipTask]:
    """Layout and tip task of an arm; no curve where `vertices` is 0."""
    arm = TrussArm(truss) if isinstance(truss, Truss) else truss
    task = TipTask(track, arm)
    weights = weights or Weights()
    if not vertices:
        none = np.zeros((0, 0))
        return Layout(arm, none, none, np.zeros(0, dtype=np.int64), task.row_names, weights), task
    family = bezier(vertices)
    tracked = np.arange(1, len(arm.stations.nodes))
    s = tracked / tracked[-1]
    layout = Layout(
        arm,
        family.weights(s),
        family.weights(s, 1),
        tracked,
        task.row_names,
        weights,
        hard_tracking=hard_tracking,
    )
    return layout, task


def central_differences(function: Callable[[Array], Any], X: Array, h: float = 1e-6) -> Array:
    """Derivatives of an array function of `X`, by the last axes; (value shape, X shape)."""
    columns = []
    for k in range(X.size):
        step = np.zeros(X.size)
        step[k] = h
        ahead, behind = (function(X + sign * step.reshape(X.shape)) for sign in (1.0, -1.0))
        columns.append((np.asarray(ahead) - np.asarray(behind)) / (2 * h))
    return np.stack(columns, axis=-1).reshape(*np.shape(columns[0]), *X.shape)


def check_curve_rows(
    shape: CurveShape,
    vertices: Array,
    torsion: Array,
    base: Array,
    *,
    atol: float,
    turn_atol: float,
    first: int = 0,
) -> None:
    """The rows of a curve are the derivatives of its nodes, spacings and frames; of these from a coordinate on."""
    coordinates = np.concatenate([vertices.reshape(-1), torsion])

    def at(z: Array) -> CurveRows:
        return shape.rows(z[: vertices.size].reshape(-1, 3), z[vertices.size :], base)

    rows = at(coordinates)
    for value, row in (("position", rows.position_rows), ("spacing", rows.spacing_rows)):
        wanted = central_differences(lambda z, name=value: getattr(at(z), name), coordinates)
        np.testing.assert_allclose(row, wanted, atol=atol)
    change = central_differences(lambda z: at(z).frame, coordinates)
    turning = np.cross(np.swapaxes(rows.spin_rows, 1, 2)[:, None], rows.frame.transpose(0, 2, 1)[:, :, None])
    if not shape.tracks_roll:
        change, turning = change[:, :, 2:], turning[:, 2:]
    found = turning.transpose(0, 3, 1, 2)
    np.testing.assert_allclose(found[..., first:], change[..., first:], atol=turn_atol)


def arm_problem(
    target: Any = (0.5, 0.2, 1.2),
    *,
    bays: int = 2,
    steps: int = 10,
    time: float = 10.0,
    truss: dict[str, Any] | None = None,
    waypoint: dict[str, Any] | None = None,
    **more: Any,
) -> Problem:
    """An octahedral arm that goes straight to a target; other tables by keyword, less what is None."""
    spec = {"module": "octahedral", "bays": bays, "stroke": [0.6, 1.5], **(truss or {})}
    point = {"time": time, "position": [float(x) for x in target], **(waypoint or {})}
    spec, point = ({k: v for k, v in table.items() if v is not None} for table in (spec, point))
    return Problem.from_dict(
        {"schema_version": 1, "truss": spec, "maneuver": {"steps": steps, "waypoint": [point]}, **more}
    )


def three_bays(**changes: Any) -> Problem:
    """An octahedral arm of three bays that bends over, without another try where it stops; changes by key path."""
    table = {
        "name": "three bays",
        "truss": {"module": "octahedral", "bays": 3, "stroke": [0.6, 1.5]},
        "curve": {"control_vertices": 4},
        "maneuver": {"steps": 15, "waypoint": [{"time": 4.0, "position": [0.9, 0.0, 1.9]}]},
        "clearance": {"safe": 0.05, "influence": 0.5},
        "method": {"retries": False},
    }
    return Problem.from_dict(table).replace(changes)
