"""Every export is read back by somebody else's reader, and holds what the result holds."""

from __future__ import annotations

import builtins
import csv
import importlib
import json
import re
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from synthetic import maneuver_of, place, tripod

import vgtm_qp as vq
from vgtm_qp.cli import main
from vgtm_qp.cli.results import FormatName
from vgtm_qp.export import FORMATS, export_maneuver
from vgtm_qp.export.mjcf import mjcf, node_masses
from vgtm_qp.export.trajectory import step_rates, through_rates
from vgtm_qp.verify.arm import RecordedArm
from vgtm_qp.view.drawing import drawing_of_maneuver
from vgtm_qp.view.figure import each_picture

MOVING = {
    "name": "drone",
    "shape": "sphere",
    "center": [3.0, 0.0, 2.0],
    "radius": 0.1,
    "velocity": [-0.1, 0.0, 0.0],
}


@pytest.fixture(scope="module")
def maneuver() -> vq.Maneuver:
    """A tripod whose two actuators move at uneven times, beside obstacles of every kind."""
    time = np.array([0.0, 0.4, 1.0, 1.3, 2.0])
    first = 1.4 + 0.1 * np.sin(time)
    last = 0.9 + 0.05 * time
    nodes = np.array([place(np.array([a, 1.4, 1.4, 1.5, 1.5, b])) for a, b in zip(first, last, strict=True)])
    obstacles = [
        {"name": "mast", "shape": "cylinder", "center": [2.0, 0.0, 1.0], "radius": 0.2, "height": 2.0},
        MOVING,
        {
            "name": "crate",
            "shape": "box",
            "center": [0, 2.5, 0.5],
            "size": 0.4,
            "rotation_vector": [0, 0, 0.5],
        },
    ]
    return maneuver_of(nodes, time, tripod(), problem={"obstacle": obstacles})


@pytest.fixture(scope="module")
def arm_between_cubes() -> vq.Maneuver:
    return vq.solve(vq.load_problem("five_bay_two_cubes").replace({"maneuver.steps": 12}))


def test_the_command_line_names_the_formats_that_there_are():
    assert set(FormatName.__args__) == set(FORMATS)


@pytest.mark.smoke
def test_csv_holds_lengths_and_rates_to_the_last_digit(maneuver: vq.Maneuver, tmp_path: Path):
    with export_maneuver(maneuver, tmp_path / "t.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    names = list(maneuver.actuator_names)
    assert header == ["time [s]", *(f"{n} [m]" for n in names), *(f"d {n}/dt [m/s]" for n in names)]
    table = np.array(rows, dtype=float)
    lengths = maneuver.member_lengths[:, maneuver.member_actuated]
    assert np.array_equal(table[:, 0], maneuver.time)
    assert np.array_equal(table[:, 1 : 1 + len(names)], lengths)
    steps = np.diff(maneuver.time)[:, None]
    assert np.allclose(
        lengths[0] + np.cumsum(table[1:, 1 + len(names) :] * steps, axis=0), lengths[1:], atol=1e-15
    )


def test_rates_through_the_states_lie_between_those_of_the_steps(maneuver: vq.Maneuver):
    before, through = step_rates(maneuver), through_rates(maneuver)
    assert not through[[0, -1]].any()
    low, high = np.minimum(before[1:-1], before[2:]), np.maximum(before[1:-1], before[2:])
    assert np.all(through[1:-1] >= low - 1e-12)
    assert np.all(through[1:-1] <= high + 1e-12)


def test_rates_through_the_states_are_exact_for_a_parabola():
    time = np.array([0.0, 0.5, 0.8, 1.5])
    lengths = 0.9 + 0.1 * time + 0.05 * time**2
    nodes = np.array([place(np.array([1.4, 1.4, 1.4, 1.5, 1.5, value])) for value in lengths])
    through = through_rates(maneuver_of(nodes, time, tripod()))
    assert np.allclose(through[1:-1, 1], 0.1 + 0.1 * time[1:-1], atol=1e-12)


@pytest.mark.smoke
def test_a_ros_trajectory_holds_the_lengths(maneuver: vq.Maneuver, tmp_path: Path):
    message = yaml.safe_load(export_maneuver(maneuver, tmp_path / "t.yaml").read_text())
    assert message["joint_names"] == list(maneuver.actuator_names)
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in message["points"]]
    assert np.allclose(times, maneuver.time, atol=1e-9)
    positions = [point["positions"] for point in message["points"]]
    assert np.array_equal(positions, maneuver.member_lengths[:, maneuver.member_actuated])


