"""Elimination along the bays against the dense condensed QP: one problem, one answer, multipliers included."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from functools import cached_property

import casadi as ca
import modules
import numpy as np
import pytest
from arms import make_layout, mast, random_pose
from hypothesis import given, settings
from hypothesis import strategies as st
from steps import MOVED_BASE

from vgtm_qp.arm.truss import lengths
from vgtm_qp.arm.truss.build import lock_members
from vgtm_qp.arm.truss.kinematics import LengthRows
from vgtm_qp.errors import SolverError
from vgtm_qp.problem.method import Weights
from vgtm_qp.qp.condensed import CondensedSolver
from vgtm_qp.qp.linearise import Linearisation
from vgtm_qp.qp.long import working_set
from vgtm_qp.qp.long.chain import find_chain
from vgtm_qp.qp.long.select import chain_solver, prefers_staged
from vgtm_qp.qp.long.sparse_symbols import range_and_null
from vgtm_qp.qp.long.staged import StagedSolver
from vgtm_qp.qp.long.sweep import Sweep
from vgtm_qp.qp.long.tracked import TrackedSolver
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.qp.residual import InfeasibleStepError
from vgtm_qp.qp.settle import held, settling_gain
from vgtm_qp.qp.solvers import make_solver
from vgtm_qp.rotation import rotation_from_vector
from vgtm_qp.step.closing import Closing
from vgtm_qp.step.path import Path
from vgtm_qp.step.target import QPInput, Target

MODULES = {
    "octahedral": lambda **kw: modules.octahedral(4, **kw),
    "double-octahedral": lambda **kw: modules.double_octahedral(4, **kw),
    "hexapod": lambda **kw: modules.hexapod(4, **kw),
    "longeron": lambda **kw: modules.longeron(4, **kw),
    "tetrahedral-1": lambda **kw: modules.tetrahedral(4, actuated=(1,), **kw),
    "tetrahedral-23": lambda **kw: modules.tetrahedral(4, actuated=(2, 3), **kw),
    "tetrahedral-123": lambda **kw: modules.tetrahedral(4, longeron=1.1, **kw),
}
SQUARE = ["octahedral", "double-octahedral", "longeron", "tetrahedral-1"]


@pytest.fixture(autouse=True)
def _without_compiler(monkeypatch):
    """The virtual machine evaluates the same graphs; compiling a dozen of them would be most of the time."""
    monkeypatch.setenv("VGTM_CC", "none")


class Case:
    """A truss with a layout of its QP."""

    def __init__(self, truss, track=("position",), **options):
        self.truss = truss
        self.layout, _ = make_layout(truss, track, **options)

    @cached_property
    def kinematics(self):
        return self.layout.arm.kinematics()

    @cached_property
    def linearisation(self):
        return Linearisation(self.layout)


def random_numbers(
    case,
    rng,
    *,
    off=0.02,
    box=0.03,
    push=0.1,
    near=6,
    slack=0.02,
    base=False,
    motion=True,
):
    """One QP at a random pose: members off their lengths, narrow strokes, clearance rows on two members each."""
    layout, kinematics, truss = case.layout, case.kinematics, case.truss
    X = random_pose(truss, rng, off)
    X[truss.base] = truss.home[truss.base]
    kinematics.evaluate(X)
    home = kinematics.quantities + 1e-4 * rng.normal(size=truss.member_count)
    here, rotation = layout.arm.end_effector.position(X), kinematics.tip_rotation.copy()
    turn = rotation_from_vector(0.2 * push * rng.normal(size=3))
    path = Path(
        np.array([0.0, 1.0]),
        np.stack([here, here + push * rng.normal(size=3)]),
        np.stack([rotation, turn @ rotation]),
    )
    now = kinematics.quantities[truss.actuators]
    room = box * rng.uniform(0.2, 1.0, size=(2, len(now)))
    target = Target(path, 0.0, 1.0, now - room[0], now + room[1], 0.0, 1.0, MOVED_BASE if base else None)
    vertices = np.linspace(0, 1, layout.vertices)[:, None] * [0.0, 0.0, truss.height]
    vertices = vertices + off * rng.normal(size=vertices.shape)
    nodes = truss.members[rng.integers(truss.member_count, size=(near, 2))].reshape(near, 4)
    coefficients = rng.normal(size=(near, 4, 3)) * [[1.0], [1.0], [-1.0], [-1.0]]
    rows = ClearanceRows(nodes, coefficients, -slack * rng.uniform(size=near))
    progress = 0.0 if motion else 0.6
    asked = QPInput(X, X, vertices, np.zeros(0), target, path.at(progress), progress, rows, motion)
    return with_lengths(case.linearisation.numbers(asked.linear(layout), rows), layout, home, motion=motion)


def with_lengths(numbers, layout, home, *, motion):
    """The QP of an arm whose members are `home` (M,), m, long at home."""
    arm = layout.arm
    longer = home - arm.home_quantities
    rhs = numbers.motion.rhs + np.where(arm.actuated, 0.0, longer)
    centring = layout.weights.stroke_centring * longer[arm.actuators] if motion else 0.0
    return replace(
        numbers,
        motion=LengthRows(arm.truss, numbers.motion.gradient, rhs),
        actuator_gradient=numbers.actuator_gradient - centring,
    )


def outcome(solver, numbers):
    try:
        return solver.solve(numbers)
    except InfeasibleStepError:
        return "infeasible"


def assert_same(found, wanted):
    assert isinstance(found, str) == isinstance(wanted, str), (found, wanted)
    if isinstance(wanted, str):
        return
    for name in (
        "nodes",
        "actuators",
        "vertices",
        "progress",
        "actuator_multipliers",
        "clearance_multipliers",
    ):
        one, other = np.asarray(getattr(found, name)), np.asarray(getattr(wanted, name))
        np.testing.assert_allclose(one, other, atol=1e-9 * (1 + np.abs(other).max(initial=0.0)), err_msg=name)


def assert_same_answers(case, solver, count, rng, **options):
    """Compare over known QPs and over three that are drawn.

    Return how many strokes and clearances were active in the known ones, and how many of these had no answer.
    """
    dense, known = CondensedSolver(case.layout), np.random.default_rng(0)
    strokes = clearances = infeasible = 0
    for k in range(count + 3):
        numbers = random_numbers(case, known if k < count else rng, motion=k % 3 < 2, **options)
        wanted = outcome(dense, numbers)
        assert_same(outcome(solver, numbers), wanted)
        if k >= count:
            continue
        if isinstance(wanted, str):
            infeasible += 1
        else:
            strokes += np.count_nonzero(wanted.actuator_multipliers)
            clearances += np.count_nonzero(wanted.clearance_multipliers)
    return strokes, clearances, infeasible


@pytest.mark.parametrize("vertices", [5, 0])
@pytest.mark.parametrize("name", MODULES)
def test_elastic_answers_are_those_of_the_condensed_qp(name, vertices, rng):
    case = Case(MODULES[name](), vertices=vertices)
    solver = StagedSolver(find_chain(case.layout))
    strokes, clearances, infeasible = assert_same_answers(case, solver, 9, rng)
    assert strokes > 20
    assert clearances > 5
    assert infeasible < 5


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("hexapod", {"track": ("position", "orientation")}),
        ("octahedral", {"track": ("position", "pointing")}),
        ("longeron", {"track": ("x", "pointing")}),
    ],
)
@pytest.mark.parametrize("base", [False, True])
def test_tip_directions_and_a_moving_base(name, options, base, rng):
    case = Case(MODULES[name](), **options)
    solver = StagedSolver(find_chain(case.layout))
    found = assert_same_answers(case, solver, 6, rng, base=base, push=0.03, box=0.06)
    assert found[0] + found[1] > 0
    assert found[2] < 6


def test_offset_joints(rng):
    case = Case(modules.octahedral(4, joint_offset=0.05))
    solver = StagedSolver(find_chain(case.layout))
    assert sum(assert_same_answers(case, solver, 5, rng)) > 5


def test_other_weights(rng):
    weights = Weights(node_rate=0.0, actuator_rate=1.0, stroke_centring=0.0, tracking=3.0, tangent=0.7)
    case = Case(MODULES["octahedral"](), weights=weights)
    assert sum(assert_same_answers(case, StagedSolver(find_chain(case.layout)), 5, rng)) > 5


def test_locked_actuators_are_rows_of_their_own(rng):
    truss = lock_members(MODULES["octahedral"](), ["B2-1", "B4-3"])
    case = Case(truss)
    chain = find_chain(case.layout)
    assert [truss.member_names[k] for k in chain.locked] == ["B2-1", "B4-3"]
    assert sum(assert_same_answers(case, StagedSolver(chain), 6, rng)) > 5


@pytest.mark.parametrize("track", [("position",), ("position", "pointing")])
@pytest.mark.parametrize("name", SQUARE)
def test_hard_tracking_follows_the_curve(name, track, rng):
    case = Case(MODULES[name](), track, vertices=7, hard_tracking=True)
    chain = find_chain(case.layout)
    assert chain.is_square
    options = {"off": 0.005, "push": 0.02, "box": 0.3}
    _, clearances, infeasible = assert_same_answers(case, TrackedSolver(chain), 8, rng, **options)
    assert clearances > 0
    assert infeasible < 4
    strokes, *_ = assert_same_answers(case, TrackedSolver(chain), 8, rng, **{**options, "box": 0.06}, near=0)
    assert strokes > 0


def test_a_long_arm_with_many_rows_at_once(rng):
    case = Case(modules.octahedral(24), vertices=6)
    solver = StagedSolver(find_chain(case.layout))
    strokes, clearances, _ = assert_same_answers(case, solver, 3, rng, near=40, push=0.5, box=0.02)
    assert strokes > 60
    assert clearances > 5


@pytest.mark.smoke
@given(st.integers(0, 10**6), st.floats(0.005, 0.3), st.floats(0.0, 0.05), st.booleans())
@settings(max_examples=25, deadline=None)
def test_any_qp_of_one_arm(shared, seed, box, slack, motion):
    case, solver, dense = shared
    rng = np.random.default_rng(seed)
    numbers = random_numbers(case, rng, box=box, slack=slack, motion=motion, near=12)
    assert_same(outcome(solver, numbers), outcome(dense, numbers))


@pytest.fixture(scope="module")
def shared():
    case = Case(MODULES["octahedral"]())
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VGTM_CC", "none")
        solver = StagedSolver(find_chain(case.layout))
    return case, solver, CondensedSolver(case.layout)


def test_compiled_and_interpreted_recursions_agree(shared, monkeypatch, rng):
    monkeypatch.delenv("VGTM_CC")
    case, interpreted, _ = shared
    compiled = StagedSolver(find_chain(case.layout))
    numbers = random_numbers(case, rng)
    assert_same(compiled.solve(numbers), interpreted.solve(numbers))


def test_what_was_active_before_does_not_change_the_answer(shared, rng):
    case, solver, dense = shared
    several = [random_numbers(case, rng, near=9) for _ in range(3)]
    for numbers in several + several[::-1]:
        assert_same(outcome(solver, numbers), outcome(dense, numbers))


def test_rows_that_contradict_one_another_are_infeasible(shared, rng):
    case, solver, _ = shared
    numbers = random_numbers(case, rng, near=1)
    rows = numbers.clearance
    opposed = ClearanceRows(
        np.repeat(rows.nodes, 2, axis=0),
        np.concatenate([rows.coefficients, -rows.coefficients]),
        np.full(2, 1e-3),
    )
    with pytest.raises(InfeasibleStepError):
        solver.solve(replace(numbers, clearance=opposed))
    base = np.flatnonzero(case.truss.base)[:1]
    unmovable = ClearanceRows(np.full((1, 4), base), rows.coefficients, np.array([1e-3]))
    with pytest.raises(InfeasibleStepError):
        solver.solve(replace(numbers, clearance=unmovable))
    slack = replace(unmovable, lower=np.array([-1e-3]))
    assert outcome(solver, replace(numbers, clearance=slack)) != "infeasible"


@pytest.mark.parametrize("hard", [False, True])
def test_a_singular_bay_is_an_error(hard, rng):
    case = Case(MODULES["octahedral"](), vertices=7, hard_tracking=hard)
    solver = chain_solver(case.layout)
    numbers = random_numbers(case, rng, off=0.001, push=0.01, box=0.3)
    gradient, fixed = numbers.motion.gradient.copy(), case.truss.fixed
    gradient[fixed[8]] = gradient[fixed[9]] = 0.0
    with pytest.raises(SolverError):
        solver.solve(replace(numbers, motion=LengthRows(case.truss, gradient, numbers.motion.rhs)))
    assert solver.solve(numbers).progress > 0.9


def test_an_objective_without_terms_is_an_error(rng):
    weights = Weights(node_rate=0.0, actuator_rate=0.0, stroke_centring=0.0, tracking=0.0, tangent=0.0)
    case = Case(MODULES["octahedral"](), vertices=0, weights=weights)
    numbers = random_numbers(case, rng)
    with pytest.raises(SolverError, match="singular"):
        StagedSolver(find_chain(case.layout)).solve(numbers)


@pytest.mark.parametrize("hard", [False, True])
def test_a_wrong_answer_is_refused(hard, monkeypatch, rng):
    case = Case(MODULES["octahedral"](), vertices=7, hard_tracking=hard)
    solver = chain_solver(case.layout)
    numbers = random_numbers(case, rng, off=0.001, push=0.01, box=0.3)
    solver.solve(numbers)
    right = working_set.dual_solution
    monkeypatch.setattr(working_set, "dual_solution", lambda *a: (right(*a)[0] * (1 + 1e-4), 1))
    with pytest.raises(SolverError):
        solver.solve(numbers)
    monkeypatch.undo()
    unchanged = type(solver).displacements
    monkeypatch.setattr(type(solver), "displacements", lambda self: unchanged(self) * (1 + 1e-4) + 1e-4)
    with pytest.raises(SolverError, match="residual"):
        solver.solve(numbers)


@pytest.mark.parametrize("joint_offset", [0.0, 0.04])
@pytest.mark.parametrize("name", MODULES)
def test_the_periods_hold_the_whole_length_jacobian(name, joint_offset, rng):
    case = Case(MODULES[name](joint_offset=joint_offset))
    chain = find_chain(case.layout)
    layout = case.layout
    numbers = random_numbers(case, rng)
    data = StagedSolver(chain).data
    data.fill(numbers)
    values = data.part["jacobian"][::-1]
    pattern, rebuilt = chain.pattern, np.zeros((layout.node_columns, layout.node_columns))
    for period in range(chain.periods):
        block = np.zeros(pattern.shape)
        block.T[pattern.T] = values[period]
        before = chain.nodes[period - 1][chain.carried] if period else np.zeros(0, dtype=np.int64)
        columns = (
            layout.node_column[np.concatenate([before, chain.nodes[period]])][:, None] + np.arange(3)
        ).ravel()
        rebuilt[np.ix_(chain.members[period], columns)] = block[:, block.shape[1] - len(columns) :]
    np.testing.assert_allclose(rebuilt, numbers.motion.jacobian(), atol=1e-15)


@given(st.integers(0, 10**6))
@settings(max_examples=40, deadline=None)
def test_range_and_null_space_of_sparse_rows(seed):
    rng = np.random.default_rng(seed)
    rows, size = sorted(rng.integers(1, 9, size=2))
    pattern = rng.uniform(size=(rows, size)) < 0.4
    pattern[np.arange(rows), rng.permutation(size)[:rows]] = True
    values = np.where(
        pattern, rng.uniform(0.5, 2.0, size=(rows, size)) * rng.choice([-1, 1], (rows, size)), 0.0
    )
    if np.linalg.cond(values) > 1e6:
        return
    symbols = ca.SX.sym("A", ca.DM(values).sparsity())
    G, N = ca.Function("f", [symbols], [ca.densify(x) for x in range_and_null(symbols)])(ca.DM(values))
    G, N = np.array(G), np.array(N).reshape(size, -1)
    assert N.shape == (size, size - rows)
    np.testing.assert_allclose(values @ G, np.eye(rows), atol=1e-9)
    np.testing.assert_allclose(values @ N, 0.0, atol=1e-12)
    np.testing.assert_allclose(G.T @ N, 0.0, atol=1e-8)
    np.testing.assert_allclose(N.T @ N, np.eye(size - rows), atol=1e-12)


def test_a_sweep_is_a_recursion():
    carry, data = ca.SX.sym("carry", 2), ca.SX.sym("data", 1)
    function = ca.Function(
        "fibonacci", [carry, data], [ca.vertcat(carry[1], carry[0] + carry[1] + data), carry[0]]
    )
    sweep = Sweep(function, 8)
    sweep.carry[0] = [0.0, 1.0]
    for extra in (0.0, 1.0):
        sweep.inputs[1][:] = extra
        sweep()
        a, b = 0.0, 1.0
        for period in range(8):
            assert sweep.outputs[1][period] == a
            a, b = b, a + b + extra
        assert sweep.carry[-1].tolist() == [a, b]
    with pytest.raises(ValueError, match="16"):
        sweep.bind_output(0, np.zeros(3))


def test_memory_is_linear_in_the_bays():
    arrays = tracemalloc.DomainFilter(inclusive=True, domain=np.lib.tracemalloc_domain)

    def size(bays):
        chain = find_chain(Case(modules.octahedral(bays)).layout)
        tracemalloc.start()
        solver = StagedSolver(chain)
        found = tracemalloc.take_snapshot().filter_traces([arrays])
        tracemalloc.stop()
        assert solver.chain is chain
        return sum(trace.size for trace in found.traces)

    assert size(60) < 3.1 * size(20)


@pytest.mark.parametrize("joint_offset", [0.0, 0.02])
@pytest.mark.parametrize("is_wide", [False, True])
@pytest.mark.parametrize("name", [*MODULES, "graph"])
def test_lengths_by_a_band_and_by_a_sparse_matrix(name, is_wide, joint_offset, rng, monkeypatch):
    monkeypatch.setattr(lengths, "WIDEST", 0 if is_wide else lengths.WIDEST)
    truss = mast() if name == "graph" else MODULES[name](joint_offset=joint_offset)
    case = Case(truss, vertices=0)
    kinematics = case.kinematics
    kinematics.evaluate(random_pose(truss, rng, 0.02))
    error = rng.normal(size=truss.member_count)
    solver = lengths.LengthSolver(case.layout.arm.bays)
    step = solver.solve(kinematics.gradient, error)
    np.testing.assert_allclose(kinematics.motion().jacobian() @ step.ravel(), error, atol=1e-10)
    for wrong in (0.0, np.nan, np.inf):
        broken = kinematics.gradient.copy()
        broken[0] = wrong
        with pytest.raises(SolverError, match="singular"):
            solver.solve(broken, error)


def test_a_configuration_that_does_not_close_is_measured_where_it_is(rng):
    case = Case(MODULES["octahedral"](), vertices=0)
    closing, open_ = Closing(case.layout, case.kinematics), 0
    truss, arm = case.truss, case.layout.arm
    for _ in range(10):
        wanted = rng.uniform(0.6, 1.5, len(truss.actuators))
        q = truss.home + 0.5 * rng.normal(size=truss.home.shape) * ~truss.base[:, None]
        closed = closing.close(q, wanted, wanted, 1e-10, too_far=np.inf)
        if closed.error < np.inf:
            aims = truss.home_lengths.copy()
            aims[truss.actuators] = wanted
            np.testing.assert_allclose(closed.quantities, arm.measured(closed.q), rtol=1e-9)
            assert closed.error == pytest.approx(
                np.abs(aims - arm.measured(closed.q)).max(), rel=1e-9, abs=1e-9
            )
            open_ += closed.error > 1e-6
    assert open_


def test_the_gain_is_the_least_motion_of_the_tip(rng):
    case = Case(MODULES["octahedral"](), vertices=0)
    layout, truss, weights = case.layout, case.truss, case.layout.weights
    solver = StagedSolver(find_chain(case.layout))
    assert solver.gain(np.zeros(len(truss.actuators), dtype=bool)) is None
    stopped = 0
    for _ in range(4):
        numbers = random_numbers(case, rng, box=0.1, push=0.05, near=0)
        answer = solver.solve(numbers)
        at_bound = held(answer.actuators, numbers.lower, numbers.upper, 1.0)
        stopped += at_bound.sum()
        gain = solver.gain(at_bound)
        response = np.linalg.inv(numbers.motion.jacobian())[:, truss.actuators]
        tip = numbers.tip_jacobian @ response[(layout.node_column[truss.tip][:, None] + np.arange(3)).ravel()]
        stiffness = weights.actuator_rate + weights.stroke_centring
        hessian = weights.node_rate * response.T @ response + stiffness * np.eye(len(at_bound))
        wanted = settling_gain(hessian, tip, layout.levers, ~at_bound)
        assert (gain is None) == (wanted is None)
        if wanted is not None:
            np.testing.assert_allclose(gain, wanted, atol=1e-9 * np.abs(wanted).max())
    assert stopped > 0
    assert solver.gain(np.ones(len(truss.actuators), dtype=bool)) is None


def test_long_regular_arms_are_solved_along_the_chain():
    short = Case(modules.octahedral(5)).layout
    assert not prefers_staged(short)
    assert isinstance(make_solver("daqp", short), CondensedSolver)
    long = Case(modules.octahedral(24)).layout
    assert prefers_staged(long)
    assert isinstance(make_solver("daqp", long), StagedSolver)
    hard = Case(modules.octahedral(24), hard_tracking=True).layout
    assert isinstance(make_solver("daqp", hard), TrackedSolver)
    legs = Case(modules.hexapod(10), hard_tracking=True).layout
    assert chain_solver(legs) is None
    assert isinstance(make_solver("daqp", legs), CondensedSolver)
    every = Case(modules.octahedral(7)).layout
    irregular = replace(every, tracked=every.tracked[:3], curve_weights=every.curve_weights[:3])
    assert chain_solver(irregular) is None
