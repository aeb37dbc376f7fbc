"""Everything that is built once for a problem: arm, curve, task, QP layout, engine and clearance monitor."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Arm, Kinematics, Pose
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.solvers import DEFAULT_SOLVER
from vgtm_qp.step.base import BaseMotion
from vgtm_qp.step.engine import Engine
from vgtm_qp.step.state import State, frozen
from vgtm_qp.step.task import TipTask

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Setup:
    """An arm ready to move.

    Attributes
    ----------
    arm : Arm
    kinematics : Kinematics
        Of the arm; overwritten by whoever evaluates it.
    layout, task, engine, monitor
        The QP, the end effector's rows, what solves a step, and what measures clearance.
    control_vertices : (V, 3)
        The curve at home, m.
    safe, self_safe, influence : float
        Least clearance to obstacles and between members, and the distance from which pairs enter the QP, m.
    margin : float
        What the QP keeps over the least clearance, m.
    minimum_angle : float
        Least angle between bodies that meet, rad.
    tip_mode : str
        How strictly the end effector follows its path: ``scaled``, ``hard`` or ``elastic``.
    dt : float
        Duration of a step, s.
    torsion : (T,)
        Torsion coordinates of the curve at home, rad.
    vertex_goals : (V, 3) or None
        Where the problem draws control vertices, m.
    solver : str
        Name of the QP solver.
    jams : tuple of (str, float)
        Actuators that lock later than at the start, and the times, s.
    base_motion : BaseMotion or None
        None where the base rests.
    slow_approach : bool
        Whether members slow down before they touch, and actuators before the ends of their strokes.
    measure : Clearance or None
        What the clearance of a state is measured with where the monitor does not see pairs of members.
    """

    arm: Arm
    kinematics: Kinematics
    layout: Layout
    task: TipTask
    engine: Engine
    monitor: Clearance
    control_vertices: Array
    safe: float
    self_safe: float
    influence: float
    margin: float
    dt: float
    minimum_angle: float = 0.0
    tip_mode: str = "scaled"
    torsion: Array = field(default_factory=lambda: np.zeros(0))
    vertex_goals: Array | None = None
    solver: str = DEFAULT_SOLVER
    base_motion: BaseMotion | None = None
    jams: tuple[tuple[str, float], ...] = ()
    slow_approach: bool = True
    measure: Clearance | None = None

    @property
    def truss(self) -> Truss:
        """The truss, for what knows trusses alone; TrussError for any other arm."""
        return truss_of(self.arm)

    def least_clearance(self, q: Array, time: float, among: str = "all") -> float:
        """Return the exact least surface distance at a configuration, m; see ``Clearance.least``."""
        points = self.arm.points(q)
        if self.measure is None:
            return self.monitor.least(points, time, among=among)[0]
        return self.measure.least(points, time, among=among)[0]

    def base_at(self, time: float) -> Pose | None:
        """Return where the base is at `time`, s; None where it rests."""
        return None if self.base_motion is None else self.base_motion.pose(time)

    def home_state(self) -> State:
        """Return the arm at rest in its home pose at time 0."""
        return State(
            time=0.0,
            q=(home := frozen(self.arm.home_configuration)),
            nodes=self.arm.nodes(home),
            control_vertices=frozen(self.control_vertices),
            torsion=frozen(self.torsion),
            quantities=frozen(self.arm.home_quantities),
            rates=frozen(np.zeros(len(self.arm.quantity_names))),
            motion=frozen(np.zeros_like(home)),
        )
