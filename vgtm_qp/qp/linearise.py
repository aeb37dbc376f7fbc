"""From a configuration to the numbers of its QP: one compiled function linearises every row of a step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vgtm_qp.arm.symbols import Bound, Constants
from vgtm_qp.arrays import Array
from vgtm_qp.compiled import Kernel
from vgtm_qp.qp.graph import Argument, StepGraph, station_rows
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import ClearanceRows, Legs, StepNumbers
from vgtm_qp.qp.shape import CurveRows
from vgtm_qp.qp.stepper import Workspace
from vgtm_qp.rows.tip import TipGoal, progress_gradient


class StepInput(NamedTuple):
    """The point at which a step's QP is linearised.

    Attributes
    ----------
    q, at : configurations
        Configurations at which residuals and Jacobians are evaluated.
    base : (N, 3)
        Nodes at `q` after only the base has moved, m.
    vertices : (V, 3)
        Control vertices, m.
    lower, upper : (n_a,)
        Boxes of the actuators at the end of the step.
    motion : bool
        Whether the QP moves the arm. A correction instead returns to the constraints by the least displacement,
        without the gradients of the null-space objectives.
    progress : float
        Progress alpha so far; the QP may change it to any value from 0 to 1.
    goal : TipGoal
    curve : CurveRows or None
        Rows of a curve that constant tables do not describe.
    vertex_goals : (V, 3) or None
    torsion, base_frame : (T,), (3, 3)
        From which compiled code computes such rows.
    """

    q: Array
    at: Array
    base: Array
    vertices: Array
    lower: Array
    upper: Array
    motion: bool
    progress: float
    goal: TipGoal
    curve: CurveRows | None = None
    vertex_goals: Array | None = None
    torsion: Array = np.zeros(0)
    base_frame: Array = np.eye(3)

    def load(self, kernel: Kernel | Workspace) -> None:
        """Write the arguments of a function of ``StepGraph.inputs``."""
        inputs = kernel.inputs
        inputs[Argument.Q][:] = self.q.reshape(-1)
        inputs[Argument.AT][:] = self.at.reshape(-1)
        inputs[Argument.BASE][:] = self.base.reshape(-1)
        inputs[Argument.VERTICES][:] = self.vertices.reshape(-1)
        inputs[Argument.LOWER][:] = self.lower
        inputs[Argument.UPPER][:] = self.upper
        inputs[Argument.MOTION][0] = 1.0 if self.motion else 0.0
        inputs[Argument.PROGRESS][0] = self.progress
        inputs[Argument.GOAL][:] = self.goal.position
        inputs[Argument.TURNED][:] = self.goal.rotation.T.reshape(-1)
        inputs[Argument.VELOCITY][:] = self.goal.velocity
        inputs[Argument.SPIN][:] = self.goal.spin
        for k, table in enumerate(self.curve or (), start=Argument.GIVEN):
            inputs[k][:] = table.reshape(-1)


class Linearisation:
    """Fills :class:`StepNumbers` at a configuration.

    Attributes
    ----------
    quantities : (M,)
        The arm's, at the configuration linearised last.
    """

    def __init__(self, layout: Layout, *, compiled: bool = True) -> None:
        self.layout = layout
        self._kernel = linear_function(layout).kernel(compiled=compiled)
        self.quantities = self._kernel.outputs[0]

    def numbers(self, asked: StepInput, clearance: ClearanceRows) -> StepNumbers:
        """Return the QP's numbers, in new arrays."""
        layout, kernel = self.layout, self._kernel
        asked.load(kernel)
        kernel()
        count, tips, turns = len(layout.tracked), len(layout.tip_rows), layout.turns
        (
            _,
            strokes,
            error,
            rate,
            tip,
            curvature,
            offset,
            axes,
            legs,
            least,
            gap,
            turn,
            face,
            curve,
            *motion,
        ) = (output.copy() for output in kernel.outputs)
        moves = asked.motion
        home = layout.arm.home_quantities[layout.arm.actuators]
        vertices = asked.vertices
        shift, base_axes = np.zeros(3), axes.reshape(2, 3)
        base_rhs, pull = np.zeros(2), np.zeros_like(vertices)
        gap, turn = gap.reshape(count, 3), turn.reshape(count, turns)
        if layout.vertices:
            shift = offset[:3]
            base_rhs = -base_axes @ (vertices[1] - vertices[0])
        if moves:
            pull = layout.vertex_gradient(vertices, asked.vertex_goals)
        face = face.reshape(count, 9, turns).transpose(0, 2, 1)
        curve = curve.reshape(count, curve.size // max(count * turns, 1), turns).transpose(0, 2, 1)
        spacing = np.zeros(0) if asked.curve is None else asked.curve.spacing
        return StepNumbers(
            motion=layout.arm.motion_rows(*motion),
            lower=asked.lower - strokes,
            upper=asked.upper - strokes,
            actuator_gradient=moves * layout.centring_weights * (strokes - home),
            tip_jacobian=tip.reshape(-1, tips).T,
            tip_rate=rate,
            tip_rhs=error,
            progress_lower=1.0 - asked.progress if layout.elastic_tip else -asked.progress,
            progress_upper=1.0 - asked.progress,
            progress_gradient=progress_gradient(float(curvature[0]), asked.progress),
            progress_curvature=float(curvature[0]),
            position_rhs=gap,
            tangent_face=face,
            tangent_curve=curve,
            tangent_rhs=turn,
            vertex_gradient=pull,
            base_displacement=shift,
            base_axes=base_axes,
            base_rhs=base_rhs,
            clearance=clearance,
            legs=Legs(legs.reshape(len(least), vertices.size), least),
            spacing_rhs=spacing if moves else 0.0 * spacing,
            curve=asked.curve,
            own=(
                layout.own.curvature(asked.q, asked.base, motion=moves)
                if layout.own and layout.own.objectives
                else None
            ),
        )


def linear_function(layout: Layout) -> Bound:
    """Return the function that linearises a step of `layout`.

    Arguments are ``StepGraph.inputs``. Results, in this order:

    - quantities (M,) and strokes (n_a,);
    - error (n_e,) and rate (n_e,) of the tip, its Jacobian J_u (n_e, 3K) over its K nodes; curvature of the progress;
    - offsets (3, V) and base axes (3, 2) of the curve; rows (3 V, G) and bounds (G) of its legs;
    - gaps (3, S) and turns (R, S) of the S tracked stations; the turns' rows over the stations' nodes (R, 9S) and over
      the curve (``StationSymbols.curve``);
    - the values of ``Arm.motion_rows``.
    """
    constants = Constants()
    graph = StepGraph(layout, layout.arm.symbols(constants), constants)
    symbols = graph.symbols
    outputs = [
        symbols.quantities(graph.q),
        graph.strokes,
        graph.tip_error,
        graph.tip_rate,
        graph.tip_jacobian,
        graph.curvature,
        graph.offset,
        graph.base_axes,
        graph.leg_rows,
        graph.leg_lower,
        *station_rows(graph),
        *symbols.motion(graph.q, graph.at, graph.moved),
    ]
    return graph.bound("linear", outputs)
