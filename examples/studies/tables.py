"""Make the tables of figures in README.md of this folder again, each by its own command.

    python examples/studies/tables.py              all of them but the four below, in half an hour on two cores
    python examples/studies/tables.py figure8      only this one
    python examples/studies/tables.py tracking     a thousand scenes in six forms: another hour and more
    python examples/studies/tables.py robustness   a thousand scenes with and without a compiler: two hours
    python examples/studies/tables.py serial       serial arms beside IPOPT: an hour
    python examples/studies/tables.py loops        100,000 steps: half an hour
    python examples/studies/tables.py --short      every command in its quick form; the document stays as it is

Each table stands between two marks, with the commit and the machine that it was made on. What has moved by more than
20 % is printed at the end. A new study needs a pair of marks in the document, and options here if it takes any.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

ROOT = Path(__file__).resolve().parents[2]
# The tables name the commit of the source tree that they are made from, so it is that which runs.
sys.path.insert(0, str(ROOT))

from vgtm_qp.study import STUDIES  # noqa: E402

DOCUMENT = Path(__file__).with_name("README.md")
LARGE = 0.2
"""A figure has moved if it differs by more than this share of what it was."""
UNITS = {"us": 1e-6, "ms": 1e-3, "s": 1.0}
NUMBER = re.compile(r"(?<![\w.])([-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?)(?: (us|ms|s)\b)?")

OPTIONS = {
    "robustness": "--scenes 1000 --seed 20261206 --without-compiler 1",
    "tracking": "--scenes 1000 --seed 1991",
    "loops": "--scenes 400 --seed 20261206",
}
"""Of the studies that take any."""
COMMANDS = {
    **{name: f"vgtm study {name} {OPTIONS.get(name, '')}".strip() for name in STUDIES},
    "serial": "vgtm study robustness --arms serial --scenes 1000 --seed 20261215 --without-compiler 1000 "
    "--against ipopt",
    "changes": "vgtm study loops --scenes 100 --seed 20261203 --changes 0.4",
    "bench": "vgtm bench --seconds 0.7",
    "peers": "vgtm bench --scene serial --scene snake --distance fcl --baselines mink --baselines pink --seconds 0.7",
}
LONG = {"tracking", "robustness", "serial", "loops", "peers"}
"""Made only where they are asked for by name, or with --short."""
SHORT = {
    **{name: f"vgtm study {name} --short" for name in STUDIES},
    "serial": "vgtm study robustness --arms serial --short --against ipopt",
    "changes": "vgtm study loops --short --changes 0.4",
    "bench": "vgtm bench --scene cubes --bays 5 --tracking elastic --seconds 0.1 --steps 20 --baselines eq28",
    "peers": "vgtm bench --scene serial --seconds 0.1 --steps 20 --baselines mink --baselines pink",
}


def marks(name: str) -> tuple[str, str]:
    """Return what stands before and after a table in the document."""
    return f"<!-- {name}: {COMMANDS[name]} -->", f"<!-- end of {name} -->"


def made(name: str, folder: Path, workers: int, *, short: bool = False) -> str:
    """Return the tables that a command prints, and where they were made."""
    words = (SHORT if short else COMMANDS)[name].split()
    study = words[2] if words[1] == "study" else None
    if study:
        words += ["--workers", str(workers), "--output", str(folder)]
    program = [sys.executable, "-c", "import sys; from vgtm_qp.cli import main; sys.exit(main(sys.argv[1:]))"]
    path = os.pathsep.join(part for part in (str(ROOT), os.environ.get("PYTHONPATH")) if part)
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run(
        [*program, *words[1:]], check=True, stdout=subprocess.PIPE, text=True, env=environment
    )
    found = (folder / study / f"{study}.md").read_text() if study else done.stdout
    return re.sub(r"\A## .*\n+", "", found).strip()


def replaced(document: str, name: str, text: str) -> str:
    """Return the document with another text between the marks of a table; ValueError where they are missing."""
    start, end = marks(name)
    if document.count(start) != 1 or document.count(end) != 1:
        raise ValueError(f"{DOCUMENT} needs these two lines, once each:\n{start}\n{end}")
    before, after = document.index(start) + len(start), document.index(end)
    return f"{document[:before]}\n{text}\n{document[after:]}"


def block(document: str, name: str) -> str:
    """Return what stands between the marks of a table."""
    start, end = marks(name)
    return document.partition(start)[2].partition(end)[0].strip()


def cells(text: str) -> dict[tuple[str, ...], str]:
    """Return the cells of the tables in a text by the words that their row begins with and the head of their column."""
    found: dict[tuple[str, ...], str] = {}
    head: list[str] = []
    for line in text.splitlines():
        row = [cell.strip() for cell in line.strip().strip("|").split("|")] if line.startswith("|") else []
        if not row or not head or set(line) <= set("|- "):
            head = head if row else []
            head = head or row
            continue
        lead = next((k for k, cell in enumerate(row) if NUMBER.match(cell) or cell == "-"), 1) or 1
        found |= {(*row[:lead], title): cell for title, cell in zip(head[lead:], row[lead:], strict=False)}
    return found


def values(cell: str) -> list[float]:
    """Return the numbers of a cell, times in seconds."""
    return [float(number) * UNITS.get(unit or "s", 1.0) for number, unit in NUMBER.findall(cell)]


def moved(old: str, new: str) -> list[str]:
    """Return a line for each cell that is lost, has other words, or a number that differs by more than a fifth."""
    before, after, lines = cells(old), cells(new), []
    for place, cell in after.items():
        if place not in before:
            continue
        was, now = values(before[place]), values(cell)
        same = NUMBER.sub("", before[place]) == NUMBER.sub("", cell) and len(was) == len(now)
        if not same or any(abs(b - a) > LARGE * abs(a) for a, b in zip(was, now, strict=False)):
            lines.append(f"{', '.join(place)}: {before[place]} -> {cell}")
    lines += [
        f"{', '.join(place)}: {cell} -> nothing" for place, cell in before.items() if place not in after
    ]
    return lines


def main() -> None:
    """Make the tables that are asked for, and say what has moved."""
    options = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    options.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help=f"{', '.join(COMMANDS)}; all of them by default, but not {', '.join(LONG)}",
    )
    options.add_argument("--short", action="store_true", help="only try each command, in its quick form")
    options.add_argument(
        "--workers", type=int, default=2, help="processes of the studies that measure no times"
    )
    options.add_argument(
        "--folder", type=Path, help="of rows and figures; where one is given, studies go on in it"
    )
    given = options.parse_args()
    unknown = [name for name in given.names if name not in COMMANDS]
    if unknown:
        options.error(f"no table {', '.join(unknown)}; choices: {', '.join(COMMANDS)}")
    texts: dict[str, str] = {}
    try:
        with tempfile.TemporaryDirectory() as scratch:
            every = [name for name in COMMANDS if given.short or name not in LONG]
            for name in given.names or every:
                started = perf_counter()
                texts[name] = made(name, given.folder or Path(scratch), given.workers, short=given.short)
                print(f"{name}: {perf_counter() - started:.0f} s", flush=True)
    finally:
        # At the end, since a changed document would count as a change of the commit that the tables name.
        if not given.short:
            write(texts)


def write(texts: dict[str, str]) -> None:
    """Write texts between the marks of their tables, and say what has moved."""
    document = DOCUMENT.read_text(encoding="utf-8")
    for name, text in texts.items():
        for line in moved(block(document, name), text):
            print(f"{name} moved by more than 20 %: {line}")
        document = replaced(document, name, text)
    DOCUMENT.write_text(document, encoding="utf-8")


if __name__ == "__main__":
    main()
