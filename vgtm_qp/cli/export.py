"""``vgtm export``: a result in the forms that other programs read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from vgtm_qp.cli.output import ExitCode, Json, document, say

FormatName = Literal["html", "gif", "mp4", "pdf", "png", "csv", "mcap", "ros", "mjcf"]


def export(
    result: Annotated[Path, Parameter(name="RESULT", help="result file, .npz")],
    /,
    *,
    to: Annotated[FormatName, Parameter(help="form to write")],
    output: Annotated[
        Path | None, Parameter(name=["--output", "-o"], help="file to write; beside the result by default")
    ] = None,
    json: Json = False,
) -> int:
    """Write a result as an offline page, animation, figure, table, ROS 2 bag or message, or MuJoCo model."""
    from vgtm_qp.cli.files import check_writable
    from vgtm_qp.export import FORMATS, export_maneuver
    from vgtm_qp.maneuver.maneuver import load_result

    suffix = FORMATS[to].suffix
    path = result.with_suffix(suffix) if output is None else output
    check_writable(path, "--output", (suffix,))
    written = export_maneuver(load_result(result), path, to=to)
    if json:
        document({"result": str(result), "format": to, "file": str(written), "bytes": written.stat().st_size})
    else:
        say(f"{to}: {written}")
    return ExitCode.SOLVED
