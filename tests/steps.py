"""One step of an arm to ask an engine for, and what two engines' answers have in common."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import piqp
import pytest
import qpsolvers
import scipy.sparse
from arms import make_layout, random_pose
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Kinematics, Pose
from vgtm_qp.curve.families import make_family
from vgtm_qp.problem import Problem
from vgtm_qp.qp.answer import StepSolution
from vgtm_qp.qp.full import FullBuilder, StepQP
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.linearise import Linearisation
from vgtm_qp.qp.numbers import ClearanceRows, StepNumbers
from vgtm_qp.qp.residual import InfeasibleStepError
from vgtm_qp.qp.shape import CurveShape
from vgtm_qp.qp.solvers import make_solver
from vgtm_qp.rotation import rotation_from_vector
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.engine import GeneralEngine
from vgtm_qp.step.path import Path
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.target import QPInput, Target

Array = NDArray[np.float64]


def drives_nothing(patch: pytest.MonkeyPatch) -> None:
    """Let every step of the resolvers made from now on be an attempt, none be taken in one call."""
    patch.setattr("vgtm_qp.step.attempt.can_drive", lambda _: False)


def plain_arm(problem: Problem, *, compiled: bool = True) -> Setup:
    """The arm of a problem with the general engine, which does not step in one call of C; its answers are the same."""
    setup = build_arm(problem, solves=False)

    def engine(layout: Layout) -> GeneralEngine:
        solver = make_solver(setup.solver, layout)
        return GeneralEngine(layout, setup.kinematics, setup.task, solver, compiled=compiled)

    elastic = setup.elastic and cache(lambda: engine(setup.layout.giving_way()))
    return replace(setup, engine=engine(setup.layout), elastic=elastic)


MOVED_BASE = Pose(np.array([0.01, 0.0, 0.02]), rotation_from_vector([0.01, -0.02, 0.015]))
"""A base that turned and moved a little."""


SHAPES: dict[str, dict[str, Any]] = {
    "arc-length": {"by_arc_length": True},
    "torsion": {"torsion": 2, "tracks_roll": True},
    "spacing": {"spacing": True},
    "everything": {"by_arc_length": True, "torsion": 1, "tracks_roll": True, "spacing": True},
}


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
    arm, tip = layout.arm, layout.arm.end_effector
    truss = arm.truss
    X = random_pose(truss, rng, 0.01)
    X[arm.base] = arm.home[arm.base]
    kinematics.evaluate(X)
    lengths = kinematics.quantities[arm.actuators].copy()
    here, rotation = tip.position(X), kinematics.tip_rotation.copy()
    turn = rotation_from_vector([0.02, -0.01, 0.015])
    path = Path(
        np.array([0.0, 2.0]),
        np.stack([here, here + np.array([0.03, 0.02, -0.02])]),
        np.stack([rotation, turn @ rotation]),
    )
    target = Target(path, 0.0, 1.0, lengths - 0.2, lengths + 0.2, 1.0, 1.0, MOVED_BASE if base else None)
    vertices = np.linspace(0, 1, layout.vertices)[:, None] * [0.0, 0.0, arm.height]
    vertices[2:] += 0.03 * rng.normal(size=vertices[2:].shape)
    normal = rng.normal(size=(3, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    pairs = [rng.choice(truss.member_count, 2, replace=False) for _ in range(3)]
    nodes = truss.members[np.array(pairs)].reshape(3, 4)
    share = rng.uniform(size=(3, 4, 1)) * [[1.0], [1.0], [-1.0], [-1.0]]
    rows = ClearanceRows(nodes, share * normal[:, None, :], np.full(3, -1.0), str)
    Y = X + 0.005 * rng.normal(size=X.shape)
    Y[arm.base] = X[arm.base]
    return X, Y, vertices, target, rows


def pressing(rows: ClearanceRows, answer: StepSolution) -> ClearanceRows:
    """The rows, each asking for a little more than a solution without them gives: some become active."""
    moved = np.where(np.isfinite(answer.nodes), answer.nodes, 0.0)
    value = np.einsum("rsc,rsc->r", rows.coefficients, moved[rows.nodes])
    return ClearanceRows(rows.nodes, rows.coefficients, value + np.array([1e-4, -1e-2, -1e-2]), rows.name)


def answers(engines: Iterable[Any], asked: QPInput) -> list[StepSolution] | None:
    """Every engine's answer; none where rows drawn at random contradict one another, which all have to say."""
    found: list[StepSolution] = []
    refused = []
    for engine in engines:
        try:
            found.append(engine.solve(asked))
        except InfeasibleStepError:
            refused.append(engine)
    assert not (found and refused), refused
    return found or None


