"""Studies: isolation of runs, resuming, the same rows whatever runs them, and the short form of each."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import study_tasks

import vgtm_qp as vq
from vgtm_qp.comparison.tables import exponent, wilson_interval
from vgtm_qp.errors import GoalError
from vgtm_qp.problem import Problem
from vgtm_qp.problem.snake import snake
from vgtm_qp.step.checks import check_problem
from vgtm_qp.study import STUDIES, Study, clutter, loops, run_study, snakes
from vgtm_qp.study import study as study_module
from vgtm_qp.study.workers import run_dask, run_here, run_processes


def test_a_run_that_dies_hangs_or_raises_loses_itself_alone(tmp_path: Path) -> None:
    mark = str(tmp_path / "died")
    tasks = [
        {"value": 0},
        {"value": 1, "way": "die"},
        {"value": 2, "way": "die once", "mark": mark},
        {"value": 3, "way": "raise"},
        {"value": 4, "way": "hang"},
        {"value": 5},
    ]
    rows = dict(run_processes("study_tasks:end", tasks, 2, hang=4.0))
    assert sorted(rows) == list(range(6))
    assert {k: row["double"] for k, row in rows.items() if "double" in row} == {0: 0, 2: 4, 5: 10}
    assert "died" in rows[1]["failed"]
    assert rows[3]["failed"].startswith("ValueError: no 3")
    assert "longer than 4 s" in rows[4]["failed"]


def test_a_process_tells_a_warning_of_its_tasks_once(capfd: pytest.CaptureFixture[str]) -> None:
    tasks = [{"value": value} for value in (1, 1, 2, 1)]
    assert len(dict(run_processes("study_tasks:warn", tasks, 1))) == 4
    told = [line for line in capfd.readouterr().err.splitlines() if "doubtful" in line]
    assert told == [f"warning: task of value {value} is doubtful" for value in (1, 2)]


def test_processes_and_a_cluster_give_the_rows_of_one_process(tmp_path: Path) -> None:
    tasks = [{"offset": offset, "problem": "five_bay_free"} for offset in (0.02, 0.1)]
    function = "vgtm_qp.study.joints:run"
    here = dict(run_here(function, tasks))
    assert not any("failed" in row for row in here.values())
    assert dict(run_processes(function, tasks, 2)) == here
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=None, local_directory=str(tmp_path)
    ) as cluster:
        assert dict(run_dask(function, tasks, cluster.scheduler_address)) == here


def test_an_interrupted_study_goes_on_where_it_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[int] = []

    def run(value: int) -> dict[str, Any]:
        calls.append(value)
        if value == 2 and len(calls) == 3:
            raise KeyboardInterrupt
        if value == 1 and len(calls) < 4:
            raise ValueError("only at first")
        return {"double": 2 * value}

    from matplotlib.figure import Figure

    fake = SimpleNamespace(
        tasks=lambda short: [{"value": k} for k in range(2 if short else 4)],
        run=run,
        draw=lambda rows: Figure(),
        text=lambda rows: f"{len(rows)} rows",
    )
    monkeypatch.setitem(STUDIES, "nothing", Study("study_tasks", "A study of nothing"))
    monkeypatch.setattr(study_module, "import_module", lambda name: fake)
    monkeypatch.setattr(study_tasks, "run", run, raising=False)
    with pytest.raises(KeyboardInterrupt):
        run_study("nothing", tmp_path)
    log = tmp_path / "nothing" / "rows.jsonl"
    with log.open("a") as file:
        file.write('{"key": "cut')
    seen: list[tuple[int, int]] = []
    run_study("nothing", tmp_path, progress=lambda done, total: seen.append((done, total)))
    assert calls == [0, 1, 2, 1, 2, 3], "the failed run and those that were left, and no other"
    assert seen == [(1, 4), (2, 4), (3, 4), (4, 4)]
    data = json.loads((tmp_path / "nothing" / "nothing.json").read_text())
    assert [row["double"] for row in data["rows"]] == [0, 2, 4, 6]
    assert (tmp_path / "nothing" / "nothing.csv").read_text().splitlines()[0] == "value,double"
    assert "4 rows" in (tmp_path / "nothing" / "nothing.md").read_text()


def test_a_scene_of_snakes_is_the_same_each_time_clear_at_home_and_in_reach() -> None:
    first, again = snakes.scene(7, 6, 3, 40), snakes.scene(7, 6, 3, 40)
    assert first.to_dict() == again.to_dict()
    assert len(first.obstacle) == 6
    assert vq.Resolver(first).setup.least_clearance(vq.Resolver(first).state.q, 0.0, "obstacles") >= 0.1


@pytest.mark.parametrize("universal", [2, 3, 15, 40])
def test_a_snake_can_start_in_every_direction(universal: int) -> None:
    goal = {"waypoint": [{"time": 1.0, "position": [0.5, 0.0, 2.0]}]}
    problem = Problem.from_dict({"arm": snake(universal, length=3.0), "maneuver": goal})
    setup = vq.Resolver(problem).setup
    assert setup.arm.height == pytest.approx(3.0)
    assert not check_problem(problem, setup)


SHORT = ("figure4", "figure7", "figure8", "joints", "clutter")


@pytest.mark.dear
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in SHORT else [pytest.mark.slow]) for name in STUDIES]
)
def test_the_short_form_of_each_study_is_whole(name: str, tmp_path: Path) -> None:
    place = run_study(name, tmp_path, short=True)
    data = json.loads((place / f"{name}.json").read_text())
    assert data["rows"]
    assert not [row["failed"] for row in data["rows"] if "failed" in row]
    assert data["machine"]["processor"]
    assert (place / f"{name}.pdf").read_bytes().startswith(b"%PDF")
    text = (place / f"{name}.md").read_text()
    assert f"`vgtm study {name} --short`" in text
    assert "Measured on:" in text


@pytest.mark.smoke
def test_an_unknown_study_is_named_with_the_choices(tmp_path: Path) -> None:
    with pytest.raises(GoalError, match='did you mean "figure8"'):
        run_study("figure_8", tmp_path)


def test_a_clutter_scene_is_the_same_each_time_and_clear_at_home() -> None:
    first, again = clutter.scene(7, 6, 3, 40), clutter.scene(7, 6, 3, 40)
    assert first.to_dict() == again.to_dict()
    assert clutter.scene(7, 6, 4, 40).to_dict()["obstacle"] != first.to_dict()["obstacle"]
    assert len(first.obstacle) == 6
    from vgtm_qp.step.build import build_arm

    setup = build_arm(first.replace({"method.solver": "piqp"}))
    assert setup.monitor.least(setup.arm.home, 0.0, among="obstacles")[0] > 0.08


@pytest.mark.smoke
def test_wilson_intervals_and_exponents() -> None:
    low, high = wilson_interval(8, 10)
    assert (low, high) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson_interval(0, 10)[0] == 0.0
    assert wilson_interval(10, 10)[1] == 1.0
    assert wilson_interval(0, 0) == (0.0, 1.0)
    sizes = np.array([2.0, 5.0, 30.0])
    assert exponent(sizes, 3.0 * sizes**1.7) == pytest.approx(1.7)


def test_a_loop_of_a_serial_arm_keeps_everything() -> None:
    row = loops.run(11, 4, 30, arms="serial")
    assert row["reached"] + row["slowed"] + row["blocked"] == 30
    assert not row["failures"]


def test_a_loop_counts_its_steps_and_what_breaks_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    row = loops.run(7, 5, 20)
    assert row["reached"] + row["slowed"] + row["blocked"] == 20
    assert row["reached"]
    assert not row["failures"]

    class Stricter(vq.Recording):
        def maneuver(self) -> vq.Maneuver:
            maneuver = super().maneuver()
            rules = {"safe": 2.5, "influence": 3.0}
            problem = {**maneuver.manifest["problem"], "clearance": rules}
            return replace(maneuver, manifest={**maneuver.manifest, "problem": problem})

    monkeypatch.setattr(loops, "Recording", Stricter)
    assert "clearance" in " ".join(loops.run(7, 5, 20)["failures"])


def test_a_loop_through_a_scene_that_changes_keeps_everything() -> None:
    row = loops.run(31, 4, 40, changes=0.5)
    assert row["changes"] > 10
    assert row["change_cost"] > 0.0
    assert not row["failures"]
    told = loops.text([{**row, "seed": 31, "number": 4}])
    assert f"{row['changes']} changes of the scene" in told
    assert {"changes": 0.5}.items() <= loops.tasks(True, changes=0.5)[0].items()
    assert "changes" not in loops.tasks(True)[0]
