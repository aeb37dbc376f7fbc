"""``vgtm solve``: solve a problem, verify the maneuver, write it, print a short table."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from vgtm_qp.cli.output import (
    ExitCode,
    Json,
    Output,
    ProblemName,
    answer,
    bar,
    check_writable,
    following,
    note,
    table,
    waiting,
)
from vgtm_qp.cli.results import outcome_code
from vgtm_qp.notices import spoken

if TYPE_CHECKING:
    from vgtm_qp.problem import Problem

_KEYS = {"method.name": "--method", "method.solver": "--solver", "maneuver.steps": "--steps"}


def solve(
    problem: ProblemName,
    /,
    *,
    output: Annotated[Path | None, Output(help="result file; NAME.npz in this folder by default")] = None,
    method: Annotated[
        str | None, Parameter(help="in the place of the problem's, by its name in compare")
    ] = None,
    solver: Annotated[str | None, Parameter(help="QP solver, in the place of the problem's")] = None,
    steps: Annotated[int | None, Parameter(help="number of steps, in the place of the problem's")] = None,
    figure: Annotated[
        Path | None, Parameter(help="draw frames of the maneuver too: .pdf, .png or .svg")
    ] = None,
    html: Annotated[
        Path | None, Parameter(help="write one offline page with the maneuver in three dimensions too")
    ] = None,
    json: Json = False,
) -> int:
    """Solve a problem, verify the maneuver, write the result and print a short table.

    A maneuver that is blocked or interrupted is written as far as it came, and says so.
    """
    from vgtm_qp.export import export_maneuver
    from vgtm_qp.maneuver.solve import solve as run
    from vgtm_qp.problem import load_problem
    from vgtm_qp.verify import verify as certify

    loaded = _changed(load_problem(problem), method, {"method.solver": solver, "maneuver.steps": steps})
    name = loaded.source.stem if loaded.source else "result"
    result = Path(f"{name}.npz") if output is None else output
    check_writable(result, "--output", (".npz",))
    if figure is not None:
        check_writable(figure, "--figure", (".pdf", ".png", ".svg"))
    if html is not None:
        check_writable(html, "--html", (".html",))
        from vgtm_qp.view.scene import import_viser

        import_viser()

    with following(loaded.name, shown=not json) as progress:
        maneuver = run(loaded, progress=progress, verify=False)
    # Saved before it is verified, so that an interrupt of the verification loses nothing.
    maneuver.save(result)
    with waiting(f"{loaded.name}: verifying", shown=not json):
        maneuver = maneuver.with_certificate(certify(maneuver))
    maneuver.save(result)
    if figure is not None:
        from vgtm_qp.view.figure import save_figure

        with waiting(f"{loaded.name}: drawing", shown=not json):
            save_figure(maneuver.plot(), figure)
    if html is not None:
        with bar(f"{loaded.name}: page", shown=not json) as advance:
            export_maneuver(maneuver, html, to="html", progress=partial(advance, total=1.0))

    files = {"result": result, "figure": figure, "html": html}
    written = {name: str(path) for name, path in files.items() if path is not None}
    summary = maneuver.summary(result) | written
    report = _report(summary, serial=maneuver.joints is not None)
    lines = [f"{name}: {path}" for name, path in written.items()]
    answer(summary, "\n".join([report, *lines]), as_json=json)
    if "interrupted" in maneuver.blocked_by:
        note(f"vgtm: interrupted; what was solved is in {result}")
        return ExitCode.INTERRUPTED
    return outcome_code(maneuver)


def _changed(problem: Problem, method: str | None, changes: dict[str, Any]) -> Problem:
    """Return the problem with the options of the command line, which name their own mistakes."""
    from dataclasses import replace

    from vgtm_qp.errors import ProblemError
    from vgtm_qp.methods.presets import with_method

    wanted = {key: value for key, value in changes.items() if value is not None}
    try:
        changed = problem if method is None else with_method(problem, method)
        changed = changed.replace(wanted) if wanted else changed
        if "method.solver" in wanted:
            from vgtm_qp.step.build import check_solver

            check_solver(changed)
        return changed
    except ProblemError as error:
        mistakes = [replace(mistake, key=_KEYS.get(mistake.key, mistake.key)) for mistake in error.mistakes]
        raise ProblemError("command line", mistakes) from None


def _report(summary: dict[str, Any], *, serial: bool) -> str:
    body, fixed, unit = (
        ("links", "locked joints", "rad or m") if serial else ("members", "fixed members", "m")
    )
    verified = "verified" if summary["verified"] else "VERIFICATION FAILED"
    lines = [f"{summary['name']}: {summary['status']}, {verified}"]
    if summary["stopped_by"]:
        lines.append(f"  stopped by {summary['stopped_by']}")
    if summary["way_out"]:
        lines.append(
            f"  the problem as given was a dead end; retried with {summary['way_out']} "
            "(method.retries = false switches this off)"
        )
    lines += [f"  not within tolerance: {line}" for line in summary["failures"]]
    lines += [f"  {line}" for line in summary["notes"] if line.startswith("recovered")]
    step = summary["step_time"]
    rows = [
        ("path covered", f"{100 * summary['reached']:.4g} % in {summary['steps']} steps"),
        ("least clearance", _number(summary["min_clearance"], "m", "nothing near")),
        (f"clearance of {body} from {body}", _number(summary["min_self_clearance"], "m", "not watched")),
        (f"error of {fixed}", _number(summary["max_member_error"], unit)),
        ("stroke violation", _number(summary["max_stroke_violation"], unit)),
        ("rate violation", _number(summary["max_rate_violation"], f"({unit})/s" if serial else "m/s")),
        ("tip error", _number(summary["max_tip_error"], "m", "not tracked")),
        ("tip direction error", _number(summary["max_tip_direction_error"], "rad", "not tracked")),
        ("off the curve", _off_curve(summary)),
        ("time of a step, median and 99 %", f"{_spoken(step['median'])}, {_spoken(step['p99'])}"),
        ("set-up", _spoken(summary["setup_time"])),
        ("method and solver", ", ".join(filter(None, (summary["method"], summary["solver"])))),
    ]
    return "\n".join([*lines, table(rows, indent="  ")])


def _off_curve(summary: dict[str, Any]) -> str:
    share = summary["states_off_curve"]
    if share is None:
        return "no curve"
    return f"{_number(summary['max_tracking_gap'], 'm')} at most; {100 * share:.3g} % of the states"


def _number(value: float | None, unit: str, absent: str = "-") -> str:
    return absent if value is None else f"{value:.6g} {unit}"


def _spoken(seconds: float | None) -> str:
    return "-" if seconds is None else spoken(seconds)
