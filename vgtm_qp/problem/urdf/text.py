"""The text of a URDF file: XML elements that know their lines, and the mistakes that are found in them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from vgtm_qp.errors import Mistake, ProblemError
from vgtm_qp.problem.fields import GREATEST_LENGTH
from vgtm_qp.problem.table import shown

_GREATEST_BYTES = 50_000_000
_DEEPEST = 100


@dataclass(eq=False)
class Element:
    """An XML element: tag, attributes, the elements inside it, and its line in the file."""

    tag: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list)

    def all(self, tag: str) -> list[Element]:
        """Return the elements of that tag inside this one."""
        return [child for child in self.children if child.tag == tag]

    def first(self, tag: str) -> Element | None:
        """Return the first element of that tag inside this one, or None."""
        return next(iter(self.all(tag)), None)

    def walk(self) -> Iterator[Element]:
        """Yield this element and all inside it."""
        waiting = [self]
        while waiting:
            element = waiting.pop()
            yield element
            waiting += reversed(element.children)


def read_xml(file: Path) -> Element:
    """Return the root element of a file; ProblemError where it cannot be read."""
    try:
        if file.stat().st_size > _GREATEST_BYTES:
            raise ProblemError.at(file, "file", "a huge file", f"less than {_GREATEST_BYTES // 1_000_000} MB")
        text = file.read_bytes()
    except OSError as error:
        raise ProblemError.at(file, "file", error.strerror or "", "a readable file") from None
    root = Element("", {}, 0)
    opened = [root]
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        if len(opened) > _DEEPEST:
            expected = f"elements at most {_DEEPEST} deep"
            raise ProblemError.at(file, f"line {parser.CurrentLineNumber}", f"<{tag}>", expected)
        element = Element(tag, attributes, parser.CurrentLineNumber)
        opened[-1].children.append(element)
        opened.append(element)

    def refuse(name: str, *_: object) -> None:
        expected = "no document type and no entities of its own"
        raise ProblemError.at(file, f"line {parser.CurrentLineNumber}", f"<!DOCTYPE {name}", expected)

    parser.StartElementHandler, parser.StartDoctypeDeclHandler = start, refuse
    parser.EndElementHandler = lambda _: opened.pop()
    try:
        parser.Parse(text, True)
    except (expat.ExpatError, ValueError, LookupError) as error:
        place = f"line {parser.ErrorLineNumber}"
        code = getattr(error, "code", None)
        said = str(error) if code is None else expat.ErrorString(code)
        raise ProblemError.at(file, place, said, "well-formed XML in UTF-8") from None
    return root.children[0]


class Mistakes:
    """The mistakes of one file, gathered so that they are told together."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._found: list[Mistake] = []

    def add(self, place: Element, what: str, value: str | None, expected: str) -> None:
        """Add a mistake at an element; `what` says of which link or joint, and which part of it, the value is."""
        where = f"line {place.line}" + (f", {what}" if what else "")
        self._found.append(Mistake(where, shown(value), expected))

    def stop(self) -> None:
        """Raise ProblemError if there are mistakes."""
        if self._found:
            raise ProblemError(str(self.file), self._found)

    def numbers(
        self, element: Element, what: str, key: str, count: int, default: tuple[float, ...] | None = None
    ) -> tuple[float, ...] | None:
        """Return `count` finite numbers of an attribute; `default` without it, and None where they are wrong."""
        text = element.attributes.get(key)
        expected = "a finite number" if count == 1 else f"{count} finite numbers with blanks between them"
        what = f"{what}, <{element.tag}> {key}"
        if text is None:
            if default is None:
                self.add(element, what, None, expected)
            return default
        try:
            values = tuple(float(part) for part in text.split())
        except ValueError:
            values = ()
        if len(values) != count or not all(math.isfinite(x) and abs(x) <= GREATEST_LENGTH for x in values):
            self.add(element, what, text, f"{expected}, none beyond {GREATEST_LENGTH:g}")
            return None
        return values

    def length(self, element: Element, what: str, key: str) -> float:
        """Return the length of an attribute, m, greater than 0; 1 where it is wrong."""
        return self.lengths(element, what, key, 1)[0]

    def lengths(self, element: Element, what: str, key: str, count: int) -> tuple[float, ...]:
        """Return `count` lengths of an attribute, m, greater than 0; ones where they are wrong."""
        values = self.numbers(element, what, key, count)
        if values is not None and min(values) > 0.0:
            return values
        if values is not None:
            said = "a length" if count == 1 else "lengths"
            self.add(
                element,
                f"{what}, <{element.tag}> {key}",
                element.attributes[key],
                f"{said} greater than 0, m",
            )
        return (1.0,) * count
