"""Files of trajectories: every fault is one clear message with its place; what others write is read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vgtm_qp as vq
from vgtm_qp.certify.certify import Certifier
from vgtm_qp.certify.trajectory import read_trajectory
from vgtm_qp.cli import main
from vgtm_qp.export.trajectory import JOINT_STATE

PROBLEM = {
    "arm": {
        "joint": [
            {"name": "shoulder", "axis": [0, 0, 1], "home": 0.3},
            {"name": "elbow", "axis": [0, 0, 1], "position": [1, 0, 0]},
            {
                "name": "slide",
                "kind": "prismatic",
                "axis": [1, 0, 0],
                "position": [0.5, 0, 0],
                "limits": [0, 0.5],
            },
            {"name": "t", "axis": [0, 0, 1], "position": [1, 0, 0]},
        ],
        "tip": [0.5, 0, 0],
        "locked": ["t"],
    },
    "maneuver": {"waypoint": [{"time": 1.0, "position": [1.0, 1.0, 0.0]}]},
}


@pytest.fixture(scope="module")
def certifier() -> Certifier:
    return Certifier(vq.Problem.from_dict(PROBLEM))


GOOD = "t,shoulder,elbow,slide\n0,0.1,0.2,0.3\n1,0.2,0.3,0.4\n"

BROKEN: dict[str, tuple[str | bytes, str, str]] = {
    "empty": ("", "line 1", "a header"),
    "blank lines": ("\n\n\n", "line 1", "a header"),
    "header alone": ("t,shoulder,elbow,slide\n", "line 2", "at least one row"),
    "no header": ("0,0.1,0.2,0.3\n", "line 1", "shoulder"),
    "misspelt": ("t,shoulder,elbw,slide\n0,1,2,0\n", "line 1, column 3", 'did you mean "elbow"'),
    "another case": ("T,shoulder,elbow,slide\n0,1,2,0\n", "line 1", "t and the names"),
    "unknown": ("t,shoulder,elbow,slide,wrist\n0,1,2,0,0\n", "line 1, column 5", "t and the names"),
    "another arm's": ("time [s],B1-1 [m],B1-2 [m]\n0,1,1\n", "line 1", "a header with"),
    "a rate of nothing": (
        "t,shoulder,elbow,slide,d wrist/dt [rad/s]\n0,1,2,0,0\n",
        "line 1, column 5",
        "t and the names",
    ),
    "missing": ("t,shoulder,slide\n0,1,0\n", "line 1", "elbow"),
    "no time": ("shoulder,elbow,slide\n1,2,0\n", "line 1", 'no column "t"'),
    "twice": ("t,shoulder,elbow,slide,elbow\n0,1,2,0,2\n", "line 1, column 5", "once"),
    "twice in two spellings": ("t,shoulder,elbow,slide,elbow [rad]\n0,1,2,0,2\n", "line 1, column 5", "once"),
    "nameless column": ("t,shoulder,elbow,slide,\n0,1,2,0,\n", "line 1, column 5", "nothing"),
    "degrees": ("t,shoulder,elbow [deg],slide\n0,1,2,0\n", "line 1, column 3", "elbow"),
    "a slide in radians": ("t,shoulder,elbow,slide [rad]\n0,1,2,0\n", "line 1, column 4", "slide"),
    "semicolons": (GOOD.replace(",", ";"), "line 1", "commas"),
    "tabs": (GOOD.replace(",", "\t"), "line 1", "commas"),
    "decimal commas": ('t,shoulder,elbow,slide\n0,"0,1",0,0\n', "line 2, column shoulder", "a finite number"),
    "cell too few": ("t,shoulder,elbow,slide\n0,0.1,0.2\n", "line 2", "4 cells"),
    "cell too many": ("t,shoulder,elbow,slide\n0,0.1,0.2,0.3,0.4\n", "line 2", "4 cells"),
    "a word": ("t,shoulder,elbow,slide\n0,0.1,half,0.3\n", "line 2, column elbow", '"half"'),
    "an empty cell": ("t,shoulder,elbow,slide\n0,0.1,,0.3\n", "line 2, column elbow", "a finite number"),
    "nan": ("t,shoulder,elbow,slide\n0,nan,0,0.3\n", "line 2, column shoulder", "a finite number"),
    "infinite": ("t,shoulder,elbow,slide\n0,0,-inf,0.3\n", "line 2, column elbow", "a finite number"),
    "too large": ("t,shoulder,elbow,slide\n0,1e300,0,0.3\n", "line 2, column shoulder", "a finite number"),
    "overflows": ("t,shoulder,elbow,slide\n0,1e999,0,0.3\n", "line 2, column shoulder", "a finite number"),
    "underscore": ("t,shoulder,elbow,slide\n0,1_0,0,0.3\n", "line 2, column shoulder", "a finite number"),
    "hexadecimal": ("t,shoulder,elbow,slide\n0,0x10,0,0.3\n", "line 2, column shoulder", "a finite number"),
    "a unit in a cell": (
        "t,shoulder,elbow,slide\n0,0.1 rad,0,0.3\n",
        "line 2, column shoulder",
        "a finite number",
    ),
    "negative time": ("t,shoulder,elbow,slide\n-1,0,0,0\n", "line 2, column t", "0 or more"),
    "time stands still": ("t,shoulder,elbow,slide\n0,0,0,0\n1,0,0,0\n1,0,0,0\n", "line 4, column t", "after"),
    "time goes back": ("t,shoulder,elbow,slide\n2,0,0,0\n1,0,0,0\n", "line 3, column t", "after"),
    "time too short": ("t,shoulder,elbow,slide\n0,0,0,0\n1e-12,0,0,0\n", "line 3, column t", "a step of"),
    "time is no number": ("t,shoulder,elbow,slide\nnow,0,0,0\n", "line 2, column t", '"now"'),
    "not text": (b"t,shoulder\xff,elbow,slide\n", "file", "UTF-8"),
    "UTF-16": (GOOD.encode("utf-16"), "file", "UTF-8"),
    "open quote": ('t,"shoulder,elbow,slide\n0,0,0,0\n', "line 1, column 2", "quotation mark"),
    "a huge cell": ("t,shoulder,elbow,slide\n0,0," + "1" * 200_000 + ",0\n", "file", "comma-separated"),
    "a zero byte": ("t,shoulder,elbow,slide\n0,0\x00,0,0\n", "line 2, column shoulder", "a finite number"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_table_is_one_clear_message(kind: str, certifier: Certifier, tmp_path: Path) -> None:
    content, place, expected = BROKEN[kind]
    file = tmp_path / "way.csv"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(vq.ProblemError) as raised:
        certifier.certify_file(file)
    mistakes = raised.value.mistakes
    assert mistakes[0].key.startswith(place), str(raised.value)
    assert expected in str(mistakes[0]), str(raised.value)
    # What is wrong is said once, and nothing that follows from it.
    assert len(mistakes) == 1, str(raised.value)
    assert str(raised.value).startswith(str(file))


def test_every_wrong_cell_is_named_in_the_order_of_lines(certifier: Certifier, tmp_path: Path) -> None:
    file = tmp_path / "way.csv"
    file.write_text("t,shoulder,elbow,slide\n0,x,0,0\n1,0,0,0\n0.5,0,y,0\n")
    with pytest.raises(vq.ProblemError) as raised:
        certifier.certify_file(file)
    keys = [mistake.key for mistake in raised.value.mistakes]
    assert keys == ["line 2, column shoulder", "line 4, column elbow", "line 4, column t"]


@pytest.mark.parametrize(
    "name", ["none.csv", "none.mcap", "none.yaml", ".", "x" * 5000 + ".csv", "a\x00b.csv"]
)
def test_what_is_no_file_is_said(name: str, certifier: Certifier, tmp_path: Path) -> None:
    with pytest.raises(vq.ProblemError, match="file"):
        certifier.certify_file(tmp_path / name)


def test_columns_are_read_in_any_order_and_in_the_export_s_own_spelling(
    certifier: Certifier, tmp_path: Path
) -> None:
    file = tmp_path / "way.csv"
    file.write_text(
        "\ufeffslide [m], d elbow/dt [rad/s], elbow [rad], time [s], shoulder, t [rad]\n0.3,9,0.2,0.5,0.1,0\n"
    )
    read = read_trajectory(file, certifier.columns)
    assert read.time.tolist() == [0.5]
    filled = read.filled(certifier.arm.home_quantities)
    assert filled.tolist() == [[0.1, 0.2, 0.3, 0.0]]
    file.write_text(GOOD)
    assert read_trajectory(file, certifier.columns).filled(certifier.arm.home_quantities)[1].tolist() == [
        0.2,
        0.3,
        0.4,
        0.0,
    ]


def message(**changes: Any) -> dict[str, Any]:
    point = {"positions": [0.3, 0.1, 0.2], "time_from_start": {"sec": 0, "nanosec": 500_000_000}}
    later = {"positions": [0.4, 0.2, 0.3], "time_from_start": {"sec": 2, "nanosec": 0}}
    return {"joint_names": ["slide", "shoulder", "elbow"], "points": [point, later]} | changes


def test_a_message_is_read_by_name(certifier: Certifier, tmp_path: Path) -> None:
    file = tmp_path / "way.yaml"
    file.write_text(json.dumps(message()))
    read = read_trajectory(file, certifier.columns)
    assert read.time.tolist() == [0.5, 2.0]
    assert read.filled(certifier.arm.home_quantities)[0].tolist() == [0.1, 0.2, 0.3, 0.0]


NO_TIME = [{"positions": [0.3, 0.1, 0.2]}]
WRONG_MESSAGES: dict[str, tuple[str, str, str]] = {
    "no YAML": ("{a: [", "line 1", "YAML"),
    "a number": ("3", "message, joint_names", "a list"),
    "no points": (json.dumps(message(points=[])), "points", "at least one"),
    "names are numbers": (json.dumps(message(joint_names=[1, 2, 3])), "joint_names", "a list of names"),
    "misspelt": (
        json.dumps(message(joint_names=["slide", "shoulder", "elbw"])),
        "joint_names[2]",
        'did you mean "elbow"',
    ),
    "a position too few": (
        json.dumps(message(points=[{"positions": [0.3], "time_from_start": {"sec": 0}}])),
        "points[0], positions",
        "3, one for each",
    ),
    "a position is text": (
        json.dumps(message(points=[{"positions": ["a", 0, 0], "time_from_start": {"sec": 0}}])),
        "points[0], slide",
        "a finite number",
    ),
    "no time": (json.dumps(message(points=NO_TIME)), "points[0], time_from_start", "sec and nanosec"),
    "time stands still": (
        json.dumps(message(points=message()["points"][:1] * 2)),
        "points[1], time",
        "a time after",
    ),
    "an alias that holds itself": ("&a [*a]", "message, joint_names", "a list"),
}


@pytest.mark.parametrize("kind", WRONG_MESSAGES)
def test_a_broken_message_is_one_clear_message(kind: str, certifier: Certifier, tmp_path: Path) -> None:
    text, place, expected = WRONG_MESSAGES[kind]
    file = tmp_path / "way.yaml"
    file.write_text(text)
    with pytest.raises(vq.ProblemError) as raised:
        certifier.certify_file(file)
    (mistake,) = raised.value.mistakes
    assert mistake.key.startswith(place), str(mistake)
    assert expected in str(mistake), str(mistake)


def states(path: Path, topics: list[str], names: list[list[str]]) -> Path:
    """A bag of JointState messages of 10 ms after one another, from a large clock on."""
    from mcap_ros2.writer import Writer

    with path.open("wb") as stream, Writer(stream) as writer:
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        for k, (topic, name) in enumerate(zip(topics, names, strict=True)):
            stamp = {"sec": 1_700_000_000, "nanosec": 10_000_000 * k}
            values = {"position": [0.1 * (j + k) for j in range(len(name))], "velocity": [], "effort": []}
            data = {"header": {"stamp": stamp, "frame_id": ""}, "name": name, **values}
            writer.write_message(topic, schema, data, k, k)
    return path


def test_recorded_states_are_a_trajectory_from_their_first_on(certifier: Certifier, tmp_path: Path) -> None:
    names = ["slide", "shoulder", "elbow"]
    read = read_trajectory(states(tmp_path / "a.mcap", ["/js"] * 3, [names] * 3), certifier.columns)
    np.testing.assert_allclose(read.time, [0.0, 0.01, 0.02], atol=1e-6)
    filled = read.filled(certifier.arm.home_quantities)
    np.testing.assert_allclose(filled[2], [0.3, 0.4, 0.2, 0.0], atol=1e-15)


def test_a_broken_bag_is_one_clear_message(certifier: Certifier, tmp_path: Path) -> None:
    names = ["slide", "shoulder", "elbow"]
    good = states(tmp_path / "good.mcap", ["/js"] * 3, [names] * 3).read_bytes()
    cases = {
        "text": (b"t,shoulder\n", "an MCAP file"),
        "empty": (b"", "an MCAP file"),
        "cut": (good[: len(good) // 2], "an MCAP file"),
    }
    for kind, (content, expected) in cases.items():
        (tmp_path / f"{kind}.mcap").write_bytes(content)
        with pytest.raises(vq.ProblemError, match=expected):
            certifier.certify_file(tmp_path / f"{kind}.mcap")
    for file, expected in (
        (states(tmp_path / "two.mcap", ["/a", "/b"], [names] * 2), "/a, /b"),
        (states(tmp_path / "other.mcap", ["/a", "/a"], [names, names[::-1]]), "as before"),
        (states(tmp_path / "none.mcap", [], []), "a JointTrajectory message"),
        (states(tmp_path / "lacks.mcap", ["/a"], [names[:2]]), "elbow"),
    ):
        with pytest.raises(vq.ProblemError) as raised:
            certifier.certify_file(file)
        assert len(raised.value.mistakes) == 1
        assert expected in str(raised.value)


def test_without_the_reader_of_bags_the_command_says_what_brings_it(
    certifier: Certifier, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "mcap.reader", None)
    monkeypatch.setitem(sys.modules, "yaml", None)
    for name in ("way.mcap", "way.yaml"):
        (tmp_path / name).write_bytes(b"")
        with pytest.raises(vq.MissingExtraError, match="export"):
            certifier.certify_file(tmp_path / name)


@pytest.mark.parametrize(
    ("times", "joints", "place", "expected"),
    [
        ([], [], "times", "at least one"),
        ([[0.0]], [[0.0] * 4], "times", "at least one"),
        (["now"], [[0.0] * 4], "times", "an array of numbers"),
        ([0.0], [0.0] * 4, "joints", "values (1, 4)"),
        ([0.0], [[0.0] * 2], "joints", "values (1, 4)"),
        ([0.0, 1.0], [[0.0] * 4], "joints", "values (2, 4)"),
        ([0.0], [[0.0, np.nan, 0.0, 0.0]], "joints[0, 1]", "a finite number"),
        ([0.0, 0.0], [[0.0] * 4] * 2, "times[1]", "a time after"),
        ([-1.0], [[0.0] * 4], "times[0]", "0 or more"),
        ([0.0], {"shoulder": [0.0], "slide": [0.0]}, "joint_names", "elbow"),
        ([0.0], {"shoulder": [0.0], "slide": [0.0], "elbo": [0.0]}, "joint_names[2]", "elbow"),
        ([0.0], {"shoulder": [0.0], "slide": [0.0], "elbow": [0.0, 1.0]}, 'joints["elbow"]', "1 values"),
        ([0.0], None, "joints", "values (1, 4)"),
    ],
)
def test_wrong_arrays_are_one_clear_message(
    times: Any, joints: Any, place: str, expected: str, certifier: Certifier
) -> None:
    with pytest.raises(vq.ProblemError) as raised:
        certifier.certify(times, joints)
    (mistake,) = raised.value.mistakes
    assert mistake.key == place, str(mistake)
    assert expected in str(mistake), str(mistake)


def test_what_is_no_problem_is_refused() -> None:
    with pytest.raises(vq.ProblemError, match="load_problem"):
        vq.certify("snake_past_a_cube", [0.0], [[0.0]])  # type: ignore[arg-type]


def test_the_command_refuses_a_broken_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "way.csv"
    file.write_text("t,pitch-1\n0,zero\n")
    assert main(["certify", "snake_past_a_cube", str(file), "--json"]) == 2
    output = capsys.readouterr()
    said = json.loads(output.out)
    assert {mistake["file"] for mistake in said["mistakes"]} == {str(file)}
    assert "Traceback" not in output.err
