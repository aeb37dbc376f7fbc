"""The end effector's coordinates, eqs. (11) and (16): position by axes, attitude by rotation vectors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca

from vgtm_qp.arrays import Array
from vgtm_qp.errors import GoalError, nearest

PositionRotation = tuple[Any, Any]
"""A position and a rotation, or their rates."""

_ROWS = {
    "position": ("tip x", "tip y", "tip z"),
    "pointing": ("tip direction 1", "tip direction 2"),
    "orientation": ("tip rotation x", "tip rotation y", "tip rotation z"),
    "x": ("tip x",),
    "y": ("tip y",),
    "z": ("tip z",),
}
_AXES = {"tip x": 0, "tip y": 1, "tip z": 2}

_TINY = 1e-30
"""Added under a square root to keep it smooth at zero."""

_SHORT_WAY = 0.01
"""Displacement of the tip in a step, over the arm's unit, below which its progress has a larger weight.

Above this value the weight is the square of the displacement. The other objectives have forces that do not
shrink with the displacement, so that with its square alone the last micrometres would never be covered. Below
this value the weight is therefore the product of displacement and value. On a path of zero length any
positive weight will do.
"""

_NO_WAY = 1e-6
"""Displacement, over the arm's unit, that counts as zero."""

_CLOSED = 2e-8
"""Tip error that a motion need not close, m, for arms of a fineness of 1: twice the tolerance at a unit of 1 m."""

_OPPOSITE = 1e-9
"""Angle from the opposite direction, rad, below which half a turn about any axis will do."""

_HALF_TURN = 1e-4
"""Sine of a turn near half a turn below which its axis is that of the rotation's symmetric part."""


class TipGoal(NamedTuple):
    """A goal pose of the end effector, and its rates.

    Attributes
    ----------
    position, velocity : (3,)
        m, and m per unit of the path variable or of progress.
    rotation : (3, 3)
    spin : (3,)
        Angular velocity in the base frame, rad per unit of the path variable or of progress.
    """

    position: Array
    rotation: Array
    velocity: Array
    spin: Array

    def over(self, span: float) -> TipGoal:
        """Return the goal with rates per unit of progress along a piece of path of that `span`."""
        if span == 1.0:
            return self
        return TipGoal(self.position, self.rotation, self.velocity * span, self.spin * span)


