"""The condensed QP of a step, from node positions, for arms whose bays can be eliminated one after another."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from vgtm_qp.qp.fused_parts import AXES, Bound, Symbols, tip_error, tip_frames
from vgtm_qp.qp.graph import Frames, Stage, TrussGraph
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import CLOSED, SHORT_WAY, UNBOUNDED


def row_function(layout: Layout, stages: list[Stage]) -> Bound:
    """Return the function that linearises and condenses the QP of a step.

    Arguments: X, Y (3, N), where residuals and where Jacobians are evaluated; base (3, N), positions that base nodes
    take; p (3, V); lower, upper (n_a); motion, 1 for the QP that moves the arm and 0 for corrections; progress; goal
    position (3) and rotation (3, 3) there; velocity and spin (3) of the goal per unit of progress.

    Results: R (3 (N - N_c) + 5 K, n_a + q + 1), whose Gram matrix is the objective's, the last row and column but for
    the progress its gradient; tip rows (n_a + q + 1, n_e); lower and upper bounds (n_a + q + 1 + n_e) of the unknowns
    and tip rows; what else there is of the gradient (n_a + q + 1); curvature of the progress; offsets (3, V) of the
    control vertices; base normal (3).

    Where the curve is more than its tables, ``CurveRows`` are arguments too, after `motion`, transposed as CasADi reads
    them; then there are R rows of turns for each of the K faces and S rows of spacing.
    """
    symbols, truss = Symbols(layout), layout.truss
    constants = symbols.constants
    graph = TrussGraph(layout, stages, constants)
    X, Y = symbols.X, ca.MX.sym("Y", 3, truss.node_count)
    base, motion = ca.MX.sym("base", 3, truss.node_count), ca.MX.sym("motion")
    vertices = ca.MX.sym("p", 3, layout.vertices)
    progress, goal, turned = ca.MX.sym("progress"), ca.MX.sym("goal", 3), ca.MX.sym("turned", 3, 3)
    velocity, spin_rate = ca.MX.sym("velocity", 3), ca.MX.sym("spin", 3)
    weights = layout.weights
    node_rate, centring, tracking, tangent, roll, curve_rate, smoothness, spacing, eager = ca.vertsplit(
        constants.add(
            "weights",
            np.array(
                [
                    weights.node_rate,
                    weights.stroke_centring,
                    1.0 if layout.hard_tracking else weights.tracking,
                    1.0 if layout.hard_turns else weights.tangent,
                    1.0 if layout.hard_turns else weights.roll,
                    weights.curve_rate,
                    weights.smoothness,
                    weights.spacing,
                    weights.progress,
                ]
            ),
        )
    )
    lengths, _ = graph.lengths(X)
    _, gradients = graph.lengths(Y)
    given = np.flatnonzero(truss.base).tolist()
    moved = ca.MX.zeros(3, truss.node_count)
    moved[:, given] = (base - X)[:, given]
    corners = layout.member_nodes
    terms = gradients * ca.vec(moved[:, corners.reshape(-1).tolist()])
    base_rate = ca.sum1(ca.reshape(terms, 3 * corners.shape[1], truss.member_count)).T
    missing = ca.DM(symbols.fixed) * (symbols.home_lengths - lengths)
    response = graph.response(gradients, missing - base_rate)

    actuators = truss.actuators.tolist()
    strokes = lengths[actuators]
    place = {int(node): 3 * k for k, node in enumerate(truss.free)}

    def displacement(nodes: list[int]) -> ca.MX:
        """Rows (3 K, n_a + 1) of the displacement of nodes; base nodes move as they are told."""
        zero = ca.MX.zeros(3, len(actuators))
        parts = [
            response[place[node] : place[node] + 3, :] if node in place else ca.horzcat(zero, moved[:, node])
            for node in nodes
        ]
        return ca.vertcat(*parts)

    tip = displacement(truss.tip.tolist())
    tip_rows = ca.DM(np.kron(truss.tip_weights, np.eye(3))) @ tip
    rotation = ca.MX.eye(3)
    if layout.has_tip_frame:
        frames = tip_frames(layout, constants)
        rotation, _ = frames.at(X)
        _, spin = frames.at(Y)
        tip_rows = ca.vertcat(tip_rows, spin @ tip)
    else:
        tip_rows = ca.vertcat(tip_rows, ca.MX.zeros(3, len(actuators) + 1))

    tip_value = X[:, truss.tip.tolist()] @ ca.DM(truss.tip_weights)
    error = tip_error(layout.tip_rows, tip_value, rotation, goal, turned)
    error = ca.if_else(
        ca.logic_and(motion > 0, ca.norm_inf(error) <= CLOSED), ca.DM.zeros(*error.shape), error
    )
    tip_rows = _tracked(layout.tip_rows, tip_rows[:3, :], tip_rows[3:, :], rotation)
    rate = _tracked(layout.tip_rows, velocity, spin_rate, rotation)
    way = ca.norm_2(rate)
    curvature = eager * ca.if_else(way > 1e-6, way * ca.fmax(way, SHORT_WAY), 1.0)

    top = ca.sqrt(node_rate) * response
    curve_gradient, offset, normal = ca.MX.zeros(0, 1), ca.MX.zeros(3, 0), ca.MX.zeros(3)
    gaps: list[ca.MX] = []
    tilts: list[ca.MX] = []
    told: list[ca.MX] = []
    if layout.vertices:
        faces = Frames(truss.home[truss.faces], truss.face_frames, truss.faces, constants, "face")
        rotations, _ = faces.at(X)
        _, spins = faces.at(Y)
        centre = (X + moved)[:, truss.faces[0].tolist()] @ ca.DM(truss.face_weights[0])
        base_face = Frames(
            truss.home[truss.faces[:1]], truss.face_frames[:1], truss.faces[:1], constants, "base"
        )
        base_rotation, _ = base_face.at(X + moved)
        axes, normal = base_rotation[:, :2], base_rotation[:, 2]
        offset = ca.MX.zeros(3, layout.vertices)
        offset[:, 0] = centre - vertices[:, 0]
        offset[:, 1] = offset[:, 0] - axes @ (axes.T @ (vertices[:, 1] - vertices[:, 0]))
        if layout.general is None:
            curve_weights = constants.add("curve_weights", layout.curve_weights)
            curve_slopes = constants.add("curve_slopes", layout.curve_slopes)
            curve_node = _curve_node(layout, len(actuators))
        else:
            told = _given_curve(layout)
            every = ca.vertcat(ca.vec(offset), ca.MX.zeros(layout.torsion))
            curve_node = _given_curve_node(layout, len(actuators))
        turn_scale = ca.sqrt(ca.vertcat(tangent, tangent, roll)[: layout.turns])
        gap_on = 1.0 if layout.hard_tracking else motion
        turn_on = 1.0 if layout.hard_turns else motion
        for k, face in enumerate(layout.tracked.tolist()):
            nodes, block = truss.faces[face].tolist(), slice(3 * k, 3 * k + 3)
            arguments = [
                X[:, nodes],
                displacement(nodes),
                rotations[:, 3 * face : 3 * face + 3],
                spins[:, 9 * face : 9 * face + 9],
            ]
            if layout.general is None:
                arguments += [vertices, offset, normal, curve_weights[:, k], curve_slopes[:, k]]
            else:
                arguments += [told[0][:, k], *(table[:, block] for table in told[1:4]), every, normal]
            gap, tilt = curve_node(*arguments, truss.face_weights[face], gap_on, turn_on)
            gaps.append(ca.sqrt(tracking) * gap)
            tilts.append(ca.repmat(turn_scale, 1, gap.shape[1]) * tilt)
        if layout.spacings:
            stretch = ca.horzcat(_free_columns(told[5], normal), motion * told[4] + told[5].T @ every)
            fixed = ca.MX.zeros(layout.spacings, len(actuators))
            tilts.append(ca.sqrt(spacing) * ca.horzcat(fixed, stretch))
        top = ca.horzcat(top[:, :-1], ca.MX.zeros(layout.node_columns, layout.free_curve), top[:, -1])
        bend = ca.DM(layout.polygon_bending)
        pull = curve_rate * offset + smoothness * ((offset + motion * vertices) @ bend)
        curve_gradient = ca.vertcat(
            ca.dot(pull[:, 1], normal), ca.vec(pull[:, 2:]), ca.MX.zeros(layout.torsion)
        )
    free = layout.free_curve
    unbounded = ca.DM.ones(free) * UNBOUNDED
    value = error - tip_rows[:, -1]
    results = [
        ca.vertcat(top, *gaps, *tilts),
        ca.horzcat(tip_rows[:, :-1], ca.MX.zeros(len(layout.tip_rows), free), -rate).T,
        ca.vertcat(symbols.lower - strokes, -unbounded, -progress, value),
        ca.vertcat(symbols.upper - strokes, unbounded, 1.0 - progress, value),
        ca.vertcat(
            motion * centring * (strokes - symbols.home_lengths[actuators]),
            curve_gradient,
            curvature * (progress - 2.0),
        ),
        curvature,
        offset,
        normal,
    ]
    inputs = [
        X,
        Y,
        base,
        vertices,
        symbols.lower,
        symbols.upper,
        motion,
        progress,
        goal,
        turned,
        velocity,
        spin_rate,
    ]
    function = ca.Function(
        "rows", [*inputs, *told, *constants.symbols], [ca.densify(result) for result in results]
    )
    return Bound(function, constants.values)


def _tracked(names: tuple[str, ...], position: ca.MX, spin: ca.MX, rotation: ca.MX) -> ca.MX:
    """Return the tracked rows (n_e, n) from those of the tip's position and spin (3, n), see ``TipTask.residual``."""
    parts = [position[[AXES[name] for name in names if name in AXES], :]]
    if "tip direction 1" in names:
        parts.append(rotation[:, :2].T @ spin)
    elif "tip rotation x" in names:
        parts.append(spin)
    return ca.vertcat(*parts)


