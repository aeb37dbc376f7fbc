"""The rows of a truss's step by their equations: plain NumPy, one function an equation, Jacobians by complex steps.

It shares nothing with the arms, frames and rows of the library but the data of a truss and of a layout. A derivative by
a complex step, Im f(x + ih) / h, is exact to rounding and no formula of anybody.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.linearise import StepInput
from vgtm_qp.qp.numbers import StepNumbers
from vgtm_qp.rows.tip import TipGoal

Array = NDArray[Any]
Index = NDArray[np.int64]

_STEP = 1e-30


def derivative(function: Callable[[Array], Array], x: Array) -> Array:
    """Return the derivative of an analytic function of `x`: shape of its value, then shape of `x`."""
    columns = []
    for place in np.ndindex(*np.shape(x)):
        ahead = np.array(x, dtype=complex)
        ahead[place] += 1j * _STEP
        columns.append(np.imag(function(ahead)) / _STEP)
    return np.stack(columns, axis=-1).reshape(*np.shape(columns[0]), *np.shape(x))


def norm(vectors: Array) -> Array:
    """Return |v| over the last axis, by an analytic function."""
    return np.asarray(np.sqrt(np.sum(vectors * vectors, axis=-1)))


def unit(vectors: Array) -> Array:
    """Return v / |v| over the last axis."""
    return vectors / norm(vectors)[..., None]


def turned(rotation: Array, angles: Array) -> Array:
    """Return a rotation after a small turn by a rotation vector (3,), to first order."""
    return np.asarray(rotation + np.cross(angles, rotation, axisb=0, axisc=0))


# Lengths, eqs. (12)-(17) and (22)-(24).


def member_ends(truss: Truss, X: Array) -> Array:
    """Return (M, 2, 3) the ends of all members, eq. (13): constant in the frames of the joints at their nodes."""
    ends = X[truss.members]
    if truss.joints is None:
        return ends
    node, first, second = (X[truss.joints.triangle[:, k]] for k in range(3))
    normal = unit(np.cross(first - node, second - node))
    outward = -unit(unit(first - node) + unit(second - node))
    axes = np.stack([outward, np.cross(normal, outward), normal], axis=1)
    return np.asarray(ends + np.einsum("mea,meac->mec", truss.joints.offset, axes[truss.members]))


def lengths(truss: Truss, X: Array) -> Array:
    """Return (M,) the member lengths, eq. (12)."""
    ends = member_ends(truss, X)
    return norm(ends[:, 0] - ends[:, 1])


def length_jacobian(truss: Truss, X: Array) -> Array:
    """Return (M, N, 3) d length / d node, eq. (17)."""
    return derivative(lambda Y: lengths(truss, Y), X)


def motion(truss: Truss, X: Array, at: Array, base: Array) -> tuple[Array, Array]:
    """Return [J, -E] (M, 3 (N - N_c) + n_a) and right-hand sides (M,): eqs. (22)-(24) beside the actuated members'."""
    jacobian = length_jacobian(truss, at)
    moved = np.where(truss.base[:, None], base - X, 0.0)
    missing = np.where(truss.actuated, 0.0, lengths(truss, truss.home) - lengths(truss, X))
    actuated = np.eye(truss.member_count)[:, truss.actuators]
    rows = np.hstack([jacobian[:, truss.free].reshape(truss.member_count, -1), -actuated])
    return rows, missing - np.einsum("mnc,nc->m", jacobian, moved)


# Frames of faces and tip.


def polygon_frame(points: Array, angles: Array) -> Array:
    """Return the frame (3, 3) of a polygon (K, 3) whose corners are at polar `angles` (K,) as nearly as they can.

    z is the normal of the area; about z the corners fit best: of sum_j |c_j| cos(theta_j - phi_j - turn) the greatest.
    """
    corners = points - points.mean(axis=0)
    z = unit(np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0))
    first = unit(corners[0] - z * (corners[0] @ z))
    second = np.cross(z, first)
    u, v = corners @ first, corners @ second
    cosine = np.sum(u * np.cos(angles) + v * np.sin(angles))
    sine = np.sum(v * np.cos(angles) - u * np.sin(angles))
    x = unit(cosine * first + sine * second)
    return np.stack([x, np.cross(z, x), z], axis=1)


