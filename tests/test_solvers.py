"""Dense solvers by name: their answers are DAQP's, whatever rows come and go, and OSQP keeps its workspace."""

from __future__ import annotations

import numpy as np
import osqp
import pytest

import vgtm_qp as vq
from vgtm_qp.qp.daqp import DAQP
from vgtm_qp.qp.dense import EQUALITY, DenseAnswer, DenseQP, residuals
from vgtm_qp.qp.numbers import UNBOUNDED
from vgtm_qp.qp.osqp import AGAIN, FIRST, Osqp
from vgtm_qp.qp.residual import AnswerError, InfeasibleStepError, refuse_large
from vgtm_qp.qp.solvers import available_solvers, dense_solver
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.chain_engine import ChainEngine
from vgtm_qp.step.engine import FusedEngine

OTHERS = [name for name in available_solvers() if name != "daqp"]
SIZE, BOUNDED = 9, 6


def random_qp(rng, rows, *, bounded=BOUNDED):
    """A feasible QP: two equalities, then rows with a lower, an upper and both bounds in turn; some are active."""
    root = rng.normal(size=(SIZE, SIZE))
    constraint = rng.normal(size=(rows, SIZE))
    inside = 0.1 * rng.normal(size=SIZE)
    values = np.concatenate([inside[:bounded], constraint @ inside])
    lower = values - rng.uniform(0.0, 0.1, len(values))
    upper = values + rng.uniform(0.0, 0.1, len(values))
    equal = slice(bounded, bounded + 2)
    lower[equal] = upper[equal] = values[equal]
    upper[bounded + 2 :: 3], lower[bounded + 3 :: 3] = UNBOUNDED, -UNBOUNDED
    sense = np.zeros(len(values), dtype=np.int32)
    sense[equal] = EQUALITY
    hessian = root @ root.T + 0.1 * np.eye(SIZE)
    return DenseQP(hessian, rng.normal(size=SIZE), constraint, lower, upper, sense)


@pytest.fixture
def set_ups(monkeypatch):
    """Numbers of rows for which OSQP was set up."""
    found, set_up = [], osqp.OSQP.setup

    def counted(self, P, q, A, *bounds, **settings):
        found.append(A.shape[0])
        return set_up(self, P, q, A, *bounds, **settings)

    monkeypatch.setattr(osqp.OSQP, "setup", counted)
    return found


@pytest.mark.parametrize("bounded", [0, BOUNDED, SIZE])
@pytest.mark.parametrize("name", OTHERS)
def test_every_solver_has_daqp_s_answer(name, bounded):
    rng, solver, active = np.random.default_rng(1), dense_solver(name), 0
    for rows in (5, 2, 11, 4, 3):
        qp = random_qp(rng, rows, bounded=bounded)
        found, wanted = solver.ask(qp), DAQP.ask(qp)
        refuse_large(*residuals(wanted, qp), wanted.status)
        np.testing.assert_allclose(found.x, wanted.x, atol=1e-6)
        np.testing.assert_allclose(found.multipliers, wanted.multipliers, atol=1e-5)
        active += np.count_nonzero(wanted.multipliers)
    assert active > 15


@pytest.mark.parametrize("name", ["daqp", *OTHERS])
def test_rows_that_contradict_one_another_are_infeasible(name):
    qp = random_qp(np.random.default_rng(2), 4)
    constraint, lower, upper = qp[2:5]
    constraint[3] = constraint[2]
    lower[-2:], upper[-2:] = (-UNBOUNDED, 0.1), (0.0, UNBOUNDED)
    with pytest.raises(InfeasibleStepError):
        dense_solver(name).ask(qp)


def test_osqp_is_set_up_once_and_grows_by_doubling(set_ups):
    rng, solver = np.random.default_rng(3), Osqp()
    for rows in (4, 12, 2, 9, 13, 24, 3, 25, 30):
        qp = random_qp(rng, rows)
        np.testing.assert_allclose(solver.ask(qp).x, DAQP.ask(qp).x, atol=1e-7)
    assert set_ups == [BOUNDED + capacity for capacity in (12, 24, 48)]


