"""Arms with limited accelerations: they slow down in time, come to rest when they must, and are never trapped."""

from __future__ import annotations

import numpy as np
import pytest

import vgtm_qp as vq
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.maneuver.plan import Plan
from vgtm_qp.step.path import Path

CRATE = {"name": "crate", "shape": "box", "center": [0.9, 0.3, 1.8], "size": [0.5, 0.5, 0.5]}
KNOWN = [0, 1, None]
"""Seeds of goals that make the arm brake; of those that are drawn anew only what must hold of all is asserted."""

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
    rate = (last.quantities - before.quantities)[truss.actuators] / last.duration
    return bool(np.all(np.abs(rate) <= truss.acceleration[truss.actuators] * last.duration + slack))


@pytest.mark.parametrize(("acceleration", "longest"), [(0.3, 13.0), (0.1, 14.0), (0.03, 28.0)])
def test_limited_accelerations_stretch_a_maneuver_round_a_corner(acceleration, longest):
    maneuver = vq.solve(problem(acceleration))
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    assert maneuver.certificate.acceleration_violation.value <= 1e-9
    assert maneuver.time[-1] <= longest


def test_a_maneuver_that_is_blocked_ends_where_the_arm_may_rest():
    goal = [{"time": 6.0, "position": [1.2, 0.0, 2.0]}]
    maneuver = vq.solve(problem(0.1, **{"obstacle": [WALL], "maneuver.waypoint": goal, "maneuver.steps": 20}))
    assert maneuver.status == "blocked"
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    rate = np.diff(maneuver.member_lengths[-2:], axis=0)[0] / np.diff(maneuver.time[-2:])
    assert np.abs(rate[maneuver.member_actuated]).max() <= 0.1 * np.diff(maneuver.time[-2:]) + 1e-9


@pytest.mark.parametrize("known", KNOWN)
@pytest.mark.parametrize("obstacles", [[], [CRATE]])
def test_random_goals_in_a_control_loop_never_trap_a_moving_arm(known, obstacles, rng):
    resolver = vq.Resolver(problem(0.1, obstacle=obstacles))
    rng = rng if known is None else np.random.default_rng(known)
    truss = truss_of(resolver.setup.arm)
    steps, goal = [], np.zeros(3)
    for k in range(40):
        if k % 8 == 0:
            goal = np.array([0.0, 0.0, 2.0]) + rng.uniform([-0.9, -0.9, -0.5], [0.9, 0.9, 0.5])
        before = resolver.state
        step = resolver.step(position=goal, dt=0.2)
        if step.status is vq.StepStatus.BLOCKED:
            assert not steps or may_rest(truss, steps[-1], before)
            continue
        steps.append(before)
        change = np.abs(step.state.rates - before.rates)[truss.actuators]
        interval = 0.5 * (step.state.duration + (before.duration or step.state.duration))
        assert np.all(change <= (truss.acceleration[truss.actuators] + 1e-9) * interval)
        if obstacles:
            assert resolver.setup.monitor.least(step.state.nodes, among="obstacles")[0] >= 0.05 - 1e-9
    if known is not None:
        assert len(steps) >= 30
        assert max(np.abs(state.rates).max() for state in steps) > 0.03


def keeps_accelerations(truss, before, after, slack=1e-9):
    """Return whether no actuator changed its speed in a step by more than it may."""
    change = np.abs(after.rates - before.rates)[truss.actuators]
    interval = 0.5 * (after.duration + (before.duration or after.duration))
    return bool(np.all(change <= (truss.acceleration[truss.actuators] + slack) * interval))


def drive(resolver, goals, dt=0.2):
    """Send an arm to one goal after another; return its steps, none of which may break a limit or trap it."""
    truss, steps, before = truss_of(resolver.setup.arm), [], None
    for goal in goals:
        here = resolver.state
        step = resolver.step(position=goal(resolver), dt=dt)
        steps.append(step)
        if step.status is vq.StepStatus.BLOCKED:
            assert before is None or may_rest(truss, before, here)
            assert here.time >= (resolver.setup.base_motion.end if resolver.setup.base_motion else 0.0) - 1e-9
            continue
        assert keeps_accelerations(truss, here, step.state)
        assert (
            resolver.setup.monitor.least(step.state.nodes, step.state.time, among="obstacles")[0]
            >= 0.05 - 1e-9
        )
        before = here
    return steps


ELASTIC = {"method.tracking_mode": "elastic"}
"""What brakes the arm is known of this tracking; stations on the curve take it other ways."""


