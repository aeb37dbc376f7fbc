"""``vgtm view``: a live page of a problem or a result."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from vgtm_qp.cli.output import ExitCode, note, say


def view(
    shown: Annotated[
        str,
        Parameter(
            name="PROBLEM_OR_RESULT", help="problem file, name of a bundled problem, or result file, .npz"
        ),
    ],
    /,
    *,
    port: Annotated[int, Parameter(help="port on 127.0.0.1; the next free one from here on")] = 8080,
) -> int:
    """Show an arm on a live page: play a maneuver back, drag its tip, and see what holds it.

    The page is served to this machine alone, until the command is interrupted.
    """
    from vgtm_qp.live.page import view as serve
    from vgtm_qp.maneuver.maneuver import load_result
    from vgtm_qp.problem import load_problem
    from vgtm_qp.view.scene import import_viser

    import_viser()
    loaded = load_result(shown) if shown.lower().endswith(".npz") else load_problem(shown)
    note("interrupt (Ctrl-C) to end")
    try:
        serve(loaded, port=port, ready=say)
    except KeyboardInterrupt:
        note("ended")
    return ExitCode.SOLVED
