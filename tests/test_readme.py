"""The README is tried as it stands: its commands, its Python, its problem file, its tables."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import tomllib
from functools import reduce
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from vgtm_qp.cli import main
from vgtm_qp.cli.app import app
from vgtm_qp.problem import Problem, load_problem, problem_schema

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

# What stands in each table of the problem-file reference.
TABLES = {
    "[truss]": ("ModuleTruss", "TetrahedralTruss", "GraphTruss"),
    "[[truss.node]]": ("Node",),
    "[[truss.member]]": ("Member",),
    "[[truss.locked]]": ("Lock",),
    "[[truss.base_motion]]": ("BasePose",),
    "[arm]": ("ArmTable",),
    "[[arm.joint]]": ("Joint",),
    "[arm.joint.mimic]": ("Mimic",),
    "[[arm.body]]": ("ArmBody",),
    "[[arm.locked]]": ("JointLock",),
    "[curve]": ("BezierCurve", "BSplineCurve", "BetaSplineCurve"),
    "[[curve.control_vertex_goals]]": ("VertexGoal",),
    "[end_effector]": ("EndEffector",),
    "[maneuver]": ("WaypointManeuver", "PathManeuver"),
    "[[maneuver.waypoint]]": ("Waypoint",),
    "[[obstacle]]": ("Box", "Sphere", "Cylinder", "Mesh"),
    "[clearance]": ("ClearanceTable",),
    "[method]": ("Method",),
    "[method.weights]": ("Weights",),
    "[method.gains]": ("Gains",),
}


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)


def table(first: str) -> list[str]:
    """Return the rows of the table whose first column is headed `first`."""
    head = re.escape(f"| {first} |")
    (rows,) = re.findall(rf"^{head}[^\n]*\n\|[-|]+\|\n((?:\|[^\n]*\n)*)", README, flags=re.MULTILINE)
    return str(rows).splitlines()


def reference(models: tuple[str, ...]) -> list[str]:
    """Return the rows that the schema gives a table: key, default, meaning; the first model has the word."""
    definitions = problem_schema()["$defs"]
    found: dict[str, tuple[str, str, list[str]]] = {}
    for model in models:
        definition = definitions[model]
        definition = definition if "properties" in definition else definition["anyOf"][1]
        for key, value in definition["properties"].items():
            if "$ref" in value:
                continue
            default = "required" if key in definition.get("required", ()) else _written(value["default"])
            *_, choices = found.setdefault(key, (default, value.get("description", ""), []))
            choices += value.get("enum", [value["const"]] if "const" in value else [])
    ordered = sorted(found.items(), key=lambda item: item[0] not in ("module", "family", "shape"))
    return [
        f"| `{key}` | {default} | {_meaning(text, choices)} |" for key, (default, text, choices) in ordered
    ]


def _meaning(text: str, choices: list[str]) -> str:
    """Return the description in a cell of Markdown, with the choices that it does not name."""
    unnamed = list(dict.fromkeys(choice for choice in choices if choice not in text))
    listed = ", ".join(f'"{choice}"' for choice in (dict.fromkeys(choices) if unnamed else ()))
    return "; ".join(part for part in (text, listed) if part).replace("|", r"\|")


def _written(default: Any) -> str:
    if default is None:
        return "-"
    if isinstance(default, bool | str):
        return f"`{json.dumps(default)}`"
    if isinstance(default, list):
        return f"`[{', '.join(f'{x:g}' if isinstance(x, float) else json.dumps(x) for x in default)}]`"
    return f"{default:g}"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(ROOT / "problems", tmp_path / "problems")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_block_is_of_a_kind_that_is_tried():
    found = set(re.findall(r"^```(\w+)$", README, flags=re.MULTILINE))
    assert found == {"sh", "console", "python", "toml", "text", "bibtex"}


def test_set_up_is_what_continuous_integration_does():
    first, second = blocks("sh")
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    for command in ("-m venv", "solve problems/five_bay_two_cubes.toml"):
        assert command in first
        assert command in script
    assert "pip install ." in first
    assert "pip install '.[test]' && .venv/bin/pytest" in second
    assert re.search(r'pip" install [^\n]*\.$', script, flags=re.MULTILINE)
    assert re.search(r"pip\" install [^\n]*'\.\[test\]'$", script, flags=re.MULTILINE)
    assert '"$bin/pytest"' in script


def test_the_commands_do_what_they_say(folder: Path, capsys: pytest.CaptureFixture[str]):
    lines = [line for block in blocks("console") for line in block.splitlines()]
    assert len(lines) >= 4
    for line in lines:
        prompt, command, *arguments = shlex.split(line)
        assert (prompt, command) == ("$", "vgtm")
        assert main(arguments) == 0, capsys.readouterr().err
    assert (folder / "five_bay_two_cubes.npz").is_file()
    assert (folder / "frames.pdf").read_bytes().startswith(b"%PDF")

    capsys.readouterr()
    assert main(["verify", "five_bay_two_cubes.npz"]) == 0
    (shown,) = blocks("text")
    assert _measures(shown) == _measures(capsys.readouterr().out)


def _measures(certificate: str) -> list[tuple[str, ...]]:
    """Return verdict, name and bound of each line; values differ from machine to machine in their last digits."""
    found = re.findall(
        r"^ *(ok|FAIL) +(\w+(?: \w+)*)  .*?(\(at \w+ \S+\)|$)", certificate, flags=re.MULTILINE
    )
    assert len(found) > 10
    return found


def test_the_python_runs(folder: Path):
    names: dict[str, object] = {}
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), names)
    assert (folder / "maneuver.npz").is_file()
    assert (folder / "frames.png").is_file()


def test_the_problem_files_are_solved(folder: Path):
    assert len(blocks("toml")) == 2
    for block in blocks("toml"):
        file = folder / "own.toml"
        file.write_text(block, encoding="utf-8")
        assert isinstance(load_problem(file), Problem)
        assert main(["solve", "own.toml"]) == 0


@pytest.mark.parametrize("name", TABLES)
def test_the_reference_is_that_of_the_schema(name: str):
    assert table(f"`{name}`") == reference(TABLES[name])


def test_every_command_has_its_row():
    rows = [re.match(r"\| `vgtm (\w+)", row) for row in table("command")]
    assert [row[1] for row in rows if row] == [name for name in app if not name.startswith("-")]


def test_every_extra_has_its_row():
    rows = [re.match(r"\| `\[(\w+)\]` \|.*\| `pip install '\.\[(\w+)\]'` \|$", row) for row in table("extra")]
    assert [row.groups() for row in rows if row] == [
        (name, name) for name in PROJECT["optional-dependencies"]
    ]


def test_the_equations_are_where_the_table_says():
    named = 0
    for row in [*table("equation"), *table("beyond the paper")]:
        for file, names in re.findall(r"`([\w/]+)\.py`: (`[\w.]+`(?:, `[\w.]+`)*)", row.split(" | ")[-1]):
            module = import_module(f"vgtm_qp.{file.replace('/', '.')}")
            for name in re.findall(r"`([\w.]+)`", names):
                assert reduce(getattr, name.split("."), module) is not None
                named += 1
    assert named > 40


def test_what_it_shows_and_how_it_is_cited():
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", README)
    assert pictures
    for picture in pictures:
        assert 5_000 < (ROOT / picture).stat().st_size < 150_000
    assert f"version = {{{PROJECT['version']}}}" in blocks("bibtex")[0]
