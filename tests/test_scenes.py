import numpy as np
import pytest

from vgtm_qp.step.build import build_arm
from vgtm_qp.study.robustness import draw, run, tasks, text
from vgtm_qp.study.scenes import MODULES, SAFE, random_scene


@pytest.mark.parametrize("number", [0, 2, 11, 17])
def test_a_scene_is_the_same_each_time_and_its_goal_is_a_clear_shape_of_its_arm(number):
    scene, again = random_scene(0, number), random_scene(0, number)
    assert scene.problem == again.problem
    setup = build_arm(scene.problem, compiled=False)
    states = [setup.arm.home]
    if scene.reachable:
        states.append(scene.shape)
        goal = scene.problem.maneuver.waypoint[0]
        setup.kinematics.evaluate(scene.shape)
        np.testing.assert_allclose(setup.arm.end_effector.position(scene.shape), goal.position, atol=1e-12)
        actuated = setup.arm.actuated
        lengths = setup.kinematics.quantities
        np.testing.assert_allclose(lengths[~actuated], setup.arm.home_quantities[~actuated], atol=1e-9)
        assert np.all(lengths >= setup.arm.stroke[:, 0] - 1e-9)
        assert np.all(lengths <= setup.arm.stroke[:, 1] + 1e-9)
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


def test_the_study_tells_what_was_solved_and_what_stopped_the_rest():
    assert tasks(False, scenes=3, seed=5) == [{"seed": 5, "number": k, "steps": 30} for k in range(3)]
    rows = [{**task, **run(**task)} for task in tasks(True, scenes=2, seed=0)]
    assert all(not row["failures"] for row in rows)
    assert all((row["status"] == "solved") != bool(row["stop"]) for row in rows)
    assert "scenes 0 to 1" in text(rows)
    assert draw(rows).axes
    assert text([]) == "No scene was run."
