"""Joints that follow others: read from files, within limits, in results, certificates and models of MuJoCo."""

from __future__ import annotations

import copy
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from urdf_texts import ARM, placed

import vgtm_qp as vq
from vgtm_qp.arm.build import make_arm
from vgtm_qp.methods.presets import with_method
from vgtm_qp.problem.urdf import read_urdf
from vgtm_qp.result.chain import RecordedChain


@pytest.fixture(autouse=True)
def _without_a_compiler(monkeypatch):
    monkeypatch.setenv("VGTM_CC", "none")


def problem(**changes):
    """Six pairs of joints, of which two follow others."""
    rules = {
        "yaw-3": {"joint": "pitch-1", "multiplier": -0.5, "offset": 0.05},
        "pitch-5": {"joint": "pitch-1"},
    }
    joints = []
    for k in range(1, 7):
        for kind, axis, apart in (("pitch", [1.0, 0.0, 0.0], 0.4), ("yaw", [0.0, 1.0, 0.0], 0.0)):
            joint = {"name": f"{kind}-{k}", "axis": axis, "position": [0.0, 0.0, apart], "home": 0.1}
            joint |= {"limits": [-1.0, 1.0], "rate": 0.5, "acceleration": 20.0}
            joints.append(joint | ({"mimic": rules[joint["name"]]} if joint["name"] in rules else {}))
    table = {
        "arm": {"joint": joints, "tip": [0.0, 0.0, 0.4]},
        "curve": {"control_vertices": 5},
        "obstacle": [{"name": "ball", "shape": "sphere", "center": [1.2, -0.3, 1.6], "radius": 0.2}],
        "maneuver": {"steps": 12, "waypoint": [{"time": 6.0, "position": [1.2, -1.0, 2.0]}]},
    }
    return vq.Problem.from_dict(table).replace(changes)


@pytest.fixture(scope="module")
def maneuver():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VGTM_CC", "none")
        return vq.solve(problem())


def test_a_file_may_let_joints_follow_others_one_after_another(tmp_path):
    text = ARM.replace(
        '<limit lower="-1"', '<mimic joint="turn" multiplier="0.5" offset="0.1"/><limit lower="-1"'
    ).replace(
        '<limit lower="0.1" upper="0.4"',
        '<mimic joint="lift" multiplier="0.2" offset="0.1"/><limit lower="0.1" upper="0.4"',
    )
    (tmp_path / "arm.urdf").write_text(text)
    found = read_urdf(tmp_path / "arm.urdf", tip_link="tool")
    assert [joint.mimic and joint.mimic[0] for joint in found.joints] == [None, "turn", "turn"]
    np.testing.assert_allclose(found.joints[1].mimic[1:], (0.5, 0.1))
    np.testing.assert_allclose(found.joints[2].mimic[1:], (0.1, 0.12))
    table = {"urdf": str(tmp_path / "arm.urdf"), "tip_link": "tool", "home": [0.3]}
    waypoint = [{"time": 1.0, "position": [0.5, 0.0, 0.5]}]
    arm = make_arm(vq.Problem.from_dict({"arm": table, "maneuver": {"waypoint": waypoint}}))
    np.testing.assert_allclose(arm.home_configuration[:3], [0.3, 0.25, 0.15])
    assert arm.actuated.tolist() == [True, False, False]
    # What each of the three may do, of the one that moves: -inf to inf, -2.2 to 2.8 and -0.2 to 2.8.
    np.testing.assert_allclose(arm.stroke[0], [-0.2, 2.8])
    np.testing.assert_allclose(arm.rate[0], min(1.5, 0.8 / 0.5, 0.2 / 0.1))
    frames = placed(text, {"turn": 0.3, "lift": 0.25, "slide": 0.15})
    np.testing.assert_allclose(arm.end_effector.position(arm.home), frames["tool"][:3, 3], atol=1e-12)


def test_followers_keep_to_what_they_follow(maneuver):
    assert maneuver.status == "solved", maneuver.certificate.failures()
    joints = dict(zip(maneuver.joint_names.tolist(), maneuver.joints.T, strict=True))
    np.testing.assert_allclose(joints["yaw-3"], -0.5 * joints["pitch-1"] + 0.05, atol=1e-12)
    np.testing.assert_allclose(joints["pitch-5"], joints["pitch-1"], atol=1e-12)
    assert np.ptp(joints["pitch-1"]) > 0.01
    assert "yaw-3" not in maneuver.actuator_names


@pytest.mark.parametrize(
    "method", ["pseudoinverse", "pseudoinverse-corrected", "qp-none", "curve-pseudoinverse"]
)
def test_every_method_moves_followers(method):
    found = vq.solve(with_method(problem(), method))
    joints = dict(zip(found.joint_names.tolist(), found.joints.T, strict=True))
    np.testing.assert_allclose(joints["pitch-5"], joints["pitch-1"], atol=1e-9)


def test_a_follower_that_does_not_follow_is_found(maneuver):
    joints = maneuver.joints.copy()
    joints[-1, maneuver.joint_names.tolist().index("yaw-3")] += 1e-5
    assert any(
        "member" in line or "joint" in line for line in vq.verify(replace(maneuver, joints=joints)).failures()
    )
    for change in ({"followers": [], "multipliers": []}, {"multipliers": [-0.5, 0.5]}):
        assert any("follow" in line for line in found_in(maneuver, **change).contradictions)
    for change in (
        {"followers": [[99, 0], [8, 0]]},
        {"followers": [[5.5, 0], [8, 0]]},
        {"multipliers": [1.0]},
    ):
        with pytest.raises(vq.VgtmError, match=r"followers|multipliers"):
            found_in(maneuver, **change)


