"""Arms with limited accelerations: they slow down in time, come to rest when they must, and are never trapped."""

from __future__ import annotations

import numpy as np
import pytest

import vgtm_qp as vq
from vgtm_qp.maneuver.plan import Plan
from vgtm_qp.step.path import Path

CRATE = {"name": "crate", "shape": "box", "center": [0.9, 0.3, 1.8], "size": [0.5, 0.5, 0.5]}
WALL = {"name": "wall", "shape": "box", "center": [1.0, 0.0, 2.0], "size": [0.3, 6.0, 6.0]}


def problem(acceleration=0.1, **changes):
    data = {
        "name": "three bays",
        "truss": {"module": "octahedral", "bays": 3, "rate": 0.4, "acceleration": acceleration},
        "curve": {"control_vertices": 4},
        "maneuver": {
            "steps": 60,
            "waypoint": [
                {"time": 6.0, "position": [0.6, 0.0, 2.0]},
                {"time": 12.0, "position": [0.0, 0.6, 1.9]},
            ],
        },
        "method": {"retries": False},
    }
    return vq.Problem.from_dict(data).replace(changes)


def may_rest(truss, before, last, slack=1e-9):
    """Return whether no actuator moved faster in the last step than it can stop within one."""
    rate = (last.lengths - before.lengths)[truss.actuators] / last.duration
    return bool(np.all(np.abs(rate) <= truss.acceleration[truss.actuators] * last.duration + slack))


@pytest.mark.parametrize(("acceleration", "longest"), [(0.3, 13.0), (0.1, 14.0), (0.03, 25.0)])
def test_limited_accelerations_stretch_a_maneuver_round_a_corner(acceleration, longest):
    maneuver = vq.solve(problem(acceleration))
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    assert maneuver.certificate.acceleration_violation.value <= 1e-9
    assert maneuver.time[-1] <= longest


def test_a_maneuver_that_is_blocked_ends_where_the_arm_may_rest():
    goal = [{"time": 6.0, "position": [1.2, 0.0, 2.0]}]
    maneuver = vq.solve(problem(0.1, **{"obstacle": [WALL], "maneuver.waypoint": goal}))
    assert maneuver.status == "blocked"
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    rate = np.diff(maneuver.member_lengths[-2:], axis=0)[0] / np.diff(maneuver.time[-2:])
    assert np.abs(rate[maneuver.member_actuated]).max() <= 0.1 * np.diff(maneuver.time[-2:]) + 1e-9


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("obstacles", [[], [CRATE]])
def test_random_goals_in_a_control_loop_never_trap_a_moving_arm(seed, obstacles):
    resolver = vq.Resolver(problem(0.1, obstacle=obstacles))
    truss, random = resolver.arm.truss, np.random.default_rng(seed)
    steps, goal = [], np.zeros(3)
    for k in range(40):
        if k % 8 == 0:
            goal = np.array([0.0, 0.0, 2.0]) + random.uniform([-0.9, -0.9, -0.5], [0.9, 0.9, 0.5])
        before = resolver.state
        step = resolver.step(position=goal, dt=0.2)
        if step.status is vq.StepStatus.BLOCKED:
            assert may_rest(truss, steps[-1], before)
            continue
        steps.append(before)
        change = np.abs(step.state.length_rates - before.length_rates)[truss.actuators]
        interval = 0.5 * (step.state.duration + (before.duration or step.state.duration))
        assert np.all(change <= (truss.acceleration[truss.actuators] + 1e-9) * interval)
        if obstacles:
            assert resolver.arm.monitor.least(step.state.nodes, among="obstacles")[0] >= 0.05 - 1e-9
    assert len(steps) >= 30
    assert max(np.abs(state.length_rates).max() for state in steps) > 0.03


def test_an_arm_that_is_sent_back_brakes_first_and_says_so():
    resolver = vq.Resolver(problem(0.1))
    tip, _ = resolver.tip()
    for _ in range(8):
        resolver.step(position=[0.6, 0.0, 2.0], dt=0.2)
    way = resolver.tip()[0] - tip
    step = resolver.step(position=tip, dt=0.2)
    assert step.braked
    assert step.status is vq.StepStatus.SLOWED
    assert (resolver.tip()[0] - tip) @ way > way @ way
    for _ in range(60):
        step = resolver.step(position=tip, dt=0.2)
        if step.status is vq.StepStatus.REACHED:
            break
    assert step.status is vq.StepStatus.REACHED
    np.testing.assert_allclose(resolver.tip()[0], tip, atol=1e-6)


def test_a_goal_is_reached_from_far_and_held():
    resolver = vq.Resolver(problem(0.05))
    goal = np.array([0.0, 0.6, 1.9])
    for _ in range(80):
        resolver.step(position=goal, dt=0.2)
    np.testing.assert_allclose(resolver.tip()[0], goal, atol=1e-6)


def plan():
    poses = np.zeros((2, 3)), np.stack([np.eye(3)] * 2)
    return Plan(Path(np.array([0.0, 4.0]), *poses), np.array([1.0, 2.0, 3.0, 4.0]))


@pytest.mark.parametrize(
    ("value", "aim"), [(0.0, 1.0), (0.5, 1.0), (0.94, 1.0), (0.96, 2.0), (1.0, 2.0), (3.96, 4.0), (3.0, 4.0)]
)
def test_a_small_rest_of_a_piece_is_covered_with_the_next_one_but_for_the_last(value, aim):
    assert plan().next_mark(value) == (aim, 1.0)


@pytest.mark.parametrize(("value", "aim"), [(0.0, 1.0), (0.5, 1.5), (0.96, 2.0), (3.4, 4.0)])
def test_an_arm_that_keeps_moving_aims_a_whole_piece_ahead(value, aim):
    assert plan().next_mark(value, keeps_moving=True) == (aim, 1.0)
