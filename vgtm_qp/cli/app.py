"""The application: its commands, and the exit code and message of every failure."""

from __future__ import annotations

import errno
import logging
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict

from cyclopts import App, CycloptsError, UnknownCommandError, UnknownOptionError, UnusedCliTokensError

from vgtm_qp.cli.certify import certify
from vgtm_qp.cli.doctor import doctor
from vgtm_qp.cli.experiments import bench, compare, study
from vgtm_qp.cli.output import ExitCode, asked_to_end, document, note
from vgtm_qp.cli.problems import check, list_problems, schema
from vgtm_qp.cli.results import export, replay, verify, view
from vgtm_qp.cli.solve import solve
from vgtm_qp.errors import AlteredResultError, ProblemError, VgtmError, nearest
from vgtm_qp.machine import THREADS, noting_interrupts
from vgtm_qp.notices import telling

_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}
"""Error numbers of the system for a disk that is full or fails."""

_EPILOGUE = (
    "Exit codes: 0 solved and verified; 1 internal error; 2 wrong usage or problem file; "
    "3 blocked or infeasible, the partial result is written; 4 verification failed; "
    "130 interrupted, what was solved is on disk."
)


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return f"vgtm {version('vgtm-qp')}"
    except PackageNotFoundError:
        return "vgtm, not installed"


app = App(
    name="vgtm",
    help="Moves highly redundant arms through clutter: one quadratic program a step, every step certified.",
    help_epilogue=_EPILOGUE,
    help_format="plaintext",
    version=_version,
    suppress_keyboard_interrupt=False,
)
app.register_install_completion_command(
    help="Complete commands and options of this shell, from the next one on."
)
_COMMANDS: dict[str, Callable[..., int | None]] = {
    "solve": solve,
    "verify": verify,
    "certify": certify,
    "compare": compare,
    "study": study,
    "check": check,
    "list": list_problems,
    "view": view,
    "export": export,
    "replay": replay,
    "schema": schema,
    "doctor": doctor,
    "bench": bench,
}
for order, (name, command) in enumerate(_COMMANDS.items()):
    app.command(command, name=name, sort_key=order)


def main(tokens: Sequence[str] | None = None) -> int:
    """Run one command line, that of the process by default, and return its exit code."""
    given = list(sys.argv[1:] if tokens is None else tokens)
    # Before NumPy is imported. The matrices are small; beside a compiler a second thread keeps the first one waiting.
    for name in THREADS:
        os.environ.setdefault(name, "1")
    # trimesh logs a traceback for a damaged file; the error that it raises is printed in one line.
    logging.getLogger("trimesh").addHandler(logging.NullHandler())
    try:
        asked_to_end.clear()
        with noting_interrupts(asked_to_end), _plain_warnings():
            code = app(given, exit_on_error=False, print_error=False, result_action="return_value")
        if code == ExitCode.INTERRUPTED:
            _stop_compilers()
        return ExitCode.SOLVED if code is None else int(code)
    except (Exception, KeyboardInterrupt) as error:
        code, message = _outcome(error)
        if code == ExitCode.INTERRUPTED:
            _stop_compilers()
        mistakes = []
        if isinstance(error, ProblemError):
            mistakes = [{"file": error.source, **asdict(mistake)} for mistake in error.mistakes]
        # Each line of a ProblemError begins with the file that it is about.
        note(message if mistakes else f"vgtm: {message}")
        if "--json" in given:
            document({"error": message, "mistakes": mistakes})
        return code


def _stop_compilers() -> None:
    """End the compilers of this process; otherwise they go on, for the next process."""
    if compiled := sys.modules.get("vgtm_qp.compiled"):
        compiled.stop_compilers()


def _outcome(error: BaseException) -> tuple[ExitCode, str]:
    """Return the exit code and the message of an error; the traceback of an internal one is printed."""
    match error:
        case CycloptsError():
            return ExitCode.USAGE, _explained(error)
        case VgtmError() if _lacks_room(error):
            return ExitCode.INTERNAL, f"the system refuses: {error}"
        case AlteredResultError():
            return ExitCode.UNVERIFIED, str(error)
        case VgtmError():
            return ExitCode.USAGE, str(error)
        case KeyboardInterrupt():
            return ExitCode.INTERRUPTED, "interrupted before there was anything to keep"
        case OSError():
            return ExitCode.INTERNAL, f"the system refuses: {error}"
    note("".join(traceback.format_exception(error)).rstrip())
    said = f"internal error, {type(error).__name__}: {error}; this is a bug in vgtm, please report it"
    return ExitCode.INTERNAL, said


def _lacks_room(error: BaseException | None) -> bool:
    """Return whether a full or failing disk caused an error."""
    while error is not None and getattr(error, "errno", None) not in _NO_ROOM:
        error = error.__context__
    return error is not None


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Print warnings in one line on stderr each, those of other libraries with their kind and place."""

    def show(
        message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: object, **__: object
    ) -> None:
        place = "" if category is UserWarning else f" ({category.__name__}, {filename}:{lineno})"
        note(f"warning: {' '.join(str(message).split())}{place}")

    with warnings.catch_warnings(), telling(note):
        warnings.showwarning = show
        yield


def _explained(error: CycloptsError) -> str:
    """Return what was wrong with the command line, and all the possible choices."""
    command = " ".join(("vgtm", *(error.command_chain or ())))
    said = str(error)
    if isinstance(error, UnknownCommandError) and error.unused_tokens:
        name = error.unused_tokens[0]
        said = f'unknown command "{name}"{nearest(name, _COMMANDS) or "."} Commands: {", ".join(_COMMANDS)}.'
    elif isinstance(error, UnknownOptionError):
        names = [name for argument in error.argument_collection for name in argument.names]
        options = [name for name in names if name.startswith("-")]
        said += f" Options: {', '.join(options)}." if options else ""
    elif isinstance(error, UnusedCliTokensError) and error.command_chain:
        extra = ", ".join(f'"{token}"' for token in error.unused_tokens or ())
        said = f"more than {command} takes: {extra}. Usage: {command}{_usage(error.command_chain[-1])}."
    return f"{said} See {command} --help."


def _usage(command: str) -> str:
    """Return what follows the name of a command: its arguments, its required options, the others."""
    arguments = app[command].assemble_argument_collection()
    given = [f" {entry.name}" for entry in arguments if not entry.name.startswith("-")]
    required = [f" {entry.name} ..." for entry in arguments if entry.required and entry.name.startswith("-")]
    return "".join([*given, *required, " [OPTIONS]"])
