"""From the answer of a QP to the next configuration: quantities closed, the tip at its goal, the answer checked."""

from __future__ import annotations

from collections.abc import Callable

import casadi as ca
import numpy as np

from vgtm_qp.arm.symbols import ArmSymbols, Bound, Constants, rotated
from vgtm_qp.qp.graph import tip_frames
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.settle import AT_BOUND, LEFT, SETTLED, SETTLING_STEPS, WORST_CONDITION
from vgtm_qp.rows.tip import error as tip_error

NEAR = 24
"""Greatest number of clearance rows with which the compiled function checks an answer."""

_HELD_STEPS = 4
_BOXED_STEPS = 2


def settle_function(layout: Layout) -> Bound:
    """Return the function from the answer of a QP to a configuration with closed quantities and the tip at its goal.

    Arguments: q; lower, upper (n_a); goal position (3), rotation (3, 3), velocity and spin (3) per unit of progress;
    progress so far; results 0 to 3, 6 and 7 of `row_function`, with the tip rows and bounds followed by those of hard
    tracking and of ``NEAR`` clearances; p (3, V); Hessian and gradient; the QP's answer and multipliers; Gram matrix
    (n_a, n_a) of the weighted node displacements in R; and 1 to follow the answer, 0 to settle q at the given goal.
    With hard tracking the stations are held on the curve instead, if they and the fixed quantities determine the
    configuration: the tip is then at the curve's end.

    Results: q with fixed quantities as at home and actuators in their boxes; quantities there; tip position; tip
    rotation; p; seven numbers; q before it was settled. The seven are the errors of the quantities and of the tip
    before the gain of ``qp.settle`` was first used and at the end (norms, so that NaN shows), progress, greatest
    displacement of a node by the answer, and the answer's primal and dual residuals, see :mod:`vgtm_qp.qp.residual`.
    """
    constants, arm = Constants(), layout.arm
    symbols, qp = arm.symbols(constants), _SolvedQP(layout)
    q = ca.MX.sym("q", *symbols.shape)
    count = len(arm.actuators)
    lower, upper = ca.MX.sym("lower", count), ca.MX.sym("upper", count)
    frames = tip_frames(layout, constants) if arm.end_effector.has_frame else None
    goal, turned = ca.MX.sym("goal", 3), ca.MX.sym("turned", 3, 3)
    velocity, spin, progress = ca.MX.sym("velocity", 3), ca.MX.sym("spin", 3), ca.MX.sym("progress")
    vertices, follows = ca.MX.sym("p", 3, layout.vertices), ca.MX.sym("follows")
    scales = np.array(
        [
            layout.weights.actuator_rate + layout.weights.stroke_centring,
            1.0 / np.sqrt(layout.weights.node_rate),
        ]
    )
    stiffness, scale = ca.vertsplit(constants.add("scale", scales))

    def tip(q: ca.MX) -> tuple[ca.MX, ca.MX]:
        X = symbols.nodes(q)
        position = X[:, arm.end_effector.nodes.tolist()] @ ca.DM(arm.end_effector.weights)
        return position, ca.MX.eye(3) if frames is None else frames.at(X)[0]

    reached = ca.fmin(ca.fmax(progress + qp.answer[-1], 0.0), 1.0)
    left = (1.0 - reached) * ca.fmax(ca.norm_inf(velocity), ca.norm_inf(spin))
    reached = ca.if_else(left <= LEFT, 1.0, reached)
    gone = follows * (reached - progress)
    goal_pose = goal + gone * velocity, rotated(gone * spin) @ turned
    moved = follows * scale * (qp.response @ qp.actuators + qp.particular)
    vertices_after = vertices + follows * qp.curve_displacement()
    start = symbols.along(q, symbols.coordinates(moved, follows * qp.actuators))

    is_plain = layout.hard_tracking and layout.general is None and not layout.hard_turns
    held = symbols.held(layout.tracked.tolist()) if is_plain else None
    if held is None:
        end = symbols.closed(symbols.closed(start, lower, upper), lower, upper)
    else:
        points = vertices_after @ constants.add("curve_weights", layout.curve_weights)
        end = start
        for _ in range(_HELD_STEPS):
            end = held(end, points)
        # The stations take actuators along: what these are beyond their boxes goes back, by less than gaps count.
        for _ in range(_BOXED_STEPS):
            end = symbols.closed(end, lower, upper)
    first = error = tip_error(layout.tip_rows, *tip(end), *goal_pose)
    if not layout.hard_tracking:
        gain = qp.gain(stiffness)
        settling = symbols.coordinates(scale * (qp.response @ gain), gain)
        step = _settling_step(layout, symbols, constants, tip, settling.shape)
        for _ in range(SETTLING_STEPS):
            is_off = ca.norm_2(error) > SETTLED
            end, error = step(is_off, end, error, lower, upper, settling, *goal_pose, *constants.symbols)
    quantities = symbols.quantities(end)
    measures = [
        symbols.error(quantities, lower, upper),
        *(ca.norm_2(first), ca.norm_2(error), reached, ca.norm_inf(moved)),
        *qp.residuals(),
    ]
    inputs = [
        *(q, lower, upper, goal, turned, velocity, spin, progress),
        *(qp.rows, qp.constraint, qp.low, qp.high, qp.offset, qp.normal, vertices),
        *(qp.hessian, qp.linear, qp.answer, qp.multipliers, qp.gram, follows),
    ]
    outputs = [end, quantities, *tip(end), vertices_after, ca.vertcat(*measures), start]
    function = ca.Function(
        "settle", [*inputs, *constants.symbols], [ca.densify(output) for output in outputs]
    )
    return Bound(function, constants.values)


