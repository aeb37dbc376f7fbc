"""What is said of a trajectory: certified, or where it is wrong or in doubt."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from vgtm_qp.notebook import html_table


@dataclass(frozen=True)
class Finding:
    """Something that is wrong, or neither proven nor refuted, from one time to another.

    Attributes
    ----------
    start, end : float
        Interval, s, in which the limit is violated at least once, or is in doubt.
    kind : str
        ``limit``, ``rate``, ``acceleration``, ``lock``, ``clearance``, ``self-clearance``, ``angle`` or ``motion``.
    names : tuple of str
        The joint or actuator; the body and the obstacle; or the two bodies.
    value, bound : float
        Worst value found, or the proven bound if undecided; and the limit. Lengths and clearances in m,
        joints in rad or m, rates and accelerations of these over s and s^2. NaN for kind ``motion``.
    at : float
        Time of that value, s; NaN if undecided.
    reason : str
        Why it is undecided; empty if the proof merely did not come to an end.
    """

    start: float
    end: float
    kind: str
    names: tuple[str, ...]
    value: float
    bound: float
    at: float = math.nan
    reason: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as JSON data; NaN and infinity become null."""
        found = {
            "from": self.start,
            "to": self.end,
            "kind": self.kind,
            "names": list(self.names),
            "value": _finite(self.value),
            "bound": _finite(self.bound),
            "at": _finite(self.at),
        }
        return found | ({"reason": self.reason} if self.reason else {})

    def __str__(self) -> str:
        when = f"{self.start:.6g} to {self.end:.6g} s" if self.end > self.start else f"at {self.start:.6g} s"
        parts = [f"{when}: {self.kind} of {' / '.join(self.names)}"]
        if math.isfinite(self.value):
            known = f"is {self.value:.6g}" if math.isfinite(self.at) else f"is {self.value:.6g} or more"
            parts.append(known + (f" at {self.at:.6g} s" if math.isfinite(self.at) else ""))
        if math.isfinite(self.bound):
            parts.append(f"its bound is {self.bound:.6g}")
        return ", ".join(parts) + (f": {self.reason}" if self.reason else "")


@dataclass(frozen=True)
class Verdict:
    """What is proven of a trajectory whose joints or actuators move linearly between its rows.

    Attributes
    ----------
    certified : bool
        Whether it is proven that at every instant all limits, rates, accelerations and locks hold and every clearance
        is at least the one asked for, to 1e-9 m.
    clearance, self_clearance : float
        Proven lower bounds over the whole trajectory of the clearance to obstacles and of that between bodies of the
        arm, m: infinite without anything to keep clear of, minus infinite if the motion is unknown.
    violations, undecided : tuple of Finding
        What was refuted; and what was neither proven nor refuted.
    time : float
        Duration of the proof, s.
    notes : tuple of str
        What the proof leaves out, and why.
    """

    clearance: float
    self_clearance: float
    violations: tuple[Finding, ...]
    undecided: tuple[Finding, ...]
    time: float
    notes: tuple[str, ...] = ()

    @property
    def certified(self) -> bool:
        """Whether nothing is wrong and nothing is in doubt."""
        return not self.violations and not self.undecided

    @property
    def answer(self) -> str:
        """``certified``, ``violated`` or ``undecided``."""
        if self.certified:
            return "certified"
        return "violated" if self.violations else "undecided"

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as JSON data; NaN and infinity become null."""
        return {
            "certified": self.certified,
            "answer": self.answer,
            "clearance": _finite(self.clearance),
            "self_clearance": _finite(self.self_clearance),
            "violations": [finding.to_dict() for finding in self.violations],
            "undecided": [finding.to_dict() for finding in self.undecided],
            "time": self.time,
            "notes": list(self.notes),
        }

    def _repr_html_(self) -> str:
        head, *lines = str(self).splitlines()
        return html_table(head, [("note" if self.certified else "FAIL", line.strip()) for line in lines])

    def __str__(self) -> str:
        bounds = [
            f"{what} at least {value:.6g} m"
            for what, value in (("clearance", self.clearance), ("self-clearance", self.self_clearance))
            if math.isfinite(value)
        ]
        head = "certified" if self.certified else f"NOT CERTIFIED, {self.answer}"
        lines = [f"violated, {finding}" for finding in self.violations]
        lines += [f"undecided, {finding}" for finding in self.undecided]
        return "\n".join([", ".join([head, *bounds]), *(f"  {line}" for line in (*lines, *self.notes))])


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
