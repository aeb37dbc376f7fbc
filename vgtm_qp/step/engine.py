"""What an attempt asks of the QP: one displacement, and members back to their lengths. Two engines, one answer.

The fused engine compiles everything between node positions and QP into one call; the plain engine linearises in NumPy,
serves every truss and every solver by name, and is what the fused one is tested against.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

from vgtm_qp.arm.truss.kinematics import Kinematics
from vgtm_qp.errors import SolverError
from vgtm_qp.qp.fused import Closed, FusedSolver, Taken, TipGoal
from vgtm_qp.qp.fused_settle import NEAR
from vgtm_qp.qp.graph import elimination_stages, stage_faces
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.lengths import FaceSolver, LengthSolver
from vgtm_qp.qp.long.closing import MOST_STEPS
from vgtm_qp.qp.long.staged import StagedSolver
from vgtm_qp.qp.numbers import StepNumbers, StepSolution
from vgtm_qp.qp.settle import SETTLING_STEPS, held, settling_gain
from vgtm_qp.qp.solvers import StepSolver
from vgtm_qp.step.linearise import Linearisation, QPInput, Target, base_frame
from vgtm_qp.step.path import PathPoint

Array = NDArray[np.float64]

_SETTLED = 1e-3
"""A tip this much nearer to its goal than it must be gains nothing by another iteration."""

_ROUNDING = float(np.finfo(float).eps)

_ON_PATH = 1e-6
"""Solvers leave slacks of this size, m or rad, where the answer's are zero."""


@dataclass(frozen=True)
class Accuracy:
    """How exactly members, m, and tip, m or rad, are settled, and from how far off the tip may be brought there."""

    member: float
    tip: float
    start: float


class Engine(Protocol):
    """Solves the QP of a step and closes the lengths."""

    def solve(self, asked: QPInput) -> StepSolution:
        """Return the QP's answer; raise ``SolverError`` instead of a wrong one."""
        ...

    def settle(self, X: Array, target: Target, goal: PathPoint, accuracy: Accuracy) -> Closed | None:
        """Return the configuration near `X` with its lengths closed and the tip at `goal`; None where a QP is due."""
        ...


class LengthCloser:
    """Newton's iteration on all member lengths: actuated members keep theirs, or go to the nearest one allowed."""

    def __init__(self, layout: Layout, kinematics: Kinematics, home_lengths: Array) -> None:
        self._layout, self._kinematics, self._home_lengths = layout, kinematics, home_lengths
        self._solver = LengthSolver(layout)

    def close(self, X: Array, lower: Array, upper: Array, tolerance: float) -> Closed:
        """Return the configuration near `X` (N, 3) with actuators where they are, but between bounds (n_a,), m."""
        layout, kinematics = self._layout, self._kinematics
        actuators, free = layout.truss.actuators, layout.truss.free
        wanted = self._home_lengths.copy()
        X, worst, enough = X.copy(), np.inf, enough_length(X, tolerance)
        for _ in range(5):
            kinematics.evaluate_members(X)
            wanted[actuators] = np.clip(kinematics.lengths[actuators], lower, upper)
            error = wanted - kinematics.lengths
            worst = float(np.max(np.abs(error)))
            if worst <= enough or not worst < 1e-2:
                break
            try:
                X[free] += self._solver.solve(kinematics.gradient, error)
            except SolverError:
                worst = np.inf
                break
        return Closed(
            X, kinematics.lengths.copy(), worst, kinematics.tip_position(X), kinematics.tip_rotation.copy()
        )


class CurveCloser:
    """Newton's iteration on the lengths of fixed members and the places of the faces; actuators follow."""

    def __init__(self, layout: Layout, kinematics: Kinematics, home_lengths: Array) -> None:
        self._layout, self._kinematics, self._home_lengths = layout, kinematics, home_lengths
        self._solver = FaceSolver(layout)

    def close(self, X: Array, vertices: Array, lower: Array, upper: Array, tolerance: float) -> Closed | None:
        """Return the configuration near `X` (N, 3) with the faces on the curve of control vertices (V, 3), m.

        None where an actuator would leave its bounds (n_a,), m.
        """
        layout, kinematics = self._layout, self._kinematics
        fixed, free = layout.fixed, layout.truss.free
        points = layout.curve_weights @ vertices
        X, worst, enough = X.copy(), np.inf, enough_length(X, tolerance)
        for _ in range(5):
            kinematics.evaluate_members(X)
            error = self._home_lengths[fixed] - kinematics.lengths[fixed]
            gap = points - kinematics.face_centres(X)[layout.tracked]
            worst = max(float(np.max(np.abs(error), initial=0.0)), float(np.max(np.abs(gap))))
            if worst <= enough or not worst < 1e-2:
                break
            try:
                X[free] += self._solver.solve(kinematics.gradient, error, gap)
            except SolverError:
                return None
        strokes = kinematics.lengths[layout.truss.actuators]
        if not within(strokes, lower, upper, enough):
            return None
        return Closed(
            X, kinematics.lengths.copy(), worst, kinematics.tip_position(X), kinematics.tip_rotation.copy()
        )


