"""A step's QP by plain NumPy formulas, written apart from the package: what its symbolic one is tested against.

Of the package stand in here the arm's kinematics, which have tests by differences of their own, and constant tables.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Kinematics
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.linearise import StepInput, TipGoal
from vgtm_qp.qp.numbers import ClearanceRows, CurveNumbers, StepNumbers
from vgtm_qp.qp.shape import CurveRows

Array = NDArray[np.float64]

ENOUGH = 2e-8
"""A tip error of a state that a motion need not close, m or rad."""

SHORT_WAY = 0.01
"""A way of the tip, m, below which progress along it counts more."""

GOAL_REACH = 0.01
"""Greatest part of the arm's length that a control vertex is drawn towards its goal in one step."""


def turn_between(start: Array, end: Array, across: Array) -> Array:
    """Return the rotation vector from a unit vector to another; half a turn is about the unit vector `across`."""
    axis = np.cross(start, end)
    sine = np.linalg.norm(axis)
    if sine > 1e-12:
        return axis * (np.arctan2(sine, start @ end) / sine)
    return np.zeros(3) if start @ end > 0.0 else np.pi * across


def rotation_vector(rotation: Array) -> Array:
    """Return the rotation vector of a rotation, up to half a turn."""
    twist = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    sine, cosine = np.linalg.norm(twist) / 2, (np.trace(rotation) - 1) / 2
    angle = np.arctan2(sine, cosine)
    if sine > 1e-7:
        return twist * (angle / (2 * sine))
    if cosine > 0:
        return twist / 2
    outer = (rotation + np.eye(3)) / 2
    axis = outer[:, int(np.argmax(np.diag(outer)))]
    return angle * axis / np.linalg.norm(axis)


class TipRows(NamedTuple):
    """Goal less value (n_e,), the path's rate (n_e,), and which turns are tracked, (r, 3)."""

    error: Array
    rate: Array
    across: Array


def tip_rows(rows: tuple[str, ...], position: Array, rotation: Array, goal: TipGoal) -> TipRows:
    """Return the rows of a tip, eqs. (11) and (16)."""
    axes = ["xyz".index(row[-1]) for row in rows if row in ("tip x", "tip y", "tip z")]
    error, rate = (goal.position - position)[axes], goal.velocity[axes]
    if "tip direction 1" in rows:
        across = rotation[:, :2].T
        turn = turn_between(rotation[:, 2], goal.rotation[:, 2], rotation[:, 0])
    elif "tip rotation x" in rows:
        across = np.eye(3)
        turn = rotation_vector(goal.rotation @ rotation.T)
    else:
        return TipRows(error, rate, np.zeros((0, 3)))
    return TipRows(
        np.concatenate([error, across @ turn]), np.concatenate([rate, across @ goal.spin]), across
    )


def progress_weight(rate: Array) -> float:
    """Return the square of the way, or more where it is short."""
    way = float(np.linalg.norm(rate))
    return way * max(way, SHORT_WAY) if way > 1e-6 else 1.0


class TurnRows(NamedTuple):
    """Turns between faces and curve: (K, R) residuals, rows over the faces' nodes (K, R, 9) and the curve (K, R, D)."""

    residual: Array
    face: Array
    curve: Array


def turn_rows(rows: CurveRows, rotation: Array, spin: Array, turns: int) -> TurnRows:
    """Return the turns between stations, `rotation` (K, 3, 3) and `spin` (K, 3, 9), and the curve's frames, eq. (39)."""
    frame = rows.frame
    x, y = rotation[:, :, 0], rotation[:, :, 1]
    tangent = frame[:, :, 2]
    residual = [np.einsum("kc,kc->k", axis, tangent) for axis in (x, y)]
    combined = [np.cross(axis, tangent) for axis in (x, y)]
    if turns == 3:
        first, second = frame[:, :, 0], frame[:, :, 1]
        residual.append(0.5 * np.einsum("kc,kc->k", x, second) - 0.5 * np.einsum("kc,kc->k", y, first))
        combined.append(0.5 * (np.cross(x, second) - np.cross(y, first)))
    c = np.stack(combined, axis=1)
    return TurnRows(np.stack(residual, axis=1), c @ spin, -c @ rows.spin_rows)


