"""A state is held once more against what it must be, by other means than those that made it.

What settles a configuration also measures it. If that measure is wrong for any reason, the state is: so the
configuration is the only thing taken from it here, and quantities and tip are found from that anew.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Arm, Kinematics, Pose
from vgtm_qp.qp.fused import Closed
from vgtm_qp.step.path import PathPoint
from vgtm_qp.step.task import TipTask

Array = NDArray[np.float64]

_LOOSER = 10.0
"""What was settled to a tolerance is refused from so many times that on.

Rounding never decides then, and what is published of a state still holds.
"""

_ROUNDING = 64.0 * float(np.finfo(float).eps)
"""Of the furthest coordinate: quantities found in two ways differ by no more."""


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
        self._member, self._tip = _LOOSER * member, _LOOSER * tip

    def flaw(
        self,
        closed: Closed,
        before: Array,
        base: Pose | None,
        lower: Array,
        upper: Array,
        goal: PathPoint | None,
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
        # NaN passes no comparison with `<=`.
        size = float(np.abs(q).max())
        if not size < np.inf or not all(np.isfinite(part).all() for part in curve):
            return "the new state is not finite"
        rounding = _ROUNDING * size
        X = arm.nodes(q)
        # A base that rests is left alone by everything, so that it cannot drift either.
        at, spare = (before, 0.0) if base is None else (arm.based(q, base), self._member + rounding)
        off = X.take(self._base, axis=0) - arm.nodes(at).take(self._base, axis=0)
        if not np.abs(off).max(initial=0.0) <= spare:
            return f"the new state has its base {np.abs(off).max():.3g} m from where it is"
        values, wanted = arm.measured(q), arm.home_quantities.copy()
        actuated = values[self._actuators]
        wanted[self._actuators] = np.minimum(np.maximum(actuated, lower), upper)
        worst = float(np.abs(values - wanted).max())
        if not worst <= self._member + rounding:
            return f"the new state has a member {worst:.3g} m from the lengths it may have"
        worst = float(np.abs(values - closed.quantities).max())
        if not worst <= self._member + rounding:
            return f"the new state has a member {worst:.3g} m from the length that it is said to have"
        if goal is not None:
            if self._task.turns is not None:
                self._kinematics.evaluate_quantities(q)
            worst = self._task.error(arm.end_effector.position(X), self._kinematics.tip_rotation, goal)
            if not worst <= self._tip + rounding:
                return f"the new state has its tip {worst:.3g} m or rad from its goal"
        return ""
