"""The methods of the paper against one another, against the QP, and against finite differences."""

from __future__ import annotations

import numpy as np
import pytest
from method_problems import MODULES, free_problem, run
from steps import numbers_at

import vgtm_qp as vq
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.errors import ProblemError
from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.methods import PRESETS, Resolver, with_method
from vgtm_qp.methods.conventional import ConventionalResolver
from vgtm_qp.methods.curve_first import CurveFirstResolver
from vgtm_qp.methods.objectives import potential_curvature, potential_field, potential_slope
from vgtm_qp.methods.segments import make_segments
from vgtm_qp.problem import Problem
from vgtm_qp.qp.condensed import CondensedSolver
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.target import Target

ALL_TERMS = ["node_rate", "actuator_rate", "stroke_centring"]


@pytest.mark.parametrize("module", MODULES)
@pytest.mark.parametrize("algebra", ["dense", "sparse"])
@pytest.mark.parametrize("variant", ["moore-penrose", "weighted"])
def test_without_active_limits_the_qp_is_the_pseudoinverse(module: str, algebra: str, variant: str) -> None:
    """Equal objective, no obstacle, no limit: one step of eq. (28) is one QP, to 1e-9."""
    corrected = free_problem(module, name="pseudoinverse", correct=True)
    there = Resolver(corrected)
    run(there, corrected, 12)

    problem = corrected.replace(
        {
            "method.correct": False,
            "method.algebra": algebra,
            "method.variant": variant,
            "method.null_space": ALL_TERMS,
        }
    )
    resolver = ConventionalResolver(problem)
    setup = resolver.setup
    plan = make_plan(problem, *resolver.tip())
    resolver.state = there.state
    start, end = float(plan.marks[11]), float(plan.marks[12])
    step = resolver.follow(plan.path, start, end)
    assert step.progress == 1.0, step.reason

    unlimited = np.full(len(setup.arm.actuators), 1e9)
    target = Target(plan.path, start, end, -unlimited, unlimited, there.state.time + 0.05, 0.05)
    q = np.array(there.state.nodes)
    numbers = numbers_at(setup, q, np.zeros((0, 3)), target, 0.0, ClearanceRows(), motion=True)
    answer = CondensedSolver(setup.layout).solve(numbers)
    assert answer.progress == pytest.approx(1.0, abs=1e-12)
    moved = resolver.state.nodes - there.state.nodes
    assert np.abs(moved).max() > 1e-3
    np.testing.assert_allclose(moved, answer.nodes, atol=1e-9)


@pytest.mark.parametrize("module", MODULES)
@pytest.mark.parametrize("correct", [False, True])
def test_parallel_tracking_is_recursive_tracking(module: str, correct: bool) -> None:
    options = {"name": "curve-pseudoinverse", "correct": correct}
    problem = free_problem(module, tracking="recursive", **options)
    recursive = run(CurveFirstResolver(problem), problem)
    problem = free_problem(module, tracking="parallel", **options)
    parallel = run(CurveFirstResolver(problem), problem)
    np.testing.assert_allclose(parallel, recursive, atol=1e-9)


@pytest.mark.parametrize("module", MODULES)
@pytest.mark.parametrize("name", ["pseudoinverse", "curve-pseudoinverse"])
def test_corrected_methods_keep_lengths_and_tip(module: str, name: str) -> None:
    problem = free_problem(module, name=name, tracking="recursive", correct=True)
    resolver = Resolver(problem)
    run(resolver, problem)
    setup = resolver.setup
    fixed = truss_of(setup.arm).fixed
    np.testing.assert_allclose(resolver.state.quantities[fixed], setup.arm.home_quantities[fixed], atol=1e-10)
    np.testing.assert_allclose(resolver.tip()[0], problem.maneuver.waypoint[0].position, atol=1e-9)


