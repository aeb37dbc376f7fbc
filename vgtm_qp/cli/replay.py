"""``vgtm replay``: a result in MuJoCo, exactly and under gravity, against its certificate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from vgtm_qp.cli.output import ExitCode, Json, document, say, table


def replay(
    result: Annotated[Path, Parameter(name="RESULT", help="result file, .npz")], /, *, json: Json = False
) -> int:
    """Replay a result in MuJoCo, exactly and under gravity, and compare it with the certificate."""
    from vgtm_qp.export.replay import replay as run
    from vgtm_qp.maneuver.maneuver import load_result

    replayed = run(load_result(result))
    if json:
        document({"result": str(result), **replayed.to_dict()})
    else:
        say(table([("", "certificate", "kinematic", "physics"), *replayed.rows()]))
    return ExitCode.SOLVED
