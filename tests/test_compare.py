"""Comparisons: failures are shown as failures, the report in its three forms, the command."""

from __future__ import annotations

import itertools
import json
import os
import signal
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from figures import clipped_and_overlapping
from matplotlib.figure import Figure

import vgtm_qp as vq
from vgtm_qp.cli import main
from vgtm_qp.errors import GoalError
from vgtm_qp.methods import PRESETS, method_name, with_method
from vgtm_qp.study.study import STUDIES, Study

METHODS = ["qp", "pseudoinverse", "pseudoinverse-corrected", "curve-pseudoinverse-plain"]


@pytest.fixture(scope="module")
def report() -> vq.Report:
    problem = vq.load_problem("five_bay_two_cubes").replace({"maneuver.steps": 30})
    return vq.compare(problem, methods=METHODS)


@pytest.mark.smoke
def test_each_method_is_held_against_the_same_verification(report: vq.Report) -> None:
    assert [row.method for row in report.rows] == METHODS
    qp = report.row("qp")
    assert qp.solved
    assert qp.kept
    assert qp.least_clearance is not None
    assert qp.least_clearance >= 0.08 - 1e-4
    faithful = report.row("pseudoinverse")
    assert not faithful.solved
    assert not faithful.kept
    assert faithful.member_drift is not None
    assert faithful.member_drift > 1e-3
    corrected = report.row("pseudoinverse-corrected")
    assert corrected.member_drift is not None
    assert corrected.member_drift < 1e-9
    assert "clearance" in corrected.reason
    assert (qp.rank, faithful.rank) == (None, 33), "30 longerons and the tip's position"
    assert corrected.actuator_travel is not None
    assert corrected.actuator_travel > 0.5


def test_a_breakdown_is_shown_with_its_step(report: vq.Report) -> None:
    row = report.row("curve-pseudoinverse-plain")
    assert row.status == "blocked"
    assert row.reached < 1.0
    assert row.reason.startswith(f"step {row.steps + 1}: ")


def test_the_report_as_table_data_and_figure(report: vq.Report, tmp_path: Path) -> None:
    table = report.markdown()
    assert str(report) == table
    assert repr(report).startswith("<Report: qp solved, pseudoinverse not, ")
    assert table.count("\n| ") == 1 + len(METHODS)
    assert "Measured on:" in table
    assert [row["method"] for row in json.loads(report.json())["rows"]] == METHODS
    figure = report.figure()
    assert clipped_and_overlapping(figure) == ([], [])
    figure.savefig(tmp_path / "compare.pdf")
    assert (tmp_path / "compare.pdf").stat().st_size > 10_000


def test_a_method_that_an_arm_cannot_have_is_refused_in_its_row() -> None:
    problem = vq.load_problem("five_bay_free").replace(
        {"truss.base_motion": [{"time": 10.0, "position": [0.1, 0.0, 0.0]}], "maneuver.steps": 10}
    )
    report = vq.compare(problem, methods=["curve-pseudoinverse", "pseudoinverse"])
    assert report.rows[0].status == "refused"
    assert "truss.base_motion" in report.rows[0].reason
    assert report.rows[1].status == "infeasible", "its members drift"
    assert "refused" in report.json()
    report.figure()


@pytest.mark.smoke
def test_every_preset_is_a_valid_method() -> None:
    problem = vq.load_problem("five_bay_free")
    for name in PRESETS:
        changed = with_method(problem, name)
        assert changed.method.name == PRESETS[name]["method.name"]
    with pytest.raises(GoalError, match='did you mean "qp-none"'):
        with_method(problem, "qp-nun")


@pytest.mark.parametrize(
    ("methods", "says"),
    [
        ("qp", r'a list of names, not one text: \["qp"\]'),
        ([], "at least one method; choices: qp, "),
        (["qq"], "qq"),
    ],
)
def test_methods_that_are_no_list_of_methods_are_refused(methods: object, says: str) -> None:
    with pytest.raises(GoalError, match=says):
        vq.compare(vq.load_problem("five_bay_free"), methods=methods)  # type: ignore[arg-type]


def test_the_command_writes_table_data_and_figure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "out"
    arguments = ["compare", "five_bay_free", "--methods", "qp,curve-pseudoinverse-corrected"]
    figure = tmp_path / "compared.png"
    assert main([*arguments, "--output", str(folder), "--figure", str(figure), "--json"]) == 0
    assert figure.read_bytes().startswith(b"\x89PNG")
    data = json.loads(capsys.readouterr().out)
    assert [row["solved"] for row in data["rows"]] == [True, True]
    assert json.loads((folder / "compare.json").read_text()) == data
    assert "curve-pseudoinverse-corrected" in (folder / "compare.md").read_text()
    assert (folder / "compare.pdf").read_bytes().startswith(b"%PDF")
    assert main(["compare", "five_bay_free", "--methods", "magic"]) == 2
    assert main(["compare", "five_bay_free", "--figure", "compared.gif"]) == 2


