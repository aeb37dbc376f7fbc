"""Frames of a URDF file: where its elements are in one another."""

from __future__ import annotations

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.problem.urdf.text import Element, Mistakes

Frame = tuple[Array, Array]
"""An origin (3,), m, and an attitude (3, 3)."""

AT_REST: Frame = (np.zeros(3), np.eye(3))
"""The frame that is the one it is given in."""


class Origins:
    """Where elements are by their <origin>; each is read once, so that its mistakes are told once."""

    def __init__(self, mistakes: Mistakes) -> None:
        self._mistakes = mistakes
        self._known: dict[Element, Frame] = {}

    def of(self, element: Element, what: str) -> Frame:
        """Return the frame of an element; `what` names it where its numbers are wrong."""
        origin = element.first("origin")
        if origin is None:
            return AT_REST
        if origin not in self._known:
            self._known[origin] = self._read(origin, what)
        return self._known[origin]

    def _read(self, origin: Element, what: str) -> Frame:
        """Return what xyz, m, and roll, pitch and yaw about fixed axes, rad, say."""
        zero = (0.0, 0.0, 0.0)
        at = self._mistakes.numbers(origin, what, "xyz", 3, zero) or zero
        turn = self._mistakes.numbers(origin, what, "rpy", 3, zero) or zero
        (sr, sp, sy), (cr, cp, cy) = np.sin(turn), np.cos(turn)
        roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        return np.array(at), yaw @ pitch @ roll


def after(frame: Frame, inner: Frame) -> Frame:
    """Return a frame that is given in another one."""
    return frame[0] + frame[1] @ inner[0], frame[1] @ inner[1]


def inverse(frame: Frame) -> Frame:
    """Return the frame that another one is given in, in that other one."""
    return -frame[1].T @ frame[0], frame[1].T
