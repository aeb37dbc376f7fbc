"""Honest stops: what is named is what holds the arm, and without it the arm gets further."""

from __future__ import annotations

import json

import numpy as np
import pytest
from arms import three_bays

import vgtm_qp as vq
from vgtm_qp.maneuver.retries import DeadEnd, bulge, retries
from vgtm_qp.step.stops import Stop, StopKind


def boxes(random):
    """Return two or three boxes beside the arm of which some stand in its way."""
    found = []
    for k in range(int(random.integers(2, 4))):
        center = [random.uniform(0.95, 1.2), random.uniform(-0.8, 0.8), random.uniform(1.0, 2.3)]
        found.append({"name": f"box {k}", "shape": "box", "center": center, "size": random.uniform(0.3, 0.6)})
    return found


@pytest.mark.dear
def test_without_the_named_obstacles_or_limits_a_blocked_arm_gets_further(rng):
    """In one of some 200 such scenes it then takes another way, into another dead end before the first one."""
    further = []
    for _ in range(10):
        obstacles = boxes(rng)
        blocked = vq.solve(three_bays(obstacle=obstacles))
        assert blocked.certificate.ok, blocked.certificate.failures()
        stop = blocked.manifest["stop"]
        if blocked.status == "solved":
            assert stop is None
            continue
        assert stop["multipliers"]
        assert all(value > 0.0 for value in stop["multipliers"].values())
        assert set(stop["obstacles"]) <= {entry["name"] for entry in obstacles}
        changes = {"obstacle": [entry for entry in obstacles if entry["name"] not in stop["obstacles"]]}
        if not stop["obstacles"]:
            changes = {"truss.stroke": [0.4, 1.7], "clearance.self_collision": False, "obstacle": obstacles}
        freer = vq.solve(three_bays(**changes))
        further.append(freer.status == "solved" or freer.reached > blocked.reached + 1e-3)
    assert further.count(False) <= 1


@pytest.mark.parametrize("_", range(10))
def test_where_it_stops_an_arm_goes_on_at_once_without_the_named_obstacles(_, rng):
    problem = three_bays(obstacle=boxes(rng))
    resolver, goal = vq.Resolver(problem), np.array(problem.maneuver.waypoint[-1].position)
    for _ in range(80):
        step = resolver.step(position=goal)
        if step.status is vq.StepStatus.REACHED or not step.moved or step.progress < 1e-4:
            break
    left = np.linalg.norm(goal - resolver.tip()[0])
    if step.status is vq.StepStatus.REACHED:
        return
    path = resolver.setup.task.path_to(resolver.tip(), goal, None, None)
    stop = resolver.explain(path, 0.0, 1.0, last=step)
    assert stop.obstacles
    for name in stop.obstacles:
        resolver.remove_obstacle(name)
    for _ in range(3):
        resolver.step(position=goal)
    assert np.linalg.norm(goal - resolver.tip()[0]) < left - 1e-3


def test_some_of_the_random_scenes_are_blocked_by_obstacles():
    kinds = [
        vq.solve(three_bays(obstacle=boxes(np.random.default_rng(seed))), verify=False).manifest["stop"]
        for seed in range(6)
    ]
    assert any(stop and stop["kind"] == "obstacle" for stop in kinds)


def test_the_wall_is_named_and_the_set_is_small():
    maneuver = vq.solve(vq.load_problem("five_bay_blocked_by_wall"))
    stop = maneuver.manifest["stop"]
    assert (stop["kind"], stop["obstacles"]) == ("obstacle", ["wall"])
    assert 1 <= len(stop["multipliers"]) <= 6
    assert set(maneuver.blocked_by) == set(stop["multipliers"])
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    json.dumps(maneuver.manifest, allow_nan=False)


@pytest.mark.parametrize("name", ["east / wall", "wall: its upper part", "member L2-1 / wall"])
def test_an_obstacle_is_named_whatever_its_name_contains(name):
    """Names of rows have colons and slashes too, and the name of an obstacle may end with that of another."""
    wall = {"name": name, "shape": "box", "center": [1.3, 0.0, 2.5], "size": [0.2, 8.0, 8.0]}
    away = {"name": "wall", "shape": "box", "center": [-9.0, 0.0, 2.5], "size": 0.2}
    problem = vq.load_problem("five_bay_blocked_by_wall")
    stop = vq.solve(problem.replace({"obstacle": [away, wall], "method.retries": False})).manifest["stop"]
    assert (stop["kind"], stop["obstacles"]) == ("obstacle", [name])
    changed = {
        change["name"] for remedy in stop["remedies"] for change in remedy if change["kind"] == "clearance"
    }
    assert changed == {name}


