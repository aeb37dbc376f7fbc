"""The rows of a tip as functions of numbers: every coordinate, short ways, and turns near and at half a turn."""

from __future__ import annotations

import modules
import numpy as np
import oracle
import pytest

from vgtm_qp.arm.truss.arm import TrussArm
from vgtm_qp.rotation import rotation_from_vector
from vgtm_qp.rows.tip import TipGoal, row_names, tip_function
from vgtm_qp.step.task import TipTask

TRACKS = [("position",), ("y",), ("x", "z"), ("position", "pointing"), ("z", "orientation"), ("orientation",)]


def assert_close(found, wanted, atol):
    """Compare by absolute differences alone."""
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=atol)


def tip_of(track, position, rotation, goal, motion=False, unit=1.0):
    """Error, rate, turned axes and weight by the package's own function."""
    function = tip_function(row_names(track), unit)
    found = function(
        position, rotation, goal.position, goal.rotation, goal.velocity, goal.spin, 1.0 if motion else 0.0
    )
    error, rate, across, weight = (np.array(part) for part in found)
    return error[:, 0], rate[:, 0], across, float(weight[0, 0])


def random_pose(rng, turn=1.0):
    return rng.normal(size=3), rotation_from_vector(turn * rng.normal(size=3))


@pytest.mark.smoke
@pytest.mark.parametrize("track", TRACKS, ids="+".join)
def test_the_rows_of_a_tip_are_those_of_the_formulas(track, rng):
    task = TipTask(track, TrussArm(modules.octahedral(2)))
    for turn in (1e-9, 1e-6, 1e-3, 0.3, 2.0):
        position, rotation = random_pose(rng)
        there, _ = random_pose(rng)
        turned = rotation_from_vector(turn * rng.normal(size=3)) @ rotation
        goal = TipGoal(there, turned, rng.normal(size=3), rng.normal(size=3))
        error, rate, across, weight = tip_of(track, position, rotation, goal)
        rows = row_names(track)
        wanted = oracle.tip_rate(rows, rotation, goal)
        assert_close(error, oracle.tip_error(rows, position, rotation, goal), atol=1e-13)
        assert_close(task.error(position, rotation, goal), error, atol=1e-13)
        assert_close(rate, wanted, atol=1e-14)
        assert_close(across, oracle.tip_axes(rows, rotation), atol=1e-14)
        assert weight == pytest.approx(oracle.progress_weight(wanted))
        scaled = tip_of(track, position, rotation, goal, unit=0.3)[3]
        assert scaled == pytest.approx(oracle.progress_weight(oracle.as_lengths(rows, wanted, 0.3), 0.3))


@pytest.mark.parametrize("way", [0.0, 1e-7, 1e-5, 1e-3, 0.1, 1.0])
def test_progress_counts_more_on_a_short_way(way):
    goal = TipGoal(np.zeros(3), np.eye(3), way * np.array([0.6, 0.0, 0.8]), np.zeros(3))
    weight = tip_of(("position",), np.zeros(3), np.eye(3), goal)[3]
    assert weight == pytest.approx({0.0: 1.0, 1e-7: 1.0, 1e-5: 1e-7, 1e-3: 1e-5}.get(way, way * way))
    larger = goal._replace(velocity=20.0 * goal.velocity)
    assert tip_of(("position",), np.zeros(3), np.eye(3), larger, unit=20.0)[3] == pytest.approx(
        400.0 * weight
    )


@pytest.mark.parametrize("off", [1e-7, 2.1e-8, 1.9e-8, 1e-10, 0.0])
def test_a_motion_need_not_close_what_a_state_may_have(off):
    goal = TipGoal(np.array([0.0, -off, 0.0]), np.eye(3), np.zeros(3), np.zeros(3))
    for motion in (False, True):
        error = tip_of(("position", "pointing"), np.zeros(3), np.eye(3), goal, motion=motion)[0]
        wanted = 0.0 if motion and off < 2e-8 else -off
        np.testing.assert_array_equal(error, [0.0, wanted, 0.0, 0.0, 0.0])
        small = goal._replace(position=0.01 * goal.position)
        error = tip_of(("position", "pointing"), np.zeros(3), np.eye(3), small, motion=motion, unit=0.01)[0]
        np.testing.assert_allclose(error[1], 0.01 * wanted, rtol=1e-12, atol=0.0)


def test_towards_the_opposite_direction_the_tip_turns_half_round_about_its_own_x_axis(rng):
    _, rotation = random_pose(rng)
    half = rotation_from_vector(np.pi * rotation[:, 0])
    goal = TipGoal(np.zeros(3), half @ rotation, np.zeros(3), np.zeros(3))
    error, _, across, _ = tip_of(("pointing",), np.zeros(3), rotation, goal)
    assert_close(error, [np.pi, 0.0], atol=1e-12)
    assert_close(rotation_from_vector(across.T @ error), half, atol=1e-12)


@pytest.mark.parametrize("off", [0.0, 1e-15, 1e-13, 1e-11, 1e-9, 1e-6, 1e-3])
def test_near_the_opposite_direction_the_turn_is_half_a_turn_less_what_is_off(off):
    """Wherever one formula gives way to the other, the turn leads to the goal's direction."""
    rotation = rotation_from_vector([0.3, -0.8, 0.4])
    for side in (rotation[:, 0], rotation[:, 1], rotation[:, :2] @ [0.6, -0.8]):
        turned = rotation_from_vector((np.pi - off) * side) @ rotation
        goal = TipGoal(np.zeros(3), turned, np.zeros(3), np.zeros(3))
        error, _, across, _ = tip_of(("pointing",), np.zeros(3), rotation, goal)
        assert np.linalg.norm(error) == pytest.approx(np.pi - off, abs=2e-9)
        there = rotation_from_vector(across.T @ error) @ rotation[:, 2]
        assert_close(there, turned[:, 2], atol=2e-9 if off <= 1e-9 else 1e-12)


def test_the_same_direction_is_no_turn():
    rotation = rotation_from_vector([0.3, -0.8, 0.4])
    goal = TipGoal(
        np.zeros(3), rotation_from_vector(1.3 * rotation[:, 2]) @ rotation, np.zeros(3), np.zeros(3)
    )
    error = tip_of(("pointing",), np.zeros(3), rotation, goal)[0]
    assert_close(error, 0.0, atol=1e-15)


@pytest.mark.parametrize("off", [0.0, 1e-15, 1e-13, 1e-11, 1e-9, 1e-7, 1e-5, 1e-3])
@pytest.mark.parametrize(
    "axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, -0.8), (-0.36, 0.48, 0.8)]
)
def test_an_orientation_half_a_turn_away_is_half_a_turn_away(axis, off):
    rotation = rotation_from_vector([0.2, 0.5, -0.4])
    turned = rotation_from_vector((np.pi - off) * np.array(axis)) @ rotation
    goal = TipGoal(np.zeros(3), turned, np.zeros(3), np.zeros(3))
    error = tip_of(("orientation",), np.zeros(3), rotation, goal)[0]
    assert np.linalg.norm(error) == pytest.approx(np.pi - off, abs=2e-9)
    assert_close(rotation_from_vector(error) @ rotation, turned, atol=1e-9)
