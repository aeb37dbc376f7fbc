"""Acceptance of a new state: its constraints are checked again, by code that did not make it.

The engine that settles a configuration also measures it, so that an error in its measure would go unnoticed.
Here quantities and tip are computed again from the configuration alone.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array, record
from vgtm_qp.qp.answer import Accuracy, Closed, StepSolution
from vgtm_qp.qp.numbers import ClearanceRows, beyond, norm
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State
from vgtm_qp.step.step import WHOLE, Step, StepStatus
from vgtm_qp.step.target import Target

LOOSER = 10.0
"""Error of a state that is refused, over the tolerance of settling.

With this factor rounding never decides, and the published tolerances still hold.
"""

ROUNDING = 64.0 * float(np.finfo(float).eps)
"""Greatest rounding difference between two computations of a quantity, relative to the configuration's norm."""


class Acceptance:
    """Checks states of one arm, settled to an accuracy, for their quantities, limits and goals.

    Attributes
    ----------
    accuracy : Accuracy
    gives_way : bool
        Whether stations may leave the curve where they block the arm.
    """

    def __init__(self, setup: Setup, accuracy: Accuracy) -> None:
        self._arm, self._kinematics, self._task = setup.arm, setup.kinematics, setup.task
        base, self._actuators = np.flatnonzero(setup.arm.base), setup.arm.actuators
        # Base nodes usually come first, and a slice is cheaper than an index array.
        is_first = np.array_equal(base, np.arange(len(base)))
        self._base: slice | NDArray[np.int64] = slice(len(base)) if is_first else base
        self._least, self._greatest = setup.arm.home_quantities.copy(), setup.arm.home_quantities.copy()
        self._member, self._tip = LOOSER * accuracy.member, LOOSER * accuracy.tip
        self.accuracy, self.gives_way = accuracy, setup.elastic is not None

    def gave_way(self, gap: float) -> bool:
        """Return whether stations with that gap, m, are off the curve although tracking is exact."""
        return self.gives_way and not gap <= self.accuracy.tracking

    def passed(
        self,
        state: State,
        progress: float,
        gap: float,
        qps: int,
        solution: StepSolution | None,
        rows: ClearanceRows | None,
    ) -> Step:
        """Return the step to a proven `state` with the `gap` of its stations; the rest are its fields of the QPs."""
        return record(
            Step,
            status=StepStatus.REACHED if progress >= WHOLE else StepStatus.SLOWED,
            progress=progress,
            state=state,
            reason="",
            qps=qps,
            gave_way=self.gave_way(gap),
            gap=gap,
            solution=solution,
            rows=rows,
        )

    def flaw(
        self,
        closed: Closed,
        before: Array,
        target: Target,
        goal: TipGoal | None,
        vertices: Array,
        torsion: Array,
    ) -> str:
        """Return what is wrong with a configuration and its curve (V, 3), m, and (T,), rad, or an empty string.

        `before` is the configuration of the state before; limits and base are those of the `target`. `goal`
        is the tip's goal, None for a free tip. If the tip has a direction, the kinematics is overwritten.
        """
        arm, q, base = self._arm, closed.q, target.base
        # NaN fails every comparison with `<=`, and makes every norm NaN.
        size = norm(q.reshape(-1))
        curve = norm(vertices.reshape(-1)) + (norm(torsion) if len(torsion) else 0.0)
        if not size + curve < math.inf:
            return "the new state is not finite"
        rounding = ROUNDING * size
        X, at = arm.nodes(q), arm.nodes(before if base is None else arm.based(q, base))
        # Nothing moves a base at rest: its nodes must be equal, without a tolerance.
        spare = 0.0 if base is None else self._member + rounding
        off = norm((X[self._base] - at[self._base]).reshape(-1))
        if not off <= spare:
            return f"the new state has its base {off:.3g} m from where it is"
        values, enough = arm.measured(q), self._member + rounding
        self._least[self._actuators], self._greatest[self._actuators] = target.lower, target.upper
        out = beyond(values, self._least, self._greatest)
        if not norm(out) <= enough:
            return f"the new state has {self._worst(out)} from the values it may have"
        wrong = values - closed.quantities
        if not norm(wrong) <= enough:
            return f"the new state has {self._worst(wrong)} from the value that it is said to have"
        if goal is not None:
            off = self._tip_error(X, goal)
            if not off <= self._tip + rounding:
                return f"the new state has its tip {off:.3g} m from its goal"
        return ""

    def _worst(self, errors: Array) -> str:
        """Return the name and error of the quantity with the greatest error, or of the first NaN."""
        k = int(np.argmax(np.abs(errors)))
        return f"{self._arm.quantity_names[k]} {abs(errors[k]):.3g} m or rad"

    def _tip_error(self, X: Array, goal: TipGoal) -> float:
        """Return the norm of the tip's error, m: angles times the arm's unit."""
        if self._task.turns is not None:
            self._kinematics.evaluate_tip(X)
        position = self._arm.end_effector.position(X)
        return self._task.off(position, self._kinematics.tip_rotation, goal)
