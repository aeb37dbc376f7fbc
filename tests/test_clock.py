"""Rates are those of a step's own duration, whatever the clock says, and short steps are not lost on a large clock."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vgtm_qp as vq
from vgtm_qp.errors import GoalError

RATE = 0.5
SHORTEST, LONGEST = 1e-8, 1e8
"""Durations of steps that are made, s; the others are refused."""
ROUNDING = 1e-15
"""Of a length or joint value computed from node positions of a few metres, m or rad."""


@cache
def resolver(name: str) -> vq.Resolver:
    problem = vq.load_problem(name)
    if problem.truss is not None:
        return vq.Resolver(problem.replace({"truss.rate": RATE}))
    joints = [{**joint, "rate": RATE} for joint in problem.to_dict()["arm"]["joint"]]
    return vq.Resolver(problem.replace({"arm.joint": joints}))


def actuators(arm: Any, state: Any) -> np.ndarray:
    """Return lengths of actuated members or joint values, by formulas of this test alone."""
    if not hasattr(arm, "truss"):
        return state.q[: len(arm.quantity_names)][arm.actuators]
    first, second = arm.truss.members[arm.actuators].T
    return np.sqrt(((state.nodes[first] - state.nodes[second]) ** 2).sum(axis=1))


steps = st.lists(
    st.tuples(st.floats(-9.0, 9.0), st.tuples(*[st.floats(-0.5, 0.5)] * 3)), min_size=3, max_size=8
)


@pytest.mark.parametrize("name", ["five_bay_two_cubes", "snake_past_a_cube"])
@given(exponents=steps, clock=st.just(0.0) | st.floats(-3.0, 9.0).map(lambda x: 10.0**x))
@settings(max_examples=30, deadline=None)
def test_no_step_exceeds_a_rate_in_its_own_duration(name: str, exponents: list[Any], clock: float) -> None:
    loop = resolver(name)
    loop.state = replace(loop.setup.home_state(), time=clock)
    arm, passed = loop.setup.arm, [clock]
    for exponent, away in exponents:
        dt, before = 10.0**exponent, loop.state
        goal = loop.tip()[0] + np.array(away)
        if not SHORTEST <= dt <= LONGEST:
            with pytest.raises(GoalError, match="dt must be"):
                loop.step(position=goal, dt=dt)
            assert loop.state is before
            continue
        step = loop.step(position=goal, dt=dt)
        if not step.moved:
            assert loop.state is before
            continue
        passed.append(dt)
        moved = np.abs(actuators(arm, loop.state) - actuators(arm, before))
        assert (moved <= RATE * dt + ROUNDING).all(), (dt, moved.max() - RATE * dt)
        assert loop.state.duration == dt
        assert (np.abs(loop.state.rates[arm.actuators]) <= RATE + ROUNDING / dt).all()
        assert loop.state.time == pytest.approx(math.fsum(passed), rel=1e-15)


def test_steps_that_the_clock_does_not_show_add_up() -> None:
    loop = resolver("five_bay_two_cubes")
    loop.state = replace(loop.setup.home_state(), time=1e9)
    for k in range(40):
        assert loop.step(position=loop.tip()[0] + [0.0, 0.0, -1e-9], dt=1e-8).moved, k
    # The clock has steps of 1.2e-7 s here.
    assert loop.state.time - 1e9 + loop.state.late == pytest.approx(4e-7, rel=1e-6)
    assert 3e-7 < loop.state.time - 1e9 < 5e-7
