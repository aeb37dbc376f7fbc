"""``vgtm study``: the paper's figures and the sweeps over methods; what was run already is not run again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from vgtm_qp.cli.output import Json, Output, Switch, document, note, say
from vgtm_qp.cli.progress import bar


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
    short: Annotated[bool, Switch(help="a quick look: fewer and smaller runs")] = False,
    scenes: Annotated[int | None, Parameter(help="number of random scenes, of robustness")] = None,
    seed: Annotated[int | None, Parameter(help="seed of the random scenes, of robustness")] = None,
    ipopt: Annotated[bool, Switch(help="solve them by IPOPT too, step by step, of robustness")] = False,
    output: Annotated[Path, Output(help="folder of the results")] = Path("studies"),
    json: Json = False,
) -> None:
    """Run studies and write rows (CSV, JSON), a figure (PDF) and a text (Markdown) for each.

    An interrupted study goes on where it stopped: the rows of finished runs are on disk. A run that crashes or
    hangs loses only itself; it is tried once more alone, and then reported.
    """
    import os

    # Before NumPy is imported: times and processes are for one BLAS thread each.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from vgtm_qp.errors import GoalError
    from vgtm_qp.study import STUDIES, Study, run_study

    wanted = list(STUDIES) if names == ["all"] else names
    titles = {name: Study.named(name).title for name in wanted}
    for option, value in (("--workers", workers), ("--scenes", scenes)):
        if value is not None and value < 1:
            raise GoalError(f"{option} must be 1 or more, not {value}")
    given = {"scenes": scenes, "seed": seed, "ipopt": ipopt or None}
    options = {key: value for key, value in given.items() if value is not None}
    for name in titles:
        Study.named(name).tasks(short=short, **options)
    written = []
    for name, title in titles.items():
        with bar(title, shown=not json, counted=True) as progress:
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
