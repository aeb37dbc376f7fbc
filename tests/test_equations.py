"""Which function stands for which equation of the paper: first lines of docstrings say it, each number once."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import vgtm_qp

PACKAGE = Path(vgtm_qp.__file__).parent
EQUATIONS = range(1, 40)

# Those that vgtm_qp/README.md has no row for.
UNUSED = {2, 31}


# The independent check has everything a second time.
SECOND = "verify/"

NUMBERS = re.compile(r"\beqs?\. \(\d+\)(?:(?:-| and |, | to )\(\d+\))*")


def numbers(line: str) -> list[int]:
    """Return the numbers of the equations that a line names; a range counts as all that it covers."""
    found: list[int] = []
    for named in NUMBERS.findall(line):
        for first, last in re.findall(r"\((\d+)\)(?:(?:-| to )\((\d+)\))?", named):
            found += range(int(first), int(last or first) + 1)
    return found


@cache
def headed() -> dict[int, set[str]]:
    """Return which functions have a docstring whose first line names each equation."""
    found: dict[int, set[str]] = defaultdict(set)
    for file in sorted(PACKAGE.rglob("*.py")):
        place = file.relative_to(PACKAGE).as_posix()
        if place.startswith(SECOND):
            continue
        for name, function in _functions(ast.parse(file.read_text(encoding="utf-8")), ""):
            if isinstance(function, ast.ClassDef) and place.startswith("problem/"):
                # What the schema says of a table.
                continue
            for number in numbers((ast.get_docstring(function) or "").split("\n")[0]):
                found[number].add(f"{place}: {name}")
    return found


def _functions(tree: ast.AST, owner: str) -> Iterator[tuple[str, ast.ClassDef | ast.FunctionDef]]:
    """Yield functions and classes, whose first lines are found in the same search."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            name = f"{owner}.{node.name}".lstrip(".")
            yield name, node
            yield from _functions(node, name)


def table() -> dict[int, set[str]]:
    """Return which functions the table in vgtm_qp/README.md names for each equation."""
    found: dict[int, set[str]] = {}
    lines = (Path(__file__).parent.parent / "vgtm_qp" / "README.md").read_text(encoding="utf-8").splitlines()
    for line in lines[lines.index("| equation | what | where |") + 2 :]:
        if not line.startswith("|"):
            break
        equations, _, where = line.strip("|").split(" | ")
        named = re.findall(r"`([\w/]+\.py)`: (`[\w.]+`(?:, `[\w.]+`)*)", where)
        names = {f"{file}: {name}" for file, listed in named for name in re.findall(r"`([\w.]+)`", listed)}
        for number in numbers(f"eq. {equations.strip()}"):
            found[number] = found.get(number, set()) | names
    return found


@pytest.mark.smoke
@pytest.mark.parametrize("number", EQUATIONS)
def test_an_equation_heads_one_function(number: int) -> None:
    functions = headed().get(number, set())
    assert len(functions) == (number not in UNUSED), functions


@pytest.mark.smoke
def test_no_docstring_names_an_equation_that_the_paper_does_not_have() -> None:
    assert set(headed()) <= set(EQUATIONS)


@pytest.mark.smoke
def test_the_table_of_equations_has_them_all_and_names_what_they_head() -> None:
    rows = table()
    assert set(rows) == set(EQUATIONS) - UNUSED
    for number, functions in headed().items():
        assert functions <= rows[number], (number, functions - rows[number])


@pytest.mark.smoke
@pytest.mark.parametrize(
    ("line", "wanted"),
    [
        ("Lengths, eq. (12).", [12]),
        ("Frames, eqs. (11) and (16): more", [11, 16]),
        ("Rows, eqs. (22)-(24), and what", [22, 23, 24]),
        ("Inverses, eqs. (5), (6) and (28): all", [5, 6, 28]),
        ("A table (3, 4) of numbers", []),
    ],
)
def test_numbers_are_read_as_they_are_written(line: str, wanted: list[int]) -> None:
    assert numbers(line) == wanted