def length_jacobian(truss: Truss, gradient: Array) -> Array:
    """Return the dense Jacobian (M, 3 N) of lengths by all nodes, from gradients (M, Q, 3)."""
    full = np.zeros((truss.member_count, truss.node_count, 3))
    for slot in range(gradient.shape[1]):
        np.add.at(full, (np.arange(truss.member_count), truss.member_nodes[:, slot]), gradient[:, slot])
    return full.reshape(truss.member_count, -1)


def goal_pull(layout: Layout, vertices: Array, goals: Array | None) -> Array:
    """Return (V, 3) the gradient of the control vertices' goals."""
    pull = np.zeros_like(vertices)
    for i in layout.vertex_goals if goals is not None else ():
        gap = vertices[i] - goals[i]
        apart = float(np.linalg.norm(gap))
        if apart > 0.0:
            share = min(1.0, GOAL_REACH * layout.arm.height / apart)
            pull[i] = layout.weights.vertex_goal * share * gap
    return pull


def numbers(
    layout: Layout, kinematics: Kinematics, asked: StepInput, clearance: ClearanceRows
) -> StepNumbers:
    """Return the QP's numbers of a truss; ``motion`` has its gradient and right-hand sides alone."""
    arm: Any = layout.arm
    truss, stations, tip, weights = arm.truss, arm.stations, arm.end_effector, layout.weights
    tracked, actuators, moves = layout.tracked, truss.actuators, asked.motion
    kinematics.evaluate(asked.at)
    gradient, spin = kinematics.gradient.copy(), kinematics.station_spin.copy()
    tip_spin = kinematics.tip_spin.copy()
    X = asked.q
    moved = np.where(truss.base[:, None], asked.base - X, 0.0)
    base_rotation = np.eye(3)
    if layout.vertices:
        kinematics.evaluate(X + moved)
        base_rotation = kinematics.station_rotation[0].copy()
    kinematics.evaluate(X)
    lengths, rotations = kinematics.quantities.copy(), kinematics.station_rotation[tracked].copy()
    missing = np.where(truss.actuated, 0.0, truss.home_lengths - lengths)
    missing -= length_jacobian(truss, gradient) @ moved.reshape(-1)

    rows = tip_rows(layout.tip_rows, tip.weights @ X[tip.nodes], kinematics.tip_rotation, asked.goal)
    error = rows.error
    if moves and np.abs(error).max(initial=0.0) <= ENOUGH:
        error = np.zeros_like(error)
    axes = ["xyz".index(row[-1]) for row in layout.tip_rows if row in ("tip x", "tip y", "tip z")]
    jacobian = np.kron(tip.weights, np.eye(3))[axes]
    if len(rows.across):
        jacobian = np.concatenate([jacobian, rows.across @ tip_spin])
    curvature = weights.progress * progress_weight(rows.rate)

    count = len(tracked)
    gap, shift = np.zeros((count, 3)), np.zeros(3)
    face, slope, tilt = np.zeros((count, 2, 9)), np.zeros((count, 2, 3)), np.zeros((count, 2))
    base_axes, base_rhs, pull = np.zeros((2, 3)), np.zeros(2), np.zeros_like(asked.vertices)
    curve = None
    if layout.vertices:
        p, given = asked.vertices, asked.curve
        centres = np.einsum("fk,fkc->fc", stations.weights, X[stations.nodes])
        points = layout.curve_weights @ p if given is None else given.position
        if moves or layout.hard_tracking:
            gap = centres[tracked] - points
        if given is None:
            slopes = layout.curve_slopes @ p
            speed = np.linalg.norm(slopes, axis=1, keepdims=True)
            tangents = slopes / speed
            across = rotations[:, :, :2].transpose(0, 2, 1)
            along = np.einsum("kac,kc->ka", across, tangents)
            face = np.einsum("kac,kcf->kaf", np.cross(across, tangents[:, None, :]), spin[tracked])
            slope = (across - along[..., None] * tangents[:, None, :]) / speed[:, None]
            if moves or layout.hard_turns:
                tilt = along
        else:
            turns = turn_rows(given, rotations, spin[tracked], layout.turns)
            curve = CurveNumbers(
                position=given.position_rows,
                turn_face=turns.face,
                turn_curve=turns.curve,
                turn_rhs=turns.residual if moves or layout.hard_turns else 0.0 * turns.residual,
                spacing=given.spacing_rows,
                spacing_rhs=given.spacing if moves else 0.0 * given.spacing,
            )
        if moves:
            bending = np.diff(np.eye(layout.vertices), n=2, axis=0)
            pull = weights.smoothness * (bending.T @ bending @ p)
            pull += goal_pull(layout, p, asked.vertex_goals)
        base_axes = base_rotation[:, :2].T
        first = stations.nodes[0]
        shift = stations.weights[0] @ (X + moved)[first] - p[0]
        base_rhs = -base_axes @ (p[1] - p[0])
    strokes = lengths[actuators]
    pulled = weights.stroke_centring * (strokes - truss.home_lengths[actuators])
    motion: Any = SimpleNamespace(gradient=gradient, rhs=missing)
    return StepNumbers(
        motion=motion,
        lower=asked.lower - strokes,
        upper=asked.upper - strokes,
        actuator_gradient=pulled if moves else np.zeros(len(actuators)),
        tip_jacobian=jacobian,
        tip_rate=rows.rate,
        tip_rhs=error,
        progress_lower=1.0 - asked.progress if layout.elastic_tip else -asked.progress,
        progress_upper=1.0 - asked.progress,
        progress_gradient=curvature * (asked.progress - 2.0),
        progress_curvature=curvature,
        position_rhs=gap,
        tangent_face=face,
        tangent_curve=slope,
        tangent_rhs=tilt,
        vertex_gradient=pull,
        base_displacement=shift,
        base_axes=base_axes,
        base_rhs=base_rhs,
        clearance=clearance,
        curve=curve,
    )


