"""Verification: a good maneuver passes, and each single alteration of it is found."""

from __future__ import annotations

import ast
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from modules import octahedral
from synthetic import LENGTHS, RADIUS, found_clearances, good_maneuver, maneuver_of, place, swing, tripod

from vgtm_qp.arm.truss.joints import Joints
from vgtm_qp.errors import ResultError
from vgtm_qp.maneuver.maneuver import Maneuver
from vgtm_qp.verify import check, verify, verify_file
from vgtm_qp.verify.arm import RecordedArm
from vgtm_qp.verify.clearance import RESOLUTION, AgainstBody, AgainstMembers, Least, RecordedMotion
from vgtm_qp.verify.obstacles import read_obstacles


def broken(maneuver: Maneuver) -> set[str]:
    """Names of the measures that fail."""
    return {name for name, measure in verify(maneuver).measures.items() if not measure.ok}


def again(maneuver: Maneuver, nodes: Any) -> Maneuver:
    """The maneuver with other nodes, and every stored array computed from them."""
    other = maneuver_of(np.asarray(nodes), maneuver.time, tripod())
    return found_clearances(replace(other, tip_target_position=maneuver.tip_target_position))


@pytest.mark.smoke
def test_good_maneuver_passes() -> None:
    certificate = verify(good_maneuver())
    assert certificate.ok, str(certificate)
    assert certificate.failures() == ()
    assert "FAIL" not in str(certificate)
    assert "tip error" in str(certificate)


def test_verify_file(tmp_path: Path) -> None:
    assert verify_file(good_maneuver().save(tmp_path / "r.npz")).ok


@pytest.mark.smoke
@pytest.mark.parametrize("node", [3, 4])
def test_moved_node_is_found(node: int) -> None:
    maneuver = good_maneuver()
    nodes = maneuver.nodes.copy()
    nodes[4, node] += [0.0, 1e-6, 0.0]
    assert {"member_error", "array_error"} <= broken(replace(maneuver, nodes=nodes))
    assert "member_error" in broken(again(maneuver, nodes))


def test_moved_base_node_is_found() -> None:
    maneuver = good_maneuver()
    nodes = maneuver.nodes.copy()
    nodes[:, 0, 0] += 2e-9
    assert "base_error" in broken(again(maneuver, nodes))


def driven(lengths: Any, duration: float = 6.0, **changes: Any) -> Maneuver:
    nodes = np.stack([place(row) for row in lengths])
    return found_clearances(maneuver_of(nodes, np.linspace(0.0, duration, len(nodes)), tripod(), **changes))


@pytest.mark.parametrize(("beyond", "found"), [(0.0, set()), (3e-9, {"stroke_violation"})])
def test_stroke_is_held_to_a_nanometre(beyond: float, found: set[str]) -> None:
    lengths = np.tile(LENGTHS, (21, 1))
    lengths[:, 0] = np.linspace(1.4, 1.8, 21)
    lengths[-1, 0] += beyond
    assert broken(driven(lengths, duration=10.0)) == found


@pytest.mark.smoke
def test_rate_is_held() -> None:
    lengths = np.tile(LENGTHS, (11, 1))
    lengths[:, 5] += 0.1 * np.linspace(0.0, 1.0, 11)
    assert broken(driven(lengths, duration=0.5 + 1e-9)) == set()
    assert broken(driven(lengths, duration=0.5 - 1e-6)) == {"rate_violation"}


def test_acceleration_is_held() -> None:
    lengths = np.tile(LENGTHS, (3, 1))
    lengths[2, 0] += 0.1
    assert broken(driven(lengths, duration=2.0)) == set()
    lengths[2, 0] += 0.11
    assert broken(driven(lengths, duration=2.0)) == {"rate_violation", "acceleration_violation"}


@pytest.mark.parametrize(("lock", "found"), [("leg-1", True), ({"member": "leg-1", "time": 2.0}, True)])
def test_locked_actuator_is_held(lock: Any, found: bool) -> None:
    truss = {"module": "graph", "locked": [lock]}
    assert ("member_error" in broken(good_maneuver(problem={"truss": truss}))) is found


def test_actuator_that_locks_after_the_motion_is_free() -> None:
    truss = {"module": "graph", "locked": [{"member": "leg-1", "time": 6.0}]}
    assert broken(good_maneuver(problem={"truss": truss})) == set()


def test_wrong_tip_is_found() -> None:
    maneuver = good_maneuver()
    targets = maneuver.tip_target_position.copy()
    targets[5] += [2e-6, 0.0, 0.0]
    assert "tip_error" in broken(replace(maneuver, tip_target_position=targets))
    moved = maneuver.tip_position + 1e-8
    assert broken(replace(maneuver, tip_position=moved)) == {"array_error"}


