"""``vgtm compare``: the same maneuver by several methods, one table, one figure."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from vgtm_qp.cli.output import Json, Output, answer, note

if TYPE_CHECKING:
    from vgtm_qp.step.resolver import Step


def compare(
    problems: Annotated[
        list[str], Parameter(name="PROBLEM", help="problem files, or names of bundled problems (vgtm list)")
    ],
    /,
    *,
    methods: Annotated[
        list[str] | None,
        Parameter(help="methods by name, all of them with all; nine by default", consume_multiple=True),
    ] = None,
    output: Annotated[Path | None, Output(help="folder for compare.md, .json and .pdf")] = None,
    json: Json = False,
) -> None:
    """Solve problems by several methods and show what each of them keeps; a method that fails is shown as failed.

    Exit code 0 says that the comparison was made, whatever the methods did.
    """
    from vgtm_qp.cli.progress import following
    from vgtm_qp.comparison.compare import compare as run
    from vgtm_qp.methods import DEFAULT_METHODS, PRESETS
    from vgtm_qp.methods.presets import check_methods
    from vgtm_qp.problem import load_problem
    from vgtm_qp.view.figure import save_figure

    names = [name for entry in methods or DEFAULT_METHODS for name in entry.split(",")]
    names = list(PRESETS) if names == ["all"] else names
    check_methods(names)
    loaded = [load_problem(problem) for problem in problems]
    folder = output or Path("compare")
    folder.mkdir(parents=True, exist_ok=True)
    reports = []
    total = len(loaded) * len(names)
    with following("compare", shown=not json) as advance:
        for k, problem in enumerate(loaded):

            def show(name: str, part: float, step: Step, done: int = k * len(names)) -> None:
                advance((done + names.index(name) + part) / total, step)

            reports.append(run(problem, methods=names, progress=show))
    report = sum(reports[1:], reports[0])
    (folder / "compare.md").write_text(report.markdown())
    (folder / "compare.json").write_text(report.json() + "\n")
    save_figure(report.figure(), folder / "compare.pdf")
    answer(report.to_dict(), report.markdown(), as_json=json)
    note(f"written: {folder / 'compare.md'}, compare.json, compare.pdf")
