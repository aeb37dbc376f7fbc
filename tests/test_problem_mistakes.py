"""Every wrong problem file is answered by one message per mistake: file, key path, value, expectation."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest
from problem_texts import ARM, GRAPH, VALID

import vgtm_qp as vq
from vgtm_qp.errors import ProblemError, VgtmError
from vgtm_qp.problem import Problem, load_problem
from vgtm_qp.problem.obstacle import Box

# What is replaced in the file, by what, and the key, value and part of the expectation of its one mistake.
WRONG = [
    ("bays = 5", "bays = 0", "truss.bays", "0", "an integer from 1 to 10000"),
    ("bays = 5", "bays = 5.0", "truss.bays", "5.0", "an integer"),
    ("bays = 5", "bays = true", "truss.bays", "true", "an integer"),
    ("bays = 5", "bays = 1000000000", "truss.bays", "1000000000", "10000"),
    ("bays = 5", "bays = 0x" + "f" * 6000, "truss.bays", "an integer of thousands of digits", "10000"),
    ("bays = 5", "", "truss.bays", "nothing", "number of bays"),
    ("bays = 5", "bayz = 5\nbays = 5", "truss.bayz", "5", 'did you mean "bays"?'),
    ("bays = 5", "byas = 5", "truss.byas", "5", 'did you mean "bays"?'),
    ("time = 10.0", "tmie = 10.0", "maneuver.waypoint[0].tmie", "10.0", 'did you mean "time"?'),
    ("[0.6, 1.5]", '["0.6", 1.5]', "truss.stroke[0]", '"0.6"', "a length in metres greater than 0"),
    ("[0.6, 1.5]", "[-0.6, 1.5]", "truss.stroke[0]", "-0.6", "a length in metres greater than 0"),
    ("[0.6, 1.5]", "[0.6, true]", "truss.stroke[1]", "true", "a length in metres"),
    ("[0.6, 1.5]", "[0.6, nan]", "truss.stroke[1]", "nan", "a length in metres"),
    ("[0.6, 1.5]", "[1.5, 0.6]", "truss.stroke", "[1.5, 0.6]", "the least length first"),
    ("[0.6, 1.5]", "[0.6]", "truss.stroke", "[0.6]", "two lengths [least, greatest]"),
    ("[0.6, 1.5]", "[1.1, 1.5]", "truss.stroke", "[1.1, 1.5]", "holds the home length, 1 m (batten)"),
    ("bays = 5", "bays = 5\nrate = -1", "truss.rate", "-1", "greater than 0"),
    ("bays = 5", "bays = 5\nlongeron = inf", "truss.longeron", "inf", "a length in metres"),
    ("bays = 5", "bays = 5\nmember_radius = -0.1", "truss.member_radius", "-0.1", "0 or more"),
    ("bays = 5", "bays = 5\njoint_offset = 0.5", "truss.joint_offset", "0.5", "less than half the shortest"),
    ("bays = 5", "bays = 5\nlocked = [3]", "truss.locked[0]", "3", "the name of an actuated member"),
    ("bays = 5", 'bays = 5\nlocked = ["B1-1", "B1-1"]', "truss.locked[1].member", '"B1-1"', "no other entry"),
    (
        "bays = 5",
        'bays = 5\nlocked = [{ member = "B1-1", time = -1 }]',
        "truss.locked[0].time",
        "-1",
        "0 or more",
    ),
    (
        "bays = 5",
        "bays = 5\nbase_motion = [{ time = 0 }]",
        "truss.base_motion[0].time",
        "0",
        "greater than 0",
    ),
    ('"octahedral"', '"octahedrl"', "truss.module", '"octahedrl"', 'did you mean "octahedral"?'),
    ('"octahedral"', "7", "truss.module", "7", '"tetrahedral", "graph"'),
    ('"octahedral"', '"plate"', "truss.module", '"plate"', "that one is reserved for a later version"),
    ("[curve]", "[surface]\n[curve]", "surface", "an empty table", "a reference [curve]"),
    ("[curve]", "[loads]\npayload = 3.0\n[curve]", "loads", "a table of payload", "knows no forces"),
    *(
        (
            "steps = 50",
            f'kind = "{kind}"\nsteps = 50',
            "maneuver.kind",
            f'"{kind}"',
            "that one is reserved for a later version",
        )
        for kind in ("goal", "deployment", "follow-the-leader", "shape")
    ),
    ('"octahedral"', '["graph"]', "truss.module", '["graph"]', "one of"),
    ('module = "octahedral"', "", "truss.module", "nothing", "one of"),
    (
        '"octahedral"',
        '"octahedral"\nactuated = [1]',
        "truss.actuated",
        "[1]",
        "the keys of a truss of this module",
    ),
    (
        "control_vertices = 6",
        "control_vertices = 2",
        "curve.control_vertices",
        "2",
        "an integer from 3 to 60",
    ),
    ("control_vertices = 6", "degree = 3", "curve.degree", "3", "the keys of a Bezier curve: "),
    (
        '"bezier"',
        '"b-spline"\ndegree = 6',
        "curve.degree",
        "6",
        "less than the number of control vertices, 6",
    ),
    ('"bezier"', '"bezir"', "curve.family", '"bezir"', 'did you mean "bezier"?'),
    (
        "control_vertices = 6",
        "control_vertex_goals = [{ index = 6, position = [0, 0, 0] }]",
        "curve.control_vertex_goals[0].index",
        "6",
        "0 to 5",
    ),
    ('["position"]', '["positon"]', "end_effector.track[0]", '"positon"', 'did you mean "position"?'),
    ('["position"]', '["position", "x"]', "end_effector.track[1]", '"x"', "not both"),
    ('["position"]', '["position", "position"]', "end_effector.track[1]", '"position"', "once"),
    ('["position"]', '"position"', "end_effector.track", '"position"', "an array"),
    ('["position"]', "[]", "end_effector.track", "[]", "at least 1"),
    ('["position"]', '["position", "pointing"]', "maneuver.waypoint[0].pointing", "nothing", "a direction"),
    ("steps = 50", "steps = 0", "maneuver.steps", "0", "an integer from 1"),
    ("steps = 50", 'kind = "deploy"', "maneuver.kind", '"deploy"', '"path"'),
    ("time = 10.0", "time = 0.0", "maneuver.waypoint[0].time", "0.0", "greater than 0"),
    ("time = 10.0", "", "maneuver.waypoint[0].time", "nothing", "the key is required"),
    ("time = 10.0", "time = 2020-01-01", "maneuver.waypoint[0].time", "2020-01-01", "a time in seconds"),
    ("[1.6, 0.0, 3.3]", "[1.6, 0.0]", "maneuver.waypoint[0].position", "[1.6, 0.0]", "three numbers"),
    ("[1.6, 0.0, 3.3]", "[1.6, nan, 3.3]", "maneuver.waypoint[0].position[1]", "nan", "a finite number"),
    (
        "[1.6, 0.0, 3.3]",
        "[1, 0, 3]\npointing = [0, 0, 1]",
        "maneuver.waypoint[0].pointing",
        "[0.0, 0.0, 1.0]",
        'lacks "pointing"',
    ),
    (
        "[1.6, 0.0, 3.3]",
        "[1, 0, 3]\n[[maneuver.waypoint]]\ntime = 10\nposition = [1, 0, 3]",
        "maneuver.waypoint[1].time",
        "10.0",
        "after that of the entry before, 10 s",
    ),
    (
        "[[maneuver.waypoint]]",
        "[maneuver.waypoint]",
        "maneuver.waypoint",
        "a table of time, position",
        "[[...]]",
    ),
    ("size = 0.9\n[clear", "size = -1\n[clear", 'obstacle[1] ("right cube").size', "-1", "greater than 0"),
    (
        "size = 0.9\n[clear",
        "size = [1, 0, 1]\n[clear",
        'obstacle[1] ("right cube").size[1]',
        "0",
        "greater than 0",
    ),
    (
        "size = 0.9\n[clear",
        "size = [1, 1]\n[clear",
        'obstacle[1] ("right cube").size',
        "[1, 1]",
        "[sx, sy, sz]",
    ),
    ("size = 0.9\n[clear", "[clear", 'obstacle[1] ("right cube").size', "nothing", "edge length"),
    (
        "size = 0.9\n[clear",
        "size = 0.9\nradius = 1\n[clear",
        'obstacle[1] ("right cube").radius',
        "1",
        "one of the keys of a box: name, center, rotation_vector, velocity, shape, size",
    ),
    ('"right cube"', '"left cube"', 'obstacle[1] ("left cube").name', '"left cube"', "no other entry"),
    ('"right cube"', '""', 'obstacle[1] ("").name', '""', "a name"),
    (
        '"right cube"\nshape = "box"',
        '"c"\nshape = "bx"',
        'obstacle[1] ("c").shape',
        '"bx"',
        'did you mean "box"?',
    ),
    (
        '"right cube"\nshape = "box"',
        '"c"\nshape = "boks"',
        'obstacle[1] ("c").shape',
        '"boks"',
        'did you mean "box"?',
    ),
    ("safe = 0.08", "safe = -0.08", "clearance.safe", "-0.08", "a distance in metres, 0 or more"),
    ("safe = 0.08", "safe = 0.5", "clearance.influence", "0.5", "greater than safe, 0.5 m"),
    ("safe = 0.08", "self_collision = 1", "clearance.self_collision", "1", "true or false"),
    ("safe = 0.08", "minimum_angle = 2", "clearance.minimum_angle", "2", "an angle in radians"),
    ('name = "qp"', 'name = "quadratic"', "method.name", '"quadratic"', '"qp", "pseudoinverse"'),
    ('name = "qp"', 'tracking = "paralel"', "method.tracking", '"paralel"', 'did you mean "parallel"?'),
    (
        'name = "qp"',
        'tracking = "none"\ntracking_mode = "hard"',
        "method.tracking_mode",
        '"hard"',
        '"exact", since',
    ),
    (
        "actuator_rate = 0.5",
        "actuator_rate = -1",
        "method.weights.actuator_rate",
        "-1",
        "a weight, 0 or more",
    ),
    (
        "actuator_rate = 0.5",
        "actuator_rat = 1",
        "method.weights.actuator_rat",
        "1",
        'did you mean "actuator_rate"?',
    ),
    ("[clearance]", "[clearence]", "clearence", "a table of safe", 'did you mean "clearance"?'),
    ("[curve]", "[arm]\nurdf = 3\n[curve]", "arm.urdf", "3", "the path of a file"),
    ("schema_version = 1", "schema_version = 2", "schema_version", "2", "1, the version"),
    ("schema_version = 1", "schema_version = true", "schema_version", "true", "1, the version"),
    ("schema_version = 1", "", "schema_version", "nothing", "1, the version"),
]

WRONG_GRAPH = [
    (
        'nodes = ["b", "d"]',
        'nodes = ["bb", "d"]',
        'truss.member[1] ("bd").nodes[0]',
        '"bb"',
        'did you mean "b"?',
    ),
    (
        'nodes = ["b", "d"]',
        'nodes = ["d", "d"]',
        'truss.member[1] ("bd").nodes',
        '["d", "d"]',
        "two different nodes",
    ),
    (
        'nodes = ["b", "d"]',
        'nodes = ["d"]',
        'truss.member[1] ("bd").nodes',
        '["d"]',
        "the names of two nodes",
    ),
    (
        'nodes = ["b", "d"]',
        'nodes = ["d", "a"]',
        'truss.member[1] ("bd").nodes',
        '["d", "a"]',
        '"ad" joins these',
    ),
    ('name = "bd"', 'name = "ad"', 'truss.member[1] ("ad").name', '"ad"', "no other entry"),
    (
        "node = [",
        'node = [ { name = "d", position = [5, 5, 5] },',
        'truss.node[4] ("d").name',
        '"d"',
        "no other",
    ),
    ('["d"]\n', '["e"]\n', "truss.tip[0]", '"e"', 'one of "a", "b", "c", "d"'),
    ('["d"]\n', '["d", "d"]\n', "truss.tip", '["d", "d"]', "each node once"),
    ('["d"]\n', '["d"]\nfaces = [["a", "b", "b"]]\n', "truss.faces[0]", '["a", "b", "b"]', "three different"),
    ('["d"]\n', '["d"]\nlocked = ["bd"]\n', "truss.locked[0].member", '"bd"', "an actuated member"),
    ("[0.5, 1.5]", "[1.2, 1.5]", 'truss.member[0] ("ad").stroke', "[1.2, 1.5]", "the home length, 1 m"),
    ("actuated = true, ", "", 'truss.member[0] ("ad").stroke', "[0.5, 1.5]", "not actuated"),
    ("[0, 0, 1] }", "[0, 0, 1], fixed = true }", "truss.node", "an array of 4 arrays or tables", "not fixed"),
    ("[0, 0, 1] }", "[0, 0, 0] }", 'truss.member[0] ("ad").nodes', '["a", "d"]', "further apart"),
    (
        'nodes = ["b", "d"]',
        'nodes = ["b", "d"], offsets = [[0, 0, 0.1], [0, 0, 0]]',
        'truss.member[1] ("bd").offsets',
        "an array of 2 arrays or tables",
        'a joint at node "b"',
    ),
]

WRONG_ARM = [
    ("[0, 0, 1]\n", "[0, 0, 0]\n", 'arm.joint[0] ("base").axis', "[0, 0, 0]", "not all zero"),
    ("[-1.0, 1.0]", "[1.0, -1.0]", 'arm.joint[0] ("base").limits', "[1.0, -1.0]", "the least value first"),
    ("[-1.0, 1.0]", "[-1.0, 1.0]\nhome = 2", 'arm.joint[0] ("base").home', "2.0", "-1 to 1"),
    (
        "[[arm.joint]]",
        '[arm]\nlocked = ["bas"]\n[[arm.joint]]',
        "arm.locked[0].joint",
        '"bas"',
        'mean "base"?',
    ),
    (
        "[[arm.joint]]",
        '[truss]\nmodule = "hexapod"\nbays = 2\n[[arm.joint]]',
        "arm",
        "a table of",
        "not both",
    ),
]


def cases() -> list[tuple[str, str, str, str, str, str]]:
    tables = [(VALID, WRONG), (GRAPH, WRONG_GRAPH), (ARM, WRONG_ARM)]
    return [(text, *case) for text, table in tables for case in table]


@pytest.mark.parametrize("text", [VALID, GRAPH, ARM])
def test_the_files_that_are_made_wrong_are_right(tmp_path: Path, text: str) -> None:
    (tmp_path / "p.toml").write_text(text)
    assert load_problem(tmp_path / "p.toml").schema_version == 1


@pytest.mark.parametrize(("text", "old", "new", "key", "value", "expected"), cases())
def test_each_mistake_has_place_value_and_expectation(
    tmp_path: Path, text: str, old: str, new: str, key: str, value: str, expected: str
) -> None:
    assert text.count(old) >= 1
    file = tmp_path / "wrong.toml"
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(ProblemError) as raised:
        load_problem(file)
    (mistake,) = raised.value.mistakes
    assert mistake.key == key
    assert mistake.value.startswith(value)
    assert expected in mistake.expected
    message = str(raised.value)
    assert message.startswith(f"{file}: {key}: found {value}")
    assert "pydantic" not in message.lower()
    assert "http" not in message
    assert "Input" not in message
    assert "<" not in message


@pytest.mark.smoke
def test_all_mistakes_of_a_file_come_at_once(tmp_path: Path) -> None:
    file = tmp_path / "wrong.toml"
    text = VALID.replace("bays = 5", "bays = 0").replace("size = 0.9", "size = 0").replace("safe", "saef")
    file.write_text(text)
    with pytest.raises(ProblemError) as raised:
        load_problem(file)
    assert [mistake.key for mistake in raised.value.mistakes] == [
        "truss.bays",
        'obstacle[0] ("left cube").size',
        'obstacle[1] ("right cube").size',
        "clearance.saef",
    ]
    assert len(str(raised.value).splitlines()) == 4


@pytest.mark.parametrize(
    ("content", "key", "expected"),
    [
        (b"", "file", "schema_version = 1"),
        (b"# nothing but a comment\n", "file", "schema_version = 1"),
        (b"schema_version = 1\nname = \n", "line 2, column 8", "valid TOML"),
        (b"schema_version = 1\nschema_version = 1\n", "line 2, column 19", "valid TOML"),
        (b'name = "caf\xe9"\n', "line 1", "text in UTF-8"),
        (b"a = " + b"[" * 20000 + b"]" * 20000, "file", "tables as in"),
        (b"a = " + b"9" * 6000, "file", "valid TOML"),
        (b"[truss", "file", "valid TOML"),
    ],
)
def test_files_that_are_no_problem_at_all(tmp_path: Path, content: bytes, key: str, expected: str) -> None:
    file = tmp_path / "wrong.toml"
    file.write_bytes(content)
    with pytest.raises(ProblemError) as raised:
        load_problem(file)
    (mistake,) = raised.value.mistakes
    assert mistake.key.startswith(key)
    assert expected in mistake.expected
    assert raised.value.source == str(file)


@pytest.mark.smoke
def test_a_missing_file_names_the_nearest_and_the_bundled_ones(tmp_path: Path) -> None:
    (tmp_path / "reach.toml").write_text(VALID)
    with pytest.raises(ProblemError, match=r'"five_bay_two_cubes".*did you mean "reach.toml"') as raised:
        load_problem(tmp_path / "raech.toml")
    assert len(raised.value.mistakes) == 1
    with pytest.raises(ProblemError, match='did you mean "five_bay_two_cubes"'):
        load_problem("five_bay_two_cube")
    for name in (tmp_path, "/dev/null", "a\0b", "x" * 5000, ""):
        with pytest.raises(ProblemError):
            load_problem(name)


def test_files_that_a_problem_names_must_exist(tmp_path: Path) -> None:
    (tmp_path / "part.stl").write_text("solid\nendsolid\n")
    mesh = VALID.replace('shape = "box"', 'shape = "mesh"\nfile = "FILE"', 1).replace("size = 0.9\n", "", 1)
    file = tmp_path / "p.toml"
    file.write_text(mesh.replace("FILE", "part.stl"))
    (obstacle, _) = load_problem(file).obstacle
    assert obstacle.file == str(tmp_path / "part.stl")  # type: ignore[union-attr]
    for name in ("prat.stl", "", ".", "\\u0000"):
        file.write_text(mesh.replace("FILE", name))
        with pytest.raises(ProblemError) as raised:
            load_problem(file)
        (mistake,) = raised.value.mistakes
        assert mistake.key == 'obstacle[0] ("left cube").file'
        assert ('did you mean "part.stl"?' in mistake.expected) == (name == "prat.stl")
    (tmp_path / "neg.toml").write_text("")
    file.write_text(mesh.replace("FILE", "neg.stl"))
    with pytest.raises(ProblemError) as raised:
        load_problem(file)
    assert "neg.toml" not in str(raised.value)


def test_tables_made_in_python_raise_the_same_error() -> None:
    with pytest.raises(VgtmError) as raised:
        Box(name="b", shape="box", center=(0, 0, 0), size=(1, -1, 1))
    assert str(raised.value).startswith("Box: size[1]: found -1; expected a length")
    with pytest.raises(ProblemError, match=r"Problem: truss.bays: found 0"):
        Problem(
            truss={"module": "hexapod", "bays": 0},
            maneuver={"waypoint": [{"time": 1, "position": [0, 0, 1]}]},
        )
    with pytest.raises(ProblemError, match="a table \\[truss\\]"):
        Problem(maneuver={"waypoint": [{"time": 1, "position": [0, 0, 1]}]})
    with pytest.raises(ProblemError, match=r"obstacle\[0\]: found .*; expected a table"):
        Problem(
            truss={"module": "hexapod", "bays": 1},
            maneuver={"waypoint": [{"time": 1, "position": [0, 0, 1]}]},
            obstacle=["box"],
        )


@pytest.mark.parametrize("function", [vq.solve, vq.Resolver, vq.compare])
@pytest.mark.parametrize(
    ("value", "says"),
    [
        (
            "five_bay_free",
            r'found "five_bay_free"; expected a problem: vgtm_qp\.load_problem\("five_bay_free"\)',
        ),
        (Path("a.toml"), r'vgtm_qp\.load_problem\("a.toml"\) reads it'),
        (None, r"found nothing; expected a problem, from vgtm_qp\.load_problem\(path\)"),
        ({"name": "x"}, "found a table of name; expected a problem"),
    ],
)
def test_what_is_no_problem_is_told_how_to_become_one(function: object, value: object, says: str) -> None:
    with pytest.raises(VgtmError, match=says):
        function(value)  # type: ignore[operator]


def test_a_problem_is_not_changed_in_place(tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text(VALID)
    problem = load_problem(tmp_path / "p.toml")
    with pytest.raises(ProblemError, match=r'Problem: name: found "other"; expected .*problem\.replace'):
        problem.name = "other"
    with pytest.raises(ProblemError, match=r"ClearanceTable: safe: found 0\.1; expected no change"):
        problem.clearance.safe = 0.1
    with pytest.raises(ProblemError, match="clearance: found nothing; expected no change"):
        del problem.clearance
    assert (problem.name, problem.clearance.safe) == ("unnamed", 0.08)


def test_an_error_survives_the_way_back_from_a_worker_process() -> None:
    with pytest.raises(ProblemError) as raised:
        Box(name="b", shape="box", center=(0, 0, 0), size=-1)
    copy = pickle.loads(pickle.dumps(raised.value))
    assert (copy.source, copy.mistakes, str(copy)) == (
        raised.value.source,
        raised.value.mistakes,
        str(raised.value),
    )