def test_the_study_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["study", "figure4", "--short", "--output", str(tmp_path), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["studies"][0]["study"] == "figure4"
    assert (tmp_path / "figure4" / "figure4.pdf").exists()
    assert main(["study", "figure5", "--output", str(tmp_path)]) == 2
    assert main(["study", "figure4", "--workers", "0", "--output", str(tmp_path)]) == 2


def _interrupting(monkeypatch: pytest.MonkeyPatch, module: str, *, at: int, after: int) -> None:
    """Let Ctrl-C come in solution `at` of a module, counted from 1, after so many of its steps."""
    given, count = vq.solve, itertools.count(1)

    def solve(problem: vq.Problem, **options: Any) -> vq.Maneuver:
        if next(count) != at:
            return given(problem, **options)
        steps, progress = itertools.count(1), options.get("progress")
        if not after:
            os.kill(os.getpid(), signal.SIGINT)

        def interrupt(part: float, step: vq.Step) -> None:
            if progress is not None:
                progress(part, step)
            if next(steps) == after:
                os.kill(os.getpid(), signal.SIGINT)

        return given(problem, **{**options, "progress": interrupt})

    monkeypatch.setattr(f"{module}.solve", solve)


@pytest.mark.parametrize("after", [0, 3])
def test_an_interrupted_comparison_says_which_rows_are_missing(
    after: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _interrupting(monkeypatch, "vgtm_qp.comparison.compare", at=2, after=after)
    arguments = ["compare", "five_bay_free", "ten_bay_round_a_cube", "--methods", "qp,qp-none,pseudoinverse"]
    assert main([*arguments, "--output", str(tmp_path), "--json"]) == 130
    data = json.loads(capsys.readouterr().out)
    assert [row["status"] for row in data["rows"]] == ["solved", *5 * ["interrupted"]]
    assert not any(row["solved"] or row["kept"] for row in data["rows"][1:])
    assert data["rows"][1]["steps"] <= after + 1
    assert json.loads((tmp_path / "compare.json").read_text()) == data
    assert (tmp_path / "compare.md").read_text().count("interrupted") == 5


def test_an_interrupted_study_keeps_its_finished_runs_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tasks = [{"seed": k} for k in range(6)]
    study = types.ModuleType("interrupted_study")
    problem = vq.load_problem("five_bay_free").replace({"maneuver.steps": 6})
    asked: list[int] = []

    def run(seed: int) -> dict[str, Any]:
        asked.append(seed)
        return {"status": study.solve(problem).status}

    study.solve, study.run, study.tasks = vq.solve, run, lambda short: tasks
    study.text, study.draw = lambda rows: f"{len(rows)} rows", lambda rows: Figure()
    monkeypatch.setitem(sys.modules, "interrupted_study", study)
    monkeypatch.setitem(STUDIES, "figure4", Study("interrupted_study", "A study"))
    _interrupting(monkeypatch, "interrupted_study", at=2, after=3)
    command = ["study", "figure4", "--output", str(tmp_path)]
    assert main(command) == 130
    said = capsys.readouterr().err
    assert "the same command goes on from there" in said
    assert len((tmp_path / "figure4" / "rows.jsonl").read_text().splitlines()) == 1
    assert main(command) == 0
    assert asked == [0, 1, 1, 2, 3, 4, 5]
    assert "6 rows" in capsys.readouterr().out


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="no limit of a file's size")
@pytest.mark.parametrize("to", ["csv", "mcap", "html", "pdf", "png", "ros", "mjcf", "gif"])
def test_a_full_disk_is_told_with_exit_code_1_and_leaves_no_half_file(
    to: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import resource

    result = tmp_path / "arm.npz"
    vq.solve(vq.load_problem("five_bay_free").replace({"maneuver.steps": 8})).save(result)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        code = main(["export", str(result), "--to", to])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert code == 1
    said = capsys.readouterr().err
    assert "the system refuses" in said
    assert "Traceback" not in said
    assert [path.name for path in tmp_path.iterdir()] == ["arm.npz"]


def test_osqp_stands_beside_daqp_and_another_solver_keeps_its_name() -> None:
    problem = vq.load_problem("five_bay_free").replace({"maneuver.steps": 5})
    report = vq.compare(problem, methods=["qp", "qp-osqp"])
    assert [row.solved for row in report.rows] == [True, True]
    ours, other = (report.maneuvers[problem.name, name] for name in ("qp", "qp-osqp"))
    assert other.manifest["problem"]["method"]["solver"] == "osqp"
    assert np.allclose(ours.nodes, other.nodes, rtol=0.0, atol=1e-7)
    assert not np.array_equal(ours.nodes, other.nodes)
    assert method_name(problem) == "qp"
    assert method_name(with_method(problem, "qp-osqp")) == "qp-osqp"
    piqp = problem.replace({"method.solver": "piqp"})
    assert method_name(with_method(piqp, "qp")) == "qp"
    assert with_method(piqp, "qp").method.solver == "piqp"
