"""Every example and notebook runs as it stands, in a new folder, and does what its first line says."""

from __future__ import annotations

import runpy
import shutil
import sys
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from vgtm_qp import parts

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "examples"
OWN_PARTS = sorted((FOLDER / "own_parts").glob("*.py"))
EXAMPLES = [*sorted(FOLDER.glob("*.py")), *OWN_PARTS]
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
MOST_LINES = 30
"""Of an example of a part of one's own."""


def called(example: Path) -> str:
    return example.relative_to(FOLDER).with_suffix("").as_posix()


SAYS = {
    "own_truss": ("6 free motions", "solved; verified: True"),
    "control_loop": ("400 cycles at 200 Hz", "certified: True"),
    "pick_and_place": ("taken up, too near: nothing", "56 steps, certified: True", "least clearance 0.080"),
    "compare_methods": ("curve-pseudoinverse", "pseudoinverse", "qp"),
    "jammed_actuator": ("it moved by 0.000000000 m", "verified: True"),
    "certify_plans": (
        "clear at all of its 6 waypoints: True",
        "NOT CERTIFIED",
        "clear at all of its 7 waypoints: True\ncertified",
        "from ROS: certified",
        "OMPL",
    ),
    "snakes": ("snake of 15 universal joints", "lower cube", "qp "),
    "panda_among_shelves": ("Panda among shelves", "upper board", "| qp                      | yes"),
    "own_study": ("x = 1.2 m: solved", "x = 2.4 m: blocked"),
    "own_parts/curve": (
        "tension 0.0: solved; on the curve: True; True",
        "tension 0.2: solved; on the curve: True; True",
    ),
    "own_parts/module": ("36 members; solved; verified: True",),
    "own_parts/objective": (
        "0 objectives: solved, True; out of level by at most 0.266 m",
        "1 objectives: solved, True; out of level by at most 0.058 m",
    ),
    "own_parts/obstacle": (
        "beam: side, beam: lower end, beam: upper end",
        "solved; 0.080 m",
        "beam: side; True",
    ),
    "own_parts/row": ("1 rows: solved, True; third face up to x = 0.350 m", "held by row: light before n5"),
    "own_parts/solver": ("solved in 50 steps; verified: True",),
}

SHOWS = {
    "first_maneuver": ("solved in 50 steps", "clearance between", "written: first_maneuver.xml"),
    "own_arm": ("solved and verified: True\n", "3 free motions", 'did you mean "top"?'),
    "control_loop": ("slowed    held by clearance: member", "blocked   held by", "stroke: ", "rate: "),
}


def test_what_examples_write_is_ignored_by_git():
    ignored = (FOLDER.parent / ".gitignore").read_text(encoding="utf-8").splitlines()
    assert "out/" in ignored


def test_each_example_is_tried():
    assert {called(example) for example in EXAMPLES} == set(SAYS)
    assert {notebook.stem for notebook in NOTEBOOKS} == set(SHOWS)


@pytest.mark.parametrize("example", OWN_PARTS, ids=called)
def test_a_part_of_ones_own_takes_few_lines(example: Path):
    assert len(example.read_text(encoding="utf-8").splitlines()) <= MOST_LINES


@pytest.mark.parametrize("example", EXAMPLES, ids=called)
def test_an_example_runs(
    example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    # What an example registers is not there for later tests.
    monkeypatch.setattr(parts, "REGISTERED", {kind: {} for kind in parts.REGISTERED})
    # A plain install has none of the extras.
    for extra in ("viser", "mcap", "mujoco", "distributed", "dask"):
        monkeypatch.setitem(sys.modules, extra, None)
    monkeypatch.setattr(sys, "argv", [str(example)])
    try:
        runpy.run_path(str(example), run_name="__main__")
    except SystemExit as ended:
        if "pip install" not in str(ended):
            raise
        pytest.skip(str(ended))
    printed = capsys.readouterr().out
    for words in SAYS[called(example)]:
        assert words in printed
    assert {place.name for place in tmp_path.iterdir()} <= {"out"}
    for picture in tmp_path.glob("out/*.png"):
        assert picture.stat().st_size > 5_000


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.stem)
def test_a_notebook_runs_and_ends_with_something_seen(notebook: Path, tmp_path: Path):
    # Notebooks find the files of problems beside their own folder.
    shutil.copytree(ROOT / "problems", tmp_path / "problems")
    (tmp_path / "examples").mkdir()
    book = nbformat.read(notebook, as_version=4)
    nbformat.validate(book)
    code = [cell for cell in book.cells if cell.cell_type == "code"]
    assert not any(cell.outputs or cell.execution_count for cell in code), "no outputs are stored"
    NotebookClient(book, timeout=300, resources={"metadata": {"path": str(tmp_path / "examples")}}).execute()
    outputs = [output for cell in code for output in cell.outputs]
    told = "".join(output.get("text") or output.get("data", {}).get("text/html", "") for output in outputs)
    for words in SHOWS[notebook.stem]:
        assert words in told
    assert any("image/png" in output.get("data", {}) for output in code[-1].outputs)