def frame(points: Array, home: Array, rotation: Array) -> Array:
    """Return the rotation (3, 3) of a body of `points` (K, 3) that has `rotation` where they are at `home`."""
    corners = home - home.mean(axis=0)
    z = unit(np.cross(corners, np.roll(corners, -1, axis=0)).sum(axis=0))
    first = unit(corners[0] - z * (corners[0] @ z))
    angles = np.arctan2(corners @ np.cross(z, first), corners @ first)
    return polygon_frame(points, angles) @ polygon_frame(home, angles).T @ rotation


def spin(points: Array, home: Array, rotation: Array) -> Array:
    """Return (3, 3K) the angular velocity of a frame by its points: the axial vector of dR R'."""
    change = derivative(lambda moved: frame(moved, home, rotation), points).reshape(3, 3, -1)
    W = np.einsum("abk,cb->ack", change, frame(points, home, rotation))
    return np.stack([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]]) / 2


def face_rotations(truss: Truss, X: Array) -> Array:
    """Return (F, 3, 3) the rotations of the faces."""
    pairs = zip(truss.faces, truss.face_frames, strict=True)
    return np.array([frame(X[nodes], truss.home[nodes], home) for nodes, home in pairs]).reshape(-1, 3, 3)


def face_spins(truss: Truss, X: Array) -> Array:
    """Return (F, 3, 9) the angular velocities of the faces by their nodes."""
    pairs = zip(truss.faces, truss.face_frames, strict=True)
    return np.array([spin(X[nodes], truss.home[nodes], home) for nodes, home in pairs]).reshape(-1, 3, 9)


def face_centres(truss: Truss, X: Array) -> Array:
    """Return (F, 3) where the axis passes through the faces."""
    return np.array([w @ X[nodes] for w, nodes in zip(truss.face_weights, truss.faces, strict=True)])


def tip_rotation(truss: Truss, X: Array) -> Array:
    """Return (3, 3) the rotation of the end effector; identity for a tip of fewer than three nodes."""
    nodes = truss.tip
    return frame(X[nodes], truss.home[nodes], truss.tip_frame) if len(nodes) >= 3 else np.eye(3)


def tip_spin(truss: Truss, X: Array) -> Array:
    """Return (3, 3K) its angular velocity by its nodes."""
    nodes = truss.tip
    if len(nodes) < 3:
        return np.zeros((3, 3 * len(nodes)))
    return spin(X[nodes], truss.home[nodes], truss.tip_frame)


# End effector, eqs. (11) and (16).

_AXES = {"tip x": 0, "tip y": 1, "tip z": 2}


def shortest_turn(start: Array, end: Array) -> Array:
    """Return the rotation vector (3,) that turns one direction to another, not its opposite, about their normal."""
    axis = np.cross(start, end)
    sine = float(norm(axis))
    return np.asarray(axis * (np.arctan2(sine, start @ end) / sine) if sine > 0.0 else np.zeros(3))


def tip_turn(rows: Sequence[str], rotation: Array, goal: Array) -> Array:
    """Return the rotation vector (3,) from the tip's direction, or its orientation, to the goal's."""
    if "tip direction 1" in rows:
        return shortest_turn(rotation[:, 2], goal[:, 2])
    return np.asarray(Rotation.from_matrix(goal @ rotation.T).as_rotvec())


def tip_axes(rows: Sequence[str], rotation: Array) -> Array:
    """Return (r, 3) the axes of the turns that are rows."""
    if "tip direction 1" in rows:
        return rotation[:, :2].T
    return np.eye(3) if "tip rotation x" in rows else np.zeros((0, 3))


