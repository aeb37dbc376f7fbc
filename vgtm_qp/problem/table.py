"""The base of every table of a problem file: unknown keys are refused, mistakes reported in plain words."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from typing import Any, ClassVar, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    ModelWrapValidatorHandler,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import ErrorDetails, InitErrorDetails

from vgtm_qp.errors import Mistake, ProblemError, closest, nearest
from vgtm_qp.parts import part_names
from vgtm_qp.problem.fields import entry, quoted, unexpected

Place = tuple[str | int, ...]

_MISSING = object()
_PHRASES = {
    "tuple_type": "an array [...]",
    "list_type": "an array [...]",
    "too_short": "at least {min_length} of them",
    "too_long": "at most {max_length} of them",
    "model_type": "a table",
    "model_attributes_type": "a table",
    "choice": "a table",
}
_nested: ContextVar[bool] = ContextVar("_nested", default=False)


class Table(BaseModel):
    """One table of a problem file: immutable, checked when made, in Python as in a file.

    ProblemError with one :class:`~vgtm_qp.errors.Mistake` per mistake, those of the tables inside it too.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    called: ClassVar[str] = "this table"
    later: ClassVar[Mapping[str, str]] = {}
    """Reserved keys, which this version does not serve, and what it takes instead of each."""
    decisive: ClassVar[str] = ""
    """The key that decides the meaning of the others: if its value is wrong, they are not checked."""

    def __init_subclass__(cls, *, called: str | None = None, **options: Any) -> None:
        """Name the table in messages as `called`, where given."""
        super().__init_subclass__(**options)
        cls.called = called or cls.called

    def __setattr__(self, name: str, value: Any) -> None:
        """Refuse a new value of a key."""
        if not name.startswith("_"):
            raise self._immutable(name, value)
        super().__setattr__(name, value)

    def __delattr__(self, name: str) -> None:
        """Refuse to drop a key."""
        raise self._immutable(name, _MISSING)

    def _immutable(self, name: str, value: Any) -> ProblemError:
        expected = "no change, since problems are immutable: problem.replace({...}) returns a changed one"
        return ProblemError.at(type(self).__name__, name, shown(value), expected)

    def _contradictions(self) -> Iterator[tuple[Place, str]]:
        """Yield place and expectation of each value that contradicts another one of this table."""
        yield from ()

    def _unused(self) -> Iterator[tuple[Place, str]]:
        """Yield place and expectation of each value that the method does not use; a result may have some."""
        yield from ()

    @model_validator(mode="wrap")
    @classmethod
    def _explain(cls, data: Any, handler: ModelWrapValidatorHandler[Self], info: ValidationInfo) -> Self:
        # pydantic merges the errors of inner tables into those of the outer one, so only the outermost may
        # turn them into the package's own exception.
        outermost = not _nested.get()
        token = _nested.set(True)
        try:
            try:
                table = handler(data)
            except ValidationError as error:
                errors = error.errors(include_url=False)
                misspelt = cls._misspelt(errors)
                decided = [found for found in errors if found["loc"] == (cls.decisive,)]
                details = [
                    cls._detail(found)
                    for found in decided or errors
                    if not (_echo(found) or (found["type"] == "missing" and found["loc"] in misspelt))
                ]
            else:
                unused = () if (info.context or {}).get("of_result") else table._unused()
                details = [
                    InitErrorDetails(type=unexpected(phrase), loc=place, input=value_at(table, place))
                    for place, phrase in (*unused, *table._contradictions())
                ]
                if not details:
                    return table
        finally:
            _nested.reset(token)
        wrong = ValidationError.from_exception_data(cls.__name__, details)
        if not outermost:
            raise wrong
        source = (info.context or {}).get("source") or cls.__name__
        mistakes = [
            Mistake(key_path(data, found["loc"]), shown(found["input"]), found["msg"])
            for found in _refusals_first(wrong.errors(include_url=False))
        ]
        raise ProblemError(str(source), mistakes) from None

    @classmethod
    def _misspelt(cls, errors: Sequence[ErrorDetails]) -> set[Place]:
        """Return those keys of this table that unknown keys are probably meant for."""
        unknown = [found["loc"] for found in errors if found["type"] == "extra_forbidden"]
        meant = (closest(str(place[0]), cls.model_fields) for place in unknown if len(place) == 1)
        return {(name,) for name in meant if name is not None}

    @classmethod
    def _detail(cls, found: ErrorDetails) -> InitErrorDetails:
        """Return an error of pydantic in the words of a problem file."""
        kind, place, value = found["type"], found["loc"], found["input"]
        context = found.get("ctx", {})
        reserved = kind == "reserved"
        if kind in ("expected", "reserved"):
            phrase = found["msg"]
        elif kind == "extra_forbidden":
            keys, unknown = list(cls.model_fields), str(place[-1])
            reserved = unknown in cls.later
            phrase = cls.later.get(
                unknown, f"one of the keys of {cls.called}: {', '.join(keys)}{nearest(unknown, keys)}"
            )
        elif kind == "missing":
            field = cls.model_fields.get(str(place[0])) if len(place) == 1 else None
            about = f" ({field.description})" if field and field.description else ""
            phrase, value = f"a value{about}: the key is required", _MISSING
        elif kind == "choice" and isinstance(value, Mapping):
            key = context["key"]
            place, value = (*place, key), value.get(key, _MISSING)
            own = part_names(context["kind"]) if context["kind"] else []
            phrase = _one_of([*context["choices"].split(","), *own], value)
            if value in context["later"].split(","):
                reserved, phrase = True, f"{phrase}; that one is reserved for a later version"
        elif kind == "literal_error":
            phrase = _one_of(re.findall("'([^']+)'", context["expected"]), value)
        elif kind == "tuple_type" and isinstance(value, Mapping):
            phrase = "an array of tables: [[...]] with two brackets, one for each entry"
        elif kind in _PHRASES:
            phrase = _PHRASES[kind].format_map(context)
        else:
            phrase = found["msg"][:1].lower() + found["msg"][1:]
        return InitErrorDetails(type=unexpected(phrase, reserved=reserved), loc=place, input=value)