@pytest.mark.smoke
def test_a_stretched_arm_is_out_of_reach_of_what_lies_further():
    waypoint = [{"time": 4.0, "position": [0.0, 0.0, 2.62]}]
    maneuver = vq.solve(three_bays(**{"maneuver.waypoint": waypoint, "truss.stroke": [0.9, 1.2]}))
    assert maneuver.status == "blocked"
    stop = maneuver.manifest["stop"]
    assert stop["kind"] in ("out of reach", "stroke")
    assert all(name.startswith("stroke: ") for name in stop["multipliers"])
    wider = vq.solve(three_bays(**{"maneuver.waypoint": waypoint, "truss.stroke": [0.5, 1.6]}))
    assert wider.reached > maneuver.reached


def test_a_resolver_explains_a_stop_in_a_control_loop_and_keeps_its_state():
    resolver = vq.Resolver(
        three_bays(
            obstacle=[{"name": "wall", "shape": "box", "center": [1.2, 0.0, 2.0], "size": [0.3, 6.0, 6.0]}]
        )
    )
    step = None
    for _ in range(40):
        step = resolver.step(position=[1.3, 0.0, 2.2])
        if step.status is vq.StepStatus.BLOCKED or step.progress < 1e-6:
            break
    before = resolver.state
    from vgtm_qp.step.path import Path

    here, rotation = resolver.tip()
    path = Path(np.array([0.0, 1.0]), np.stack([here, [1.3, 0.0, 2.2]]), np.stack([rotation] * 2))
    stop = resolver.explain(path, 0.0, 1.0, last=step)
    assert stop.kind is StopKind.OBSTACLE
    assert stop.obstacles == ("wall",)
    assert "wall" in str(stop)
    assert resolver.state is before


@pytest.mark.parametrize("bad", [[np.nan, 0.0, 1.0], [np.inf, 0.0, 1.0], [1.0, 2.0], "up"])
def test_a_target_that_is_no_number_is_refused_and_the_state_kept(bad):
    resolver = vq.Resolver(three_bays())
    resolver.step(position=[0.1, 0.0, 2.4])
    before = resolver.state
    with pytest.raises(vq.GoalError, match="unchanged"):
        resolver.step(position=bad)
    assert resolver.state is before


def test_another_way_out_is_tried_before_giving_up_and_can_be_turned_off():
    wall = vq.load_problem("five_bay_blocked_by_wall")
    patient, hasty = vq.solve(wall), vq.solve(wall.replace({"method.retries": False}))
    assert hasty.manifest["way_out"] == ""
    assert patient.reached >= hasty.reached


def dead_end(kind=StopKind.OBSTACLE, vertices=6, away=(-2.0, 0.0, -1.0)):
    curve = np.column_stack([np.zeros((vertices, 2)), np.linspace(0.0, 2.5, vertices)])
    return DeadEnd(Stop(kind, away=away), curve, 2.5, np.array([0.0, 1.0, 0.0]))


@pytest.mark.smoke
def test_a_bulge_is_drawn_across_the_arm_to_four_sides_and_keeps_base_and_tip():
    end = dead_end()
    drawn = [bulge(end, quarter) - end.control_vertices for quarter in range(4)]
    for quarter, (x, y) in enumerate([(-1.0, 0.0), (0.0, -1.0), (1.0, 0.0), (0.0, 1.0)]):
        np.testing.assert_allclose(drawn[quarter][[0, -1]], 0.0, atol=1e-12)
        middle = drawn[quarter][2:4]
        assert np.linalg.norm(middle, axis=1).min() > 0.2 * 2.5
        np.testing.assert_allclose(
            middle / np.linalg.norm(middle, axis=1)[:, None], [[x, y, 0.0]] * 2, atol=1e-12
        )