def tip_error(rows: Sequence[str], position: Array, rotation: Array, goal: TipGoal) -> Array:
    """Return (n_e,) goal less value, eq. (11)."""
    missing = [(goal.position - position)[_AXES[row]] for row in rows if row in _AXES]
    return np.array([*missing, *(tip_axes(rows, rotation) @ tip_turn(rows, rotation, goal.rotation))])


def tip_rate(rows: Sequence[str], rotation: Array, goal: TipGoal) -> Array:
    """Return (n_e,) how the goal moves in a step."""
    speed = [goal.velocity[_AXES[row]] for row in rows if row in _AXES]
    return np.array([*speed, *(tip_axes(rows, rotation) @ goal.spin)])


def tip_jacobian(rows: Sequence[str], truss: Truss, X: Array, at: Array) -> Array:
    """Return (n_e, 3K) J_u of eq. (16), taken `at`, with the axes at `X`."""
    position = derivative(lambda tips: truss.tip_weights @ tips, at[truss.tip]).reshape(3, -1)
    kept = position[[_AXES[row] for row in rows if row in _AXES]]
    return np.vstack([kept, tip_axes(rows, tip_rotation(truss, X)) @ tip_spin(truss, at)])


def progress_weight(rate: Array, unit: float = 1.0) -> float:
    """Return what progress is weighted by: the square of the tip's way, of which a hundredth unit counts at least."""
    way = float(norm(rate))
    return way * max(way, 0.01 * unit) if way > 1e-6 * unit else unit**2


def unit_of(truss: Truss) -> float:
    """Return the mean distance of two nodes that a member joins, at home, m."""
    return float(np.mean([norm(truss.home[i] - truss.home[j]) for i, j in truss.members]))


def as_lengths(rows: Sequence[str], values: Array, unit: float) -> Array:
    """Return values of the tip's rows with angles times the unit."""
    return values * np.array([1.0 if row in _AXES else unit for row in rows])


# Reference curve, eqs. (32)-(39).


def gaps(truss: Truss, X: Array, tracked: Index, points: Array) -> Array:
    """Return (K, 3) the faces' places less the curve's, eq. (39)."""
    return face_centres(truss, X)[tracked] - points


def turns(rotation: Array, frame: Array, count: int) -> Array:
    """Return (R,) the turns between a face and the curve: two tilts and the roll of the relative rotation R'F."""
    relative = rotation.T @ frame
    tilts = [relative[0, 2], relative[1, 2]]
    return np.array([*tilts, (relative[0, 1] - relative[1, 0]) / 2] if count == 3 else tilts)


def turn_rows(rotation: Array, frame: Array, count: int) -> tuple[Array, Array]:
    """Return (R, 3) twice: the turns' derivatives by turnings of the face, and of the curve."""
    still = np.zeros(3)
    face = derivative(lambda angles: turns(turned(rotation, angles), frame, count), still)
    return face, derivative(lambda angles: turns(rotation, turned(frame, angles), count), still)


def tilts(rotation: Array, slope: Array) -> Array:
    """Return (2,) the cosines between a face's x- and y-axes and the curve's tangent r' / |r'|."""
    return rotation[:, :2].T @ unit(slope)


def tilt_rows(rotation: Array, slope: Array) -> tuple[Array, Array]:
    """Return (2, 3) twice: the tilts' derivatives by turnings of the face, and by the slope r'."""
    face = derivative(lambda angles: tilts(turned(rotation, angles), slope), np.zeros(3))
    return face, derivative(lambda moved: tilts(rotation, moved), slope)


def base_conditions(truss: Truss, base: Array, vertices: Array) -> tuple[Array, Array, Array]:
    """Return d_p[0] (3,), two axes (2, 3) and what d_p[1] - d_p[0] is along them (2,).

    The curve begins in the centre of the base face and leaves it along its normal.
    """
    axes = face_rotations(truss, base)[0][:, :2].T
    return face_centres(truss, base)[0] - vertices[0], axes, -axes @ (vertices[1] - vertices[0])


