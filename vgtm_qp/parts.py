"""Parts that a user brings: modules of trusses, curve families, solvers of QPs, shapes of obstacles, by their names."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal, get_args, get_type_hints

from vgtm_qp.errors import PartError, closest

Kind = Literal["module", "curve", "solver", "obstacle"]
Part = Callable[..., Any]

_GROUPS: dict[str, str] = {
    "module": "vgtm_qp.modules",
    "curve": "vgtm_qp.curves",
    "solver": "vgtm_qp.solvers",
    "obstacle": "vgtm_qp.obstacles",
}
"""The group of entry points of each kind."""
_TAKEN: dict[str, frozenset[str]] = {
    "module": frozenset(
        ("octahedral", "double-octahedral", "hexapod", "longeron", "tetrahedral", "graph", "plate")
    ),
    "curve": frozenset(("bezier", "b-spline", "beta-spline", "segments")),
    "solver": frozenset(("daqp", "osqp", "piqp")),
    "obstacle": frozenset(("box", "sphere", "cylinder", "mesh")),
}
"""Names of the package's own parts, which no other part can have."""
_CALLED_BY: dict[str, str] = {"module": "module", "curve": "family", "obstacle": "shape"}
"""The key of a table that names its part."""

REGISTERED: dict[str, dict[str, Part]] = {kind: {} for kind in _GROUPS}
"""The parts of this process by kind and name; those of installed packages once they have been asked for."""


def register(kind: Kind, name: str, part: Part) -> None:
    """Register a part of one's own under the name by which problem files call it, for this process.

    A part that is registered again takes the place of the earlier one. A package that is installed needs no call: an
    entry point of its ``pyproject.toml`` does the same in every process, in a group of the same kind:
    ``[project.entry-points."vgtm_qp.modules"]``, ``.curves``, ``.solvers`` or ``.obstacles``.

    Parameters
    ----------
    kind
        ``"module"`` of a truss, ``"curve"`` family, ``"solver"`` of QPs, or shape of an ``"obstacle"``.
    name
        Its value of ``truss.module``, ``curve.family``, ``method.solver`` or ``obstacle.shape``.
    part
        The function, or the class of a solver; ``vgtm_qp/README.md`` says what each is given and returns.

    Raises
    ------
    PartError
        There is no such kind, the name is that of a part of the package, or the part cannot be called so.
    """
    there = REGISTERED[_known_kind(kind)]
    name = _free_name(kind, name)
    there[name] = _fitting(kind, name, part)


def part_names(kind: Kind) -> list[str]:
    """Return the names of the parts of a kind that are registered or installed, sorted."""
    return sorted({*REGISTERED[kind], *_installed(kind)} - _TAKEN[kind])


def find_part(kind: Kind, name: object) -> Part | None:
    """Return the part of a kind and a name; None if there is none.

    Raises
    ------
    PartError
        An installed package names the part, but it cannot be imported, or not be called.
    """
    if not isinstance(name, str) or name in _TAKEN[kind]:
        return None
    if name not in REGISTERED[kind]:
        entry = _installed(kind).get(name)
        if entry is None:
            return None
        try:
            part = entry.load()
        except Exception as error:  # the import runs somebody else's code
            raise PartError(f'the {kind} "{name}" cannot be imported from {entry.value}: {error}') from error
        REGISTERED[kind][name] = _fitting(kind, name, part)
    return REGISTERED[kind][name]


def part_keys(part: Part) -> dict[str, tuple[Any, Any]]:
    """Return the type and the default of each keyword of a part, by name; ``...`` stands for no default."""
    try:
        hints = get_type_hints(part)
    except (NameError, TypeError):
        hints = {}
    return {
        key: (hints.get(key, Any), ... if found.default is found.empty else found.default)
        for key, found in inspect.signature(part).parameters.items()
    }


def _installed(kind: str) -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=_GROUPS[kind])}


def _known_kind(kind: str) -> str:
    if kind not in _GROUPS:
        meant = closest(str(kind), _GROUPS)
        hint = "" if meant is None else f'; did you mean "{meant}"?'
        raise PartError(
            f"there is no kind of part {kind!r}; expected one of {', '.join(get_args(Kind))}{hint}"
        )
    return kind


def _free_name(kind: str, name: object) -> str:
    if not (isinstance(name, str) and name.strip() and name.isprintable() and "," not in name):
        raise PartError(f"{name!r} cannot be the name of a {kind}; expected a string without commas")
    if name in _TAKEN[kind]:
        raise PartError(f'"{name}" is a {kind} of the package; expected another name')
    return name


def _fitting(kind: str, name: str, part: Part) -> Part:
    """Return the part if it can be called with its keys by name; solvers are called otherwise."""
    if not callable(part):
        raise PartError(f'the {kind} "{name}" is {part!r}; expected a function')
    if kind == "solver":
        return part
    for key, found in inspect.signature(part).parameters.items():
        if key == _CALLED_BY[kind]:
            raise PartError(
                f'the {kind} "{name}" has the parameter {key}; expected another name: the key is its own'
            )
        if found.kind not in (found.POSITIONAL_OR_KEYWORD, found.KEYWORD_ONLY):
            raise PartError(
                f'the {kind} "{name}" has the parameter {found}; expected parameters that have names, such as '
                f"{key}: the keys of its table in a problem file"
            )
    return part
