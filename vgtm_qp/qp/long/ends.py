"""The two ends of a long arm as CasADi functions: its tip with the goal, and the base of its curve."""

from __future__ import annotations

import casadi as ca
import numpy as np

from vgtm_qp.arm.arm import tip_frames
from vgtm_qp.arm.symbols import Bound, Constants, Frames, goal_after
from vgtm_qp.qp.fused_rows import leg_rows
from vgtm_qp.qp.layout import Layout
from vgtm_qp.rows import curve as curve_rows
from vgtm_qp.rows import tip as tip_rows


class _Ends:
    """Symbols of both ends.

    Attributes
    ----------
    X, Y : (3, K)
        The tip's nodes, where residuals and where Jacobians are evaluated.
    base, points : (3, 3), (3, V)
        Nodes of the first station when the base has moved; control vertices.
    rotation, spin : (3, 3), (3, 3K)
        Of the tip at `X`, and at `Y`.
    offset, normal : (3, V), (3,)
        Of the curve at the base, see ``ChainData``.
    legs, least : (3 V, G), (G,)
        Rows and bounds of the curve's legs, see ``rows.curve.legs``.
    """

    def __init__(self, layout: Layout) -> None:
        arm, tip, vertices = layout.arm, layout.arm.end_effector, layout.vertices
        self.layout, self._constants = layout, Constants()
        self.X, self.Y = (ca.MX.sym(name, 3, len(tip.nodes)) for name in "XY")
        self.base, self.points = ca.MX.sym("base", 3, 3), ca.MX.sym("p", 3, vertices)
        self.rotation, self.spin = ca.MX.eye(3), ca.MX.zeros(3, self.Y.numel())
        if tip.has_frame:
            frames = tip_frames(arm, self._constants, np.arange(len(tip.nodes)))
            self.rotation, self.spin = frames.rotations(self.X), frames.at(self.Y)[1]
        self.offset, self.normal = ca.MX(3, 0), ca.MX.zeros(3)
        self.legs, self.least = ca.MX.zeros(3 * vertices, 0), ca.MX.zeros(0)
        if vertices:
            home, weights = arm.home[arm.stations.nodes[:1]], ca.DM(arm.stations.weights[0])
            base = Frames(home, arm.stations.frames[:1], np.arange(3), self._constants, "base")
            turned = base.rotations(self.base)
            self.offset = curve_rows.base_offset(self.base @ weights, turned, self.points)
            self.normal = turned[:, 2]
        if len(layout.legs):
            least, both = self.constant("least_leg", layout.least_leg), len(layout.legs) > 1
            self.legs, self.least = curve_rows.legs(self.points, self.normal, least, both=both)

    def constant(self, name: str, *values: float) -> ca.MX:
        """Return constants as an argument that is bound once."""
        return self._constants.add(name, np.array(values))

    def bound(self, name: str, inputs: list[ca.MX], results: list[ca.MX]) -> Bound:
        """Return the function of these `results`, dense."""
        return self._constants.bound(name, inputs, [ca.densify(result) for result in results])


def end_function(layout: Layout) -> Bound:
    """Return the function (X, Y, base, points) -> rotation, spin, offset, normal, legs and least of :class:`_Ends`."""
    ends = _Ends(layout)
    results = [ends.rotation, ends.spin, ends.offset, ends.normal, ends.legs, ends.least]
    return ends.bound("ends", [ends.X, ends.Y, ends.base, ends.points], results)


def begin_function(layout: Layout) -> Bound:
    """Return the rows of both ends as a function for C.

    Arguments: X, Y, base and points of :class:`_Ends`; then those of a step from its motion on, see
    ``graph.Argument``. Results: error (n_e), rate (n_e) and Jacobian (n_e, 3K) of the tip, row by row;
    curvature of the progress; offset and normal of the curve; rows (G, 3V - 5) and bounds (G) of its legs; gradient of
    the progress.
    """
    ends, tip, rows = _Ends(layout), layout.arm.end_effector, layout.tip_rows
    goal, turned = ca.MX.sym("goal", 3), ca.MX.sym("turned", 3, 3)
    velocity, spin = ca.MX.sym("velocity", 3), ca.MX.sym("spin", 3)
    motion, progress = ca.MX.sym("motion"), ca.MX.sym("progress")
    levers = ends.constant("levers", *layout.tip_levers)
    unit, fineness, weight = ca.vertsplit(
        ends.constant("weights", layout.arm.unit, layout.arm.fineness, layout.weights.progress)
    )
    pairs = (ends.X @ ca.DM(tip.weights), ends.rotation), (goal, turned), (velocity, spin)
    error, rate, of_progress = tip_rows.along_path(rows, *pairs, motion, levers, unit, fineness)
    position, curvature = ca.DM(np.kron(tip.weights, np.eye(3))), weight * of_progress
    results = [
        error,
        rate,
        tip_rows.combined(rows, position, ends.spin, ends.rotation).T,
        curvature,
        ends.offset,
        ends.normal,
        leg_rows(layout, ends.legs, ends.normal),
        ends.least,
        tip_rows.progress_gradient(curvature, progress),
    ]
    inputs = [ends.X, ends.Y, ends.base, ends.points, motion, progress, goal, turned, velocity, spin]
    return ends.bound("begin", inputs, results)


def missing_tip_function(layout: Layout) -> Bound:
    """Return (X, goal, turned, velocity, spin, gone) -> error (n_e), position and rotation of the tip.

    The goal has moved on by the progress `gone` along a straight line.
    """
    ends, tip = _Ends(layout), layout.arm.end_effector
    goal, turned = ca.MX.sym("goal", 3), ca.MX.sym("turned", 3, 3)
    velocity, spin, gone = ca.MX.sym("velocity", 3), ca.MX.sym("spin", 3), ca.MX.sym("gone")
    position = ends.X @ ca.DM(tip.weights)
    there = goal_after(goal, turned, velocity, spin, gone)
    error = tip_rows.error(layout.tip_rows, position, ends.rotation, *there)
    inputs = [ends.X, goal, turned, velocity, spin, gone]
    return ends.bound("missing_tip", inputs, [error, position, ends.rotation])
