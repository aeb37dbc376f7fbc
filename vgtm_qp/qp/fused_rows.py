"""The condensed QP of a step, from a configuration, for arms whose coordinates can be eliminated one after another."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca

from vgtm_qp.arm.symbols import Bound, Constants
from vgtm_qp.qp.graph import StationSymbols, StepGraph
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.numbers import UNBOUNDED
from vgtm_qp.rows import curve as curve_rows
from vgtm_qp.rows.tip import progress_gradient


def row_function(layout: Layout) -> Bound:
    """Return the function that linearises and condenses the QP of a step.

    Arguments are ``StepGraph.inputs``. Results: R (3 (N - N_c) + (3 + R) K + S, n_a + q + 1), whose Gram matrix holds
    the Hessian and, in its last column, the gradient of the least-squares terms; tip rows (n_a + q + 1, n_e); lower and
    upper bounds (n_a + q + 1 + n_e) of the unknowns and tip rows; gradient of the other terms (n_a + q + 1); curvature
    of the progress; offsets (3, V) of the control vertices; base normal (3); rows (q, G) and bounds (G) of the legs.

    If the actuators move the nodes by twists, R lacks the rows of the nodes and the columns of the actuators, and the
    tip rows are their last column. Further results then give the rest: twists (6, n_a); the free nodes at `at`
    (3, N - N_c) and their motions with the base; wrenches (6, n_e + (3 + R) K + S) of the tip rows, then those of R. A
    row's entry in the column of an actuator that moves all its nodes is the product of wrench and twist.
    """
    constants, arm, weights = Constants(), layout.arm, layout.weights
    graph = StepGraph(layout, arm.symbols(constants), constants)
    (node_rate,) = graph.weights(weights.node_rate)
    centring = graph.table("centring", layout.centring_weights)
    twists = graph.symbols.twists(graph.at)
    actuators = len(arm.actuators) if twists is None else 0
    moved = ca.vec(graph.moved[:, arm.free.tolist()])
    response = graph.symbols.response(graph.q, graph.at, graph.moved) if twists is None else moved
    free, rows = layout.free_curve, len(layout.tip_rows)
    place = {int(node): 3 * k for k, node in enumerate(arm.free)}

    def displacement(nodes: list[int]) -> ca.MX:
        """Rows (3 K, n_a + 1) of the displacement of nodes; base nodes move with the base."""
        zero = ca.MX.zeros(3, actuators)
        parts = [
            response[place[node] : place[node] + 3, :]
            if node in place
            else ca.horzcat(zero, graph.moved[:, node])
            for node in nodes
        ]
        return ca.vertcat(*parts)

    tip_nodes = arm.end_effector.nodes.tolist()
    tip_rows = graph.tip_jacobian @ displacement(tip_nodes)
    stack, wrenches = _tracking_rows(graph, displacement, actuators) if layout.vertices else ([], [])
    if twists is None:
        top = ca.sqrt(node_rate) * response
        stack.insert(0, ca.horzcat(top[:, :-1], ca.MX.zeros(layout.node_columns, free), top[:, -1]))
        bodies = []
    else:
        stack, tip_rows = stack or [ca.MX.zeros(0, 1)], ca.horzcat(tip_rows[:, :0], tip_rows[:, -1])
        tip = _wrenches(graph.tip_jacobian, graph.Y[:, tip_nodes])
        bodies = [twists, graph.Y[:, arm.free.tolist()], moved, ca.horzcat(tip, *wrenches)]
    home = graph.symbols.home[arm.actuators.tolist()]
    unbounded = ca.DM.ones(free) * UNBOUNDED
    value = graph.tip_error - tip_rows[:, -1]
    return graph.bound(
        "rows",
        [
            ca.vertcat(*stack),
            ca.horzcat(tip_rows[:, :-1], ca.MX.zeros(rows, free if twists is None else 0), -graph.tip_rate).T,
            ca.vertcat(graph.lower - graph.strokes, -unbounded, -graph.progress, value),
            ca.vertcat(graph.upper - graph.strokes, unbounded, 1.0 - graph.progress, value),
            ca.vertcat(
                graph.motion * centring * (graph.strokes - home),
                _curve_gradient(graph),
                progress_gradient(graph.curvature, graph.progress),
            ),
            graph.curvature,
            graph.offset,
            graph.normal,
            _leg_rows(graph),
            graph.leg_lower,
            *bodies,
        ],
    )


def _wrenches(rows: Any, nodes: Any) -> Any:
    """Return (6, R) the wrenches of rows (R, 3 K) over nodes (3, K): sums of moments and of forces."""
    forces = [rows[:, 3 * k : 3 * k + 3].T for k in range(nodes.shape[1])]
    moments = [ca.skew(nodes[:, k]) @ force for k, force in enumerate(forces)]
    return ca.vertcat(sum(moments[1:], moments[0]), sum(forces[1:], forces[0]))


def _leg_rows(graph: StepGraph) -> ca.MX:
    """Return (q, G) the rows of the legs over the free coordinates of the curve."""
    layout, axes = graph.layout, graph.leg_axes
    rows = ca.MX.zeros(layout.free_curve, len(layout.legs))
    for k, (start, _) in enumerate(layout.legs.tolist()):
        if start == 0:
            # The first leg is along the first of the free coordinates.
            rows[0, k] = 1.0
            continue
        first = 3 * start - 5
        rows[first : first + 6, k] = ca.vertcat(-axes[:, k], axes[:, k])
    return rows


def _tracking_rows(
    graph: StepGraph, displacement: Callable[[list[int]], ca.MX], actuators: int
) -> tuple[list[ca.MX], list[ca.MX]]:
    """Return the rows of all gaps, turns and spacings, times the roots of their weights; hard rows times 1.

    And their wrenches. There are columns of as many `actuators` as `displacement` has.
    """
    layout, arm, weights = graph.layout, graph.layout.arm, graph.layout.weights
    tracking, tangent, roll, spacing = graph.weights(
        weights.tracking, weights.tangent, weights.roll, weights.spacing
    )
    station, motion, offset = _condensed_station(layout, actuators), graph.motion, graph.offset
    every = offset if layout.general is None else ca.vertcat(ca.vec(offset), ca.MX.zeros(layout.torsion))
    scales = ca.repmat(ca.sqrt(tracking), 3), ca.sqrt(ca.vertcat(tangent, tangent, roll)[: layout.turns])
    gaps, tilts, gap_wrenches, tilt_wrenches = [], [], [], []
    wrench = _station_wrenches(layout)
    for k, face in enumerate(layout.tracked.tolist()):
        nodes = arm.stations.nodes[face].tolist()
        moving = displacement(nodes)
        hard = [ca.DM(mask[k].astype(float)) for mask in (layout.hard_gaps, layout.hard_tilts)]
        # Corrections close hard rows as well, without a weight.
        closed = [mask + (1.0 - mask) * motion for mask in hard]
        rows = station(*graph.station(k), moving, every, graph.normal, *closed, *hard)
        weighed = [mask + (1.0 - mask) * scale for mask, scale in zip(hard, scales, strict=True)]
        gap, tilt = (ca.repmat(w, 1, row.shape[1]) * row for w, row in zip(weighed, rows, strict=True))
        gaps.append(gap)
        tilts.append(tilt)
        of_gap, of_tilt = wrench(*graph.station(k), graph.Y[:, nodes], *weighed)
        gap_wrenches.append(of_gap)
        tilt_wrenches.append(of_tilt)
    if layout.spacings:
        pieces, rows = graph.given[4], graph.given[5].T
        stretch = ca.horzcat(curve_rows.free_columns(rows, graph.normal), motion * pieces + rows @ every)
        tilts.append(ca.sqrt(spacing) * ca.horzcat(ca.MX.zeros(layout.spacings, actuators), stretch))
        tilt_wrenches.append(ca.MX.zeros(6, layout.spacings))
    return gaps + tilts, gap_wrenches + tilt_wrenches


def _station_wrenches(layout: Layout) -> ca.Function:
    """Return the wrenches (6, 3) of gap and (6, R) of turn rows of one station, times weights (3) and (R)."""
    station, places = StationSymbols(layout), ca.SX.sym("places", 3, 3)
    weights = ca.SX.sym("gap_weight", 3), ca.SX.sym("turn_weight", layout.turns)
    rows = ca.kron(station.weights.T, ca.SX.eye(3)), station.face
    wrenches = [_wrenches(ca.diag(weight) @ row, places) for weight, row in zip(weights, rows, strict=True)]
    inputs = [*station.inputs, places, *weights]
    return ca.Function("wrench", inputs, [ca.densify(wrench) for wrench in wrenches])


def _curve_gradient(graph: StepGraph) -> ca.MX:
    """Return (q, 1) the gradient of the curve's own objectives in its free coordinates."""
    layout = graph.layout
    if not layout.vertices:
        return ca.MX.zeros(0, 1)
    curve_rate, smoothness = graph.weights(layout.weights.curve_rate, layout.weights.smoothness)
    bend = ca.DM(layout.polygon_bending)
    pull = curve_rate * graph.offset + smoothness * ((graph.offset + graph.motion * graph.vertices) @ bend)
    return ca.vertcat(ca.dot(pull[:, 1], graph.normal), ca.vec(pull[:, 2:]), ca.MX.zeros(layout.torsion))


