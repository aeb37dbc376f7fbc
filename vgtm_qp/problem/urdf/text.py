"""The text of a URDF file: XML elements that know their lines, and the mistakes that are found in them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from vgtm_qp.errors import Mistake, ProblemError, closest
from vgtm_qp.problem.fields import GREATEST_LENGTH, LEAST_LENGTH, read_bytes
from vgtm_qp.problem.table import shown

_GREATEST_BYTES = 50_000_000
_DEEPEST = 100
_GREATEST_MISTAKES = 100
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)

_KNOWN: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "robot": (("link", "joint", "material"), ("name", "version")),
    "link": (("inertial", "visual", "collision"), ("name", "type")),
    "joint": (
        (
            "origin",
            "parent",
            "child",
            "axis",
            "calibration",
            "dynamics",
            "limit",
            "mimic",
            "safety_controller",
        ),
        ("name", "type"),
    ),
    "collision": (("origin", "geometry"), ("name",)),
    "inertial": (("origin", "mass", "inertia"), ()),
    "mass": ((), ("value",)),
    "inertia": ((), ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")),
    "origin": ((), ("xyz", "rpy")),
    "axis": ((), ("xyz",)),
    "limit": ((), ("lower", "upper", "velocity", "effort", "acceleration", "deceleration", "jerk")),
    "parent": ((), ("link",)),
    "child": ((), ("link",)),
    "mimic": ((), ("joint", "multiplier", "offset")),
    "geometry": (("box", "cylinder", "sphere", "capsule", "mesh"), ()),
    "box": ((), ("size",)),
    "cylinder": ((), ("radius", "length")),
    "sphere": ((), ("radius",)),
    "capsule": ((), ("radius", "length")),
    "mesh": ((), ("filename", "scale")),
}
"""Of each element the known elements inside it, and its known attributes; other elements are not checked."""
_ALIKE = 0.65
"""Least similarity of a misspelt name: "xzy" counts, but "kinematic", which is in use, not as "inertial"."""
_ONCE = (
    "origin",
    "parent",
    "child",
    "axis",
    "limit",
    "mimic",
    "geometry",
    "inertial",
    "mass",
    "inertia",
)
"""Elements that may stand at most once inside another."""


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
    text = read_bytes(file, _GREATEST_BYTES)
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
    """The mistakes of one file, gathered for one report; ProblemError as soon as there are very many."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._found: list[Mistake] = []

    def add(self, place: Element, what: str, value: str | None, expected: str) -> None:
        """Add a mistake at an element; `what` names the link or joint, and its part, that has the value."""
        where = f"line {place.line}" + (f", {what}" if what else "")
        self._found.append(Mistake(where, shown(value), expected))
        if len(self._found) == _GREATEST_MISTAKES:
            self.stop()

    def stop(self) -> None:
        """Raise ProblemError if there are mistakes."""
        if self._found:
            raise ProblemError(str(self.file), self._found)

    def spelling(self, element: Element, what: str) -> None:
        """Add misspelt elements and attributes, and elements that stand twice, at any depth.

        Otherwise a misspelt body or limit would be ignored silently.
        """
        for inner in element.walk():
            elements, attributes = _KNOWN.get(inner.tag, ((), ()))
            tags = [child.tag for child in inner.children]
            for child, tag in zip(inner.children, tags, strict=True):
                if (meant := _misspelt(tag, elements)) is not None:
                    self.add(child, what, f"<{tag}>", f"<{meant}>, or another name than one so like it")
                elif tag in _ONCE and inner.tag in _KNOWN and child is not inner.children[tags.index(tag)]:
                    self.add(child, what, f"<{tag}>", f"one <{tag}> in a <{inner.tag}>")
            for name in inner.attributes:
                if (meant := _misspelt(name, attributes)) is not None:
                    where = what if inner is element else f"{what}, <{inner.tag}>"
                    self.add(inner, where, name, f"{meant}, or another name than one so like it")

    def numbers(
        self, element: Element, what: str, key: str, count: int, default: tuple[float, ...] | None = None
    ) -> tuple[float, ...] | None:
        """Return `count` finite numbers of an attribute; `default` if missing, None if they are wrong."""
        text = element.attributes.get(key)
        expected = "a finite number" if count == 1 else f"{count} finite numbers with blanks between them"
        what = f"{what}, <{element.tag}> {key}"
        if text is None:
            if default is None:
                self.add(element, what, None, expected)
            return default
        parts = text.split()
        values = tuple(map(float, parts)) if all(map(_NUMBER.fullmatch, parts)) else ()
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
        if values is not None and min(values) >= LEAST_LENGTH:
            return values
        if values is not None:
            said = "a length" if count == 1 else "lengths"
            self.add(
                element,
                f"{what}, <{element.tag}> {key}",
                element.attributes[key],
                f"{said} greater than 0, m: {LEAST_LENGTH:g} or more",
            )
        return (1.0,) * count


def _misspelt(name: str, known: tuple[str, ...]) -> str | None:
    """Return the known name that a name is probably meant for, at most one letter longer or shorter."""
    meant = None if name in known else closest(name, known, alike=_ALIKE)
    return meant if meant is not None and abs(len(meant) - len(name)) <= 1 else None
