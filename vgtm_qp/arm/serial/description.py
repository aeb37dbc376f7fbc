"""What `vgtm check` tells of a serial arm."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ChainDescription:
    """The counts of a serial arm.

    Attributes
    ----------
    joints, actuated, links, stations : int
    length : float
        Of the way from the base over the joints to the tip at home, m.
    hard : bool
        Whether all stations can keep their positions on the curve at home.
    """

    joints: int
    actuated: int
    links: int
    stations: int
    length: float
    hard: bool

    def __str__(self) -> str:
        """Return two lines."""
        can = "can" if self.hard else "cannot"
        return (
            f"serial arm of {self.joints} joints, {self.actuated} of them actuated, {self.links} links, "
            f"{self.length:.6g} m long\n"
            f"{self.stations} stations track the curve; they {can} keep their positions on it exactly"
        )
