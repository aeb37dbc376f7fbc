"""From a configuration to the numbers of its QP: every row of mathematics section 5, linearised there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.truss.kinematics import Kinematics
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import ClearanceRows, CurveNumbers, StepNumbers, progress_scale
from vgtm_qp.qp.shape import turn_rows
from vgtm_qp.step.path import Path, PathPoint
from vgtm_qp.step.task import TipTask, worth_closing

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Target:
    """What one step is asked for: a piece of a path, the time it takes and where the base will be.

    Attributes
    ----------
    path : Path
    start, end : float
        Values of the path variable between which the step moves; progress alpha runs from 0 to 1 over them.
    lower, upper : (n_a,)
        Actuator lengths allowed at the end of the step, m.
    time : float
        Time at the end of the step, s.
    base : (N, 3) or None
        Positions of the base nodes at the end of the step (other rows are ignored), m.
    base_rotation : (3, 3) or None
        Rotation of the base frame there.
    vertex_goals : (V, 3) or None
        Where control vertices are drawn to, m; the rows in ``Layout.vertex_goals`` count.
    """

    path: Path
    start: float
    end: float
    lower: Array
    upper: Array
    time: float
    base: Array | None = None
    base_rotation: Array | None = None
    vertex_goals: Array | None = None


class QPInput(NamedTuple):
    """What the QP of a step is linearised at and asked for.

    Attributes
    ----------
    X : (N, 3)
        Node positions where residuals are taken, m.
    Y : (N, 3)
        Those where Jacobians are; `X` itself for a correction.
    vertices, torsion : (V, 3), (T,)
        The curve, m and rad.
    target : Target
    goal : PathPoint
        The tip's, at `progress`.
    progress : float
        How much of the target's piece of path lies behind the tip, 0 to 1.
    rows : ClearanceRows
    motion : bool
        Whether it moves the arm; a correction returns to the constraints on the shortest way.
    """

    X: Array
    Y: Array
    vertices: Array
    torsion: Array
    target: Target
    goal: PathPoint
    progress: float
    rows: ClearanceRows
    motion: bool


class Linearisation:
    """Fills :class:`StepNumbers` at a configuration."""

    def __init__(self, layout: Layout, kinematics: Kinematics, task: TipTask, home_lengths: Array) -> None:
        self.layout = layout
        self.kinematics = kinematics
        self.task = task
        self.home_lengths = home_lengths
        self._fixed_lengths = home_lengths[layout.fixed]
        self._home_strokes = home_lengths[layout.truss.actuators]
        self._polygon = layout.weights.smoothness * layout.polygon_bending

    def length_error(self) -> float:
        """Return the largest error of a fixed member at the configuration evaluated last, m."""
        return float(
            np.max(np.abs(self.kinematics.lengths[self.layout.fixed] - self._fixed_lengths), initial=0.0)
        )

    def _base_rotation(self, X: Array) -> Array:
        """Return (3, 3) the frame of the base face at node positions `X` (N, 3); the kinematics is evaluated there."""
        self.kinematics.evaluate(X)
        return np.array(self.kinematics.face_rotation[0])

    def numbers(
        self,
        X: Array,
        vertices: Array,
        target: Target,
        progress: float,
        clearance: ClearanceRows,
        *,
        motion: bool,
        at: Array | None = None,
        torsion: Array | None = None,
    ) -> StepNumbers:
        """Return the QP's numbers at node positions `X` (N, 3) and control vertices (V, 3).

        Parameters
        ----------
        progress
            Progress alpha reached so far; the step may go back to 0 and on to 1.
        motion
            True for the QP that moves the arm; False for a correction, which returns to the constraints on the
            shortest way, without the gradients of the null-space objectives.
        at
            (N, 3) where the Jacobians are taken, m; `X` by default.
        torsion
            (T,) torsion coordinates of the curve, rad.
        """
        layout, kinematics, weights = self.layout, self.kinematics, self.layout.weights
        kinematics.evaluate(X if at is None else at)
        gradient, face_spin = kinematics.gradient, kinematics.face_spin
        tip_spin = kinematics.tip_spin
        if at is not None:
            gradient, face_spin, tip_spin = gradient.copy(), face_spin.copy(), tip_spin.copy()
            kinematics.evaluate(X)
        actuators, tracked = layout.truss.actuators, layout.tracked

        base_rotation = kinematics.face_rotation[0] if layout.vertices else np.eye(3)
        if target.base is not None and layout.vertices:
            base_rotation = self._base_rotation(np.where(layout.truss.base[:, None], target.base, X))
            kinematics.evaluate(X)

        length_rhs = np.zeros(layout.truss.member_count)
        length_rhs[layout.fixed] = self._fixed_lengths - kinematics.lengths[layout.fixed]
        shift = np.zeros(3)
        if target.base is not None:
            moved = np.where(layout.truss.base[:, None], target.base - X, 0.0)
            length_rhs -= layout.base_length_rate(gradient, moved)
        length = kinematics.lengths[actuators]

        span = target.end - target.start
        goal = target.path.at(target.start + progress * span)
        tip = self.task.rows(X, goal, tip_spin)
        rate = tip.rate * span
        curvature = weights.progress * progress_scale(rate)

        position_rhs = np.zeros((len(tracked), 3))
        tangent_face, tangent_curve = np.zeros((len(tracked), 2, 9)), np.zeros((len(tracked), 2, 3))
        tangent_rhs = np.zeros((len(tracked), 2))
        base_axes, base_rhs = np.zeros((2, 3)), np.zeros(2)
        vertex_gradient = np.zeros_like(vertices)
        curve = None
        if layout.general is not None:
            rows = layout.general.rows(
                vertices,
                np.zeros(0) if torsion is None else torsion,
                base_frame(layout.truss, target.base_rotation),
            )
            turns = turn_rows(rows, kinematics.face_rotation[tracked], face_spin[tracked], layout.turns)
            curve = CurveNumbers(
                position=rows.position_rows,
                turn_face=turns.face,
                turn_curve=turns.curve,
                turn_rhs=turns.residual if motion or layout.hard_turns else 0.0 * turns.residual,
                spacing=rows.spacing_rows,
                spacing_rhs=rows.spacing if motion else 0.0 * rows.spacing,
            )
        if layout.vertices:
            centres = kinematics.face_centres(X)
            if motion or layout.hard_tracking:
                nodes = layout.curve_weights @ vertices if layout.general is None else rows.position
                position_rhs = centres[tracked] - nodes
            slopes = layout.curve_slopes @ vertices
            speed = np.linalg.norm(slopes, axis=1, keepdims=True)
            tangents = slopes / speed
            axes = kinematics.face_rotation[tracked][:, :, :2].transpose(0, 2, 1)
            turn = np.cross(axes, tangents[:, None, :])
            tangent_face = np.einsum("kac,kcf->kaf", turn, face_spin[tracked])
            along = np.einsum("kac,kc->ka", axes, tangents)
            tangent_curve = (axes - along[..., None] * tangents[:, None, :]) / speed[:, None]
            if motion or layout.hard_turns:
                tangent_rhs = along
            if motion:
                vertex_gradient = self._polygon @ vertices + layout.goal_pull(vertices, target.vertex_goals)
            base_axes = base_rotation[:, :2].T
            shift = centres[0] - vertices[0]
            if target.base is not None:
                face = layout.truss.faces[0]
                shift = layout.truss.face_weights[0] @ target.base[face] - vertices[0]
            base_rhs = -base_axes @ (vertices[1] - vertices[0])
        return StepNumbers(
            gradient=gradient,
            length_rhs=length_rhs,
            lower=target.lower - length,
            upper=target.upper - length,
            actuator_gradient=weights.stroke_centring * (length - self._home_strokes)
            if motion
            else np.zeros(len(actuators)),
            tip_jacobian=tip.jacobian,
            tip_rate=rate,
            tip_rhs=worth_closing(tip.error) if motion else tip.error,
            progress_lower=1.0 - progress if layout.elastic_tip else -progress,
            progress_upper=1.0 - progress,
            progress_gradient=curvature * (progress - 2.0),
            progress_curvature=curvature,
            position_rhs=position_rhs,
            tangent_face=tangent_face,
            tangent_curve=tangent_curve,
            tangent_rhs=tangent_rhs,
            vertex_gradient=vertex_gradient,
            base_displacement=shift,
            base_axes=base_axes,
            base_rhs=base_rhs,
            clearance=clearance,
            curve=curve,
        )


def base_frame(truss: Truss, rotation: Array | None) -> Array:
    """Return (3, 3) the frame of the base face where the base is rotated by `rotation` (3, 3), or rests."""
    home = truss.face_frames[0]
    return home if rotation is None else np.asarray(rotation @ home)