@pytest.mark.parametrize("name", ["pseudoinverse", "curve-pseudoinverse"])
def test_faithful_methods_drift_by_the_square_of_the_step(name: str) -> None:
    drift = []
    for steps in (20, 40):
        problem = free_problem("octahedral", steps=steps, name=name, tracking="recursive")
        resolver = Resolver(problem)
        run(resolver, problem)
        fixed = truss_of(resolver.setup.arm).fixed
        drift.append(np.abs(resolver.state.quantities - resolver.setup.arm.home_quantities)[fixed].max())
    # Squares of half the displacement, twice as often.
    assert drift[0] / drift[1] == pytest.approx(2.0, abs=0.2)


@pytest.mark.parametrize("module", ["octahedral", "octahedral with offset joints", "longeron"])
def test_dense_and_sparse_algebra_give_one_maneuver(module: str) -> None:
    for variant in ("moore-penrose", "damped"):
        options = {"name": "pseudoinverse", "variant": variant, "null_space": ["node_rate", "actuator_rate"]}
        ways = []
        for algebra in ("dense", "sparse"):
            problem = free_problem(module, algebra=algebra, **options)
            ways.append(run(Resolver(problem), problem))
        np.testing.assert_allclose(ways[0], ways[1], atol=1e-9)


def test_damping_and_truncation_change_the_answer_and_the_rank() -> None:
    def resolver(**options: object) -> ConventionalResolver:
        problem = free_problem("octahedral", name="pseudoinverse", **options)
        found = ConventionalResolver(problem)
        run(found, problem, 3)
        return found

    plain = resolver()
    rows = len(truss_of(plain.setup.arm).fixed) + 3
    assert plain.rank == rows
    damped = resolver(variant="damped", damping=0.3)
    assert np.abs(damped.state.nodes - plain.state.nodes).max() > 1e-4
    truncated = resolver(variant="truncated", truncation=0.3)
    assert truncated.rank is not None
    assert truncated.rank < rows


def test_segments_are_of_the_right_size() -> None:
    def partition(module: str, turns: str | None = None, **truss: object) -> list[tuple[int, str, bool]]:
        problem = free_problem(module).replace({f"truss.{key}": value for key, value in truss.items()})
        setup = build_arm(problem.replace({"method.solver": "piqp"}))
        segments = make_segments(setup.layout, setup.kinematics, turns)
        return [(s.station, s.tracks, s.is_square) for s in segments]

    assert partition("octahedral") == [(k, "position", True) for k in range(1, 6)]
    assert partition("hexapod") == [(k, "orientation", True) for k in range(1, 5)]
    assert partition("longeron") == [
        (1, "position", True),
        (3, "orientation", True),
        (5, "orientation", True),
    ]
    assert partition("longeron", bays=4) == [(2, "orientation", True), (4, "orientation", True)]
    assert partition("tetrahedral") == [(k, "orientation", False) for k in range(1, 5)]
    assert partition("tetrahedral, two actuated") == [(k, "orientation", True) for k in range(1, 5)]
    assert partition("octahedral", "pointing")[-2:] == [(2, "position", True), (5, "pointing", False)]


def test_pointing_is_tracked_by_three_octahedral_bays_together() -> None:
    problem = free_problem("octahedral", name="curve-pseudoinverse", tracking="recursive", correct=True)
    data = problem.to_dict()
    data["end_effector"] = {"track": ["position", "pointing"]}
    data["maneuver"]["waypoint"][0]["pointing"] = [0.2, 0.1, 1.0]
    states = []
    for tracking in ("recursive", "parallel"):
        data["method"]["tracking"] = tracking
        pointed = Problem.from_dict(data)
        resolver = Resolver(pointed)
        states.append(run(resolver, pointed))
        direction = np.array([0.2, 0.1, 1.0]) / np.linalg.norm([0.2, 0.1, 1.0])
        np.testing.assert_allclose(resolver.tip()[1][:, 2], direction, atol=1e-9)
    np.testing.assert_allclose(states[0], states[1], atol=1e-9)


