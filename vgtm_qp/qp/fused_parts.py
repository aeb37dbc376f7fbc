"""What both compiled functions of a step have in common, for arms whose bays can be eliminated one after another."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.qp.graph import Constants, Frames
from vgtm_qp.qp.layout import Layout

Array = NDArray[np.float64]

AXES = {"tip x": 0, "tip y": 1, "tip z": 2}
TINY = 1e-30
"""A square that keeps the root of another one smooth at zero."""


@dataclass(frozen=True, eq=False)
class Bound:
    """A CasADi function and the constants to bind to its last arguments."""

    function: ca.Function
    constants: list[Array]


class Symbols:
    """Arguments that both functions share."""

    def __init__(self, layout: Layout) -> None:
        truss = layout.truss
        self.X = ca.MX.sym("X", 3, truss.node_count)
        self.lower = ca.MX.sym("lower", len(truss.actuators))
        self.upper = ca.MX.sym("upper", len(truss.actuators))
        self.constants = Constants()
        self.home_lengths = self.constants.add("home_lengths", truss.home_lengths)
        self.fixed = (~truss.actuated).astype(float)


def tip_frames(layout: Layout, constants: Constants) -> Frames:
    """Return the tip's frame."""
    truss = layout.truss
    return Frames(truss.home[truss.tip][None], truss.tip_frame[None], truss.tip[None], constants, "tip")


def tip_error(names: tuple[str, ...], position: ca.MX, rotation: ca.MX, goal: ca.MX, turned: ca.MX) -> ca.MX:
    """Return goal minus value of the tip's rows (n_e, 1), as ``TipTask.residual`` does."""
    axes = [AXES[name] for name in names if name in AXES]
    parts = [(goal - position)[axes]]
    twist = None
    if "tip direction 1" in names:
        twist, cosine = ca.cross(rotation[:, 2], turned[:, 2]), ca.dot(rotation[:, 2], turned[:, 2])
        across = rotation[:, :2].T
    elif "tip rotation x" in names:
        relative = turned @ rotation.T
        twist, cosine = ca.inv_skew((relative - relative.T) / 2), (ca.trace(relative) - 1) / 2
        across = ca.MX.eye(3)
    if twist is not None:
        sine = ca.sqrt(ca.dot(twist, twist) + TINY)
        parts.append(across @ (twist * (ca.atan2(sine, cosine) / sine)))
    return ca.vertcat(*parts)
