"""Stroke, rate and acceleration as one box: no contradictions, and what stays in it stays allowed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vgtm_qp.rows.limits import APPROACH, actuator_box, braking_speed, resting_box

positive = st.floats(0.01, 10.0)
limit = st.one_of(st.just(np.inf), positive)
share = st.one_of(st.sampled_from([0.0, 1.0]), st.floats(0.0, 1.0))


def one(*values):
    return (np.array([value], dtype=float) for value in values)


@pytest.mark.smoke
@settings(max_examples=300, deadline=None)
@given(distance=st.floats(0.0, 5.0), acceleration=positive, dt=st.sampled_from([1e-3, 0.01, 0.2, 1.0, 3.0]))
def test_braking_speed_is_the_greatest_from_which_even_short_steps_stop_in_time(distance, acceleration, dt):
    speed = float(braking_speed(np.array([distance]), np.array([acceleration]), dt)[0])
    # In steps without a length what is left is covered at a speed that falls evenly.
    last = max(speed - 0.5 * acceleration * dt, 0.0)
    assert speed * dt + 0.5 * last**2 / acceleration == pytest.approx(distance, abs=1e-9 * (1.0 + distance))


@pytest.mark.smoke
def test_without_an_acceleration_limit_any_speed_brakes():
    assert braking_speed(np.array([0.0, 1.0]), np.array([np.inf, np.inf]), 0.1).tolist() == [np.inf, np.inf]
    assert braking_speed(np.array([-1.0]), np.array([2.0]), 0.1).tolist() == [0.0]


@pytest.mark.smoke
@settings(max_examples=300, deadline=None)
@given(
    start=share,
    least=st.floats(0.1, 2.0),
    travel=st.floats(0.0, 2.0),
    rate=limit,
    acceleration=limit,
    dt=st.floats(1e-3, 2.0),
    choices=st.lists(st.tuples(share, st.floats(0.05, 1.0)), min_size=1, max_size=40),
    even=st.booleans(),
)
def test_lengths_that_stay_in_their_boxes_keep_every_limit_in_steps_of_any_duration(
    start, least, travel, rate, acceleration, dt, choices, even
):
    stroke = np.array([[least, least + travel]])
    length, speed, rates, accelerations = one(least + start * travel, 0.0, rate, acceleration)
    before = None
    for choice, part in choices:
        now = dt if even else part * dt
        lower, upper = actuator_box(length, speed, stroke, rates, accelerations, now, before)
        assert lower[0] <= upper[0]
        after = lower + choice * (upper - lower)
        change = (after - length) / now
        assert stroke[0, 0] - 1e-12 <= after[0] <= stroke[0, 1] + 1e-12
        assert abs(change[0]) <= rate + 1e-12 / now
        between = now if before is None else 0.5 * (now + before)
        assert abs(change[0] - speed[0]) <= acceleration * between + 1e-11 / now
        length, speed, before = after, change, now


@pytest.mark.smoke
@settings(max_examples=300, deadline=None)
@given(
    length=st.floats(0.0, 4.0),
    speed=st.floats(-20.0, 20.0),
    least=st.floats(0.5, 2.0),
    travel=st.floats(0.0, 1.0),
    rate=limit,
    acceleration=limit,
    dt=st.floats(1e-3, 2.0),
)
def test_a_start_outside_any_limit_has_a_box_that_leads_back(
    length, speed, least, travel, rate, acceleration, dt
):
    stroke = np.array([[least, least + travel]])
    lengths, speeds, rates, accelerations = one(length, speed, rate, acceleration)
    lower, upper = actuator_box(lengths, speeds, stroke, rates, accelerations, dt)
    assert lower[0] <= upper[0]
    assert np.isfinite([lower[0], upper[0]]).all()
    assert lower[0] >= min(least, length) - 1e-12
    assert upper[0] <= max(least + travel, length) + 1e-12
    assert abs(lower[0] - length) <= rate * dt + 1e-12
    assert abs(upper[0] - length) <= rate * dt + 1e-12


@pytest.mark.smoke
def test_an_actuator_outside_its_stroke_comes_back_by_its_own_limits():
    stroke = np.array([[0.6, 1.5]])
    length, speed = np.array([1.7]), np.array([0.0])
    rate, acceleration, dt = np.array([0.5]), np.array([0.4]), 0.1
    for _ in range(100):
        before, speed_before = length, speed
        length, upper = actuator_box(length, speed, stroke, rate, acceleration, dt)
        assert upper[0] <= max(before[0], 1.5) + 1e-15
        speed = (length - before) / dt
        assert abs(speed[0]) <= 0.5 + 1e-12
        assert abs(speed[0] - speed_before[0]) <= 0.04 + 1e-12
    assert length[0] == pytest.approx(0.6, abs=1e-9)


@pytest.mark.smoke
def test_each_actuator_has_its_own_box(rng):
    count = 20
    stroke = np.sort(rng.uniform(0.5, 2.0, (count, 2)), axis=1)
    length = stroke[:, 0] + rng.uniform(size=count) * np.diff(stroke, axis=1)[:, 0]
    speed, rate = rng.uniform(-0.2, 0.2, count), rng.uniform(0.2, 1.0, count)
    acceleration = np.where(rng.uniform(size=count) < 0.3, np.inf, rng.uniform(0.1, 1.0, count))
    together = actuator_box(length, speed, stroke, rate, acceleration, 0.2)
    for k in range(count):
        row = slice(k, k + 1)
        alone = actuator_box(length[row], speed[row], stroke[row], rate[row], acceleration[row], 0.2)
        assert (together[0][k], together[1][k]) == (alone[0][0], alone[1][0])


def test_without_limits_of_acceleration_the_box_is_that_of_stroke_and_rate(rng):
    """Also of actuators outside their strokes, without limits, and that slow down before their ends."""
    count, dt = 200, 0.2
    stroke = np.sort(rng.uniform(0.5, 2.0, (count, 2)), axis=1)
    stroke[rng.uniform(size=count) < 0.2] = (-np.inf, np.inf)
    value = rng.uniform(0.3, 2.2, count)
    rate = np.where(rng.uniform(size=count) < 0.2, np.inf, rng.uniform(0.01, 5.0, count))
    box, free = resting_box(count), np.full(count, np.inf)
    lower, upper = (
        np.asarray(side).reshape(-1) for side in box(value, stroke[:, 0], stroke[:, 1], rate * dt, free)
    )
    wanted = actuator_box(value, rng.normal(size=count), stroke, rate, free, dt)
    np.testing.assert_allclose(lower, wanted[0], rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(upper, wanted[1], rtol=0.0, atol=1e-15)
    approach = rng.uniform(1e-3, 0.1, count)
    slow = box(value, stroke[:, 0], stroke[:, 1], rate * dt, approach)
    for side, found, sense in zip((lower, upper), slow, (-1.0, 1.0), strict=True):
        left = sense * (side - value)
        to_end = np.maximum(sense * (stroke[:, int(sense > 0.0)] - value), 0.0)
        allowed = np.minimum(left, np.maximum(APPROACH * to_end, np.minimum(to_end, approach)))
        np.testing.assert_allclose(sense * (np.asarray(found).reshape(-1) - value), allowed, atol=1e-15)
