import json

import numpy as np
import pytest
from sampled_motions import is_safe, spare

from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.maneuver.solve import solve
from vgtm_qp.methods import Resolver
from vgtm_qp.methods.ipopt import NonlinearResolver
from vgtm_qp.step.build import build_arm
from vgtm_qp.study.robustness import draw, features, kind_of, run, solve_by_ipopt, tasks, text
from vgtm_qp.study.scenes import MODULES, SAFE, random_scene
from vgtm_qp.study.varied import varied_scene


def told(problem):
    """What a problem says but for its numbers, and these."""
    values = []
    words = json.loads(json.dumps(problem.to_dict()), parse_float=lambda text: values.append(float(text)))
    return words, np.array(values)


@pytest.mark.parametrize("number", [0, 2, 11, 17])
def test_a_scene_is_the_same_each_time_and_its_goal_is_a_clear_shape_of_its_arm(number):
    scene, again = random_scene(0, number), random_scene(0, number)
    (words, values), (words_again, values_again) = told(scene.problem), told(again.problem)
    assert words == words_again
    # The last digits of LAPACK's solutions depend on where in the memory its arrays are.
    np.testing.assert_allclose(values, values_again, rtol=0.0, atol=1e-12)
    setup = build_arm(scene.problem, solves=False)
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
    assert tasks(False, scenes=3, seed=5) == [
        {"seed": 5, "steps": 30, "arms": "trusses", "number": number, "compiler": compiler}
        for number, compiler in ((0, True), (0, False), (1, True), (2, True))
    ]
    both = [True, False, True, True, False]
    assert [task["compiler"] for task in tasks(False, scenes=3, without_compiler=2)] == both
    rows = [{**task, **run(**task)} for task in tasks(True, scenes=2, seed=0)]
    assert all(not row["failures"] for row in rows)
    assert all((row["status"] == "solved") != bool(row["stop"]) for row in rows)
    assert rows[0]["status"] == rows[1]["status"]
    assert "scenes 0 to 1" in text(rows)
    assert "1 of 1 end with the same status" in text(rows)
    assert draw(rows).axes
    assert text([]) == "No scene was run."


def test_scenes_of_a_seed_have_everything_that_a_problem_may_say():
    scenes = [varied_scene(3, k) for k in range(40)]
    found = {words for scene in scenes for words in features(scene)}
    assert found >= {
        *("a direction of the tip", "offset joints", "limited accelerations", "jams", "a moving base"),
        *("moving obstacles", "obstacles: sphere", "obstacles: cylinder", "obstacles: mesh", "no curve"),
        *("a general curve", "curve: bezier", "curve: b-spline", "curve: beta-spline"),
        *("tip: scaled", "tip: hard", "tip: elastic"),
    }
    assert {scene.method.tracking_mode for scene in scenes} == {"exact", "hard", "elastic"}
    assert varied_scene(3, 0).to_dict() == scenes[0].to_dict()


def test_serial_scenes_have_everything_that_a_problem_may_say_about_serial_arms():
    scenes = [varied_scene(3, k, arms="serial") for k in range(40)]
    found = {words for scene in scenes for words in features(scene)}
    assert found >= {
        *(
            "a direction of the tip",
            "an attitude of the tip",
            "limited accelerations",
            "jams",
            "a moving base",
        ),
        *("moving obstacles", "obstacles: sphere", "obstacles: cylinder", "obstacles: mesh", "no curve"),
        *("a general curve", "tip: scaled", "tip: hard", "tip: elastic"),
    }
    assert {kind_of(scene) for scene in scenes} == {"snake", "joints that turn", "joints that turn or slide"}
    assert {scene.arm.body is None for scene in scenes} == {True, False}
    assert {any(joint.limits is None for joint in scene.arm.joint) for scene in scenes} == {True, False}
    assert varied_scene(3, 0, arms="serial").to_dict() == scenes[0].to_dict()
    for scene in scenes[:8]:
        setup = build_arm(scene, solves=False)
        resting = scene.replace(
            {"obstacle": [{**o, "velocity": (0, 0, 0)} for o in scene.to_dict()["obstacle"]]}
        )
        home = build_arm(resting, solves=False).least_clearance(
            setup.arm.home_configuration, 0.0, "obstacles"
        )
        assert home >= scene.clearance.safe


@pytest.mark.dear
@pytest.mark.anew
@pytest.mark.parametrize("arms", ["trusses", "serial"])
def test_no_scene_of_a_new_seed_is_unsafe_or_ends_without_a_word(rng, arms):
    """Scenes that nobody has seen, by the independent certificate; every tenth without a compiler, too."""
    seed, count = int(rng.integers(2**31)), 40 if arms == "trusses" else 12
    rows = [{**task, **run(**task)} for task in tasks(False, scenes=count, seed=seed, steps=12, arms=arms)]
    assert [row for row in rows if row["failures"]] == []
    refused = [row for row in rows if row["status"] == "refused"]
    assert all("expected" in row["blocked_by"] for row in refused)
    assert len(refused) < 10
    tried = [row for row in rows if row["status"] != "refused"]
    assert {row["status"] for row in tried} <= {"solved", "blocked"}
    assert all((row["status"] == "solved") != bool(row["stop"]) for row in tried)


