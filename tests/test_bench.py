"""The measuring instrument: what it reports is what happened. No test depends on how fast anything is."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import jsonschema
import numpy as np
import pytest

import vgtm_qp as vq
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.bench import BaselineName, contestants, measure, report, scenes
from vgtm_qp.bench.chart import plot_phases
from vgtm_qp.bench.contestants import BASELINES, BarePseudoinverse, make_baseline
from vgtm_qp.bench.fresh import measure_fresh, measure_start
from vgtm_qp.bench.measure import PairedTimes, StepTime, breakdown, run_alone, run_in_turn, timing
from vgtm_qp.bench.tables import render
from vgtm_qp.bench.tour import Goal, Tour, make_goals
from vgtm_qp.cli import main
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.checks import check_problem, find_warnings
from vgtm_qp.step.state import State
from vgtm_qp.view.figure import save_figure

SPENT = {"type": "number", "minimum": 0}
TIMING = {
    "type": "object",
    "required": ["median", "p95", "p99", "max", "cpu", "cpu_p95", "cpu_p99", "cpu_max", "steps"],
    "additionalProperties": SPENT,
}
FRESH = {
    "type": "object",
    "required": [
        "imports",
        "setup",
        "setup_cpu",
        "first_step",
        "to_first_step",
        "peak_memory",
        "imported_memory",
    ],
    "additionalProperties": SPENT,
}
SCENE = {
    "type": "object",
    "required": [
        "name",
        "kind",
        "bays",
        "tracking",
        "distance",
        "covered",
        "stopped_by",
        "qps",
        "members",
        "actuators",
        "obstacles",
    ],
    "properties": {
        "step": TIMING,
        "breakdown": {
            "type": "object",
            "properties": {"total": SPENT, "phases": {"type": "object", "minProperties": 2}},
        },
        "covered": {"type": "number", "minimum": 0, "maximum": 1},
        "warm": FRESH,
        "cold": {"anyOf": [FRESH, {"type": "null"}]},
        "baselines": {
            "type": "object",
            "additionalProperties": {
                "type": "object",
                "required": ["step", "ours", "ratio", "failed", "skipped"],
                "properties": {"step": {"anyOf": [TIMING, {"type": "null"}]}},
            },
        },
    },
}
DOCUMENT = {
    "type": "object",
    "required": [
        "schema_version", "time", "commit", "machine", "versions", "settings", "baselines", "start",
        "scenes", "growth",
    ],
    "properties": {
        "scenes": {"type": "array", "items": SCENE},
        "start": {
            "type": "object",
            "required": ["python", "import", "help"],
            "additionalProperties": SPENT,
        },
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def free() -> vq.Problem:
    return scenes.make_scenes(("free",), trackings=("elastic",))[0].problem


def resolver_and_goals(problem: vq.Problem) -> tuple[vq.Resolver, list[Goal]]:
    resolver = vq.Resolver(problem)
    return resolver, make_goals(problem, resolver)


def walk_to(resolver: vq.Resolver, goals: list[Goal], count: int) -> None:
    for goal in goals[1 : count + 1]:
        assert resolver.step(position=goal.pose.position, pointing=goal.pointing).status == "reached"


@pytest.mark.smoke
def test_percentiles_are_of_the_clock_and_of_the_processor_apart() -> None:
    found = timing([StepTime(k, 201.0 - k) for k in range(1, 102)])
    assert (found["median"], found["cpu"], found["steps"]) == (51.0, 150.0, 101)
    assert (found["p95"], found["p99"], found["max"]) == (96.0, 100.0, 101.0)
    assert (found["cpu_p95"], found["cpu_p99"], found["cpu_max"]) == (195.0, 199.0, 200.0)


def step_of(status: vq.StepStatus, progress: float) -> Any:
    """What a tour reads of a step."""
    return SimpleNamespace(status=status, progress=progress, blocked_by=("wall",))


def test_a_tour_goes_there_and_back_and_asks_again_for_what_was_not_reached() -> None:
    tour = Tour([goal_at(float(k)) for k in range(4)])
    asked = []
    for _ in range(2 * tour.round_trip):
        asked.append(float(tour.goal.pose.position[0]))
        tour.advance(step_of(vq.StepStatus.REACHED, 1.0))
    assert asked == [1.0, 2.0, 3.0, 2.0, 1.0, 0.0] * 2
    slow = Tour([goal_at(float(k)) for k in range(4)])
    for progress, covered in ((0.5, 0.5 / 3.0), (0.5, 0.75 / 3.0)):
        slow.advance(step_of(vq.StepStatus.SLOWED, progress))
        assert slow.goal.pose.position[0] == 1.0
        assert slow.covered == pytest.approx(covered)
    slow.advance(step_of(vq.StepStatus.REACHED, 1.0))
    assert slow.goal.pose.position[0] == 2.0
    slow.advance(step_of(vq.StepStatus.BLOCKED, 0.0))
    assert slow.stuck == "wall"
    slow.restart()
    assert (slow.stuck, slow.goal.pose.position[0], slow.covered) == ("", 1.0, pytest.approx(1.0 / 3.0))


def test_a_tour_that_makes_no_progress_is_stuck() -> None:
    tour = Tour([goal_at(0.0), goal_at(1.0)])
    for _ in range(4):
        tour.advance(step_of(vq.StepStatus.SLOWED, 1e-4))
    assert tour.stuck == ""
    tour.advance(step_of(vq.StepStatus.SLOWED, 1e-4))
    assert tour.stuck == "wall"


def goal_at(x: float) -> Goal:
    zero = np.zeros(3)
    return Goal(TipGoal(np.array([x, 0.0, 0.0]), np.eye(3), zero, zero), None)


def test_goals_are_those_of_the_maneuver_as_a_control_loop_asks_for_them() -> None:
    (scene,) = scenes.make_scenes(("pointing",), trackings=("elastic",))
    resolver, goals = resolver_and_goals(scene.problem)
    position, rotation = resolver.tip()
    assert len(goals) == scene.problem.maneuver.steps + 1
    assert goals[0].pose.position == pytest.approx(position)
    assert goals[0].pointing == pytest.approx(rotation[:, 2])
    assert goals[-1].pose.position == pytest.approx([1.6, 0.0, 3.3])
    assert goals[-1].pointing == pytest.approx([0.0, 0.0, 1.0])
    walk_to(resolver, goals, 3)
    assert resolver.tip()[0] == pytest.approx(goals[3].pose.position, abs=1e-7)


@pytest.mark.smoke
def test_phases_sum_to_the_total_and_an_interrupted_step_does_not_decide() -> None:
    spent = [StepTime(1.0, 1.0)] * 10 + [StepTime(1000.0, 1.0)] * 30
    found = breakdown(spent, {"qp": [0.5] * 10 + [999.0] * 30, "distance": [0.25] * 40})
    assert found["total"] == 1.0
    assert found["phases"] == {"qp": 0.5, "distance": 0.25, "other": 0.25}
    assert breakdown([StepTime(3.0, 3.0)], {"qp": [1.0]})["phases"] == {"qp": 1.0, "other": 2.0}
    rare = breakdown([StepTime(1.0, 1.0)] * 19 + [StepTime(9.0, 9.0)], {"qp": [0.5] * 20})
    assert rare == {"total": 1.0, "phases": {"qp": 0.5, "other": 0.5}}


def test_a_run_alone_covers_the_maneuver_and_its_phases_are_parts_of_its_steps(free: vq.Problem) -> None:
    resolver, goals = resolver_and_goals(free)
    steps = run_alone(resolver, goals, seconds=60.0, steps=len(goals) + 3)
    assert steps.covered == pytest.approx(1.0)
    assert steps.stopped_by == ""
    assert len(steps.spent) == len(steps.qps) == len(goals) + 3
    assert min(steps.qps) >= 1
    assert set(steps.phases) == set(resolver.phases)
    within = np.sum(list(steps.phases.values()), axis=0)
    wall = np.array([spent.wall for spent in steps.spent])
    assert np.all(within > 0.0)
    assert np.all(within <= wall + 1e-9)
    found = breakdown(steps.spent, steps.phases)
    assert sum(found["phases"].values()) == pytest.approx(found["total"], rel=1e-12)


def test_a_blocked_arm_is_reported_and_does_not_run_for_ever() -> None:
    resolver, goals = resolver_and_goals(vq.load_problem("five_bay_blocked_by_wall"))
    steps = run_alone(resolver, goals, seconds=60.0, steps=60)
    assert 0.0 < steps.covered < 1.0
    assert steps.stopped_by


class Watched:
    """A baseline that notes where it was placed, what it was asked, and when."""

    def __init__(self, log: list[str], seconds: float, clock: Clock) -> None:
        self.log, self.clock, self.seconds = log, clock, seconds
        self.states: list[State] = []
        self.goals: list[Goal] = []

    def place(self, state: State) -> None:
        self.states.append(state)

    def step(self, goal: Goal) -> bool:
        self.log.append("theirs")
        self.goals.append(goal)
        self.clock.pass_by(self.seconds)
        return True


class Clock:
    """The time of a machine that grows slower and slower."""

    def __init__(self) -> None:
        self.now, self.slowness = 0.0, 1.0

    def __call__(self) -> float:
        return self.now

    def pass_by(self, seconds: float) -> None:
        self.now += self.slowness * seconds
        self.slowness *= 1.01


def test_runs_in_turn_take_the_same_steps_from_the_same_states_and_drift_cancels(
    free: vq.Problem, monkeypatch: pytest.MonkeyPatch
) -> None:
    resolver, goals = resolver_and_goals(free)
    log: list[str] = []
    clock = Clock()
    ours: list[tuple[State, list[float]]] = []
    take = resolver.step

    def watched(*, position: Any, pointing: Any) -> vq.Step:
        log.append("ours")
        ours.append((resolver.state, position.tolist()))
        clock.pass_by(2.0)
        return take(position=position, pointing=pointing)

    monkeypatch.setattr(resolver, "step", watched)
    monkeypatch.setattr(measure, "perf_counter", clock)
    monkeypatch.setattr(measure, "thread_time", clock)
    baseline = Watched(log, 6.0, clock)
    pairs = run_in_turn(resolver, baseline, goals, seconds=1e9, steps=60)
    assert (len(pairs.theirs), len(pairs.ours)) == (60, 70)
    del ours[60:]
    assert [goal.pose.position.tolist() for goal in baseline.goals[1:]] == [position for _, position in ours]
    assert all(theirs is own for theirs, (own, _) in zip(baseline.states[1:], ours, strict=True))
    assert log[1:] == (["ours"] * 10 + ["theirs"] * 10) * 6 + ["ours"] * 10
    assert clock.slowness > 3.0
    assert pairs.ratio == pytest.approx(3.0, rel=0.02)


def test_a_ratio_is_of_the_processor_and_steps_without_answer_are_counted_apart(free: vq.Problem) -> None:
    pairs = PairedTimes([StepTime(9.0, 4.0)] * 3, [StepTime(1.0, 2.0)] * 3)
    assert pairs.ratio == 2.0

    class Failing(Watched):
        def step(self, goal: Goal) -> bool:
            raise vq.SolverError("no answer")

    resolver, goals = resolver_and_goals(free)
    found = run_in_turn(resolver, Failing([], 0.0, Clock()), goals, seconds=60.0, steps=4)
    assert (found.failed, found.theirs) == (4, [])


@pytest.fixture(scope="module")
def midway() -> tuple[vq.Problem, State, State, list[Goal]]:
    """The two-cube problem, a state half way, the one after it, and the goals of these two."""
    problem = scenes.make_scenes(("cubes",), (5,), ("elastic",))[0].problem
    resolver, goals = resolver_and_goals(problem)
    walk_to(resolver, goals, 25)
    before = resolver.state
    walk_to(resolver, goals[25:], 1)
    return problem, before, resolver.state, goals[25:27]


def tip_and_lengths(problem: vq.Problem, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    truss = truss_of(build_arm(problem.replace({"method.solver": "piqp"})).arm)
    ends = truss.member_ends(X)
    return truss.tip_weights @ X[truss.tip], np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)


def test_the_bare_pseudoinverse_moves_the_tip_to_first_order(midway: tuple[Any, ...]) -> None:
    problem, before, _, (here, goal) = midway
    errors = []
    for share in (1.0, 0.5):
        step = BarePseudoinverse(problem)
        step.place(before)
        wanted = here.pose.position + share * (goal.pose.position - here.pose.position)
        assert step.step(Goal(goal.pose._replace(position=wanted), None))
        tip, lengths = tip_and_lengths(problem, step.reached)
        fixed = ~build_arm(problem).arm.actuated
        errors.append(np.abs(lengths - before.quantities)[fixed].max())
        assert np.abs(tip - wanted).max() < 1e-12
    assert 3.0 < errors[0] / errors[1] < 5.0


def test_the_nonlinear_program_is_solved_within_its_limits_and_not_worse_than_the_qp(
    midway: tuple[Any, ...],
) -> None:
    problem, before, after, (_, goal) = midway
    baseline = make_baseline("ipopt", problem, 5)
    baseline.place(before)
    assert baseline.step(goal)
    assert isinstance(baseline, contestants.ResolverStep)
    reached = baseline.resolver.state.nodes
    tip, lengths = tip_and_lengths(problem, reached)
    setup = build_arm(problem)
    fixed, low, high = ~setup.arm.actuated, *setup.arm.stroke.T
    assert np.abs(lengths - before.quantities)[fixed].max() < 1e-9
    assert np.abs(tip - goal.pose.position).max() < 1e-9
    assert np.all((lengths > low - 1e-9) & (lengths < high + 1e-9))
    assert setup.monitor.least(reached, after.time, among="obstacles")[0] > setup.safe - 1e-3

    def cost(X: np.ndarray, lengths: np.ndarray) -> float:
        weights = problem.method.weights
        moved, change = X - before.nodes, (lengths - before.quantities)[~fixed]
        home = (lengths - setup.arm.home_quantities)[~fixed]
        terms = (weights.node_rate, moved), (weights.actuator_rate, change), (weights.stroke_centring, home)
        return 0.5 * sum(weight * float(np.sum(values**2)) for weight, values in terms)

    assert cost(reached, lengths) < cost(after.nodes, after.quantities) + 1e-6


@pytest.mark.parametrize("name", ["eq28-sparse", "curve", "osqp", "piqp"])
def test_the_package_s_own_baselines_step_from_where_they_are_placed(name: Any) -> None:
    scene = scenes.make_scenes(("free",), trackings=("hard",))[0]
    resolver, goals = resolver_and_goals(scene.problem)
    baseline = make_baseline(name, scene.problem, scene.bays)
    assert isinstance(baseline, contestants.ResolverStep)
    walk_to(resolver, goals, 1)
    before = resolver.state
    walk_to(resolver, goals[1:], 1)
    baseline.place(before)
    assert baseline.step(goals[2])
    moved = baseline.resolver.state
    assert moved.time == pytest.approx(resolver.state.time)
    assert baseline.resolver.tip()[0] == pytest.approx(resolver.tip()[0], abs=2e-3)
    if name in ("osqp", "piqp"):
        assert np.abs(moved.nodes - resolver.state.nodes).max() < 1e-5


def test_a_baseline_is_not_tried_on_longer_arms_than_it_says(free: vq.Problem) -> None:
    with pytest.raises(vq.SolverError, match="more than 20 bays"):
        make_baseline("ipopt", free, 21)


@pytest.mark.smoke
def test_scenes_have_names_of_their_own_and_the_bays_that_were_asked_for() -> None:
    found = scenes.make_scenes(("cubes", "serial", "free"), (5, 12, 12), ("exact", "hard"))
    assert [scene.name for scene in found] == [
        "cubes-5", "cubes-5-hard", "cubes-12", "cubes-12-hard", "serial-7", "free-5", "free-5-hard",
    ]  # fmt: skip
    assert [scene.problem.truss.bays for scene in found if scene.kind == "cubes"] == [5, 5, 12, 12]
    assert [scene.problem.method.tracking_mode for scene in found[:2]] == ["exact", "hard"]
    both = scenes.make_scenes(("cubes",), (5,), None, ("fcl", "exact"))
    assert [scene.name for scene in both] == ["cubes-5", "cubes-5-exact-distance"]
    assert [scene.problem.clearance.distance for scene in both] == ["fcl", "exact"]
    usual = {scene.name for scene in scenes.make_scenes()}
    assert {"free-5", "cubes-5", "cubes-5-exact-distance", "pointing-5-elastic", "cubes-1000-hard"} <= usual


@pytest.mark.parametrize(
    ("kind", "bays"),
    [("cubes", 10), ("cubes", 30), ("clutter", 50), ("tetrahedral", 14), ("serial", 7), ("snake", 30)],
)
def test_scenes_begin_clear_and_can_be_reached(kind: Any, bays: int) -> None:
    scene = scenes.make_scenes((kind,), (bays,), ("elastic",))[0]
    setup = build_arm(scene.problem.replace({"method.solver": "piqp"}))
    assert scene.bays == bays
    assert check_problem(scene.problem, setup) == []
    assert find_warnings(scene.problem, setup) == []
    assert len(scene.problem.obstacle) == {"cubes": 2, "clutter": 100, "serial": 1, "snake": 3}.get(kind, 0)


def test_every_step_of_a_longer_arm_has_a_cube_within_influence() -> None:
    scene = scenes.make_scenes(("cubes",), (10,), ("elastic",))[0]
    resolver, goals = resolver_and_goals(scene.problem)
    tip = resolver.tip()[0]
    for goal in goals[1:]:
        assert resolver.step(position=goal.pose.position).status == "reached"
        least = resolver.setup.monitor.least(resolver.state.nodes, resolver.state.time, among="obstacles")[0]
        assert resolver.setup.safe - 1e-9 <= least < resolver.setup.influence
        assert np.linalg.norm(resolver.tip()[0] - tip) > 0.02
        tip = resolver.tip()[0]


def test_a_fresh_process_is_measured_and_a_cold_cache_leaves_the_users_alone(
    free: vq.Problem, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("VGTM_CC", "none")
    monkeypatch.setenv("VGTM_CACHE", str(tmp_path / "cache"))
    found = measure_fresh(free.to_dict(), cold=True)
    assert set(found) == {*FRESH["required"], "to_result"}
    assert min(found.values()) > 0.0
    assert found["peak_memory"] >= found["imported_memory"] > 10_000_000
    assert not (tmp_path / "cache").exists()


def test_a_fresh_process_that_fails_says_why(free: vq.Problem) -> None:
    with pytest.raises(vq.SolverError, match=r"fresh process failed: .*wooden"):
        measure_fresh(free.to_dict() | {"truss": {"module": "wooden"}})


def test_start_is_measured_with_more_to_do_for_more() -> None:
    found = measure_start()
    assert set(found) == {"python", "import", "help"}
    assert min(found.values()) > 0.0


def test_threads_are_held_before_numpy_is_loaded() -> None:
    script = (
        "import sys; from vgtm_qp.machine import pin_threads; "
        "assert 'numpy' not in sys.modules; assert pin_threads(); "
        "import numpy, os; assert os.environ['OPENBLAS_NUM_THREADS'] == '1'; assert pin_threads(); "
        "del os.environ['OPENBLAS_NUM_THREADS']; assert not pin_threads()"
    )
    clean = {key: value for key, value in os.environ.items() if not key.endswith("NUM_THREADS")}
    root = str(Path(vq.__file__).parents[1])
    subprocess.run([sys.executable, "-c", script], check=True, env={**clean, "PYTHONPATH": root})


def scene_document(bays: int, cpu: float, ratio: float | None = None, kind: str = "cubes") -> dict[str, Any]:
    step = {"median": 2 * cpu, "p95": 3 * cpu, "p99": 4 * cpu, "max": 5 * cpu, "steps": 10}
    step |= {"cpu": cpu, "cpu_p95": cpu, "cpu_p99": 2 * cpu, "cpu_max": 3 * cpu}
    theirs = None if ratio is None else step | {"cpu": ratio * cpu}
    baseline = {"step": theirs, "ours": cpu, "ratio": ratio, "failed": 0, "skipped": ""}
    fresh = {"imports": 1.0, "setup": cpu, "first_step": 1.0, "peak_memory": 100, "imported_memory": 50}
    return {
        "name": f"{kind}-{bays}-elastic", "kind": kind, "bays": bays, "tracking": "elastic", "distance": "fcl",
        "step": step,
        "warm": fresh, "baselines": {"eq28-sparse": baseline},
    }  # fmt: skip


def test_growth_is_the_exponent_of_a_power_law_from_fifty_bays_on() -> None:
    found = report.growth(
        [scene_document(bays, 1e-6 * bays**1.3, ratio=bays) for bays in (50, 100, 1000)]
        + [scene_document(5, 1.0), scene_document(50, 7.0, kind="clutter")]
    )
    assert [(row["method"], row["tracking"], row["bays"]) for row in found] == [
        ("qp", "elastic", [50, 100, 1000]),
        ("eq28-sparse", "elastic", [50, 100, 1000]),
    ]
    assert [row["exponent"] for row in found] == pytest.approx([1.3, 2.3])
    assert report.growth([scene_document(50, 1.0)]) == []


def test_a_comparison_corrects_for_the_machine_by_a_baseline_that_both_have() -> None:
    old = {"commit": "abc", "time": "then", "scenes": [scene_document(5, 4.0, 2.0), scene_document(10, 4.0)]}
    # A machine of half the speed, and a step of a quarter of the work.
    new = {"scenes": [scene_document(5, 2.0, 8.0), scene_document(10, 2.0, 8.0), scene_document(20, 1.0)]}
    found = report.compare(new, old)
    assert (found["commit"], [row["name"] for row in found["scenes"]]) == (
        "abc",
        ["cubes-5-elastic", "cubes-10-elastic"],
    )
    first, second = found["scenes"]
    assert (first["cpu"], first["corrected"], first["by"]) == (0.5, 0.25, "eq28-sparse")
    assert (second["cpu"], second["corrected"], second["by"]) == (0.5, None, None)
    assert (first["setup"], first["memory"]) == (0.5, 1.0)


def test_the_command_offers_what_there_is() -> None:
    assert get_args(BaselineName) == tuple(BASELINES)


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("bench") / "old.json"
    tokens = ["bench", "--scene", "free", "--tracking", "elastic", "--steps", "12", "--seconds", "20"]
    tokens += ["--figure", str(file.with_suffix(".png"))]
    with pytest.MonkeyPatch.context() as patch, file.open("w") as stream:
        patch.setattr(sys, "stdout", stream)
        assert main([*tokens, "--baselines", "eq28", "ipopt", "--json"]) == 0
    return file


def test_json_is_one_document_of_the_schema(printed: Path) -> None:
    document = json.loads(printed.read_text())
    jsonschema.validate(document, DOCUMENT)
    (scene,) = document["scenes"]
    assert (scene["name"], scene["step"]["steps"], scene["cold"]) == ("free-5-elastic", 12, None)
    assert printed.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    assert sum(scene["breakdown"]["phases"].values()) == pytest.approx(scene["breakdown"]["total"])
    assert list(scene["baselines"]) == ["eq28", "ipopt"]
    for found in scene["baselines"].values():
        assert found["ratio"] == pytest.approx(found["step"]["cpu"] / found["ours"])
        assert found["step"]["steps"] + found["failed"] == 12


def test_a_table_shows_every_number_and_the_comparison(
    printed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tokens = ["bench", "--scene", "free", "--tracking", "elastic", "--steps", "5", "--no-baselines"]
    assert main([*tokens, "--compare", str(printed)]) == 0
    out, err = capsys.readouterr()
    assert "free-5" in err
    first, second, third = (
        next(line for line in out.splitlines() if line.startswith(f"| {head}"))
        for head in ("clock", "mean by phase", "fresh process")
    )
    assert all(word in first for word in ("median", "95 %", "99 %", "100 %", "CPU median", "CPU 100 %"))
    assert all(word in second for word in ("distance", "qp", "correction", "acceptance", "other", "covered"))
    assert all(word in third for word in ("set-up", "memory"))
    assert "| new / old" in out
    document = json.loads(printed.read_text())
    text = render(document)
    assert "eq. (28), dense pseudoinverse alone" in text
    assert text.count("| free-5") == 4


def test_a_baseline_that_was_not_measured_has_no_column_and_its_reason_stands_below(printed: Path) -> None:
    document = json.loads(printed.read_text())
    document["baselines"]["mink"] = "another package"
    missing = {"step": None, "ours": None, "ratio": None, "failed": 0, "skipped": "mink is not installed"}
    document["scenes"][0]["baselines"]["mink"] = missing
    text = render(document)
    head = next(line for line in text.splitlines() if line.startswith("| CPU, and ratio"))
    assert "ipopt" in head
    assert "mink" not in head
    assert "mink: another package (not measured: mink is not installed)" in text


def test_what_stopped_an_arm_does_not_widen_the_table(printed: Path) -> None:
    document = json.loads(printed.read_text())
    document["scenes"][0]["stopped_by"] = "one, two, three, four, five"
    assert "one, two and 3 more |" in render(document)


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_the_chart_has_a_bar_of_phases_for_each_scene(printed: Path, tmp_path: Path, suffix: str) -> None:
    document = json.loads(printed.read_text())
    (scene,) = document["scenes"]
    phases = scene["breakdown"]["phases"]
    long = {**scene, "name": "cubes-50", "bays": 50}
    figure = plot_phases({**document, "scenes": [scene, long]})
    assert [axes.get_yticklabels()[0].get_text() for axes in figure.axes] == ["free-5-elastic", "cubes-50"]
    for axes in figure.axes:
        scale = 1e3 if axes.get_xlabel().endswith("ms") else 1e6
        widths = [bar.get_width() / scale for bar in axes.patches]
        assert sorted(widths) == pytest.approx(sorted(phases.values()), abs=1e-12)
        assert axes.get_xlim()[1] / scale > scene["breakdown"]["total"]
    assert save_figure(figure, tmp_path / f"bars{suffix}").stat().st_size > 5000


@pytest.mark.parametrize(
    ("tokens", "words"),
    [
        (["--scene", "moon"], ["moon", "tetrahedral"]),
        (["--baselines", "magic"], ["magic", "eq28-sparse"]),
        (["--bays", "many"], ["many"]),
        (["--bays", "20", "0"], ["--bays", "5"]),
        (["--steps", "0"], ["--steps"]),
        (["--seconds", "0"], ["--seconds"]),
        (["--distance", "guessed"], ["guessed", "fcl"]),
        (["--figure", "bars.txt"], ["--figure", ".svg"]),
        (["--compare", "none.json"], ["none.json: cannot be read: no such file or directory"]),
    ],
)
def test_wrong_usage_gives_2_and_names_the_choices(
    capsys: pytest.CaptureFixture[str], tokens: list[str], words: list[str]
) -> None:
    assert main(["bench", *tokens]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert all(word in err for word in words)


@pytest.mark.parametrize(
    "text", ["", "[]", '{"scenes": []}', '{"schema_version": 99, "commit": "", "time": "", "scenes": []}']
)
def test_a_file_that_is_something_else_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "old.json"
    file.write_text(text)
    with pytest.raises(vq.ResultError, match=r"old\.json"):
        report.load_document(file)