def test_targets_must_lie_on_the_path_and_end_there() -> None:
    nodes, time = swing()
    problem = maneuver_of(nodes, time, tripod()).manifest["problem"]
    maneuver = good_maneuver()
    astray = [{"time": 6.0, "position": [0.3, 0.3, 2.0]}]
    manifest = {**maneuver.manifest, "problem": {**problem, "maneuver": {"waypoint": astray}}}
    certificate = verify(replace(maneuver, manifest=manifest))
    assert not certificate.target_error.ok
    assert any("end of the path" in line for line in certificate.contradictions)


@pytest.mark.smoke
@pytest.mark.parametrize(
    "name", ["member_lengths", "tip_position", "tip_rotation", "clearance", "self_clearance"]
)
def test_changed_array_is_found(name: str) -> None:
    maneuver = good_maneuver(problem={"obstacle": [CUBE]})
    assert broken(maneuver) == set()
    array = getattr(maneuver, name).copy()
    array[-1] += 3e-9
    assert broken(replace(maneuver, **{name: array})) == {"array_error"}


CUBE = {"name": "cube", "shape": "box", "center": [2.0, 0.0, 1.0], "size": 0.4}


@pytest.mark.smoke
@pytest.mark.parametrize(
    "shape",
    [
        {"shape": "box", "size": 0.02, "rotation_vector": [0.3, 0.2, 0.1]},
        {"shape": "sphere", "radius": 0.01},
        {"shape": "cylinder", "radius": 0.01, "height": 0.02, "rotation_vector": [1.0, 0.2, 0.1]},
    ],
)
def test_member_that_passes_through_an_obstacle_between_two_states_is_found(shape: dict[str, Any]) -> None:
    lengths = np.tile(LENGTHS, (2, 1))
    lengths[:, 0] = [1.1, 1.75]
    nodes = np.stack([place(row) for row in lengths])
    halfway = nodes.mean(axis=0)
    center = 0.4 * halfway[1] + 0.6 * halfway[4]
    stone = {"name": "stone", "center": center.tolist(), **shape}
    certificate = verify(driven(lengths, problem={"obstacle": [stone], "clearance": {"safe": 0.15}}))
    failed = {name for name, measure in certificate.measures.items() if not measure.ok}
    assert failed == {"clearance_between"}, str(certificate)
    assert certificate.clearance_between.value == pytest.approx(-RADIUS, abs=2 * RESOLUTION)
    assert certificate.clearance_between.where == "step 1 at 0.5000: mast-1 / stone"


def test_obstacle_that_moves_through_the_arm_between_two_states_is_found() -> None:
    nodes, _ = swing()
    still = nodes[[0, 0]]
    middle = (still[0, 3] + still[0, 4]) / 2
    ball = {"name": "ball", "shape": "sphere", "radius": 0.05, "velocity": [0.0, 2.0, 0.0]}
    ball["center"] = (middle - [0.0, 1.0, 0.0]).tolist()
    maneuver = found_clearances(
        maneuver_of(still, np.array([0.0, 1.0]), tripod(), problem={"obstacle": [ball]})
    )
    certificate = verify(maneuver)
    assert certificate.clearance.ok
    assert not certificate.clearance_between.ok


def test_states_and_records_that_disagree_are_named() -> None:
    maneuver = good_maneuver()
    blocked = {**maneuver.manifest, "status": "blocked"}
    assert any("blocked" in line for line in verify(replace(maneuver, manifest=blocked)).failures())
    short = {**maneuver.manifest, "reached": 0.5}
    assert any("last progress" in line for line in verify(replace(maneuver, manifest=short)).failures())
    renamed = replace(maneuver, member_names=np.array(["a"] * 6))
    assert any("member_names" in line for line in verify(renamed).failures())
    for key, value in (("radius", [0.01] * 6), ("rate", [1.0] * 6)):
        arm = {**maneuver.manifest["arm"], key: value}
        altered = replace(maneuver, manifest={**maneuver.manifest, "arm": arm})
        assert any(key in line for line in verify(altered).failures()), key
    longer = {**maneuver.manifest["arm"], "length": [1.0] * 6}
    altered = replace(maneuver, manifest={**maneuver.manifest, "arm": longer})
    assert any("off its home nodes" in line for line in verify(altered).failures())


