"""The engine of long arms: from the positions of the nodes to the step and back by sweeps along the bays.

Its QP is that of the general engine with the solvers of ``qp.long``. The numbers of the QP are written
directly into the sweeps' inputs, and lengths are closed with the factors of the QP. Where that can be compiled, one
call of C does all of it, see ``qp.long.compiled``.
"""

from __future__ import annotations

import numpy as np

from vgtm_qp.arm.arm import Kinematics
from vgtm_qp.arrays import Array
from vgtm_qp.qp.answer import Accuracy, Closed, CurvePoint, Move, Settled, StepSolution
from vgtm_qp.qp.long.chain_data import PeriodValues
from vgtm_qp.qp.long.compiled import CompiledChain
from vgtm_qp.qp.long.ends import end_function
from vgtm_qp.qp.long.solver import ChainSolver
from vgtm_qp.qp.numbers import Legs, RowNumbers, beyond
from vgtm_qp.qp.settle import TOO_FAR, enough_length, enough_tip_error, held
from vgtm_qp.qp.stepper import Stepper
from vgtm_qp.rows.tip import TipGoal, progress_gradient
from vgtm_qp.step.closing import Closing, Correct, converge
from vgtm_qp.step.engine import Engine, Spent
from vgtm_qp.step.state import frozen
from vgtm_qp.step.target import QPInput, Target
from vgtm_qp.step.task import TipTask

_UPRIGHT = frozen(np.eye(3))


