"""``vgtm study``: the paper's figures and the sweeps over methods; what was run already is not run again."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from vgtm_qp.cli.output import ExitCode, Json, document, note, say


def study(
    names: Annotated[
        list[str],
        Parameter(
            name="NAME",
            help="figure3, figure4, figure7, figure8, figure9, redundancy, joints, clutter, robustness, or all",
        ),
    ],
    /,
    *,
    workers: Annotated[int, Parameter(help="processes; studies of run time use one, alone")] = 1,
    dask: Annotated[str | None, Parameter(help="address of a dask.distributed scheduler")] = None,
    short: Annotated[bool, Parameter(negative="", help="a quick look: fewer and smaller runs")] = False,
    scenes: Annotated[int | None, Parameter(help="number of random scenes, of robustness")] = None,
    seed: Annotated[int | None, Parameter(help="seed of the random scenes, of robustness")] = None,
    output: Annotated[Path, Parameter(name=["--output", "-o"], help="folder of the results")] = Path(
        "studies"
    ),
    json: Json = False,
) -> int:
    """Run studies and write rows (CSV, JSON), a figure (PDF) and a text (Markdown) for each.

    An interrupted study goes on where it stopped: the rows of finished runs are on disk. A run that crashes or
    hangs loses only itself; it is tried once more alone, and then reported.
    """
    import os

    # Before NumPy is imported: times and processes are for one BLAS thread each.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from vgtm_qp.errors import GoalError
    from vgtm_qp.study import STUDIES, find_study, run_study, study_tasks

    wanted = list(STUDIES) if names == ["all"] else names
    titles = {name: find_study(name).title for name in wanted}
    if workers < 1:
        raise GoalError(f"--workers must be 1 or more, not {workers}")
    if scenes is not None and scenes < 1:
        raise GoalError(f"--scenes must be 1 or more, not {scenes}")
    given = {"scenes": scenes, "seed": seed}
    options = {key: value for key, value in given.items() if value is not None}
    for name in titles:
        study_tasks(name, short=short, **options)
    written = []
    for name, title in titles.items():
        with _bar(title, shown=not json) as progress:
            place = run_study(
                name, output, short=short, workers=workers, dask=dask, progress=progress, options=options
            )
        written.append({"study": name, "title": title, "folder": str(place)})
        if not json:
            say((place / f"{name}.md").read_text())
    if json:
        document({"studies": written})
    else:
        note("written: " + ", ".join(entry["folder"] for entry in written))
    return ExitCode.SOLVED


@contextmanager
def _bar(title: str, *, shown: bool) -> Iterator[Any]:
    """Give what moves a bar on stderr, where that is a terminal."""
    import sys

    if not shown or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(escape(title), total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
