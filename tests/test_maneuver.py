"""Whole maneuvers: the bundled scenes come through, a wall stops the arm safely, random scenes do no harm."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import modules
import numpy as np
import pytest
from arms import arm_problem
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from vgtm_qp.errors import ProblemError
from vgtm_qp.maneuver.solve import solve
from vgtm_qp.problem import Problem, load_problem
from vgtm_qp.step.qp_resolver import QPResolver
from vgtm_qp.step.step import StepStatus
from vgtm_qp.study.varied import varied_scene
from vgtm_qp.verify import verify

PROBLEMS = Path(__file__).parents[1] / "problems"
SCENES = ("five_bay_free", "five_bay_two_cubes", "five_bay_two_cubes_pointing")


@cache
def solved(name, solver="daqp"):
    return solve(load_problem(PROBLEMS / f"{name}.toml").replace({"method.solver": solver}))


def recheck(maneuver):
    """What a person would check with the arrays in hand and a tape measure."""
    truss = maneuver.manifest["problem"]["truss"]
    ends = maneuver.nodes[:, maneuver.members]
    lengths = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2)
    np.testing.assert_allclose(maneuver.member_lengths, lengths, atol=1e-12)
    fixed = ~maneuver.member_actuated
    assert np.max(np.abs(lengths - lengths[0])[:, fixed]) <= 1e-9
    least, greatest = truss["stroke"]
    assert lengths[:, ~fixed].min() >= least - 1e-9
    assert lengths[:, ~fixed].max() <= greatest + 1e-9
    rate = np.diff(lengths, axis=0) / np.diff(maneuver.time)[:, None]
    assert np.abs(rate).max() <= truss["rate"] + 1e-9
    np.testing.assert_allclose(maneuver.tip_position, maneuver.tip_target_position, atol=1e-6)
    assert np.all(np.diff(maneuver.time) > 0.0)
    assert np.all(np.diff(maneuver.progress) >= 0.0)


@pytest.mark.parametrize("name", SCENES)
def test_bundled_scenes_come_through_in_fifty_steps(name):
    maneuver = solved(name)
    assert maneuver.status == "solved"
    assert maneuver.blocked_by == ()
    assert maneuver.steps == 50
    assert maneuver.reached == pytest.approx(1.0)
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    np.testing.assert_allclose(maneuver.time, np.linspace(0.0, 10.0, 51), atol=1e-12)
    np.testing.assert_allclose(maneuver.tip_position[-1], [1.6, 0.0, 3.3], atol=1e-6)
    recheck(maneuver)
    if name != "five_bay_free":
        assert maneuver.clearance.min() >= 0.08 - 1e-9
    if name.endswith("pointing"):
        assert np.abs(maneuver.tip_rotation[:, :2, 2]).max() <= 1e-6


@pytest.mark.parametrize("solver", ["osqp", "piqp"])
@pytest.mark.parametrize("name", SCENES[:2])
def test_other_solvers_make_the_same_maneuver(name, solver):
    default, other = solved(name), solved(name, solver)
    assert other.certificate.ok, other.certificate.failures()
    assert other.steps == default.steps
    np.testing.assert_allclose(other.nodes, default.nodes, atol=1e-4)
    np.testing.assert_allclose(other.control_vertices, default.control_vertices, atol=1e-4)


def test_the_same_problem_gives_the_same_maneuver():
    problem = load_problem(PROBLEMS / "five_bay_two_cubes.toml").replace({"maneuver.steps": 20})
    first, second = (solve(problem, verify=False) for _ in range(2))
    np.testing.assert_array_equal(first.nodes, second.nodes)
    np.testing.assert_array_equal(first.control_vertices, second.control_vertices)


@pytest.mark.parametrize("solver", ["daqp", "piqp"])
def test_a_wall_stops_the_arm_safely_and_is_named(solver):
    maneuver = solved("five_bay_blocked_by_wall", solver)
    assert maneuver.status == "blocked"
    assert 0.4 < maneuver.reached < 0.9
    assert any("wall" in name for name in maneuver.blocked_by), maneuver.blocked_by
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    assert maneuver.clearance.min() >= 0.08 - 1e-9
    assert maneuver.tip_position[:, 0].max() < 1.2
    recheck(maneuver)


def test_out_of_reach_the_limits_are_named():
    """A target beyond the strokes: the arm stretches, stops, and says which actuators end there."""
    maneuver = solve(arm_problem((0.0, 0.0, 2.62), bays=3, steps=15, truss={"stroke": [0.9, 1.2]}))
    assert maneuver.status == "blocked"
    assert 0.05 < maneuver.reached < 0.95
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    ends = np.abs(maneuver.member_lengths[-1] - 0.9) < 1e-6
    at_the_end = {f"stroke: {name}" for name in maneuver.member_names[ends]}
    assert at_the_end & set(maneuver.blocked_by), maneuver.blocked_by


def test_slow_actuators_take_more_steps_and_more_time():
    fast = solve(arm_problem((0.4, 0.1, 1.3), steps=8, time=2.0, truss={"rate": 0.5}))
    slow = solve(arm_problem((0.4, 0.1, 1.3), steps=8, time=2.0, truss={"rate": 0.06}))
    assert fast.status == slow.status == "solved"
    assert fast.steps == 8 < slow.steps
    assert slow.time[-1] > fast.time[-1] == pytest.approx(2.0)
    assert slow.certificate.ok, slow.certificate.failures()
    np.testing.assert_allclose(slow.tip_position[-1], fast.tip_position[-1], atol=1e-6)


@pytest.mark.smoke
def test_an_arm_that_covers_half_of_what_is_left_in_each_step_arrives(monkeypatch):
    """It came within 1e-16 of the end and went on: progress was compared with what was left alone."""
    follow = QPResolver.follow

    def half(self, path, start, end, *, dt=None):
        step = follow(self, path, start, start + 0.5 * (end - start), dt=dt)
        return replace(step, status=StepStatus.SLOWED, progress=0.5 * step.progress)

    monkeypatch.setattr(QPResolver, "follow", half)
    maneuver = solve(load_problem("five_bay_free").replace({"maneuver.steps": 4}))
    assert maneuver.status == "solved"
    assert len(maneuver.time) < 80
    assert maneuver.certificate.tip_error.value < 1e-8


def test_waypoints_are_all_passed():
    data = arm_problem((0.35, 0.0, 1.35), steps=12, time=3.0).to_dict()
    data["maneuver"]["waypoint"].append({"time": 6.0, "position": [0.0, 0.3, 1.4]})
    data["maneuver"]["waypoint"].append({"time": 9.0, "position": [0.0, 0.0, 1.6]})
    maneuver = solve(Problem.from_dict(data))
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    for waypoint in data["maneuver"]["waypoint"]:
        row = int(np.argmin(np.abs(maneuver.time - waypoint["time"])))
        np.testing.assert_allclose(maneuver.tip_position[row], waypoint["position"], atol=1e-6)


def test_a_moving_obstacle_is_kept_away_from_at_its_own_time():
    cart = {"name": "cart", "shape": "sphere", "center": [-1.5, 0.3, 1.0], "radius": 0.3}
    problem = arm_problem(
        (0.3, 0.0, 1.4),
        steps=12,
        time=6.0,
        obstacle=[cart | {"velocity": [0.12, 0.0, 0.0]}],
        clearance={"safe": 0.05},
    )
    maneuver = solve(problem)
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    assert maneuver.status == "solved"


def test_progress_is_told_and_an_interrupt_keeps_what_was_solved():
    told = []
    problem = arm_problem((0.3, 0.1, 1.4), steps=6)
    whole = solve(problem, progress=lambda part, step: told.append(part))
    assert told == pytest.approx(whole.progress[1:].tolist())

    def stop(part, step):
        if part > 0.4:
            raise KeyboardInterrupt

    partial = solve(problem, progress=stop)
    assert partial.status == "blocked"
    assert partial.blocked_by == ("interrupted",)
    assert partial.steps == 3
    assert partial.certificate.ok, partial.certificate.failures()
    np.testing.assert_array_equal(partial.nodes, whole.nodes[:4])


@pytest.mark.smoke
def test_without_verification_there_is_no_certificate():
    maneuver = solve(arm_problem((0.2, 0.0, 1.45), steps=3), verify=False)
    assert maneuver.certificate is None
    assert verify(maneuver).ok


unit = st.floats(-1.0, 1.0)


@st.composite
def scenes(draw):
    """Arms of two to six bays with limits, up to three cubes, and a target that may well be out of reach."""
    bays = draw(st.sampled_from([2, 3, 4, 6]))
    truss = {"member_radius": draw(st.sampled_from([0.0, 0.03]))}
    if draw(st.booleans()):
        truss["rate"] = draw(st.floats(0.05, 0.5))
    if draw(st.booleans()):
        truss["acceleration"] = draw(st.floats(0.05, 1.0))
    if draw(st.booleans()):
        truss["stroke"] = [draw(st.floats(0.6, 0.95)), draw(st.floats(1.05, 1.5))]
    height = bays * np.sqrt(2.0 / 3.0)
    cubes = [
        {
            "name": f"cube {k}",
            "shape": "box",
            "center": [1.6 * draw(unit), 1.6 * draw(unit), height * (0.55 + 0.75 * draw(unit))],
            "size": draw(st.floats(0.15, 1.2)),
            "rotation_vector": [draw(unit) for _ in range(3)] if draw(st.booleans()) else [0.0, 0.0, 0.0],
        }
        for k in range(draw(st.integers(0, 3)))
    ]
    reach = 0.4 * height
    pointing = bays > 2 and draw(st.booleans())
    return arm_problem(
        [reach * draw(unit), reach * draw(unit), height + reach * (draw(unit) - 0.6)],
        bays=bays,
        steps=draw(st.integers(3, 8)),
        time=draw(st.sampled_from([0.4, 4.0])),
        truss=truss,
        waypoint={"pointing": [0.3 * draw(unit), 0.3 * draw(unit), 1.0] if pointing else None},
        end_effector={"track": ["position", "pointing"] if pointing else ["position"]},
        obstacle=cubes,
        clearance={"safe": draw(st.sampled_from([0.0, 0.02, 0.1])), "influence": 0.4},
    )


def is_free_at_home(problem):
    """Whether the bounding sphere of every cube keeps away from the straight arm."""
    truss = modules.octahedral(problem.truss.bays)
    share = np.linspace(0.0, 1.0, 41)[:, None]
    points = np.concatenate([(1 - share) * truss.home[a] + share * truss.home[b] for a, b in truss.members])
    return all(
        np.linalg.norm(points - np.array(cube.center), axis=1).min()
        > 0.5 * np.sqrt(3.0) * np.max(cube.size) + problem.truss.member_radius + problem.clearance.safe
        for cube in problem.obstacle
    )


@pytest.mark.dear
@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(problem=scenes())
def test_whatever_comes_out_of_a_random_scene_is_verified(problem):
    assume(is_free_at_home(problem))
    try:
        maneuver = solve(problem)
    except ProblemError:
        assume(False)
    certificate = maneuver.certificate
    assert certificate.ok, (maneuver.status, certificate.failures())
    assert maneuver.status in ("solved", "blocked")
    assert (maneuver.status == "solved") == (maneuver.reached >= 1.0 - 1e-9)
    assert bool(maneuver.blocked_by) == (maneuver.status == "blocked")
    if problem.obstacle:
        assert maneuver.clearance.min() >= problem.clearance.safe - 1e-9


def test_a_tip_that_stays_on_time_takes_shorter_steps_where_a_whole_one_is_blocked():
    """A snake of 26 joints; as a whole its first step turns it too far for the QPs to converge."""
    problem = varied_scene(1991, 32, steps=10, arms="serial")
    assert problem.end_effector.mode == "hard"
    maneuver = solve(
        problem.replace({"method": problem.method.kept_by("qp", "none"), "method.retries": False})
    )
    assert (maneuver.status, maneuver.certificate.failures()) == ("solved", ())
    np.testing.assert_allclose(maneuver.time, 10.0 * maneuver.progress, atol=1e-9)
    durations = np.diff(maneuver.time)
    assert durations.min() < 0.6
    assert durations.max() < 1.0 + 1e-9