def bending_gradient(vertices: Array, weight: float) -> Array:
    """Return (V, 3) the gradient of weight / 2 times the squares of the second differences."""
    return derivative(lambda p: np.asarray(weight / 2 * np.sum(np.diff(p, n=2, axis=0) ** 2)), vertices)


def goal_gradient(layout: Layout, vertices: Array, goals: Array | None) -> Array:
    """Return (V, 3) the pull of vertices to their goals, by no more than a hundredth of the arm's length."""
    pull = np.zeros_like(vertices)
    if goals is None:
        return pull
    for i in layout.vertex_goals:
        gap = vertices[i] - goals[i]
        share = min(1.0, 0.01 * truss_of(layout.arm).height / float(norm(gap)))
        pull[i] = layout.weights.vertex_goal * share * gap
    return pull


# The whole step.


def numbers(layout: Layout, asked: StepInput) -> dict[str, Array]:
    """Return the numbers of a step's QP by the names of ``StepNumbers``; rows of the motion and the curve as arrays."""
    truss, weights, rows = truss_of(layout.arm), layout.weights, layout.tip_rows
    X, at = asked.q, asked.at
    strokes, rest = (lengths(truss, Y)[truss.actuators] for Y in (X, truss.home))
    matrix, rhs = motion(truss, X, at, asked.base)
    rotation = tip_rotation(truss, X)
    error = tip_error(rows, truss.tip_weights @ X[truss.tip], rotation, asked.goal)
    rate = tip_rate(rows, rotation, asked.goal)
    unit = unit_of(truss)
    curvature = weights.progress * progress_weight(as_lengths(rows, rate, unit), unit)
    closed = np.abs(as_lengths(rows, error, unit)).max() <= 2e-8 * min(1.0, unit)
    found = {
        "motion": matrix,
        "motion_rhs": rhs,
        "lower": asked.lower - strokes,
        "upper": asked.upper - strokes,
        "actuator_gradient": asked.motion * weights.stroke_centring * (strokes - rest),
        "tip_jacobian": tip_jacobian(rows, truss, X, at),
        "tip_rate": rate,
        "tip_rhs": 0.0 * error if asked.motion and closed else error,
        "progress_lower": 1.0 - asked.progress if layout.elastic_tip else -asked.progress,
        "progress_upper": 1.0 - asked.progress,
        "progress_gradient": curvature * (asked.progress - 2.0),
        "progress_curvature": curvature,
    }
    return {key: np.asarray(value) for key, value in (found | curve_numbers(layout, asked)).items()}


def curve_numbers(layout: Layout, asked: StepInput) -> dict[str, Array]:
    """Return those of the curve; corrections close only what is to hold exactly."""
    truss, tracked, vertices, given = truss_of(layout.arm), layout.tracked, asked.vertices, asked.curve
    if not layout.vertices:
        return {}
    hard_gaps, hard_turns = hard_tracking_rows(layout)
    shift, axes, base_rhs = base_conditions(truss, asked.base, vertices)
    pull = bending_gradient(vertices, layout.weights.smoothness)
    pull += goal_gradient(layout, vertices, asked.vertex_goals)
    rotations, spins = face_rotations(truss, asked.q)[tracked], face_spins(truss, asked.at)[tracked]
    points = layout.curve_weights @ vertices if given is None else given.position
    found = {
        "base_displacement": shift,
        "base_axes": axes,
        "base_rhs": base_rhs,
        "vertex_gradient": asked.motion * pull,
        "position_rhs": (hard_gaps | asked.motion) * gaps(truss, asked.q, tracked, points),
    }
    if given is None:
        slopes = layout.curve_slopes @ vertices
        pairs = list(zip(rotations, slopes, strict=True))
        residuals = [tilts(*pair) for pair in pairs]
        derivatives = [tilt_rows(*pair) for pair in pairs]
        curve = [by_slope for _, by_slope in derivatives]
    else:
        frames = list(zip(rotations, given.frame, strict=True))
        residuals = [turns(*pair, layout.turns) for pair in frames]
        derivatives = [turn_rows(*pair, layout.turns) for pair in frames]
        curve = [by_curve @ row for (_, by_curve), row in zip(derivatives, given.spin_rows, strict=True)]
        found["curve.position_rows"] = given.position_rows
        found["curve.spacing_rows"] = given.spacing_rows
        found["spacing_rhs"] = asked.motion * given.spacing
    face = [by_face @ row for (by_face, _), row in zip(derivatives, spins, strict=True)]
    names = "tangent_rhs", "tangent_face", "tangent_curve"
    for name, value in zip(
        names, ((hard_turns | asked.motion) * np.array(residuals), face, curve), strict=True
    ):
        found[name] = np.array(value)
    return found


