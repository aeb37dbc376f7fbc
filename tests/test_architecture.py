"""What the shape of the package promises, beside the contracts of imports in ``pyproject.toml``."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

import vgtm_qp
from vgtm_qp.geometry.exact import CONTACT
from vgtm_qp.geometry.watch import AXIS
from vgtm_qp.qp.dense import EQUALITY
from vgtm_qp.qp.fused import SUMS
from vgtm_qp.qp.long.working_set import BLOCK, REFINEMENTS, UNMOVABLE
from vgtm_qp.qp.numbers import UNBOUNDED
from vgtm_qp.step.separation import MOST_PIECES

PACKAGE = Path(vgtm_qp.__file__).parent
TESTS = Path(__file__).parent

LONGEST_CLASS, LONGEST_FUNCTION = 300, 80
"""Lines, docstrings included and decorators not, above which a docstring has a sentence that begins as follows."""
REASON = "Long because "

OPEN = {"_replace", "_asdict", "_fields", "_make", "_exit"}
"""Names that others made public: NamedTuple's, and that of the module os."""
BY_NAME = {"setattr", "delattr", "getattr", "hasattr", "attrgetter", "patch", "object"}
"""Functions that take the names of attributes, or the places of things, as texts."""

Definition = ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


def definitions(tree: ast.Module, name: str = "") -> Iterator[tuple[str, Definition]]:
    """Yield all classes and functions, also those in others, with where they are."""
    for node in ast.walk(tree):
        if isinstance(node, Definition):
            yield f"{name}:{node.lineno} {node.name}", node


def of_the_package() -> Iterator[tuple[str, Definition]]:
    for file in sorted(PACKAGE.rglob("*.py")):
        yield from definitions(
            ast.parse(file.read_text(encoding="utf-8")), file.relative_to(PACKAGE).as_posix()
        )