def test_malformed_arm_record_is_refused() -> None:
    maneuver = good_maneuver()
    for change in ({"radius": [0.02]}, {"base": [99]}, {"home": [[0.0, 0.0, 0.0]]}, {"tip": {}}):
        arm = {**maneuver.manifest["arm"], **change}
        with pytest.raises(ResultError, match=r"manifest\.arm"):
            verify(replace(maneuver, manifest={**maneuver.manifest, "arm": arm}))


def test_blocked_maneuver_can_be_verified() -> None:
    nodes, time = swing()
    maneuver = found_clearances(maneuver_of(nodes[:6], time[:6], tripod(), status="blocked", reached=0.4))
    assert verify(maneuver).ok
    home = found_clearances(maneuver_of(nodes[:1], time[:1], tripod(), status="infeasible", reached=0.0))
    assert verify(home).ok


def test_pointing_is_held() -> None:
    truss = octahedral(2)
    nodes = np.tile(truss.home, (3, 1, 1))
    rules = {
        "truss": {"module": "octahedral", "bays": 2},
        "end_effector": {"track": ["position", "pointing"]},
    }
    maneuver = found_clearances(maneuver_of(nodes, np.arange(3.0), truss, problem=rules))
    assert any("tip_target_pointing" in line for line in verify(maneuver).failures())
    straight = np.tile([0.0, 0.0, 1.0], (3, 1))
    assert verify(replace(maneuver, tip_target_pointing=straight)).ok
    turned = straight.copy()
    turned[-1, 1] = 3e-6
    certificate = verify(replace(maneuver, tip_target_pointing=turned))
    assert certificate.tip_direction_error.value == pytest.approx(3e-6, rel=1e-6)
    assert not certificate.tip_direction_error.ok


def test_mesh_is_tied_to_its_file(tmp_path: Path) -> None:
    import trimesh

    from vgtm_qp.result.manifest import mesh_record

    file = tmp_path / "part.stl"
    trimesh.creation.box((0.4, 0.4, 0.4)).export(file)
    obstacle = [{"name": "part", "shape": "mesh", "file": "part.stl", "center": [2.0, 0.0, 1.0]}]
    where: dict[str, Any] = {
        "problem": {"obstacle": obstacle},
        "directory": str(tmp_path),
        "meshes": {"part": mesh_record(file, 12)},
    }
    maneuver = good_maneuver(**where)
    assert verify(maneuver).ok
    np.testing.assert_allclose(
        maneuver.clearance, good_maneuver(problem={"obstacle": [CUBE]}).clearance, atol=1e-7
    )
    trimesh.creation.box((0.3, 0.3, 0.3)).export(file)
    assert any("not the file" in line for line in verify(maneuver).failures())
    file.unlink()
    assert any("cannot be read" in line for line in verify(maneuver).failures())


def test_arm_inside_a_closed_mesh_touches_it(tmp_path: Path) -> None:
    import trimesh

    from vgtm_qp.result.manifest import mesh_record

    file = tmp_path / "room.stl"
    trimesh.creation.box((20.0, 20.0, 20.0)).export(file)
    obstacle = [{"name": "room", "shape": "mesh", "file": "room.stl"}]
    maneuver = good_maneuver(
        problem={"obstacle": obstacle}, directory=str(tmp_path), meshes={"room": mesh_record(file, 12)}
    )
    assert verify(maneuver).clearance.value == pytest.approx(-RADIUS)


def test_singular_values_against_finite_differences() -> None:
    truss = tripod()
    maneuver = good_maneuver()
    arm = RecordedArm(maneuver.manifest["arm"], truss.members)
    values = arm.singular_values(place(LENGTHS))
    assert values is not None
    step = 1e-6
    columns = [
        (place(LENGTHS + step * row)[4] - place(LENGTHS - step * row)[4]) / (2 * step) for row in np.eye(6)
    ]
    G = np.array(columns).T[:, truss.actuated]
    assert values[2] == pytest.approx(np.linalg.svd(G, compute_uv=False)[0], rel=1e-7)


def test_sparse_and_dense_singular_values_agree(rng) -> None:
    truss = octahedral(6)
    nodes = truss.home + 0.02 * rng.normal(size=truss.home.shape)
    maneuver = maneuver_of(nodes[None], np.zeros(1), truss, status="blocked", reached=0.0)
    arm = RecordedArm(maneuver.manifest["arm"], truss.members)
    dense = arm.singular_values(nodes)
    assert arm.singular_values(nodes, most_dense=0) == pytest.approx(dense, rel=1e-8)


def offset_joints(rng: np.random.Generator) -> Joints:
    triangle = np.array([[0, 1, 2], [1, 2, 0], [2, 0, 1], [3, 1, 2], [4, 1, 3]])
    return Joints(triangle, 0.03 * rng.normal(size=(6, 2, 3)))