def hard_tracking_rows(layout: Layout) -> tuple[Array, Array]:
    """Return which gaps (K, 3) and turns (K, R) are equalities: those asked for, and those of the curve's end."""
    gaps_held = np.full((len(layout.tracked), 3), layout.hard_tracking)
    turns_held = np.full((len(layout.tracked), layout.turns), layout.hard_turns)
    truss = truss_of(layout.arm)
    if layout.vertices >= 3 and sorted(truss.faces[-1]) == sorted(truss.tip):
        gaps_held[-1] = True
        if layout.vertices >= 4 and any(
            " direction " in row or " rotation " in row for row in layout.tip_rows
        ):
            turns_held[-1, :2] = True
    return gaps_held, turns_held


def tracking_error(layout: Layout, X: Array, vertices: Array, frames: Array | None, points: Array) -> float:
    """Return the greatest gap, m, and turn, rad, of faces that are to be on the curve exactly.

    `points` (K, 3) and `frames` (K, 3, 3) of the curve; the latter None where it has slopes alone.
    """
    truss, tracked = truss_of(layout.arm), layout.tracked
    found = [np.linalg.norm(gaps(truss, X, tracked, points).reshape(-1, 3), axis=1)]
    if layout.hard_turns:
        rotations = face_rotations(truss, X)[tracked]
        slopes = layout.curve_slopes @ vertices
        if frames is None:
            found += [tilts(*pair) for pair in zip(rotations, slopes, strict=True)]
        else:
            found += [turns(*pair, layout.turns) for pair in zip(rotations, frames, strict=True)]
    return float(np.abs(np.concatenate(found)).max())


def check_numbers(
    found: StepNumbers, wanted: dict[str, Array], layout: Layout, tolerance: float = 1e-12
) -> None:
    """Assert that a linearisation found the numbers of the equations."""
    pattern, count = layout.arm.motion_pattern, layout.node_columns + len(layout.arm.actuators)
    matrix = np.zeros((len(found.motion.rhs), count))
    np.add.at(matrix, (pattern.rows, pattern.columns), found.motion.values)
    own = {"motion": matrix, "motion_rhs": found.motion.rhs}
    for name, value in wanted.items():
        group, _, key = name.rpartition(".")
        got = own[name] if name in own else getattr(getattr(found, group) if group else found, key)
        np.testing.assert_allclose(got, value, rtol=1e-11, atol=tolerance, err_msg=name)


# The step over what actuators, base and path leave free.


