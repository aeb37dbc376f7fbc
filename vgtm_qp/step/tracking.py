"""How far stations that are to stay on the curve exactly are from it: what a linear row leaves, and a step must not."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Kinematics, Pose
from vgtm_qp.compiled import Kernel
from vgtm_qp.qp.graph import StationSymbols
from vgtm_qp.qp.layout import Layout
from vgtm_qp.step.target import base_frame

Array = NDArray[np.float64]


class TrackingError:
    """Measures the tracking of a layout with hard rows."""

    def __init__(self, layout: Layout, kinematics: Kinematics) -> None:
        self._layout, self._kinematics = layout, kinematics
        count = len(layout.tracked)
        self._nodes = layout.arm.stations.nodes[layout.tracked].reshape(-1)
        station = StationSymbols(layout)
        nodes, rotation, _, weights, *curve = station.inputs
        if layout.general is not None:
            curve = [curve[0], curve[2]]
        function = ca.Function(
            "station", [nodes, rotation, weights, *curve], [station.gap, ca.densify(station.turn)]
        )
        self._kernel = kernel = Kernel(function.map(count), compiled=False)
        kernel.inputs[2][:] = layout.arm.stations.weights[layout.tracked].reshape(-1)
        kernel.inputs[1].reshape(count, 9)[:] = np.eye(3).reshape(-1)
        if layout.general is None:
            kernel.inputs[4][:] = layout.curve_weights.reshape(-1)
            kernel.inputs[5][:] = layout.curve_slopes.reshape(-1)

    def greatest(self, q: Array, vertices: Array, torsion: Array, base: Pose | None) -> float:
        """Return the greatest gap, m, or turn, rad, that should be zero.

        Parameters
        ----------
        q, vertices, torsion
            Configuration, and the curve's coordinates (V, 3), m, and (T,), rad.
        base
            Where the base is; None where it rests.
        """
        layout, inputs = self._layout, self._kernel.inputs
        tracked, arm, shape = layout.tracked, layout.arm, layout.general
        inputs[0][:] = arm.nodes(q).take(self._nodes, axis=0).reshape(-1)
        if layout.hard_turns:
            self._kinematics.evaluate(q)
            inputs[1][:] = self._kinematics.station_rotation[tracked].transpose(0, 2, 1).reshape(-1)
        if shape is None:
            inputs[3].reshape(len(tracked), -1)[:] = vertices.reshape(-1)
        else:
            rows = shape.rows(vertices, torsion, base_frame(arm, base))
            inputs[3][:] = rows.position.reshape(-1)
            inputs[4][:] = rows.frame.reshape(-1)
        self._kernel()
        gap, turn = self._kernel.outputs
        worst = float(np.abs(gap).max())
        return max(worst, float(np.abs(turn).max())) if layout.hard_turns else worst
