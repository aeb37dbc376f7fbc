"""Every truss module and every curve family: the tip goes half the arm's length past a cube, certified."""

from __future__ import annotations

import numpy as np
import pytest

import vgtm_qp as vq
from vgtm_qp.step.build import build_arm

SAFE = 0.08
PAST = [
    "octahedral_past_a_cube",
    "double_octahedral_past_a_cube",
    "hexapod_past_a_cube",
    "longeron_past_a_cube",
    "tetrahedral_past_a_cube",
    "b_spline_past_a_cube",
    "beta_spline_past_a_cube",
    "actuator_jams",
    "moving_base",
    "offset_joints_past_a_cube",
]


@pytest.fixture(autouse=True, scope="module")
def _without_a_compiler():
    """So many arms are built here that the C compiler would take more time than their few steps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VGTM_CC", "none")
        yield


@pytest.fixture(scope="module", params=PAST)
def case(request):
    problem = vq.load_problem(request.param)
    return problem, vq.solve(problem)


def test_it_is_solved_and_certified(case):
    problem, maneuver = case
    assert maneuver.status == "solved", maneuver.manifest["blocked_by"]
    assert maneuver.certificate.ok, maneuver.certificate.failures()
    assert maneuver.certificate.clearance.value >= SAFE - 1e-9
    goal = problem.maneuver.waypoint[-1]
    np.testing.assert_allclose(maneuver.tip_position[-1], goal.position, atol=1e-6)
    assert len(maneuver.time) <= 1.2 * (problem.maneuver.steps + 1)


def test_the_tip_goes_half_the_arms_length_and_the_cube_is_in_the_way(case):
    problem, maneuver = case
    height = vq.build_truss(problem.truss).height
    moved = np.linalg.norm(maneuver.tip_position[-1] - maneuver.tip_position[0])
    assert moved >= 0.499 * height
    assert maneuver.certificate.clearance.value <= SAFE + 0.005


def test_nobody_is_warned_of_a_curve_that_is_freer_than_the_arm(case):
    problem, _ = case
    curve, truss = problem.curve, vq.build_truss(problem.truss)
    assert 3 * curve.control_vertices + curve.torsion_vertices - 5 <= len(truss.actuators)


def test_ten_bays_go_round_a_cube_that_they_would_enter():
    problem = vq.load_problem("ten_bay_round_a_cube")
    heedless = vq.solve(problem.replace({"obstacle": []}), verify=False)
    setup = build_arm(problem, solves=False)
    assert min(setup.least_clearance(nodes, 0.0, "obstacles") for nodes in heedless.nodes) == -0.03
    for changes in ({}, {"method.solver": "osqp"}, {"method.tracking": "none"}):
        maneuver = vq.solve(problem.replace({**changes, "method.retries": False}))
        assert (maneuver.status, maneuver.steps) == ("solved", 50)
        assert maneuver.certificate.ok, maneuver.certificate.failures()
        assert SAFE - 1e-9 <= maneuver.certificate.clearance.value <= SAFE + 0.005


def test_members_that_jam_half_way_stay_as_they_are():
    problem = vq.load_problem("actuator_jams")
    maneuver = vq.solve(problem)
    names = list(maneuver.member_names)
    for lock in problem.truss.locked:
        lengths = maneuver.member_lengths[:, names.index(lock.member)]
        half = int(np.argmin(np.abs(maneuver.time - lock.time)))
        assert 0.4 < maneuver.progress[half] < 0.6
        np.testing.assert_allclose(lengths[half:], lengths[half], atol=1e-9)
        assert abs(lengths[half] - lengths[0]) > 0.01


def test_the_hexapod_arm_meets_all_six_coordinates():
    problem = vq.load_problem("hexapod_past_a_cube")
    maneuver = vq.solve(problem, verify=False)
    assert problem.end_effector.track == ("position", "orientation")
    np.testing.assert_allclose(maneuver.tip_rotation[-1], maneuver.tip_target_rotation[-1], atol=1e-6)


def test_the_base_moves_and_the_goal_does_not_move_with_it():
    problem = vq.load_problem("moving_base")
    maneuver = vq.solve(problem, verify=False)
    base = maneuver.nodes[:, :3].mean(axis=1)
    last = problem.truss.base_motion[-1]
    np.testing.assert_allclose(base[-1], last.position, atol=1e-9)
    assert np.linalg.norm(base[len(base) // 2] - base[0]) > 0.2
    np.testing.assert_allclose(maneuver.tip_position[-1], problem.maneuver.waypoint[-1].position, atol=1e-6)