def test_a_record_cannot_make_a_follower_or_a_locked_joint_free(maneuver):
    """What is actuated is not held to its value."""
    stuck = vq.solve(problem(**{"arm.locked": ["yaw-6", {"joint": "yaw-5", "time": 2.0}]}))
    assert stuck.certificate.ok, stuck.certificate.failures()
    for result, name in ((maneuver, "pitch-5"), (stuck, "yaw-6")):
        k = result.joint_names.tolist().index(name)
        actuated = list(result.manifest["arm"]["actuated"])
        actuated[k] = True
        joints = result.joints.copy()
        joints[1:, k] += 1e-3
        found = vq.verify(replace(changed(result, actuated=actuated), joints=joints))
        assert any(f"drive of joint {name}" in line for line in found.contradictions)


def changed(maneuver, **record):
    """The maneuver with other values in the record of its arm."""
    manifest = copy.deepcopy(maneuver.manifest)
    manifest["arm"] |= record
    return replace(maneuver, manifest=manifest)


def found_in(maneuver, **record):
    return vq.verify(changed(maneuver, **record))


def test_a_follower_of_no_joint_in_a_result_is_named(maneuver):
    manifest = copy.deepcopy(maneuver.manifest)
    manifest["problem"]["arm"]["joint"][5]["mimic"]["joint"] = "nobody"
    found = vq.verify(replace(maneuver, manifest=manifest))
    assert any("nobody" in line for line in found.contradictions)


def test_a_trajectory_need_not_name_followers_and_may_not_contradict_them(maneuver):
    names = maneuver.joint_names.tolist()
    given = {name: maneuver.joints[:, k] for k, name in enumerate(names)}
    own = {name: given[name] for name in maneuver.actuator_names}
    for values in (given, own):
        assert vq.certify(problem(), maneuver.time, values).answer == "certified"
    wrong = {**given, "pitch-5": given["pitch-5"] + 0.01}
    verdict = vq.certify(problem(), maneuver.time, wrong)
    assert verdict.answer == "violated"
    assert {finding.kind for finding in verdict.violations} == {"lock"}
    assert {name for finding in verdict.violations for name in finding.names} == {"pitch-5"}


@pytest.mark.parametrize(
    ("mimic", "said"),
    [
        ({"joint": "yaw-9"}, "yaw-9"),
        ({"joint": "yaw-1", "multiplier": 0.0}, "other than 0"),
        ({"joint": "pitch-5"}, "moves by itself"),
        ({"joint": "yaw-2"}, "moves by itself"),
        ({"joint": "yaw-1", "offset": 3.0}, "limits that hold 3.1"),
        ({"joint": "yaw-1", "ratio": 3.0}, "ratio"),
    ],
)
def test_a_wrong_rule_is_named(mimic, said):
    joints = problem().to_dict()["arm"]["joint"]
    joints[3] = {**joints[3], "mimic": mimic}
    with pytest.raises(vq.ProblemError, match=said):
        problem(**{"arm.joint": joints})


def test_a_follower_cannot_be_locked_by_itself():
    with pytest.raises(vq.ProblemError, match=r"locked.*pitch-1"):
        problem(**{"arm.locked": ["pitch-5"]})
    stuck = vq.solve(problem(**{"arm.locked": ["pitch-1"]}))
    assert np.ptp(stuck.joints[:, stuck.joint_names.tolist().index("pitch-5")]) < 1e-12
    assert stuck.certificate.ok


def test_limits_that_no_value_keeps_are_named():
    joints = problem().to_dict()["arm"]["joint"]
    joints[0] |= {"limits": [0.09, 0.11]}
    joints[5] |= {"limits": [-0.2, -0.0001], "mimic": {"joint": "pitch-1", "multiplier": -1.0, "offset": 0.0}}
    assert vq.Resolver(problem(**{"arm.joint": joints})).setup.arm.stroke[0].tolist() == [0.09, 0.11]


def test_mujoco_couples_them(maneuver, tmp_path):
    from vgtm_qp.export.mjcf import mjcf

    (found,) = ElementTree.fromstring(mjcf(maneuver)).findall(".//equality/joint[@name='yaw-3']")
    assert found.get("joint2") == "pitch-1"
    assert [float(x) for x in found.get("polycoef").split()] == pytest.approx([0.05, -0.5, 0.0, 0.0, 0.0])
    assert found.get("active") == "true"
    pytest.importorskip("mujoco")
    from vgtm_qp.export.replay import replay

    told = replay(maneuver)
    assert told.kinematic.length_error.max() < 1e-9
    assert told.physics.length_error.max() < 0.02


def test_the_record_counts_followers_with_what_they_follow(maneuver):
    chain, arm = RecordedChain(maneuver.manifest["arm"]), make_arm(problem())
    q = maneuver.configurations[3]
    np.testing.assert_allclose(chain.quantities(q[None])[0], arm.measured(q), atol=1e-12)
    np.testing.assert_allclose(chain.joints(chain.quantities(q[None]))[0], q[:-6], atol=1e-12)
    kinematics = arm.kinematics(compiled=False)
    kinematics.evaluate(q)
    response, _ = kinematics.motion().response()
    rows = 3 * np.flatnonzero(arm.free == arm.end_effector.nodes[0])[0] + np.arange(3)
    values = np.linalg.svd(response[rows], compute_uv=False)
    np.testing.assert_allclose(chain.singular_values(q)[1:], (values[-1], values[0]), rtol=1e-9)
