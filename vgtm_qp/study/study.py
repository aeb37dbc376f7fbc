"""The list of all studies, and how each is run: its tasks, the storage of their rows, the written results."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

from vgtm_qp.errors import GoalError, nearest
from vgtm_qp.machine import commit, machine, sentence
from vgtm_qp.study.workers import Row, Task, run_dask, run_here, run_processes


class Study(NamedTuple):
    """A study: its module, its title, and whether it is `timed`.

    Other processes beside a timed study would falsify its times, so that it runs alone. The module's
    functions are ``tasks(short, **options)``, the keyword arguments of each run, fewer and smaller ones for a
    `short` look; ``run(**task)``, the row of a task; ``draw(rows)``, the figure; and ``text(rows)``, the
    results in a paragraph and tables. Tasks and rows are JSON data.
    """

    module: str
    title: str
    timed: bool = False


STUDIES = {
    "figure3": Study("vgtm_qp.study.continuum", "Figure 3: trusses approach the continuum"),
    "figure4": Study("vgtm_qp.study.curves", "Figure 4: space curves and their control polygons"),
    "figure7": Study("vgtm_qp.study.segment", "Figure 7: a segment tracks a moving curve"),
    "figure8": Study("vgtm_qp.study.example", "Figure 8: a five-bay arm between two cubes"),
    "figure9": Study("vgtm_qp.study.run_time", "Figure 9: run time against the number of bays", timed=True),
    "redundancy": Study(
        "vgtm_qp.study.redundancy",
        "Variable degree of redundancy: the number of control vertices",
        timed=True,
    ),
    "joints": Study("vgtm_qp.study.joints", "Offset joints: what ignoring them costs"),
    "clutter": Study("vgtm_qp.study.clutter", "Clutter: success over random scenes"),
    "snakes": Study("vgtm_qp.study.snakes", "Snakes: success over random scenes of a serial arm"),
    "tracking": Study("vgtm_qp.study.tracking", "Tracking as an equality, and how it gives way"),
    "robustness": Study("vgtm_qp.study.robustness", "Robustness: random scenes of every module"),
    "loops": Study("vgtm_qp.study.loops", "Control loops: random goals among obstacles that move"),
}


def find_study(name: str) -> Study:
    """Return a study by its name.

    Raises
    ------
    GoalError
        There is no such study.
    """
    if name not in STUDIES:
        raise GoalError(f'no study "{name}"{nearest(name, STUDIES)}; choices: {", ".join(STUDIES)}, all')
    return STUDIES[name]


def study_tasks(name: str, *, short: bool = False, **options: Any) -> list[Task]:
    """Return the tasks of a study.

    Raises
    ------
    GoalError
        There is no such study, or it has no such option.
    """
    tasks = import_module(find_study(name).module).tasks
    known = list(signature(tasks).parameters)[1:]
    for option in options:
        if option not in known:
            given, *choices = (key.replace("_", "-") for key in (option, *known))
            raise GoalError(f'study "{name}" has no option "{given}"; it has {", ".join(choices) or "none"}')
    found: list[Task] = tasks(short, **options)
    return found


def run_study(
    name: str,
    folder: Path,
    *,
    short: bool = False,
    workers: int = 1,
    dask: str | None = None,
    progress: Callable[[int, int], None] | None = None,
    options: Mapping[str, Any] | None = None,
) -> Path:
    """Run a study, or the rest of it, and write its rows, figure and text.

    In `folder` a folder ``NAME/`` is made: ``rows.jsonl`` grows by a line a task; ``NAME.csv``, ``.json``, ``.pdf`` and
    ``.md`` are written at the end. Tasks whose rows are there already are not run again; failed ones are.

    Parameters
    ----------
    workers, dask
        Number of processes, each with one BLAS thread, 1 being this process; or address of a Dask scheduler.
    progress
        Called with the number of tasks done, and of all tasks.
    options
        Of the study: ``scenes`` and ``seed`` of tracking, robustness and loops, ``arms`` of the last two,
        ``without_compiler`` and ``against`` of robustness, and ``changes`` of loops.

    Raises
    ------
    GoalError
        There is no such study, or it has no such option.
    MissingExtraError
        A cluster is asked for and Dask is not installed.
    """
    study, options = find_study(name), options or {}
    tasks = study_tasks(name, short=short, **options)
    place = folder / name
    place.mkdir(parents=True, exist_ok=True)
    log = place / "rows.jsonl"
    known = _known_rows(log)
    keys = [hashlib.sha256(json.dumps(task, sort_keys=True).encode()).hexdigest()[:16] for task in tasks]
    left = [k for k, key in enumerate(keys) if key not in known]
    done = len(tasks) - len(left)
    report = progress or (lambda _done, _total: None)
    report(done, len(tasks))
    function, waiting = f"{study.module}:run", [tasks[k] for k in left]
    if dask is not None:
        answers = run_dask(function, waiting, dask)
    elif workers > 1:
        answers = run_processes(function, waiting, 1 if study.timed else workers)
    else:
        answers = run_here(function, waiting)
    with log.open("a", encoding="utf-8") as file:
        for finished, (k, row) in enumerate(answers, start=done + 1):
            key = keys[left[k]]
            known[key] = row
            file.write(json.dumps({"key": key, "task": waiting[k], "row": row}) + "\n")
            file.flush()
            report(finished, len(tasks))
    rows = [{**task, **known[key]} for task, key in zip(tasks, keys, strict=True)]
    given = "".join(f" --{key} {value}" for key, value in options.items())
    _write(study, place, rows, f"vgtm study {name}{' --short' if short else ''}{given}")
    return place


def _known_rows(log: Path) -> dict[str, Row]:
    """Return the rows of an earlier run by the keys of their tasks; a line cut by a crash is skipped."""
    rows: dict[str, Row] = {}
    if log.exists():
        for line in log.read_text(encoding="utf-8").splitlines():
            try:
                entry = json.loads(line)
            except json.JSONDecodeError:
                continue
            if "failed" not in entry["row"]:
                rows[entry["key"]] = entry["row"]
    return rows


def _write(study: Study, place: Path, rows: Sequence[Row], command: str) -> None:
    """Write rows, figure and text into the folder of a study; failed rows are in the data and named in the text."""
    import matplotlib as mpl

    from vgtm_qp.view.figure import save_figure
    from vgtm_qp.view.style import RC

    name, module, found = place.name, import_module(study.module), machine()
    data: dict[str, Any] = {
        "study": name,
        "title": study.title,
        "commit": commit(),
        "machine": found,
        "rows": rows,
    }
    (place / f"{name}.json").write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    flat = [{key: value for key, value in row.items() if not isinstance(value, list | dict)} for row in rows]
    with (place / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for row in flat for key in row)))
        writer.writeheader()
        writer.writerows(flat)
    counted = [row for row in rows if "failed" not in row]
    with mpl.rc_context(RC):
        figure = module.draw(counted)
    save_figure(figure, place / f"{name}.pdf")
    lines = [f"## {study.title}", "", module.text(counted).strip(), ""]
    lines += [f"Not counted: a run that failed, {row['failed']}" for row in rows if "failed" in row]
    at = f", commit {data['commit'][:12]}" if data["commit"] else ""
    lines += [f"Measured on: {sentence(found)}{at}. Made again by `{command}`.", ""]
    (place / f"{name}.md").write_text("\n".join(lines), encoding="utf-8")
