"""MuJoCo as the referee: a result replayed exactly and under gravity, beside what its certificate says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from synthetic import maneuver_of, place, tripod

import vgtm_qp as vq
from vgtm_qp.arm.build import make_arm
from vgtm_qp.cli import main
from vgtm_qp.export.mjcf import mjcf
from vgtm_qp.export.replay import Replay, replay
from vgtm_qp.maneuver.maneuver import Maneuver


@pytest.fixture(scope="module")
def maneuver() -> Maneuver:
    return vq.solve(vq.load_problem("five_bay_two_cubes"))


@pytest.fixture(scope="module")
def replayed(maneuver: Maneuver) -> Replay:
    return replay(maneuver)


def test_the_kinematic_replay_is_exact(replayed: Replay):
    assert replayed.kinematic.length_error.max() < 1e-9
    assert replayed.kinematic.tip_error.max() < 1e-9
    assert replayed.kinematic.contacts == 0


def test_clearances_of_the_kinematic_replay_are_those_of_the_result(maneuver: Maneuver, replayed: Replay):
    assert np.allclose(replayed.kinematic.clearance, maneuver.clearance, atol=1e-9)


def test_under_gravity_the_arm_follows_and_touches_nothing(replayed: Replay):
    physics = replayed.physics
    assert 1e-9 < physics.length_error.max() < 1e-3
    assert physics.contacts == 0
    assert physics.clearance.min() > 0.075
    predicted = replayed.certified_tip_error_per_millimetre * np.maximum(physics.actuator_error, 1e-6)
    assert physics.tip_error.max() < 2.0 * predicted.max()


def test_the_certificate_predicts_the_sensitivity_within_a_factor_of_two(
    maneuver: Maneuver, replayed: Replay
):
    certificate = maneuver.certificate
    assert certificate is not None
    value = certificate.tip_error_per_millimetre.value
    assert value is not None
    assert replayed.certified_tip_error_per_millimetre == pytest.approx(value, rel=1e-9)
    assert value / 2.0 < replayed.tip_error_per_millimetre < 2.0 * value


def test_a_wrong_result_does_not_pass_for_exact():
    nodes = np.array([place(np.array([1.4, 1.4, 1.4, 1.5, 1.5, length])) for length in (0.9, 0.95)])
    maneuver = maneuver_of(nodes, np.array([0.0, 0.5]), tripod())
    assert replay(maneuver).kinematic.length_error.max() < 1e-12
    moved = nodes.copy()
    moved[1, 4, 0] += 0.01
    wrong = vq.Maneuver(**(maneuver.arrays | {"nodes": moved}), manifest=maneuver.manifest)
    found = replay(wrong)
    assert found.kinematic.tip_error[1] == pytest.approx(0.01, rel=1e-6)
    assert found.kinematic.length_error[1] > 1e-3


def test_a_node_inside_an_obstacle_is_found():
    nodes = place(np.array([1.4, 1.4, 1.4, 1.5, 1.5, 0.9]))[None]
    ball = {"name": "ball", "shape": "sphere", "center": nodes[0, 4].tolist(), "radius": 0.05}
    found = replay(maneuver_of(nodes, np.array([0.0]), tripod(), problem={"obstacle": [ball]}))
    assert found.kinematic.contacts == 1
    assert found.kinematic.clearance[0] < 0.0


def test_the_command_prints_the_table_or_one_document(
    maneuver: Maneuver, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    result = maneuver.save(tmp_path / "arm.npz")
    assert main(["replay", str(result)]) == 0
    printed = capsys.readouterr().out
    for words in ("certificate", "kinematic", "physics", "tip error per mm of actuator error [mm]"):
        assert words in printed
    assert main(["replay", str(result), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["kinematic"]["max_tip_error"] < 1e-9
    assert document["physics"]["contacts"] == 0


MOVING = [{"time": 4.0, "position": [0.1, 0.0, 0.05], "rotation_vector": [0.0, 0.1, 0.05]}]
DRONE = {
    "name": "drone",
    "shape": "sphere",
    "center": [-1.0, 0.5, 1.0],
    "radius": 0.1,
    "velocity": [0.01, 0, 0],
}


@pytest.mark.dear
@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("snake_past_a_cube", {}),
        ("snake_past_a_cube", {"arm.base_motion": MOVING, "obstacle": [DRONE], "arm.locked": ["yaw-4"]}),
        ("station_arm_past_a_module", {}),
    ],
)
def test_a_serial_arm_is_replayed_joint_by_joint(name: str, changes: dict):
    maneuver = vq.solve(vq.load_problem(name).replace({"maneuver.steps": 20, **changes}))
    assert maneuver.arrived
    found = replay(maneuver)
    # MuJoCo's kinematics know nothing of ours.
    assert found.kinematic.length_error.max() < 1e-12
    assert found.kinematic.tip_error.max() < 1e-12 * maneuver.manifest["arm"].get("unit", 20.0)
    assert np.allclose(found.kinematic.clearance, maneuver.clearance, atol=1e-9)
    assert found.kinematic.contacts == found.physics.contacts == 0
    assert 1e-9 < found.physics.length_error.max() < 5e-3
    expected = found.certified_tip_error_per_millimetre
    assert expected / 1.2 < found.tip_error_per_millimetre < 1.2 * expected
    assert "joint error [mrad or mm]" in found.rows()[0][0]


def test_a_link_inside_an_obstacle_is_found_and_one_that_stretches_has_no_model():
    joints = [
        {"name": "turn", "axis": [1, 0, 0], "home": 0.3, "rate": 1.0, "limits": [-2, 2]},
        {"name": "swing", "axis": [0, 1, 0], "position": [0, 0, 0.5], "home": 0.2, "limits": [-2, 2]},
        {
            "name": "slide",
            "kind": "prismatic",
            "axis": [0, 0, 1],
            "position": [0, 0, 0.5],
            "limits": [-0.2, 0.2],
        },
    ]
    body = [{"name": "rod", "joint": "slide", "points": [[0, 0, 0], [0, 0, 0.4]], "radius": 0.05}]
    ball = {"name": "ball", "shape": "sphere", "center": [0.1, -0.4, 1.2], "radius": 0.3}
    table = {
        "arm": {"joint": joints, "tip": [0, 0, 0.4], "body": body},
        "maneuver": {"steps": 2, "waypoint": [{"time": 5.0, "position": [0.2, -0.4, 1.25]}]},
        "method": {"name": "pseudoinverse"},
    }
    clear = vq.solve(vq.Problem.from_dict(table))
    problem = {**clear.manifest["problem"], "obstacle": [ball]}
    through = vq.Maneuver(**clear.arrays, manifest={**clear.manifest, "problem": problem})
    found = replay(through)
    assert found.kinematic.tip_error.max() < 1e-12
    assert found.kinematic.contacts == len(through.time)
    assert found.kinematic.clearance.max() < 0.0
    del table["arm"]["body"]
    with pytest.raises(vq.ExportError, match="link slide stretches"):
        replay(vq.solve(vq.Problem.from_dict(table)))


def test_joints_weigh_in_mujoco_what_they_weigh_here():
    """Against the forces by which MuJoCo balances an arm at rest under gravity."""
    mujoco = pytest.importorskip("mujoco")
    problem = vq.load_problem("twelve_joints_past_a_crate")
    table = problem.to_dict()["arm"]["joint"]
    for k, joint in enumerate(table):
        joint |= {"mass": 1.0 + k % 3, "center_of_mass": [0.05, -0.02 * k, 0.1]}
    problem = problem.replace({"arm.joint": table, "maneuver.steps": 2})
    maneuver, arm = vq.solve(problem), make_arm(problem)
    model = mujoco.MjModel.from_xml_string(mjcf(maneuver))
    data = mujoco.MjData(model)
    assert sum(model.body(name).mass[0] for name in arm.quantity_names) == pytest.approx(arm.mass, abs=1e-12)
    for q in maneuver.configurations[[0, -1]]:
        data.qpos[:] = q[:-6]
        mujoco.mj_forward(model, data)
        borne = arm.forces(q, np.zeros(3), gravity=np.array([0.0, 0.0, -9.81]))
        np.testing.assert_allclose(-data.qfrc_bias, borne, atol=1e-9)
