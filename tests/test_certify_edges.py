"""Proofs for trajectories at their edges: a micrometre decides; moving things, locks, meshes; random arms."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import vgtm_qp as vq
from vgtm_qp.result.chain import RecordedChain

SAFE = 0.02
NAMES = ("one", "two", "three")


def problem(
    joints: list[dict[str, Any]], obstacles: Sequence[dict[str, Any]] = (), **more: Any
) -> vq.Problem:
    """A serial arm of these joints, with a last link of 0.3 m."""
    clearance = {"safe": SAFE, **more.pop("clearance", {})}
    return vq.Problem.from_dict(
        {
            "arm": {"joint": joints, "tip": [0.3, 0.0, 0.0], "link_radius": 0.05, **more},
            "maneuver": {"waypoint": [{"time": 1.0, "position": [0.5, 0.0, 0.0]}]},
            "obstacle": list(obstacles),
            "clearance": clearance,
        }
    )


def planar(
    obstacles: Sequence[dict[str, Any]] = (), joint: dict[str, Any] | None = None, **more: Any
) -> vq.Problem:
    """Three joints about z, one in the origin and two each 0.5 m further out along x."""
    joints = [
        {
            "name": name,
            "axis": [0.0, 0.0, 1.0],
            "position": [0.5 if k else 0.0, 0.0, 0.0],
            "limits": [-2.0, 2.0],
            **(joint or {}),
        }
        for k, name in enumerate(NAMES)
    ]
    return problem(joints, obstacles, **more)


def ball(center: list[float], radius: float = 0.1, **more: Any) -> dict[str, Any]:
    return {"name": "ball", "shape": "sphere", "center": center, "radius": radius, **more}


def seven(seed: int) -> vq.Problem:
    """Seven joints among ten obstacles."""
    rng = np.random.default_rng(seed)
    joints = [
        {
            "name": f"j{k}",
            "axis": [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]][k % 2],
            "position": [0.0, 0.0, 0.3 if k else 0.1],
            "limits": [-2.9, 2.9],
        }
        for k in range(7)
    ]
    obstacles = []
    for k in range(10):
        center = rng.normal(size=3)
        center *= rng.uniform(0.9, 2.0) / np.linalg.norm(center)
        shape: dict[str, Any] = [
            {"shape": "box", "size": [0.2, 0.3, 0.25]},
            {"shape": "sphere", "radius": 0.15},
            {"shape": "cylinder", "radius": 0.1, "height": 0.4},
        ][k % 3]
        turn = {} if k % 3 == 1 else {"rotation_vector": rng.normal(size=3).tolist()}
        obstacles.append({"name": f"body {k}", "center": center.tolist(), **shape, **turn})
    return problem(joints, obstacles)


def wander(rng: np.random.Generator, rows: int, joints: int, pace: float) -> tuple[np.ndarray, np.ndarray]:
    values = np.cumsum(rng.normal(size=(rows, joints)) * pace, axis=0)
    return 0.2 * np.arange(rows), np.clip(values, -1.9, 1.9)


def positions(asked: vq.Problem, values: np.ndarray) -> np.ndarray:
    """(Q, J + 2, 3) base, joints and tip by SciPy's rotations; a second way beside the record's."""
    assert asked.arm
    at, turn, found = np.zeros((len(values), 3)), Rotation.identity(len(values)), [np.zeros((len(values), 3))]
    for k, joint in enumerate(asked.arm.joint):
        axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
        at = at + turn.apply(joint.position)
        turn = turn * Rotation.from_rotvec(joint.rotation_vector)
        found.append(at)
        if joint.kind == "revolute":
            turn = turn * Rotation.from_rotvec(values[:, k, None] * axis)
        else:
            at = at + turn.apply(axis) * values[:, k, None]
    return np.stack([*found, at + turn.apply(asked.arm.tip)], axis=1)


def brute(asked: vq.Problem, times: np.ndarray, values: np.ndarray, samples: int) -> float:
    """The least clearance of points on the links to boxes and spheres, at `samples` instants of each step, m.

    It is never below the real one; a link's axis in a body counts as one that touches it.
    """
    assert asked.arm
    t = np.unique(np.concatenate([np.linspace(a, b, samples) for a, b in itertools.pairwise(times)]))
    joints = positions(asked, np.stack([np.interp(t, times, column) for column in values.T], axis=1))[:, 1:]
    share = np.linspace(0.0, 1.0, 21)[:, None]
    points = joints[:, :-1, None] + share * (joints[:, 1:, None] - joints[:, :-1, None])
    least = np.inf
    for body in asked.obstacle:
        table = body.model_dump()
        seen = points - np.array(table["center"])
        velocity = table.get("velocity")
        if velocity is not None:
            seen = seen - t[:, None, None, None] * np.array(velocity)
        if table["shape"] == "sphere":
            apart = np.maximum(np.linalg.norm(seen, axis=-1) - table["radius"], 0.0)
        else:
            turned = (
                Rotation.from_rotvec(table["rotation_vector"] or [0.0] * 3).inv().apply(seen.reshape(-1, 3))
            )
            outside = np.maximum(np.abs(turned) - np.array(table["size"]) / 2, 0.0)
            apart = np.linalg.norm(outside, axis=-1)
        least = min(least, float(apart.min()) - asked.arm.link_radius)
    return least


def kinds(found: tuple[vq.Finding, ...]) -> list[tuple[str, tuple[str, ...]]]:
    return [(finding.kind, finding.names) for finding in found]


SWEEP = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
"""The straight planar arm, 1.3 m long, swings through the x axis."""


def at_tip(clearance: float, **more: Any) -> dict[str, Any]:
    """A ball that the sweep passes at that clearance."""
    return ball([1.3 + 0.05 + 0.1 + clearance, 0.0, 0.0], **more)


def test_a_sweep_that_is_clear_at_its_rows_and_not_between_them():
    asked = planar([at_tip(0.015)])
    for row in SWEEP:
        assert vq.certify(asked, [0.0], [row]).certified
    verdict = vq.certify(asked, [0.0, 1.0], SWEEP)
    assert not verdict.certified
    assert kinds(verdict.violations) == [("clearance", ("three", "ball"))]
    (found,) = verdict.violations
    assert found.value == pytest.approx(0.015, abs=1e-12)
    assert found.bound == SAFE
    assert 0.4 < found.start <= 0.5 <= found.end < 0.6
    assert verdict.clearance <= 0.015


@pytest.mark.parametrize(("spare", "certified"), [(1e-6, True), (-1e-6, False), (1e-3, True), (-1e-4, False)])
def test_a_micrometre_decides(spare: float, certified: bool):
    verdict = vq.certify(planar([at_tip(SAFE + spare)]), [0.0, 1.0], SWEEP)
    assert verdict.certified is certified
    assert bool(verdict.violations) is not certified
    assert not certified or SAFE - 1e-9 <= verdict.clearance <= SAFE + spare + 1e-12


def test_exactly_the_clearance_that_is_asked_for_is_enough():
    verdict = vq.certify(planar([at_tip(SAFE)]), [0.0, 1.0], SWEEP)
    assert not verdict.violations
    assert verdict.certified
    assert verdict.clearance >= SAFE - 1e-9


def test_a_moving_obstacle_is_where_it_is_at_the_time():
    # It comes in along x and is at the tip's way when the arm is elsewhere, or there.
    body = at_tip(1.0 - 0.5 * 2.0, velocity=[-2.0, 0.0, 0.0])
    early = vq.certify(planar([at_tip(2.0, velocity=[-1.0, 0.0, 0.0])]), [0.0, 1.0], SWEEP)
    late = vq.certify(planar([at_tip(2.0, velocity=[-1.0, 0.0, 0.0])]), [1.485, 2.485], SWEEP)
    assert early.certified
    assert kinds(late.violations) == [("clearance", ("three", "ball"))]
    assert not vq.certify(planar([body]), [0.0, 1.0], SWEEP).certified


def test_a_moving_base_counts_and_its_poses_need_no_rows():
    poses = [{"time": 0.5, "position": [0.1, 0.0, 0.0]}, {"time": 1.0, "position": [0.0, 0.0, 0.0]}]
    asked = planar([at_tip(0.11)], base_motion=poses)
    verdict = vq.certify(asked, [0.0, 1.0], SWEEP)
    assert kinds(verdict.violations) == [("clearance", ("three", "ball"))]
    assert verdict.violations[0].value == pytest.approx(0.01, abs=1e-12)
    assert vq.certify(planar([at_tip(0.11)]), [0.0, 1.0], SWEEP).certified


def test_a_base_that_turns_about_changing_axes_is_decided():
    poses = [
        {"time": 0.5, "rotation_vector": [0.3, 0.0, 0.0]},
        {"time": 1.0, "rotation_vector": [0.0, 0.4, 0.0]},
    ]
    verdict = vq.certify(planar(base_motion=poses), [0.0, 1.0], SWEEP)
    assert verdict.certified


def test_links_keep_apart_and_need_not_where_the_problem_says_so():
    path = np.array([[0.0, 0.0, 0.0], [0.0, 2.6, 2.6], [0.0, 0.0, 0.0]])
    joint = {"limits": [-3.0, 3.0]}
    verdict = vq.certify(planar(joint=joint), [0.0, 1.0, 2.0], path)
    assert kinds(verdict.violations) == [("self-clearance", ("one", "three"))]
    assert verdict.violations[0].start < 1.0 < verdict.violations[0].end
    free = planar(joint=joint, clearance={"self_collision": False})
    assert vq.certify(free, [0.0, 1.0, 2.0], path).certified


def test_limits_rates_and_accelerations():
    asked = planar(joint={"rate": 1.0, "acceleration": 5.0})
    times = np.array([0.0, 1.0, 2.0, 3.0])

    def verdict(*values: float) -> vq.Verdict:
        return vq.certify(asked, times, np.stack([np.zeros(4), np.array(values), np.zeros(4)], axis=1))

    assert verdict(0.0, 1.0, 2.0, 1.0).certified
    high = verdict(0.0, 1.0, 2.0, 2.001).violations
    assert [(each.kind, each.names, each.value, each.bound) for each in high] == [
        ("limit", ("two",), 2.001, 2.0)
    ]
    assert (high[0].start, high[0].end) == (2.0, 3.0)
    fast = verdict(0.0, 1.0, -0.5, 0.0).violations
    assert [(each.kind, each.names, each.start, each.end) for each in fast] == [("rate", ("two",), 1.0, 2.0)]
    assert fast[0].value == pytest.approx(1.5)
    close = np.array([0.0, 0.1, 0.2, 0.3])
    values = np.stack([np.zeros(4), np.array([0.0, 0.09, 0.0, 0.0]), np.zeros(4)], axis=1)
    jerky = vq.certify(asked, close, values).violations
    assert kinds(jerky) == [("acceleration", ("two",))]
    assert jerky[0].value == pytest.approx(18.0)


@pytest.mark.parametrize("since", [0.0, 1.0, 1.5])
def test_a_locked_joint_stands_still_from_then_on(since: float):
    lock = {"joint": "two"} if since == 0.0 else {"joint": "two", "time": since}
    asked = planar(locked=[lock])

    def verdict(*values: float) -> vq.Verdict:
        return vq.certify(
            asked, np.arange(4.0), np.stack([np.arange(4) * 0.1, np.array(values), np.zeros(4)], axis=1)
        )

    first = 0.0 if since == 0.0 else 0.1
    assert verdict(0.0, first, first, first).certified
    assert kinds(verdict(0.0, first, first, 0.3).violations) == [("lock", ("two",))]
    assert kinds(verdict(0.0, first, 0.2, 0.2).violations) == [("lock", ("two",))]


def test_a_link_inside_a_closed_mesh_touches_it(tmp_path: Path):
    import trimesh

    file = tmp_path / "shell.stl"
    trimesh.creation.icosphere(subdivisions=2, radius=5.0).export(file)
    asked = planar([{"name": "shell", "shape": "mesh", "file": str(file)}])
    verdict = vq.certify(asked, [0.0, 1.0], SWEEP)
    assert {names for _, names in kinds(verdict.violations)} == {(name, "shell") for name in NAMES}
    outside = planar([{"name": "shell", "shape": "mesh", "file": str(file), "center": [0.0, 0.0, 5.2]}])
    assert vq.certify(outside, [0.0, 1.0], SWEEP).certified
    near = planar([{"name": "shell", "shape": "mesh", "file": str(file), "center": [0.0, 0.0, 5.05]}])
    assert kinds(vq.certify(near, [0.0, 1.0], SWEEP).violations)


def test_planted_penetrations_are_all_found():
    rng = np.random.default_rng(3)
    for _ in range(120):
        times, values = wander(rng, 3, 3, 0.2)
        step, share = int(rng.integers(2)), rng.uniform(0.05, 0.95)
        points = positions(planar(), values[step : step + 1] * (1 - share) + values[step + 1] * share)[0]
        middle = points[1] + rng.uniform(0.1, 0.9) * (points[2] - points[1])
        radius, depth = rng.uniform(0.02, 0.3), 10.0 ** rng.uniform(-4.0, -2.0)
        up = 0.05 + SAFE + radius - depth * 1.000001
        verdict = vq.certify(planar([ball([middle[0], middle[1], up], radius)]), times, values)
        assert ("clearance", ("one", "ball")) in kinds(verdict.violations)


def test_clear_trajectories_with_a_millimetre_to_spare_are_certified():
    certified = 0
    for seed in range(8):
        asked = seven(seed)
        times, values = wander(np.random.default_rng(seed), 8, 7, 0.1)
        states = vq.certify(asked, times, values)
        least = min((each.value for each in states.violations), default=states.clearance)
        if least < 2e-3 or states.clearance < 2e-3:
            continue
        safe = states.clearance - 1e-3
        closer = asked.replace(
            {
                "clearance.safe": safe,
                "clearance.self_safe": 0.0,
                "clearance.influence": 9.0,
            }
        )
        verdict = vq.certify(closer, times, values)
        assert verdict.certified
        assert verdict.clearance <= brute_seven(closer, times, values) + 1e-12
        certified += 1
    assert certified >= 3


def brute_seven(asked: vq.Problem, times: np.ndarray, values: np.ndarray) -> float:
    """The brute force without the cylinders, which it does not know."""
    data = asked.to_dict()
    data["obstacle"] = [body for body in data["obstacle"] if body["shape"] != "cylinder"]
    return brute(vq.Problem.from_dict(data), times, values, 300)


@st.composite
def scenes(draw: st.DrawFn) -> tuple[vq.Problem, np.ndarray, np.ndarray]:
    seed, count = draw(st.integers(0, 2**32 - 1)), draw(st.integers(1, 5))
    rng = np.random.default_rng(seed)
    joints: list[dict[str, Any]] = []
    for k in range(count):
        slides = draw(st.booleans()) and k > 0
        joints.append(
            {
                "name": f"j{k}",
                "kind": "prismatic" if slides else "revolute",
                "axis": rng.normal(size=3).tolist(),
                "position": (rng.normal(size=3) * 0.3).tolist(),
                "rotation_vector": rng.normal(size=3).tolist(),
                "limits": [-2.0, 2.0],
            }
        )
    obstacles: list[dict[str, Any]] = []
    for k in range(draw(st.integers(1, 4))):
        body = {"name": f"b{k}", "center": (rng.normal(size=3) * 0.7).tolist()}
        body["velocity"] = (rng.normal(size=3) * draw(st.sampled_from([0.0, 0.3]))).tolist()
        if k % 2:
            obstacles.append({**body, "shape": "sphere", "radius": rng.uniform(0.05, 0.3)})
        else:
            turn = rng.normal(size=3).tolist()
            obstacles.append(
                {**body, "shape": "box", "size": rng.uniform(0.1, 0.4, 3).tolist(), "rotation_vector": turn}
            )
    times, values = wander(rng, draw(st.integers(2, 5)), count, draw(st.sampled_from([0.05, 0.4, 1.0])))
    return problem(joints, obstacles, clearance={"self_collision": False}), times, values


@given(scenes())
@settings(max_examples=60, deadline=None)
def test_nothing_is_certified_that_brute_force_refutes(scene: tuple[vq.Problem, np.ndarray, np.ndarray]):
    asked, times, values = scene
    verdict, least = vq.certify(asked, times, values), brute(asked, times, values, 200)
    assert verdict.clearance <= least + 1e-9
    if verdict.certified:
        assert least >= SAFE - 1e-9
    if least < SAFE - 1e-6:
        assert any(each.kind == "clearance" for each in (*verdict.violations, *verdict.undecided))
    for each in verdict.violations:
        assert each.kind == "clearance"
        assert each.value < SAFE


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_the_bound_of_bending_holds(seed: int):
    from vgtm_qp.arm.build import make_arm

    rng = np.random.default_rng(seed)
    joints = [
        {
            "name": f"j{k}",
            "kind": "prismatic" if k and rng.random() < 0.3 else "revolute",
            "axis": rng.normal(size=3).tolist(),
            "position": rng.normal(size=3).tolist(),
            "limits": [-3.0, 3.0],
        }
        for k in range(int(rng.integers(1, 6)))
    ]
    chain = RecordedChain(make_arm(problem(joints)).record())
    before, after = rng.uniform(-2.0, 2.0, (2, len(joints) + 6))
    share = np.linspace(0.0, 1.0, 2001)[:, None]
    ends = chain.states_ends(before + share * (after - before))
    second = np.linalg.norm(np.diff(ends, n=2, axis=0), axis=3).max(axis=(0, 2)) * 2000.0**2
    bound = chain.bend(before, after, np.arange(len(chain.links)))
    assert (second <= bound * (1.0 + 1e-3) + 1e-3).all()
    assert np.array_equal(chain.bend(before, after, np.arange(len(bound))), bound)
