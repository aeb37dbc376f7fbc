"""The one exception tree of the package; every message names the possible choices."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass


class VgtmError(Exception):
    """Root of every error that this package raises on purpose."""


@dataclass(frozen=True)
class Mistake:
    """One mistake in a problem file: where it stands, what was found and what was expected."""

    key: str
    value: str
    expected: str

    def __str__(self) -> str:
        found = f": found {self.value}" if self.value else ""
        return f"{self.key}{found}; expected {self.expected}"


class ProblemError(VgtmError):
    """A problem, or the file it was read from, is wrong; one :class:`Mistake` per mistake."""

    def __init__(self, source: str, mistakes: Sequence[Mistake]) -> None:
        self.source = source
        self.mistakes = tuple(mistakes)
        super().__init__("\n".join(f"{source}: {mistake}" for mistake in self.mistakes))

    @classmethod
    def at(cls, source: object, key: str, value: str, expected: str) -> ProblemError:
        """Return the error of one mistake."""
        return cls(str(source), [Mistake(key, value, expected)])

    def __reduce__(self) -> tuple[type[ProblemError], tuple[str, tuple[Mistake, ...]]]:
        return type(self), (self.source, self.mistakes)


class TrussError(VgtmError):
    """A truss is not statically determinate, or its description contradicts itself."""


class CurveError(VgtmError):
    """A reference curve cannot be built or evaluated as asked."""


class GoalError(VgtmError):
    """A goal is not a number, has the wrong shape, or asks for what the arm cannot do at all."""


class SolverError(VgtmError):
    """A QP solver is unknown or not installed, or its answer failed the residual check."""


class EvaluationError(SolverError):
    """A function of the arm could not be evaluated at its arguments, at a singular matrix for one."""


class ResultError(VgtmError):
    """A result file is cut, altered, or of another version."""


class AlteredResultError(ResultError):
    """A result file whose content was changed after it was written."""


class PartError(VgtmError):
    """A part of one's own, such as a module or a solver, cannot be registered, imported or used."""


class ExportError(VgtmError):
    """A maneuver cannot be written in the wanted form, or replayed there."""


class MissingExtraError(VgtmError):
    """An optional dependency is absent; the message holds the pip line that brings it."""

    def __init__(self, extra: str, package: str) -> None:
        self.extra = extra
        self.package = package
        super().__init__(f"{package} is not installed: pip install 'vgtm-qp[{extra}]'")

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str]]:
        return type(self), (self.extra, self.package)


def closest(name: str, choices: Iterable[str], *, alike: float = 0.55) -> str | None:
    """Return the one of `choices` that `name` is probably meant for, or None.

    `alike` is the least similarity, 0 to 1; in names as short as "box" one wrong letter is already a large
    part.
    """
    return next(iter(difflib.get_close_matches(name, list(choices), n=1, cutoff=alike)), None)


def nearest(name: str, choices: Iterable[str]) -> str:
    """Return ``; did you mean "..."?`` for the closest of `choices`, or an empty string."""
    found = closest(name, choices)
    return "" if found is None else f'; did you mean "{found}"?'
