"""After a configuration has settled: its curve is ended at the tip, and the gaps of its stations are measured."""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from vgtm_qp.arm.arm import Pose
from vgtm_qp.arm.symbols import Bound, Constants, Frames
from vgtm_qp.arrays import Array
from vgtm_qp.compiled import Kernel
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.shape import CurveShape
from vgtm_qp.rows import tracking
from vgtm_qp.step.target import base_frame


def ending_function(layout: Layout) -> Bound:
    """Return (vertices (3, V), position (3), rotation (3, 3), normal (3)) -> ended vertices (3, V); 1 if they reverse.

    The curve of the least changed vertices, m, ends at the tip's `position`, and along the z-axis of its `rotation` if
    the direction is tracked. The length of its slope is kept: a projection would shrink it from step to step. It
    reverses if it begins against the base's `normal`, or ends against that axis.
    """
    constants, vertices = Constants(), ca.MX.sym("p", 3, layout.vertices)
    position, rotation, normal = ca.MX.sym("position", 3), ca.MX.sym("rotation", 3, 3), ca.MX.sym("normal", 3)
    axis, ended = rotation[:, 2], vertices
    if layout.ends_at_tip:
        missing = [tracking.gap(position, vertices @ constants.add("place", layout.curve_weights[-1]))]
        if layout.ends_along_tip:
            slope = vertices @ constants.add("slope", layout.curve_slopes[-1])
            missing.append(ca.copysign(ca.norm_2(slope), ca.dot(slope, axis)) * axis - slope)
        ended = vertices + ca.horzcat(*missing) @ constants.add("gain", layout.end_gain)
    legs = zip(layout.legs.tolist(), (normal, axis), strict=False)
    along = [ca.dot(ended[:, after] - ended[:, before], way) for (before, after), way in legs]
    reverses = ca.mmin(ca.vertcat(0.0, *along)) < 0.0
    return constants.bound("ending", [vertices, position, rotation, normal], [ended, reverses])


def traced_shape(layout: Layout) -> CurveShape | None:
    """Return the shape of a curve whose nodes are to be found for its gaps; None if constant tables give them."""
    shape = layout.general
    return shape if shape is not None and (layout.hard_turns or shape.by_arc_length) else None


def gap_function(layout: Layout) -> Bound:
    """Return (X (3, N), vertices (3, V)) -> the greatest gap of a station, m, or turn, times the arm's unit.

    Turns count if they are equalities. If one of the gaps is NaN, so is the greatest. With a :func:`traced_shape` the
    function has two arguments more: ``position`` and ``frame`` of ``CurveRows``, transposed as CasADi reads them.
    """
    constants, arm, tracked = Constants(), layout.arm, layout.tracked
    count, nodes = len(tracked), arm.stations.nodes[tracked]
    X, vertices = ca.MX.sym("X", 3, len(arm.node_names)), ca.MX.sym("p", 3, layout.vertices)
    traced = [ca.MX.sym("position", 3, count), ca.MX.sym("frame", 3, 3 * count)]
    if traced_shape(layout) is None:
        traced = []
    corners, shares, point = ca.SX.sym("nodes", 3, 3), ca.SX.sym("shares", 3), ca.SX.sym("point", 3)
    off = ca.Function("off", [corners, shares, point], [ca.norm_2(tracking.gap(corners @ shares, point))])
    points = traced[0] if traced else vertices @ constants.add("curve_weights", layout.curve_weights)
    means = constants.add("station_weights", arm.stations.weights[tracked])
    errors = [off.map(count)(X[:, nodes.reshape(-1).tolist()], means, points).T]
    if layout.hard_turns:
        rotation, frame, slope = ca.SX.sym("rotation", 3, 3), ca.SX.sym("frame", 3, 3), ca.SX.sym("slope", 3)
        if traced:
            along, way = frame, traced[1]
            # CasADi reads the frame's rows as columns.
            turn, _ = tracking.turns(rotation, frame.T, layout.turns)
        else:
            along, way = slope, vertices @ constants.add("curve_slopes", layout.curve_slopes)
            turn, *_ = tracking.slope_rows(rotation, slope)
        of_station = ca.Function("turns", [rotation, along], [ca.densify(turn)]).map(count)
        frames = Frames(arm.home[nodes], arm.stations.frames[tracked], nodes, constants, "station")
        unit = constants.add("unit", np.array([arm.unit]))
        errors.append(unit * ca.fabs(ca.vec(of_station(frames.rotations(X), way))))
    every = ca.vertcat(*errors)
    total = ca.sum1(every)
    # `mmax` skips NaN; the sum keeps it.
    return constants.bound("gap", [X, vertices, *traced], [ca.if_else(total >= 0.0, ca.mmax(every), total)])


class Arrival:
    """Ends the curve of one arm at its tip, and measures the gaps that linear rows leave."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout

    @cached_property
    def _ending(self) -> Kernel:
        return ending_function(self._layout).kernel(compiled=False)

    @cached_property
    def _gap(self) -> Kernel:
        return gap_function(self._layout).kernel(compiled=False)

    def ended(
        self, vertices: Array, position: Array, rotation: Array, base: Pose | None = None
    ) -> tuple[Array, bool]:
        """Return (V, 3) the control vertices whose curve ends at the tip, and whether that curve reverses.

        See :func:`ending_function`; it begins along the normal of a `base` at that pose, or at home.
        """
        layout = self._layout
        if not layout.vertices:
            return vertices, False
        kernel = self._ending
        given = vertices, position, rotation.T, base_frame(layout.arm, base)[:, 2]
        for argument, values in zip(kernel.inputs, given, strict=False):
            argument[:] = values.reshape(-1)
        kernel()
        return kernel.outputs[0].reshape(-1, 3).copy(), bool(kernel.outputs[1][0])

    def gap(self, q: Array, vertices: Array, torsion: Array, base: Pose | None) -> float:
        """Return the greatest gap or turn of a configuration, m, see :func:`gap_function`; NaN without a curve.

        The curve has control vertices (V, 3), m, and torsion (T,), rad. Raises CurveError where it has no frame.
        """
        layout, arm = self._layout, self._layout.arm
        if not layout.vertices:
            return np.nan
        given = [arm.nodes(q), vertices]
        if (shape := traced_shape(layout)) is not None:
            rows = shape.at(vertices, torsion, base_frame(arm, base))
            given += [rows.position, rows.frame]
        kernel = self._gap
        for argument, values in zip(kernel.inputs, given, strict=False):
            argument[:] = values.reshape(-1)
        kernel()
        return float(kernel.outputs[0][0])