def aliases(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield line and name of what a module calls like a class, without making one: type aliases."""
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        for target in targets:
            if isinstance(target, ast.Name) and re.fullmatch(
                "_?[A-Z][A-Za-z0-9]*[a-z][A-Za-z0-9]*", target.id
            ):
                yield node.lineno, target.id


def test_a_class_name_stands_for_one_class() -> None:
    """Nor does a type alias share the name of a class, or of another alias."""
    homes = defaultdict(list)
    for place, node in of_the_package():
        if isinstance(node, ast.ClassDef):
            homes[node.name].append(place)
    for file in sorted(PACKAGE.rglob("*.py")):
        for line, name in aliases(ast.parse(file.read_text(encoding="utf-8"))):
            homes[name].append(f"{file.relative_to(PACKAGE).as_posix()}:{line} {name}")
    assert not {name: places for name, places in homes.items() if len(places) > 1}


def test_type_aliases_are_found() -> None:
    text = "Box = tuple[int, int]\nNear: TypeAlias = int\nMOST = 3\n_T = 1\nclass Pair: ...\n_Shape = int\n"
    assert [name for _, name in aliases(ast.parse(text))] == ["Box", "Near", "_Shape"]


def too_long(node: Definition) -> bool:
    most = LONGEST_CLASS if isinstance(node, ast.ClassDef) else LONGEST_FUNCTION
    assert node.end_lineno is not None
    return node.end_lineno - node.lineno + 1 > most and REASON not in (ast.get_docstring(node) or "")


def test_what_is_long_says_why() -> None:
    assert not [place for place, node in of_the_package() if too_long(node)], f'cut it, or say "{REASON}..."'


@pytest.mark.parametrize(("kind", "most"), [("class", LONGEST_CLASS), ("def", LONGEST_FUNCTION)])
def test_long_classes_and_functions_are_found(kind: str, most: int) -> None:
    def found(lines: int, said: str = "Something.") -> bool:
        head = f"{kind} long:" if kind == "class" else f"{kind} long():"
        text = "\n".join(["@decorated", head, f'    """{said}"""', *["    a = 1"] * (lines - 2)])
        ((_, node),) = definitions(ast.parse(text))
        return too_long(node)

    assert not found(most)
    assert found(most + 1)
    assert not found(most + 1, f"Something. {REASON}its options are.")


SPEAKERS = {
    "cli/output.py": "the command's",
    "bench/fresh.py": "a process's answer to the one that started it",
}
"""Files that may print, and whose output that is."""


def spoken_aloud(tree: ast.Module) -> Iterator[int]:
    """Yield the lines that print, or warn otherwise than by ``logging``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            if name in (
                "print",
                "warn",
                "warnings.warn",
                "traceback.print_exc",
                "sys.stdout.write",
                "sys.stderr.write",
            ):
                yield node.lineno


def test_library_code_logs_and_prints_nothing() -> None:
    files = {file.relative_to(PACKAGE).as_posix(): file for file in PACKAGE.rglob("*.py")}
    found = {
        name: list(spoken_aloud(ast.parse(file.read_text(encoding="utf-8")))) for name, file in files.items()
    }
    assert {name for name, lines in found.items() if lines} == set(SPEAKERS)


def is_private(name: str) -> bool:
    """Return whether a name is for its own module or class alone; ``_repr_html_`` and its like belong to protocols."""
    return name.startswith("_") and not name.endswith("_") and name not in OPEN


def private_names(text: str) -> Iterator[tuple[int, str]]:
    """Yield line and name where a test's text reads a private name that is not its own."""
    tree = ast.parse(text)
    nodes = list(ast.walk(tree))
    # Of a function that takes the place of a method of the package, `self` is the package's.
    classes = [node for node in nodes if isinstance(node, ast.ClassDef)]
    own = {id(inner) for one in classes for inner in ast.walk(one) if _is_own(inner)}
    for node in nodes:
        if isinstance(node, ast.Attribute) and is_private(node.attr) and id(node) not in own:
            yield node.lineno, node.attr
        elif isinstance(node, ast.Import | ast.ImportFrom):
            above = getattr(node, "module", None) or ""
            names = [part for alias in node.names for part in f"{above}.{alias.name}".split(".")]
            yield from ((node.lineno, name) for name in names if is_private(name))
        elif isinstance(node, ast.Call):
            called = getattr(node.func, "attr", getattr(node.func, "id", ""))
            texts = [one.value for one in node.args if isinstance(one, ast.Constant)]
            names = [one.split(".")[-1] for one in texts if isinstance(one, str)]
            yield from ((node.lineno, name) for name in names if called in BY_NAME and is_private(name))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield from ((node.lineno, name) for name in _in_text(node.value))


def _is_own(node: ast.AST) -> bool:
    return isinstance(node, ast.Attribute) and getattr(node.value, "id", "") in ("self", "cls")


def _in_text(text: str) -> Iterator[str]:
    """Yield the private names in a dotted place within the package, or in a program that another process runs."""
    if re.fullmatch(r"vgtm_qp(\.\w+)+", text):
        yield from filter(is_private, text.split("."))
    elif re.search(r"^\s*(from|import) ", text, re.MULTILINE):
        try:
            yield from (name for _, name in private_names(text))
        except (SyntaxError, ValueError):
            return


def test_tests_read_no_private_names() -> None:
    # The examples below are no programs.
    files = sorted(set(TESTS.rglob("*.py")) - {Path(__file__)})
    found = {file.name: list(private_names(file.read_text(encoding="utf-8"))) for file in files}
    assert not {name: names for name, names in found.items() if names}


def test_tests_import_no_other_test() -> None:
    imports = re.compile(r"^\s*(?:from|import) test_\w+", re.MULTILINE)
    assert not [file.name for file in TESTS.glob("*.py") if imports.search(file.read_text(encoding="utf-8"))]


def test_what_c_and_python_both_know_is_the_same() -> None:
    """Numbers that size the arrays which Python makes and C fills, and those by which both decide."""
    text = "".join(file.read_text(encoding="utf-8") for file in sorted((PACKAGE / "native").glob("*.[ch]")))
    of_c = {name: float(value) for name, value in re.findall(r"\b([A-Z_]+) = ([\d.e+-]+)", text)}
    sizes = {"MOST_PIECES": MOST_PIECES, "BLOCK": BLOCK, "CONTACT": CONTACT, "SUMS": SUMS, "AXIS": AXIS}
    marks = {"EQUALITY": EQUALITY, "UNBOUNDED": UNBOUNDED, "UNMOVABLE": UNMOVABLE, "REFINEMENTS": REFINEMENTS}
    known = sizes | marks
    assert {name: of_c[name] for name in known} == known


@pytest.mark.parametrize(
    "line",
    [
        "arm._table",
        "arm.solver._kept(1)",
        "def wrong(self): return self._state",
        "from vgtm_qp.qp.osqp import _FIRST",
        "from vgtm_qp._qp import osqp",
        "import vgtm_qp._qp.osqp",
        "monkeypatch.setattr(module, '_FIRST', 1)",
        "monkeypatch.setattr('vgtm_qp.compiled._PATIENCE', 1)",
        "getattr(arm, '_table')",
        "place = 'vgtm_qp.compiled._PATIENCE'",
        "program = 'import vgtm_qp\\nprint(vgtm_qp._state)'",
    ],
)
def test_private_names_are_found(line: str) -> None:
    assert list(private_names(line))


@pytest.mark.parametrize(
    "line",
    [
        "move._replace(closed=1)._asdict()",
        "os._exit(0)",
        "maneuver._repr_html_()",
        "type(arm).__init__",
        "class Own:\n    def __init__(self): self._state = 1",
        "from vgtm_qp.errors import CurveError as _Error",
        "key.endswith('_rows')",
        "said = 'imports from _elsewhere are not served'",
    ],
)
def test_names_that_tests_may_read_are_let_be(line: str) -> None:
    assert not list(private_names(line))
