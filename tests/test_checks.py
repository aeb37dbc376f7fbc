"""Hopeless problems are refused for a reason that is proven; doubtful ones are let through with a warning."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import vgtm_qp as vq
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.arm.truss.bounds import longest_paths
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.checks import check_problem, find_warnings


@pytest.fixture(scope="module")
def free() -> vq.Problem:
    return vq.load_problem("five_bay_free")


def found(problem: vq.Problem, changes: dict[str, Any]) -> tuple[list[vq.Mistake], list[vq.Mistake]]:
    changed = problem.replace(changes)
    setup = build_arm(changed)
    return check_problem(changed, setup), find_warnings(changed, setup)


def ball(center: list[float], radius: float, **more: Any) -> dict[str, Any]:
    return {"obstacle": [{"name": "ball", "shape": "sphere", "center": center, "radius": radius, **more}]}


def waypoint(*position: float) -> dict[str, Any]:
    return {"maneuver.waypoint": [{"time": 10.0, "position": list(position)}]}


@pytest.mark.parametrize("name", sorted(vq.bundled_problems()))
def test_no_bundled_problem_is_refused_or_doubted(name: str):
    problem = vq.load_problem(name)
    setup = build_arm(problem)
    assert check_problem(problem, setup) == []
    assert find_warnings(problem, setup) == []


def test_an_obstacle_in_the_arm_is_refused_and_one_beside_it_doubted(free: vq.Problem):
    setup = build_arm(free)
    truss = truss_of(setup.arm)
    ends = truss.home[truss.members[truss.member("L3-1")]]
    out = ends.mean(axis=0) * [1.0, 1.0, 0.0]
    out /= np.linalg.norm(out)
    reach = 0.2 + 0.03
    inside, _ = found(free, ball((ends.mean(axis=0) + 0.99 * reach * out).tolist(), 0.2))
    assert [mistake.key for mistake in inside] == ['obstacle[0] ("ball").center']
    assert "L3-1" in inside[0].expected
    mistakes, warnings = found(free, ball((ends.mean(axis=0) + (reach + 0.04) * out).tolist(), 0.2))
    assert mistakes == []
    assert [warning.key for warning in warnings] == ['obstacle[0] ("ball").center']
    assert found(free, ball((ends.mean(axis=0) + (reach + 0.2) * out).tolist(), 0.2)) == ([], [])


def test_solve_refuses_what_check_refuses(free: vq.Problem):
    with pytest.raises(
        vq.ProblemError, match=r"five_bay_free\.toml: maneuver\.waypoint\[0\]\.position: .*reach"
    ):
        vq.solve(free.replace(waypoint(30.0, 0.0, 0.0)))


def test_a_target_out_of_reach_is_refused_on_the_tracked_axes_only(free: vq.Problem):
    mistakes, _ = found(free, waypoint(0.0, 0.0, 5.3))
    assert [mistake.key for mistake in mistakes] == ["maneuver.waypoint[0].position"]
    assert "base node" in mistakes[0].expected
    changes = {"end_effector.track": ["x", "z"], **waypoint(1.0, 90.0, 3.0)}
    assert found(free, changes) == ([], [])


def test_the_row_of_a_path_file_is_named(free: vq.Problem, tmp_path):
    (tmp_path / "path.csv").write_text("t,x,y,z\n0,0,0,4\n1,0.1,0,4\n2,40,0,4\n", encoding="utf-8")
    mistakes, _ = found(free, {"maneuver": {"path": str(tmp_path / "path.csv")}})
    assert len(mistakes) == 1
    assert mistakes[0].key.endswith('path.csv", row 3 of numbers')


def test_a_target_in_an_obstacle_is_refused_where_no_tip_can_surround_it(free: vq.Problem):
    mistakes, _ = found(free, ball([1.6, 0.0, 3.3], 0.45))
    assert [mistake.key for mistake in mistakes] == ["maneuver.waypoint[0].position"]
    mistakes, warnings = found(free, ball([1.6, 0.0, 3.3], 0.1))
    assert mistakes == []
    assert [warning.key for warning in warnings] == ["maneuver.waypoint[0].position"]
    assert found(free, ball([1.6, 0.0, 3.3], 0.45, velocity=[0.0, 1.0, 0.0])) == ([], [])


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_no_pose_reaches_farther_than_the_longest_paths(seed: int):
    problem = vq.load_problem("five_bay_free")
    truss = truss_of(build_arm(problem).arm)
    nodes = truss.home * np.random.default_rng(seed).uniform(0.3, 1.1, 3)
    lengths = np.linalg.norm(np.diff(nodes[truss.members], axis=1)[:, 0], axis=1)
    # Any positions are a pose of a truss whose members may be as long as they are there.
    scale = float((lengths / truss.stroke[:, 1]).max())
    sources = np.flatnonzero(truss.base)
    apart = np.linalg.norm(nodes[sources, None] - nodes[None], axis=2)
    assert np.all(apart <= scale * longest_paths(truss, sources) + 1e-12)
