"""A step's QP in CasADi's symbols: the common part of its linearised and its condensed form."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from vgtm_qp.arm.arm import tip_frames
from vgtm_qp.arm.symbols import ArmSymbols, Bound, Constants, Frames
from vgtm_qp.qp.layout import Layout
from vgtm_qp.rows import curve as curve_rows
from vgtm_qp.rows import tip as tip_rows
from vgtm_qp.rows import tracking


class Argument:
    """Places of a step's arguments among ``StepGraph.inputs``; those of a general curve begin at GIVEN."""

    Q, AT, BASE, VERTICES, LOWER, UPPER, MOTION, PROGRESS, GOAL, TURNED, VELOCITY, SPIN, GIVEN = range(13)


class StepGraph:
    """Arguments of a step, and the rows that follow from them.

    Attributes
    ----------
    q, at
        Configurations where residuals and where Jacobians are evaluated.
    base : (3, N)
        Node positions when only the base has moved.
    vertices : (3, V)
    lower, upper : (n_a,)
        Boxes of the actuators.
    motion, progress : scalar
        1 for the QP that moves the arm and 0 for corrections; progress along the path so far.
    goal, turned, velocity, spin : (3,), (3, 3), (3,), (3,)
        Pose of the goal there, and its rates per unit of progress.
    given : list
        ``CurveRows`` as arguments, transposed as CasADi reads them, for curves that constant tables do not describe.
    X, moved : (3, N)
        Nodes at `q`, and their displacement with the base.
    strokes : (n_a,)
    tip_position, tip_rotation : (3,), (3, 3)
    tip_error, tip_rate, tip_jacobian : (n_e,), (n_e,), (n_e, 3K)
        Goal less value, the path's rate, and J_u at `at`.
    curvature : scalar
        Weight of the progress along the path.
    rotations, spins : (3, 3F), (3, 9F)
        Of the stations at `q`, and at `at`.
    base_axes, normal, offset : (3, 2), (3,), (3, V)
        Axes and normal of the curve's base, and the displacements that bring the curve back to it.
    leg_rows, leg_lower : (3 V, G), (G,)
        Rows and bounds of the legs of ``Layout.legs``, see ``rows.curve.legs``.
    """

    def __init__(self, layout: Layout, symbols: ArmSymbols, constants: Constants) -> None:
        arm = layout.arm
        self.layout, self.symbols, self._constants = layout, symbols, constants
        count, nodes, vertices = len(arm.actuators), len(arm.node_names), layout.vertices
        self.q, self.at = ca.MX.sym("q", *symbols.shape), ca.MX.sym("at", *symbols.shape)
        self.base = ca.MX.sym("base", 3, nodes)
        self.vertices = ca.MX.sym("p", 3, vertices)
        self.lower, self.upper = ca.MX.sym("lower", count), ca.MX.sym("upper", count)
        self.motion, self.progress = ca.MX.sym("motion"), ca.MX.sym("progress")
        self.goal, self.turned = ca.MX.sym("goal", 3), ca.MX.sym("turned", 3, 3)
        self.velocity, self.spin = ca.MX.sym("velocity", 3), ca.MX.sym("spin", 3)
        self.given = [] if layout.general is None else _given_curve(layout)
        self.X = symbols.nodes(self.q)
        self.Y = symbols.nodes(self.at)
        self.moved = ca.MX.zeros(3, nodes)
        self.moved[:, symbols.given] = (self.base - self.X)[:, symbols.given]
        self.strokes = symbols.quantities(self.q)[arm.actuators.tolist()]
        self._tip()
        self._curve()

    @property
    def inputs(self) -> list[ca.MX]:
        """Arguments of both functions by :class:`Argument`, the constants last."""
        return [
            *(self.q, self.at, self.base, self.vertices, self.lower, self.upper, self.motion, self.progress),
            *(self.goal, self.turned, self.velocity, self.spin, *self.given, *self._constants.symbols),
        ]

    def bound(self, name: str, results: list[ca.MX]) -> Bound:
        """Return the function of these `results`, dense."""
        function = ca.Function(name, self.inputs, [ca.densify(result) for result in results])
        return Bound(function, self._constants.values)

    def weights(self, *values: float) -> list[ca.MX]:
        """Return weights as constants."""
        return list(ca.vertsplit(self._constants.add("weights", np.array(values))))

    def table(self, name: str, value: np.ndarray) -> ca.MX:
        """Return a table as a constant; its columns are the rows of `value`."""
        return self._constants.add(name, value)

    def _tip(self) -> None:
        rows, tip = self.layout.tip_rows, self.layout.arm.end_effector
        nodes = tip.nodes.tolist()
        self.tip_position = self.X[:, nodes] @ ca.DM(tip.weights)
        self.tip_rotation, spin = ca.MX.eye(3), ca.MX.zeros(3, 3 * len(nodes))
        if tip.has_frame:
            frames = tip_frames(self.layout.arm, self._constants)
            self.tip_rotation = frames.rotations(self.X)
            _, spin = frames.at(self.Y)
        levers = self.table("levers", self.layout.tip_levers)
        unit, fineness = self.weights(self.layout.arm.unit, self.layout.arm.fineness)
        (weight,) = self.weights(self.layout.weights.progress)
        there = (self.tip_position, self.tip_rotation), (self.goal, self.turned), (self.velocity, self.spin)
        self.tip_error, self.tip_rate, of_progress = tip_rows.along_path(
            rows, *there, self.motion, levers, unit, fineness
        )
        position = ca.DM(np.kron(tip.weights, np.eye(3)))
        self.tip_jacobian = tip_rows.combined(rows, position, spin, self.tip_rotation)
        self.curvature = weight * of_progress

    def _curve(self) -> None:
        layout, stations = self.layout, self.layout.arm.stations
        self.base_axes, self.normal = ca.MX.zeros(3, 2), ca.MX.zeros(3)
        self.offset, self.leg_rows, self.leg_lower = ca.MX.zeros(3, 0), ca.MX.zeros(0, 0), ca.MX.zeros(0)
        if not layout.vertices:
            return
        home = layout.arm.home
        frames = Frames(home[stations.nodes], stations.frames, stations.nodes, self._constants, "station")
        self.rotations = frames.rotations(self.X)
        _, self.spins = frames.at(self.Y)
        start = stations.nodes[:1]
        base = Frames(home[start], stations.frames[:1], start, self._constants, "base")
        based = self.X + self.moved
        rotation = base.rotations(based)
        centre = based[:, start[0].tolist()] @ ca.DM(stations.weights[0])
        self.base_axes, self.normal = rotation[:, :2], rotation[:, 2]
        self.offset = curve_rows.base_offset(centre, rotation, self.vertices)
        if len(layout.legs):
            (least,) = self.weights(layout.least_leg)
            both = len(layout.legs) > 1
            self.leg_rows, self.leg_lower = curve_rows.legs(self.vertices, self.normal, least, both=both)
        if layout.general is None:
            self._tables = (
                self.table("curve_weights", layout.curve_weights),
                self.table("curve_slopes", layout.curve_slopes),
            )

    def station(self, k: int) -> tuple[list[ca.MX], list[ca.MX]]:
        """Return the arguments of :class:`StationSymbols` for the k-th tracked station: its places, and its rates."""
        layout, stations = self.layout, self.layout.arm.stations
        face = int(layout.tracked[k])
        nodes = stations.nodes[face].tolist()
        rotation, spin = self.rotations[:, 3 * face : 3 * face + 3], self.spins[:, 9 * face : 9 * face + 9]
        places = [self.X[:, nodes], rotation, ca.MX(ca.DM(stations.weights[face]))]
        if layout.general is None:
            weights, slopes = self._tables
            return [*places, self.vertices, weights[:, k], slopes[:, k]], [spin]
        block = slice(3 * k, 3 * k + 3)
        position, _, frame, spin_rows = self.given[:4]
        return [*places, position[:, k], frame[:, block]], [spin, spin_rows[:, block]]


