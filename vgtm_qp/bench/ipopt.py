"""A step as one nonlinear program over the node positions, by IPOPT: the yardstick of general-purpose optimisation.

Clearances enter linearised, as they do in the QP. With exact distances it would take several times as long.
"""

from __future__ import annotations

import numpy as np

from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.bench.tour import Goal
from vgtm_qp.methods.ipopt import NonlinearProgram
from vgtm_qp.methods.resolver import arm_without_curve
from vgtm_qp.problem import Problem
from vgtm_qp.rows.clearance import clearance_rows
from vgtm_qp.rows.limits import actuator_box
from vgtm_qp.step.state import State

_PAIRS = 24


class NonlinearStep:
    """Steps of a truss whose base is at rest: exact lengths and tip, the QP's truss terms."""

    def __init__(self, problem: Problem) -> None:
        self._setup = arm_without_curve(problem)
        # A serial arm is refused.
        truss_of(self._setup.arm)
        self._program = NonlinearProgram(self._setup, _PAIRS, "hard")
        self._state = self._setup.home_state()

    def place(self, state: State) -> None:
        """See :class:`~vgtm_qp.bench.contestants.Contestant`."""
        self._state = state

    def step(self, goal: Goal) -> bool:
        """See :class:`~vgtm_qp.bench.contestants.Contestant`; False where IPOPT fails."""
        setup, state, program = self._setup, self._state, self._program
        arm, monitor = setup.arm, setup.monitor
        k = arm.actuators
        limits = arm.stroke[k], arm.rate[k], arm.acceleration[k]
        box = actuator_box(state.quantities[k], state.rates[k], *limits, setup.dt, state.duration or None)
        near = monitor.near(arm.points(state.q), state.time, setup.influence)
        coefficients, lower = clearance_rows(
            near.distance, near.normal, near.weights, near.is_self, setup.safe, setup.self_safe
        )
        rows, guess = (
            program.rows_over(state.q, near.points, coefficients),
            program.displacement(state.motion),
        )
        answer = program.answer(state.q, box, goal.pose, rows, np.minimum(lower, 0.0), guess)
        if answer is None:
            return False
        self.reached = program.moved(state.q, answer.displacement)
        return True
