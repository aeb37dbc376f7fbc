"""Every table of figures in the documents stands between marks, and one script makes them all."""

from __future__ import annotations

import re
import runpy
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from vgtm_qp.study import STUDIES

ROOT = Path(__file__).resolve().parents[1]
tables = SimpleNamespace(**runpy.run_path(str(ROOT / "examples" / "studies" / "tables.py")))
DOCUMENT = tables.DOCUMENT.read_text(encoding="utf-8")
WORDS = re.compile(
    r"\| (`\[+[\w.]+\]+`|extra|command|exit code|equation|beyond the paper|`name`|what you see|folder|word|script"
    r"|notebook|picture) \|"
)
"""Heads of the tables that hold words, not figures; other tests compare those of README.md with the code."""


def documents() -> list[Path]:
    return [
        *ROOT.glob("*.md"),
        *(file for top in ("vgtm_qp", "examples", "problems") for file in (ROOT / top).rglob("*.md")),
    ]


def stray(text: str) -> Iterator[str]:
    """Yield the first line of each table of figures outside all marks."""
    for name in tables.COMMANDS:
        start, end = tables.marks(name)
        text = re.sub(re.escape(start) + ".*?" + re.escape(end), "", text, flags=re.DOTALL)
    before = ""
    for line in text.splitlines():
        if line.startswith("|") and not before.startswith("|") and not WORDS.match(line):
            yield line
        before = line


@pytest.mark.parametrize("file", documents(), ids=lambda file: str(file.relative_to(ROOT)))
def test_figures_stand_between_marks(file):
    assert list(stray(file.read_text(encoding="utf-8"))) == []


def test_a_table_outside_is_found():
    row = "| arm | median step |\n|---|---|\n| 5 bays | 0.18 ms |\n"
    assert list(stray(f"text\n\n{row}\n{DOCUMENT}")) == ["| arm | median step |"]
    start, end = tables.marks("bench")
    assert list(stray(f"{start}\n{row}\n{end}\n")) == []


def test_the_list_is_complete():
    assert (
        tables.COMMANDS.keys()
        == STUDIES.keys() | {"serial", "changes", "bench", "peers"}
        == tables.SHORT.keys()
    )
    for name in tables.COMMANDS:
        assert tables.replaced(DOCUMENT, name, tables.block(DOCUMENT, name)).count(tables.marks(name)[0]) == 1
    marked = re.findall(r"^<!-- (\w+): ", DOCUMENT, flags=re.MULTILINE)
    assert sorted(marked) == sorted(tables.COMMANDS)
    with pytest.raises(ValueError, match="needs these two lines"):
        tables.replaced("", "bench", "text")


@pytest.mark.parametrize("name", tables.COMMANDS)
def test_each_block_names_its_machine_or_says_that_it_does_not(name):
    text = tables.block(DOCUMENT, name)
    assert re.search(
        r"Measured on: .*, commit [0-9a-f]{7,}|^Commit [0-9a-f]{7,}|the commit is not known",
        text,
        re.MULTILINE,
    )


def test_a_table_is_made_by_its_command(tmp_path):
    text = tables.made("figure4", tmp_path, 1, short=True)
    assert len(tables.cells(text)) > 2
    assert "Made again by `vgtm study figure4 --short`" in text


def test_what_moved_is_told():
    head = "| arm | step | solved | bays |\n|---|---|---|---|\n"
    old = f"{head}| two cubes | 0.9 ms | 24 (86-100 %) | yes |\n| free | 2 ms | - | 5 |\n"
    new = old.replace("0.9 ms", "950 us").replace("2 ms", "2.5 ms").replace("| yes", "| no")
    assert tables.moved(old, new) == [
        "two cubes, bays: yes -> no",
        "free, step: 2 ms -> 2.5 ms",
    ]
    assert tables.moved(old, old) == []
    assert tables.values("1.5e-02") == [0.015]
    assert tables.values("870 us, x 2") == [pytest.approx(0.87e-3), 2.0]
    for cell, other in (("yes; 100", "no, 100 %"), ("9 us, x 1.7", "9 us, x 17"), ("40 of 40", "40 of 400")):
        assert len(tables.moved(old.replace("| yes", f"| {cell}"), old.replace("| yes", f"| {other}"))) == 1
    assert "free, step: 2 ms -> nothing" in tables.moved(old, head)
