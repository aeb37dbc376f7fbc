"""From the answer of a QP to the next configuration: quantities closed, the tip at its goal, the answer checked."""

from __future__ import annotations

import casadi as ca
import numpy as np

from vgtm_qp.arm.symbols import Bound, Constants, rotated
from vgtm_qp.qp.graph import tip_frames
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.settle import AT_BOUND, LEFT, SETTLED, SETTLING_STEPS, WORST_CONDITION
from vgtm_qp.rows.tip import error as tip_error

NEAR = 24
"""Clearance rows of a QP whose answer is checked by the compiled function; those of more are checked without it."""

_HELD_STEPS = 4


def settle_function(layout: Layout) -> Bound:
    """Return the function from the answer of a QP to a configuration with closed quantities and the tip at its goal.

    Arguments: q; lower, upper (n_a); goal position (3), rotation (3, 3), velocity and spin (3) per unit of progress;
    progress so far; results 0 to 3, 6 and 7 of `row_function`, with the tip rows and bounds followed by those of hard
    tracking and of ``NEAR`` clearances; p (3, V); Hessian and gradient; the QP's answer and multipliers; Gram matrix
    (n_a, n_a) of the weighted node displacements in R; and 1 where the answer is to be taken, 0 where q is to be
    settled at the goal given. With hard tracking the stations are held on the curve instead, where they and the fixed
    quantities determine the configuration: the tip then is where the curve ends.

    Results: q, whose fixed quantities are those at home and whose actuators are in their boxes; quantities there; tip
    position; tip rotation; p; and (7) error of the quantities and of the tip before the gain of ``qp.settle``
    was first used and at the end (norms, so that NaN shows), progress, greatest displacement of a node by the answer,
    and the answer's primal and dual residuals, see :mod:`vgtm_qp.qp.residual`; q before it was settled.
    """
    constants, arm = Constants(), layout.arm
    symbols = arm.symbols(constants)
    q = ca.MX.sym("q", *symbols.shape)
    count, columns = len(arm.actuators), layout.node_columns
    lower, upper = ca.MX.sym("lower", count), ca.MX.sym("upper", count)
    is_plain = layout.hard_tracking and layout.general is None and not layout.hard_turns
    held = symbols.held(layout.tracked.tolist()) if is_plain else None
    frames = tip_frames(layout, constants) if arm.end_effector.has_frame else None
    goal, turned = ca.MX.sym("goal", 3), ca.MX.sym("turned", 3, 3)
    velocity, spin, progress = ca.MX.sym("velocity", 3), ca.MX.sym("spin", 3), ca.MX.sym("progress")
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
        constants.add(
            "scale",
            np.array([weights.actuator_rate + weights.stroke_centring, 1.0 / np.sqrt(weights.node_rate)]),
        )
    )

    def tip(q: ca.MX) -> tuple[ca.MX, ca.MX]:
        X = symbols.nodes(q)
        position = X[:, arm.end_effector.nodes.tolist()] @ ca.DM(arm.end_effector.weights)
        return position, ca.MX.eye(3) if frames is None else frames.at(X)[0]

    chosen = answer[:count]
    response = rows[:columns, :count]
    moved = taken * scale * (response @ chosen + rows[:columns, -1])
    reached = ca.fmin(ca.fmax(progress + answer[-1], 0.0), 1.0)
    left = (1.0 - reached) * ca.fmax(ca.norm_inf(velocity), ca.norm_inf(spin))
    reached = ca.if_else(left <= LEFT, 1.0, reached)
    gone = taken * (reached - progress)
    goal_position, goal_rotation = goal + gone * velocity, rotated(gone * spin) @ turned

    vertices_after = vertices
    if layout.vertices:
        free_curve = answer[count : size - 1 - layout.torsion]
        change = ca.horzcat(
            ca.MX.zeros(3), free_curve[0] * normal, ca.reshape(free_curve[1:], 3, layout.vertices - 2)
        )
        vertices_after = vertices + taken * (offset + change)
    start = symbols.along(q, symbols.coordinates(moved, taken * chosen))
    if held is None:
        end = symbols.closed(symbols.closed(start, lower, upper), lower, upper)
    else:
        points = vertices_after @ constants.add("curve_weights", layout.curve_weights)
        end = start
        for _ in range(_HELD_STEPS):
            end = held(end, points)
    first = error = tip_error(layout.tip_rows, *tip(end), goal_position, goal_rotation)
    if not layout.hard_rows:
        free = ca.logic_and(chosen > low[:count] + AT_BOUND, chosen < high[:count] - AT_BOUND)
        gain = _gain(gram, stiffness, constraint[:count, :tip_rows], free)
        settling = symbols.coordinates(scale * (response @ gain), gain)
        at, off, by = (
            ca.MX.sym("at", *symbols.shape),
            ca.MX.sym("off", tip_rows),
            ca.MX.sym("by", *settling.shape),
        )
        nearer = symbols.closed(symbols.along(at, by @ off), lower, upper)
        rest = [lower, upper, by, goal, turned, *constants.symbols]
        again = ca.Function(
            "again", [at, off, *rest], [nearer, tip_error(layout.tip_rows, *tip(nearer), goal, turned)]
        )
        enough = ca.Function("enough", [at, off, *rest], [at, off])
        either = ca.Function.if_else("either", again, enough)
        given = [lower, upper, settling, goal_position, goal_rotation, *constants.symbols]
        for _ in range(SETTLING_STEPS):
            end, error = either(ca.norm_2(error) > SETTLED, end, error, *given)
    position, rotation = tip(end)
    quantities = symbols.quantities(end)

    values = ca.vertcat(answer, constraint.T @ answer)
    beyond = ca.fmax(ca.fmax(values - high, low - values), 0.0)
    stationarity = hessian @ answer + gradient + multipliers[:size] + constraint @ multipliers[size:]
    measures = [
        symbols.error(quantities, lower, upper),
        ca.norm_2(first),
        ca.norm_2(error),
        reached,
        ca.norm_inf(moved),
        ca.norm_2(beyond),
        ca.norm_2(stationarity) / (1.0 + ca.norm_2(gradient) + ca.norm_2(multipliers)),
    ]
    inputs = [
        *(q, lower, upper, goal, turned, velocity, spin, progress),
        *(rows, constraint, low, high, offset, normal, vertices),
        *(hessian, gradient, answer, multipliers, gram, taken),
    ]
    outputs = [end, quantities, position, rotation, vertices_after, ca.vertcat(*measures), start]
    function = ca.Function(
        "settle", [*inputs, *constants.symbols], [ca.densify(output) for output in outputs]
    )
    return Bound(function, constants.values)


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