@pytest.mark.smoke
def test_the_curve_keeps_its_base_and_its_null_space_vector_does_not_move_the_tip() -> None:
    ends = []
    for terms in ([], ["curve_rate", "spacing", "smoothness"]):
        problem = free_problem("hexapod", name="curve-pseudoinverse", tracking="parallel", null_space=terms)
        resolver = CurveFirstResolver(problem)
        home = resolver.curve
        run(resolver, problem)
        p = resolver.curve.control_vertices
        np.testing.assert_allclose(p[0], home.control_vertices[0], atol=1e-12)
        np.testing.assert_allclose(p[1, :2], 0.0, atol=1e-12)
        ends.append(p)
    np.testing.assert_allclose(ends[0][-1], ends[1][-1], atol=1e-12)
    assert np.abs(ends[0] - ends[1]).max() > 1e-3


def test_torsion_coordinates_let_the_curve_steer_roll() -> None:
    problem = free_problem("hexapod", name="curve-pseudoinverse", tracking="recursive", correct=True)
    data = problem.to_dict()
    data["end_effector"] = {"track": ["position", "orientation"]}
    data["maneuver"]["waypoint"][0]["rotation_vector"] = [0.1, 0.05, 0.3]
    with pytest.raises(vq.ProblemError, match=r"curve\.torsion_vertices: found 0; expected 1 or more"):
        Resolver(Problem.from_dict(data))
    data["curve"] |= {"torsion_vertices": 2, "control_vertices": 6}
    rolled = Problem.from_dict(data)
    resolver = Resolver(rolled)
    run(resolver, rolled)
    np.testing.assert_allclose(truss_of(resolver.setup.arm).tip_frame, np.eye(3))
    expected = make_plan(rolled, *resolver.tip()).path.at(1e9).rotation
    np.testing.assert_allclose(resolver.tip()[1], expected, atol=1e-9)


def test_a_breakdown_ends_the_maneuver_with_step_and_reason() -> None:
    problem = vq.load_problem("five_bay_free").replace(
        {"method.name": "curve-pseudoinverse", "method.null_space": [], "method.correct": True}
    )
    goal = {"time": 10.0, "position": [1.84, 0.0, 2.86]}
    maneuver = vq.solve(problem.replace({"maneuver.waypoint": [goal]}))
    assert maneuver.status == "blocked"
    assert 10 <= maneuver.steps < 50
    assert maneuver.blocked_by[0].startswith(f"step {maneuver.steps + 1}: ")


def test_a_faithful_run_arrives_but_is_not_solved() -> None:
    problem = vq.load_problem("five_bay_free").replace({"method.name": "pseudoinverse"})
    maneuver = vq.solve(problem)
    assert (maneuver.status, maneuver.reached) == ("infeasible", 1.0)
    assert maneuver.certificate is not None
    assert any("member error" in line for line in maneuver.certificate.failures())
    corrected = vq.solve(problem.replace({"method.correct": True}))
    assert corrected.certificate is not None
    assert not any("member error" in line for line in corrected.certificate.failures())


BAYS = {name: dict(MODULES[name], bays=10) for name in MODULES}