def test_offset_joints_place_ends_and_bound_their_paths(rng) -> None:
    truss = tripod(offset_joints(rng))
    maneuver = maneuver_of(truss.home[None], np.zeros(1), truss, status="blocked", reached=0.0)
    arm = RecordedArm(maneuver.manifest["arm"], truss.members)
    np.testing.assert_allclose(arm.length, truss.home_lengths, atol=1e-14)
    member = np.arange(6)
    for _ in range(10):
        before = truss.home + 0.05 * rng.normal(size=(5, 3))
        after = before + 0.1 * rng.normal(size=(5, 3))
        np.testing.assert_allclose(arm.ends(before), truss.member_ends(before), atol=1e-14)
        motion = RecordedMotion(arm, np.array([0.0, 1.0]), np.stack([before, after]))
        bend = motion.bend[0]
        h = 1e-3
        for share in np.linspace(h, 1.0 - h, 40):
            low, here, high = (
                motion.ends_between(np.zeros(6, dtype=int), member, np.full(6, s))
                for s in (share - h, share, share + h)
            )
            second = np.linalg.norm(low - 2 * here + high, axis=2).max(axis=1) / h**2
            assert (second <= bend * (1 + 1e-6) + 1e-6).all()


def encounters(truss: Any, nodes: Any, obstacles: list[dict[str, Any]]) -> tuple[RecordedMotion, list[Any]]:
    maneuver = maneuver_of(nodes, np.arange(float(len(nodes))), truss, problem={"obstacle": obstacles})
    arm = RecordedArm(maneuver.manifest["arm"], truss.members)
    motion = RecordedMotion(arm, maneuver.time, maneuver.nodes)
    bodies, _, _ = read_obstacles(maneuver.manifest["problem"], {}, Path())
    return motion, [*(AgainstBody(motion, body) for body in bodies), AgainstMembers(motion)]


@pytest.mark.dear
@pytest.mark.parametrize("joints", [False, True])
@pytest.mark.parametrize("_", range(3))
def test_bound_between_states_is_below_every_instant_and_close(
    _: int, joints: bool, rng: np.random.Generator
) -> None:
    truss = tripod(offset_joints(rng) if joints else None)
    nodes = truss.home + rng.normal(scale=0.15, size=(2, 5, 3))
    center = nodes[0, 4] + rng.normal(scale=0.4, size=3)
    turn = rng.normal(size=3).tolist()
    obstacles: list[dict[str, Any]] = [
        {"shape": "box", "size": [0.2, 0.3, 0.1], "rotation_vector": turn, "velocity": [0.1, -0.2, 0.3]},
        {"shape": "sphere", "radius": 0.1, "velocity": [0.0, 0.2, 0.0]},
        {"shape": "cylinder", "radius": 0.1, "height": 0.3, "rotation_vector": turn},
    ]
    placed = [{**obstacle, "name": obstacle["shape"], "center": center.tolist()} for obstacle in obstacles]
    motion, pairs = encounters(truss, nodes, placed)
    for pair in pairs:
        limit, bound = pair.between(Least(pair.at_states()[0].value), Least())
        bound_value = min(bound.value, limit.value)
        sampled = []
        for share in np.linspace(0.0, 1.0, 1001):
            moment = nodes[0] + share * (nodes[1] - nodes[0])
            sampled.append(frozen(pair, moment, share))
        assert bound_value <= min(sampled) + 1e-12
        assert limit.value <= min(sampled) + motion.resolution
        # Where a joint's triangle folds up on the way, its ends have no bound of their bend.
        if np.isfinite(motion.bend).all():
            assert bound_value >= limit.value - motion.resolution - 1e-12
    assert len(motion.ends) == 2