@pytest.mark.dear
@pytest.mark.parametrize("number", [1, 10, 43])
def test_sampled_motions_agree_with_the_certificate_and_show_a_clearance_that_is_not_kept(number):
    maneuver = solve(varied_scene(1991, number, arms="serial"))
    random, certificate = np.random.default_rng(number), maneuver.certificate
    rules = maneuver.manifest["problem"]["clearance"]
    rules["self_safe"] = rules["safe"] / 4.0
    floors = rules["safe"], rules["self_safe"]

    def room(name):
        found = certificate.measures[name], certificate.measures[f"self_{name}"]
        return min(measure.value - floor for measure, floor in zip(found, floors, strict=True))

    least = spare(maneuver, 100, random)
    assert is_safe(maneuver, least)
    # Points of the surface of a hull are a little further away than the hull.
    coarse = any(len(body["points"]) > 2 for body in maneuver.manifest["problem"]["arm"].get("body") or ())
    grid = 2e-3 if coarse else 1e-8
    assert room("clearance") - 1e-8 <= least["at"][0] <= room("clearance") + grid
    assert least["between"][0] >= room("clearance_between") - 1e-8
    rules["safe"] = certificate.clearance.value + 1e-3
    more = spare(maneuver, 20, random)
    assert -1e-3 - 1e-8 <= more["at"][0] <= (0.0 if coarse else -1e-3 + 1e-8)
    assert not is_safe(maneuver, more)


@pytest.mark.dear
@pytest.mark.parametrize("arms", ["trusses", "serial"])
def test_ipopt_solves_scenes_step_by_step_with_exact_states(arms):
    given = tasks(False, scenes=2, seed=7, steps=12, arms=arms, without_compiler=9, against="ipopt")
    assert [task.get("against") for task in given] == [None, "ipopt", None, None, "ipopt"]
    rows = [{**task, **run(**task)} for task in given]
    theirs = [row for row in rows if row.get("against")]
    assert all(row["failures"] == row["between"] for row in theirs)
    assert any(row["status"] == "solved" for row in theirs)
    assert "by IPOPT without any curve" in text(rows)


@pytest.mark.dear
@pytest.mark.parametrize("number", [4, 7, 15, 21, 28])
def test_a_scene_for_ipopt_keeps_tip_and_limits_of_every_kind(number):
    """Hard and elastic tips, limited accelerations, jams; what is not exact at states would be a failure."""
    maneuver = solve_by_ipopt(varied_scene(1991, number, arms="serial"))
    assert maneuver.steps > 5
    assert [line for line in maneuver.certificate.failures() if "between" not in line] == []


@pytest.mark.parametrize("number", [10, 20])
def test_ipopt_finds_no_worse_step_than_the_qp_and_nearly_the_same_short_one(number):
    scene = varied_scene(1991, number, arms="serial")
    changes = {"method": scene.method.kept_by("qp", "none"), "obstacle": [], "end_effector.mode": "hard"}
    scene = scene.replace(changes)
    setup, weights = Resolver(scene).setup, scene.method.weights
    arm = setup.arm

    def cost(q):
        change, off_home = (
            arm.levers * (q - start)[arm.actuators] for start in (home, arm.home_configuration)
        )
        moved = arm.nodes(q) - arm.nodes(home)
        terms = (
            (weights.node_rate, moved),
            (weights.actuator_rate, change),
            (weights.stroke_centring, off_home),
        )
        return sum(weight * float(np.sum(values**2)) for weight, values in terms)

    home = arm.home_configuration
    for share in (1.0, 0.05):
        found = []
        for resolver in (Resolver(scene), NonlinearResolver(scene)):
            plan = make_plan(scene, *resolver.tip())
            end = share * float(plan.marks[0])
            step = resolver.follow(plan.path, 0.0, end, dt=end)
            assert step.status == "reached"
            np.testing.assert_allclose(resolver.tip()[0], plan.path.at(end).position, atol=1e-8)
            found.append(step.state.q)
        assert cost(found[1]) <= cost(found[0]) * (1.0 + 1e-5)
    assert np.abs(found[1] - found[0]).max() < 0.1 * np.abs(found[0] - home).max()


def test_an_arm_that_brakes_in_a_shorter_step_does_not_pass_a_jam():
    """The steps that bring it to rest have durations of their own."""
    maneuver = solve(varied_scene(20261215, 260, arms="serial"))
    assert maneuver.certificate.ok, maneuver.certificate.failures()
