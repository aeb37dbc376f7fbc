"""The gap between an arm's stations and its reference curve."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np

from vgtm_qp.arm.arm import Kinematics, Pose
from vgtm_qp.arrays import Array
from vgtm_qp.compiled import Kernel
from vgtm_qp.qp.graph import StationSymbols
from vgtm_qp.qp.layout import Layout
from vgtm_qp.step.target import base_frame


class Gap:
    """Measures the gaps between an arm's stations and its curve's nodes that linear rows leave."""

    def __init__(self, layout: Layout, kinematics: Kinematics) -> None:
        self._layout, self._kinematics = layout, kinematics
        if not layout.hard_turns:
            return
        station, count = StationSymbols(layout), len(layout.tracked)
        _, rotation, _, _, *curve = station.inputs
        # Turns need the slope of a plain curve, or the frame of any other one.
        curve = curve[:3] if layout.general is None else [curve[2]]
        function = ca.Function("turns", [rotation, *curve], [ca.densify(station.turn)])
        self._turns = Kernel(function.map(count), compiled=False)
        if layout.general is None:
            self._turns.inputs[2][:] = layout.curve_weights.reshape(-1)
            self._turns.inputs[3][:] = layout.curve_slopes.reshape(-1)

    def greatest(self, q: Array, vertices: Array, torsion: Array, base: Pose | None) -> float:
        """Return the greatest gap of a configuration, m, or turn, times the arm's unit, if it is an equality.

        Its curve has control vertices (V, 3), m, and torsion (T,), rad.
        """
        layout, arm, shape = self._layout, self._layout.arm, self._layout.general
        points, frames = layout.curve_weights @ vertices, None
        if shape is not None and (layout.hard_turns or shape.by_arc_length):
            rows = shape.at(vertices, torsion, base_frame(arm, base))
            points, frames = rows.position, rows.frame
        off = arm.stations.centres(arm.nodes(q))[layout.tracked] - points
        worst = math.sqrt(np.einsum("kc,kc->k", off, off).max())
        return max(worst, arm.unit * self._greatest_turn(q, vertices, frames)) if layout.hard_turns else worst

    def _greatest_turn(self, q: Array, vertices: Array, frames: Array | None) -> float:
        tracked, inputs = self._layout.tracked, self._turns.inputs
        self._kinematics.evaluate(q)
        inputs[0][:] = self._kinematics.station_rotation[tracked].transpose(0, 2, 1).reshape(-1)
        if frames is None:
            inputs[1].reshape(len(tracked), -1)[:] = vertices.reshape(-1)
        else:
            inputs[1][:] = frames.reshape(-1)
        self._turns()
        return float(np.abs(self._turns.outputs[0]).max())
