"""Newton's iteration that closes a configuration: fixed quantities, actuators in their boxes, stations on the curve."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial

import numpy as np

from vgtm_qp.arm.arm import Kinematics, Newton
from vgtm_qp.arrays import Array
from vgtm_qp.errors import SolverError
from vgtm_qp.qp.answer import Closed
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.settle import MOST_STEPS, TOO_FAR, enough_length

Correct = Callable[[], Array]


def converge(
    q: Array, measure: Callable[[Array], tuple[float, Correct | None]], too_far: float
) -> tuple[Array, float]:
    """Return the configuration to which Newton's method leads, and its error, infinite in a singular pose.

    `measure` returns the error of a configuration and the function that makes the next one, None to stop there. The
    iteration ends at errors of `too_far` or more.
    """
    for count in range(MOST_STEPS + 1):
        worst, correct = measure(q)
        if correct is None or count == MOST_STEPS or not worst < too_far:
            break
        try:
            q = correct()
        except SolverError:
            return q, np.inf
    return q, worst


class Closing:
    """Closes configurations of one arm; each call overwrites the `kinematics`."""

    def __init__(self, layout: Layout, kinematics: Kinematics) -> None:
        self._layout, self._arm, self._kinematics = layout, layout.arm, kinematics
        self._too_far = TOO_FAR * layout.arm.unit
        self._actuators, self._fixed = layout.arm.actuators, ~layout.arm.actuated

    @cached_property
    def _by_quantities(self) -> Newton:
        return self._arm.newton()

    @cached_property
    def _by_stations(self) -> Newton:
        return self._arm.newton(self._layout.tracked)

    def close(
        self, q: Array, lower: Array, upper: Array, tolerance: float, *, too_far: float | None = None
    ) -> Closed:
        """Return the closed configuration near `q`; actuators keep their values, or go to their bounds.

        `lower`, `upper` (n_a,) are the bounds. The error is infinite in a singular pose; the iteration ends
        at errors beyond `too_far`, m or rad.
        """
        kinematics, wanted = self._kinematics, self._arm.home_quantities.copy()

        def missing(_: Array) -> Array:
            wanted[self._actuators] = np.clip(kinematics.quantities[self._actuators], lower, upper)
            return np.asarray(wanted - kinematics.quantities)

        too_far = self._too_far if too_far is None else too_far
        return self._close(q, missing, self._by_quantities, tolerance, too_far)

    def close_on_curve(
        self, q: Array, points: Array, lower: Array, upper: Array, tolerance: float
    ) -> Closed | None:
        """Return the configuration near `q` whose tracked stations are at `points` (K, 3), m; actuators follow.

        Actuators beyond their bounds (n_a,) then go back to these, and move the stations. None in a singular
        pose.
        """
        arm, kinematics, tracked = self._arm, self._kinematics, self._layout.tracked
        home = arm.home_quantities[self._fixed]

        def missing(q: Array) -> Array:
            gap = points - arm.stations.centres(arm.nodes(q))[tracked]
            return np.concatenate([home - kinematics.quantities[self._fixed], gap.reshape(-1)])

        closed = self._close(q, missing, self._by_stations, tolerance, np.inf)
        return self.close(closed.q, lower, upper, tolerance) if closed.error < np.inf else None

    def _close(
        self, q: Array, missing: Callable[[Array], Array], step: Newton, tolerance: float, too_far: float
    ) -> Closed:
        arm, kinematics, enough = self._arm, self._kinematics, enough_length(q, tolerance)

        def measure(q: Array) -> tuple[float, Correct | None]:
            kinematics.evaluate_quantities(q)
            error = missing(q)
            worst = float(np.abs(error).max())
            return worst, None if worst <= enough else partial(step, q, error, kinematics)

        q, worst = converge(q, measure, too_far)
        position = arm.end_effector.position(arm.nodes(q))
        return Closed(q, kinematics.quantities.copy(), worst, position, kinematics.tip_rotation.copy())