def _refusals_first(errors: Sequence[ErrorDetails]) -> list[ErrorDetails]:
    """Return the errors, reserved keys first; of reserved keys with one message only the first stays."""
    refused = {
        (found["loc"][:-1], found["msg"]): found for found in reversed(errors) if found["type"] == "reserved"
    }
    return [*reversed(refused.values()), *(found for found in errors if found["type"] != "reserved")]


def increasing(key: str, times: list[float]) -> Iterator[tuple[Place, str]]:
    """Yield each entry of the array `key` whose time is not later than the one before."""
    for i in range(1, len(times)):
        if times[i] <= times[i - 1]:
            yield (key, i, "time"), f"a time after that of the entry before, {times[i - 1]:g} s"


def unique(key: str, within: str, names: Sequence[str | int]) -> Iterator[tuple[Place, str]]:
    """Yield each entry of the array `key` whose name is that of an earlier one."""
    seen: set[str | int] = set()
    for i, name in enumerate(names):
        if name in seen:
            yield (key, i, within), "a name that no other entry has"
        seen.add(name)


def known_names(
    place: Place, names: Iterable[str], known: Mapping[str, Any], key: str | None = None
) -> Iterator[tuple[Place, str]]:
    """Yield each name, or the value of `key` at `place`, that is not among the known ones."""
    for i, name in enumerate(names):
        if name not in known:
            some = quoted(list(known)[:8]) + (", ..." if len(known) > 8 else "")
            yield (*place, i if key is None else key), f"the name of one of {some}{nearest(name, known)}"


def _one_of(choices: Sequence[str], value: Any) -> str:
    hint = nearest(value, choices) if isinstance(value, str) else ""
    return f"{'one of ' if len(choices) > 1 else ''}{quoted(choices)}{hint}"


def _echo(found: ErrorDetails) -> bool:
    """Whether an array only seems too short because an entry with an error of its own was left out."""
    return found["type"] == "too_short" and len(found["input"]) >= found["ctx"]["min_length"]


IN_FILE = "in file "
"""What begins a place that is in another file; no key has blanks."""


def key_path(data: Any, place: Place) -> str:
    """Return a place in a table, or in the mapping it is made from, as ``obstacle[1] ("right cube").size``.

    The tags of unions, ``"<...>"`` before a deeper key, are left out. What begins with :data:`IN_FILE` is a place in
    another file, which the table names, and is told without the keys before it.
    """
    path = ""
    for depth, part in enumerate(place):
        if isinstance(part, int):
            data = data[part] if isinstance(data, list | tuple) and part < len(data) else None
            name = entry(data, "name")
            path += f"[{part}]" + (f' ("{_line(name, 40)}")' if isinstance(name, str) else "")
        elif part.startswith(IN_FILE):
            return _line(part.removeprefix(IN_FILE), 240)
        elif part.startswith("<") and depth + 1 < len(place) and entry(data, part) is None:
            continue
        else:
            data = entry(data, part)
            path += ("." if path else "") + _line(part, 120)
    return path or "problem"


def shown(value: Any) -> str:
    """Return a value as a problem file has it, on one short line."""
    if value is _MISSING or value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{_line(value, 60)}"'
    if isinstance(value, Mapping | BaseModel):
        keys = list(value) if isinstance(value, Mapping) else list(type(value).model_fields)
        return "a table of " + _line(", ".join(map(str, keys)), 60) if keys else "an empty table"
    if isinstance(value, list | tuple):
        if len(value) > 6:
            return f"an array of {len(value)}"
        if any(isinstance(item, Mapping | BaseModel | list | tuple) for item in value):
            return f"an array of {len(value)} arrays or tables"
        return f"[{', '.join(shown(item) for item in value)}]"
    try:
        return _line(str(value), 60)
    except ValueError:
        return "an integer of thousands of digits"


def value_at(table: Table, place: Place) -> Any:
    """Return the value at a place of a table."""
    value: Any = table
    for part in place:
        value = value[part] if isinstance(part, int) else entry(value, part)
    return value


def _line(text: str, length: int) -> str:
    text = "".join(letter if letter.isprintable() else " " for letter in text)
    return text if len(text) <= length else text[: length - 3] + "..."
