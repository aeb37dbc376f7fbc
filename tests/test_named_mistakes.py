"""What is wrong is said with file and key, by ``check`` as by ``solve``, and altered results end with 4 everywhere."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mutations import AMONG, CORNERS, FACES, SCENE, document
from problem_texts import GRAPH

import vgtm_qp as vq
from vgtm_qp.cli import main
from vgtm_qp.result.file import content_digest

LOOSE = GRAPH.replace(
    "position = [0, 0, 1] },\n", 'position = [0, 0, 1] },\n  { name = "e", position = [0, 0, 2] },\n'
)
POINTING = (
    '[end_effector]\ntrack = ["pointing"]\n[[maneuver.waypoint]]\ntime = 1.0\npointing = [0.1, 0.0, 1.0]\n'
)
CURVE_FIRST = '[method]\nname = "curve-pseudoinverse"\n'


def octahedral(maneuver: str = "", truss: str = "", rest: str = "") -> str:
    path = "[[maneuver.waypoint]]\ntime = 1.0\nposition = [0.05, 0.0, 1.6]\n"
    text = f'schema_version = 1\n[truss]\nmodule = "octahedral"\nbays = 2\n{truss}\n[curve]\ncontrol_vertices = 4\n'
    return f"{text}{maneuver or path}{rest}"


MISTAKES = {
    "a node that nothing holds": (LOOSE, "truss", "no chain of members joins node(s) e"),
    "an actuator without a stroke": (GRAPH.replace(", stroke = [0.5, 1.5]", ""), "truss", "ad has no stroke"),
    "a direction of one node": (
        GRAPH.split("[[maneuver")[0] + POINTING,
        "end_effector.track",
        "three or more nodes",
    ),
    "a curve along one face": (
        GRAPH.replace('tip = ["d"]', 'tip = ["d"]\nfaces = [["a", "b", "d"]]')
        + '[method]\ntracking = "recursive"\n',
        "method.tracking",
        "has fewer than two",
    ),
    "bays that cannot follow": (
        octahedral(truss='locked = ["B1-1"]', rest='[method]\ntracking = "recursive"\n'),
        "method.tracking",
        "motions too few",
    ),
    "a tip that turns on too few bays": (
        octahedral(POINTING, rest=CURVE_FIRST),
        "method.name",
        "takes 3 bays",
    ),
    "a base that the method cannot move": (
        octahedral(truss="base_motion = [{ time = 1.0, position = [0, 0, 1] }]", rest=CURVE_FIRST),
        "truss.base_motion",
        "a base at rest",
    ),
    "steps of years": (
        octahedral("[maneuver]\nsteps = 3\nwaypoint = [{ time = 1e9, position = [0.05, 0.0, 1.6] }]\n"),
        "maneuver.waypoint[0].time",
        "these 3 take 3.33333e+08 s each",
    ),
    "steps of nanoseconds": (
        octahedral('[maneuver]\npath = "short.csv"\n'),
        'maneuver.path "short.csv", line 3, column t',
        "a step of 1e-07 to 5e+07 s",
    ),
    "an approach of nanoseconds": (
        octahedral('[maneuver]\npath = "path.csv"\napproach_time = 1e-6\napproach_steps = 100\n'),
        "maneuver.approach_time",
        "these 100 take 1e-08 s each",
    ),
    "triangles that are not wound alike": (
        AMONG.format(suffix=".off"),
        'obstacle[0] ("part").file',
        "not wound alike",
    ),
    "a mesh without end": (AMONG.format(suffix="2.off"), 'obstacle[0] ("part").file', "beyond 1e+06"),
}


@pytest.mark.parametrize("command", ["check", "solve"])
@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_has_file_and_key(
    name: str, command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, key, words = MISTAKES[name]
    faces = np.array(FACES)
    faces[0] = faces[0, ::-1]
    for suffix, corners in (("", CORNERS), ("2", 1e7 * CORNERS)):
        points = "\n".join(f"{x} {y} {z}" for x, y, z in corners)
        sides = "\n".join(f"3 {a} {b} {c}" for a, b, c in (FACES if suffix else faces))
        (tmp_path / f"part{suffix}.off").write_text(f"OFF\n8 12 0\n{points}\n{sides}\n")
    (tmp_path / "path.csv").write_text("t,x,y,z\n0,0,0,1.6\n1,0,0.05,1.6\n")
    (tmp_path / "short.csv").write_text("t,x,y,z\n0,0,0,1.6\n1e-9,0,0.05,1.6\n")
    file = tmp_path / "wrong.toml"
    file.write_text(text)
    assert main([command, str(file), "--json"]) == 2
    out, err = capsys.readouterr()
    (mistake,) = json.loads(out)["mistakes"]
    assert (mistake["file"], mistake["key"]) == (str(file), key)
    assert words in mistake["value"] + "; expected " + mistake["expected"]
    assert "Traceback" not in err


def mistakes_of(data: dict[str, Any]) -> list[str]:
    with pytest.raises(vq.ProblemError) as raised:
        vq.Problem.from_dict(data)
    return [mistake.key for mistake in raised.value.mistakes]


def test_what_this_version_does_not_have_is_refused_before_keys_are_questioned() -> None:
    base = {
        "truss": {"module": "octahedral", "bays": 2},
        "maneuver": {"waypoint": [{"time": 1.0, "wrong": 1}]},
    }
    assert mistakes_of({**base, "loads": {"gravity": 1}, "curve": {"wrong": 1}}) == [
        "loads",
        "curve.wrong",
        "maneuver.waypoint[0].wrong",
    ]
    assert mistakes_of({**base, "truss": {"module": "plate", "wrong": 1}})[0] == "truss.module"
    joint = {"joint": [{"name": "a", "axis": [0, 0, 1], "wrong": 1}]}
    keys = mistakes_of({"arm": joint, "maneuver": {"kind": "goal", "wrong": 1}})
    assert keys == ["maneuver.kind", 'arm.joint[0] ("a").wrong']
    assert "method.wrong" not in mistakes_of({**base, "method": {"name": "planner", "wrong": 1}})


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("result")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VGTM_CC", "none")
        (folder / "scene.toml").write_text(SCENE)
        assert main(["solve", str(folder / "scene.toml"), "-o", str(folder / "scene.npz")]) == 0
    return folder / "scene.npz"


COMMANDS = [
    ("verify",),
    ("export", "--to", "html", "-o", "x.html"),
    ("export", "--to", "mjcf", "-o", "x.xml"),
    ("export", "--to", "png", "-o", "x.png"),
    ("replay",),
    ("view", "--port", "0"),
]
EDITS = {
    "an array is gone": (lambda content, manifest: content.pop("clearance"), "array clearance is missing"),
    "a key is gone": (lambda content, manifest: manifest.pop("arm"), "the manifest lacks arm"),
    "a wrong kind": (
        lambda content, manifest: manifest["problem"].update(clearance=3),
        "manifest.problem.clearance",
    ),
    "more nodes": (
        lambda content, manifest: content.update(nodes=np.pad(content["nodes"], ((0, 0), (0, 1), (0, 0)))),
        "array nodes holds 10 nodes; manifest.arm describes 9",
    ),
    "too great": (
        lambda content, manifest: content.update(tip_position=1e300 * content["tip_position"]),
        "array tip_position holds a number beyond 1e+12, row 0",
    ),
}


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: " ".join(command[:3]))
@pytest.mark.parametrize("edit", EDITS)
def test_an_edited_result_ends_with_4_and_the_key(
    edit: str,
    command: tuple[str, ...],
    result: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("viser")
    monkeypatch.chdir(tmp_path)
    with np.load(result) as file:
        content = dict(file)
    manifest = json.loads(str(content.pop("manifest")))
    EDITS[edit][0](content, manifest)
    unsigned = {key: value for key, value in manifest.items() if key != "digest"}
    signed = {**unsigned, "digest": content_digest(content, unsigned)}
    np.savez("edited.npz", **content, manifest=np.array(json.dumps(signed)))
    assert main([command[0], "edited.npz", *command[1:]]) == 4
    said = capsys.readouterr().err
    assert EDITS[edit][1] in said
    assert said.count("edited.npz") == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["edited.npz"]


def test_the_inline_form_of_a_problem_is_the_same_problem() -> None:
    import tomllib

    data = tomllib.loads(SCENE)
    assert vq.Problem.from_dict(tomllib.loads(document(data))) == vq.Problem.from_dict(data)
