"""The README is tried as it stands: its commands, its Python, its problem file, its tables."""

from __future__ import annotations

import re
import runpy
import shlex
import shutil
import tomllib
from functools import reduce
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest
from key_reference import TABLES, reference, written

from vgtm_qp.cli import main
from vgtm_qp.cli.app import app
from vgtm_qp.problem import Problem, bundled_problems, load_problem

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

DOCUMENTS = {
    name: (ROOT / name).read_text(encoding="utf-8")
    for name in ("README.md", "problems/README.md", "examples/README.md", "vgtm_qp/README.md")
}
README = DOCUMENTS["README.md"]


def blocks(language: str, document: str = "README.md") -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", DOCUMENTS[document], flags=re.MULTILINE | re.DOTALL)


def table(first: str) -> list[str]:
    """Return the rows of the table, in whichever document, whose first column is headed `first`."""
    head, everything = re.escape(f"| {first} |"), "\n".join(DOCUMENTS.values())
    (rows,) = re.findall(rf"^{head}[^\n]*\n\|[-|]+\|\n((?:\|[^\n]*\n)*)", everything, flags=re.MULTILINE)
    return str(rows).splitlines()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(ROOT / "problems", tmp_path / "problems")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_front_page_is_short():
    assert len(README.encode()) <= 12_000


def test_every_block_is_of_a_kind_that_is_tried():
    found = set(re.findall(r"^```(\w+)$", "\n".join(DOCUMENTS.values()), flags=re.MULTILINE))
    assert found == {"sh", "console", "python", "toml", "text", "bibtex"}


@pytest.mark.parametrize("name", DOCUMENTS)
def test_links_lead_to_what_is_there(name: str):
    links = re.findall(r"\]\(([^)#\s]*)(?:#([\w-]+))?\)", DOCUMENTS[name])
    for file, anchor in links:
        if file.startswith("https://"):
            continue
        place = (ROOT / name).parent / file if file else ROOT / name
        assert place.exists(), file
        if anchor:
            heads = re.findall(r"^#+ (.*)$", place.read_text(encoding="utf-8"), flags=re.MULTILINE)
            known = [re.sub(r"[^\w -]", "", head.lower()).replace(" ", "-") for head in heads]
            assert anchor in known, anchor


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
    (shown,), (some,), told = blocks("text", "examples/README.md"), blocks("text"), capsys.readouterr().out
    assert _measures(shown) == _measures(told)
    assert len(_measures(some)) > 4
    assert set(_measures(some)) < set(_measures(told))


def _measures(certificate: str) -> list[tuple[str, ...]]:
    """Return verdict, name and bound of each line; values differ from machine to machine in their last digits."""
    return re.findall(r"^ *(ok|FAIL) +(\w+(?: \w+)*)  .*?(\(at \w+ \S+\)|$)", certificate, flags=re.MULTILINE)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_the_python_runs(name: str, folder: Path):
    names: dict[str, object] = {}
    for block in blocks("python", name):
        exec(compile(block, name, "exec"), names)
    if name == "README.md":
        assert (folder / "maneuver.npz").is_file()
        assert (folder / "frames.png").is_file()


def test_the_problem_files_are_solved(folder: Path):
    tables = blocks("toml") + blocks("toml", "problems/README.md")
    assert len(tables) == 2
    for block in tables:
        file = folder / "own.toml"
        file.write_text(block, encoding="utf-8")
        assert isinstance(load_problem(file), Problem)
        assert main(["solve", "own.toml"]) == 0


@pytest.mark.parametrize("name", TABLES)
def test_the_reference_is_that_of_the_schema(name: str):
    assert table(f"`{name}`") == reference(TABLES[name])


def test_the_reference_is_written_as_it_stands():
    document = DOCUMENTS["problems/README.md"]
    assert written(document.replace("| required |", "| 3 |")) == document


def test_the_changelog_begins_with_this_version():
    text = DOCUMENTS["vgtm_qp/README.md"].split("## Changelog\n")[1].split("\n## ")[0]
    versions = re.findall(r"^### (\S+?),? ", text, flags=re.MULTILINE)
    assert versions[0] == PROJECT["version"]


def test_every_example_has_its_row():
    rows = [re.match(r"\| `(\w+\.py)`", row) for row in table("script")]
    assert sorted(row[1] for row in rows if row) == sorted(
        file.name for file in (ROOT / "examples").glob("*.py")
    )


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


def test_the_gallery_has_twelve_small_pictures_and_their_commands():
    gallery = SimpleNamespace(**runpy.run_path(str(ROOT / "examples" / "gallery" / "make.py")))
    shown = list(gallery.pictures())
    assert len(shown) == len(table("picture")) == 12
    files = {ROOT / "examples" / picture for picture, _ in shown}
    assert sum(file.stat().st_size for file in files) < 1_500_000
    assert {
        file for file in (ROOT / "examples" / "gallery").iterdir() if file.suffix in gallery.WIDEST
    } < files
    problems = set(bundled_problems())
    for picture, command in shown:
        for program, *arguments in map(shlex.split, command.split(" && ")):
            if program == "python":
                assert (ROOT / arguments[0]).is_file()
                assert Path(picture).stem.split("_qp")[0] in (ROOT / arguments[0]).read_text()
                continue
            assert program == "vgtm"
            assert Path(arguments[1]).stem in problems
            app.parse_args(arguments)
        assert Path(picture).name in command or Path(picture).stem in command or program == "python"


def test_what_it_shows_and_how_it_is_cited():
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", README)
    assert pictures
    for picture in pictures:
        assert 5_000 < (ROOT / picture).stat().st_size < 150_000
    assert f"version = {{{PROJECT['version']}}}" in blocks("bibtex")[0]
