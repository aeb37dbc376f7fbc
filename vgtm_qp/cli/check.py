"""``vgtm check``: everything about a problem that can be told without solving it."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from vgtm_qp.cli.output import ExitCode, Json, document, note, say


def check(
    problem: Annotated[str, Parameter(help="problem file, or the name of a bundled problem (vgtm list)")],
    /,
    *,
    json: Json = False,
) -> int:
    """Check a problem file: its keys and values, its arm, its obstacles and goals at the home pose."""
    from dataclasses import asdict

    from vgtm_qp.errors import ProblemError
    from vgtm_qp.problem import load_problem
    from vgtm_qp.step.build import build_arm
    from vgtm_qp.step.checks import check_problem, find_warnings

    loaded = load_problem(problem)
    source = str(loaded.source or loaded.name)
    setup = build_arm(loaded)
    mistakes = check_problem(loaded, setup)
    if mistakes:
        raise ProblemError(source, mistakes)
    warnings = find_warnings(loaded, setup)
    kind = "arm" if loaded.truss is None else "truss"
    arm = setup.arm.describe()
    for warning in warnings:
        note(f"{source}: warning: {warning}")
    if json:
        document(
            {
                "file": source,
                "name": loaded.name,
                "valid": True,
                "warnings": [asdict(warning) for warning in warnings],
                kind: asdict(arm),
            }
        )
    else:
        say(f"{source}: no mistakes\n{arm}")
    return ExitCode.SOLVED
