"""A state is held once more against what it must be, by other means than those that made it.

What settles a configuration also measures it. If that measure is wrong for any reason, the state is: so the
configuration is the only thing taken from it here, and quantities and tip are found from that anew.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Arm, Kinematics, Pose
from vgtm_qp.qp.fused import Closed
from vgtm_qp.qp.numbers import beyond, norm
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.task import TipTask

Array = NDArray[np.float64]

_LOOSER = 10.0
"""What was settled to a tolerance is refused from so many times that on.

Rounding never decides then, and what is published of a state still holds.
"""

_ROUNDING = 64.0 * float(np.finfo(float).eps)
"""Of the configuration's norm: quantities found in two ways differ by no more."""


class Acceptance:
    """Holds states of one arm against its quantities, limits and goals.

    Parameters
    ----------
    arm, kinematics
        The latter is evaluated for a tip that has a direction to keep; overwritten then.
    task
        The coordinates of the tip.
    member, tip : float
        What quantities, and tip, m or rad, are settled to.
    """

    def __init__(self, arm: Arm, kinematics: Kinematics, task: TipTask, *, member: float, tip: float) -> None:
        self._arm, self._kinematics, self._task = arm, kinematics, task
        self._base, self._actuators = np.flatnonzero(arm.base), arm.actuators
        self._least, self._greatest = arm.home_quantities.copy(), arm.home_quantities.copy()
        self._member, self._tip = _LOOSER * member, _LOOSER * tip

    def flaw(
        self,
        closed: Closed,
        before: Array,
        base: Pose | None,
        lower: Array,
        upper: Array,
        goal: TipGoal | None,
        *curve: Array,
    ) -> str:
        """Return what is wrong with a configuration, or an empty string.

        Parameters
        ----------
        closed
            The configuration, and its quantities.
        before, base
            Configuration of the state before, and where the base is now; None where it rests.
        lower, upper
            (n_a,) least and greatest values of the actuators.
        goal
            Of the tip; None for a tip that need not be anywhere.
        curve
            Whatever else has to be finite.
        """
        arm, q = self._arm, closed.q
        # NaN passes no comparison with `<=`, and is in every norm.
        size = norm(q.reshape(-1))
        if not size < np.inf or not all(norm(part.reshape(-1)) < np.inf for part in curve):
            return "the new state is not finite"
        rounding = _ROUNDING * size
        X, at = arm.nodes(q), arm.nodes(before if base is None else arm.based(q, base))
        # A base that rests is left alone by everything, so that it cannot drift either.
        spare = 0.0 if base is None else self._member + rounding
        off = norm((X.take(self._base, axis=0) - at.take(self._base, axis=0)).reshape(-1))
        if not off <= spare:
            return f"the new state has its base {off:.3g} m from where it is"
        values, enough = arm.measured(q), self._member + rounding
        self._least[self._actuators], self._greatest[self._actuators] = lower, upper
        out = beyond(values, self._least, self._greatest)
        if not norm(out) <= enough:
            return f"the new state has {self._worst(out)} from the values it may have"
        wrong = values - closed.quantities
        if not norm(wrong) <= enough:
            return f"the new state has {self._worst(wrong)} from the value that it is said to have"
        if goal is not None:
            off = self._tip_error(q, X, goal)
            if not off <= self._tip + rounding:
                return f"the new state has its tip {off:.3g} m or rad from its goal"
        return ""

    def _worst(self, errors: Array) -> str:
        """Return which quantity is furthest off, and how far; of NaN the first."""
        k = int(np.argmax(np.abs(errors)))
        return f"{self._arm.quantity_names[k]} {abs(errors[k]):.3g} m or rad"

    def _tip_error(self, q: Array, X: Array, goal: TipGoal) -> float:
        """Return the greatest error of the tip, m or rad."""
        position, task = self._arm.end_effector.position(X), self._task
        if task.turns is None:
            return norm((goal.position - position)[task.axes])
        self._kinematics.evaluate_quantities(q)
        return task.error(position, self._kinematics.tip_rotation, goal)
