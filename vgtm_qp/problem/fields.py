"""The kinds of values in a problem file, each with the words for what was expected."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    Field,
    GetCoreSchemaHandler,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WithJsonSchema,
    WrapValidator,
)
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from vgtm_qp.errors import ProblemError, nearest
from vgtm_qp.parts import Kind

# Beyond these, squares of lengths exceed the certificate's tolerances; no arm is that long or that fine.
LEAST_LENGTH = 1e-6
GREATEST_LENGTH = 1e6
SHORTEST_STEP, LONGEST_STEP = 1e-7, 5e7
"""Least and greatest duration of a step of a maneuver, s; a control loop may go a little beyond these."""
ORIGIN = (0.0, 0.0, 0.0)


def unexpected(phrase: str, *, reserved: bool = False) -> PydanticCustomError:
    """Return the error of a value that is not as in `phrase`, or that is `reserved` in this version."""
    return PydanticCustomError("reserved" if reserved else "expected", phrase)


def expect(phrase: str) -> WrapValidator:
    """Return an annotation whose message for every wrong value of a type is `phrase`."""

    def validate(value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
        try:
            return handler(value)
        except ValidationError:
            raise unexpected(phrase) from None

    return WrapValidator(validate)


def quoted(names: Iterable[str]) -> str:
    """Return the names as ``"a", "b", "c"``."""
    return ", ".join(f'"{name}"' for name in names)


class Within:
    """Annotation of an integer or finite number with bounds such as ``ge=0``; `phrase` is the message."""

    def __init__(self, phrase: str, **bounds: Any) -> None:
        self.phrase, self.bounds = phrase, bounds

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        finite = None if source is int else False
        bounds = Field(strict=True, allow_inf_nan=finite, **self.bounds)
        return handler(Annotated[source, bounds, expect(self.phrase)])


def count(least: int, greatest: int) -> Within:
    """Return the annotation of an integer from `least` to `greatest`."""
    return Within(f"an integer from {least} to {greatest}", ge=least, le=greatest)


class ByKey:
    """Annotation of a union of tables, of which the value of one key picks one.

    The key is a ``Literal`` of strings in each table; it may be missing if a table has a default for it, unless it has
    to be `in_file`. If given, `pick` returns the table for a value, or None, instead. Values `later` are reserved:
    messages say that this version does not serve them. Messages name the user's own parts of a `kind` as well.
    """

    def __init__(
        self,
        key: str,
        pick: Callable[[Any], type[BaseModel] | None] | None = None,
        *,
        later: Iterable[str] = (),
        in_file: bool = False,
        kind: Kind | None = None,
    ) -> None:
        self._in_file, self._kind = in_file, kind
        self.key, self.pick, self.later = key, pick or self._by_key, ",".join(later)
        # Both are read from the tables of the union when its schema is built.
        self.tables: dict[str, type[BaseModel]] = {}
        self.default: str | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        tables = get_args(source)
        for table in tables:
            field = table.model_fields[self.key]
            self.tables |= dict.fromkeys(get_args(field.annotation), table)
            self.default = self.default if self._in_file or field.is_required() else field.default
        return core_schema.tagged_union_schema(
            {_tag(table): handler.generate_schema(table) for table in tables},
            lambda value: _tag(self.pick(value)),
            custom_error_type="choice",
            custom_error_message="a table",
            custom_error_context={
                "key": self.key,
                "choices": ",".join(self.tables),
                "later": self.later,
                "kind": self._kind or "",
            },
        )

    def _by_key(self, value: Any) -> type[BaseModel] | None:
        chosen = entry(value, self.key)
        chosen = self.default if chosen is None and isinstance(value, Mapping) else chosen
        return self.tables.get(chosen) if isinstance(chosen, str) else None


def _tag(table: type[BaseModel] | None) -> str | None:
    """Return the tag of a table; its brackets distinguish it from a key in the place of a mistake."""
    return None if table is None else f"<{table.__name__}>"


def entry(table: Any, key: str) -> Any:
    """Return the value of a key of a table, or of the mapping that it is made from; None if it is missing."""
    if isinstance(table, Mapping):
        return table.get(key)
    return getattr(table, key, None) if isinstance(table, BaseModel) else None


def exactly(size: int, phrase: str) -> WrapValidator:
    """Return an annotation whose message for an array of another length than `size` is `phrase`."""

    def validate(value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
        entries = value.tolist() if hasattr(value, "tolist") else value
        if not isinstance(entries, list | tuple) or len(entries) != size:
            raise unexpected(phrase)
        return handler(entries)

    return WrapValidator(validate)


def _ordered(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] >= value[1]:
        raise unexpected("[least, greatest] with the least length first and below the greatest")
    return value


def _edges(value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
    entries = value.tolist() if hasattr(value, "tolist") else value
    if isinstance(entries, list | tuple):
        if len(entries) != 3:
            raise unexpected("one edge length, or three [sx, sy, sz], in metres")
        return handler(entries)
    try:
        return handler((entries, entries, entries))
    except ValidationError:
        raise unexpected("an edge length greater than 0, or three [sx, sy, sz], in metres") from None


def _direction(value: tuple[float, float, float]) -> tuple[float, float, float]:
    if math.hypot(*value) < 1e-9:
        raise unexpected("a direction: three numbers [x, y, z] that are not all zero")
    return value


def read_bytes(file: Path, greatest: int) -> bytes:
    """Return the content of a file of at most `greatest` bytes; ProblemError where it is larger or cannot be read."""
    try:
        if file.stat().st_size > greatest:
            raise ProblemError.at(file, "file", "a huge file", f"less than {greatest // 1_000_000} MB")
        return file.read_bytes()
    except OSError as error:
        raise ProblemError.at(file, "file", error.strerror or "", "a readable file") from None


def _file(value: str, info: ValidationInfo) -> str:
    context = info.context or {}
    folder = Path(context.get("folder") or Path.cwd())
    try:
        path = folder.joinpath(Path(value).expanduser()).absolute()
        found = path.is_file()
    except (OSError, RuntimeError, ValueError):
        raise unexpected("the path of a file") from None
    if not found and context.get("check_files", True):
        try:
            beside = [entry for entry in path.parent.iterdir() if entry.is_file()]
            names = [entry.name for entry in beside if entry.suffix.lower() == path.suffix.lower()]
        except OSError:
            names = []
        raise unexpected(f"a file that exists; there is none at {path}{nearest(path.name, names)}")
    return str(path)


def _array(item: dict[str, Any], size: int) -> WithJsonSchema:
    # Plain `items` with equal bounds, not `prefixItems`: TOML editors know older drafts of JSON Schema only.
    return WithJsonSchema({"type": "array", "items": item, "minItems": size, "maxItems": size})


_COORDINATE = f"a finite number between -{GREATEST_LENGTH:g} and {GREATEST_LENGTH:g}"
_LENGTH = f"a length in metres greater than 0 (from {LEAST_LENGTH:g} to {GREATEST_LENGTH:g})"
_LENGTH_SCHEMA = {"type": "number", "exclusiveMinimum": 0, "maximum": GREATEST_LENGTH}
_COORDINATE_SCHEMA = {"type": "number", "minimum": -GREATEST_LENGTH, "maximum": GREATEST_LENGTH}

Flag = Annotated[bool, Field(strict=True), expect("true or false")]
Number = Annotated[float, Within("a finite number", ge=-1e6, le=1e6)]
Coordinate = Annotated[float, Within(_COORDINATE, ge=-GREATEST_LENGTH, le=GREATEST_LENGTH)]
Length = Annotated[
    float, Within(_LENGTH, ge=LEAST_LENGTH, le=GREATEST_LENGTH), WithJsonSchema(_LENGTH_SCHEMA)
]
Distance = Annotated[float, Within("a distance in metres, 0 or more", ge=0, le=GREATEST_LENGTH)]
Angle = Annotated[
    float, Within("an angle in radians, 0 or more and less than a right angle (1.5708)", ge=0, lt=math.pi / 2)
]
UpperLimit = Annotated[float, Within("a limit greater than 0; leave the key out for no limit", gt=0, le=1e9)]
Kilograms = Annotated[float, Within("a mass in kilograms, 0 or more", ge=0, le=1e9)]
Seconds = Annotated[float, Within("a time in seconds, greater than 0", ge=LEAST_LENGTH, le=1e9)]
Onset = Annotated[float, Within("a time in seconds, 0 or more", ge=0, le=1e9)]
Weight = Annotated[float, Within("a weight, 0 or more", ge=0, le=1e12)]
Factor = Annotated[float, Within("a number greater than 0", gt=0, le=1e6)]
NonNegative = Annotated[float, Within("a number, 0 or more", ge=0, le=1e6)]
Name = Annotated[
    str,
    Field(
        strict=True,
        min_length=1,
        max_length=200,
        pattern=r"^[^\x00-\x1f\x7f]*[^\s\x00-\x1f\x7f][^\x00-\x1f\x7f]*$",
    ),
    expect("a name: a string of 1 to 200 printable characters"),
]
File = Annotated[
    str,
    Field(strict=True, min_length=1, max_length=4096),
    expect("the path of a file, relative to the problem file"),
    AfterValidator(_file),
]
Vector = Annotated[
    tuple[Coordinate, Coordinate, Coordinate],
    exactly(3, "three numbers [x, y, z]"),
    _array(_COORDINATE_SCHEMA, 3),
]
Direction = Annotated[Vector, AfterValidator(_direction), _array(_COORDINATE_SCHEMA, 3)]
Stroke = Annotated[
    tuple[Length, Length],
    exactly(2, "two lengths [least, greatest] in metres"),
    AfterValidator(_ordered),
    _array(_LENGTH_SCHEMA, 2),
]
Edges = Annotated[
    tuple[Length, Length, Length],
    WrapValidator(_edges),
    WithJsonSchema({"anyOf": [_LENGTH_SCHEMA, _array(_LENGTH_SCHEMA, 3).json_schema]}),
]