class StationSymbols:
    """One station and its curve node as symbols.

    These are eqs. (32)-(39) at the station.

    Attributes
    ----------
    places, rates : list
        The result of ``StepGraph.station``; gap and turn are functions of the places alone.
    gap, turn : (3,), (R,)
    face : (R, 9)
        Rows of the turns over the station's nodes.
    """

    def __init__(self, layout: Layout) -> None:
        nodes, weights = ca.SX.sym("nodes", 3, 3), ca.SX.sym("face", 3)
        rotation, spin = ca.SX.sym("rotation", 3, 3), ca.SX.sym("spin", 3, 9)
        self.places, self.rates = [nodes, rotation, weights], [spin]
        self._is_tabled = layout.general is None
        if self._is_tabled:
            vertices = ca.SX.sym("p", 3, layout.vertices)
            at, slopes = ca.SX.sym("w", layout.vertices), ca.SX.sym("dw", layout.vertices)
            self.places += [vertices, at, slopes]
            point = vertices @ at
            self.turn, c, self.slope = tracking.slope_rows(rotation, vertices @ slopes)
        else:
            size = 3 * layout.vertices + layout.torsion
            point, frame = ca.SX.sym("position", 3), ca.SX.sym("frame", 3, 3)
            spin_rows = ca.SX.sym("spin_rows", size, 3)
            self.places += [point, frame]
            self.rates += [spin_rows]
            # CasADi reads the frame's rows as columns.
            self.turn, c = tracking.turns(rotation, frame.T, layout.turns)
            self._turned = -c @ spin_rows.T
        self.gap, self.face = tracking.gap(nodes @ weights, point), c @ spin
        self._reaches = layout.reach, layout.reach / layout.arm.unit

    def drawn(self, hard_gap: Any, hard_turn: Any) -> tuple[Any, Any]:
        """Return gap (3,) and turn (R,); components that are not equalities are cut to the reach of a step.

        The masks `hard_gap` (3,) and `hard_turn` (R,) mark the equalities.
        """
        both = (self.gap, hard_gap), (self.turn, hard_turn)
        if not np.isfinite(self._reaches[0]):
            return self.gap, self.turn
        gap, turn = (
            mask * error + (1.0 - mask) * tracking.within(error, reach)
            for (error, mask), reach in zip(both, self._reaches, strict=True)
        )
        return gap, turn

    @property
    def curve(self) -> Any:
        """Rows of the turns over the curve: (2, 3) over the slope r', or (R, 3 V + T) over all coordinates."""
        return self.slope if self._is_tabled else self._turned


