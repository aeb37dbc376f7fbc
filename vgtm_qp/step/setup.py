"""Everything that is built once for a problem: arm, curve, task, QP layout, engine and clearance monitor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vgtm_qp.arm.arm import Arm, Kinematics, Pose
from vgtm_qp.arrays import Array
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.qp.layout import Layout
from vgtm_qp.step.engine import Engine
from vgtm_qp.step.path import Path
from vgtm_qp.step.state import State, frozen
from vgtm_qp.step.task import TipTask

TOO_LONG = "a node would move further than method.step_limit"
"""How the reason of a step begins that is refused for its length."""


@dataclass(frozen=True, eq=False)
class Setup:
    """An arm ready to move.

    Attributes
    ----------
    kinematics : Kinematics
        Of the arm; overwritten by whoever evaluates it.
    layout, task, engine, monitor
        The QP, the end effector's rows, what solves a step, and what measures clearance.
    elastic : callable or None
        Gives what solves a step with elastic tracking where the engine's hard rows have none; None where they have to
        hold, or there are none.
    solver, tracking : str
        Names of the QP solver, and of how stations track the curve.
    control_vertices, torsion : (V, 3), (T,)
        The curve at home, m and rad.
    vertex_goals : (V, 3) or None
        Where the problem draws control vertices, m; NaN for those that it does not.
    safe, self_safe, influence, margin : float
        Least clearance to obstacles and between bodies, the distance from which pairs enter the QP, and what this keeps
        over the clearance for all that is not linear in its step, m.
    dt, minimum_angle, step_limit : float
        Duration of a step, s, least angle between bodies that meet, rad, and greatest displacement of a node in one
        step, m, infinite where it is free.
    tip_mode : str
        How strictly the end effector follows its path: ``scaled``, ``hard`` or ``elastic``.
    base_motion : Path or None
        Of the base over time; None where it rests.
    slow_approach : bool
        Whether bodies slow down before they touch, and actuators before the ends of their strokes.
    jams : tuple of (str, float)
        Actuators that lock later than at the start, and the times, s.
    measure : Clearance or None
        What the clearance of a state is measured with where the monitor does not see pairs of bodies.
    """

    arm: Arm
    kinematics: Kinematics
    layout: Layout
    task: TipTask
    engine: Engine
    elastic: Callable[[], Engine] | None
    monitor: Clearance
    solver: str
    tracking: str
    control_vertices: Array
    torsion: Array
    vertex_goals: Array | None
    safe: float
    self_safe: float
    influence: float
    margin: float
    dt: float
    minimum_angle: float
    step_limit: float
    tip_mode: str
    base_motion: Path | None
    slow_approach: bool
    jams: tuple[tuple[str, float], ...]
    measure: Clearance | None

    def too_long(self, displacements: Array) -> str:
        """Return why nodes (N, 3) may not be displaced so far in one step, m; empty where they may."""
        moved = float(np.linalg.norm(displacements, axis=1).max())
        return "" if moved <= self.step_limit else f"{TOO_LONG}, {self.step_limit:g} m: by {moved:.3g} m"

    @property
    def slows_down(self) -> bool:
        """Whether pairs and actuators slow down before contacts and ends of strokes: the tip has to be allowed to."""
        return self.slow_approach and self.tip_mode == "scaled"

    def least_clearance(self, q: Array, time: float, among: str = "all") -> float:
        """Return the exact least surface distance at a configuration, m; see ``Clearance.least``."""
        return (self.measure or self.monitor).least(self.arm.points(q), time, among=among)[0]

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
