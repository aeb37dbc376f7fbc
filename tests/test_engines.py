"""The fused engine against the plain one: one QP, two ways to its numbers, one answer."""

from __future__ import annotations

import numpy as np
import pytest
from arms import TRUSSES, make_layout, random_pose

from vgtm_qp.qp.fused import FusedSolver
from vgtm_qp.qp.graph import elimination_stages
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.qp.solvers import make_solver
from vgtm_qp.step.engine import FusedEngine, PlainEngine
from vgtm_qp.step.linearise import Linearisation, Target
from vgtm_qp.step.path import Path, rotation_from_vector
from vgtm_qp.truss.kinematics import Kinematics

ELIMINABLE = [name for name in TRUSSES if name != "graph"]
TRACKS = {"hexapod": ("position", "orientation"), "longeron": ("x", "pointing")}


def engines(name, *, joint_offset=0.0, **options):
    truss = TRUSSES[name](joint_offset=joint_offset)
    kinematics = Kinematics(truss)
    layout, task = make_layout(truss, kinematics, TRACKS.get(name, ("position",)), **options)
    stages = elimination_stages(layout)
    assert stages is not None
    plain = PlainEngine(Linearisation(layout, kinematics, task, truss.home_lengths), make_solver("daqp", layout))
    return layout, kinematics, plain, FusedEngine(FusedSolver(layout, stages, task.axes), task)


def make_step(layout, kinematics, rng, *, base=False):
    """A pose, the middle of a guessed motion, a curve and a target near them, and clearance rows that are active."""
    truss = layout.truss
    X = random_pose(truss, rng, 0.01)
    X[truss.base] = truss.home[truss.base]
    kinematics.evaluate(X)
    lengths = kinematics.lengths[truss.actuators].copy()
    here, rotation = kinematics.tip_position(X), kinematics.tip_rotation.copy()
    turn = rotation_from_vector([0.02, -0.01, 0.015])
    path = Path(np.array([0.0, 2.0]), np.stack([here, here + [0.03, 0.02, -0.02]]), np.stack([rotation, turn @ rotation]))
    moved = None
    if base:
        moved = truss.home @ rotation_from_vector([0.01, -0.02, 0.015]).T + [0.01, 0.0, 0.02]
    target = Target(path, 0.0, 1.0, lengths - 0.2, lengths + 0.2, 1.0, moved)
    height = truss.height
    vertices = np.linspace(0, 1, layout.vertices)[:, None] * [0.0, 0.0, height]
    vertices[2:] += 0.03 * rng.normal(size=vertices[2:].shape)
    normal = rng.normal(size=(3, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    nodes = truss.members[rng.integers(truss.member_count, size=(3, 2))].reshape(3, 4)
    share = rng.uniform(size=(3, 4, 1)) * [[1.0], [1.0], [-1.0], [-1.0]]
    rows = ClearanceRows(nodes, share * normal[:, None, :], np.full(3, -1.0), str)
    Y = X + 0.005 * rng.normal(size=X.shape)
    Y[truss.base] = X[truss.base]
    return X, Y, vertices, target, rows


def pressing(rows, answer):
    """The rows, each asking for a little more than a solution without them gives: some become active."""
    moved = np.where(np.isfinite(answer.nodes), answer.nodes, 0.0)
    value = np.einsum("rsc,rsc->r", rows.coefficients, moved[rows.nodes])
    return ClearanceRows(rows.nodes, rows.coefficients, value + [1e-4, -1e-2, -1e-2], rows.name)


def assert_same_answer(found, wanted, tolerance=1e-10):
    for which in ("nodes", "actuators", "vertices", "progress"):
        np.testing.assert_allclose(getattr(found, which), getattr(wanted, which), atol=tolerance, err_msg=which)


@pytest.mark.parametrize("base", [False, True])
@pytest.mark.parametrize("joint_offset", [0.0, 0.1])
@pytest.mark.parametrize("name", ELIMINABLE)
def test_both_engines_give_one_answer(name, joint_offset, base):
    layout, kinematics, plain, fused = engines(name, joint_offset=joint_offset)
    truss = layout.truss
    rng = np.random.default_rng(5)
    X, Y, vertices, target, rows = make_step(layout, kinematics, rng, base=base)
    for motion, progress in ((True, 0.0), (False, 0.7)):
        goal = target.path.at(progress)
        at = Y if motion else X
        free = plain.solve(X, at, vertices, target, goal, progress, rows, motion=motion)
        pressed = pressing(rows, free)
        answers = [
            engine.solve(X, at, vertices, target, goal, progress, pressed, motion=motion)
            for engine in (fused, plain)
        ]
        assert_same_answer(*answers)
        np.testing.assert_allclose(
            answers[0].clearance_multipliers, answers[1].clearance_multipliers, atol=1e-8
        )
        assert answers[0].clearance_multipliers.max() > 0.0
    near = truss.home + 1e-3 * rng.normal(size=X.shape)
    near[truss.base] = truss.home[truss.base]
    for pose in (truss.home, near):
        closed = [engine.close(pose, target, 1e-12) for engine in (fused, plain)]
        np.testing.assert_allclose(closed[0].X, closed[1].X, atol=1e-9)
        np.testing.assert_allclose(closed[0].lengths, closed[1].lengths, atol=1e-10)
