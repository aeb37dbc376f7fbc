"""``vgtm compare``, ``vgtm study``, ``vgtm bench``: methods against each other, over scenes, and by the clock."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from vgtm_qp.bench import BaselineName, DistanceName, SceneKind, TrackingName
from vgtm_qp.cli.output import (
    ExitCode,
    Json,
    Output,
    Switch,
    answer,
    bar,
    check_writable,
    document,
    following,
    note,
    on_terminal,
    say,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vgtm_qp.bench.scenes import BenchScene
    from vgtm_qp.step.step import Step

_several = partial(Switch, consume_multiple=True)


def compare(
    problems: Annotated[
        list[str], Parameter(name="PROBLEM", help="problem files, or names of bundled problems (vgtm list)")
    ],
    /,
    *,
    methods: Annotated[
        list[str] | None,
        Parameter(help="methods by name, all of them with all; ten by default", consume_multiple=True),
    ] = None,
    output: Annotated[
        Path | None, Output(help="folder for compare.md, .json and .pdf; made if it is missing")
    ] = None,
    figure: Annotated[
        Path | None, Parameter(help="the figure once more, in a file of this name: .pdf, .png or .svg")
    ] = None,
    json: Json = False,
) -> int:
    """Solve problems by several methods and show what each of them keeps; a method that fails is shown as failed.

    Exit code 0 says that the comparison was made, whatever the methods did; 130 that it was interrupted, and rows
    that are missing say so.
    """
    from vgtm_qp.comparison.compare import Report, missing_row
    from vgtm_qp.comparison.compare import compare as run
    from vgtm_qp.methods import DEFAULT_METHODS, PRESETS
    from vgtm_qp.methods.presets import check_methods
    from vgtm_qp.problem import load_problem
    from vgtm_qp.result.file import replacing
    from vgtm_qp.view.figure import SUFFIXES, save_figure

    names = [name for entry in methods or DEFAULT_METHODS for name in entry.split(",")]
    names = list(PRESETS) if names == ["all"] else names
    check_methods(names)
    if figure is not None:
        check_writable(figure, "--figure", SUFFIXES)
    loaded = [load_problem(problem) for problem in problems]
    folder = output or Path("compare")
    folder.mkdir(parents=True, exist_ok=True)
    reports: list[Report] = []
    total = len(loaded) * len(names)
    with following("compare", shown=not json) as advance:
        for k, problem in enumerate(loaded):

            def show(name: str, part: float, step: Step, done: int = k * len(names)) -> None:
                advance((done + names.index(name) + part) / total, step)

            if reports and reports[-1].interrupted:
                rows = tuple(missing_row(problem, name) for name in names)
                reports.append(Report(rows, {}, reports[-1].machine))
            else:
                reports.append(run(problem, methods=names, progress=show))
    report = sum(reports[1:], reports[0])
    for name, text in (("compare.md", report.markdown()), ("compare.json", report.json() + "\n")):
        with replacing(folder / name) as scratch:
            scratch.write_text(text, encoding="utf-8")
    drawn = report.figure()
    save_figure(drawn, folder / "compare.pdf")
    if figure is not None:
        save_figure(drawn, figure)
    answer(report.to_dict(), report.markdown(), as_json=json)
    note(f"written: {folder / 'compare.md'}, compare.json, compare.pdf")
    if report.interrupted:
        note("vgtm: interrupted; the rows that are missing say so")
        return ExitCode.INTERRUPTED
    return ExitCode.SOLVED


_OPTIONS = ("scenes", "seed", "arms", "without_compiler", "against", "changes")
"""Options that some of the studies have."""


def study(
    names: Annotated[
        list[str],
        Parameter(
            name="NAME",
            help="figure3, figure4, figure7, figure8, figure9, redundancy, joints, clutter, snakes, tracking, "
            "robustness, loops, or all",
        ),
    ],
    /,
    *,
    workers: Annotated[int, Parameter(help="processes; studies of run time use one, alone")] = 1,
    dask: Annotated[str | None, Parameter(help="address of a dask.distributed scheduler")] = None,
    short: Annotated[bool, Switch(help="a quick look: fewer and smaller runs")] = False,
    scenes: Annotated[
        int | None, Parameter(help="number of random scenes, of tracking, robustness and loops")
    ] = None,
    seed: Annotated[
        int | None, Parameter(help="seed of the random scenes, of tracking, robustness and loops")
    ] = None,
    arms: Annotated[
        Literal["trusses", "serial"] | None,
        Parameter(help="arms of the random scenes, of robustness and loops: trusses by default"),
    ] = None,
    without_compiler: Annotated[
        int | None,
        Parameter(help="solve one scene in so many without a compiler, too, of robustness: 10 by default"),
    ] = None,
    against: Annotated[
        Literal["ipopt"] | None,
        Parameter(help="solve each scene by this method, too, step by step, of robustness"),
    ] = None,
    changes: Annotated[
        float | None,
        Parameter(help="share of steps before which the scene changes, of loops: 0 by default"),
    ] = None,
    output: Annotated[
        Path, Output(help="folder of the results; made if it is missing, with a folder for each study")
    ] = Path("studies"),
    json: Json = False,
) -> int:
    """Run studies and write rows (CSV, JSON), a figure (PDF) and a text (Markdown) for each.

    An interrupted study goes on where it stopped: the rows of finished runs are on disk. A run that crashes or
    hangs loses only itself; it is tried once more alone, and then reported.
    """
    from vgtm_qp.study import STUDIES, find_study, run_study, study_tasks

    wanted = list(STUDIES) if names == ["all"] else names
    titles = {name: find_study(name).title for name in wanted}
    _check_counts({"--workers": workers, "--scenes": scenes, "--without-compiler": without_compiler})
    given = zip(_OPTIONS, (scenes, seed, arms, without_compiler, against, changes), strict=True)
    options = {key: value for key, value in given if value is not None}
    for name in titles:
        study_tasks(name, short=short, **options)
    written: list[dict[str, str]] = []
    for name, title in titles.items():
        with bar(title, shown=not json, counted=True) as progress:
            try:
                place = run_study(
                    name, output, short=short, workers=workers, dask=dask, progress=progress, options=options
                )
            except KeyboardInterrupt:
                said = f"interrupted; the finished runs are in {output / name}, the same command goes on from there"
                note(f"vgtm: {said}")
                if json:
                    document({"studies": written, "error": said})
                return ExitCode.INTERRUPTED
        written.append({"study": name, "title": title, "folder": str(place)})
        if not json:
            say((place / f"{name}.md").read_text(encoding="utf-8"))
    if json:
        document({"studies": written})
    else:
        note("written: " + ", ".join(entry["folder"] for entry in written))
    return ExitCode.SOLVED


def _check_counts(counts: dict[str, int | None]) -> None:
    from vgtm_qp.errors import GoalError

    for option, value in counts.items():
        if value is not None and value < 1:
            raise GoalError(f"{option} must be 1 or more, not {value}")


def bench(
    *,
    scene: Annotated[
        list[SceneKind] | None,
        _several(help="all of them, or cubes where --bays is given"),
    ] = None,
    bays: Annotated[
        list[int] | None,
        _several(
            validator=Number(gte=5, lte=10_000),
            help="of the arms between two cubes, 5 or more; 5 to 1000 by default",
        ),
    ] = None,
    tracking: Annotated[
        list[TrackingName] | None,
        _several(help="method.tracking_mode; by default those that matter for a scene"),
    ] = None,
    distance: Annotated[
        list[DistanceName] | None,
        _several(help="clearance.distance; by default those that matter for a scene"),
    ] = None,
    baselines: Annotated[
        list[BaselineName] | None,
        _several(negative="--no-baselines", help="what else takes the steps; all by default"),
    ] = None,
    seconds: Annotated[
        float,
        Parameter(
            validator=Number(gt=0),
            help="greatest duration of a run in turn with a baseline; alone it is 30 times as long",
        ),
    ] = 2.0,
    steps: Annotated[int, Parameter(validator=Number(gte=1), help="steps of each run, at most")] = 2000,
    cold: Annotated[bool, Switch(help="set up with an empty cache of compiled kernels too")] = False,
    compare: Annotated[
        Path | None, Parameter(help="what --json printed before: give the ratios to it")
    ] = None,
    figure: Annotated[
        Path | None, Parameter(help="bars of the time of a step by phase, as .pdf, .png or .svg")
    ] = None,
    json: Json = False,
) -> None:
    """Measure how long a step takes, where that time goes, and what other methods take for the same steps.

    A step is one call of Resolver.step, as a control loop makes it: to the next mark of the maneuver, there and back,
    warm. BLAS is held to one thread. Each scene is run by itself, for percentiles and phases, then in turn with each
    baseline, ten steps each from the same states, for the ratios. Set-up and memory are those of a fresh process.
    """
    from vgtm_qp.machine import pin_threads

    pinned = pin_threads()
    from vgtm_qp.bench.contestants import BASELINES
    from vgtm_qp.bench.report import compare as compared
    from vgtm_qp.bench.report import load_document
    from vgtm_qp.bench.scenes import BAYS, KINDS, make_scenes
    from vgtm_qp.bench.tables import render

    if figure is not None:
        check_writable(figure, "--figure", (".pdf", ".png", ".svg"))
    older = None if compare is None else load_document(compare)
    kinds = scene or (("cubes",) if bays else KINDS)
    scenes = make_scenes(kinds, bays or BAYS, tracking, distance)
    rivals = BASELINES if baselines is None else dict.fromkeys(baselines)
    found = _measured(scenes, tuple(rivals), seconds=seconds, steps=steps, cold=cold, pinned=pinned)
    if older is not None:
        found["compared"] = compared(found, older)
    if figure is not None:
        _draw_phases(found, figure)
    answer(found, render(found), as_json=json)


def _measured(
    scenes: Sequence[BenchScene],
    baselines: tuple[BaselineName, ...],
    *,
    seconds: float,
    steps: int,
    cold: bool,
    pinned: bool,
) -> dict[str, Any]:
    """Return what is measured in the scenes, and tell which one is under way."""
    from vgtm_qp.bench.report import measure

    if not pinned:
        note("vgtm bench: BLAS was loaded before its threads could be held to one")

    with bar("bench", shown=True, counted=True) as advance:

        def follow(under_way: BenchScene) -> None:
            done = scenes.index(under_way)
            advance(done, len(scenes), f"bench: {under_way.name}")
            if not on_terminal():
                note(f"{done + 1}/{len(scenes)} {under_way.name}")

        given: dict[str, Any] = {"seconds": seconds, "steps": steps, "cold": cold, "pinned": pinned}
        return measure(scenes, baselines, **given, progress=follow)


def _draw_phases(found: dict[str, Any], file: Path) -> None:
    """Draw the time of a step by phase into a file."""
    from vgtm_qp.bench.chart import plot_phases
    from vgtm_qp.view.figure import save_figure

    save_figure(plot_phases(found), file)
    note(f"written: {file}")
