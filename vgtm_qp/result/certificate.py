"""The result of a verification: each measured quantity with its tolerance."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from typing import Any, Literal

from vgtm_qp.errors import ResultError
from vgtm_qp.notebook import html_table


@dataclass(frozen=True)
class Measure:
    """One measured quantity.

    Attributes
    ----------
    value : float or None
        The worst value over the maneuver; None if there is nothing to measure (no obstacle, not tracked).
    unit : str
        Its unit.
    bound : float or None
        The tolerance; None if the value is only reported.
    side : "most" or "least"
        Whether `bound` is the greatest or the least value allowed.
    where : str
        The state or step, the member and the obstacle of the worst value.
    """

    value: float | None
    unit: str
    bound: float | None = None
    side: Literal["most", "least"] = "most"
    where: str = ""

    def __post_init__(self) -> None:
        """Replace an infinite clearance by None, and any other value that is not finite by the worst float."""
        if self.value is None or math.isfinite(self.value):
            return
        nothing_near = self.side == "least" and self.value > 0.0
        worst = sys.float_info.max * (-1.0 if self.side == "least" else 1.0)
        object.__setattr__(self, "value", None if nothing_near else worst)

    @property
    def ok(self) -> bool:
        """True if the value is within its bound, or value or bound is missing."""
        if self.value is None or self.bound is None:
            return True
        return self.value <= self.bound if self.side == "most" else self.value >= self.bound

    @property
    def words(self) -> tuple[str, str, str]:
        """Value with unit, bound and place as text; empty where there is none."""
        value = "-" if self.value is None else f"{self.value:.6g} {self.unit}".rstrip()
        return value, "" if self.bound is None else f"(at {self.side} {self.bound:.9g})", self.where

    def __str__(self) -> str:
        return "  ".join(filter(None, self.words))


@dataclass(frozen=True)
class Certificate:
    """Result of ``verify``: worst values over all states of a maneuver, and between them.

    A clearance is the distance of a member's axis from a solid obstacle less the radius, or of two axes less
    both radii: from surface to surface, and minus the radius if the axis is inside, at any depth. Clearances
    between states are proven lower bounds, at most 1e-6 of the mean member or link below the least clearance
    found.

    Attributes
    ----------
    member_error, base_error : Measure
        Greatest deviation of a fixed or locked member from its length, and of a base node from its place in
        the problem, m.
    stroke_violation, rate_violation, acceleration_violation : Measure
        Greatest excess of actuated members over their limits, m, m/s and m/s^2; zero if they keep them.
    clearance, clearance_between : Measure
        Least distance from members to obstacles at the states, and a lower bound of it between them, m.
    self_clearance, self_clearance_between : Measure
        The same between members that share no node, m.
    member_angle : Measure
        Least angle between members that share a node, rad.
    tip_error, tip_direction_error : Measure
        Greatest distance of the tip from its target over the tracked axes, m, and greatest angle between tip and
        target direction or orientation, rad.
    target_error : Measure
        Greatest distance of a tip target from the path that the problem asks for, m.
    array_error : Measure
        Greatest difference between a stored array and the same recomputed from the nodes, m.
    length_singular_value, tip_singular_value : Measure
        Least singular value of the square length Jacobian, and of the tip's translation with respect to the
        actuated lengths, m/m.
    tip_error_per_millimetre : Measure
        Greatest singular value of the latter: mm at the tip for actuator errors whose squares sum to 1 mm^2.
    tracking_gap, states_off_curve : Measure
        Greatest distance of a station from its node on the reference curve, m, and the share of the states in
        which that exceeds 1e-6 of the mean member or link; without the home pose, to which the curve is
        fitted.
    tracking_angle : Measure
        Greatest angle between a station's normal and the curve, rad, if the method keeps normals along the
        curve.
    curve_start_gap, curve_start_angle : Measure
        Greatest distance of the curve's start from the base, m, and angle from the base's normal, rad.
    curve_end_gap, curve_end_angle : Measure
        Greatest distance of the curve's end from the end effector, m, and angle between their directions,
        rad, if the method ties the two.
    fcl_rows, exact_rows : Measure
        Numbers of the solver's clearance rows by FCL and by closed forms: the solver's own count, which the
        states cannot confirm.
    contradictions, notes : tuple of str
        Contradictions within the file or with its problem, and what could not be checked, one line each.
    """

    member_error: Measure
    base_error: Measure
    stroke_violation: Measure
    rate_violation: Measure
    acceleration_violation: Measure
    clearance: Measure
    clearance_between: Measure
    self_clearance: Measure
    self_clearance_between: Measure
    member_angle: Measure
    tip_error: Measure
    tip_direction_error: Measure
    target_error: Measure
    array_error: Measure
    length_singular_value: Measure
    tip_singular_value: Measure
    tip_error_per_millimetre: Measure
    tracking_gap: Measure = Measure(None, "m")
    states_off_curve: Measure = Measure(None, "of the states")
    tracking_angle: Measure = Measure(None, "rad")
    curve_start_gap: Measure = Measure(None, "m")
    curve_start_angle: Measure = Measure(None, "rad")
    curve_end_gap: Measure = Measure(None, "m")
    curve_end_angle: Measure = Measure(None, "rad")
    fcl_rows: Measure = Measure(None, "")
    exact_rows: Measure = Measure(None, "")
    contradictions: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def measures(self) -> dict[str, Measure]:
        """All measures by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, Measure)}

    @property
    def ok(self) -> bool:
        """True if every measure is within its tolerance and there are no contradictions."""
        return not self.failures()

    def failures(self) -> tuple[str, ...]:
        """Return one line for each measure outside its tolerance and each contradiction."""
        broken = [f"{_label(name)}: {measure}" for name, measure in self.measures.items() if not measure.ok]
        return (*broken, *self.contradictions)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data that strict JSON can hold; `from_dict` reads it back."""
        texts = {"contradictions": list(self.contradictions), "notes": list(self.notes)}
        return {"ok": self.ok, **asdict(self), **texts}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Certificate:
        """Read what `to_dict` wrote; ResultError where a measure is missing or is not one."""
        texts = {"contradictions", "notes"}
        try:
            values: dict[str, Any] = {
                f.name: _lines(data[f.name]) if f.name in texts else _measure(data[f.name])
                for f in fields(cls)
                # Files of earlier versions lack measures that have a default.
                if f.name in data or f.default is MISSING or f.name in texts
            }
            return cls(**values)
        except (KeyError, TypeError, OverflowError) as error:
            raise ResultError(f"the certificate is not complete: {error}") from None

    def __str__(self) -> str:
        rows = [
            f"{'ok  ' if measure.ok else 'FAIL'}  {_label(name):<26}  {measure}"
            for name, measure in self.measures.items()
        ]
        rows += [f"FAIL  {line}" for line in self.contradictions]
        rows += [f"note  {line}" for line in self.notes]
        return "\n".join(rows)

    def _repr_html_(self) -> str:
        rows: list[tuple[str, ...]] = [
            ("ok" if measure.ok else "FAIL", _label(name), *measure.words)
            for name, measure in self.measures.items()
        ]
        rows += [("FAIL", line) for line in self.contradictions]
        rows += [("note", line) for line in self.notes]
        return html_table("verified" if self.ok else "VERIFICATION FAILED", rows)


def _lines(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(line, str) for line in value):
        raise TypeError("contradictions and notes are lists of strings")
    return tuple(value)


def _measure(value: Any) -> Measure:
    numbers = (value[key] for key in ("value", "bound"))
    if not all(x is None or (isinstance(x, int | float) and type(x) is not bool) for x in numbers):
        raise TypeError("value and bound of a measure are numbers or null")
    if value["side"] not in ("most", "least") or not all(
        isinstance(value[key], str) for key in ("unit", "where")
    ):
        raise TypeError('the side of a measure is "most" or "least", its unit and place are strings')
    return Measure(**value)


def _label(name: str) -> str:
    return name.replace("_", " ")