def assert_same_answer(found: Any, wanted: Any, tolerance: float = 1e-10) -> None:
    """Nodes, actuators, curve and progress are the same."""
    for which in ("nodes", "actuators", "vertices", "progress"):
        np.testing.assert_allclose(
            getattr(found, which), getattr(wanted, which), atol=tolerance, err_msg=which
        )


def numbers_at(
    setup: Setup,
    q: Array,
    vertices: Array,
    target: Target,
    progress: float,
    rows: ClearanceRows,
    *,
    motion: bool,
) -> StepNumbers:
    """The numbers of the QP of an arm at a configuration, as the general engine has them."""
    at = QPInput(q, q, vertices, setup.torsion, target, target.goal(progress), progress, rows, motion)
    return Linearisation(setup.layout, compiled=False).numbers(at.linear(setup.layout), rows)


class WholeSolver:
    """Solves the whole QP of a step, not condensed, by PIQP behind qpsolvers: the oracle of all other forms."""

    settles = "equalities"

    def __init__(self, layout: Layout) -> None:
        self.builder = FullBuilder(layout)

    def solve(self, numbers: StepNumbers) -> StepSolution:
        qp = self.builder.build(numbers)
        z, y = solved(qp)
        return self.builder.solution(z, y, -(qp.P @ z + qp.q + qp.A.T @ y), 0)

    def gain(self, held: NDArray[np.bool_]) -> Array | None:
        return None


def solved(qp: StepQP) -> tuple[Array, Array]:
    """Answer and multipliers of the rows of a whole QP, by PIQP behind qpsolvers."""
    equal = qp.row_lower == qp.row_upper
    sides = qp.A[~equal]
    G = scipy.sparse.vstack([sides, -sides]).tocsr()
    h = np.concatenate([qp.row_upper[~equal], -qp.row_lower[~equal]])
    kept = np.isfinite(h)
    problem = qpsolvers.Problem(
        scipy.sparse.csc_matrix(qp.P),
        qp.q,
        scipy.sparse.csc_matrix(G[kept]),
        h[kept],
        scipy.sparse.csc_matrix(qp.A[equal]),
        qp.row_lower[equal],
        qp.column_lower,
        qp.column_upper,
    )
    gap = {"eps_duality_gap_abs": 1e-13, "eps_duality_gap_rel": 1e-13}
    found = qpsolvers.solve_problem(problem, solver="piqp", eps_abs=1e-10, eps_rel=1e-12, **gap)
    if not found.found and found.extras["info"].status == piqp.PIQP_PRIMAL_INFEASIBLE:
        raise InfeasibleStepError("the hard rows of the step contradict one another")
    assert found.found
    multipliers, of_sides = np.zeros(len(equal)), np.zeros(len(h))
    of_sides[kept] = found.z
    above, below = np.split(of_sides, 2)
    multipliers[equal], multipliers[~equal] = found.y, above - below
    return np.asarray(found.x), multipliers


def curved(truss, track, curve="tables", family="bezier", weights=None):
    """A layout whose curve is plain tables, absent, held by the stations, of a shape, or drawn to goals."""
    layout, _ = make_layout(truss, track, vertices=0 if curve == "none" else 6, weights=weights)
    if curve in SHAPES:
        return shaped(layout, curve, family=family)
    if curve in ("hard", "hard turns"):
        return replace(layout, hard_tracking=True, hard_turns=curve == "hard turns")
    if curve == "hard torsion":
        return shaped(layout, "torsion", family=family, hard=True)
    return shaped(layout, family=family, goals=(2, 4)) if curve == "drawn" else layout


def asked_at_random(layout, seed, *, base, progress, motion):
    """What a QP is asked for at a configuration, its Jacobians at another one, and its clearance rows."""
    rng = np.random.default_rng(seed)
    X, Y, vertices, target, rows = make_step(layout, layout.arm.kinematics(compiled=False), rng, base=base)
    goals = np.full(vertices.shape, np.nan)
    if layout.vertex_goals:
        goals[2], goals[4] = vertices[2] + [0.3, 0.0, 0.0], vertices[4] + [0.0, 0.002, 0.0]
    target, torsion = replace(target, vertex_goals=goals), 0.1 * rng.normal(size=layout.torsion)
    goal = target.goal(progress)
    return QPInput(X, Y, vertices, torsion, target, goal, progress, rows, motion).linear(layout), rows