def random_goals(rng, count=40, base=None):
    """Yield goals, as functions of the resolver, that jump every eight steps; they go with a base that moves."""
    for k in range(count):
        if k % 8 == 0:
            goal = np.array([0.0, 0.0, 2.0]) + rng.uniform([-0.9, -0.9, -0.5], [0.9, 0.9, 0.5])
        yield (
            lambda resolver, goal=goal: (
                goal
                + (0.0 if base is None else np.interp(resolver.state.time, [0.0, base["time"]], [0.0, 1.0]))
                * np.array([0.0, 0.0, 0.0] if base is None else base["position"])
            )
        )


@pytest.mark.parametrize("known", KNOWN)
@pytest.mark.parametrize("obstacles", [[], [CRATE]])
def test_an_elastic_tip_leaves_its_goal_to_brake_and_never_traps_a_moving_arm(known, obstacles, rng):
    resolver = vq.Resolver(problem(0.1, obstacle=obstacles, **{"end_effector.mode": "elastic", **ELASTIC}))
    steps = drive(resolver, random_goals(rng if known is None else np.random.default_rng(known)))
    if known is not None:
        assert max(np.abs(step.state.rates).max() for step in steps) > 0.1
        assert any(step.braked and step.left_path for step in steps)


@pytest.mark.parametrize("known", KNOWN)
def test_a_hard_tip_that_is_turned_round_brakes_along_its_path(known, rng):
    resolver = vq.Resolver(problem(0.1, **{"end_effector.mode": "hard"}))
    rng = rng if known is None else np.random.default_rng(known)
    speed, steps = np.zeros(3), []
    for k in range(60):
        if k % 12 == 0:
            wanted = rng.uniform(-0.08, 0.08, 3)
        speed = speed + np.clip(wanted - speed, -0.006, 0.006)
        if k % 20 == 19:
            speed = -speed
        steps += drive(resolver, [lambda resolver, speed=speed: resolver.tip()[0] + 0.2 * speed])
        if steps[-1].braked or steps[-1].status is vq.StepStatus.BLOCKED:
            truss = truss_of(resolver.setup.arm)
            speed = truss.tip_weights @ resolver.state.motion[truss.tip] / 0.2
    braked = [step for step in steps if step.braked]
    assert not any(step.left_path for step in braked)
    if known is not None:
        assert braked
        assert sum(step.status is vq.StepStatus.REACHED for step in steps) > 40


SLOW = {"time": 10.0, "position": [0.1, 0.0, 0.05], "rotation_vector": [0.0, 0.02, 0.02]}
SIDEWAYS = {"time": 10.0, "position": [0.12, 0.02, 0.0]}
IN_THE_WAY = {**CRATE, "center": [0.92, 0.3, 1.8]}


@pytest.mark.dear
@pytest.mark.parametrize("mode", ["scaled", "elastic"])
@pytest.mark.parametrize(("base", "obstacles"), [(SLOW, [CRATE]), (SIDEWAYS, [IN_THE_WAY])])
@pytest.mark.parametrize("known", [1, None])
def test_a_moving_base_never_traps_a_moving_arm(mode, base, obstacles, known, rng):
    changes = {"truss.base_motion": [base], "end_effector.mode": mode}
    goals = random_goals(rng if known is None else np.random.default_rng(known), 60, base)
    steps = drive(vq.Resolver(problem(0.1, obstacle=obstacles, **changes)), goals)
    assert mode == "elastic" or not any(step.left_path for step in steps)
    if known is not None:
        assert sum(step.braked for step in steps) > 3
        assert max(np.abs(step.state.rates).max() for step in steps) > 0.1


@pytest.mark.parametrize("mode", ["scaled", "elastic"])
def test_a_maneuver_on_a_base_that_carries_the_arm_towards_a_crate_comes_through(mode):
    changes = {"truss.base_motion": [SIDEWAYS], "obstacle": [IN_THE_WAY], "maneuver.steps": 30}
    # On its curve of so few control vertices the arm is too late; with more of them it is not.
    ways = {"end_effector.mode": mode, "method.retries": True}
    maneuver = vq.solve(problem(0.1, **changes, **ways))
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok, maneuver.certificate.failures()


def test_a_base_that_starts_faster_than_actuators_can_is_no_motion_with_the_tip_on_its_path():
    abrupt = [{"time": 4.0, "position": [0.2, 0.0, 0.1]}]
    maneuver = vq.solve(problem(0.1, **{"truss.base_motion": abrupt}))
    assert (maneuver.status, len(maneuver.time)) == ("blocked", 1)
    assert maneuver.manifest["stop"]["kind"] == "acceleration"


LURCH = [{"time": 4.0, "position": [0.04, 0.0, 0.0]}, {"time": 8.0, "position": [1.5, 0.0, 0.0]}]


