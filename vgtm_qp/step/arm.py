"""Everything that is built once for a problem: truss, curve, task, QP layout, solver and clearance monitor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.qp.layout import Layout
from vgtm_qp.step.attempt import Solver
from vgtm_qp.step.state import State, frozen
from vgtm_qp.step.task import TipTask
from vgtm_qp.truss.kinematics import Kinematics
from vgtm_qp.truss.truss import Truss

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm ready to move.

    Attributes
    ----------
    home_lengths : (M,)
        Member lengths at home, m: what fixed members must keep.
    control_vertices : (V, 3)
        The curve at home, m.
    safe, influence : float
        Least clearance, and the distance from which pairs enter the QP, m.
    dt : float
        Duration of a step, s.
    """

    truss: Truss
    kinematics: Kinematics
    layout: Layout
    task: TipTask
    solver: Solver
    monitor: Clearance
    home_lengths: Array
    control_vertices: Array
    safe: float
    influence: float
    dt: float

    def home_state(self) -> State:
        """Return the arm at rest in its home pose at time 0."""
        return State(
            time=0.0,
            nodes=frozen(self.truss.home),
            control_vertices=frozen(self.control_vertices),
            lengths=frozen(self.home_lengths),
            length_rates=frozen(np.zeros(self.truss.member_count)),
        )