def row_names(track: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the rows of the tracked coordinates.

    Raises
    ------
    GoalError
        A name is unknown, or coordinates are given twice.
    """
    for name in track:
        if name not in _ROWS:
            raise GoalError(f'cannot track "{name}"{nearest(name, _ROWS)}; choices: {", ".join(_ROWS)}')
    rows = tuple(row for name in track for row in _ROWS[name])
    if len(set(rows)) < len(rows) or {"pointing", "orientation"} <= set(track):
        raise GoalError(f"the end effector's coordinates {list(track)} name one coordinate twice")
    return rows


def axes(rows: Sequence[str]) -> list[int]:
    """Return the axes, 0 to 2, of the rows that are positions."""
    return [_AXES[row] for row in rows if row in _AXES]


def unit(row: str) -> str:
    """Return the unit of a row."""
    return "m" if row in _AXES else "rad"


def turned_axes(rows: Sequence[str], rotation: Any) -> Any:
    """Return (r, 3) the axes of the tracked turns of the tip: r = 0, 2 (across its z-axis) or 3."""
    if "tip direction 1" in rows:
        return rotation[:, :2].T
    if "tip rotation x" in rows:
        return ca.DM.eye(3)
    return ca.DM(0, 3)


def combined(rows: Sequence[str], position: Any, spin: Any, rotation: Any) -> Any:
    """Return the rows (n_e, n) of the end effector's rate, eqs. (3), (4) and (16)-(18): J, that is [J_u J_c].

    `position` and `spin` are the derivatives (3, n) of the tip's velocity and angular velocity by the rates
    of n coordinates. The rates of a moving goal, x_e-dot, are combined in the same way.
    """
    return ca.vertcat(position[axes(rows), :], turned_axes(rows, rotation) @ spin)


def error(rows: Sequence[str], position: Any, rotation: Any, goal: Any, turned: Any) -> Any:
    """Return (n_e, 1) goal minus value, eq. (11), m and rad: the pose `goal` (3,), `turned` (3, 3) less the tip's.

    The turn is the vector of the smallest rotation to the goal's direction, or to its orientation.
    """
    if "tip direction 1" in rows:
        twist, cosine = ca.cross(rotation[:, 2], turned[:, 2]), ca.dot(rotation[:, 2], turned[:, 2])
        # All turns to the opposite direction are equal: the tip's own x-axis is the axis.
        turn = _turn(twist, cosine, _OPPOSITE, rotation[:, 0])
    elif "tip rotation x" in rows:
        relative = turned @ rotation.T
        twist, cosine = ca.inv_skew((relative - relative.T) / 2), (ca.trace(relative) - 1) / 2
        turn = _turn(twist, cosine, _HALF_TURN, _axis(relative, twist, cosine))
    else:
        return (goal - position)[axes(rows)]
    return ca.vertcat((goal - position)[axes(rows)], turned_axes(rows, rotation) @ turn)


def _turn(twist: Any, cosine: Any, least: float, axis: Any) -> Any:
    """Return the turn (3,) of a `twist` (3,), its axis times its sine; about `axis` (3,) if near half a turn.

    Near half a turn the sine is below `least`, and the twist is too small to show its axis.
    """
    sine = ca.sqrt(ca.dot(twist, twist) + _TINY)
    angle = ca.atan2(sine, cosine)
    is_half = ca.logic_and(ca.dot(twist, twist) < least**2, cosine < 0)
    return ca.if_else(is_half, angle * axis, twist * (angle / sine))


def _axis(rotation: Any, twist: Any, cosine: Any) -> Any:
    """Return the axis (3,) of a rotation (3, 3) by more than a quarter of a turn, in the sense of its twist (3,)."""
    outer = (rotation + rotation.T) / 2 - cosine * ca.DM.eye(3)
    first = ca.logic_and(outer[0, 0] >= outer[1, 1], outer[0, 0] >= outer[2, 2])
    other = ca.if_else(outer[1, 1] >= outer[2, 2], outer[:, 1], outer[:, 2])
    column = ca.if_else(first, outer[:, 0], other)
    sense = ca.if_else(ca.dot(column, twist) < 0, -1.0, 1.0)
    return column * (sense / ca.sqrt(ca.dot(column, column) + _TINY))


def worth_closing(error: Any, motion: Any, levers: Any, fineness: Any) -> Any:
    """Return an error (n_e, 1), or zeros in a motion (1) if it is within the tolerance of an accepted state.

    The `levers` (n_e, 1) turn the error into lengths, m; `fineness` is that of the arm.

    An arm held on all sides cannot close even such an error, and its QP would be infeasible. With zeros, resting is
    feasible, and the multipliers show the rows that hold the arm.
    """
    closed = ca.logic_and(motion > 0, ca.norm_inf(levers * error) <= _CLOSED * fineness)
    return ca.if_else(closed, ca.DM.zeros(*error.shape), error)


def progress_weight(rate: Any, levers: Any, unit: Any) -> Any:
    """Return the weight of the progress along the path, m^2, from the tip's displacement (n_e, 1) over it.

    The weight is the square of the displacement, except for short ones, see :data:`_SHORT_WAY`. The `levers`
    (n_e, 1) turn the displacement into lengths, m; `unit` is that of the arm, m.
    """
    way = ca.norm_2(levers * rate)
    return ca.if_else(way > _NO_WAY * unit, way * ca.fmax(way, _SHORT_WAY * unit), unit**2)


def progress_gradient(curvature: Any, progress: Any) -> Any:
    """Return the objective's derivative by the progress, m^2, at a `progress`.

    The minimum is at a progress of 2, so that the end of the piece, at 1, is always an active bound.
    """
    return curvature * (progress - 2.0)


def levers(rows: Sequence[str], unit_length: float) -> list[float]:
    """Return the lengths, m, to compare rows' changes by: 1 for positions, the arm's unit for angles."""
    return [1.0 if unit(row) == "m" else unit_length for row in rows]


def along_path(
    rows: Sequence[str],
    tip: PositionRotation,
    goal: PositionRotation,
    rates: PositionRotation,
    motion: Any,
    levers: Any,
    unit: Any,
    fineness: Any,
) -> tuple[Any, Any, Any]:
    """Return what the rows of a tip close (n_e, 1), their rate (n_e, 1) along the path, and the weight of the progress.

    Tip and goal are positions (3, 1) and rotations (3, 3), rates the goal's velocity and spin (3, 1). For the other
    arguments see :func:`worth_closing` and :func:`progress_weight`.
    """
    rate = combined(rows, *rates, tip[1])
    closing = worth_closing(error(rows, *tip, *goal), motion, levers, fineness)
    return closing, rate, progress_weight(rate, levers, unit)


def tip_function(rows: Sequence[str], unit_length: float) -> ca.Function:
    """Return the rows of a tip as a function of numbers, for an arm of that unit, m.

    Arguments: position (3), rotation (3, 3); goal (3), turned (3, 3), velocity and spin (3) of the goal;
    motion, 1 or 0, see :func:`worth_closing`. Results: error (n_e), rate (n_e), axes of the turns (r, 3),
    weight of the progress.
    """
    position, rotation = ca.SX.sym("position", 3), ca.SX.sym("rotation", 3, 3)
    goal, turned = ca.SX.sym("goal", 3), ca.SX.sym("turned", 3, 3)
    velocity, spin = ca.SX.sym("velocity", 3), ca.SX.sym("spin", 3)
    motion = ca.SX.sym("motion")
    of_arm = ca.DM(levers(rows, unit_length)), unit_length, min(1.0, unit_length)
    pairs = (position, rotation), (goal, turned), (velocity, spin)
    closing, rate, weight = along_path(rows, *pairs, motion, *of_arm)
    results = [closing, rate, turned_axes(rows, rotation), weight]
    inputs = [position, rotation, goal, turned, velocity, spin, motion]
    return ca.Function("tip", inputs, [ca.densify(result) for result in results])