def _given_curve(layout: Layout) -> list[ca.MX]:
    """Return the arguments that ``CurveRows`` are given as: each array's last axis is the row index."""
    count, size, pieces = len(layout.tracked), 3 * layout.vertices + layout.torsion, layout.spacings
    shapes = {
        "position": (3, count),
        "position_rows": (size, 3 * count),
        "frame": (3, 3 * count),
        "spin_rows": (size, 3 * count),
        "stretch": (pieces, 1),
        "stretch_rows": (size, pieces),
    }
    return [ca.MX.sym(name, *shape) for name, shape in shapes.items()]


def _free_columns(rows: Any, normal: Any) -> Any:
    """Return (R, q) rows over what the base leaves free of the curve's coordinates, from (D, R)."""
    return ca.horzcat(rows[3:6, :].T @ normal, rows[6:, :].T)


def _given_curve_node(layout: Layout, actuators: int) -> ca.Function:
    """Return the rows of one curve node as `_curve_node` does, from its ``CurveRows``; R turns."""
    size = 3 * layout.vertices + layout.torsion
    nodes, motion_rows = ca.SX.sym("nodes", 3, 3), ca.SX.sym("rows", 9, actuators + 1)
    rotation, spin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("spin", 3, 9)
    position, position_rows = ca.SX.sym("position", 3), ca.SX.sym("position_rows", size, 3)
    frame, spin_rows = ca.SX.sym("frame", 3, 3), ca.SX.sym("spin_rows", size, 3)
    offset, normal, face = ca.SX.sym("offset", size), ca.SX.sym("normal", 3), ca.SX.sym("face", 3)
    gap_on, turn_on = ca.SX.sym("gap_on"), ca.SX.sym("turn_on")

    centre = ca.kron(face.T, ca.SX.eye(3)) @ motion_rows
    gap = gap_on * (nodes @ face - position) + centre[:, -1] - position_rows.T @ offset
    gap_rows = ca.horzcat(centre[:, :-1], -_free_columns(position_rows, normal), gap)

    first, second, tangent = (frame[c, :].T for c in range(3))
    x, y = rotation[:, 0], rotation[:, 1]
    residuals, combined = (
        [ca.dot(x, tangent), ca.dot(y, tangent)],
        [ca.cross(x, tangent), ca.cross(y, tangent)],
    )
    if layout.turns == 3:
        residuals.append((ca.dot(x, second) - ca.dot(y, first)) / 2)
        combined.append((ca.cross(x, second) - ca.cross(y, first)) / 2)
    c = ca.horzcat(*combined).T
    turned = c @ spin @ motion_rows
    constant = turn_on * ca.vertcat(*residuals) + turned[:, -1] - c @ (spin_rows.T @ offset)
    turn_rows = ca.horzcat(turned[:, :-1], -c @ _free_columns(spin_rows, normal), constant)
    inputs = [
        nodes,
        motion_rows,
        rotation,
        spin,
        position,
        position_rows,
        frame,
        spin_rows,
        offset,
        normal,
        face,
    ]
    outputs = [ca.densify(gap_rows), ca.densify(turn_rows)]
    return ca.Function("curve_node", [*inputs, gap_on, turn_on], outputs)


