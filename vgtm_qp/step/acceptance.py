"""A state is held once more against what it must be, by other means than those that made it.

What settles a configuration also measures it. If that measure is wrong for any reason, the state is: so node positions
are the only thing taken from it here, and lengths and tip are found from them anew.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.truss.kinematics import Kinematics
from vgtm_qp.qp.fused import Closed
from vgtm_qp.step.path import PathPoint
from vgtm_qp.step.task import TipTask

Array = NDArray[np.float64]

_LOOSER = 10.0
"""What was settled to a tolerance is refused from so many times that: rounding never decides, and what is published of
a state still holds."""

_ROUNDING = 64.0 * float(np.finfo(float).eps)
"""Of the furthest coordinate: lengths found in two ways differ by no more."""


class Acceptance:
    """Holds states of one arm against its lengths, limits and goals.

    Parameters
    ----------
    kinematics
        Evaluated for offset joints and for a tip that has a direction to keep; overwritten then.
    home_lengths : (M,)
        Of the members, m; those that are not actuated keep theirs.
    task
        The coordinates of the tip.
    member, tip : float
        What lengths, m, and tip, m or rad, are settled to.
    """

    def __init__(
        self, kinematics: Kinematics, home_lengths: Array, task: TipTask, *, member: float, tip: float
    ) -> None:
        truss = self._truss = kinematics.truss
        self._kinematics, self._task, self._home_lengths = kinematics, task, home_lengths
        self._first, self._last = np.ascontiguousarray(truss.members.T)
        self._base = np.flatnonzero(truss.base)
        self._member, self._tip = _LOOSER * member, _LOOSER * tip

    def flaw(
        self,
        closed: Closed,
        before: Array,
        base: Array | None,
        lower: Array,
        upper: Array,
        goal: PathPoint | None,
        *curve: Array,
    ) -> str:
        """Return what is wrong with a configuration, or an empty string.

        Parameters
        ----------
        closed
            The configuration, and what was said of it.
        before, base
            (N, 3) positions of the state before, and those that base nodes have now; None where they rest, m.
        lower, upper
            (n_a,) least and greatest lengths of the actuators, m.
        goal
            Of the tip; None for a tip that need not be anywhere.
        curve
            Whatever else has to be finite.
        """
        X, truss = closed.X, self._truss
        # NaN passes no comparison with `<=`.
        size = float(np.abs(X).max())
        if not size < np.inf or not all(np.isfinite(part).all() for part in curve):
            return "the new state is not finite"
        rounding = _ROUNDING * size
        # A base that rests is left alone by everything, so that it cannot drift either.
        at, spare = (before, 0.0) if base is None else (base, self._member + rounding)
        off = float(np.abs(X.take(self._base, axis=0) - at.take(self._base, axis=0)).max(initial=0.0))
        if not off <= spare:
            return f"the new state has its base {off:.3g} m from where it is"
        lengths = self._lengths(X)
        wanted = self._home_lengths.copy()
        strokes = lengths[truss.actuators]
        wanted[truss.actuators] = np.minimum(np.maximum(strokes, lower), upper)
        off = float(np.abs(lengths - wanted).max())
        if not off <= self._member + rounding:
            return f"the new state has a member {off:.3g} m from the lengths it may have"
        off = float(np.abs(lengths - closed.lengths).max())
        if not off <= self._member + rounding:
            return f"the new state has a member {off:.3g} m from the length that was told"
        if goal is not None:
            off = float(np.abs(self._tip_error(X, goal)).max(initial=0.0))
            if not off <= self._tip + rounding:
                return f"the new state has its tip {off:.3g} m or rad from its goal"
        return ""

    def _lengths(self, X: Array) -> Array:
        """Return the lengths (M,) at positions `X` (N, 3), m."""
        if self._truss.joints is not None:
            self._kinematics.evaluate_members(X)
            return self._kinematics.lengths
        way = X.take(self._first, axis=0) - X.take(self._last, axis=0)
        return np.asarray(np.sqrt(np.einsum("mc,mc->m", way, way)))

    def _tip_error(self, X: Array, goal: PathPoint) -> Array:
        """Return (n_e,) goal minus value at positions `X` (N, 3), m and rad."""
        truss, kinematics = self._truss, self._kinematics
        if self._task.turns is not None and truss.joints is None:
            kinematics.evaluate_members(X)
        position = truss.tip_weights @ X.take(truss.tip, axis=0)
        return self._task.residual(position, kinematics.tip_rotation, goal)[0]