class ChainEngine(Engine):
    """See ``engine.Engine``; for arms of `serves`."""

    def __init__(self, solver: ChainSolver, kinematics: Kinematics, task: TipTask) -> None:
        super().__init__(solver.layout)
        arm, chain = self.layout.arm, solver.chain
        self._solver, self._task, self._data = solver, task, solver.data
        self._values = PeriodValues(chain, solver.data)
        self._ends = end_function(self.layout).kernel()
        self.compiled = CompiledChain(solver)
        self._closing = solver.closing()
        self._members = chain.members.reshape(-1)
        self._members_at = np.argsort(self._members)
        self._nodes, self._base = chain.nodes.reshape(-1), np.flatnonzero(arm.base)
        self._at = np.argsort(np.concatenate([self._nodes, self._base]))
        self._tip = self._at[arm.end_effector.nodes]
        self._aims = arm.home_quantities.copy()
        self._strokes = arm.home_quantities[arm.actuators]
        self._answer = (self._strokes, self._strokes, self._strokes)
        self._curve_weights = self.layout.curve_weights[chain.stations.reshape(-1)]
        self._any_closing = Closing(self.layout, kinematics)

    @staticmethod
    def serves(solver: ChainSolver) -> bool:
        """Whether all bays of the solver's arm are alike and its base face is rigid; steps must close whole gaps."""
        layout, arm = solver.layout, solver.layout.arm
        if solver.chain.member_places is None or np.isfinite(layout.reach):
            return False
        return not arm.base[arm.end_effector.nodes].any() and (
            not layout.vertices or bool(arm.base[arm.stations.nodes[0]].all())
        )

    @property
    def stepper(self) -> Stepper:
        """See ``engine.Engine``."""
        return self.compiled

    def move(self, asked: QPInput, accuracy: Accuracy, spent: Spent) -> Move:
        """See ``engine.Engine``; by one call of C once that is compiled.

        It does not apply if the path bends within the step, or the base moves.
        """
        target, moved = asked.target, None
        is_straight = target.base is None and target.path.is_straight(target.start, target.end)
        if is_straight and self.compiled.is_ready:
            moved = self.compiled.move(asked.linear(self.layout), asked.rows, accuracy)
            spent("qp")
        if moved is None:
            # NumPy may have an answer: without the margin, or rounded differently.
            return super().move(asked, accuracy, spent)
        move, settled = moved
        if move.closed is None and settled.error < np.inf:
            bounds, goal = (target.lower, target.upper), target.goal(move.progress)
            closed = self._any_closing.close(settled.q, *bounds, accuracy.member)
            off = self._task.off(closed.tip_position, closed.tip_rotation, goal)
            if off <= accuracy.tip and closed.error <= accuracy.member:
                move = move._replace(closed=closed)
        return move

    def solve(self, asked: QPInput) -> StepSolution:
        """See ``engine.Engine``."""
        layout, arm, weights = self.layout, self.layout.arm, self.layout.weights
        X, Y, vertices, _, target, goal, progress, rows, motion = asked
        tip, ends = arm.end_effector, self._ends
        moved = None if target.base is None else arm.based(X, target.base) - X
        ends.inputs[0][:], ends.inputs[1][:] = X[tip.nodes].reshape(-1), Y[tip.nodes].reshape(-1)
        if layout.vertices:
            start = arm.stations.nodes[0]
            ends.inputs[2][:] = (X[start] if moved is None else X[start] + moved[start]).reshape(-1)
            ends.inputs[3][:] = vertices.reshape(-1)
        ends()
        rotation, spin, offset, normal, legs, least = ends.outputs
        if layout.vertices:
            self._data.hold_base(offset.reshape(-1, 3), normal)
        pull = layout.vertex_gradient(vertices, target.vertex_goals) if motion else np.zeros_like(vertices)
        self._data.vertex_gradient = pull
        self._values.fill(X, Y, vertices, moved, motion=motion)
        ahead = goal.over(target.end - target.start)
        error, rate, across, weight = self._task.residual(
            tip.position(X), rotation.reshape(3, 3).T, ahead, motion=motion
        )
        length = self._values.lengths[arm.actuators]
        curvature, centring = weights.progress * weight, weights.stroke_centring if motion else 0.0
        numbers = RowNumbers(
            lower=target.lower - length,
            upper=target.upper - length,
            actuator_gradient=centring * (length - arm.home_quantities[arm.actuators]),
            tip_jacobian=self._task.jacobian(across, spin.reshape(-1, 3).T),
            tip_rate=rate,
            tip_rhs=error,
            progress_lower=-progress,
            progress_upper=1.0 - progress,
            progress_gradient=progress_gradient(curvature, progress),
            progress_curvature=curvature,
            clearance=rows,
            legs=Legs(legs.reshape(len(least), vertices.size).copy(), least.copy()),
        )
        solution = self._solver.solve_filled(numbers)
        self._answer = solution.actuators, numbers.lower, numbers.upper
        self._strokes = length + solution.actuators
        return solution

    def settle(
        self, X: Array, curve: CurvePoint, target: Target, goal: TipGoal, accuracy: Accuracy
    ) -> Settled | None:
        """See ``engine.Engine``: each step corrects the lengths, and the remaining tip error by the actuators.

        The actuated lengths are those of the QP's answer plus corrections, each for what the tip will miss of its goal
        once the lengths are correct. If faces are held on the curve, the lengths follow from the curve as far as bounds
        allow.
        """
        closing, solver, bounds = self._closing, self._solver, (target.lower, target.upper)
        enough, enough_tip = enough_length(X, accuracy.member), enough_tip_error(X, accuracy.tip)
        closing.start(X)
        first: Array = X.take(self._nodes, axis=0)
        wanted = self._aim(self._strokes, curve.vertices, *bounds)
        gain: Array | None = None
        steers = by_strokes = solver.settles == "strokes"

        def missing(own: Array) -> tuple[Array, float]:
            tip = self._tip_of(own, turned=self._task.turns is not None)
            return self._task.error(*tip, goal), self._task.off(*tip, goal)

        def measure(own: Array) -> tuple[float, Correct | None]:
            nonlocal wanted, gain, steers
            is_off = steers
            closer, worst = closing.step(own)
            if steers and own is not first:
                off = missing(own)[1]
                if not off <= accuracy.start:
                    return np.inf, None
                is_off = off > enough_tip
            if not is_off and worst <= enough:
                return worst, None
            if steers and (ahead := missing(closer))[1] > enough_tip:
                if gain is None:
                    gain = solver.gain(held(*self._answer, self.layout.arm.fineness))
                steers = gain is not None
                if gain is not None:
                    wanted = wanted + gain @ ahead[0]
                    self._aim(wanted, curve.vertices, *bounds)
                    closer += solver.gain_moved @ ahead[0]
            return worst, closer.copy

        own, worst = converge(first, measure, TOO_FAR * self.layout.arm.unit)
        closed = self._closed(X, own, worst)
        strokes = closed.quantities[self.layout.arm.actuators]
        if not (
            by_strokes or (worst <= accuracy.member and np.abs(beyond(strokes, *bounds)).max() <= enough)
        ):
            closed = self._any_closing.close(closed.q, *bounds, accuracy.member)
        off = self._task.off(closed.tip_position, closed.tip_rotation, goal)
        is_there = off <= accuracy.tip and closed.error <= accuracy.member
        return Settled(closed, curve) if is_there else None

    def _aim(self, strokes: Array, vertices: Array, lower: Array, upper: Array) -> Array:
        """Set the targets: `strokes` (n_a,), m, within bounds, home lengths of the others, curve nodes of held faces.

        Return the strokes within bounds.
        """
        lengths, *points = self._closing.aims
        aimed = self._aims[self.layout.arm.actuators] = np.minimum(np.maximum(strokes, lower), upper)
        self._aims.take(self._members, out=lengths.reshape(-1), mode="clip")
        for faces in points:
            np.matmul(self._curve_weights, vertices, out=faces.reshape(-1, 3))
        return aimed

    def _closed(self, X: Array, own: Array, worst: float) -> Closed:
        """Return the configuration whose free nodes are at `own`, in the order of the chain; base nodes as in `X`."""
        nodes = np.concatenate([own, X[self._base]]).take(self._at, axis=0)
        lengths = self._closing.lengths.reshape(-1).take(self._members_at)
        return Closed(nodes, lengths, worst, *self._tip_of(own))

    def _tip_of(self, own: Array, *, turned: bool = True) -> tuple[Array, Array]:
        """Return position (3,) and rotation (3, 3) of the tip where the free nodes are at `own`; if not `turned`, I."""
        corners, ends = own.take(self._tip, axis=0), self._ends
        position = self.layout.arm.end_effector.weights @ corners
        if not turned:
            return position, _UPRIGHT
        ends.inputs[0][:] = corners.reshape(-1)
        ends()
        return position, ends.outputs[0].reshape(3, 3).T.copy()
