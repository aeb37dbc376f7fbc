"""The end effector's coordinates that a problem tracks, at numbers: eqs. (11) and (16)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Arm, Kinematics
from vgtm_qp.compiled import Kernel
from vgtm_qp.errors import GoalError
from vgtm_qp.rows.tip import TipGoal, axes, row_names, tip_function

Array = NDArray[np.float64]


class TipRows(NamedTuple):
    """Jacobian (n_e, 3 K_tip) w.r.t. the tip's nodes, rate (n_e,) along the path, and error (n_e,) goal minus value."""

    jacobian: Array
    rate: Array
    error: Array


class TipTask:
    """One to six coordinates of the end effector.

    Raises
    ------
    GoalError
        A name is unknown, coordinates are given twice, or the tip has too few nodes to have a direction.
    """

    def __init__(self, track: Sequence[str], arm: Arm) -> None:
        self.track = tuple(track)
        self.row_names = row_names(track)
        self.turns = "pointing" if "pointing" in track else "orientation" if "orientation" in track else None
        self._tip = tip = arm.end_effector
        if self.turns and not tip.has_frame:
            raise GoalError(
                f'"{self.turns}" needs a tip of three or more nodes; this one has {len(tip.nodes)}'
            )
        self.axes = np.array(axes(self.row_names), dtype=np.int64)
        self._rows = Kernel(tip_function(self.row_names), compiled=False)
        self._position_jacobian = np.kron(tip.weights, np.eye(3))[self.axes]

    def residual(
        self, position: Array, rotation: Array, goal: TipGoal, *, motion: bool = False
    ) -> tuple[Array, Array, Array, float]:
        """Return error (n_e,) goal minus value, rate (n_e,) along the path, turned axes (r, 3) and weight of progress.

        The rows of the axes times the tip's angular velocity are the tracked turns. `motion` is whether errors that
        are not worth closing count as zero.
        """
        inputs = self._rows.inputs
        inputs[0][:], inputs[1][:] = position, rotation.T.reshape(-1)
        inputs[2][:], inputs[3][:] = goal.position, goal.rotation.T.reshape(-1)
        inputs[4][:], inputs[5][:] = goal.velocity, goal.spin
        inputs[6][0] = 1.0 if motion else 0.0
        self._rows()
        error, rate, across, weight = self._rows.outputs
        return error.copy(), rate.copy(), across.reshape(3, -1).T.copy(), float(weight[0])

    def error(self, position: Array, rotation: Array, goal: TipGoal) -> float:
        """Return the greatest error, m or rad."""
        return float(np.abs(self.residual(position, rotation, goal)[0]).max(initial=0.0))

    def rows(self, X: Array, kinematics: Kinematics, goal: TipGoal, spin: Array | None = None) -> TipRows:
        """Return the rows at nodes `X` (N, 3), at which the kinematics was evaluated, towards `goal`.

        `spin` (3, 3 K_tip) are the tip's angular-velocity rows if they are to be taken elsewhere.
        """
        error, rate, across, _ = self.residual(self._tip.position(X), kinematics.tip_rotation, goal)
        return TipRows(self.jacobian(across, kinematics.tip_spin if spin is None else spin), rate, error)

    def jacobian(self, across: Array, spin: Array | None) -> Array:
        """Return (n_e, 3 K_tip) the rows' Jacobian, from `residual`'s combination of the tip's `spin` (3, 3 K_tip)."""
        if spin is None or not len(across):
            return np.asarray(self._position_jacobian)
        return np.concatenate([self._position_jacobian, across @ spin])
