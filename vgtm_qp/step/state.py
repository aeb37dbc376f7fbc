"""The state of an arm between two steps; immutable, so a refused step leaves nothing behind."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from vgtm_qp.arm.arm import Arm, Pose
from vgtm_qp.arrays import Array
from vgtm_qp.geometry.clearance import Pair
from vgtm_qp.qp.answer import Closed

Shortfall = Mapping[Pair, float]
"""Pairs below their clearance, with their distances, m."""


def frozen(array: Array) -> Array:
    """Return a read-only contiguous copy of `array`."""
    return _sealed(np.array(array, dtype=float, order="C"))


def _sealed(array: Array) -> Array:
    """Return `array` itself, read-only from now on; nobody else may write to it."""
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class State:
    """The state of an arm at one time.

    Attributes
    ----------
    time : float
        s.
    q : configuration
        Of the arm, see ``arm.Arm``; of a truss the positions of its nodes.
    nodes : (N, 3)
        Positions of the nodes, m.
    control_vertices : (V, 3)
        Reference curve, m; V = 0 without a curve.
    torsion : (T,)
        Torsion coordinates of the curve's frame, rad.
    quantities : (M,)
        Fixed and actuated quantities: member lengths, m, or joint values.
    rates : (M,)
        Rate of each over the step that led here, per second.
    motion : configuration
        Displacement over that step, which predicts the next step: its QP is linearised at the predicted
        middle.
    duration : float
        Duration of that step, s; 0 at home, where the arm rests.
    shortfall : Shortfall or None
        Pairs below their clearance; None if not computed yet.
    tip : Pose or None
        Pose of the end effector; None if not computed yet.
    late : float
        What rounding left out of `time`, s: the exact time is their sum. Otherwise steps too short for the digits of a
        large `time` would be lost, however many there are.
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
    shortfall: Shortfall | None = None
    late: float = 0.0
    tip: Pose | None = None

    def after(self, duration: float) -> tuple[float, float]:
        """Return `time` and `late` after a step of a `duration`, s."""
        time = math.fsum((self.time, self.late, duration))
        return time, math.fsum((self.time, self.late, duration, -time))

    def next(
        self,
        arm: Arm,
        duration: float,
        closed: Closed,
        vertices: Array,
        torsion: Array,
        shortfall: Shortfall | None = None,
    ) -> State:
        """Return the state of `arm` after a step of a `duration`, s; all arrays are read-only from now on."""
        (time, late), q, quantities = self.after(duration), _sealed(closed.q), _sealed(closed.quantities)
        return State(
            time=time,
            q=q,
            nodes=_sealed(arm.nodes(q)),
            control_vertices=_sealed(vertices),
            torsion=_sealed(torsion),
            quantities=quantities,
            rates=_sealed((quantities - self.quantities) / duration),
            motion=_sealed(q - self.q),
            duration=duration,
            shortfall=shortfall,
            late=late,
            tip=Pose(_sealed(closed.tip_position), _sealed(closed.tip_rotation)),
        )