def test_a_bag_is_read_back_by_rosbags(maneuver: vq.Maneuver, tmp_path: Path):
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    path = export_maneuver(maneuver, tmp_path / "t.mcap")
    states, trajectories = [], []
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, stamp, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/joint_states":
                assert connection.msgtype == "sensor_msgs/msg/JointState"
                assert stamp == message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
                states.append((1e-9 * stamp, message))
            else:
                assert connection.msgtype == "trajectory_msgs/msg/JointTrajectory"
                trajectories.append(message)
    lengths = maneuver.member_lengths[:, maneuver.member_actuated]
    assert np.allclose([stamp for stamp, _ in states], maneuver.time, atol=1e-9)
    assert all(list(message.name) == list(maneuver.actuator_names) for _, message in states)
    assert np.array_equal([message.position for _, message in states], lengths)
    assert np.array_equal([message.velocity for _, message in states], through_rates(maneuver))
    assert len(trajectories) == 1
    assert list(trajectories[0].joint_names) == list(maneuver.actuator_names)
    assert np.array_equal([point.positions for point in trajectories[0].points], lengths)


def test_the_folder_of_a_bag_opens_as_a_ros_2_bag(maneuver: vq.Maneuver, tmp_path: Path, capsys):
    from rosbags.rosbag2 import Reader

    maneuver.save(tmp_path / "t.npz")
    assert main(["export", str(tmp_path / "t.npz"), "--to", "mcap", "--json"]) == 0
    written = json.loads(capsys.readouterr().out)
    assert written["bag"] == str(tmp_path)
    with Reader(tmp_path) as reader:
        counts = {connection.topic: connection.msgcount for connection in reader.connections}
        stamps = [stamp for _, stamp, _ in reader.messages()]
        assert (reader.start_time, reader.end_time) == (stamps[0], stamps[-1] + 1)
        assert reader.message_count == len(stamps)
    assert counts == {"/joint_states": len(maneuver.time), "/joint_trajectory": 1}
    about = yaml.safe_load((tmp_path / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert about["files"][0]["path"] == "t.mcap"
    assert about["storage_identifier"] == "mcap"


@pytest.mark.parametrize(
    "metadata", ["", "rosbag2_bagfile_information: 3", "{", None], ids=["empty", "other", "broken", "a bag's"]
)
def test_the_metadata_of_other_files_is_left_as_it_is(
    maneuver: vq.Maneuver, tmp_path: Path, caplog, metadata
):
    file = tmp_path / "metadata.yaml"
    if metadata is None:
        export_maneuver(maneuver, tmp_path / "first.mcap")
        export_maneuver(maneuver, tmp_path / "first.mcap")
        assert not caplog.messages
    else:
        file.write_text(metadata)
    before = file.read_text()
    export_maneuver(maneuver, tmp_path / "second.mcap")
    assert file.read_text() == before
    assert "second.mcap" in caplog.messages[-1]


def test_mujoco_reads_the_model_and_finds_the_lengths_at_every_keyframe(
    maneuver: vq.Maneuver, tmp_path: Path
):
    import mujoco

    model: Any = mujoco.MjModel.from_xml_path(str(export_maneuver(maneuver, tmp_path / "t.xml")))
    data: Any = mujoco.MjData(model)
    assert [model.tendon(k).name for k in range(model.ntendon)] == [
        str(name) for name in maneuver.member_names
    ]
    assert model.nkey == len(maneuver.time)
    drone = model.body("obstacle drone").mocapid[0]
    for k in range(model.nkey):
        mujoco.mj_resetDataKeyframe(model, data, k)
        mujoco.mj_forward(model, data)
        assert np.allclose(data.ten_length, maneuver.member_lengths[k], atol=1e-12)
        assert np.allclose(data.site_xpos, maneuver.nodes[k], atol=1e-12)
        assert np.allclose(data.ctrl, maneuver.member_lengths[k, maneuver.member_actuated], atol=1e-12)
        center = np.array(MOVING["center"]) + maneuver.time[k] * np.array(MOVING["velocity"])
        assert np.allclose(data.mocap_pos[drone], center, atol=1e-12)


@pytest.mark.parametrize("name", ["five_bay_two_cubes", "station_arm_past_a_module"])
def test_mujoco_opens_with_arm_tip_and_obstacles_in_the_picture(name: str):
    import mujoco

    few = vq.solve(vq.load_problem(name).replace({"maneuver.steps": 10}), verify=False)
    model: Any = mujoco.MjModel.from_xml_string(mjcf(few))
    camera: Any = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    turn, tilt = np.radians([camera.azimuth, camera.elevation])
    ahead = np.array([np.cos(tilt) * np.cos(turn), np.cos(tilt) * np.sin(turn), np.sin(tilt)])
    eye = np.asarray(camera.lookat) - camera.distance * ahead
    seen = [few.nodes.reshape(-1, 3), few.tip_position, *drawing_of_maneuver(few).surfaces()]
    rays = np.concatenate(seen) - eye
    along = rays @ ahead
    aside = np.linalg.norm(rays - along[:, None] * ahead, axis=1)
    # In a picture that is at least as wide as it is high.
    assert np.all(np.arctan2(aside, along) < 0.5 * np.radians(model.vis.global_.fovy))
    assert np.all(along > model.vis.map.znear * model.stat.extent)


def test_mujoco_holds_the_truss_up_by_its_actuators(maneuver: vq.Maneuver):
    import mujoco

    model: Any = mujoco.MjModel.from_xml_string(mjcf(maneuver))
    data: Any = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 2)
    for _ in range(1500):
        mujoco.mj_step(model, data)
    assert np.allclose(data.ten_length, maneuver.member_lengths[2], atol=1e-3)
    assert np.abs(data.qvel).max() < 1e-4


def test_masses_add_up_to_those_of_the_members(maneuver: vq.Maneuver):
    arm = RecordedArm(maneuver.manifest["arm"], maneuver.members)
    assert node_masses(arm).sum() == pytest.approx(arm.length.sum())
    assert node_masses(arm)[4] == pytest.approx(0.5 * arm.length[3:].sum())


def test_offset_joints_have_no_mujoco_model():
    from vgtm_qp.arm.truss.joints import Joints

    joints = Joints(triangle=np.tile([0, 1, 2], (5, 1)), offset=np.zeros((6, 2, 3)))
    nodes = place(np.array([1.4, 1.4, 1.4, 1.5, 1.5, 0.9]))[None]
    with pytest.raises(vq.ExportError, match="pin joints"):
        mjcf(maneuver_of(nodes, np.array([0.0]), tripod(joints)))


def test_a_page_of_two_hundred_frames_stays_small_and_loads_nothing(
    arm_between_cubes: vq.Maneuver, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    path = export_maneuver(arm_between_cubes, tmp_path / "arm.html")
    assert path.stat().st_size <= 2_000_000
    page = path.read_text(encoding="utf-8")
    assert "<title>five-bay arm between two cubes (solved)</title>" in page
    head = page[: page.index("<script")]
    assert not re.search(r"(src|href)=[\"']https?://", head)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(("suffix", "magic"), [(".gif", b"GIF89a"), (".pdf", b"%PDF"), (".png", b"\x89PNG")])
def test_pictures_are_of_their_kind(
    arm_between_cubes: vq.Maneuver, tmp_path: Path, suffix: str, magic: bytes
):
    few = _first_states(arm_between_cubes, 4)
    path = export_maneuver(few, tmp_path / f"arm{suffix}")
    assert path.read_bytes().startswith(magic)


def test_an_animation_is_smooth_and_moves(arm_between_cubes: vq.Maneuver, tmp_path: Path):
    from PIL import Image

    few, shares = _first_states(arm_between_cubes, 4), []
    with Image.open(export_maneuver(few, tmp_path / "arm.gif", progress=shares.append)) as animation:
        assert len(shares) == animation.n_frames
        assert shares == sorted(shares)
        assert shares[-1] == 1.0
        pictures, pauses = [], []
        for k in range(animation.n_frames):
            animation.seek(k)
            pictures.append(np.asarray(animation.convert("RGB")).copy())
            pauses.append(animation.info["duration"] / 1000.0)
    assert max(pauses[:-1]) <= 1.0 / 15.0, "at least fifteen pictures a second"
    assert sum(pauses[:-1]) == pytest.approx(few.time[-1] - few.time[0], abs=0.07)
    assert tuple(pictures[0][0, 0]) == (255, 255, 255)
    assert all((one != other).any() for one, other in pairwise(pictures))


def test_a_video_has_as_many_pictures_as_an_animation(arm_between_cubes: vq.Maneuver, tmp_path: Path):
    import imageio_ffmpeg
    from PIL import Image

    few = _first_states(arm_between_cubes, 3)
    frames, _ = imageio_ffmpeg.count_frames_and_secs(str(export_maneuver(few, tmp_path / "arm.mp4")))
    with Image.open(export_maneuver(few, tmp_path / "arm.gif")) as animation:
        assert frames == animation.n_frames


def test_a_picture_between_two_states_is_between_them(arm_between_cubes: vq.Maneuver):
    at_state, between, next_state = each_picture(arm_between_cubes, np.array([0.2, 0.3, 0.4]), 40)
    assert at_state.shape == between.shape == next_state.shape
    assert (at_state != between).any()
    assert (between != next_state).any()


def test_a_mujoco_that_cannot_be_loaded_is_not_said_to_be_missing(
    maneuver: vq.Maneuver, tmp_path: Path, monkeypatch, capsys
):
    real = builtins.__import__

    def broken(name: str, *rest: Any, **more: Any) -> Any:
        if name == "mujoco":
            raise ImportError("libmujoco.so: cannot open shared object file")
        return real(name, *rest, **more)

    monkeypatch.delitem(sys.modules, "mujoco", raising=False)
    monkeypatch.setattr(builtins, "__import__", broken)
    file = maneuver.save(tmp_path / "t.npz")
    assert main(["replay", str(file)]) == 2
    err = capsys.readouterr().err
    assert "libmujoco.so" in err
    assert "vgtm doctor" in err
    assert "not installed" not in err


def test_a_missing_extra_is_named_with_the_pip_line(
    maneuver: vq.Maneuver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    absent = {"viser", "mcap_ros2", "yaml", "PIL", "imageio_ffmpeg", "mujoco"}
    import_module = builtins.__import__

    def without(name: str, *arguments: Any, **options: Any) -> Any:
        if name.split(".")[0] in absent:
            raise ModuleNotFoundError(name)
        return import_module(name, *arguments, **options)

    still = _first_states(maneuver, 1)
    # Matplotlib, which these import, cannot do without Pillow.
    for form in FORMATS.values():
        importlib.import_module(f"vgtm_qp.export.{form.module}")
    monkeypatch.setattr(builtins, "__import__", without)
    for name, extra in {
        "html": "view",
        "mcap": "export",
        "ros": "export",
        "gif": "export",
        "mp4": "export",
    }.items():
        with pytest.raises(vq.MissingExtraError, match=re.escape(f"pip install 'vgtm-qp[{extra}]'")):
            export_maneuver(still, tmp_path / f"x{FORMATS[name].suffix}")
    from vgtm_qp.export.replay import replay

    with pytest.raises(vq.MissingExtraError, match=re.escape("pip install 'vgtm-qp[mujoco]'")):
        replay(still)


@pytest.mark.smoke
def test_wrong_formats_and_places_are_named(maneuver: vq.Maneuver, tmp_path: Path):
    with pytest.raises(vq.ExportError, match="choices: html, gif"):
        export_maneuver(maneuver, tmp_path / "x.csv", to="cvs")
    with pytest.raises(vq.ExportError, match=r"no format ends in \"\.doc\""):
        export_maneuver(maneuver, tmp_path / "x.doc")
    (tmp_path / "file").write_text("")
    with pytest.raises(vq.ExportError, match="cannot be written"):
        export_maneuver(maneuver, tmp_path / "file" / "x.csv")


def test_an_export_that_fails_leaves_the_old_file(
    maneuver: vq.Maneuver, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def full(maneuver: vq.Maneuver) -> str:
        raise OSError(28, "No space left on device")

    path = export_maneuver(maneuver, tmp_path / "t.csv")
    before = path.read_bytes()
    monkeypatch.setattr("vgtm_qp.export.trajectory.csv_text", full)
    with pytest.raises(vq.ExportError, match="cannot be written: No space left"):
        export_maneuver(maneuver, path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_picture_has_the_suffix_of_its_kind(maneuver: vq.Maneuver, tmp_path: Path):
    with pytest.raises(vq.ExportError, match=r'a gif cannot be "\.jpg"; choices: \.gif'):
        export_maneuver(maneuver, tmp_path / "x.jpg", to="gif")


def test_the_command_exports_beside_the_result(
    maneuver: vq.Maneuver, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    result = maneuver.save(tmp_path / "tripod.npz")
    assert main(["export", str(result), "--to", "csv"]) == 0
    assert (tmp_path / "tripod.csv").is_file()
    assert main(["export", str(result), "--to", "html", "-o", str(tmp_path / "page.htm")]) == 2
    assert "--output" in capsys.readouterr().err
    assert main(["export", str(tmp_path / "none.npz"), "--to", "csv"]) == 2


def _first_states(maneuver: vq.Maneuver, count: int) -> vq.Maneuver:
    rows = len(maneuver.time)
    arrays = {
        name: array[:count]
        if array.shape[:1] == (rows,) and name not in ("members", "member_names")
        else array
        for name, array in maneuver.arrays.items()
    }
    return vq.Maneuver(**arrays, manifest=maneuver.manifest)
