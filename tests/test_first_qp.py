"""What ``build`` shows is the QP that a step begins with: other solvers give it the step's own first answer."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import qpsolvers
from scipy import sparse
from steps import plain_arm

import vgtm_qp as vq
from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.problem import bundled_problems
from vgtm_qp.qp.residual import InfeasibleStepError
from vgtm_qp.step.chain_engine import ChainEngine
from vgtm_qp.step.engine import GeneralEngine

SOLVERS = {
    "clarabel": {"tol_gap_abs": 1e-14, "tol_gap_rel": 1e-14, "tol_feas": 1e-14},
    "piqp": {"eps_abs": 1e-13, "eps_rel": 1e-13, "eps_duality_gap_abs": 1e-13, "eps_duality_gap_rel": 1e-15},
    "osqp": {"eps_abs": 1e-10, "eps_rel": 1e-10, "max_iter": 400_000, "polishing": True},
}
TOLERANCES = {"piqp": 1e-7, "osqp": 1e-7, "clarabel": 2e-7}
"""At one state Clarabel is 1.2e-7 off, and its objective above that of the others, which agree to 3e-10."""
LOOSER = {
    "clarabel": dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), 1e-9),
    "piqp": {"eps_abs": 1e-10, "eps_rel": 1e-10},
    "osqp": {"eps_abs": 1e-8, "eps_rel": 1e-8, "max_iter": 400_000, "polishing": True},
}
"""Settings for solvers that stall: the rows of an arm that hardly moves any more nearly contradict one another."""
NEAR = 1e-5
"""Tolerance of answers with these."""
QPS = [name for name in bundled_problems() if vq.load_problem(name).method.name == "qp"]


@pytest.fixture(autouse=True)
def _without_a_compiler(monkeypatch):
    monkeypatch.setenv("VGTM_CC", "none")


def answer(qp, solver):
    """The answer of one of the solvers to the QP's own arrays, and its tolerance; None if it finds none."""
    equal = qp.row_lower == qp.row_upper
    sides, lower, upper = qp.A[~equal], qp.row_lower[~equal], qp.row_upper[~equal]
    below, above = np.isfinite(lower), np.isfinite(upper)
    problem = qpsolvers.Problem(
        sparse.csc_matrix(qp.P),
        qp.q,
        sparse.vstack([sides[above], -sides[below]]).tocsc(),
        np.concatenate([upper[above], -lower[below]]),
        sparse.csc_matrix(qp.A[equal]),
        qp.row_lower[equal],
        qp.column_lower,
        qp.column_upper,
    )
    with warnings.catch_warnings():
        # Tolerances as tight as these end with a solver's remark that it came no nearer.
        warnings.simplefilter("ignore")
        for settings, tolerance in ((SOLVERS, TOLERANCES[solver]), (LOOSER, NEAR)):
            found = qpsolvers.solve_problem(problem, solver, **settings[solver])
            if found.found:
                return found.x, tolerance
    return None


def first_answer(resolver, asked):
    """The answer of the first QP of a step, None if it has none; the state stays."""
    state, engine, found = resolver.state, resolver.setup.engine, []
    solve = engine.solve

    def watched(question):
        try:
            found.append(solve(question))
        except InfeasibleStepError:
            found.append(None)
            raise
        return found[-1]

    engine.solve = watched
    try:
        resolver.step(**asked)
    finally:
        del engine.solve
        resolver.state = state
    return found[0]


