"""The QP of a step: full and condensed forms agree, answers satisfy KKT, wrong answers are refused."""

from __future__ import annotations

import itertools
from dataclasses import replace
from operator import attrgetter

import numpy as np
import oracle
import pytest
from arms import TRUSSES, make_layout, random_pose
from scipy.spatial.transform import Rotation
from steps import WholeSolver

import vgtm_qp as vq
from vgtm_qp.arm.arm import Pose
from vgtm_qp.arm.truss.arm import TrussArm
from vgtm_qp.errors import SolverError, VgtmError
from vgtm_qp.problem.method import Weights
from vgtm_qp.qp.answer import StepSolution
from vgtm_qp.qp.condensed import CondensedSolver
from vgtm_qp.qp.daqp import DAQP
from vgtm_qp.qp.dense import DenseAnswer, DenseQP, DenseSolver, answered, residuals
from vgtm_qp.qp.full import FullBuilder
from vgtm_qp.qp.linearise import Linearisation, StepInput
from vgtm_qp.qp.numbers import ClearanceRows, Legs, StepNumbers
from vgtm_qp.qp.residual import InfeasibleStepError, refuse_large
from vgtm_qp.qp.solvers import available_solvers, make_solver
from vgtm_qp.rows.tip import TipGoal

SOLVERS = ["daqp", "osqp", "piqp", "clarabel"]
# Their own tolerances would leave residuals that the check refuses; the library sets others.
TIGHTENED = ["clarabel", "proxqp", "scs"]
CURVES = ["none", "elastic", "hard"]

# Faces that can keep to a curve exactly beside the tip's three rows: one less than would use up the motions.
HARD = {"octahedral", "hexapod", "longeron", "tetrahedral-23", "tetrahedral-123"}

CASES = [(name, curve) for name in TRUSSES for curve in CURVES if curve != "hard" or name in HARD]


# A tip of one node has no direction.
TRACKS = [("position",), ("x", "z", "pointing"), ("y", "orientation")]
LINEAR = [(*case, track) for case in CASES for track in TRACKS[: 1 if case[0] == "graph" else 3]]