def station_rows(graph: StepGraph) -> list[ca.MX]:
    """Return gaps (3, K), turns (R, K), rows of the turns over the stations' nodes (R, 9 K), and over the curve.

    One block a tracked station; see :class:`StationSymbols`. In a correction only the equalities are closed.
    """
    layout = graph.layout
    if not layout.vertices:
        return [ca.MX(0, 0)] * 4
    station = StationSymbols(layout)
    masks = ca.SX.sym("hard_gap", 3), ca.SX.sym("hard_turn", layout.turns)
    motion = ca.SX.sym("motion")
    errors = [
        (mask + (1.0 - mask) * motion) * error
        for mask, error in zip(masks, station.drawn(*masks), strict=True)
    ]
    results = [ca.densify(result) for result in (*errors, station.face, station.curve)]
    function = ca.Function("station", [*station.places, *station.rates, *masks, motion], results)
    hard = [ca.DM(mask.astype(float)) for mask in (layout.hard_gaps, layout.hard_tilts)]
    found = [
        function(*places, *rates, *(mask[k, :].T for mask in hard), graph.motion)
        for k, (places, rates) in enumerate(map(graph.station, range(len(layout.tracked))))
    ]
    return [ca.horzcat(*column) for column in zip(*found, strict=True)]


def _given_curve(layout: Layout) -> list[ca.MX]:
    """Return symbols for the arrays of ``CurveRows``: each array's last axis is the row index."""
    count, size, pieces = len(layout.tracked), 3 * layout.vertices + layout.torsion, layout.spacings
    shapes = {
        "position": (3, count),
        "position_rows": (size, 3 * count),
        "frame": (3, 3 * count),
        "spin_rows": (size, 3 * count),
        "stretch": (pieces, 1),
        "stretch_rows": (size, pieces),
    }
    return [ca.MX.sym(name, *shape) for name, shape in shapes.items()]
