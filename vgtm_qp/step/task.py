"""The end effector's coordinates as rows of the QP, eqs. (11) and (16); orientation by rotation vectors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.truss.kinematics import Kinematics
from vgtm_qp.errors import GoalError, nearest
from vgtm_qp.qp.numbers import CLOSED
from vgtm_qp.step.path import PathPoint, turn_between, vector_from_rotation

Array = NDArray[np.float64]

_AXES = {"x": 0, "y": 1, "z": 2}
_ROWS = {
    "position": ("tip x", "tip y", "tip z"),
    "pointing": ("tip direction 1", "tip direction 2"),
    "orientation": ("tip rotation x", "tip rotation y", "tip rotation z"),
    "x": ("tip x",),
    "y": ("tip y",),
    "z": ("tip z",),
}


def worth_closing(error: Array) -> Array:
    """Return a tip error (n_e,), or zeros where it is within what an accepted state may have, m or rad.

    An arm that limits and clearances hold on all sides cannot close even that: its QP would have no solution, where
    staying as it is has one whose multipliers tell what holds it.
    """
    return error if float(np.abs(error).max(initial=0.0)) > CLOSED else np.zeros_like(error)


@dataclass(frozen=True)
class TipRows:
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

    def __init__(self, track: Sequence[str], kinematics: Kinematics) -> None:
        for name in track:
            if name not in _ROWS:
                raise GoalError(f'cannot track "{name}"{nearest(name, _ROWS)}; choices: {", ".join(_ROWS)}')
        rows = [row for name in track for row in _ROWS[name]]
        if len(set(rows)) < len(rows) or {"pointing", "orientation"} <= set(track):
            raise GoalError(f"the end effector's coordinates {list(track)} name one coordinate twice")
        self.turns = "pointing" if "pointing" in track else "orientation" if "orientation" in track else None
        if self.turns and not kinematics.has_tip_frame:
            count = len(kinematics.truss.tip)
            raise GoalError(f'"{self.turns}" needs a tip of three or more nodes; this one has {count}')
        self.track = tuple(track)
        self.row_names = tuple(rows)
        self.axes = np.array(
            [_AXES[row[-1]] for row in rows if row in ("tip x", "tip y", "tip z")], dtype=np.int64
        )
        self.base = kinematics.truss.base
        self._kinematics = kinematics
        weights = kinematics.truss.tip_weights
        self._position_jacobian = np.kron(weights, np.eye(3))[self.axes]

    def residual(
        self, position: Array, rotation: Array, goal: PathPoint
    ) -> tuple[Array, Array, Array | None]:
        """Return error (n_e,) goal minus value, rate (n_e,) along the path, and how the angular velocity is combined.

        The last is (r, 3), whose rows times the tip's angular velocity are the tracked turns; None without any.
        """
        error, rate = (goal.position - position)[self.axes], goal.velocity[self.axes]
        if self.turns is None:
            return error, rate, None
        if self.turns == "pointing":
            across = rotation[:, :2].T
            turn = turn_between(rotation[:, 2], goal.rotation[:, 2])
        else:
            across = np.eye(3)
            turn = vector_from_rotation(goal.rotation @ rotation.T)
        return np.concatenate([error, across @ turn]), np.concatenate([rate, across @ goal.spin]), across

    def rows(self, X: Array, goal: PathPoint, spin: Array | None = None) -> TipRows:
        """Return the rows at node positions `X`, at which the kinematics was evaluated, towards `goal`.

        `spin` (3, 3 K_tip) are the tip's angular-velocity rows if they are to be taken elsewhere.
        """
        kinematics = self._kinematics
        error, rate, across = self.residual(kinematics.tip_position(X), kinematics.tip_rotation, goal)
        return TipRows(self.jacobian(across, kinematics.tip_spin if spin is None else spin), rate, error)

    def jacobian(self, across: Array | None, spin: Array | None) -> Array:
        """Return (n_e, 3 K_tip) the rows' Jacobian, from `residual`'s combination of the tip's `spin` (3, 3 K_tip)."""
        if across is None or spin is None:
            return np.asarray(self._position_jacobian)
        return np.concatenate([self._position_jacobian, across @ spin])