def make_case(name, curve="elastic", *, seed=0, rows=5, joint_offset=0.0):
    """A layout and random numbers of its QP: feasible, with bounds and clearance rows near active."""
    rng = np.random.default_rng(seed)
    truss = TRUSSES[name](joint_offset=joint_offset)
    arm = TrussArm(truss)
    kinematics = arm.kinematics(compiled=False)
    track = ("position",)
    if curve == "hard":
        track = ("z",)
    layout, task = make_layout(
        arm, track, vertices=0 if curve == "none" else 6, hard_tracking=curve == "hard"
    )
    X = random_pose(truss, rng, 0.03)
    kinematics.evaluate(X)
    count, vertices, tracked = len(truss.actuators), layout.vertices, len(layout.tracked)

    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0][:2]
    actuators = 0.02 * rng.normal(size=count)
    progress = 0.6
    length_rhs = np.where(truss.actuated, 0.0, 0.002 * rng.normal(size=truss.member_count))
    change = length_rhs.copy()
    change[truss.actuators] += actuators
    nodes = np.zeros_like(X)
    nodes[truss.free] = np.linalg.solve(truss.scatter.dense(kinematics.gradient), change).reshape(-1, 3)

    shift, base_rhs = 0.01 * rng.normal(size=3), 0.01 * rng.normal(size=2)
    curve_step = 0.02 * rng.normal(size=(vertices, 3))
    if vertices:
        curve_step[0] = shift
        curve_step[1] = shift + 0.01 * np.cross(axes[0], axes[1]) + base_rhs @ axes
    leg_rows = np.zeros((len(layout.legs), vertices, 3))
    for row, (start, end) in zip(leg_rows, layout.legs, strict=True):
        row[end] = [0.0, 0.0, 1.0] if start else np.cross(axes[0], axes[1])
        row[start] = -row[end]
    leg_change = np.einsum("gvc,vc->g", leg_rows, curve_step)
    leg_rows = leg_rows.reshape(len(leg_rows), 3 * vertices)
    centres = np.einsum("kf,kfc->kc", truss.face_weights[layout.tracked], nodes[truss.faces[layout.tracked]])
    tip_jacobian = np.kron(truss.tip_weights, np.eye(3))[task.axes]
    tip_rate = rng.normal(size=len(layout.tip_rows))
    tip_rhs = tip_jacobian @ nodes[truss.tip].reshape(-1) - tip_rate * progress
    if curve == "hard":
        position_rhs = layout.curve_weights @ curve_step - centres
    else:
        position_rhs = 0.05 * rng.normal(size=(tracked, 3))

    members = truss.members[rng.integers(truss.member_count, size=rows)]
    others = truss.members[rng.integers(truss.member_count, size=rows)]
    clearance_nodes = np.concatenate([members, others], axis=1)
    normal = rng.normal(size=(rows, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    share = rng.uniform(size=(rows, 2))
    scale = np.stack([1 - share[:, 0], share[:, 0], share[:, 1] - 1, -share[:, 1]], axis=1)
    scale[:1, 2:] = 0.0
    coefficients = scale[..., None] * normal[:, None, :]
    value = np.einsum("rsc,rsc->r", coefficients, nodes[clearance_nodes])
    numbers = StepNumbers(
        motion=arm.motion_rows(kinematics.gradient.copy(), length_rhs),
        lower=actuators - rng.uniform(0.0, 0.03, count),
        upper=actuators + rng.uniform(0.0, 0.03, count),
        actuator_gradient=rng.normal(size=count),
        tip_jacobian=tip_jacobian,
        tip_rate=tip_rate,
        tip_rhs=tip_rhs,
        progress_lower=0.0,
        progress_upper=1.0,
        progress_gradient=-1.5,
        progress_curvature=1.0,
        position_rhs=position_rhs,
        tangent_face=rng.normal(size=(tracked, 2, 9)),
        tangent_curve=rng.normal(size=(tracked, 2, 3)),
        tangent_rhs=0.1 * rng.normal(size=(tracked, 2)),
        vertex_gradient=0.05 * rng.normal(size=(vertices, 3)),
        base_displacement=shift,
        base_axes=axes,
        base_rhs=base_rhs,
        clearance=ClearanceRows(
            clearance_nodes,
            coefficients,
            value - rng.uniform(0.0, 0.01, rows),
            lambda k: f"clearance: row {k}",
        ),
        legs=Legs(leg_rows, leg_change - rng.uniform(0.0, 0.02)),
    )
    return layout, numbers


def contradiction(layout, numbers):
    """Numbers whose clearance row asks for a jump that the strokes do not allow."""
    node = layout.arm.free[-1]
    rows = ClearanceRows(
        np.full((1, 4), node), np.zeros((1, 4, 3)), np.array([5.0]), lambda k: "clearance: far"
    )
    rows.coefficients[0, 0, 2] = 1.0
    return replace(numbers, clearance=rows)


def full_point(builder, numbers, solution):
    """The full QP's unknowns at a solution: its displacements, and the gaps that follow from them."""
    layout, arm = builder.layout, builder.layout.arm
    parts = [solution.nodes[arm.free].reshape(-1), solution.actuators, solution.vertices.reshape(-1)]
    if layout.vertices:
        faces = arm.stations.nodes[layout.tracked]
        centres = arm.stations.centres(solution.nodes)[layout.tracked]
        gap = centres - layout.curve_weights @ solution.vertices + numbers.position_rhs
        tangent = np.einsum("kaf,kf->ka", numbers.tangent_face, solution.nodes[faces].reshape(-1, 9))
        tangent += np.einsum("kac,kc->ka", numbers.tangent_curve, layout.curve_slopes @ solution.vertices)
        parts += [gap.reshape(-1), (tangent + numbers.tangent_rhs).reshape(-1)]
    return np.concatenate([*parts, [solution.progress]])


def stationarity(builder, qp, z, solution):
    """What is left of the gradient by the solution's multipliers and the best ones for the other rows."""
    clearance = len(solution.clearance_multipliers)
    known = np.zeros(len(z))
    known[builder.column["actuators"]] = solution.actuator_multipliers
    rows = np.zeros(len(qp.row_lower))
    if clearance:
        rows[-clearance:] = -solution.clearance_multipliers
    gradient = qp.P @ z + qp.q + known + qp.A.T @ rows
    equal = qp.row_lower == qp.row_upper
    pinned = np.flatnonzero((qp.column_upper - z < 1e-9) | (z - qp.column_lower < 1e-9))
    actuators = builder.column["actuators"]
    pinned = pinned[(pinned < actuators.start) | (pinned >= actuators.stop)]
    legs = builder.leg_rows[(qp.A @ z - qp.row_lower)[builder.leg_rows] < 1e-9]
    columns = np.hstack([qp.A[legs].toarray().T, qp.A[equal].toarray().T, np.eye(len(z))[:, pinned]])
    best = np.linalg.lstsq(columns, -gradient, rcond=None)[0]
    assert (best[: len(legs)] < 1e-9).all(), "a leg is held although it would grow"
    return float(np.max(np.abs(gradient + columns @ best)))


def exact_point(qp, z, within=1e-6):
    """The minimiser over the rows and bounds that are active at `z`, to `within`, free of a solver's tolerance."""
    value = qp.A @ z
    rows = (value - qp.row_lower < within) | (qp.row_upper - value < within)
    columns = (z - qp.column_lower < within) | (qp.column_upper - z < within)
    row_target = np.where(value - qp.row_lower < within, qp.row_lower, qp.row_upper)[rows]
    column_target = np.where(z - qp.column_lower < within, qp.column_lower, qp.column_upper)[columns]
    active = np.vstack([qp.A.toarray()[rows], np.eye(len(z))[columns]])
    target = np.concatenate([row_target, column_target])
    size = len(target)
    system = np.block([[qp.P.toarray(), active.T], [active, np.zeros((size, size))]])
    return np.linalg.lstsq(system, np.concatenate([-qp.q, target]), rcond=None)[0][: len(z)]


def random_step(layout, rng, *, motion=True, base=False):
    """What a step may be linearised at: any poses, boxes, curve and goal."""
    arm = layout.arm
    q, at = (random_pose(arm.truss, rng, 0.03) for _ in range(2))
    moved = Pose(0.05 * rng.normal(size=3), Rotation.from_rotvec(0.1 * rng.normal(size=3)).as_matrix())
    lower = arm.home_quantities[arm.actuators] - rng.uniform(0.0, 0.1, len(arm.actuators))
    straight = np.linspace(0.0, 1.0, layout.vertices)[:, None] * arm.home[arm.end_effector.nodes].mean(axis=0)
    goal = TipGoal(
        rng.normal(size=3),
        Rotation.from_rotvec(rng.normal(size=3)).as_matrix(),
        0.1 * rng.normal(size=3),
        0.1 * rng.normal(size=3),
    )
    return StepInput(
        q=q,
        at=at,
        base=arm.based(q, moved) if base else q,
        vertices=straight + 0.1 * rng.normal(size=straight.shape),
        lower=lower,
        upper=lower + rng.uniform(0.0, 0.2, len(lower)),
        motion=motion,
        progress=0.3,
        goal=goal,
    )


@pytest.mark.dear
@pytest.mark.parametrize("joint_offset", [0.0, 0.1])
@pytest.mark.parametrize(("name", "curve", "track"), LINEAR, ids=str)
def test_a_linearisation_has_the_numbers_of_the_equations(name, curve, track, joint_offset, rng):
    arm = TrussArm(TRUSSES[name](joint_offset=joint_offset))
    weights = Weights(progress=2.0, smoothness=0.3, stroke_centring=0.2)
    layout, _ = make_layout(
        arm, track, vertices=0 if curve == "none" else 6, hard_tracking=curve == "hard", weights=weights
    )
    layout = replace(layout, hard_turns=curve == "hard" and len(track) > 1, elastic_tip=curve == "elastic")
    linearisation, none = Linearisation(layout, compiled=False), ClearanceRows()
    for motion, base in itertools.product((True, False), repeat=2):
        asked = random_step(layout, rng, motion=motion, base=base)
        found = linearisation.numbers(asked, none)
        oracle.check_numbers(found, oracle.numbers(layout, asked), layout)
        assert found.clearance is none
        np.testing.assert_allclose(linearisation.quantities, oracle.lengths(arm.truss, asked.q), atol=1e-14)


def test_a_compiled_linearisation_has_the_numbers_of_the_equations(rng):
    layout, _ = make_layout(TRUSSES["hexapod"](joint_offset=0.1), ("position", "orientation"))
    linearisation = Linearisation(layout)
    for _ in range(3):
        asked = random_step(layout, rng, base=True)
        found = linearisation.numbers(asked, ClearanceRows())
        oracle.check_numbers(found, oracle.numbers(layout, asked), layout)


@pytest.mark.smoke
@pytest.mark.parametrize("off", [0.0, 1e-8, 1e-7])
@pytest.mark.parametrize("motion", [True, False])
def test_a_tip_that_is_there_within_what_is_accepted_need_not_move(motion, off, rng):
    layout, _ = make_layout(TRUSSES["hexapod"](), ("position", "orientation"))
    asked = random_step(layout, rng, motion=motion)
    truss, X = layout.arm.truss, asked.q
    position = truss.tip_weights @ X[truss.tip] + [off, 0.0, 0.0]
    still = TipGoal(position, oracle.tip_rotation(truss, X), np.zeros(3), np.zeros(3))
    asked = asked._replace(goal=still)
    found = Linearisation(layout, compiled=False).numbers(asked, ClearanceRows())
    oracle.check_numbers(found, oracle.numbers(layout, asked), layout)
    assert found.progress_curvature == layout.weights.progress
    assert (np.abs(found.tip_rhs).max() < 1e-15) == (off == 0.0 or (motion and off < 2e-8))


@pytest.mark.parametrize("track", ["pointing", "orientation"])
def test_half_a_turn_of_the_tip_is_an_error_of_half_a_turn(track, rng):
    """Every way there is as long, and none is nothing: a tip that points backwards has not arrived."""
    layout, _ = make_layout(TRUSSES["hexapod"](), (track,))
    arm = layout.arm
    asked = random_step(layout, rng)._replace(q=arm.home_configuration)
    linearisation = Linearisation(layout, compiled=False)
    for axis in (*np.eye(3)[: 2 if track == "pointing" else 3], np.array([0.6, 0.8, 0.0])):
        for angle in (np.pi - 1e-3, np.pi - 1e-9, np.pi):
            turn = Rotation.from_rotvec(angle * axis).as_matrix()
            if angle == np.pi:
                turn = 2.0 * np.outer(axis, axis) - np.eye(3)
            goal = asked.goal._replace(rotation=turn @ arm.end_effector.frame)
            found = linearisation.numbers(asked._replace(goal=goal), ClearanceRows())
            assert np.linalg.norm(found.tip_rhs) == pytest.approx(angle, abs=1e-5), (axis, angle)


@pytest.mark.smoke
@pytest.mark.parametrize(("name", "curve"), CASES)
def test_condensed_answer_satisfies_the_full_qp(name, curve, rng):
    clearance = strokes = 0
    for number, seed in enumerate(rng.integers(2**32, size=40)):
        if number >= 4 and clearance and strokes:
            break
        layout, numbers = make_case(name, curve, seed=seed, joint_offset=0.1 * (number % 2))
        solution = make_solver("daqp", layout).solve(numbers)
        builder = FullBuilder(layout)
        qp = builder.build(numbers)
        z = full_point(builder, numbers, solution)
        assert qp.primal_residual(z) < 1e-9, qp.violated(z)
        assert not qp.violated(z, 1e-9)
        scale = 1.0 + float(np.max(np.abs(solution.actuator_multipliers)))
        assert stationarity(builder, qp, z, solution) < 1e-9 * scale
        y, w = solution.clearance_multipliers, solution.actuator_multipliers
        assert np.all(y >= -1e-9)
        slack = (qp.A @ z - qp.row_lower)[len(qp.row_lower) - len(y) :]
        assert np.all(np.minimum(y, slack) < 1e-9)
        at_bound = np.where(w > 0, numbers.upper - solution.actuators, solution.actuators - numbers.lower)
        assert np.all(np.minimum(np.abs(w), at_bound) < 1e-9)
        clearance += int(np.sum(y > 1e-6))
        strokes += int(np.sum(np.abs(w) > 1e-6))
        fixed = qp.P @ z @ z / 2 + qp.q @ z
        nearby = exact_point(qp, z, 1e-9)  # a free row may lie within 1e-6 of its bound
        assert fixed == pytest.approx(qp.P @ nearby @ nearby / 2 + qp.q @ nearby, abs=1e-10)
    assert strokes > 0
    assert clearance > 0


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(("name", "curve"), CASES)
def test_every_solver_of_the_condensed_qp_has_the_answer_of_the_whole_one(name, curve, solver):
    layout, numbers = make_case(name, curve, seed=11)
    condensed, whole = make_solver(solver, layout).solve(numbers), WholeSolver(layout).solve(numbers)
    builder = FullBuilder(layout)
    qp = builder.build(numbers)
    one, other = (full_point(builder, numbers, answer) for answer in (condensed, whole))
    np.testing.assert_allclose(one, other, atol=3e-6)
    np.testing.assert_allclose(exact_point(qp, one), exact_point(qp, other), atol=1e-9)
    np.testing.assert_allclose(one, exact_point(qp, other), atol=1e-8 if solver in ("daqp", "osqp") else 3e-6)
    for which in ("actuator_multipliers", "clearance_multipliers"):
        np.testing.assert_allclose(getattr(condensed, which), getattr(whole, which), atol=1e-5)


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_solver_gives_the_same_answers_whatever_it_solved_before(solver):
    """Changed values, changed near pairs, infeasible QPs between: nothing of them may stay in the solver."""
    layout, first = make_case("octahedral", seed=21)
    cases = [first] + [
        make_case("octahedral", seed=s, rows=r)[1] for s, r in ((22, 5), (23, 0), (24, 2), (25, 5))
    ]
    reused = make_solver(solver, layout)
    for numbers in (*cases, first):
        with pytest.raises(InfeasibleStepError):
            reused.solve(contradiction(layout, numbers))
        for wrong in (np.nan, np.inf):
            with pytest.raises(SolverError):
                reused.solve(
                    replace(numbers, actuator_gradient=np.full_like(numbers.actuator_gradient, wrong))
                )
        answer, fresh = reused.solve(numbers), make_solver(solver, layout).solve(numbers)
        np.testing.assert_allclose(answer.nodes, fresh.nodes, atol=1e-6)
        np.testing.assert_allclose(answer.actuator_multipliers, fresh.actuator_multipliers, atol=1e-5)


@pytest.mark.parametrize("solver", SOLVERS)
def test_an_answer_does_not_change_when_the_solver_goes_on(solver):
    layout, numbers = make_case("octahedral", seed=31)
    reused = make_solver(solver, layout)
    answer = reused.solve(numbers)
    kept = {name: np.copy(getattr(answer, name)) for name in StepSolution.__dataclass_fields__}
    names = "motion.values", "motion.rhs", "lower", "upper", "tip_rhs"
    before = {name: np.copy(attrgetter(name)(numbers)) for name in names}
    reused.solve(make_case("octahedral", seed=32)[1])
    for name, value in kept.items():
        np.testing.assert_array_equal(getattr(answer, name), value)
    for name, value in before.items():
        np.testing.assert_array_equal(attrgetter(name)(numbers), value)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("curve", CURVES)
def test_contradicting_rows_are_infeasible_for_every_solver(solver, curve):
    layout, numbers = make_case("octahedral", curve, seed=41)
    with pytest.raises(InfeasibleStepError):
        make_solver(solver, layout).solve(contradiction(layout, numbers))


@pytest.mark.parametrize("solver", SOLVERS)
def test_rows_that_contradict_by_a_millimetre_are_not_called_solved(solver):
    layout, numbers = make_case("octahedral", seed=42)
    rows = numbers.clearance
    opposed = ClearanceRows(
        rows.nodes[[0, 0]], np.stack([rows.coefficients[0], -rows.coefficients[0]]), np.array([1e-3, 0.0])
    )
    with pytest.raises(SolverError):
        make_solver(solver, layout).solve(replace(numbers, clearance=opposed))


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_box_that_contradicts_itself_is_refused(solver):
    layout, numbers = make_case("octahedral", seed=43)
    upper = numbers.upper.copy()
    upper[1] = numbers.lower[1] - 1e-3
    with pytest.raises(SolverError):
        make_solver(solver, layout).solve(replace(numbers, upper=upper))


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_row_that_is_not_a_number_is_refused(solver):
    layout, numbers = make_case("octahedral", seed=44)
    tip_rhs = numbers.tip_rhs.copy()
    tip_rhs[0] = np.nan
    with pytest.raises(SolverError):
        make_solver(solver, layout).solve(replace(numbers, tip_rhs=tip_rhs))


def test_a_singular_truss_is_named():
    layout, numbers = make_case("octahedral", seed=45)
    gradient = numbers.motion.gradient.copy()
    gradient[-1] = 0.0
    motion = layout.arm.motion_rows(gradient, numbers.motion.rhs)
    with pytest.raises(SolverError, match="singular"):
        make_solver("daqp", layout).solve(replace(numbers, motion=motion))


def test_unknown_solvers_are_named_with_the_choices():
    layout, _ = make_case("octahedral")
    with pytest.raises(SolverError, match=r'no solver "ospq".*did you mean "osqp".*daqp, .*piqp'):
        make_solver("ospq", layout)
    assert issubclass(SolverError, VgtmError)
    assert issubclass(InfeasibleStepError, SolverError)
    choices = available_solvers()
    assert choices[0] == "daqp"
    assert set(SOLVERS) <= set(choices)
    assert len(set(choices)) == len(choices)


def test_every_solver_on_the_list_solves():
    layout, numbers = make_case("octahedral", seed=46)
    wanted = make_solver("daqp", layout).solve(numbers)
    for name in available_solvers():
        found = make_solver(name, layout).solve(numbers)
        np.testing.assert_allclose(found.nodes, wanted.nodes, atol=1e-5, err_msg=name)


@pytest.mark.parametrize("name", TIGHTENED)
def test_a_maneuver_takes_no_more_steps_for_its_solver(name):
    """Answers that fail the residual check would halve the steps, and end the maneuver."""
    if name not in available_solvers():
        pytest.skip(f"{name} is not installed")
    maneuver = vq.solve(vq.load_problem("five_bay_two_cubes").replace({"method.solver": name}))
    assert (maneuver.status, maneuver.steps) == ("solved", 50)
    assert maneuver.certificate is not None
    assert maneuver.certificate.ok


class Spoilt(DenseSolver):
    """A solver that says of any answer that it solved the QP."""

    accuracy = 1e-10

    def __init__(self, spoil):
        self._spoil = spoil

    def ask(self, qp):
        answer = DAQP.ask(qp)
        x, y = self._spoil(answer.x, answer.multipliers)
        return answer._replace(x=x, multipliers=y)


GARBAGE = {
    "zero": lambda x, y: (0 * x, 0 * y),
    "random": lambda x, y: (np.random.default_rng(0).normal(size=x.shape), y),
    "not a number": lambda x, y: (np.full_like(x, np.nan), y),
    "one not a number": lambda x, y: (np.where(np.arange(len(x)) == len(x) - 1, np.nan, x), y),
    "infinite": lambda x, y: (np.full_like(x, np.inf), y),
    "a millimetre off": lambda x, y: (x + 1e-3, y),
    "ten micrometres off": lambda x, y: (x + 1e-5 * np.cos(np.arange(len(x))), y),
    "no multipliers": lambda x, y: (x, 0 * y),
    "wrong signs": lambda x, y: (x, -y),
    "multipliers not numbers": lambda x, y: (x, np.full_like(y, np.nan)),
}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("kind", GARBAGE)
def test_garbage_with_a_good_status_is_refused(kind):
    layout, numbers = make_case("octahedral", seed=51)
    CondensedSolver(layout, Spoilt(lambda x, y: (x, y))).solve(numbers)
    with pytest.raises(SolverError):
        CondensedSolver(layout, Spoilt(GARBAGE[kind])).solve(numbers)


def test_a_feasible_answer_that_is_not_optimal_is_refused():
    """Multipliers of rows without active bounds would make any point stationary: they are no multipliers."""
    rng = np.random.default_rng(52)
    root, gradient = rng.normal(size=(6, 6)), rng.normal(size=6)
    hessian, rows, x = root @ root.T + np.eye(6), rng.normal(size=(2, 6)), 0.1 * rng.normal(size=6)
    qp = DenseQP(hessian, gradient, rows, np.full(8, -9.0), np.full(8, 9.0), np.zeros(8, dtype=np.int32))
    of_bounds = -(hessian @ x + gradient)
    answer = DenseAnswer(x, np.concatenate([of_bounds, np.zeros(2)]), 1, "any")
    assert residuals(answer, qp)[0] == 0.0
    with pytest.raises(SolverError, match="dual residual"):
        refuse_large(*residuals(answer, qp), answer.status)
    answered(DAQP, qp)


def test_garbage_from_a_library_is_refused(monkeypatch):
    import qpsolvers

    layout, numbers = make_case("octahedral", seed=53)
    solve = qpsolvers.solve_problem

    def feasible_for_another_objective(problem, **options):
        changed = qpsolvers.Problem(
            problem.P, -problem.q, problem.G, problem.h, problem.A, problem.b, problem.lb, problem.ub
        )
        return solve(changed, **options)

    monkeypatch.setattr(qpsolvers, "solve_problem", feasible_for_another_objective)
    with pytest.raises(SolverError):
        make_solver("clarabel", layout).solve(numbers)


def test_the_full_qp_names_and_measures_every_row_and_column():
    layout, numbers = make_case("octahedral", "elastic", seed=61)
    qp = FullBuilder(layout).build(numbers)
    assert qp.A.shape == (len(qp.rows), len(qp.columns)) == (len(qp.row_lower), len(qp.q))
    assert len({label.name for label in qp.columns}) == len(qp.columns)
    assert {label.unit for label in qp.columns} <= {"m", "rad", "1"}
    assert {label.unit for label in qp.rows} <= {"m", "rad"}
    names = [label.name for label in qp.rows]
    assert len(set(names)) == len(names)
    assert {"member: L1-1", "actuator: B2-3", "tip x", "clearance: row 4"} <= set(names)
    z = np.zeros(len(qp.q))
    violated = dict(qp.violated(z, 1e-12))
    assert np.linalg.norm(list(violated.values())) == pytest.approx(qp.primal_residual(z))
    assert list(violated.values()) == sorted(violated.values(), reverse=True)
    text = str(qp)
    assert f"{len(qp.columns)} columns, {len(qp.rows)} rows" in text
    assert np.all(np.linalg.eigvalsh(qp.P.toarray()) > -1e-12)