def _condensed_station(layout: Layout, actuators: int) -> ca.Function:
    """Return the tracking rows (3, n) and turn rows (R, n) of one station, n = n_a + q + 1."""
    station = StationSymbols(layout)
    moving = ca.SX.sym("moving", 9, actuators + 1)
    size = 3 * layout.vertices + layout.torsion
    offset = ca.SX.sym("offset", 3, layout.vertices) if layout.general is None else ca.SX.sym("offset", size)
    normal, gap_on, turn_on = (
        ca.SX.sym("normal", 3),
        ca.SX.sym("gap_on", 3),
        ca.SX.sym("turn_on", layout.turns),
    )
    centre, turned = ca.kron(station.weights.T, ca.SX.eye(3)) @ moving, station.face @ moving
    gap_curve, turn_curve, gap_offset, turn_offset = station.over_curve(offset, normal)
    hard = ca.SX.sym("hard_gap", 3), ca.SX.sym("hard_turn", layout.turns)
    drawn_gap, drawn_turn = station.drawn(*hard)
    gap = gap_on * drawn_gap + centre[:, -1] + gap_offset
    turn = turn_on * drawn_turn + turned[:, -1] + turn_offset
    results = [
        ca.horzcat(centre[:, :-1], gap_curve, gap),
        ca.horzcat(turned[:, :-1], turn_curve, turn),
    ]
    inputs = [*station.inputs, moving, offset, normal, gap_on, turn_on, *hard]
    return ca.Function("curve_node", inputs, [ca.densify(result) for result in results])
