"""The rows of a step as one compiled function, for the C that condenses them; see ``native/qp.c``."""

from __future__ import annotations

import casadi as ca

from vgtm_qp.arm.symbols import Bound, Constants
from vgtm_qp.qp.graph import StepGraph, station_rows
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import UNBOUNDED
from vgtm_qp.rows.curve import polygon_bending
from vgtm_qp.rows.tip import progress_gradient

RESULTS = (
    *(
        "tip_jacobian",
        "tip_rate",
        "lower",
        "upper",
        "linear",
        "curvature",
        "offset",
        "normal",
        "leg_rows",
        "leg_lower",
    ),
    *("gaps", "turns", "faces", "bends", "stretches", "moved"),
)
"""Names of the first results of :func:`row_function`; those of the arm's motion follow."""


def row_function(layout: Layout) -> Bound:
    """Return the function that linearises the QP of a step; C condenses it.

    Arguments are ``StepGraph.inputs``. :data:`RESULTS`: J_u (n_e, 3K) and the path's rate (n_e); lower and upper bounds
    (n + n_e) of unknowns and tip rows, which are those of J_u d_rho less the rate times d_alpha; gradient (n)
    of the terms that are no least squares, but for the slacks' penalty; curvature of the progress; offsets (3, V) of
    the control vertices; base normal (3); rows (q, G) and bounds (G) of the legs. Then, one block a tracked station,
    gaps (3, K), turns (R, K), the rows of the turns over the station's nodes (R, 9 K) and over the curve
    (``StationSymbols.curve``); stretches (S); displacements (3, N) of nodes with the base.

    Last the motion of the free nodes: where actuators move nodes by twists, the twists (6, n_a) and the free nodes at
    `at` (3, N - N_c); else ``ArmSymbols.motion``.
    """
    constants, arm = Constants(), layout.arm
    graph = StepGraph(layout, arm.symbols(constants), constants)
    centring = graph.table("centring", layout.centring_weights)
    free, motion = layout.free_curve, graph.motion
    home = graph.symbols.home[arm.actuators.tolist()]
    unbounded, slack = ca.DM.ones(free) * UNBOUNDED, ca.DM.ones(len(layout.slack_levers)) * UNBOUNDED
    # An elastic tip is on time.
    least = 1.0 - graph.progress if layout.elastic_tip else -graph.progress
    twists = graph.symbols.twists(graph.at)
    if twists is None:
        moving = graph.symbols.motion(graph.q, graph.at, graph.moved)
    else:
        moving = [twists, graph.Y[:, arm.free.tolist()]]
    return graph.bound(
        "rows",
        [
            graph.tip_jacobian,
            graph.tip_rate,
            ca.vertcat(graph.lower - graph.strokes, -unbounded, 0.0 * slack, least, graph.tip_error),
            ca.vertcat(graph.upper - graph.strokes, unbounded, slack, 1.0 - graph.progress, graph.tip_error),
            ca.vertcat(
                motion * centring * (graph.strokes - home),
                _curve_gradient(graph),
                0.0 * slack,
                progress_gradient(graph.curvature, graph.progress),
            ),
            graph.curvature,
            graph.offset,
            graph.normal,
            leg_rows(layout, graph.leg_rows, graph.normal),
            graph.leg_lower,
            *station_rows(graph),
            motion * graph.given[4] if layout.spacings else ca.MX(0, 1),
            graph.moved,
            *moving,
        ],
    )


def leg_rows(layout: Layout, rows: ca.MX, normal: ca.MX) -> ca.MX:
    """Return (q, G) the rows (3 V, G) of the legs over the free coordinates of the curve, given its base's normal."""
    if not layout.vertices:
        return rows
    return ca.vertcat(normal.T @ rows[3:6, :], rows[6:, :], ca.MX.zeros(layout.torsion, len(layout.legs)))


def _curve_gradient(graph: StepGraph) -> ca.MX:
    """Return (q, 1) the gradient of the curve's own objectives in its free coordinates."""
    layout = graph.layout
    if not layout.vertices:
        return ca.MX.zeros(0, 1)
    curve_rate, smoothness = graph.weights(layout.weights.curve_rate, layout.weights.smoothness)
    bend = ca.DM(polygon_bending(layout.vertices))
    pull = curve_rate * graph.offset + smoothness * ((graph.offset + graph.motion * graph.vertices) @ bend)
    return ca.vertcat(ca.dot(pull[:, 1], graph.normal), ca.vec(pull[:, 2:]), ca.MX.zeros(layout.torsion))