def within(strokes: Array, lower: Array, upper: Array, spare: float) -> bool:
    """Return whether lengths (n_a,) are between their bounds, give or take `spare`, m."""
    return bool(np.all(strokes >= lower - spare) and np.all(strokes <= upper + spare))


def enough_length(X: Array, tolerance: float) -> float:
    """Return the error of a length, m, that nothing is gained by making smaller.

    Divided by a short step's duration, once or twice, an error of `tolerance` is a rate that counts; but the lengths
    of an arm that is a kilometre long are not known better than its nodes' places can be told apart.
    """
    return max(1e-3 * tolerance, 8.0 * _ROUNDING * float(np.abs(X).max()))


def enough_tip_error(X: Array, tolerance: float) -> float:
    """Return the tip error, m or rad, that nothing is gained by making smaller; see `enough_length`."""
    return max(_SETTLED * tolerance, 1e3 * _ROUNDING * float(np.abs(X).max()))


def settle_strokes(
    closed: Closed,
    actuators: NDArray[np.int64],
    close: Callable[[Array, Array, Array], Closed],
    tip_error: Callable[[Closed], Array],
    find_gain: Callable[[], Array | None],
    bounds: tuple[Array, Array],
    accuracy: Accuracy,
) -> Closed | None:
    """Return a configuration near `closed` with the tip at its goal; None where another QP is due.

    Parameters
    ----------
    close
        Closes the lengths near positions (N, 3), with actuated lengths between bounds (n_a,), m.
    tip_error
        (n_e,) goal minus value, m or rad.
    find_gain
        Asked at most once: (n_a, n_e) changes of the actuated lengths per tip error, or None.
    bounds
        Least and greatest lengths (n_a,) of the actuated members, m.
    """
    gain: Array | None = None
    wanted = closed.lengths[actuators]
    enough = enough_tip_error(closed.X, accuracy.tip)
    for step in range(MOST_STEPS + 1):
        error = tip_error(closed)
        off = float(np.abs(error).max())
        if not (closed.error <= accuracy.member and off <= accuracy.start):
            return None
        if step == MOST_STEPS or off <= enough:
            break
        gain = find_gain() if gain is None else gain
        if gain is None:
            break
        wanted = wanted + gain @ error
        strokes = np.clip(wanted, *bounds)
        closed = close(closed.X, strokes, strokes)
    return closed if off <= accuracy.tip else None


class PlainEngine:
    """NumPy linearisation and a solver by name."""

    def __init__(self, linearisation: Linearisation, solver: StepSolver) -> None:
        self._linearisation = linearisation
        self._solver = solver
        arm = linearisation.layout, linearisation.kinematics, linearisation.home_lengths
        self._lengths = LengthCloser(*arm)
        self._faces = CurveCloser(*arm) if _holds_faces(linearisation.layout) else None
        self._last: tuple[StepNumbers, StepSolution] | None = None
        self._vertices: Array = np.zeros((0, 3))
        self._strokes: Array = np.zeros(0)

    def solve(self, asked: QPInput) -> StepSolution:
        """See :class:`Engine`."""
        numbers = self._linearisation.numbers(
            asked.X,
            asked.vertices,
            asked.target,
            asked.progress,
            asked.rows,
            motion=asked.motion,
            at=None if asked.Y is asked.X else asked.Y,
            torsion=asked.torsion,
        )
        solution = self._solver.solve(numbers)
        lengths = self._linearisation.kinematics.lengths[self._linearisation.layout.truss.actuators]
        self._strokes = lengths + solution.actuators
        # The kinematics overwrites its gradients at the next configuration.
        self._last = replace(numbers, gradient=numbers.gradient.copy()), solution
        self._vertices = asked.vertices + solution.vertices
        return solution

    def settle(self, X: Array, target: Target, goal: PathPoint, accuracy: Accuracy) -> Closed | None:
        """See :class:`Engine`."""
        bounds = target.lower, target.upper

        def tip_error(closed: Closed) -> Array:
            task = self._linearisation.task
            return task.residual(closed.tip_position, closed.tip_rotation, goal)[0]

        def close(X: Array, lower: Array, upper: Array) -> Closed:
            return self._lengths.close(X, lower, upper, accuracy.member)

        if self._faces is not None:
            held_on = self._faces.close(X, self._vertices, *bounds, accuracy.member)
            if held_on is not None and held_on.error <= accuracy.member:
                return held_on if float(np.abs(tip_error(held_on)).max()) <= accuracy.tip else None
        if isinstance(self._solver, StagedSolver):
            solver, last = self._solver, self._last
            assert last is not None
            at_bound = held(last[1].actuators, last[0].lower, last[0].upper)
            actuators = self._linearisation.layout.truss.actuators
            strokes = np.clip(self._strokes, *bounds)
            first = close(X, strokes, strokes)
            return settle_strokes(
                first, actuators, close, tip_error, lambda: solver.gain(at_bound), bounds, accuracy
            )
        gain = self._gain()
        for step in range(SETTLING_STEPS + 1):
            closed = close(X, *bounds)
            error = tip_error(closed)
            off = float(np.abs(error).max())
            if not (closed.error <= accuracy.member and off <= accuracy.start):
                return None
            if gain is None or step == SETTLING_STEPS or off <= _SETTLED * accuracy.tip:
                break
            X = closed.X + gain @ error
        return closed if off <= accuracy.tip else None

    def _gain(self) -> Array | None:
        """Return what settles the tip after the last QP, (N, 3, n_e); None where only another QP does."""
        layout = self._linearisation.layout
        truss, weights = layout.truss, layout.weights
        if layout.hard_tracking or self._last is None:
            return None
        numbers, solution = self._last
        jacobian = layout.length_jacobian(numbers.gradient)
        _, _, response, failed = dgesv(jacobian, np.eye(truss.member_count)[:, truss.actuators])
        if failed:
            return None
        every = np.zeros((truss.node_count, 3, response.shape[1]))
        every[truss.free] = response.reshape(-1, 3, response.shape[1])
        tip = numbers.tip_jacobian @ every[truss.tip].reshape(-1, response.shape[1])
        free = ~held(solution.actuators, numbers.lower, numbers.upper)
        gain = settling_gain(
            response, tip, free, weights.node_rate, weights.actuator_rate + weights.stroke_centring
        )
        return None if gain is None else every @ gain


