"""The state of an arm between two steps; immutable, so a refused step leaves nothing behind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.geometry.clearance import Pair

Array = NDArray[np.float64]


def frozen(array: Array) -> Array:
    """Return a read-only contiguous copy of `array`."""
    copy = np.array(array, dtype=float, order="C")
    copy.setflags(write=False)
    return copy


def sealed(array: Array) -> Array:
    """Return `array` itself, read-only from now on: for one that nobody else writes to."""
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class State:
    """Where the arm is.

    Attributes
    ----------
    time : float
        s.
    q : configuration
        Of the arm, see ``arm.Arm``; of a truss the positions of its nodes.
    nodes : (N, 3)
        Where the nodes are, m.
    control_vertices : (V, 3)
        Reference curve, m; V = 0 without a curve.
    torsion : (T,)
        Torsion coordinates of the curve's frame, rad.
    quantities : (M,)
        Fixed and actuated quantities: member lengths, m, or joint values.
    rates : (M,)
        Rate of each over the step that led here, per second.
    motion : configuration
        Displacement over that step: the guess for the next one, at whose middle it is linearised.
    duration : float
        Duration of that step, s; 0 at home, where the arm rests.
    shortfall : mapping or None
        Pairs that are nearer than they may be, with their distances, m; None where that is not known yet.
    """

    time: float
    q: Array
    nodes: Array
    control_vertices: Array
    quantities: Array
    rates: Array
    motion: Array
    duration: float = 0.0
    torsion: Array = field(default_factory=lambda: frozen(np.zeros(0)))
    shortfall: Mapping[Pair, float] | None = None