class Condensed(NamedTuple):
    """The QP over what actuators, base and path leave free: d_a, the curve's q coordinates, and the progress.

    Attributes
    ----------
    rows : (L, n_a + q + 1)
        Rows whose squares are the objective's, the last column their constants.
    tip : (n_e, n_a + q + 1)
    lower, upper : (n_a + q + 1 + n_e,)
    gradient : (n_a + q + 1,)
        What else there is of it.
    offset, normal : (V, 3), (3,)
    """

    rows: Array
    tip: Array
    lower: Array
    upper: Array
    gradient: Array
    offset: Array
    normal: Array


def condensed(layout: Layout, asked: StepInput, given: StepNumbers) -> Condensed:
    """Return a truss's QP condensed, from its :func:`numbers`."""
    arm: Any = layout.arm
    truss, stations, weights, V = arm.truss, arm.stations, layout.weights, layout.vertices
    count, torsion, tracked = len(truss.actuators), layout.torsion, layout.tracked
    moved = np.where(truss.base[:, None], asked.base - asked.q, 0.0)
    whole = length_jacobian(truss, given.motion.gradient).reshape(truss.member_count, -1, 3)
    known = np.zeros((truss.member_count, count + 1))
    known[truss.actuators, np.arange(count)] = 1.0
    known[:, -1] = given.motion.rhs
    free = np.linalg.solve(whole[:, truss.free].reshape(truss.member_count, -1), known)
    nodes = np.zeros((truss.node_count, 3, count + 1))
    nodes[:, :, -1] = moved
    nodes[truss.free] = free.reshape(-1, 3, count + 1)

    size = 3 * V + torsion
    offset, normal = np.zeros((V, 3)), np.zeros(3)
    basis = np.zeros((size, layout.free_curve))
    if V:
        axes = given.base_axes
        normal = np.cross(axes[0], axes[1])
        offset[0] = given.base_displacement
        offset[1] = given.base_displacement + given.base_rhs @ axes
        basis[3:6, 0] = normal
        basis[6:, 1:] = np.eye(size - 6)
    start = np.concatenate([offset.reshape(-1), np.zeros(torsion)])

    def stacked(over_nodes: Array, over_curve: Array, constant: Array) -> Array:
        """Rows (R, n_a + q + 1) of rows over the nodes' displacements, (R, n_a + 1) as above, and over the curve's."""
        last = constant + over_nodes[:, -1] + over_curve @ start
        return np.column_stack([over_nodes[:, :-1], over_curve @ basis, last])

    hard, turned = layout.hard_tracking, layout.hard_turns
    parts = [np.sqrt(weights.node_rate) * stacked(free, np.zeros((len(free), size)), np.zeros(len(free)))]
    if V:
        K, R = len(tracked), layout.turns
        if given.curve is None:
            position = np.einsum("kv,cd->kcvd", layout.curve_weights, np.eye(3)).reshape(K, 3, size)
            turning = np.einsum("kac,kv->kavc", given.tangent_curve, layout.curve_slopes).reshape(K, 2, size)
            face, residual = given.tangent_face, given.tangent_rhs
        else:
            position, turning = given.curve.position, given.curve.turn_curve
            face, residual = given.curve.turn_face, given.curve.turn_rhs
        corners = nodes[stations.nodes[tracked]]
        centres = np.einsum("kf,kfcn->kcn", stations.weights[tracked], corners)
        gaps = stacked(
            centres.reshape(3 * K, -1), -position.reshape(3 * K, -1), given.position_rhs.reshape(-1)
        )
        turns = stacked(
            np.einsum("krf,kfn->krn", face, corners.reshape(K, 9, -1)).reshape(R * K, -1),
            turning.reshape(R * K, -1),
            residual.reshape(-1),
        )
        scale = np.sqrt([weights.tangent, weights.tangent, weights.roll][:R])
        parts += [
            gaps * (1.0 if hard else np.sqrt(weights.tracking)),
            turns * (1.0 if turned else np.tile(scale, K)[:, None]),
        ]
        if given.curve is not None and layout.spacings:
            still = np.zeros((layout.spacings, count + 1))
            parts.append(
                np.sqrt(weights.spacing) * stacked(still, given.curve.spacing, given.curve.spacing_rhs)
            )
    tips = nodes[arm.end_effector.nodes].reshape(-1, count + 1)
    tip = given.tip_jacobian @ tips
    tip_value = given.tip_rhs - tip[:, -1]
    unbounded = np.full(layout.free_curve, 1e30)
    own = np.zeros(0)
    if V:
        bending = np.diff(np.eye(V), n=2, axis=0)
        pull = weights.curve_rate * offset + weights.smoothness * (bending.T @ bending @ offset)
        # The goals of control vertices are no part of these rows.
        pull += given.vertex_gradient - (goal_pull(layout, asked.vertices, asked.vertex_goals) * asked.motion)
        own = np.concatenate([pull.reshape(-1), np.zeros(torsion)]) @ basis
    return Condensed(
        rows=np.concatenate(parts),
        tip=np.column_stack([tip[:, :-1], np.zeros((len(tip), layout.free_curve)), -given.tip_rate]),
        lower=np.concatenate([given.lower, -unbounded, [-asked.progress], tip_value]),
        upper=np.concatenate([given.upper, unbounded, [1.0 - asked.progress], tip_value]),
        gradient=np.concatenate([given.actuator_gradient, own, [given.progress_gradient]]),
        offset=offset,
        normal=normal,
    )


def tracking_error(
    layout: Layout, kinematics: Kinematics, q: Array, vertices: Array, given: CurveRows | None
) -> float:
    """Return the greatest gap, m, or turn, rad, of stations that are to stay on the curve exactly."""
    stations, tracked = layout.arm.stations, layout.tracked
    kinematics.evaluate(q)
    centres = np.einsum("fk,fkc->fc", stations.weights, layout.arm.nodes(q)[stations.nodes])[tracked]
    rotations = kinematics.station_rotation[tracked]
    if given is not None:
        gaps = centres - given.position
        turns = turn_rows(given, rotations, kinematics.station_spin[tracked], layout.turns).residual
    else:
        slopes = layout.curve_slopes @ vertices
        tangents = slopes / np.linalg.norm(slopes, axis=1, keepdims=True)
        gaps = centres - layout.curve_weights @ vertices
        turns = np.einsum("kca,kc->ka", rotations[:, :, :2], tangents)
    return max(float(np.abs(gaps).max()), float(np.abs(turns).max()) if layout.hard_turns else 0.0)
