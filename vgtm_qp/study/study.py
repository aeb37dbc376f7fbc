"""A study: its tasks, where their rows are kept, and what is written of them; the list of all studies."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vgtm_qp.errors import GoalError, nearest
from vgtm_qp.machine import machine, sentence
from vgtm_qp.study.workers import Row, Task, run_dask, run_here, run_processes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STUDIES = {
    "figure3": "vgtm_qp.study.continuum",
    "figure4": "vgtm_qp.study.curves",
    "figure7": "vgtm_qp.study.segment",
    "figure8": "vgtm_qp.study.example",
    "figure9": "vgtm_qp.study.run_time",
    "redundancy": "vgtm_qp.study.redundancy",
    "joints": "vgtm_qp.study.joints",
    "clutter": "vgtm_qp.study.clutter",
    "robustness": "vgtm_qp.study.robustness",
}
"""The module of each study: ``TITLE``, ``TIMED``, ``tasks(short)``, ``run(**task)``, ``draw(rows)``, ``text(rows)``."""


@dataclass(frozen=True)
class Study:
    """One study.

    Attributes
    ----------
    name, title : str
    timed : bool
        Its rows hold times that tasks beside it would falsify, so that its tasks run one at a time.
    """

    name: str
    title: str
    timed: bool
    _module: Any

    @classmethod
    def named(cls, name: str) -> Study:
        """Return a study by its name.

        Raises
        ------
        GoalError
            There is no such study.
        """
        if name not in STUDIES:
            raise GoalError(f'no study "{name}"{nearest(name, STUDIES)}; choices: {", ".join(STUDIES)}, all')
        module = import_module(STUDIES[name])
        return cls(name, module.TITLE, module.TIMED, module)

    def tasks(self, *, short: bool = False, **options: Any) -> list[Task]:
        """Return the keyword arguments of each run, as JSON data; `short` for a quick look.

        Raises
        ------
        GoalError
            The study has no such option.
        """
        known = list(signature(self._module.tasks).parameters)[1:]
        for name in options:
            if name not in known:
                choices = ", ".join(known) or "none"
                raise GoalError(f'study "{self.name}" has no option "{name}"; it has {choices}')
        return list(self._module.tasks(short, **options))

    def draw(self, rows: Sequence[Row]) -> Figure:
        """Return the study's figure."""
        return self._module.draw([row for row in rows if "failed" not in row])  # type: ignore[no-any-return]

    def text(self, rows: Sequence[Row]) -> str:
        """Return what the rows say, in a paragraph and tables."""
        return str(self._module.text([row for row in rows if "failed" not in row]))

    @property
    def function(self) -> str:
        """The function of a task, as ``"module:name"``."""
        return f"{STUDIES[self.name]}:run"


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
    """Run a study, or what is left of it, and write its rows, figure and text.

    Parameters
    ----------
    name
        One of `STUDIES`.
    folder
        Where ``NAME/`` is made: ``rows.jsonl`` grows by a line a task; ``NAME.csv``, ``.json``, ``.pdf`` and ``.md``
        are written at the end. Tasks whose rows are there already are not run again; failed ones are.
    workers
        Number of processes, each with one BLAS thread; 1 is this process.
    dask
        Address of a dask.distributed scheduler, in the place of processes.
    progress
        Called with the numbers of tasks done and in all.
    options
        Of the study: ``scenes`` and ``seed`` of robustness.

    Raises
    ------
    GoalError
        There is no such study, or it has no such option.
    MissingExtraError
        A cluster is asked for and Dask is not installed.
    """
    from vgtm_qp.view.figure import save_figure

    study = Study.named(name)
    place = folder / name
    place.mkdir(parents=True, exist_ok=True)
    tasks = study.tasks(short=short, **(options or {}))
    log = place / "rows.jsonl"
    known = _known_rows(log)
    keys = [_key(task) for task in tasks]
    left = [k for k, key in enumerate(keys) if key not in known]
    done = len(tasks) - len(left)
    if progress is not None:
        progress(done, len(tasks))
    with log.open("a") as file:
        for k, row in _run(study, [tasks[k] for k in left], workers, dask):
            number = left[k]
            known[keys[number]] = row
            file.write(json.dumps({"key": keys[number], "task": tasks[number], "row": row}) + "\n")
            file.flush()
            done += 1
            if progress is not None:
                progress(done, len(tasks))
    rows = [{**tasks[k], **known[key]} for k, key in enumerate(keys)]
    found = machine()
    _write_json(place / f"{name}.json", {"study": name, "title": study.title, "machine": found, "rows": rows})
    _write_csv(place / f"{name}.csv", rows)
    save_figure(study.draw(rows), place / f"{name}.pdf")
    failed = [row for row in rows if "failed" in row]
    lines = [f"## {study.title}", "", study.text(rows).strip(), ""]
    lines += [f"Not counted: a run that failed, {row['failed']}" for row in failed]
    given = (f" --{key} {value}" for key, value in (options or {}).items())
    again = f"vgtm study {name}{' --short' if short else ''}{''.join(given)}"
    lines += [f"Measured on: {sentence(found)}. Made again by `{again}`.", ""]
    (place / f"{name}.md").write_text("\n".join(lines))
    return place


def _run(study: Study, tasks: list[Task], workers: int, dask: str | None) -> Iterator[tuple[int, Row]]:
    if dask is not None:
        return run_dask(study.function, tasks, dask)
    if workers > 1:
        return run_processes(study.function, tasks, 1 if study.timed else workers)
    return run_here(study.function, tasks)


def _known_rows(log: Path) -> dict[str, Row]:
    """Return the rows of an earlier run by the keys of their tasks; a line cut by a crash is skipped."""
    rows: dict[str, Row] = {}
    if log.exists():
        for line in log.read_text().splitlines():
            try:
                entry = json.loads(line)
            except json.JSONDecodeError:
                continue
            if "failed" not in entry["row"]:
                rows[entry["key"]] = entry["row"]
    return rows


def _key(task: Task) -> str:
    return hashlib.sha256(json.dumps(task, sort_keys=True).encode()).hexdigest()[:16]


def _write_json(path: Path, data: dict[str, Any]) -> None:
    path.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n")


def _write_csv(path: Path, rows: Sequence[Row]) -> None:
    flat = [{key: value for key, value in row.items() if not isinstance(value, list | dict)} for row in rows]
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(key for row in flat for key in row)))
        writer.writeheader()
        writer.writerows(flat)
