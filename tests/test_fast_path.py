"""The compiled step with its watch on near pairs, beside the general one with neither: one step, to 1e-10."""

from dataclasses import replace

import numpy as np
import pytest
from steps import plain_arm

import vgtm_qp as vq
from vgtm_qp.compiled import compiler, finish_compiling
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.step.engine import FusedEngine, GeneralEngine

SCENES = [
    ("five_bay_two_cubes", {}),
    ("five_bay_two_cubes", {"method.tracking_mode": "hard"}),
    ("five_bay_two_cubes", {"method.slow_approach": False}),
    ("five_bay_two_cubes_pointing", {}),
    ("hexapod_past_a_cube", {}),
    ("tetrahedral_past_a_cube", {}),
    ("snake_past_a_cube", {}),
    ("snake_past_a_cube", {"arm.joint": "followers"}),
    # At the rim of its cylinder FCL's last digits are the machine's.
    ("station_arm_past_a_module", {"clearance.distance": "exact"}),
    ("twelve_joints_past_a_crate", {}),
]


def with_followers(problem):
    """The joints of a problem, of which two follow others."""
    rules = {5: {"joint": "yaw-1", "multiplier": 0.5, "offset": 0.04}, 12: {"joint": "pitch-1"}}
    joints = problem.to_dict()["arm"]["joint"]
    return [{**joint, "mimic": rules[k]} if k in rules else joint for k, joint in enumerate(joints)]


@pytest.mark.dear
@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@pytest.mark.parametrize(("name", "changes"), SCENES)
def test_both_paths_take_the_same_steps_from_every_state_of_a_maneuver(name, changes):
    problem = vq.load_problem(name)
    if changes.get("arm.joint") == "followers":
        changes = {"arm.joint": with_followers(problem)}
    problem = problem.replace(changes)
    slow = plain_arm(problem, compiled=False)
    monitor = slow.monitor
    kept = ("safe", "self_safe", "influence", "self_collision")
    options = {key: getattr(monitor, key) for key in kept}
    by_fcl = monitor.scene.fcl is not None
    listed = Clearance(
        monitor.bodies, monitor.obstacles, watch=False, by_fcl=by_fcl, unit=monitor.scene.unit, **options
    )
    fast, plain = vq.Resolver(problem), vq.Resolver(replace(slow, monitor=listed))
    assert isinstance(fast.setup.engine, FusedEngine)
    # Until it is compiled both are the same.
    finish_compiling()
    assert fast.setup.engine.is_ready
    assert isinstance(plain.setup.engine, GeneralEngine)
    assert fast.setup.monitor.is_watched == (monitor.self_collision or bool(problem.obstacle))
    assert not plain.setup.monitor.is_watched
    plan = make_plan(problem, *fast.tip())
    value, compared, furthest = plan.path.start, 0, 0.0
    for mark in plan.marks.tolist():
        plain.state = fast.state
        steps = [one.follow(plan.path, value, mark, dt=mark - value) for one in (fast, plain)]
        if vq.StepStatus.BLOCKED in {step.status for step in steps}:
            break
        assert steps[0].qps == pytest.approx(steps[1].qps, abs=1)
        if steps[0].qps == steps[1].qps:
            compared += 1
            apart = np.abs(steps[0].state.nodes - steps[1].state.nodes).max()
            # At a dead end the rows nearly contradict one another, and rounding grows.
            furthest = max(furthest, float(apart) if steps[0].progress > 0.05 else 1e-5 * float(apart))
        value += steps[0].progress * (mark - value)
    assert compared >= 20
    assert furthest < 1e-10
