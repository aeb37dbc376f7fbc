"""The engine of long arms: from the positions of the nodes to the step and back by sweeps along the bays.

Its QP is that of the general engine with the solvers of ``qp.long``; but the numbers of the QP are written where the
sweeps read them, and lengths are closed with what the QP has factorised.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Kinematics
from vgtm_qp.arm.frames import frame_constants, frame_function
from vgtm_qp.compiled import Kernel
from vgtm_qp.qp.fused import Closed
from vgtm_qp.qp.long.closing import MOST_STEPS, TOO_FAR
from vgtm_qp.qp.long.staged import StagedSolver
from vgtm_qp.qp.long.tracked import TrackedSolver
from vgtm_qp.qp.long.values import PeriodValues
from vgtm_qp.qp.numbers import RowNumbers, StepSolution
from vgtm_qp.qp.settle import held
from vgtm_qp.rows.tip import TipGoal, progress_gradient
from vgtm_qp.step.closing import Closing, enough_length, within
from vgtm_qp.step.engine import Accuracy, Engine, enough_tip_error
from vgtm_qp.step.target import QPInput, Target
from vgtm_qp.step.task import TipTask

Array = NDArray[np.float64]


class _Frame:
    """The frame of a few nodes, evaluated anew where they moved."""

    def __init__(self, home: Array, rotation: Array) -> None:
        cosines, sines, alignment = frame_constants(home, rotation)
        self._kernel = Kernel(frame_function(len(home)))
        for k, constant in enumerate((cosines, sines, alignment.T)):
            self._kernel.inputs[1 + k][:] = constant.reshape(-1)

    def at(self, nodes: Array) -> tuple[Array, Array]:
        """Return rotation (3, 3) and spin (3, 3K) where the nodes are at `nodes` (K, 3)."""
        corners = nodes.reshape(-1)
        if not np.array_equal(corners, self._kernel.inputs[0]):
            self._kernel.inputs[0][:] = corners
            self._kernel()
        rotation, spin = self._kernel.outputs
        return rotation.reshape(3, 3).T, spin.reshape(-1, 3).T


class ChainEngine(Engine):
    """See ``engine.Engine``; for arms of `serves`."""

    def __init__(self, solver: StagedSolver | TrackedSolver, kinematics: Kinematics, task: TipTask) -> None:
        super().__init__(solver.layout)
        layout, arm = self.layout, self.layout.arm
        home_lengths, tip = arm.home_quantities, arm.end_effector
        self._solver, self._task, self._data = solver, task, solver.data
        self._values = PeriodValues(solver.chain, solver.data)
        self._home_lengths = home_lengths
        frames = range(2) if tip.has_frame else ()
        self._tip_frames = [_Frame(arm.home[tip.nodes], tip.frame) for _ in frames]
        if layout.vertices:
            face = arm.stations.nodes[0]
            self._base_frame = _Frame(arm.home[face], arm.stations.frames[0])
        self._polygon = layout.weights.smoothness * layout.polygon_bending
        self._closing = solver.closing()
        chain = solver.chain
        self._kinematics = kinematics
        self._members = chain.members.reshape(-1)
        self._members_at = np.argsort(self._members)
        self._nodes, self._base = chain.nodes.reshape(-1), np.flatnonzero(arm.base)
        self._at = np.argsort(np.concatenate([self._nodes, self._base]))
        self._tip = np.array([np.flatnonzero(self._nodes == node)[0] for node in tip.nodes])
        self._aims = home_lengths.copy()
        self._strokes = home_lengths[arm.actuators]
        self._answer = (self._strokes, self._strokes, self._strokes)
        self._vertices: Array = np.zeros((layout.vertices, 3))
        self._curve_weights = layout.curve_weights[chain.faces.reshape(-1)]
        if isinstance(solver, TrackedSolver):
            self._closing.aims[0][:] = home_lengths[chain.members]

    @staticmethod
    def serves(solver: StagedSolver | TrackedSolver) -> bool:
        """Whether the arm with that solver is one whose bays are all alike, with a base face that does not bend."""
        if solver.chain.member_places is None:
            return False
        layout, arm = solver.layout, solver.layout.arm
        return not arm.base[arm.end_effector.nodes].any() and (
            not layout.vertices or bool(arm.base[arm.stations.nodes[0]].all())
        )

    def solve(self, asked: QPInput) -> StepSolution:
        """See ``engine.Engine``."""
        layout, arm, weights = self.layout, self.layout.arm, self.layout.weights
        X, Y, vertices, _, target, goal, progress, rows, motion = asked
        tip, actuators = arm.end_effector, arm.actuators
        moved = None if target.base is None else arm.based(X, target.base) - X
        if layout.vertices:
            base = X if moved is None else X + moved
            self._hold_base(base, vertices)
            if motion:
                pull = self._polygon @ vertices + layout.goal_pull(vertices, target.vertex_goals)
                self._data.vertex_gradient = pull
            else:
                self._data.vertex_gradient = np.zeros_like(vertices)
        self._values.fill(X, Y, vertices, moved, motion=motion)
        rotation, spin = np.eye(3), None
        if self._task.turns is not None:
            rotation, spin = self._tip_frames[0].at(X[tip.nodes])[0], self._tip_frames[1].at(Y[tip.nodes])[1]
        ahead = goal.over(target.end - target.start)
        error, rate, across, weight = self._task.residual(tip.position(X), rotation, ahead, motion=motion)
        length = self._values.lengths[actuators]
        curvature = weights.progress * weight
        numbers = RowNumbers(
            lower=target.lower - length,
            upper=target.upper - length,
            tip_jacobian=self._task.jacobian(across, spin),
            tip_rate=rate,
            tip_rhs=error,
            progress_lower=-progress,
            progress_upper=1.0 - progress,
            progress_gradient=progress_gradient(curvature, progress),
            progress_curvature=curvature,
            clearance=rows,
            actuator_gradient=weights.stroke_centring * (length - self._home_lengths[actuators])
            if motion
            else np.zeros_like(length),
        )
        solution = self._solver.solve_filled(numbers)
        self._answer = solution.actuators, numbers.lower, numbers.upper
        self._strokes = length + solution.actuators
        self._vertices = vertices + solution.vertices
        return solution

    def _hold_base(self, base: Array, vertices: Array) -> None:
        """Let the curve begin at the base face of node positions `base` (N, 3), at a right angle."""
        stations = self.layout.arm.stations
        first = base[stations.nodes[0]]
        axes = self._base_frame.at(first)[0][:, :2].T
        centre = stations.weights[0] @ first
        offset = np.zeros_like(vertices)
        offset[:2] = centre - vertices[0]
        offset[1] -= axes @ (vertices[1] - vertices[0]) @ axes
        self._data.hold_base(offset, np.cross(*axes))

    def settle(self, X: Array, target: Target, goal: TipGoal, accuracy: Accuracy) -> Closed | None:
        """See ``engine.Engine``."""
        bounds = target.lower, target.upper

        def tip_error(position: Array, rotation: Array) -> Array:
            return self._task.residual(position, rotation, goal)[0]

        if isinstance(self._solver, StagedSolver):
            return self._by_strokes(X, *bounds, tip_error, self._solver, accuracy)
        closed = self._on_curve(X, *bounds, accuracy.member)
        if not closed.error <= accuracy.member:
            closed = self._any_closing.close(X, *bounds, accuracy.member)
        is_there = float(np.abs(tip_error(closed.tip_position, closed.tip_rotation)).max()) <= accuracy.tip
        return closed if is_there and closed.error <= accuracy.member else None

    @cached_property
    def _any_closing(self) -> Closing:
        return Closing(self.layout, self._kinematics)

    def _by_strokes(
        self,
        X: Array,
        lower: Array,
        upper: Array,
        tip_error: Callable[[Array, Array], Array],
        solver: StagedSolver,
        accuracy: Accuracy,
    ) -> Closed | None:
        """Return what ``engine.settle_strokes`` does: each step corrects the lengths, and what it leaves of the tip.

        The actuated lengths are those of the QP's answer and what brings the tip to its goal, between bounds (n_a,).
        """
        closing = self._closing
        enough, enough_tip = enough_length(X, accuracy.member), enough_tip_error(X, accuracy.tip)
        (aims,) = closing.aims
        closing.start(X)
        wanted = np.clip(self._strokes, lower, upper)
        self._aim(aims, wanted)
        own: Array = X.take(self._nodes, axis=0)
        gain, is_given_up = None, False
        closer, worst = closing.step(own)
        off = np.inf
        for _ in range(MOST_STEPS):
            settled = off <= enough_tip or is_given_up
            if (worst <= enough and settled) or not worst < TOO_FAR:
                break
            own = closer.copy()
            error = tip_error(*self._tip_of(own, turned=self._task.turns is not None))
            off = float(np.abs(error).max())
            if off > accuracy.start:
                return None
            if off > enough_tip and not is_given_up:
                gain = solver.gain(held(*self._answer)) if gain is None else gain
                is_given_up = gain is None
            if gain is not None and off > enough_tip:
                wanted = wanted + gain @ error
                self._aim(aims, np.clip(wanted, lower, upper))
            closer, worst = closing.step(own)
        closed = self._closed(X, own, worst)
        is_there = float(np.abs(tip_error(closed.tip_position, closed.tip_rotation)).max()) <= accuracy.tip
        return closed if is_there and worst <= accuracy.member else None

    def _aim(self, aims: Array, strokes: Array) -> None:
        """Let actuated members aim at `strokes` (n_a,), m, and the others at their home lengths."""
        self._aims[self.layout.arm.actuators] = strokes
        np.take(self._aims, self._members, out=aims.reshape(-1), mode="clip")

    def _on_curve(self, X: Array, lower: Array, upper: Array, tolerance: float) -> Closed:
        """Return the configuration near `X` with the faces on the curve; of infinite error where actuators cannot."""
        closing, enough = self._closing, enough_length(X, tolerance)
        closing.start(X)
        np.matmul(self._curve_weights, self._vertices, out=closing.aims[1].reshape(-1, 3))
        own, worst = closing.run(X.take(self._nodes, axis=0), enough)
        closed = self._closed(X, own, worst)
        actuated = closed.quantities[self.layout.arm.actuators]
        return closed if within(actuated, lower, upper, enough) else replace(closed, error=np.inf)

    def _closed(self, X: Array, own: Array, worst: float) -> Closed:
        """Return the configuration whose free nodes are at `own`, in the order of the chain; base nodes as in `X`."""
        nodes = np.concatenate([own, X[self._base]]).take(self._at, axis=0)
        lengths = self._closing.lengths.reshape(-1).take(self._members_at)
        return Closed(nodes, lengths, worst, *self._tip_of(own, turned=True))

    def _tip_of(self, own: Array, *, turned: bool) -> tuple[Array, Array]:
        """Return position (3,) of the tip where the free nodes are at `own`, and its rotation where it `turned`."""
        corners = own[self._tip]
        rotation = self._tip_frames[0].at(corners)[0].copy() if turned and self._tip_frames else np.eye(3)
        return self.layout.arm.end_effector.weights @ corners, rotation