def _settling_step(
    layout: Layout,
    symbols: ArmSymbols,
    constants: Constants,
    tip: Callable[[ca.MX], tuple[ca.MX, ca.MX]],
    shape: tuple[int, int],
) -> ca.Function:
    """Return the function of (is_off, q, error, lower, upper, gain, goal pose, constants) that corrects q and error.

    The gain, of that `shape`, maps the tip's error to coordinates. Nothing changes unless the tip `is_off`.
    """
    count = len(layout.arm.actuators)
    q, error = ca.MX.sym("q", *symbols.shape), ca.MX.sym("error", len(layout.tip_rows))
    lower, upper, gain = ca.MX.sym("lower", count), ca.MX.sym("upper", count), ca.MX.sym("gain", *shape)
    pose = ca.MX.sym("goal", 3), ca.MX.sym("turned", 3, 3)
    nearer = symbols.closed(symbols.along(q, gain @ error), lower, upper)
    arguments = [q, error, lower, upper, gain, *pose, *constants.symbols]
    again = ca.Function("again", arguments, [nearer, tip_error(layout.tip_rows, *tip(nearer), *pose)])
    return ca.Function.if_else("either", again, ca.Function("enough", arguments, [q, error]))


class _SolvedQP:
    """The condensed QP and its answer, as arguments of :func:`settle_function`.

    Attributes
    ----------
    rows : (L, n)
        Of the objective, the nodes' displacements first: their `response` (3 (N - N_c), n_a) and `particular` part.
    constraint : (n, m)
        Transposed.
    low, high, multipliers : (n + m,)
    hessian, linear : (n, n), (n,)
    gram : (n_a, n_a)
    offset, normal : (3, V), (3,)
    answer, actuators : (n,), (n_a,)
    """

    def __init__(self, layout: Layout) -> None:
        self._layout, count = layout, len(layout.arm.actuators)
        self._size = size = count + layout.free_curve + 1
        self._tip = len(layout.tip_rows)
        equal = self._tip + len(layout.hard) + len(layout.legs) + NEAR
        self.low, self.high = (ca.MX.sym(name, size + equal) for name in ("low", "high"))
        self.constraint, self.multipliers = (
            ca.MX.sym("C", size, equal),
            ca.MX.sym("multipliers", size + equal),
        )
        self.hessian, self.linear = ca.MX.sym("H", size, size), ca.MX.sym("g", size)
        self.rows, self.gram = ca.MX.sym("R", layout.least_squares, size), ca.MX.sym("gram", count, count)
        self.offset, self.normal = ca.MX.sym("offset", 3, layout.vertices), ca.MX.sym("normal", 3)
        self.answer = ca.MX.sym("answer", size)
        self.actuators, columns = self.answer[:count], layout.node_columns
        self.response, self.particular = self.rows[:columns, :count], self.rows[:columns, -1]

    def curve_displacement(self) -> ca.MX:
        """Return (3, V) the displacements of the control vertices."""
        layout = self._layout
        if not layout.vertices:
            return self.offset
        free = self.answer[len(layout.arm.actuators) : self._size - 1 - layout.torsion]
        rest = ca.reshape(free[1:], 3, layout.vertices - 2)
        return self.offset + ca.horzcat(ca.MX.zeros(3), free[0] * self.normal, rest)

    def residuals(self) -> tuple[ca.MX, ca.MX]:
        """Return the answer's primal and dual residuals, see :mod:`vgtm_qp.qp.residual`."""
        values = ca.vertcat(self.answer, self.constraint.T @ self.answer)
        beyond = ca.fmax(ca.fmax(values - self.high, self.low - values), 0.0)
        of_bounds, of_rows = self.multipliers[: self._size], self.multipliers[self._size :]
        stationarity = self.hessian @ self.answer + self.linear + of_bounds + self.constraint @ of_rows
        forces = 1.0 + ca.norm_2(self.linear) + ca.norm_2(self.multipliers)
        return ca.norm_2(beyond), ca.norm_2(stationarity) / forces

    def gain(self, stiffness: ca.MX) -> ca.MX:
        """Return :func:`_gain` of the actuators that the answer leaves between their bounds."""
        count = len(self._layout.arm.actuators)
        low, high = self.low[:count], self.high[:count]
        free = ca.logic_and(self.actuators > low + AT_BOUND, self.actuators < high - AT_BOUND)
        return _gain(self.gram, stiffness, self.constraint[:count, : self._tip], free)


def _gain(gram: ca.MX, stiffness: ca.MX, tip: ca.MX, free: ca.MX) -> ca.MX:
    """Return (n_a, n_e) the result of `settling_gain` in symbols; zeros where that is None.

    An actuator that is not `free` (n_a) has the equation that it rests.
    """
    count, rows = tip.shape
    mask = ca.if_else(free, 1.0, 0.0)
    hessian = gram * (mask @ mask.T) + ca.diag(mask * (stiffness - 1.0) + 1.0)
    reached = tip * ca.repmat(mask, 1, rows)
    answer = ca.solve(hessian, reached, "ldl")
    normal = reached.T @ answer
    # At a nearly singular matrix CasADi's virtual machine fails the whole function, whereas compiled code goes on with
    # infinities. Here both go on, and `usable` is false.
    shares = ca.inv(normal, "qr", {"eps": 0.0})
    usable = ca.logic_and(
        ca.norm_inf(ca.vec(shares)) * ca.norm_inf(ca.vec(normal)) < WORST_CONDITION, ca.sum1(mask) >= rows
    )
    return ca.if_else(usable, answer @ shares, ca.DM.zeros(count, rows))