def _curve_node(layout: Layout, actuators: int) -> ca.Function:
    """Return the tracking rows (3, n) and tangent rows (2, n) of one curve node, n = n_a + q + 1."""
    count = layout.vertices
    nodes, motion_rows = ca.SX.sym("nodes", 3, 3), ca.SX.sym("rows", 9, actuators + 1)
    rotation, spin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("spin", 3, 9)
    vertices, offset, normal = ca.SX.sym("p", 3, count), ca.SX.sym("offset", 3, count), ca.SX.sym("normal", 3)
    weights, slopes, face = ca.SX.sym("w", count), ca.SX.sym("dw", count), ca.SX.sym("face", 3)
    gap_on, tilt_on = ca.SX.sym("gap_on"), ca.SX.sym("tilt_on")

    identity = ca.SX.eye(3)
    centre = ca.kron(face.T, identity) @ motion_rows
    curve = ca.horzcat(weights[1] * normal, ca.kron(weights[2:].T, identity))
    gap = gap_on * (nodes @ face - vertices @ weights) + centre[:, -1] - offset @ weights
    gap_rows = ca.horzcat(centre[:, :-1], -curve, gap)

    slope = vertices @ slopes
    speed = ca.norm_2(slope)
    tangent = slope / speed
    tilts = []
    for a in range(2):
        axis = rotation[:, a]
        along = ca.dot(axis, tangent)
        turn = ca.cross(axis, tangent).T @ spin @ motion_rows
        across = ((axis - along * tangent) / speed).T
        free = ca.horzcat(slopes[1] * (across @ normal), ca.kron(slopes[2:].T, across))
        tilts.append(
            ca.horzcat(turn[:, :-1], free, tilt_on * along + turn[:, -1] + across @ (offset @ slopes))
        )
    inputs = [
        nodes,
        motion_rows,
        rotation,
        spin,
        vertices,
        offset,
        normal,
        weights,
        slopes,
        face,
        gap_on,
        tilt_on,
    ]
    return ca.Function("curve_node", inputs, [ca.densify(gap_rows), ca.densify(ca.vertcat(*tilts))])
