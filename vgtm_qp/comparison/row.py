"""One method on one problem: the limits its maneuver kept, in numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vgtm_qp.maneuver.maneuver import Maneuver

INTERRUPTED = "interrupted"
_DRIFT = 1e-3


@dataclass(frozen=True)
class MethodRow:
    """One method on one problem. Lengths in m, times in s; None if there was nothing to measure.

    Attributes
    ----------
    solved : bool
        The maneuver reached the end of its path and passed verification.
    kept : bool
        It reached the end and kept every limit and clearance, with a tolerance of 1 mm for members and tip: the
        standard for methods without drift correction.
    status : str
        That of the maneuver, ``refused`` (the method cannot be set up for this arm) or ``interrupted``.
    least_clearance : float or None
        From obstacles, over all states and between them.
    tracking_gap : float or None
        Greatest distance of a station from its node of the reference curve.
    reached : float
        Share of the path covered, 0 to 1.
    reason : str
        Step and reason of a breakdown, or the first tolerance that verification found broken.
    actuator_travel : float
        Sum over actuators and steps of the changes of length.
    rank : int or None
        Of the Jacobian of eq. (26) in the last step, where the method reveals it.
    """

    problem: str
    method: str
    solved: bool
    kept: bool
    status: str
    reached: float
    steps: int
    reason: str
    tip_error: float | None = None
    member_drift: float | None = None
    least_clearance: float | None = None
    stroke_violation: float | None = None
    rate_violation: float | None = None
    tracking_gap: float | None = None
    actuator_travel: float | None = None
    step_time: float | None = None
    setup_time: float | None = None
    rank: int | None = None


def make_row(problem: str, method: str, maneuver: Maneuver) -> MethodRow:
    """Return the row of a verified maneuver."""
    certificate = maneuver.certificate
    assert certificate is not None, "a maneuver is verified before it is compared"
    summary, failures = maneuver.summary(), certificate.failures()
    done = maneuver.arrived
    member, tip = certificate.member_error.value or 0.0, certificate.tip_error.value or 0.0
    drifting = max(member, tip) <= _DRIFT
    others = [line for line in failures if not line.startswith(("member error", "tip error"))]
    travel = np.abs(np.diff(maneuver.actuator_values, axis=0)).sum()
    reason = next(iter([*others, *failures]), "") if done else maneuver.stopped_by
    return MethodRow(
        problem=problem,
        method=method,
        solved=maneuver.status == "solved",
        kept=done and drifting and not others,
        status=maneuver.status,
        reached=maneuver.reached,
        steps=maneuver.steps,
        reason=reason,
        tip_error=certificate.tip_error.value,
        member_drift=member,
        least_clearance=maneuver.least_clearance,
        stroke_violation=certificate.stroke_violation.value,
        rate_violation=certificate.rate_violation.value,
        tracking_gap=certificate.tracking_gap.value,
        actuator_travel=float(travel),
        step_time=summary["step_time"]["median"],
        setup_time=summary["setup_time"],
        rank=maneuver.manifest.get("jacobian_rank"),
    )
