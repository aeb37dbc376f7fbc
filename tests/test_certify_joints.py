"""Trajectories of serial arms: what is certified is so at every instant, and what is wrong is found and named."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from certify_scenes import (
    RADIUS,
    SAFE,
    axes_at,
    planted,
    random_rows,
    sampled_clearance,
    serial_problem,
)
from hypothesis import given, settings
from hypothesis import strategies as st

import vgtm_qp as vq
from vgtm_qp.certify.certify import Certifier
from vgtm_qp.certify.decide import decide
from vgtm_qp.certify.motion import JointMotion
from vgtm_qp.cli import main

seeds = st.integers(0, 2**32 - 1)


def planar(**tables: Any) -> vq.Problem:
    """Two joints about z, links of 1 m along x; more tables, or keys of [arm] by `arm`."""
    joints = [
        {"name": "hip", "axis": [0, 0, 1], "limits": [-3, 3], "rate": 1.0, "acceleration": 2.0},
        {"name": "knee", "axis": [0, 0, 1], "position": [1, 0, 0], "limits": [-2, 2]},
    ]
    data = {
        "schema_version": 1,
        "arm": {"joint": joints, "tip": [1.0, 0.0, 0.0], "link_radius": 0.03} | tables.pop("arm", {}),
        "maneuver": {"waypoint": [{"time": 1.0, "position": [1.0, 1.0, 0.0]}]},
        "clearance": {"safe": SAFE, "influence": 0.5},
    }
    return vq.Problem.from_dict(data | tables)


def post(x: float, y: float, radius: float = 0.1, **more: Any) -> dict[str, Any]:
    return {"name": "post", "shape": "sphere", "center": [x, y, 0.0], "radius": radius, **more}


def test_what_bends_without_a_bound_is_not_certified() -> None:
    problem = planar(obstacle=[post(1.0, 0.6)])
    certifier = Certifier(problem)
    motion = JointMotion(certifier.arm, np.array([0.0, 1.0]), np.zeros((2, 2)), problem.to_dict())
    assert not decide(motion, certifier.kept(motion))["clearance"].undecided
    motion.bends[:] = np.inf
    assert decide(motion, certifier.kept(motion))["clearance"].undecided


def test_an_obstacle_is_known_no_better_than_its_clock() -> None:
    kept = []
    for x, start in ((1.0, 0.0), (-1e6 + 1.0, 1e6)):
        problem = planar(obstacle=[post(x, 0.17, velocity=[1.0, 0.0, 0.0])])
        certifier = Certifier(problem)
        motion = JointMotion(certifier.arm, start + np.array([0.0, 0.5]), np.zeros((2, 2)), problem.to_dict())
        kept += certifier.kept(motion)[:1]
    assert kept[0].rounding < 1e-12
    # Its centre and its way cancel.
    assert kept[1].rounding >= 64.0 * 2e6 * np.finfo(float).eps


@pytest.mark.smoke
def test_a_clear_trajectory_is_certified_with_a_bound_below_every_sample(rng: np.random.Generator) -> None:
    certified = 0
    for _ in range(20):
        problem = serial_problem(rng, joints=5, obstacles=3)
        times, joints = random_rows(rng, problem, 3, 0.1)
        verdict = vq.certify(problem, times, joints)
        sampled = sampled_clearance(problem, times, joints, 300)
        assert verdict.clearance <= sampled + 1e-9
        if verdict.certified:
            certified += 1
            assert sampled >= SAFE - 1e-9
            # The bound is near the least clearance: within a thousandth of the mean link.
            assert verdict.clearance >= sampled - 2e-3
    assert certified


@given(seeds, st.integers(1, 8), st.booleans(), st.sampled_from([0.02, 0.2, 1.0]))
@settings(max_examples=40, deadline=None)
def test_nothing_is_certified_that_sampling_refutes(
    seed: int, joints: int, slides: bool, step: float
) -> None:
    rng = np.random.default_rng(seed)
    problem = serial_problem(rng, joints, 4, slides=slides)
    times, values = random_rows(rng, problem, 3, step)
    verdict = vq.certify(problem, times, values)
    sampled = sampled_clearance(problem, times, values, 100)
    assert not (verdict.certified and sampled < SAFE - 1e-9)
    near = [finding for finding in verdict.violations if finding.kind == "clearance"]
    assert bool(near) or sampled >= SAFE - 1e-9 or verdict.undecided
    for finding in near:
        assert finding.value < SAFE - 1e-9
        assert times[0] <= finding.start <= finding.at <= finding.end <= times[-1]
    # A segment may bend far where joints turn by radians, but nothing of it stays in doubt.
    assert not verdict.undecided


def test_penetrations_planted_between_rows_are_all_found(rng: np.random.Generator) -> None:
    found = 0
    while found < 100:
        problem = serial_problem(rng, int(rng.integers(2, 9)), 0, slides=bool(rng.random() < 0.3))
        for _ in range(10):
            case = planted(rng, problem, float(10.0 ** rng.uniform(-4, -2.3)))
            if case is None:
                continue
            changed, times, joints = case
            verdict = vq.certify(changed, times, joints)
            assert not verdict.certified
            assert verdict.answer == "violated"
            assert {finding.names[1] for finding in verdict.violations} == {"ball"}
            found += 1


def test_one_millimetre_to_spare_is_enough(rng: np.random.Generator) -> None:
    certified = []
    while len(certified) < 40:
        problem = serial_problem(rng, int(rng.integers(2, 9)), 0)
        times, joints = random_rows(rng, problem, 4, 0.2)
        at = np.linspace(times[0], times[-1], 2001)
        ends = axes_at(problem, np.stack([np.interp(at, times, column) for column in joints.T], axis=1))
        away = rng.normal(size=3)
        center = ends[1000, int(rng.integers(ends.shape[1])), 1] + 0.4 * away / np.linalg.norm(away)
        along = np.linspace(0, 1, 65)[:, None]
        points = ends[:, :, None, 0] + along * (ends[:, :, None, 1] - ends[:, :, None, 0])
        # Between two samples of time and of the axis nothing comes nearer by a tenth of a millimetre.
        radius = float(np.linalg.norm(points - center, axis=-1).min()) - RADIUS - SAFE - 1.1e-3
        if radius < 0.01:
            continue
        ball = {"name": "ball", "shape": "sphere", "center": center.tolist(), "radius": radius}
        certified.append(vq.certify(problem.replace({"obstacle": [ball]}), times, joints).certified)
    assert sum(certified) >= 39


def test_a_violation_has_its_time_its_bodies_and_its_depth() -> None:
    # The second link sweeps past a post that it touches at 45 degrees alone.
    problem = planar(obstacle=[post(1.5, 1.5, 0.5 * np.sqrt(2.0) * 0.3)])
    reach = 1.5 * np.sqrt(2.0) - 0.15 * np.sqrt(2.0)
    verdict = vq.certify(problem, [0.0, 2.0], [[0.0, 0.0], [np.pi / 2, 0.0]])
    (finding,) = [found for found in verdict.violations if found.kind == "clearance"]
    assert finding.names == ("knee", "post")
    assert finding.at == pytest.approx(1.0, abs=0.05)
    assert finding.value == pytest.approx(max(reach - 2.0 - 0.03, -0.03), abs=2e-3)
    assert finding.bound == SAFE
    assert 0.5 < finding.start <= 1.0 <= finding.end < 1.5
    assert verdict.clearance <= finding.value


def test_the_whole_is_clear_where_rows_and_chords_are_not() -> None:
    # The tip goes round the post on an arc; the straight line between its two ends goes through it.
    problem = planar(obstacle=[post(1.1, 1.1, 0.3)], arm={"link_radius": 0.01})
    times, joints = [0.0, 2.0], [[0.0, 0.0], [np.pi / 2, 0.0]]
    assert vq.certify(problem.replace({"obstacle": []}), times, joints).clearance == np.inf
    assert vq.certify(problem, times, joints).answer == "violated"
    beyond = problem.replace({"obstacle": [post(1.6, 1.6, 0.2)]})
    verdict = vq.certify(beyond, times, joints)
    assert verdict.certified
    assert verdict.clearance == pytest.approx(1.6 * np.sqrt(2.0) - 2.0 - 0.21, abs=2e-3)


def test_exactly_what_is_safe_is_certified() -> None:
    # The tip stays on its circle, at exactly the safe distance all the way.
    gap = SAFE + RADIUS
    problem = planar(obstacle=[post(2.0 + gap + 0.5, 0.0, 0.5)])
    assert vq.certify(problem, [0.0, 1.0], [[0.0, 0.0], [0.5, 0.0]]).certified
    assert vq.certify(problem, [0.0, 1.0], [[-0.4, 0.0], [0.5, 0.0]]).certified
    nearer = problem.replace({"obstacle": [post(2.0 + gap + 0.5 - 1e-6, 0.0, 0.5)]})
    assert vq.certify(nearer, [0.0, 1.0], [[-0.4, 0.0], [0.5, 0.0]]).answer == "violated"


@pytest.mark.smoke
def test_limits_rates_and_accelerations_are_those_of_the_whole_time() -> None:
    problem = planar()
    times = [0.0, 1.0, 2.0, 3.0, 4.0]
    hip = [2.5, 3.5, 3.5, 2.5, 2.4]
    verdict = vq.certify(problem, times, {"knee": [0.0] * 5, "hip": hip})
    (beyond,) = verdict.violations
    assert (beyond.kind, beyond.names, beyond.value, beyond.bound) == ("limit", ("hip",), 3.5, 3.0)
    assert (beyond.start, beyond.end) == pytest.approx((0.5, 2.5))
    fast = vq.certify(problem, [0.0, 1.0, 2.0], [[0.0, 0.0], [1.1, 0.0], [2.0, 0.0]])
    (finding,) = fast.violations
    assert (finding.kind, finding.start, finding.end) == ("rate", 0.0, 1.0)
    assert (finding.value, finding.bound) == pytest.approx((1.1, 1.0))
    sudden = vq.certify(problem, [0.0, 0.1, 0.2], [[0.0, 0.0], [0.05, 0.0], [0.0, 0.0]])
    (finding,) = sudden.violations
    assert (finding.kind, finding.names, finding.at) == ("acceleration", ("hip",), 0.1)
    assert (finding.value, finding.bound) == pytest.approx((10.0, 2.0))


def test_a_rate_at_its_limit_is_certified_at_late_times_too() -> None:
    problem = planar()
    times = 1e5 + 0.01 * np.arange(50)
    assert vq.certify(problem, times, np.stack([times - times[0], 0 * times], axis=1)).certified


def test_a_locked_joint_must_not_move() -> None:
    times, joints = [0.0, 1.0, 2.0, 3.0], [[0, 0], [0, 0.5], [0, 0.5], [0, 0.5]]
    still = planar(arm={"locked": [{"joint": "knee", "time": 1.0}]})
    assert vq.certify(still, times, joints).certified
    # It jams between two rows, and moves on until the second of them.
    between = planar(arm={"locked": [{"joint": "knee", "time": 0.5}]})
    (finding,) = vq.certify(between, times, joints).violations
    assert (finding.kind, finding.names) == ("lock", ("knee",))
    assert (finding.value, finding.bound) == pytest.approx((0.5, 0.25))
    assert finding.start == 0.5
    stuck = planar(arm={"locked": ["knee"]})
    assert vq.certify(stuck, times, {"hip": [0, 0, 0.1, 0.1]}).certified
    (finding,) = vq.certify(stuck, times, joints).violations
    assert (finding.kind, finding.bound) == ("lock", 0.0)


def test_obstacles_and_base_move_with_time() -> None:
    # Post and arm would meet at 1 s at the earliest; the arm is elsewhere by then.
    coming = post(2.5, 0.0, velocity=[-0.5, 0.0, 0.0])
    problem = planar(obstacle=[coming])
    still = vq.certify(problem, [0.0, 2.0], [[0.0, 0.0], [0.0, 0.0]])
    assert still.answer == "violated"
    assert still.violations[0].start <= 0.8
    assert vq.certify(problem, [0.0, 0.6], [[0.0, 0.0], [0.0, 0.0]]).certified
    assert vq.certify(problem, [0.0, 2.0], [[0.0, 0.0], [np.pi / 2, 0.0]]).certified
    # The base turns the arm into a post, and out again between two rows.
    turns = [
        {"time": 1.0, "rotation_vector": [0.0, 0.0, 0.5]},
        {"time": 2.0, "rotation_vector": [0.0, 0.0, 0.0]},
    ]
    turned = planar(obstacle=[post(1.7, 0.9)], arm={"base_motion": turns})
    rows = [[0.0, 0.0], [0.0, 0.0]]
    (finding,) = vq.certify(turned, [0.0, 2.0], rows).violations
    assert finding.at == pytest.approx(1.0, abs=0.1)
    assert vq.certify(planar(obstacle=[post(1.7, 0.9)]), [0.0, 2.0], rows).certified


def test_a_base_that_turns_about_a_changing_axis_is_where_the_problem_has_it(
    rng: np.random.Generator,
) -> None:
    turns = [
        {"time": 1.0, "rotation_vector": [0.0, 0.0, 1.2]},
        {"time": 2.0, "rotation_vector": [0.0, 1.2, 0.4]},
    ]
    moved = planar(arm={"base_motion": turns})
    from vgtm_qp.arm.build import make_arm
    from vgtm_qp.result.chain import RecordedChain
    from vgtm_qp.result.poses import base_poses

    chain, table = RecordedChain(make_arm(moved).record()), moved.to_dict()
    at = np.linspace(0.0, 2.0, 801)
    ends = chain.states_ends(np.concatenate([np.zeros((801, 2)), base_poses(table, at)], axis=1))
    for k in (100, 350, 600, 750):
        # A ball above the tip's way at one instant, and one that it just reaches.
        away = ends[k, 1, 1] / np.linalg.norm(ends[k, 1, 1])
        for depth, answer in ((-1e-3, "certified"), (1e-4, "violated")):
            center = ends[k, 1, 1] + away * (0.05 + RADIUS + SAFE - depth)
            ball = {"name": "ball", "shape": "sphere", "center": center.tolist(), "radius": 0.05}
            problem = moved.replace({"obstacle": [ball]})
            assert vq.certify(problem, [0.0, 2.0], np.zeros((2, 2))).answer == answer


def test_links_keep_apart_from_one_another() -> None:
    joints = [
        {"name": f"j{k}", "axis": [0, 0, 1], "position": [1, 0, 0] if k else [0, 0, 0]} for k in range(4)
    ]
    problem = planar(arm={"joint": joints}, clearance={"safe": 0.1, "self_safe": 0.05, "influence": 0.5})
    folded = [[0, 0, 0, 0], [0, 2.2, 2.2, 2.2]]
    verdict = vq.certify(problem, [0.0, 1.0], folded)
    assert verdict.answer == "violated"
    assert {found.kind for found in verdict.violations} == {"self-clearance"}
    assert ("j0", "j3") in {tuple(sorted(found.names)) for found in verdict.violations}
    allowed = problem.replace({"clearance.self_collision": False})
    assert vq.certify(allowed, [0.0, 1.0], folded).certified
    assert vq.certify(problem, [0.0, 1.0], [[0, 0, 0, 0], [0, 0.6, 0.6, 0.6]]).certified


def test_a_mesh_is_solid_and_its_surface_is_hit_between_rows(tmp_path: Path) -> None:
    import trimesh

    trimesh.creation.box((4.0, 4.0, 4.0)).export(tmp_path / "room.stl")
    trimesh.creation.icosphere(3, 0.1).export(tmp_path / "ball.stl")
    room = {"name": "room", "shape": "mesh", "file": str(tmp_path / "room.stl"), "center": [0.5, 0.0, 0.0]}
    rows = [[0.0, 0.0], [0.1, 0.0]]
    # All of the arm is inside, far from the surface.
    inside = vq.certify(planar(obstacle=[room | {"scale": 3.0}]), [0.0, 1.0], rows)
    assert inside.answer == "violated"
    assert inside.violations[0].names[1] == "room"
    assert vq.certify(planar(obstacle=[room | {"center": [6.0, 0.0, 0.0]}]), [0.0, 1.0], rows).certified
    ball = {"name": "ball", "shape": "mesh", "file": str(tmp_path / "ball.stl"), "center": [1.6, 1.6, 0.0]}
    way = [[0.0, 0.0], [np.pi / 2, 0.0]]
    verdict = vq.certify(planar(obstacle=[ball]), [0.0, 2.0], way)
    assert verdict.certified
    near = vq.certify(planar(obstacle=[ball | {"center": [1.45, 1.45, 0.0]}]), [0.0, 2.0], way)
    assert near.answer == "violated"


def test_an_angle_is_kept_between_rows_too() -> None:
    problem = planar(clearance={"safe": SAFE, "influence": 0.5, "minimum_angle": 1.0})
    # Straight on is an angle of pi between the links; 1.9 rad of the knee leave 1.24.
    assert vq.certify(problem, [0.0, 1.0], [[0.0, 1.9], [0.0, -1.9]]).certified
    sharp = problem.replace({"clearance.minimum_angle": 1.3})
    (first, *_) = vq.certify(sharp, [0.0, 1.0], [[0.0, 1.9], [0.0, 0.0]]).violations
    assert (first.kind, set(first.names), first.at) == ("angle", {"hip", "knee"}, 0.0)
    assert first.value == pytest.approx(np.pi - 1.9)
    # The knee may turn through a sharp angle between two rows that are not sharp.
    through = planar(
        arm={
            "joint": [
                {"name": "hip", "axis": [0, 0, 1]},
                {"name": "knee", "axis": [0, 0, 1], "position": [1, 0, 0]},
            ]
        },
        clearance={"safe": SAFE, "influence": 0.5, "minimum_angle": 0.3},
    )
    (finding, *_) = vq.certify(through, [0.0, 1.0], [[0.0, 2.0], [0.0, 4.0]]).violations
    assert finding.kind == "angle"
    assert 0.4 < finding.start <= finding.end < 0.75


@pytest.mark.smoke
def test_one_row_is_a_pose() -> None:
    problem = planar(obstacle=[post(1.5, 0.2)])
    pose = vq.certify(problem, [3.0], [[0.0, 0.0]])
    assert pose.certified
    assert pose.clearance == pytest.approx(0.2 - 0.1 - 0.03)
    (finding,) = vq.certify(problem, [3.0], [[0.1, 0.0]]).violations
    assert (finding.start, finding.end, finding.at) == (3.0, 3.0, 3.0)


def test_a_proof_that_may_not_go_on_is_in_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    module = importlib.import_module("vgtm_qp.certify.decide")
    problem = planar(obstacle=[post(1.6, 1.6, 0.2)])
    monkeypatch.setattr(module, "GREATEST_DEPTH", 1)
    verdict = vq.certify(problem, [0.0, 2.0], [[0.0, 0.0], [np.pi / 2, 0.0]])
    assert verdict.answer == "undecided"
    assert not verdict.certified
    (finding,) = verdict.undecided
    assert (finding.kind, finding.names) == ("clearance", ("knee", "post"))
    assert finding.value < SAFE
    assert 0.0 <= finding.start < finding.end <= 2.0


def test_what_our_own_solver_made_is_certified_and_exported_forms_say_the_same(tmp_path: Path) -> None:
    problem = vq.load_problem("snake_past_a_cube").replace({"maneuver.steps": 12})
    maneuver = vq.solve(problem)
    certifier = Certifier(problem)
    verdict = certifier.certify(maneuver.time, maneuver.joints)
    assert verdict.certified
    assert verdict.clearance <= maneuver.certificate.clearance_between.value + 1e-9
    for suffix in ("csv", "mcap", "yaml"):
        file = vq.export_maneuver(maneuver, tmp_path / f"snake.{suffix}")
        read = certifier.certify_file(file)
        assert read.certified
        assert read.clearance == pytest.approx(verdict.clearance, abs=1e-6)


@pytest.mark.smoke
def test_the_command_says_it_by_its_exit_code(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = [f"{word}-{k}" for k in range(1, 11) for word in ("pitch", "yaw")]
    home = [0.05 if name.startswith("pitch") else 0.08 for name in names]
    table = tmp_path / "t.csv"
    table.write_text(
        "t," + ",".join(names) + "\n" + "".join(f"{t}," + ",".join(map(str, home)) + "\n" for t in (0, 1))
    )
    assert main(["certify", "snake_past_a_cube", str(table), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["certified"] is True
    assert said["clearance"] > 0.08
    assert said["violations"] == said["undecided"] == []
    assert said["time"] > 0.0
    table.write_text(table.read_text() + "2," + ",".join(["0.9"] * 20) + "\n")
    assert main(["certify", "snake_past_a_cube", str(table), "--json"]) == 4
    said = json.loads(capsys.readouterr().out)
    assert said["certified"] is False
    assert {"from", "to", "kind", "names", "value", "bound", "at"} <= set(said["violations"][0])
    assert main(["certify", "snake_past_a_cube", str(table)]) == 4
    assert "violated" in capsys.readouterr().out
    assert main(["certify", "snake_past_a_cube", str(tmp_path / "none.csv")]) == 2
    assert "none.csv: file" in capsys.readouterr().err
