"""MuJoCo as the referee: a result replayed exactly and under gravity, beside what its certificate says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from synthetic import maneuver_of, place, tripod

import vgtm_qp as vq
from vgtm_qp.cli import main
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
