"""From the answer of a QP to the next configuration: lengths closed, the tip at its goal, the answer checked."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.qp.fused_parts import TINY, Bound, Symbols, tip_error, tip_frames
from vgtm_qp.qp.graph import Stage, TrussGraph, stage_faces
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.settle import AT_BOUND, LEFT, SETTLED, SETTLING_STEPS, WORST_CONDITION

NEAR = 24
"""Clearance rows of a QP whose answer is checked by the compiled function; those of more are checked without it."""

_HELD_STEPS = 4


def settle_function(layout: Layout, stages: list[Stage]) -> Bound:
    """Return the function that takes the answer of a QP to a configuration with closed lengths and the tip at its goal.

    Arguments: X (3, N); lower, upper (n_a); goal position (3), rotation (3, 3), velocity and spin (3) per unit of
    progress; progress so far; results 0 to 3, 6 and 7 of `row_function`, with the tip rows and bounds followed by those
    of hard tracking and of ``NEAR`` clearances; p (3, V); Hessian and gradient; the QP's answer and multipliers;
    (n_a, n_a) Gram matrix of the weighted node displacements in R; and 1 where the answer is to be taken, 0 where X is
    what is to be settled at the goal given. With hard tracking the faces are held on the curve instead, where they and
    the fixed members determine the nodes: the tip then is where the curve ends.

    Results: X, whose fixed members have their home lengths and whose actuators are in their boxes; lengths there; tip
    position; tip rotation; p; and (7) error of the lengths and of the tip before the gain of :mod:`vgtm_qp.qp.settle`
    was first used and at the end (norms, so that what is not a number shows), progress, greatest displacement of a
    coordinate by the answer, and the answer's primal and dual residuals, see ``check_answer``; X before it was settled.
    """
    symbols, truss = Symbols(layout), layout.truss
    graph = TrussGraph(layout, stages, symbols.constants)
    is_plain = layout.hard_tracking and layout.general is None and not layout.hard_turns
    faces = stage_faces(layout, stages) if is_plain else None
    frames = tip_frames(layout, symbols.constants) if layout.has_tip_frame else None
    goal, turned = ca.MX.sym("goal", 3), ca.MX.sym("turned", 3, 3)
    velocity, spin, progress = ca.MX.sym("velocity", 3), ca.MX.sym("spin", 3), ca.MX.sym("progress")
    actuators, count = truss.actuators.tolist(), len(truss.actuators)
    size, tip_rows = count + layout.free_curve + 1, len(layout.tip_rows)
    equal = tip_rows + layout.hard_rows + NEAR
    low, high = (ca.MX.sym(name, size + equal) for name in ("low", "high"))
    constraint, multipliers = ca.MX.sym("C", size, equal), ca.MX.sym("multipliers", size + equal)
    hessian, gradient, answer = ca.MX.sym("H", size, size), ca.MX.sym("g", size), ca.MX.sym("answer", size)
    rows, gram = ca.MX.sym("R", layout.least_squares, size), ca.MX.sym("gram", count, count)
    offset, normal = ca.MX.sym("offset", 3, layout.vertices), ca.MX.sym("normal", 3)
    vertices, taken = ca.MX.sym("p", 3, layout.vertices), ca.MX.sym("taken")
    weights = layout.weights
    stiffness, scale = ca.vertsplit(
        symbols.constants.add(
            "scale",
            np.array([weights.actuator_rate + weights.stroke_centring, 1.0 / np.sqrt(weights.node_rate)]),
        )
    )
    place = {int(node): 3 * k for k, node in enumerate(truss.free)}

    def spread(moved: ca.MX) -> ca.MX:
        """Displacements (3, N) of all nodes from those of the free ones (3 (N - N_c), 1)."""
        zero = ca.DM.zeros(3)
        return ca.horzcat(
            *(moved[place[n] : place[n] + 3] if n in place else zero for n in range(truss.node_count))
        )

    def aims(lengths: ca.MX) -> ca.MX:
        aim = symbols.home_lengths * 1.0
        aim[actuators] = ca.fmax(symbols.lower, ca.fmin(symbols.upper, lengths[actuators]))
        return aim

    def closed(X: ca.MX) -> ca.MX:
        lengths, gradients = graph.lengths(X)
        return graph.newton(X, aims(lengths), lengths, gradients)

    def on_curve(X: ca.MX, faces: NDArray[np.int64]) -> ca.MX:
        points = vertices_after @ symbols.constants.add("curve_weights", layout.curve_weights)
        for _ in range(_HELD_STEPS):
            lengths, gradients = graph.lengths(X)
            centres = (
                X[:, truss.faces[face].tolist()] @ ca.DM(truss.face_weights[face]) for face in layout.tracked
            )
            gaps = points - ca.horzcat(*centres)
            X = graph.newton_on_faces(X, symbols.home_lengths, lengths, gradients, gaps, faces)
        return X

    def tip(X: ca.MX) -> tuple[ca.MX, ca.MX]:
        position = X[:, truss.tip.tolist()] @ ca.DM(truss.tip_weights)
        return position, ca.MX.eye(3) if frames is None else frames.at(X)[0]

    chosen = answer[:count]
    response = rows[: layout.node_columns, :count]
    moved = taken * scale * (response @ chosen + rows[: layout.node_columns, -1])
    reached = ca.fmin(ca.fmax(progress + answer[-1], 0.0), 1.0)
    left = (1.0 - reached) * ca.fmax(ca.norm_inf(velocity), ca.norm_inf(spin))
    reached = ca.if_else(left <= LEFT, 1.0, reached)
    gone = taken * (reached - progress)
    goal_position, goal_rotation = goal + gone * velocity, _turned(gone * spin) @ turned

    if layout.vertices:
        free_curve = answer[count : size - 1 - layout.torsion]
        change = ca.horzcat(
            ca.MX.zeros(3), free_curve[0] * normal, ca.reshape(free_curve[1:], 3, layout.vertices - 2)
        )
        vertices_after = vertices + taken * (offset + change)
    else:
        vertices_after = vertices
    start = symbols.X + spread(moved)
    X = closed(closed(start)) if faces is None else on_curve(start, faces)
    first = error = tip_error(layout.tip_rows, *tip(X), goal_position, goal_rotation)
    if not layout.hard_rows:
        free = ca.logic_and(chosen > low[:count] + AT_BOUND, chosen < high[:count] - AT_BOUND)
        settling = scale * (response @ _gain(gram, stiffness, constraint[:count, :tip_rows], free))
        at, off, by = symbols.X, ca.MX.sym("off", tip_rows), ca.MX.sym("by", layout.node_columns, tip_rows)
        nearer = closed(at + spread(by @ off))
        rest = [symbols.lower, symbols.upper, by, goal, turned, *symbols.constants.symbols]
        again = ca.Function(
            "again", [at, off, *rest], [nearer, tip_error(layout.tip_rows, *tip(nearer), goal, turned)]
        )
        enough = ca.Function("enough", [at, off, *rest], [at, off])
        either = ca.Function.if_else("either", again, enough)
        given = [
            symbols.lower,
            symbols.upper,
            settling,
            goal_position,
            goal_rotation,
            *symbols.constants.symbols,
        ]
        for _ in range(SETTLING_STEPS):
            X, error = either(ca.norm_2(error) > SETTLED, X, error, *given)
    position, rotation = tip(X)
    lengths, _ = graph.lengths(X)

    values = ca.vertcat(answer, constraint.T @ answer)
    beyond = ca.fmax(ca.fmax(values - high, low - values), 0.0)
    stationarity = hessian @ answer + gradient + multipliers[:size] + constraint @ multipliers[size:]
    told = [
        ca.norm_2(aims(lengths) - lengths),
        ca.norm_2(first),
        ca.norm_2(error),
        reached,
        ca.norm_inf(moved),
        ca.norm_2(beyond),
        ca.norm_2(stationarity) / (1.0 + ca.norm_2(gradient) + ca.norm_2(multipliers)),
    ]
    inputs = [
        *(symbols.X, symbols.lower, symbols.upper, goal, turned, velocity, spin, progress),
        *(rows, constraint, low, high, offset, normal, vertices),
        *(hessian, gradient, answer, multipliers, gram, taken),
    ]
    outputs = [X, lengths, position, ca.densify(rotation), vertices_after, ca.vertcat(*told), start]
    return Bound(
        ca.Function("settle", [*inputs, *symbols.constants.symbols], outputs), symbols.constants.values
    )


def _turned(vector: ca.MX) -> ca.MX:
    """Return the (3, 3) rotation by |vector| about it (Rodrigues), smooth at zero."""
    square = ca.dot(vector, vector) + TINY
    angle = ca.sqrt(square)
    cross = ca.skew(vector)
    return ca.MX.eye(3) + (ca.sin(angle) / angle) * cross + ((1.0 - ca.cos(angle)) / square) * (cross @ cross)


def _gain(gram: ca.MX, stiffness: ca.MX, tip: ca.MX, free: ca.MX) -> ca.MX:
    """Return (n_a, n_e) actuator displacements per unit of tip error as `settling_gain` does; zeros where it has none.

    An actuator that is not `free` (n_a) stands in the system as an equation of its own.
    """
    count, rows = tip.shape
    mask = ca.if_else(free, 1.0, 0.0)
    hessian = gram * (mask @ mask.T) + ca.diag(mask * (stiffness - 1.0) + 1.0)
    reached = tip * ca.repmat(mask, 1, rows)
    answer = ca.solve(hessian, reached, "ldl")
    normal = reached.T @ answer
    # Left to itself, the virtual machine gives up the whole function at a matrix that is nearly singular, where the
    # compiled one goes on with infinite shares. Both go on here: `usable` is false for those.
    shares = ca.inv(normal, "qr", {"eps": 0.0})
    usable = ca.logic_and(
        ca.norm_inf(ca.vec(shares)) * ca.norm_inf(ca.vec(normal)) < WORST_CONDITION, ca.sum1(mask) >= rows
    )
    return ca.if_else(usable, answer @ shares, ca.DM.zeros(count, rows))