def test_osqp_starts_from_its_last_answer_also_with_more_rows():
    solver = Osqp()
    qp = random_qp(np.random.default_rng(4), 4)
    cold, again = solver.ask(qp), solver.ask(qp._replace(gradient=qp.gradient + 1e-6))
    open_ends = np.full(9, UNBOUNDED)
    more = solver.ask(
        qp._replace(
            constraint=np.concatenate([qp.constraint, np.zeros((9, SIZE))]),
            lower=np.concatenate([qp.lower, -open_ends]),
            upper=np.concatenate([qp.upper, open_ends]),
            sense=np.concatenate([qp.sense, np.zeros(9, dtype=np.int32)]),
        )
    )
    assert max(again.iterations, more.iterations) < cold.iterations
    np.testing.assert_allclose(more.x, cold.x, atol=1e-9)


def test_osqp_tries_again_where_the_first_answer_is_not_accurate(set_ups, monkeypatch):
    monkeypatch.setitem(FIRST, "max_iter", 10)
    rng, solver = np.random.default_rng(5), Osqp()
    for _ in range(3):
        qp = random_qp(rng, 4)
        answer = solver.ask(qp)
        assert max(residuals(answer, qp)) <= solver.accuracy
    assert 1 < len(set_ups) <= 1 + len(AGAIN)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
@pytest.mark.parametrize("part", range(5))
@pytest.mark.parametrize("name", OTHERS)
def test_what_is_not_a_number_is_refused_and_forgotten(name, part, wrong):
    solver, rng = dense_solver(name), np.random.default_rng(6)
    qp = random_qp(rng, 4)
    spoilt = DenseQP(*(array.copy() for array in qp))
    spoilt[part].flat[0] = wrong
    with pytest.raises(AnswerError, match="NaN"):
        solver.ask(spoilt)
    np.testing.assert_allclose(solver.ask(qp).x, DAQP.ask(qp).x, atol=1e-6)


@pytest.mark.parametrize("name", ["osqp", "piqp"])
def test_named_solvers_have_the_engines_of_daqp(name):
    problem = vq.load_problem("five_bay_free").replace({"method.solver": name})
    assert isinstance(build_arm(problem).engine, FusedEngine)
    long = problem.replace({"truss.bays": 24, "method.tracking_mode": "elastic"})
    assert isinstance(build_arm(long).engine, ChainEngine)


@pytest.mark.parametrize("mode", ["hard", "elastic"])
def test_a_long_arm_goes_the_same_way_with_every_solver(mode):
    problem = vq.load_problem("ten_bay_round_a_cube").replace(
        {"truss.bays": 24, "method.tracking_mode": mode, "maneuver.steps": 200, "method.retries": False}
    )
    wanted: list[np.ndarray] = []
    for name in available_solvers():
        resolver = vq.Resolver(problem.replace({"method.solver": name}))
        tip = resolver.tip()[0]
        for k in range(1, 5):
            step = resolver.step(position=tip + k * np.array([0.3, 0.05, -0.1]))
            assert step.status in ("reached", "slowed")
        nodes = resolver.state.nodes
        wanted = wanted or [nodes]
        np.testing.assert_allclose(nodes, wanted[0], atol=1e-5, err_msg=name)
        assert np.abs(nodes - resolver.setup.arm.home).max() > 0.1


def test_osqp_is_set_up_a_few_times_in_a_maneuver_with_many_blocked_qps(monkeypatch):
    """Where polishing fails, further tries use workspaces that are kept."""
    counts = {"setup": 0, "solve": 0}
    for name in counts:
        own = getattr(osqp.OSQP, name)

        def counted(self, *args, _own=own, _name=name, **options):
            counts[_name] += 1
            return _own(self, *args, **options)

        monkeypatch.setattr(osqp.OSQP, name, counted)
    monkeypatch.setenv("VGTM_CC", "none")
    problem = vq.load_problem("snake_past_a_cube").replace({"method.solver": "osqp"})
    assert vq.solve(problem).status == "solved"
    assert counts["solve"] > 50, counts
    assert counts["setup"] < 0.1 * counts["solve"]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("part", ["x", "multipliers"])
def test_an_answer_beyond_all_numbers_is_refused(part):
    """Its square would overflow, and its dual residual over that be zero."""
    answer = DenseAnswer(np.zeros(2), np.zeros(2), 0, "a solver")
    answer = answer._replace(**{part: np.array([1e194, 0.0])})
    bounds = np.full(2, -1e30), np.full(2, 1e30), np.zeros(2, dtype=np.int32)
    qp = DenseQP(np.eye(2), np.ones(2), np.zeros((0, 2)), *bounds)
    with pytest.raises(AnswerError):
        refuse_large(*residuals(answer, qp), answer.status)