def test_an_arm_whose_base_lurches_leaves_its_path_and_rides_with_the_base():
    resolver = vq.Resolver(problem(0.1, **{"truss.base_motion": LURCH}))
    goal = resolver.tip()[0] + np.array([0.1, 0.0, -0.05])
    steps = drive(resolver, [lambda _: goal] * 40)
    left = [step for step in steps if step.left_path]
    assert left
    assert all(step.braked for step in left)
    assert left[0].state.time >= 4.0
    assert resolver.state.time >= 8.0 - 1e-9


def test_a_maneuver_ends_on_its_path_before_the_base_lurches():
    goal = [{"time": 8.0, "position": [0.1, 0.0, 2.3]}]
    maneuver = vq.solve(problem(0.1, **{"truss.base_motion": LURCH, "maneuver.waypoint": goal}))
    assert maneuver.status == "blocked"
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    assert 0.3 < maneuver.reached < 0.7
    assert maneuver.manifest["stop"]["kind"] == "acceleration"


def smoothly(goal, time=6.0, count=60):
    """Return waypoints along a straight way that is started and ended slowly."""
    tip = vq.Resolver(problem()).tip()[0]
    shares = np.arange(1, count + 1) / count
    return [
        {"time": time * u, "position": (tip + u * u * (3 - 2 * u) * (np.array(goal) - tip)).tolist()}
        for u in shares.tolist()
    ]


def test_a_hard_tip_keeps_a_timing_that_its_actuators_can_follow():
    changes = {"end_effector.mode": "hard", "maneuver.waypoint": smoothly([0.6, 0.0, 2.0])}
    maneuver = vq.solve(problem(0.3, **changes))
    assert maneuver.status == "solved"
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    np.testing.assert_allclose(maneuver.time, np.linspace(0.0, 6.0, 61), atol=1e-9)


@pytest.mark.parametrize(
    ("acceleration", "waypoints", "obstacles"),
    [
        (0.2, smoothly([0.6, 0.0, 2.0]), []),
        (0.3, smoothly([1.2, 0.0, 2.0]), [WALL]),
        (0.5, [*smoothly([0.6, 0.0, 2.0])[:30], {"time": 6.0, "position": [0.0, 0.3, 2.2]}], []),
    ],
)
def test_a_hard_tip_that_cannot_stay_on_time_comes_to_rest_on_its_path(acceleration, waypoints, obstacles):
    changes = {"end_effector.mode": "hard", "maneuver.waypoint": waypoints, "obstacle": obstacles, **ELASTIC}
    maneuver = vq.solve(problem(acceleration, **changes))
    assert maneuver.status == "blocked"
    assert 0.1 < maneuver.reached < 0.9
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    assert maneuver.manifest["stop"]["kind"] in ("acceleration", "obstacle", "stroke")
    rate = np.diff(maneuver.member_lengths, axis=0) / np.diff(maneuver.time)[:, None]
    assert np.abs(rate).max() > acceleration * 0.1
    assert np.abs(rate[-1]).max() <= acceleration * np.diff(maneuver.time[-2:]) + 1e-9


@pytest.mark.parametrize("mode", ["scaled", "hard", "elastic"])
def test_a_control_loop_may_bring_its_arm_to_rest_at_any_time(mode):
    resolver = vq.Resolver(problem(0.2, **{"end_effector.mode": mode}))
    assert resolver.brake() is None
    for waypoint in smoothly([0.6, 0.0, 2.0])[:20]:
        last = resolver.step(position=waypoint["position"], dt=0.1)
    assert last.status is not vq.StepStatus.BLOCKED
    before, count = resolver.state, 0
    while (step := resolver.brake()) is not None:
        assert step.braked
        assert keeps_accelerations(truss_of(resolver.setup.arm), before, step.state)
        last, before, count = before, step.state, count + 1
    assert count >= 1
    assert may_rest(truss_of(resolver.setup.arm), last, resolver.state)


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


def test_a_curve_that_changes_while_the_arm_moves_leaves_it_able_to_brake():
    resolver = vq.Resolver(problem(0.1))
    tip, _ = resolver.tip()
    for _ in range(8):
        resolver.step(position=[0.6, 0.0, 2.0], dt=0.2)
    resolver.set_control_vertices(7)
    step = resolver.step(position=tip, dt=0.2)
    assert step.status is vq.StepStatus.SLOWED
    assert step.braked
    assert len(step.state.control_vertices) == 7
    while (step := resolver.brake()) is not None:
        assert step.braked
        assert len(step.state.control_vertices) == 7
    assert resolver.step(position=resolver.tip()[0] + [0.0, 0.0, -0.001], dt=0.2).progress > 0.0


def test_a_step_too_short_to_rest_in_says_so():
    resolver = vq.Resolver(problem(0.1))
    resolver.step(position=[0.6, 0.0, 2.0], dt=0.2)
    step = resolver.step(position=[0.6, 0.0, 2.0], dt=0.002)
    if step.status is vq.StepStatus.BLOCKED:
        assert "less than the last step took" in step.reason
