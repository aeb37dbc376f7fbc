"""Steps of small arms at random poses, for the tests of what linearises and solves them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import piqp
from arms import random_pose
from numpy.typing import NDArray
from scipy import sparse

from vgtm_qp.arm.arm import Kinematics, Pose
from vgtm_qp.curve.families import make_family
from vgtm_qp.qp.full import StepQP
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import ClearanceRows, StepSolution
from vgtm_qp.qp.shape import CurveShape
from vgtm_qp.rotation import rotation_from_vector
from vgtm_qp.step.path import Path
from vgtm_qp.step.separation import Distances, Separation
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.target import QPInput, Target

Array = NDArray[np.float64]

SHAPES: dict[str, dict[str, Any]] = {
    "arc-length": {"by_arc_length": True},
    "torsion": {"torsion": 2, "tracks_roll": True},
    "spacing": {"spacing": True},
    "everything": {"by_arc_length": True, "torsion": 1, "tracks_roll": True, "spacing": True},
}

BASE_POSE = Pose(np.array([0.01, 0.0, 0.02]), rotation_from_vector([0.01, -0.02, 0.015]))


def shaped(
    layout: Layout,
    shape: str | None = None,
    *,
    family: str = "bezier",
    goals: tuple[int, ...] = (),
    hard: bool = False,
    **weights: float,
) -> Layout:
    """The layout with a curve that is more than its tables."""
    curve = make_family(family, layout.vertices)
    nodes = layout.tracked / layout.tracked[-1]
    options = dict(SHAPES[shape]) if shape else {}
    if options.pop("spacing", False):
        options["spacing"] = np.full(len(nodes), 0.7)
    options["roll"] = np.linspace(0.1, -0.2, len(nodes))
    return replace(
        layout,
        curve_weights=curve.weights(nodes),
        curve_slopes=curve.weights(nodes, 1),
        shape=CurveShape(curve, nodes, **options),
        vertex_goals=goals,
        hard_tracking=hard,
        hard_turns=hard,
        weights=layout.weights.model_copy(update={"spacing": 0.3, **weights}),
    )


def make_step(
    layout: Layout, kinematics: Kinematics, rng: np.random.Generator, *, base: bool = False
) -> tuple[Array, Array, Array, Target, ClearanceRows]:
    """A pose, the middle of a guessed motion, a curve and a target near them, and clearance rows that are active."""
    arm: Any = layout.arm
    truss = arm.truss
    X = random_pose(truss, rng, 0.01)
    X[truss.base] = truss.home[truss.base]
    kinematics.evaluate(X)
    lengths = kinematics.quantities[truss.actuators].copy()
    here, rotation = arm.end_effector.position(X), kinematics.tip_rotation.copy()
    turn = rotation_from_vector([0.02, -0.01, 0.015])
    path = Path(
        np.array([0.0, 2.0]),
        np.stack([here, here + np.array([0.03, 0.02, -0.02])]),
        np.stack([rotation, turn @ rotation]),
    )
    pose = BASE_POSE if base else None
    target = Target(path, 0.0, 1.0, lengths - 0.2, lengths + 0.2, 1.0, pose)
    vertices = np.linspace(0, 1, layout.vertices)[:, None] * [0.0, 0.0, arm.height]
    vertices[2:] += 0.03 * rng.normal(size=vertices[2:].shape)
    normal = rng.normal(size=(3, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    nodes = truss.members[rng.integers(truss.member_count, size=(3, 2))].reshape(3, 4)
    share = rng.uniform(size=(3, 4, 1)) * [[1.0], [1.0], [-1.0], [-1.0]]
    rows = ClearanceRows(nodes, share * normal[:, None, :], np.full(3, -1.0), str)
    Y = X + 0.005 * rng.normal(size=X.shape)
    Y[truss.base] = X[truss.base]
    return X, Y, vertices, target, rows


def asked_at(
    q: Array,
    vertices: Array,
    target: Target,
    progress: float,
    rows: ClearanceRows | None = None,
    *,
    at: Array | None = None,
    torsion: Array | None = None,
    motion: bool = True,
) -> QPInput:
    """What a QP is asked for at a configuration; Jacobians are taken there too, by default."""
    return QPInput(
        q,
        q if at is None else at,
        vertices,
        np.zeros(0) if torsion is None else torsion,
        target,
        target.goal(progress),
        progress,
        ClearanceRows() if rows is None else rows,
        motion,
    )


def pressing(rows: ClearanceRows, answer: StepSolution) -> ClearanceRows:
    """The rows, each asking for a little more than a solution without them gives: some become active."""
    moved = np.where(np.isfinite(answer.nodes), answer.nodes, 0.0)
    value = np.einsum("rsc,rsc->r", rows.coefficients, moved[rows.nodes])
    return ClearanceRows(rows.nodes, rows.coefficients, value + np.array([1e-4, -1e-2, -1e-2]), rows.name)


def assert_same_answer(found: StepSolution, wanted: StepSolution, tolerance: float = 1e-10) -> None:
    """Compare the displacements of two answers."""
    for which in ("nodes", "actuators", "vertices", "progress"):
        np.testing.assert_allclose(
            getattr(found, which), getattr(wanted, which), atol=tolerance, err_msg=which
        )


def answer_of(qp: StepQP) -> tuple[Array, Array, Array]:
    """The whole QP's unknowns by PIQP, tightly, and the multipliers of rows and columns."""
    equal = qp.row_lower == qp.row_upper
    solver = piqp.SparseSolver()
    solver.settings.eps_abs = 1e-10
    solver.settings.eps_rel = 1e-12
    solver.settings.eps_duality_gap_abs = solver.settings.eps_duality_gap_rel = 1e-13
    solver.setup(
        qp.P,
        qp.q,
        sparse.csc_matrix(qp.A[equal]),
        qp.row_lower[equal],
        sparse.csc_matrix(qp.A[~equal]),
        qp.row_lower[~equal],
        qp.row_upper[~equal],
        qp.column_lower,
        qp.column_upper,
    )
    solver.solve()
    y, z = np.zeros(len(qp.row_lower)), np.array(solver.result.x)
    y[equal] = solver.result.y
    y[~equal] = solver.result.z_u - solver.result.z_l
    return z, y, -(qp.P @ z + qp.q + qp.A.T @ y)


def separation_of(setup: Setup, **distances: float) -> Separation:
    """What keeps an arm apart from what is around it; with the margin of its problem, or that in `distances`."""
    kept = {"margin": setup.margin, **distances}
    return Separation(
        setup.arm, setup.monitor, Distances(setup.safe, setup.self_safe, setup.influence, **kept)
    )