@pytest.mark.parametrize("module", BAYS)
def test_the_qp_by_bays_is_the_coupled_one_with_stations_held_on_the_curve(
    module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Recursive, parallel and dense elimination of one QP, over ten bays of every module: one maneuver."""
    monkeypatch.setitem(MODULES, module, BAYS[module])
    coupled = free_problem(module, steps=12, tracking_mode="hard", solver="piqp")
    dense = coupled.replace({"method.solver": "daqp"})
    by_bays = [free_problem(module, steps=12, tracking=way) for way in WAYS]
    recursive, parallel = (states_of(problem) for problem in by_bays)
    np.testing.assert_allclose(parallel, recursive, atol=1e-9)
    np.testing.assert_allclose(recursive, states_of(dense), atol=1e-7)


WAYS = ("recursive", "parallel")


def states_of(problem: Problem) -> np.ndarray:
    maneuver = vq.solve(problem)
    assert maneuver.status == "solved", maneuver.blocked_by
    assert maneuver.certificate is not None
    assert maneuver.certificate.ok, str(maneuver.certificate)
    assert maneuver.nodes is not None
    return maneuver.nodes


@pytest.mark.parametrize("name", ["five_bay_two_cubes", "ten_bay_round_a_cube", "hexapod_past_a_cube"])
def test_curve_first_arrives_between_the_cubes(name: str) -> None:
    """With strokes and clearances in the QP over the curve it goes as far as the coupled QP does."""
    problem = vq.load_problem(name)
    ways = [states_of(problem.replace({"method.tracking": way, "method.retries": False})) for way in WAYS]
    np.testing.assert_allclose(*ways, atol=1e-9)


@pytest.mark.parametrize("tracking", ["coupled", *WAYS, "none"])
def test_a_timed_jam_is_held_whatever_tracks_the_curve(tracking: str) -> None:
    problem = vq.load_problem("actuator_jams").replace({"method.tracking": tracking})
    held_from_its_jam_on(vq.solve(problem), problem, 1e-9)


@pytest.mark.parametrize("algebra", ["dense", "sparse"])
@pytest.mark.parametrize("correct", [False, True])
def test_a_timed_jam_is_held_by_the_conventional_solution(algebra: str, correct: bool) -> None:
    changes = {"method.name": "pseudoinverse", "method.algebra": algebra, "method.correct": correct}
    problem = vq.load_problem("actuator_jams").replace(changes)
    # To first order, like the fixed members, where the drift is not corrected.
    held_from_its_jam_on(vq.solve(problem, verify=False), problem, 1e-9 if correct else 0.02)


def held_from_its_jam_on(maneuver: vq.Maneuver, problem: Problem, tolerance: float) -> None:
    assert maneuver.member_lengths is not None
    assert problem.truss is not None
    names = maneuver.member_names.tolist()
    jams = [lock for lock in problem.truss.locked if lock.time > 0.0]
    assert jams
    for jam in jams:
        lengths = maneuver.member_lengths[:, names.index(jam.member)]
        since, before = maneuver.time >= jam.time - 1e-9, maneuver.time <= jam.time + 1e-9
        assert since.sum() > 3
        assert np.ptp(lengths[before]) > 1e-3
        assert np.ptp(lengths[since]) <= tolerance


def test_what_cannot_hold_a_jam_names_the_key() -> None:
    problem = vq.load_problem("actuator_jams").replace({"method.name": "curve-pseudoinverse"})
    with pytest.raises(vq.ProblemError, match=r"truss\.locked.*jams"):
        vq.Resolver(problem)


@pytest.mark.parametrize("correct", [False, True])
def test_dense_and_sparse_algebra_hold_the_same_actuators(correct: bool) -> None:
    ways = []
    for algebra in ("dense", "sparse"):
        problem = free_problem("octahedral", name="pseudoinverse", algebra=algebra, correct=correct)
        resolver = vq.Resolver(problem)
        rank = None
        for name in ("B2-1", "B4-3"):
            run(resolver, problem, 2)
            resolver.lock(name)
            assert name in resolver.locked
            rank = resolver.rank
        ways.append(run(resolver, problem, 2))
        assert resolver.rank == rank + 1
    np.testing.assert_allclose(*ways, atol=1e-9)


def test_the_potential_gradient_is_that_of_the_potential(rng) -> None:
    problem = vq.load_problem("five_bay_two_cubes").replace({"method.solver": "piqp"})
    setup = build_arm(problem)
    X = setup.arm.home + rng.normal(scale=0.02, size=setup.arm.home.shape)

    def potential(nodes: np.ndarray) -> float:
        distance = setup.monitor.near(nodes, 0.0, setup.influence).distance
        return float(np.sum(0.5 * (setup.influence / distance - 1.0) ** 2))

    gradient, blocks = potential_field(setup, X, 0.0)
    assert np.abs(gradient).max() > 0.1
    assert np.linalg.eigvalsh(blocks).min() > -1e-9
    for _ in range(5):
        direction = rng.normal(size=X.shape)
        h = 1e-6
        slope = (potential(X + h * direction) - potential(X - h * direction)) / (2 * h)
        assert slope == pytest.approx(float(np.sum(gradient * direction)), rel=1e-4, abs=1e-4)


def test_the_potential_ends_at_the_influence_distance_and_stays_finite() -> None:
    slopes = potential_slope(np.array([-0.1, 1e-12, 0.1, 0.5, 0.7]), 0.5)
    assert np.all(np.isfinite(slopes))
    assert slopes[0] == slopes[1] < slopes[2] < 0.0
    h, d = 1e-6, np.array([0.1, 0.2, 0.4])
    numeric = (potential_slope(d + h, 0.5) - potential_slope(d - h, 0.5)) / (2 * h)
    np.testing.assert_allclose(potential_curvature(d, 0.5), numeric, rtol=1e-6)
    np.testing.assert_array_equal(slopes[3:], 0.0)


def test_the_obstacle_potential_keeps_the_conventional_arm_further_away() -> None:
    problem = vq.load_problem("five_bay_two_cubes").replace(
        {"method.name": "pseudoinverse", "method.correct": True, "maneuver.steps": 20}
    )
    plain = vq.solve(problem, verify=False)
    pushed = vq.solve(
        problem.replace(
            {
                "method.null_space": ["actuator_rate", "obstacle_potential"],
                "method.weights.obstacle_potential": 1e-4,
            }
        ),
        verify=False,
    )
    assert min(pushed.clearance) > min(plain.clearance) + 0.01


def test_a_moving_base_enters_the_conventional_solution() -> None:
    problem = free_problem("octahedral", name="pseudoinverse", correct=True)
    data = problem.to_dict()
    data["truss"]["base_motion"] = [{"time": 1.0, "position": [0.1, 0.0, 0.05]}]
    moving = Problem.from_dict(data)
    resolver = Resolver(moving)
    states = run(resolver, moving)
    base = resolver.setup.arm.base
    np.testing.assert_allclose(states[-1][base] - states[0][base], [[0.095, 0.0, 0.0475]] * 3, atol=2e-3)
    fixed = truss_of(resolver.setup.arm).fixed
    np.testing.assert_allclose(
        resolver.state.quantities[fixed], resolver.setup.arm.home_quantities[fixed], atol=1e-10
    )
    data["method"] |= {"name": "curve-pseudoinverse"}
    with pytest.raises(vq.ProblemError, match=r"truss\.base_motion: .*expected a base at rest"):
        Resolver(Problem.from_dict(data))


@pytest.mark.parametrize("method", PRESETS)
def test_every_method_is_served_or_refused_through_one_class(method: str) -> None:
    problem = with_method(free_problem("octahedral"), method)
    resolver = vq.Resolver(problem)
    assert isinstance(resolver, vq.Resolver)
    assert resolver.setup.arm.kind == "octahedral"
    plan = make_plan(problem, *resolver.tip())
    home, mark = resolver.state, float(plan.marks[0])
    step = resolver.follow(plan.path, 0.0, mark)
    assert step.state is resolver.state is not home
    assert set(resolver.phases.values()) != {0.0}
    assert resolver.brake(plan.path, 0.0, 1.0) is None
    assert resolver.too_near(home) == {}
    assert resolver.explain(plan.path, 0.0, mark, last=step, state=home).names
    assert resolver.state is step.state
    goal = resolver.tip()[0] + [0.01, 0.0, 0.0]
    assert resolver.step(position=goal).status is vq.StepStatus.REACHED
    is_faithful = "pseudoinverse" in method and not problem.method.correct
    np.testing.assert_allclose(resolver.tip()[0], goal, atol=1e-3 if is_faithful else 1e-6)
    with pytest.raises(vq.GoalError):
        resolver.step(position=[0.0, np.nan, 0.0])
    with pytest.raises(vq.GoalError):
        resolver.step(position=goal, dt=-1.0)
    is_qp, has_curve = problem.method.name == "qp", problem.method.tracking != "none"
    assert resolver.draws_vertices == is_qp
    assert (resolver.again(problem) is not None) == is_qp
    assert (resolver.solver is not None) == is_qp
    assert (resolver.rank is not None) == (problem.method.name == "pseudoinverse")
    resolver.control_vertex_goals = {}
    assert resolver.control_vertex_goals == {}
    if is_qp:
        assert resolver.build(position=goal).rows
    else:
        with pytest.raises(vq.GoalError, match=r'cannot show the QP.*methods that can: "qp"'):
            resolver.build(position=goal)
    if is_qp and has_curve:
        resolver.set_control_vertex_goal(3, [0.1, 0.0, 3.0])
        assert resolver.set_control_vertices(6) < 1e-9
    else:
        with pytest.raises(vq.GoalError):
            resolver.set_control_vertex_goal(3, [0.0, 0.0, 1.0])
        with pytest.raises(vq.GoalError):
            resolver.set_control_vertices(6)
    if problem.method.name == "curve-pseudoinverse":
        with pytest.raises(vq.GoalError, match='methods that can: "qp", "pseudoinverse"'):
            resolver.lock("B2-1")
        assert not resolver.locked
    else:
        resolver.lock("B2-1")
        assert resolver.locked == {"B2-1"}


@pytest.mark.parametrize("correct", [False, True])
def test_a_curve_that_is_put_into_a_state_moves_on_from_there(correct: bool) -> None:
    problem = free_problem("octahedral", name="curve-pseudoinverse", correct=correct)
    resolver, other = CurveFirstResolver(problem), CurveFirstResolver(problem)
    plan = make_plan(problem, *resolver.tip())
    first, second = (float(mark) for mark in plan.marks[:2])
    resolver.follow(plan.path, 0.0, first)
    other.state = resolver.state
    found = [mover.follow(plan.path, first, second).state.nodes for mover in (resolver, other)]
    np.testing.assert_allclose(*found, atol=1e-12)
    resolver.state = resolver.setup.home_state()
    np.testing.assert_allclose(resolver.curve.position(1.0), resolver.tip()[0], atol=1e-12)


@pytest.mark.parametrize(
    ("problem", "changes", "message"),
    [
        ("tetrahedral_truss_circle", {}, r"method\.name: found .*this arm has none"),
        ("moving_base", {}, r"truss\.base_motion: .*a base at rest"),
        ("five_bay_free", {"curve.control_vertices": 3, "end_effector.track": ["position", "pointing"],
          "maneuver.waypoint": [{"time": 1.0, "position": [0.1, 0.0, 4.0], "pointing": [0, 0, 1]}]},
         r"curve\.control_vertices: found 3; expected 4 or more: base and tip fix 10 coordinates"),
        ("five_bay_free", {"end_effector.track": ["orientation"],
          "maneuver.waypoint": [{"time": 1.0, "rotation_vector": [0.0, 0.0, 0.1]}]},
         r"curve\.torsion_vertices: found 0; expected 1 or more"),
    ],
)  # fmt: skip
def test_what_the_curve_first_method_cannot_do_is_named_by_its_key(problem, changes, message):
    asked = vq.load_problem(problem).replace(changes)
    with pytest.raises(ProblemError, match=message):
        vq.Resolver(with_method(asked, "curve-pseudoinverse"))