@pytest.mark.dear
@pytest.mark.parametrize(("name", "limit"), [*((name, None) for name in QPS), ("five_bay_two_cubes", 0.03)])
def test_other_solvers_give_the_first_answer_of_the_step(name, limit):
    problem = vq.load_problem(name)
    if limit:
        problem = problem.replace({"method.step_limit": limit})
    resolver = vq.Resolver(plain_arm(problem))
    plan, compared, task = make_plan(problem, *resolver.tip()), 0, resolver.setup.task
    value = plan.path.start
    for number, mark in enumerate(plan.marks[1:]):
        goal = plan.path.at(float(mark))
        asked = {"position": goal.position}
        if task.turns == "pointing":
            asked["pointing"] = goal.rotation[:, 2]
        qp = resolver.build(**asked)
        wanted = first_answer(resolver, asked)
        answers = {solver: answer(qp, solver) for solver in SOLVERS}
        if wanted is None:
            assert not any(answers.values()), f"state {number}"
        else:
            columns = [label.kind for label in qp.columns]
            of = {kind: np.array([k == kind for k in columns]) for kind in set(columns)}
            parts = {
                "actuator displacement": wanted.actuators,
                "progress": [wanted.progress],
                "node displacement": wanted.nodes[resolver.setup.arm.free].reshape(-1),
                "vertex displacement": wanted.vertices.reshape(-1),
            }
            for solver, (z, tolerance) in answers.items():
                for kind, values in parts.items():
                    if kind not in of:
                        continue
                    where = f"{solver}, state {number}, {kind}"
                    np.testing.assert_allclose(z[of[kind]], values, atol=tolerance, rtol=0.0, err_msg=where)
            compared += 1
        step = resolver.follow(plan.path, value, float(mark))
        if not step.moved:
            break
        value += step.progress * (float(mark) - value)
    assert compared > 0


def test_what_jams_now_or_within_the_step_is_in_the_qp_that_is_shown() -> None:
    problem = vq.load_problem("actuator_jams")
    assert problem.truss is not None
    jam = max(problem.truss.locked, key=lambda lock: lock.time)
    resolver, plan = vq.Resolver(problem), make_plan(problem, *vq.Resolver(problem).tip())
    names = [resolver.setup.arm.quantity_names[k] for k in resolver.setup.arm.actuators]
    column = names.index(jam.member)
    value, dt = plan.path.start, resolver.setup.dt
    while resolver.state.time < jam.time - 1e-9:
        ends = resolver.build(dt=dt)
        left = min(jam.time - resolver.state.time, dt)
        k = [c.kind for c in ends.columns].index("actuator displacement") + column
        assert ends.column_upper[k] - ends.column_lower[k] > 1e-3 * left
        aim, step_dt = plan.next_mark(value)
        step = resolver.follow(plan.path, value, aim, dt=step_dt)
        value += step.progress * (aim - value)
    shown = resolver.build()
    assert shown.column_lower[k] == pytest.approx(0.0, abs=1e-12)
    assert shown.column_upper[k] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("bays", [5, 24])
@pytest.mark.parametrize("error", [vq.SolverError, InfeasibleStepError])
def test_a_step_that_a_qp_without_an_answer_blocks_carries_that_qp(bays, error, monkeypatch):
    # A tip that must be on time tries no shorter pieces of its path.
    changes = {"truss.bays": bays, "method.tracking_mode": "elastic", "end_effector.mode": "hard"}
    resolver = vq.Resolver(vq.load_problem("five_bay_free").replace(changes))
    goal = resolver.tip()[0] + np.array([0.01, 0.02, -0.01])
    shown = resolver.build(position=goal)

    def fails(*_):
        raise error("the arm is in a singular pose")

    for engine in (GeneralEngine, ChainEngine):
        monkeypatch.setattr(engine, "solve", fails)
    step = resolver.step(position=goal)
    assert not step.moved
    assert isinstance(step.failure, error)
    assert step.failed_qp is not None
    assert abs(step.failed_qp.P - shown.P).max() < 1e-12
    assert abs(step.failed_qp.A - shown.A).max() < 1e-12
    for name in ("q", "row_lower", "row_upper", "column_lower", "column_upper"):
        np.testing.assert_allclose(getattr(step.failed_qp, name), getattr(shown, name), atol=1e-12, rtol=0.0)
