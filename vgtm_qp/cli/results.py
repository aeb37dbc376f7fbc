"""``vgtm verify``, ``vgtm view``, ``vgtm export``, ``vgtm replay``: what is done with a result."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from vgtm_qp.cli.output import (
    ExitCode,
    Json,
    Output,
    ResultFile,
    answer,
    bar,
    check_writable,
    document,
    note,
    say,
    table,
    waiting,
)

if TYPE_CHECKING:
    from vgtm_qp.maneuver.maneuver import Maneuver

FormatName = Literal["html", "gif", "mp4", "pdf", "png", "csv", "mcap", "ros", "mjcf"]

_SHOWN = "problem file, name of a bundled problem, or result file, .npz"

# Of several results' exit codes, the one that comes first here is the command's.
_WORST_FIRST = (ExitCode.USAGE, ExitCode.UNVERIFIED, ExitCode.BLOCKED, ExitCode.SOLVED)


def verify(
    results: Annotated[list[Path], Parameter(name="RESULT", help="result files, .npz")],
    /,
    *,
    problem: Annotated[
        str | None, Parameter(help="problem file or name to hold them against, not the one in each result")
    ] = None,
    json: Json = False,
) -> int:
    """Check results again from their nodes alone, with none of the solver's code.

    Without ``--problem`` a result is held against the problem that it holds itself, which its author may have changed.

    A file that is no result file is wrong usage (exit code 2); one that is altered or outside a tolerance
    fails the verification (4); a maneuver that is right as far as it goes, but was blocked, gives 3.
    """
    from vgtm_qp.errors import AlteredResultError, ResultError
    from vgtm_qp.maneuver.maneuver import load_result
    from vgtm_qp.problem import load_problem
    from vgtm_qp.verify import verify as certify
    from vgtm_qp.verify.held import describe_problem

    real = None if problem is None else load_problem(problem)
    codes: list[ExitCode] = []
    entries: list[dict[str, Any]] = []
    for path in results:
        try:
            with _about(path):
                maneuver = load_result(path)
                with waiting(f"{path.name}: verifying", shown=not json):
                    certificate = certify(maneuver, problem=real)
        except ResultError as error:
            is_altered = isinstance(error, AlteredResultError)
            codes.append(ExitCode.UNVERIFIED if is_altered else ExitCode.USAGE)
            entries.append({"result": str(path), "verified": False, "error": str(error)})
            note(f"vgtm: {error}")
            continue
        held = describe_problem(maneuver, real)
        maneuver = maneuver.with_certificate(certificate)
        codes.append(outcome_code(maneuver))
        entries.append(
            {
                "result": str(path),
                "verified": certificate.ok,
                "status": maneuver.status,
                "reached": maneuver.reached,
                "blocked_by": list(maneuver.blocked_by),
                "stopped_by": maneuver.stopped_by,
                "certificate": certificate.to_dict(),
                "held_against": held,
            }
        )
        if not json:
            say(f"{path}: {maneuver.status}, {'verified' if certificate.ok else 'VERIFICATION FAILED'}")
            say(f"  held against {_held(held)}")
            say("\n".join(f"  {line}" for line in str(certificate).splitlines()))
    if json:
        document({"verified": all(entry["verified"] for entry in entries), "results": entries})
    return next(code for code in _WORST_FIRST if code in codes)


def _held(held: dict[str, Any]) -> str:
    """Return in words what a result was held against."""
    if held["problem"] is None:
        return f"the problem in the result itself, SHA-256 {held['sha256']}; --problem FILE holds it against a file"
    same = "the" if held["sha256"] == held["solved_from"] else "not the very"
    return f"{held['problem']}, SHA-256 {held['sha256']}, {same} file that it was solved from"


def outcome_code(maneuver: Maneuver) -> ExitCode:
    """Return the exit code that a maneuver with its certificate deserves."""
    certificate = maneuver.certificate
    if certificate is None or not certificate.ok:
        return ExitCode.UNVERIFIED
    return ExitCode.SOLVED if maneuver.status == "solved" else ExitCode.BLOCKED


def view(
    shown: Annotated[str, Parameter(name="PROBLEM_OR_RESULT", help=_SHOWN)],
    /,
    *,
    port: Annotated[int, Parameter(help="port on 127.0.0.1; the next free one from here on")] = 8080,
) -> None:
    """Show an arm on a live page: play a maneuver back, drag its tip, and see what holds it.

    The page is served to this machine alone, until the command is interrupted.
    """
    from vgtm_qp.live.page import view as serve
    from vgtm_qp.maneuver.maneuver import load_result
    from vgtm_qp.problem import load_problem
    from vgtm_qp.view.scene import import_viser

    import_viser()
    with _about(Path(shown)):
        loaded = load_result(shown) if shown.lower().endswith(".npz") else load_problem(shown)
        note("interrupt (Ctrl-C) to end")
        until_ready = ExitStack()

        def ready(address: str) -> None:
            until_ready.close()
            say(address)

        try:
            with until_ready:
                until_ready.enter_context(waiting(f"{Path(shown).name}: set-up", shown=True))
                serve(loaded, port=port, ready=ready)
        except KeyboardInterrupt:
            note("ended")


def export(
    result: ResultFile,
    /,
    *,
    to: Annotated[FormatName, Parameter(help="form to write")],
    output: Annotated[Path | None, Output(help="file to write; beside the result by default")] = None,
    json: Json = False,
) -> None:
    """Write a result as an offline page, animation, figure, table, ROS 2 bag or message, or MuJoCo model."""
    from vgtm_qp.export import FORMATS, export_maneuver
    from vgtm_qp.export.trajectory import bag_files
    from vgtm_qp.maneuver.maneuver import load_result

    suffix = FORMATS[to].suffix
    path = result.with_suffix(suffix) if output is None else output
    check_writable(path, "--output", (suffix,))
    with _about(result), bar(f"{path.name}: writing", shown=not json) as advance:
        file = export_maneuver(load_result(result), path, to=to, progress=partial(advance, total=1.0))
    written: dict[str, Any] = {
        "result": str(result),
        "format": to,
        "file": str(file),
        "bytes": file.stat().st_size,
    }
    said = f"{to}: {file}"
    if to == "mcap" and bag_files(file.parent) == [file.name]:
        written["bag"] = str(file.parent)
        said += f"\nROS 2 bag: {file.parent}, by the metadata.yaml in it"
    answer(written, said, as_json=json)


@contextmanager
def _about(result: Path) -> Iterator[None]:
    """Name the result file in errors about its content; if it is an archive, they say that it was altered."""
    from vgtm_qp.errors import AlteredResultError, ExportError, ResultError

    try:
        yield
    except ExportError as error:
        raise ExportError(f"{result}: {error}") from None
    except ResultError as error:
        said = str(error).removeprefix(f"{result}: ")
        kind = AlteredResultError if zipfile.is_zipfile(result) else ResultError
        raise kind(f"{result}: {said}") from None


def replay(result: ResultFile, /, *, json: Json = False) -> None:
    """Replay a result in MuJoCo, exactly and under gravity, and compare it with the certificate."""
    from vgtm_qp.export.replay import replay as run
    from vgtm_qp.maneuver.maneuver import load_result

    with _about(result), waiting(f"{result.name}: replaying", shown=not json):
        replayed = run(load_result(result))
    rows = [("", "certificate", "kinematic", "physics"), *replayed.rows()]
    answer({"result": str(result), **replayed.to_dict()}, table(rows, indent="  "), as_json=json)
