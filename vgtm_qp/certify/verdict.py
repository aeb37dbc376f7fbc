"""What is said of a trajectory: whether it is certified, and otherwise where it is wrong or in doubt."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Finding:
    """Something that is wrong, or not decided, from one time to another.

    Attributes
    ----------
    start, end : float
        Times, s. Of a clearance: the first and the last instant at which it was found too small, or the interval in
        which it is not decided.
    kind : str
        ``limit``, ``rate``, ``acceleration``, ``lock``, ``clearance``, ``self-clearance``, ``base`` or ``angle``.
    names : tuple of str
        The joint, or the two bodies.
    value, bound : float
        The worst value found, or what is proven where nothing is decided, and what it has to keep to: rad or m, their
        rates and accelerations, or m.
    """

    start: float
    end: float
    kind: str
    names: tuple[str, ...]
    value: float
    bound: float

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON data; what is infinite is null."""
        return {
            "from": self.start,
            "to": self.end,
            "kind": self.kind,
            "names": list(self.names),
            "value": _finite(self.value),
            "bound": _finite(self.bound),
        }

    def __str__(self) -> str:
        when = f"at {self.start:.6g} s" if self.start == self.end else f"{self.start:.6g} to {self.end:.6g} s"
        return f"{when}: {self.kind} of {' / '.join(self.names)} is {self.value:.6g}; its bound is {self.bound:.6g}"


@dataclass(frozen=True)
class Verdict:
    """What is proven of a trajectory whose joints move linearly between its rows.

    Attributes
    ----------
    certified : bool
        Whether all is proven at every instant: limits, rates, accelerations, locks, and each clearance to be no less
        than asked for, to 1e-9 m.
    clearance, self_clearance : float
        Proven lower bounds over the whole trajectory of the clearance to obstacles, and of links to links, m; infinite
        where there are none. They are as high as the proof needed them to be: the real ones are often greater.
    violations, undecided : tuple of Finding
        What was found to be wrong, and what was neither found to be wrong nor proven to be right.
    time : float
        How long the proof took, s.
    """

    clearance: float
    self_clearance: float
    violations: tuple[Finding, ...]
    undecided: tuple[Finding, ...]
    time: float

    @property
    def certified(self) -> bool:
        """Whether nothing is wrong and nothing is in doubt."""
        return not self.violations and not self.undecided

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON data; what is infinite is null."""
        return {
            "certified": self.certified,
            "clearance": _finite(self.clearance),
            "self_clearance": _finite(self.self_clearance),
            "violations": [finding.to_dict() for finding in self.violations],
            "undecided": [finding.to_dict() for finding in self.undecided],
            "time": self.time,
        }

    def __str__(self) -> str:
        found = [f"violated, {finding}" for finding in self.violations]
        found += [f"undecided, {finding}" for finding in self.undecided]
        bounds = (
            f"{what} at least {value:.6g} m"
            for what, value in (("clearance", self.clearance), ("self-clearance", self.self_clearance))
            if math.isfinite(value)
        )
        head = "certified" if self.certified else "NOT CERTIFIED"
        return "\n".join([", ".join([head, *bounds]), *(f"  {line}" for line in found)])


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
