import numpy as np
import pytest

from vgtm_qp.ipopt.separating import IpoptStepper
from vgtm_qp.step.build import build_arm
from vgtm_qp.study import Study
from vgtm_qp.study.robustness import run, tasks, text
from vgtm_qp.study.scenes import MODULES, SAFE, random_scene


@pytest.mark.parametrize("number", [0, 2, 11, 17])
def test_a_scene_is_the_same_each_time_and_its_goal_is_a_clear_shape_of_its_arm(number):
    scene, again = random_scene(0, number), random_scene(0, number)
    assert scene.problem == again.problem
    setup = build_arm(scene.problem, compiled=False)
    states = [setup.truss.home]
    if scene.reachable:
        states.append(scene.shape)
        goal = scene.problem.maneuver.waypoint[0]
        setup.kinematics.evaluate(scene.shape)
        np.testing.assert_allclose(setup.arm.end_effector.position(scene.shape), goal.position, atol=1e-12)
        actuated = setup.truss.actuated
        lengths = setup.kinematics.quantities
        np.testing.assert_allclose(lengths[~actuated], setup.arm.home_quantities[~actuated], atol=1e-9)
        assert np.all(lengths >= setup.truss.stroke[:, 0] - 1e-9)
        assert np.all(lengths <= setup.truss.stroke[:, 1] + 1e-9)
    for X in states:
        assert setup.least_clearance(X, 0.0, "members") >= setup.self_safe
        assert setup.least_clearance(X, 0.0, "obstacles") >= SAFE


def test_scenes_of_a_seed_are_of_every_module_with_and_without_direction_and_reach():
    scenes = [random_scene(1, k) for k in range(24)]
    assert {scene.problem.truss.module for scene in scenes} == set(MODULES)
    assert {scene.reachable for scene in scenes} == {True, False}
    assert {len(scene.problem.end_effector.track) for scene in scenes} == {1, 2}
    assert all(5 <= scene.problem.truss.bays <= 12 for scene in scenes)
    assert all(len(scene.problem.obstacle) <= 8 for scene in scenes)


def test_the_yardstick_keeps_lengths_strokes_and_clearance_and_meets_the_path():
    from vgtm_qp.maneuver.plan import make_plan
    from vgtm_qp.step.resolver import Resolver

    scene = random_scene(0, 19, steps=6)
    resolver = Resolver(build_arm(scene.problem, compiled=False))
    setup = resolver.setup
    plan = make_plan(scene.problem, *resolver.tip())
    states, values = IpoptStepper(setup).run(plan)
    assert values[-1] == pytest.approx(plan.path.end)
    for state, value in zip(states[1:], values[1:], strict=True):
        fixed = ~setup.truss.actuated
        assert np.abs(state.quantities - setup.arm.home_quantities)[fixed].max(initial=0.0) < 1e-9
        assert np.all(state.quantities <= setup.truss.stroke[:, 1] + 1e-8)
        assert setup.least_clearance(state.nodes, state.time, "obstacles") >= setup.safe - 1e-8
        assert setup.least_clearance(state.nodes, state.time, "members") >= setup.self_safe - 1e-8
        tip = setup.arm.end_effector.position(state.nodes)
        np.testing.assert_allclose(tip, plan.path.at(value).position, atol=1e-7)


def test_the_study_tells_what_was_solved_and_what_stopped_the_rest():
    assert tasks(False, scenes=3, seed=5) == [
        {"seed": 5, "number": k, "steps": 30, "solver": "vgtm"} for k in range(3)
    ]
    assert [task["solver"] for task in tasks(False, scenes=2, seed=5, ipopt=True)] == ["vgtm", "ipopt"] * 2
    rows = [{**task, **run(**task)} for task in tasks(True, scenes=2, seed=0)]
    assert all(not row["failures"] for row in rows)
    assert all((row["status"] == "solved") != bool(row["stop"]) for row in rows)
    study = Study.named("robustness")
    assert "scenes 0 to 1" in study.text(rows)
    assert study.draw(rows).axes
    yardstick = [{**row, "solver": "ipopt", "reached": 1.0} for row in rows]
    assert "IPOPT step by step comes through in 2 of 2" in study.text([*rows, *yardstick])
    assert text([]) == "No scene was run."
