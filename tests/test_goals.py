"""The end effector's modes: elastic by an exact penalty, hard, and scaled."""

from dataclasses import replace

import numpy as np
import pytest
from steps import WholeSolver, numbers_at, solved

import vgtm_qp as vq
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.qp.condensed import CondensedSolver
from vgtm_qp.qp.full import FullBuilder
from vgtm_qp.qp.solvers import make_solver
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.path import Path
from vgtm_qp.step.separation import Separation
from vgtm_qp.step.target import Target


def three_bays(**changes):
    data = {
        "name": "three bays",
        "truss": {"module": "octahedral", "bays": 3},
        "curve": {"control_vertices": 4},
        "maneuver": {"steps": 12, "waypoint": [{"time": 4.0, "position": [0.6, 0.1, 2.1]}]},
        "clearance": {"safe": 0.05, "influence": 0.5},
        "method": {"retries": False},
    }
    problem = vq.Problem.from_dict(data)
    return problem.replace(changes) if changes else problem


def one_qp(penalty):
    """Return arm, elastic solver and the numbers of a step whose strokes cannot give all that the tip asks for."""
    problem = three_bays(**{"end_effector.mode": "elastic", "method.weights.end_effector": penalty})
    arm = build_arm(problem)
    truss = truss_of(arm.arm)
    X = truss.home
    arm.kinematics.evaluate(X)
    start = arm.arm.end_effector.position(X)
    rotation = arm.kinematics.tip_rotation.copy()
    path = Path(
        np.array([0.0, 1.0]),
        np.stack([start, start + np.array([0.1, 0.02, -0.03])]),
        np.stack([rotation] * 2),
    )
    lengths = truss.home_lengths[truss.actuators]
    target = Target(path, 0.0, 1.0, lengths - 0.3, lengths + 0.3, 1.0, 1.0)
    separation = Separation(arm)
    rows = separation.rows(X, 0.0, 1.0, 0.1, {}, 0.0)
    numbers = numbers_at(arm, X, arm.control_vertices, target, 0.0, rows, motion=True)
    return arm, CondensedSolver(arm.layout), numbers


@pytest.mark.smoke
def test_an_elastic_goal_holds_exactly_while_its_penalty_exceeds_the_multiplier():
    arm, _, numbers = one_qp(1.0)
    qp = FullBuilder(replace(arm.layout, elastic_tip=False)).build(numbers)
    _, multipliers = solved(qp)
    tip = [k for k, label in enumerate(qp.rows) if label.kind == "end effector"]
    greatest = float(np.abs(multipliers[tip]).max())
    assert greatest > 1e-3
    _, above, numbers = one_qp(1.01 * greatest)
    assert above.solve(numbers).tip_slack < 1e-9
    _, below, numbers = one_qp(0.9 * greatest)
    assert below.solve(numbers).tip_slack > 1e-5


@pytest.mark.parametrize("name", ["daqp", "piqp", "osqp"])
@pytest.mark.parametrize("penalty", [1e3, 1e-3])
def test_the_condensed_qp_of_an_elastic_tip_has_the_answer_of_the_whole_one(name, penalty):
    arm, _, numbers = one_qp(penalty)
    one, other = WholeSolver(arm.layout).solve(numbers), make_solver(name, arm.layout).solve(numbers)
    assert (one.tip_slack > 1e-4) == (penalty < 1.0)
    assert other.tip_slack == pytest.approx(one.tip_slack, abs=1e-6)
    assert np.abs(other.nodes - one.nodes).max() < 1e-6
    assert np.abs(other.actuators - one.actuators).max() < 1e-6


def test_the_slacks_of_an_elastic_tip_are_columns_with_names_that_a_hard_one_does_not_have():
    goal = {"position": [0.1, 0.0, 2.4]}
    elastic = vq.Resolver(three_bays(**{"end_effector.mode": "elastic"})).build(**goal)
    slacks = [k for k, label in enumerate(elastic.columns) if label.kind == "tip slack"]
    assert [elastic.columns[k].name for k in slacks] == [f"tip slack {a}{s}" for s in "+-" for a in "xyz"]
    assert np.all(elastic.column_lower[slacks] == 0.0)
    assert np.all(elastic.q[slacks] > 0.0)
    hard = vq.Resolver(three_bays()).build(**goal)
    assert not any(label.kind == "tip slack" for label in hard.columns)


