"""The QP that a resolver shows is the one that its step starts with, and says what each of its numbers is."""

from __future__ import annotations

import numpy as np
import pytest
from steps import plain_arm, solved

import vgtm_qp as vq
from vgtm_qp.methods import QPResolver

GOAL = [0.1, 0.0, 4.0]


@pytest.fixture
def resolver():
    # The answers of an engine that is not one call of C can be read.
    resolver = QPResolver(plain_arm(vq.load_problem("five_bay_two_cubes")))
    assert resolver.step(position=[0.05, 0.0, 4.04]).status == "reached"
    return resolver


def test_its_solution_is_the_first_motion_of_the_step(resolver, monkeypatch):
    qp = resolver.build(position=GOAL)
    limits = (qp.row_lower.copy(), qp.row_upper.copy())

    z, _ = solved(qp)
    arm, engine, answers = resolver.setup.arm, resolver.setup.engine, []
    solve = engine.solve
    monkeypatch.setattr(engine, "solve", lambda asked: answers.append(solve(asked)) or answers[-1])
    step = resolver.step(position=GOAL)
    assert step.status == "reached"
    solution = answers[0]
    moved = {label.name: value for label, value in zip(qp.columns, z, strict=True)}
    np.testing.assert_allclose(
        [moved[f"stroke: {arm.quantity_names[k]}"] for k in arm.actuators],
        solution.actuators,
        atol=1e-7,
    )
    assert moved["progress along the path"] == pytest.approx(solution.progress, abs=1e-7)
    np.testing.assert_array_equal(limits, (qp.row_lower, qp.row_upper))


def test_every_row_and_column_has_a_name_a_kind_and_a_unit(resolver):
    qp = resolver.build(position=GOAL)
    assert qp.A.shape == (len(qp.rows), len(qp.columns))
    assert qp.P.shape == (len(qp.columns), len(qp.columns))
    assert all(
        label.name and label.kind and label.unit in ("m", "rad", "1") for label in qp.rows + qp.columns
    )
    assert len({label.name for label in qp.columns}) == len(qp.columns)
    text = str(qp)
    for label in qp.rows + qp.columns:
        assert f"{label.kind} [{label.unit}]" in text
    assert "right cube" in text
    assert len(repr(qp)) < 80


def test_building_moves_nothing(resolver):
    state = resolver.state
    first, second = resolver.build(position=GOAL), resolver.build(position=[0.0, 0.1, 4.0])
    assert resolver.state is state
    assert not np.array_equal(first.A.data, second.A.data)


def test_a_qp_stays_as_it_is_when_another_is_built(resolver):
    goal = [0.05, 0.05, 4.45]
    first = resolver.build(position=goal)
    kept = [first.P.copy(), first.A.copy(), first.q.copy(), first.row_lower.copy()]
    for dt in (0.9, 1.1):
        resolver.step(position=goal, dt=dt)
        resolver.build(position=goal, dt=dt)
    for now, before in zip((first.P, first.A), kept, strict=False):
        assert (now != before).nnz == 0
    assert np.array_equal(first.q, kept[2])
    assert np.array_equal(first.row_lower, kept[3])


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ({"position": [0.0, np.nan, 4.0]}, "three finite numbers"),
        ({"pointing": [0.0, 0.0, 1.0]}, "not tracked, only position"),
        ({"position": GOAL, "dt": 0.0}, "positive number of seconds"),
    ],
)
def test_what_step_refuses_build_refuses(resolver, goal, message):
    with pytest.raises(vq.GoalError, match=message):
        resolver.build(**goal)
