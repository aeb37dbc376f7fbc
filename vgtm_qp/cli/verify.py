"""``vgtm verify``: check result files again, from the nodes alone."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from vgtm_qp.cli.output import ExitCode, Json, document, note, say

if TYPE_CHECKING:
    from vgtm_qp.maneuver.maneuver import Maneuver

# With several results the first of these that any of them earned is the exit code.
_WORST_FIRST = (ExitCode.USAGE, ExitCode.UNVERIFIED, ExitCode.BLOCKED, ExitCode.SOLVED)


def verify(
    results: Annotated[list[Path], Parameter(name="RESULT", help="result files, .npz")],
    /,
    *,
    json: Json = False,
) -> int:
    """Check results again from their nodes alone, with none of the solver's code.

    A file that is no result file is wrong usage (exit code 2); one that is altered or outside a tolerance
    fails the verification (4); a maneuver that is right as far as it goes, but was blocked, gives 3.
    """
    from vgtm_qp.errors import ResultError
    from vgtm_qp.maneuver.maneuver import load_result
    from vgtm_qp.verify import verify as certify

    codes, entries = [], []
    for path in results:
        try:
            maneuver = load_result(path)
            certificate = certify(maneuver)
        except ResultError as error:
            codes.append(ExitCode.UNVERIFIED if zipfile.is_zipfile(path) else ExitCode.USAGE)
            entries.append({"result": str(path), "verified": False, "error": str(error)})
            note(f"vgtm: {error}")
            continue
        codes.append(outcome_code(maneuver.with_certificate(certificate)))
        entries.append(_entry(path, maneuver, certificate.to_dict()))
        if not json:
            say(f"{path}: {maneuver.status}, {'verified' if certificate.ok else 'VERIFICATION FAILED'}")
            say("\n".join(f"  {line}" for line in str(certificate).splitlines()))
    if json:
        document({"verified": all(entry["verified"] for entry in entries), "results": entries})
    return next(code for code in _WORST_FIRST if code in codes)


def outcome_code(maneuver: Maneuver) -> ExitCode:
    """Return the exit code that a maneuver with its certificate deserves."""
    certificate = maneuver.certificate
    if certificate is None or not certificate.ok:
        return ExitCode.UNVERIFIED
    return ExitCode.SOLVED if maneuver.status == "solved" else ExitCode.BLOCKED


def _entry(path: Path, maneuver: Maneuver, certificate: dict[str, Any]) -> dict[str, Any]:
    return {
        "result": str(path),
        "verified": certificate["ok"],
        "status": maneuver.status,
        "reached": maneuver.reached,
        "blocked_by": list(maneuver.blocked_by),
        "certificate": certificate,
    }
