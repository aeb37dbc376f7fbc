"""The measuring instrument: what it reports is what happened. No test depends on how fast anything is."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, get_args

import jsonschema
import numpy as np
import pytest

import vgtm_qp as vq
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.bench import BaselineName, contestants, measure, report, scenes
from vgtm_qp.bench.contestants import BASELINES, BarePseudoinverse, make_baseline
from vgtm_qp.bench.fresh import measure_fresh, measure_start
from vgtm_qp.bench.ipopt import NonlinearStep
from vgtm_qp.bench.measure import Pairs, Spent, breakdown, run_alone, run_in_turn, timing
from vgtm_qp.bench.tables import render
from vgtm_qp.cli import main
from vgtm_qp.maneuver.plan import Plan, make_plan
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.checks import check_problem, find_warnings
from vgtm_qp.step.path import Path as TipPath
from vgtm_qp.step.state import State

SPENT = {"type": "number", "minimum": 0}
TIMING = {
    "type": "object",
    "required": ["median", "p95", "p99", "cpu", "steps"],
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
    "required": ["name", "kind", "bays", "tracking", "covered", "stopped_by", "qps", "members", "obstacles"],
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


def resolver_and_plan(problem: vq.Problem) -> tuple[vq.Resolver, Plan]:
    resolver = vq.Resolver(problem)
    return resolver, make_plan(problem, *resolver.tip())


def test_percentiles_are_of_the_clock_and_of_the_processor_apart() -> None:
    found = timing([Spent(k, 200.0 - k) for k in range(1, 101)])
    assert (found["median"], found["cpu"], found["steps"]) == (50.5, 149.5, 100)
    assert found["median"] < found["p95"] < found["p99"] < 100.0


def test_phases_sum_to_the_total_and_an_interrupted_step_does_not_decide() -> None:
    seconds = [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1000.0]
    found = breakdown(seconds, {"qp": [0.5] * 7 + [999.0], "distance": [0.25] * 8})
    assert found["total"] == 1.0
    assert found["phases"] == {"qp": 0.5, "distance": 0.25, "other": 0.25}
    assert breakdown([3.0], {"qp": [1.0]})["phases"] == {"qp": 1.0, "other": 2.0}


def test_a_run_alone_covers_the_maneuver_and_its_phases_are_parts_of_its_steps(free: vq.Problem) -> None:
    resolver, plan = resolver_and_plan(free)
    steps = run_alone(resolver, plan, seconds=60.0, steps=len(plan.marks) + 3)
    assert steps.covered == pytest.approx(1.0)
    assert steps.stopped_by == ""
    assert len(steps.spent) == len(steps.qps) == len(plan.marks) + 3
    assert min(steps.qps) >= 1
    assert set(steps.phases) == set(resolver.phases)
    within = np.sum(list(steps.phases.values()), axis=0)
    wall = np.array([spent.wall for spent in steps.spent])
    assert np.all(within > 0.0)
    assert np.all(within <= wall + 1e-9)
    found = breakdown(wall, steps.phases)
    assert sum(found["phases"].values()) == pytest.approx(found["total"], rel=1e-12)


def test_a_blocked_arm_is_reported_and_does_not_run_for_ever() -> None:
    resolver, plan = resolver_and_plan(vq.load_problem("five_bay_blocked_by_wall"))
    steps = run_alone(resolver, plan, seconds=60.0, steps=100)
    assert 0.0 < steps.covered < 1.0
    assert steps.stopped_by


class Watched:
    """A baseline that notes where it was placed, what it was asked, and when."""

    def __init__(self, log: list[str], seconds: float, clock: Clock) -> None:
        self.log, self.clock, self.seconds = log, clock, seconds
        self.states: list[State] = []
        self.goals: list[float] = []

    def place(self, state: State) -> None:
        self.states.append(state)

    def step(self, path: TipPath, start: float, end: float, dt: float) -> bool:
        self.log.append("theirs")
        self.goals.append(end)
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
    resolver, plan = resolver_and_plan(free)
    log: list[str] = []
    clock = Clock()
    ours: list[tuple[State, float]] = []
    follow = resolver.follow

    def watched(path: TipPath, start: float, end: float, *, dt: float | None = None) -> vq.Step:
        log.append("ours")
        ours.append((resolver.state, end))
        clock.pass_by(2.0)
        return follow(path, start, end, dt=dt)

    monkeypatch.setattr(resolver, "follow", watched)
    monkeypatch.setattr(measure, "perf_counter", clock)
    monkeypatch.setattr(measure, "process_time", clock)
    baseline = Watched(log, 6.0, clock)
    pairs = run_in_turn(resolver, baseline, plan, seconds=1e9, steps=60)
    assert len(pairs.theirs) == len(pairs.ours) == 60
    assert baseline.goals[1:] == [goal for _, goal in ours]
    assert all(theirs is own for theirs, (own, _) in zip(baseline.states[1:], ours, strict=True))
    assert log[1:9] == ["theirs", "ours", "ours", "theirs"] * 2
    assert clock.slowness > 3.0
    assert pairs.ratio == pytest.approx(3.0, rel=0.02)


def test_a_ratio_is_of_the_processor_and_steps_without_answer_are_counted_apart(free: vq.Problem) -> None:
    pairs = Pairs([Spent(9.0, 4.0)] * 3, [Spent(1.0, 2.0)] * 3)
    assert pairs.ratio == 2.0

    class Failing(Watched):
        def step(self, path: TipPath, start: float, end: float, dt: float) -> bool:
            raise vq.SolverError("no answer")

    resolver, plan = resolver_and_plan(free)
    found = run_in_turn(resolver, Failing([], 0.0, Clock()), plan, seconds=60.0, steps=4)
    assert (found.failed, found.theirs, found.ours) == (4, [], [])


@pytest.fixture(scope="module")
def midway() -> tuple[vq.Problem, State, State, Plan]:
    """The two-cube problem, a state half way, the one after it, and the plan."""
    problem = scenes.make_scenes(("cubes",), (5,), ("elastic",))[0].problem
    resolver, plan = resolver_and_plan(problem)
    for start, end in zip([0.0, *plan.marks[:24]], plan.marks[:25], strict=True):
        resolver.follow(plan.path, float(start), float(end))
    before = resolver.state
    resolver.follow(plan.path, float(plan.marks[24]), float(plan.marks[25]))
    return problem, before, resolver.state, plan


def tip_and_lengths(problem: vq.Problem, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    truss = truss_of(build_arm(problem.replace({"method.solver": "piqp"})).arm)
    ends = truss.member_ends(X)
    return truss.tip_weights @ X[truss.tip], np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)


def test_the_bare_pseudoinverse_moves_the_tip_to_first_order(midway: tuple[Any, ...]) -> None:
    problem, before, _, plan = midway
    errors = []
    here = float(plan.marks[24])
    for share in (1.0, 0.5):
        step = BarePseudoinverse(problem)
        step.place(before)
        goal = here + share * float(plan.marks[25] - plan.marks[24])
        assert step.step(plan.path, here, goal, 0.2)
        tip, lengths = tip_and_lengths(problem, step.reached)
        fixed = ~build_arm(problem).arm.actuated
        errors.append(np.abs(lengths - before.quantities)[fixed].max())
        assert np.abs(tip - plan.path.at(goal).position).max() < 1e-12
    assert 3.0 < errors[0] / errors[1] < 5.0


def test_the_nonlinear_program_is_solved_within_its_limits_and_not_worse_than_the_qp(
    midway: tuple[Any, ...],
) -> None:
    problem, before, after, plan = midway
    step = NonlinearStep(problem)
    step.place(before)
    here, goal = float(plan.marks[24]), float(plan.marks[25])
    assert step.step(plan.path, here, goal, goal - here)
    tip, lengths = tip_and_lengths(problem, step.reached)
    setup = build_arm(problem)
    fixed, low, high = ~setup.arm.actuated, *setup.arm.stroke.T
    assert np.abs(lengths - before.quantities)[fixed].max() < 1e-9
    assert np.abs(tip - plan.path.at(goal).position).max() < 1e-9
    assert np.all((lengths > low - 1e-9) & (lengths < high + 1e-9))
    assert setup.monitor.least(step.reached, after.time, among="obstacles")[0] > setup.safe - 1e-3

    def cost(X: np.ndarray, lengths: np.ndarray) -> float:
        weights = problem.method.weights
        moved, change = X - before.nodes, (lengths - before.quantities)[~fixed]
        home = (lengths - setup.arm.home_quantities)[~fixed]
        terms = (weights.node_rate, moved), (weights.actuator_rate, change), (weights.stroke_centring, home)
        return 0.5 * sum(weight * float(np.sum(values**2)) for weight, values in terms)

    assert cost(step.reached, lengths) < cost(after.nodes, after.quantities) + 1e-6


@pytest.mark.parametrize("name", ["eq28-sparse", "curve", "osqp", "piqp"])
def test_the_package_s_own_baselines_step_from_where_they_are_placed(name: Any) -> None:
    scene = scenes.make_scenes(("free",), trackings=("hard",))[0]
    resolver, plan = resolver_and_plan(scene.problem)
    baseline = make_baseline(name, scene.problem, scene.bays)
    assert isinstance(baseline, contestants.ResolverStep)
    resolver.follow(plan.path, 0.0, float(plan.marks[0]))
    before = resolver.state
    resolver.follow(plan.path, float(plan.marks[0]), float(plan.marks[1]))
    baseline.place(before)
    assert baseline.step(plan.path, float(plan.marks[0]), float(plan.marks[1]), 0.2)
    moved = baseline.resolver.state
    assert moved.time == pytest.approx(resolver.state.time)
    assert baseline.resolver.tip()[0] == pytest.approx(resolver.tip()[0], abs=2e-3)
    if name in ("osqp", "piqp"):
        assert np.abs(moved.nodes - resolver.state.nodes).max() < 1e-5


def test_a_baseline_is_not_tried_on_longer_arms_than_it_says(free: vq.Problem) -> None:
    with pytest.raises(vq.SolverError, match="more than 20 bays"):
        make_baseline("ipopt", free, 21)


def test_scenes_have_names_of_their_own_and_the_bays_that_were_asked_for() -> None:
    found = scenes.make_scenes(("cubes", "pointing", "free"), (5, 12, 12), ("exact", "hard"))
    assert [scene.name for scene in found] == [
        "cubes-5", "cubes-5-hard", "cubes-12", "cubes-12-hard", "pointing-5-elastic", "free-5", "free-5-hard",
    ]  # fmt: skip
    assert [scene.problem.truss.bays for scene in found if scene.kind == "cubes"] == [5, 5, 12, 12]
    assert [scene.problem.method.tracking_mode for scene in found[:2]] == ["exact", "hard"]


@pytest.mark.parametrize(
    ("kind", "bays"), [("cubes", 10), ("cubes", 30), ("clutter", 50), ("tetrahedral", 14)]
)
def test_scenes_begin_clear_and_can_be_reached(kind: Any, bays: int) -> None:
    scene = scenes.make_scenes((kind,), (bays,), ("elastic",))[0]
    setup = build_arm(scene.problem.replace({"method.solver": "piqp"}))
    assert scene.bays == bays
    assert check_problem(scene.problem, setup) == []
    assert find_warnings(scene.problem, setup) == []
    assert len(scene.problem.obstacle) == {"cubes": 2, "clutter": 100, "tetrahedral": 0}[kind]


def test_every_step_of_a_longer_arm_has_a_cube_within_influence() -> None:
    scene = scenes.make_scenes(("cubes",), (10,), ("elastic",))[0]
    resolver, plan = resolver_and_plan(scene.problem)
    tip, value = resolver.tip()[0], 0.0
    for mark in plan.marks:
        assert resolver.follow(plan.path, value, float(mark)).status == "reached"
        value = float(mark)
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
    step = {"median": 2 * cpu, "p95": 3 * cpu, "p99": 4 * cpu, "cpu": cpu, "steps": 10}
    theirs = None if ratio is None else step | {"cpu": ratio * cpu}
    baseline = {"step": theirs, "ours": cpu, "ratio": ratio, "failed": 0, "skipped": ""}
    fresh = {"imports": 1.0, "setup": cpu, "first_step": 1.0, "peak_memory": 100, "imported_memory": 50}
    return {
        "name": f"{kind}-{bays}-elastic", "kind": kind, "bays": bays, "tracking": "elastic", "step": step,
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
    with pytest.MonkeyPatch.context() as patch, file.open("w") as stream:
        patch.setattr(sys, "stdout", stream)
        assert main([*tokens, "--baselines", "eq28", "ipopt", "--json"]) == 0
    return file


def test_json_is_one_document_of_the_schema(printed: Path) -> None:
    document = json.loads(printed.read_text())
    jsonschema.validate(document, DOCUMENT)
    (scene,) = document["scenes"]
    assert (scene["name"], scene["step"]["steps"], scene["cold"]) == ("free-5-elastic", 12, None)
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
    header, *_ = (line for line in out.splitlines() if line.startswith("| one step"))
    for word in ("median", "p95", "p99", "CPU", "distance", "qp", "correction", "other", "set-up", "memory"):
        assert word in header
    assert "| new / old" in out
    document = json.loads(printed.read_text())
    text = render(document)
    assert "eq. (28), dense pseudoinverse alone" in text
    assert text.count("| free-5") == 2


@pytest.mark.parametrize(
    ("tokens", "words"),
    [
        (["--scene", "moon"], ["moon", "tetrahedral"]),
        (["--baselines", "magic"], ["magic", "eq28-sparse"]),
        (["--bays", "many"], ["many"]),
        (["--bays", "20", "0"], ["--bays", "5"]),
        (["--steps", "0"], ["--steps"]),
        (["--seconds", "0"], ["--seconds"]),
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