@pytest.mark.parametrize("away", [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
def test_an_arm_that_no_obstacle_pushes_aside_is_bulged_the_way_its_path_goes_on(away):
    end = dead_end(away=away)
    moved = bulge(end, 0) - end.control_vertices
    assert moved[2, 1] > 0.5
    np.testing.assert_allclose(moved[:, [0, 2]], 0.0, atol=1e-12)


@pytest.mark.smoke
def test_the_ways_out_are_those_that_a_problem_has():
    patient = three_bays(**{"method.retries": True})
    ways = dict(retries(patient, dead_end(vertices=4)))
    assert list(ways) == ["more control vertices", "elastic tracking"]
    assert ways["more control vertices"].method == patient.method
    elastic = patient.replace({"method.tracking_mode": "elastic"})
    assert ways["elastic tracking"] == elastic
    names = [name for name, _ in retries(elastic, dead_end(vertices=4))]
    assert names[0] == "actuators drawn to their home lengths"
    assert [name.startswith("curve bulged") for name in names] == [False] + 5 * [True] + 5 * [False]
    assert len(set(names)) == len(names)
    for name, other in retries(elastic, dead_end(vertices=4)):
        assert other != elastic, name
    assert not list(retries(three_bays(), dead_end()))
    for kind in (StopKind.SINGULAR, StopKind.OUT_OF_REACH, StopKind.LOCKED, StopKind.INTERRUPTED):
        assert not list(retries(patient, dead_end(kind)))
    bare = patient.replace({"method.tracking": "none"})
    found = [name for name, _ in retries(bare, dead_end(vertices=0))]
    assert not any("curve" in name or "vertices" in name for name in found)
    drawn = patient.replace({"curve.control_vertex_goals": [{"index": 2, "position": [0.1, 0.0, 1.5]}]})
    assert not any("bulged" in name for name, _ in retries(drawn, dead_end(vertices=4)))


@pytest.mark.dear
@pytest.mark.slow
@pytest.mark.parametrize(("seed", "number", "way"), [(0, 9, "actuators drawn"), (0, 57, "curve bulged")])
def test_a_dead_end_of_one_shape_is_passed_in_another(seed, number, way):
    from vgtm_qp.study.scenes import random_scene

    scene = random_scene(seed, number).problem.replace({"method.tracking_mode": "elastic"})
    assert vq.solve(scene.replace({"method.retries": False}), verify=False).status == "blocked"
    maneuver = vq.solve(scene)
    assert maneuver.status == "solved"
    assert maneuver.manifest["way_out"].startswith(way)
    assert maneuver.manifest["way_out"]
    assert maneuver.certificate.ok, maneuver.certificate.failures()


@pytest.mark.slow
def test_a_dead_end_of_a_curve_that_gives_way_too_late_is_passed_on_a_more_flexible_one():
    maneuver = vq.solve(vq.load_problem("five_bay_two_cubes_pointing"))
    assert maneuver.status == "solved"
    assert maneuver.manifest["way_out"] == "more control vertices"
    assert maneuver.certificate.states_off_curve.value == 0.0
    assert maneuver.certificate.ok, maneuver.certificate.failures()


@pytest.mark.parametrize("method", [{}, {"tracking": "none"}, {"tracking": "recursive"}])
@pytest.mark.parametrize("speed", [1e4, 100.0, 3.0])
def test_an_obstacle_that_strikes_the_arm_is_named_however_fast(method, speed):
    duration, steps = 2.0, 4
    # It arrives in the middle of the third step.
    center = [1.0 + 0.6 * duration * speed, 0.0, 1.2]
    thing = {"name": "thrown", "shape": "box", "center": center, "size": 0.4, "velocity": [-speed, 0.0, 0.0]}
    waypoint = {"time": duration, "position": [0.1, 0.0, 2.3]}
    maneuver = {"steps": steps, "waypoint": [waypoint]}
    changes = {"obstacle": [thing], "maneuver": maneuver, "method": {"retries": False, **method}}
    found = vq.solve(three_bays(**changes))
    assert found.certificate.ok, found.certificate.failures()
    stop = found.manifest["stop"]
    assert (stop["kind"], stop["obstacles"]) == ("obstacle", ["thrown"])
    assert found.blocked_by[0].endswith("/ thrown")