def test_a_long_arm_with_an_elastic_tip_is_condensed_and_says_so(caplog):
    resolver = vq.Resolver(three_bays(**{"end_effector.mode": "elastic", "truss.bays": 24}))
    assert "condensed onto the actuators" in caplog.text
    tip, _ = resolver.tip()
    assert resolver.step(position=tip + np.array([0.02, 0.0, -0.01])).status is vq.StepStatus.REACHED


def test_an_elastic_tip_stays_on_a_free_path_and_leaves_it_where_it_must():
    free = vq.solve(three_bays(**{"end_effector.mode": "elastic"}))
    assert free.status == "solved"
    assert free.certificate.ok, free.certificate.failures()
    assert np.abs(free.tip_position - free.tip_target_position).max() < 1e-7
    far = {
        "end_effector.mode": "elastic",
        "maneuver.waypoint": [{"time": 4.0, "position": [0.0, 0.0, 5.0]}],
        "truss.stroke": [0.9, 1.2],
    }
    stretched = vq.solve(
        three_bays(**{**far, "maneuver.waypoint": [{"time": 4.0, "position": [0.2, 0.0, 2.62]}]})
    )
    assert stretched.status == "solved"
    assert stretched.certificate.ok, stretched.certificate.failures()
    assert np.abs(stretched.tip_position - stretched.tip_target_position)[-1].max() > 1e-3


@pytest.mark.parametrize(("mode", "slower"), [("scaled", True), ("hard", False)])
def test_slow_actuators_slow_a_scaled_tip_down_and_stop_a_hard_one(mode, slower):
    maneuver = vq.solve(three_bays(**{"end_effector.mode": mode, "truss.rate": 0.06}))
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    assert (maneuver.status == "solved") == slower
    if slower:
        assert len(maneuver.time) - 1 > 12
    else:
        assert maneuver.manifest["stop"]["kind"] == "rate"
        assert all(name.startswith("rate: ") for name in maneuver.blocked_by)


POSES = [
    (["position", "orientation"], {"position": [0.4, 0.1, 2.6], "rotation_vector": [0.1, 0.2, 0.15]}),
    (["position", "pointing"], {"position": [0.4, 0.1, 2.6], "pointing": [0.3, 0.1, 1.0]}),
    (["orientation"], {"rotation_vector": [0.1, 0.2, 0.15]}),
    (["x", "z"], {"position": [0.4, 0.1, 2.6]}),
]


@pytest.mark.parametrize(("track", "goal"), POSES)
@pytest.mark.parametrize("mode", ["scaled", "hard", "elastic"])
def test_every_kind_of_pose_is_met_in_every_mode(track, goal, mode):
    problem = vq.Problem.from_dict(
        {
            "truss": {"module": "hexapod", "bays": 3},
            "curve": {"control_vertices": 4},
            "end_effector": {"track": track, "mode": mode},
            "maneuver": {"steps": 12, "waypoint": [{"time": 4.0, **goal}]},
            "obstacle": [
                {"name": "mast", "shape": "cylinder", "center": [1.0, 0.0, 1.5], "radius": 0.2, "height": 2.0}
            ],
            "method": {"retries": False},
        }
    )
    maneuver = vq.solve(problem)
    assert maneuver.status == "solved", maneuver.blocked_by
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    errors = (maneuver.certificate.tip_error.value, maneuver.certificate.tip_direction_error.value)
    assert all(error is None or error < 1e-8 for error in errors)
    assert len(maneuver.time) == 13 or mode == "scaled"


def test_a_path_that_stands_still_is_solved():
    tip = vq.solve(three_bays()).tip_position[0]
    waypoint = [{"time": 1.0, "position": tip.tolist()}]
    assert vq.solve(three_bays(**{"maneuver.waypoint": waypoint, "maneuver.steps": 3})).status == "solved"
