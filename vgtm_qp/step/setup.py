"""Everything that is built once for a problem: arm, curve, task, QP layout, engine and clearance monitor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from vgtm_qp.arm.arm import Arm, Kinematics, Pose
from vgtm_qp.arm.carrying import Carried, Carrier
from vgtm_qp.arrays import Array
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.geometry.shapes import Obstacle
from vgtm_qp.qp.layout import Layout
from vgtm_qp.step.arrival import Arrival
from vgtm_qp.step.engine import Engine
from vgtm_qp.step.path import Path
from vgtm_qp.step.state import State, frozen
from vgtm_qp.step.task import TipTask

TOO_LONG = "a node would move further than method.step_limit"
"""Beginning of the reason of a step that is refused for its length."""


@dataclass(frozen=True, eq=False)
class Setup:
    """An arm ready to move.

    Attributes
    ----------
    carrier : Carrier
        The arm with what it carries.
    kinematics : Kinematics
        The arm at one configuration; every call of ``evaluate`` overwrites it.
    layout, task, engine, monitor
        Layout of the QP, task of the end effector, engine of the steps, and monitor of clearance.
    elastic : callable or None
        Returns an engine with elastic tracking, for steps that hard tracking blocks; None if tracking must stay hard
        or is elastic already.
    solver, tracking : str
        Names of the QP solver, and of the method by which stations track the curve.
    control_vertices, torsion : (V, 3), (T,)
        The curve at home, m and rad.
    vertex_goals : (V, 3) or None
        Goals of control vertices in the problem, m; NaN for those without one.
    influence, margin : float
        The distance below which pairs enter the QP, and the margin of the QP's rows for the nonlinearity of a step, m.
    dt, minimum_angle, step_limit : float
        Duration of a step, s, least angle between bodies that meet, rad, and greatest displacement of a node in one
        step, m, infinite without a limit.
    tip_mode : str
        How strictly the end effector follows its path: ``scaled``, ``hard`` or ``elastic``.
    base_motion : Path or None
        Path of the base over time; None if it rests.
    slow_approach : bool
        Whether bodies slow down before they touch, and actuators before the ends of their strokes.
    jams : tuple of (str, float)
        Actuators that lock during the maneuver, and the times, s.
    measure : Clearance or None
        Measures the clearance of a state if the monitor ignores pairs of bodies; None otherwise.
    """

    arm: Arm
    carrier: Carrier
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
        """Return why displacements (N, 3) of the nodes, m, are too large for one step; empty if they are not."""
        moved = float(np.linalg.norm(displacements, axis=1).max())
        return "" if moved <= self.step_limit else f"{TOO_LONG}, {self.step_limit:g} m: by {moved:.3g} m"

    @property
    def safe(self) -> float:
        """Least clearance to obstacles, m."""
        return self.monitor.safe

    @property
    def self_safe(self) -> float:
        """Least clearance between bodies, m."""
        return self.monitor.self_safe

    def put(self, obstacles: Sequence[Obstacle], carried: Sequence[Carried] | None = None) -> None:
        """Put `obstacles` in the place of those that were there, and `carried` in that of what is carried, if given."""
        if carried is not None:
            self.carrier.carry(carried)
        for monitor in (self.monitor, self.measure):
            if monitor is not None:
                monitor.put(obstacles, None if carried is None else self.carrier.bodies)

    @property
    def slows_down(self) -> bool:
        """Whether pairs slow down before contacts and actuators before ends of strokes; needs a tip that may slow."""
        return self.slow_approach and self.tip_mode == "scaled"

    def least_clearance(self, q: Array, time: float, among: str = "all") -> float:
        """Return the exact least clearance at a configuration, m; see ``Clearance.least``."""
        return (self.measure or self.monitor).least(self.carrier.points(q), time, among=among)[0]

    @cached_property
    def arrival(self) -> Arrival:
        """The end of the curve, and the gaps of its stations, once a configuration is settled."""
        return Arrival(self.layout)

    def gap_of(self, state: State) -> float:
        """Return the greatest distance of a station from its curve node in a state, m; see ``Arrival.gap``."""
        return self.arrival.gap(state.q, state.control_vertices, state.torsion, self.base_at(state.time))

    def base_at(self, time: float) -> Pose | None:
        """Return the pose of the base at `time`, s; None if it is at rest."""
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
