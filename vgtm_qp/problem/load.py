"""Reading problem files, the bundled problems, and the JSON Schema."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from vgtm_qp.errors import Mistake, ProblemError, nearest
from vgtm_qp.problem.fields import entry, quoted, read_bytes
from vgtm_qp.problem.path_file import read_path
from vgtm_qp.problem.problem import SCHEMA_VERSION, Problem
from vgtm_qp.problem.table import shown

_GREATEST_BYTES = 64_000_000


def load_problem(path: str | Path) -> Problem:
    """Read a problem file.

    Parameters
    ----------
    path
        A TOML file, or the name of a bundled problem such as ``"five_bay_two_cubes"``.

    Raises
    ------
    ProblemError
        With one :class:`~vgtm_qp.errors.Mistake` per mistake.
    """
    file = _find(path)
    data = _parse(str(file), _read(file))
    version = data.get("schema_version")
    if isinstance(version, bool) or version != SCHEMA_VERSION:
        expected = f"{SCHEMA_VERSION}, the version of the problem file that this release reads"
        raise ProblemError.at(file, "schema_version", shown(version), expected)
    mistakes = _path_mistakes(file, data)
    try:
        problem = Problem.from_dict(data, source=file, check_files=True)
    except ProblemError as error:
        raise ProblemError(str(file), [*error.mistakes, *mistakes]) from None
    if mistakes:
        raise ProblemError(str(file), mistakes)
    return problem


def bundled_problems() -> dict[str, Path]:
    """Return the problems that come with the package: their files by name, sorted."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "_problems", package.parent / "problems"):
        found = {file.stem: file for file in sorted(folder.glob("*.toml"))}
        if found:
            return found
    return {}


def problem_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a problem file."""
    schema = Problem.model_json_schema()
    schema["required"] = ["schema_version", *schema.get("required", [])]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def _find(path: str | Path) -> Path:
    """Return the file, or the bundled one of that name."""
    file, name, bundled = Path(path), str(path), bundled_problems()
    beside: list[str] = []
    # No file can have a path that is too long or has a null character.
    with suppress(OSError, ValueError):
        if file.is_file():
            return file
        if file.exists():
            found = "a folder" if file.is_dir() else "something that is not a regular file"
            raise ProblemError.at(name, "file", found, "a problem file in TOML")
        beside = [entry.name for entry in file.parent.iterdir() if entry.suffix == ".toml"]
    if name in bundled:
        return bundled[name]
    hint = nearest(file.name, [*beside, *bundled])
    expected = f"a problem file that exists, or the name of a bundled problem: {quoted(bundled)}{hint}"
    raise ProblemError.at(name, "file", "nothing", expected)


def _read(file: Path) -> str:
    raw = read_bytes(file, _GREATEST_BYTES)
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise ProblemError.at(
            file, f"line {line}", f"the byte 0x{raw[error.start]:02x}", "text in UTF-8"
        ) from None


def _parse(source: str, text: str) -> dict[str, Any]:
    try:
        data = tomllib.loads(text)
    except RecursionError:
        mistake = Mistake(
            "file", "arrays or tables nested hundreds deep", "tables as in the problem file reference"
        )
    except ValueError as error:
        mistake = _toml_mistake(text, str(error))
    else:
        if data:
            return data
        mistake = Mistake("file", "an empty file", f"a problem, with schema_version = {SCHEMA_VERSION} first")
    raise ProblemError(source, [mistake])


def _toml_mistake(text: str, message: str) -> Mistake:
    place = re.search(r" \(at line (\d+), column (\d+)\)$", message)
    if not place:
        return Mistake("file", "", f"valid TOML; {message[:200]}")
    line, column = int(place[1]), int(place[2])
    lines = text.splitlines()
    found = shown(lines[line - 1].strip()) if line <= len(lines) else ""
    return Mistake(f"line {line}, column {column}", found, f"valid TOML; {message[: place.start()]}")


def _path_mistakes(file: Path, data: Mapping[str, Any]) -> list[Mistake]:
    """Return the wrong cells of the path file, if the problem has one that exists."""
    name, track = entry(data.get("maneuver"), "path"), entry(data.get("end_effector"), "track")
    if not isinstance(name, str) or not name:
        return []
    try:
        path = file.absolute().parent.joinpath(Path(name).expanduser())
        if not path.is_file():
            return []
    except (OSError, RuntimeError, ValueError):
        return []
    try:
        table = read_path(path)
    except ProblemError as error:
        return [
            Mistake(f'maneuver.path "{name}", {mistake.key}', mistake.value, mistake.expected)
            for mistake in error.mistakes
        ]
    turned = isinstance(track, list) and ("pointing" in track or "orientation" in track)
    if turned and table.rotation_vector is None:
        expected = "the columns t,x,y,z,rx,ry,rz, since end_effector.track has a direction"
        return [Mistake(f'maneuver.path "{name}", line 1', "t,x,y,z", expected)]
    return []