def condensed(layout: Layout, asked: StepInput, given: dict[str, Array]) -> dict[str, Array]:
    """Return a step's QP over d_a, the q coordinates of the curve that its base leaves free, and the progress.

    Given are its :func:`numbers`. Found are rows (L, n_a + q + 1), whose squares are the objective's and whose last
    column is their constant; those of the tip (n_e, n_a + q + 1); bounds (n_a + q + 1 + n_e,) of unknowns and tip;
    what else there is of the gradient but for the goals of control vertices; and offset (V, 3) and normal (3,) of the
    curve's base.
    """
    truss, weights, V = truss_of(layout.arm), layout.weights, layout.vertices
    count, size, tracked = len(truss.actuators), 3 * layout.vertices + layout.torsion, layout.tracked
    jacobian = given["motion"][:, : 3 * len(truss.free)]
    known = np.column_stack([np.eye(truss.member_count)[:, truss.actuators], given["motion_rhs"]])
    free = np.linalg.solve(jacobian, known)
    nodes = np.zeros((truss.node_count, 3, count + 1))
    nodes[truss.base, :, -1] = (asked.base - asked.q)[truss.base]
    nodes[truss.free] = free.reshape(-1, 3, count + 1)

    offset, normal, own = np.zeros((V, 3)), np.zeros(3), np.zeros(0)
    basis = np.zeros((size, layout.free_curve))
    if V:
        axes = given["base_axes"]
        normal, offset[0] = np.cross(axes[0], axes[1]), given["base_displacement"]
        offset[1] = offset[0] + given["base_rhs"] @ axes
        basis[3:6, 0], basis[6:, 1:] = normal, np.eye(size - 6)
        pull = weights.curve_rate * offset + bending_gradient(
            asked.motion * asked.vertices + offset, weights.smoothness
        )
        own = np.pad(pull.reshape(-1), (0, layout.torsion)) @ basis
    start = np.pad(offset.reshape(-1), (0, layout.torsion))

    def stacked(over_nodes: Array, over_curve: Array, constant: Array) -> Array:
        last = constant.reshape(-1) + over_nodes[:, -1] + over_curve @ start
        return np.column_stack([over_nodes[:, :-1], over_curve @ basis, last])

    parts = [np.sqrt(weights.node_rate) * stacked(free, np.zeros((len(free), size)), np.zeros(len(free)))]
    if V:
        K, R = len(tracked), layout.turns
        residual, face, curve = (given[name] for name in ("tangent_rhs", "tangent_face", "tangent_curve"))
        if layout.general is None:
            given = {
                **given,
                "curve.position_rows": np.einsum("kv,cd->kcvd", layout.curve_weights, np.eye(3)),
            }
            curve = np.einsum("kac,kv->kavc", curve, layout.curve_slopes)
        corners = nodes[truss.faces[tracked]]
        centres = np.einsum("kf,kfcn->kcn", truss.face_weights[tracked], corners).reshape(3 * K, -1)
        turned = np.einsum("krf,kfn->krn", face, corners.reshape(K, 9, -1)).reshape(R * K, -1)
        position = given["curve.position_rows"].reshape(3 * K, size)
        hard_gaps, hard_turns = hard_tracking_rows(layout)
        tracking = np.where(hard_gaps, 1.0, weights.tracking)
        turning = np.where(hard_turns, 1.0, [weights.tangent, weights.tangent, weights.roll][:R])
        gap_rows = stacked(centres, -position, given["position_rhs"])
        parts.append(np.sqrt(tracking).reshape(-1, 1) * gap_rows)
        parts.append(np.sqrt(turning).reshape(-1, 1) * stacked(turned, curve.reshape(-1, size), residual))
        if layout.spacings:
            still = np.zeros((layout.spacings, count + 1))
            stretch = stacked(still, given["curve.spacing_rows"], given["spacing_rhs"])
            parts.append(np.sqrt(weights.spacing) * stretch)
    tip = given["tip_jacobian"] @ nodes[truss.tip].reshape(-1, count + 1)
    missing, unbounded = given["tip_rhs"] - tip[:, -1], np.full(layout.free_curve, 1e30)
    none = np.zeros((len(tip), layout.free_curve))
    ends = (given["lower"], [given["progress_lower"]]), (given["upper"], [given["progress_upper"]])
    return {
        "rows": np.concatenate(parts),
        "tip": np.column_stack([tip[:, :-1], none, -given["tip_rate"]]),
        "lower": np.concatenate([ends[0][0], -unbounded, ends[0][1], missing]),
        "upper": np.concatenate([ends[1][0], unbounded, ends[1][1], missing]),
        "gradient": np.concatenate([given["actuator_gradient"], own, [given["progress_gradient"]]]),
        "curvature": np.array([given["progress_curvature"]]),
        "offset": offset,
        "normal": normal,
    }