def test_a_long_recording_is_bounded_as_closely_as_a_short_one(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    """The greatest count of intervals is for one step, however many are divided at once."""
    truss = tripod()
    there, back = truss.home + rng.normal(scale=0.05, size=(2, 5, 3))
    bounds = []
    for times, greatest in ((1, 400_000), (300, 400_000), (300, 40)):
        monkeypatch.setattr(sys.modules[RecordedMotion.__module__], "GREATEST_COUNT", greatest)
        motion, pairs = encounters(truss, np.array([there, back] * times), [])
        limit, bound = pairs[-1].between(Least(pairs[-1].at_states()[0].value), Least())
        assert bound.value >= limit.value - motion.resolution
        bounds.append(bound.value)
    assert bounds[1:] == pytest.approx([bounds[0]] * 2, abs=motion.resolution)


def frozen(pair: Any, nodes: Any, share: float) -> float:
    """Clearance of one instant, over all pairs without any culling."""
    ends = pair.motion.arm.ends(nodes)
    if isinstance(pair, AgainstMembers):
        a, b = np.triu_indices(6, 1)
        members = pair.motion.arm.members
        apart = np.array([not set(members[i]) & set(members[j]) for i, j in zip(a, b, strict=True)])
        index = (a[apart], b[apart])
        points = np.concatenate([ends[index[0]], ends[index[1]]], axis=1)
    else:
        index = (np.arange(6), np.zeros(6, dtype=int))
        points = ends - pair.body.at(np.array([share]))
    return float(pair.separation(points, index)[0].min())


def test_culling_changes_nothing(rng) -> None:
    truss = octahedral(4)
    nodes = truss.home + rng.normal(scale=0.05, size=(3, *truss.home.shape))
    boxes = [
        {"name": f"b{k}", "shape": "box", "center": rng.normal(scale=2.0, size=3).tolist(), "size": 0.3}
        for k in range(5)
    ]
    _, pairs = encounters(truss, nodes, boxes)
    count = truss.member_count
    for pair in pairs[:-1]:
        every = (np.arange(count), np.zeros(count, dtype=int))
        for state in range(3):
            points = pair.motion.ends[state] - pair.body.at(np.array([float(state)]))
            assert pair.at_states()[state].value == pytest.approx(
                pair.separation(points, every)[0].min(), abs=1e-14
            )
    members = truss.members
    a, b = np.triu_indices(count, 1)
    apart = ~(members[a][:, :, None] == members[b][:, None, :]).any(axis=(1, 2))
    index = (a[apart], b[apart])
    for state in range(3):
        ends = pairs[-1].motion.ends[state]
        points = np.concatenate([ends[index[0]], ends[index[1]]], axis=1)
        least = pairs[-1].separation(points, index)[0].min()
        assert pairs[-1].at_states()[state].value == pytest.approx(least, abs=1e-14)


def test_self_collision_and_angles_are_held() -> None:
    maneuver = good_maneuver()
    rules = {"safe": 0.05, "self_safe": 5.0, "minimum_angle": 1.0}
    problem = {**maneuver.manifest["problem"], "clearance": rules}
    manifest = {**maneuver.manifest, "problem": problem}
    expected = {"self_clearance", "self_clearance_between", "member_angle"}
    assert broken(replace(maneuver, manifest=manifest)) == expected
    problem["clearance"] = {**rules, "self_collision": False, "minimum_angle": 0.0}
    certificate = verify(replace(maneuver, manifest=manifest))
    assert certificate.ok
    assert certificate.self_clearance.value == pytest.approx(maneuver.self_clearance.min())


def test_moving_base_is_held_to_its_poses() -> None:
    maneuver = good_maneuver()
    shift = np.array([0.3, 0.0, 0.1])
    share = np.linspace(0.0, 1.0, len(maneuver.time))
    nodes = maneuver.nodes + share[:, None, None] * shift
    truss = {"module": "graph", "base_motion": [{"time": 6.0, "position": shift.tolist()}]}
    moved = found_clearances(maneuver_of(nodes, maneuver.time, tripod(), problem={"truss": truss}))
    assert verify(moved).ok, str(verify(moved))
    other = {"module": "graph", "base_motion": [{"time": 6.0, "position": [0.3, 0.0, 0.2]}]}
    assert broken(maneuver_of(nodes, maneuver.time, tripod(), problem={"truss": other})) >= {"base_error"}
    assert "base_error" in broken(found_clearances(maneuver_of(nodes, maneuver.time, tripod())))


def test_shares_no_code_with_the_solver() -> None:
    """Neither its own imports nor what they bring in: no CasADi, no FCL, none of the solver's packages."""
    for file in Path(check.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("vgtm_qp"):
                # Of `arrays` names of types alone.
                own = "verify", "result", "errors", "problem", "arrays"
                allowed = tuple(f"vgtm_qp.{name}" for name in own)
                assert str(node.module).startswith(allowed), f"{file.name}: {node.module}"
    code = """
        import sys, vgtm_qp.verify
        shared = ("casadi", "fcl", "vgtm_qp.geometry", "vgtm_qp.qp", "vgtm_qp.step", "vgtm_qp.arm.truss")
        print([name for name in sys.modules if name.startswith(shared)])
    """
    lines = "\n".join(line.strip() for line in code.strip().splitlines())
    root = Path(check.__file__).parents[2]
    out = subprocess.run([sys.executable, "-c", lines], capture_output=True, text=True, check=True, cwd=root)
    assert out.stdout.strip() == "[]"
