"""The README is tried as it stands: its commands, its Python, its problem file, its tables."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest

from vgtm_qp.cli import main
from vgtm_qp.problem import Problem, load_problem
from vgtm_qp.problem.method import Weights

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(ROOT / "problems", tmp_path / "problems")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_every_block_is_of_a_kind_that_is_tried():
    found = set(re.findall(r"^```(\w+)$", README, flags=re.MULTILINE))
    assert found == {"sh", "console", "python", "toml"}


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


def test_the_python_runs(folder: Path):
    names: dict[str, object] = {}
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), names)
    assert (folder / "maneuver.npz").is_file()
    assert (folder / "frames.png").is_file()


def test_the_problem_file_is_solved(folder: Path):
    (block,) = blocks("toml")
    file = folder / "own.toml"
    file.write_text(block, encoding="utf-8")
    assert isinstance(load_problem(file), Problem)
    assert main(["solve", "own.toml"]) == 0


def test_the_table_of_weights_is_that_of_the_problem_file():
    rows = re.findall(r"^\| `(\w+)` \| (\S+) \| (.*) \|$", README, flags=re.MULTILINE)
    fields = Weights.model_fields
    assert {(name, float(value), term) for name, value, term in rows} == {
        (name, field.default, field.description) for name, field in fields.items()
    }
