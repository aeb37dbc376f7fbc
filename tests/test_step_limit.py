"""No node moves further in one step than ``method.step_limit``, whatever moves the arm."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vgtm_qp as vq
from vgtm_qp.methods import with_method
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.stops import StopKind

ARMS = (
    "double_octahedral_past_a_cube",
    "five_bay_two_cubes_pointing",
    "hexapod_past_a_cube",
    "longeron_past_a_cube",
    "moving_base",
    "offset_joints_past_a_cube",
    "snake_past_a_cube",
    "tetrahedral_past_a_cube",
)


def limited(name: str, limit: float, **changes: object) -> vq.Problem:
    return vq.load_problem(name).replace({"method.step_limit": limit, "method.retries": False, **changes})


def furthest(before: np.ndarray, after: np.ndarray) -> float:
    return float(np.linalg.norm(after - before, axis=-1).max())


@pytest.mark.parametrize("name", ARMS)
def test_every_arm_keeps_it_and_gets_on(name):
    problem = limited(name, 0.03)
    resolver = vq.Resolver(build_arm(problem))
    free = vq.Resolver(build_arm(problem.replace({"method.step_limit": None})))
    start = resolver.tip()[0]
    goal = {"position": start + np.array([0.3, 0.05, -0.1])}
    if name == "five_bay_two_cubes_pointing":
        goal["pointing"] = [0.1, 0.0, 1.0]
    dt = 0.05
    assert furthest(free.state.nodes, free.step(**goal, dt=2.0).state.nodes) > 0.03
    for _ in range(6):
        before = resolver.state
        step = resolver.step(**goal, dt=dt)
        assert step.moved, step.reason
        assert step.status is vq.StepStatus.SLOWED
        assert furthest(before.nodes, step.state.nodes) <= 0.03
    assert np.linalg.norm(resolver.tip()[0] - start) > 0.03


@given(st.floats(2e-3, 0.1), st.lists(st.floats(-0.6, 0.6), min_size=3, max_size=3))
@settings(max_examples=15, deadline=None)
def test_the_null_space_keeps_it_too(limit, pull):
    """A control vertex is drawn away while the tip rests: no piece of path is there to be halved."""
    problem = limited("five_bay_free", limit)
    resolver = vq.Resolver(build_arm(problem))
    tip = resolver.tip()[0]
    resolver.set_control_vertex_goal(3, resolver.state.control_vertices[3] + pull)
    for _ in range(3):
        before = resolver.state
        step = resolver.step(position=tip)
        assert step.moved, step.reason
        assert furthest(before.nodes, step.state.nodes) <= limit


def test_a_maneuver_takes_more_steps_instead():
    maneuver = vq.solve(limited("five_bay_two_cubes", 0.03))
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok
    assert maneuver.steps > 80
    assert furthest(maneuver.nodes[:-1], maneuver.nodes[1:]) <= 0.03


@pytest.mark.parametrize("mode", ["hard", "elastic"])
def test_a_tip_that_stays_on_time_is_refused_by_name(mode):
    maneuver = vq.solve(limited("five_bay_two_cubes", 0.002, **{"end_effector.mode": mode}))
    assert maneuver.status == "blocked"
    assert maneuver.manifest["stop"]["kind"] == StopKind.STEP_LIMIT
    assert "method.step_limit, 0.002 m" in maneuver.manifest["stop"]["reason"]


def test_a_base_that_moves_further_is_refused_by_name():
    maneuver = vq.solve(limited("moving_base", 0.005))
    assert (maneuver.status, maneuver.blocked_by) == ("blocked", ("step limit",))


@pytest.mark.parametrize("method", ["qp-recursive", "pseudoinverse-sparse", "curve-pseudoinverse"])
def test_other_methods_keep_it(method):
    problem = with_method(limited("five_bay_free", 0.05), method)
    resolver = vq.Resolver(problem)
    path = resolver.setup.task.path_to(resolver.tip(), resolver.tip()[0] + [0.4, 0.0, 0.0], None, None)
    before = resolver.state
    step = resolver.follow(path, 0.0, 1.0)
    assert furthest(before.nodes, step.state.nodes) <= 0.05
    if method == "qp-recursive":
        assert 0.0 < step.progress < 1.0
    else:
        assert "method.step_limit, 0.05 m" in step.reason
        assert resolver.follow(path, 0.0, 0.05).moved


@given(st.floats(0.01, 0.04))
@settings(max_examples=5, deadline=None)
def test_an_arm_that_brakes_keeps_it(limit):
    problem = limited("five_bay_free", limit, **{"truss.acceleration": 0.5})
    resolver = vq.Resolver(build_arm(problem))
    goal = resolver.tip()[0] + [0.4, 0.0, -0.1]
    moved = 0
    for _ in range(12):
        before = resolver.state
        moved += (step := resolver.step(position=goal, dt=0.1)).moved
        assert furthest(before.nodes, step.state.nodes) <= limit
    before = resolver.state
    while (braked := resolver.brake()) is not None:
        assert furthest(before.nodes, braked.state.nodes) <= limit
        before = resolver.state
    assert moved > 6