def _holds_faces(layout: Layout) -> bool:
    """Whether faces that are held on the curve determine the nodes with the fixed members."""
    is_plain = layout.hard_tracking and layout.general is None and not layout.hard_turns
    stages = elimination_stages(layout) if is_plain else None
    return stages is not None and stage_faces(layout, stages) is not None


class ElasticEngine(PlainEngine):
    """A tip that may leave its path at an exact penalty: there it is where the QP puts it."""

    def settle(self, X: Array, target: Target, goal: PathPoint, accuracy: Accuracy) -> Closed | None:
        """See :class:`Engine`; a tip that had to leave its path is not moved."""
        slack = 0.0 if self._last is None else self._last[1].tip_slack
        closed = super().settle(X, target, goal, accuracy) if slack <= _ON_PATH else None
        if closed is not None or slack <= accuracy.tip:
            return closed
        closed = self._lengths.close(X, target.lower, target.upper, accuracy.member)
        return closed if closed.error <= accuracy.member else None


class FusedEngine:
    """One compiled call from positions to QP, for trusses whose bays can be eliminated one after another."""

    def __init__(self, solver: FusedSolver) -> None:
        self._solver = solver
        self._vertices = np.zeros((solver.layout.vertices, 3))

    def drawn(self, layout: Layout) -> FusedEngine:
        """Return the engine for a layout that differs in the control vertices with goals alone."""
        return FusedEngine(self._solver.drawn(layout))

    def solve(self, asked: QPInput) -> StepSolution:
        """See :class:`Engine`."""
        self._load(asked)
        solution = self._solver.solve(asked.rows)
        self._vertices = asked.vertices + solution.vertices
        return solution

    def _load(self, asked: QPInput) -> None:
        solver, shape = self._solver, self._solver.layout.general
        target, goal, curve = asked.target, asked.goal, None
        span = target.end - target.start
        if shape is not None:
            frame = base_frame(solver.layout.truss, target.base_rotation)
            curve = shape.rows(asked.vertices, asked.torsion, frame)
        solver.load(
            asked.X,
            asked.Y,
            asked.vertices,
            target.lower,
            target.upper,
            TipGoal(goal.position, goal.rotation, goal.velocity * span, goal.spin * span),
            asked.progress,
            motion=asked.motion,
            base=target.base,
            curve=curve,
            goals=target.vertex_goals,
        )

    def ask(self, asked: QPInput) -> Callable[[], Taken] | None:
        """Solve the QP as :meth:`solve` does; return what checks the answer and settles where it leads.

        None where that is not one call: the path turns within the step, the base moves, or too many rows are near.
        """
        near, target = len(asked.rows), asked.target
        if near > NEAR or target.base is not None or not target.path.is_straight(target.start, target.end):
            return None
        self._load(asked)
        answer = self._solver.ask(asked.rows)
        return lambda: self._solver.take(answer, near)

    def settle(self, X: Array, target: Target, goal: PathPoint, accuracy: Accuracy) -> Closed | None:
        """See :class:`Engine`."""
        closed, before, after = self._solver.settle(
            X, self._vertices, target.lower, target.upper, goal.position, goal.rotation
        )
        if closed.error <= accuracy.member and before <= accuracy.start and after <= accuracy.tip:
            return closed
        return None
