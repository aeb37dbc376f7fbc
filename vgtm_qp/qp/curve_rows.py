"""A curve at its nodes as CasADi functions, for curves that constant tables do not describe (sections 4.3-4.4).

They give what :class:`vgtm_qp.curve.curve.Curve` gives for any parameter, but at the nodes alone, in a twentieth of the
time, and only for curves without cusps: they say themselves where they may be wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import comb, perm
from typing import Any

import casadi as ca
import numpy as np

from vgtm_qp.arm.symbols import Bound, Constants
from vgtm_qp.arrays import Array
from vgtm_qp.curve.families import CurveFamily, difference, within
from vgtm_qp.rows.curve import spacing

_CELLS = 32
"""Least number of cells of the quadratures."""

_SMOOTH = 3e-6
"""Greatest part of degree 6 or 7 of the speed in a cell, over its mean: 8 Gauss points then leave errors of 1e-13,
seldom of 1e-11."""

_STEADY = 3e-4
"""The same of kappa b over its greatest magnitude: its integrals have errors of 1e-12 then; 1e-10 at ten times that."""

_EVEN = 0.5
"""Least speed in a cell, over its mean."""

_NEWTON_STEPS = 5
_CONVERGED = 1e-8
"""Greatest last step of Newton's method; one more would be below rounding."""

_AGAINST = 1e-9
"""Least sum of 1 and the cosine between the base's normal and the curve's tangent there."""

_NO_STEP = 1e-9
"""Length of an interval whose chord has the direction of the tangent."""


@dataclass(frozen=True, eq=False)
class CurvePlacing:
    """How a curve's nodes are placed on it, and how much of its frame the stations track.

    Attributes
    ----------
    family : CurveFamily
    nodes : (K,)
        Parameters s_k, or fractions of the arc length where `by_arc_length`.
    by_arc_length : bool
        Nodes keep their fractions of the arc length; s_k moves with the curve.
    torsion : int
        Number T of torsion coordinates.
    roll : (K,)
        Angle about the tangent from the curve's frame to the station at home, rad; kept if stations track roll.
    tracks_roll : bool
        Whether the third turn of a station is a row of the QP.
    spacing : (S,)
        Distances of successive nodes at home, the base first, m; S = K, or 0 without that objective.
    """

    family: CurveFamily
    nodes: Array
    by_arc_length: bool = False
    torsion: int = 0
    roll: Array | None = None
    tracks_roll: bool = False
    spacing: Array | None = None


def point_function(shape: CurvePlacing) -> Bound:
    """Return the function (vertices (3, V), torsion (T), base frame (3, 3)) -> the nodes of a curve alone.

    Results: ``position`` and ``frame`` of ``CurveRows``, transposed as CasADi reads them; and 1, or 0 where they may be
    wrong.
    """
    graph = _CurveGraph(shape)
    return graph.bound("curve_points", [graph.position, graph.frame])


def curve_function(shape: CurvePlacing) -> Bound:
    """Return the function (vertices (3, V), torsion (T), base frame (3, 3)) -> the fields of ``CurveRows``.

    They are transposed as CasADi reads them; the last result is as for :func:`point_function`.
    """
    graph = _CurveGraph(shape)
    position_rows, spin_rows = graph.rows()
    spacing = graph.spacing(position_rows)
    return graph.bound("curve_rows", [graph.position, position_rows, graph.frame, spin_rows, *spacing])


class _CurveGraph:
    """A curve at its nodes in symbols.

    Attributes
    ----------
    position, slope, tangent, speed : (3, K), (3, K), (3, K), (1, K)
        r, r', r' / |r'| and |r'| at the nodes.
    frame : (3, 3 K)
        Transposed frames that stations track; without roll only the tangents, in the third rows.
    """

    def __init__(self, shape: CurvePlacing) -> None:
        self._shape, self._constants, family = shape, Constants(), shape.family
        self._count, self._size, self._degree = len(shape.nodes), family.control_vertices, family.degree
        self._vertices = ca.MX.sym("p", 3, self._size)
        self._torsion, self._base = ca.MX.sym("torsion", shape.torsion), ca.MX.sym("base", 3, 3)
        self._sound: list[ca.MX] = []
        self._nodes, self._weights = family.gauss
        # Arrays over segments, cells or nodes have one column for each.
        segments = len(family.breaks) - 1
        self._breaks = self._constants.add("breaks", family.breaks).T
        self._extraction = self._constants.add("extraction", family.extraction.reshape(segments, -1))
        self._cells = family.divided(_CELLS)
        self._edges = self._constants.add("cells", self._cells).T
        given = self._constants.add("nodes", shape.nodes).T
        self._s = self._located(given) if shape.by_arc_length else given
        self._fraction = given
        segment = _interval(self._breaks, self._s)
        begin = self._breaks[segment]
        self._segment = self._extraction[:, segment], begin, self._breaks[segment + 1] - begin
        extraction, begin, width = self._segment
        self._w, self._dw, self._ddw = self._basis.map(self._count)(extraction, self._s, begin, width)
        self.position, self.slope = self._vertices @ self._w, self._vertices @ self._dw
        self.speed, self.tangent = _parted(self.slope)
        self._sound.append(ca.mmin(self.speed) > 0.0)
        self.frame = self._turned() if shape.tracks_roll else self._tangents()

    def bound(self, name: str, results: list[ca.MX]) -> Bound:
        """Return the function of these results, and of whether they are right."""
        # NaN fails a comparison.
        sound = ca.sumsqr(ca.vertcat(*(ca.vec(result) for result in results))) < np.inf
        for one in self._sound:
            sound = ca.logic_and(sound, one)
        return self._constants.bound(name, [self._vertices, self._torsion, self._base], [*results, sound])

    @cached_property
    def _basis(self) -> ca.Function:
        """The function (extraction of a segment, s, its begin and width) -> w, w', w'' (V)."""
        size, degree, u = self._size, self._degree, ca.SX.sym("u")
        bernstein = ca.Function("bernstein", [u], _bernstein(degree, u))
        extraction = ca.MX.sym("extraction", size * (degree + 1))
        s, begin, width = ca.MX.sym("s"), ca.MX.sym("begin"), ca.MX.sym("width")
        points, basis = ca.reshape(extraction, size, degree + 1), bernstein((s - begin) / width)
        tables = [points @ b / width**order for order, b in enumerate(basis)]
        return ca.Function("basis", [extraction, s, begin, width], tables)

    @cached_property
    def _tables(self) -> tuple[ca.MX, ca.MX]:
        """(V, C G) w' and w'' at the Gauss points of the cells."""
        points, weights = within(self._cells, self._nodes).reshape(-1), self._shape.family.weights
        first, second = (self._constants.add(f"gauss_{order}", weights(points, order)) for order in (1, 2))
        return first, second

    @cached_property
    def _widths(self) -> ca.MX:
        """(1, C) of the cells."""
        return self._constants.add("widths", np.diff(self._cells)).T

    @cached_property
    def _speeds(self) -> ca.MX:
        """(G, C) speeds at the Gauss points of the cells."""
        speeds, _ = _parted(self._vertices @ self._tables[0])
        speeds = ca.reshape(speeds, len(self._nodes), -1)
        mean, parts = (
            ca.DM(self._weights).T @ speeds,
            ca.DM(_finest_parts(self._nodes, self._weights)) @ speeds,
        )
        self._sound.append(ca.mmax(ca.fabs(parts) / _rows(mean, 2)) < _SMOOTH)
        # A cusp between two cells leaves the speed smooth in both.
        self._sound.append(ca.mmin(speeds / _rows(mean, len(self._nodes))) > _EVEN)
        return speeds

    def _check_bends(self) -> None:
        """Demand that kappa b, whose integrals are the rows of the roll, is smooth in each cell, like the speed."""
        first, second = self._tables
        bends = _binormal().map(first.shape[1])(self._vertices @ first, self._vertices @ second)
        parts = ca.DM(_finest_parts(self._nodes, self._weights)) @ ca.reshape(bends.T, len(self._nodes), -1)
        scale = ca.mmax(ca.fabs(bends)) + _NO_STEP
        self._sound.append(ca.mmax(ca.fabs(parts)) / scale < _STEADY)

    def _located(self, fractions: ca.MX) -> ca.MX:
        """Return (1, K) the parameters at these fractions of the arc length: Newton's method within a cell."""
        lengths = (ca.DM(self._weights).T @ self._speeds) * self._widths
        until = ca.horzcat(0.0, _sum().mapaccum(lengths.numel())(0.0, lengths))
        goal = fractions * until[-1]
        cell = _interval(until, goal)
        low, high = self._edges[cell], self._edges[cell + 1]
        rest, whole = goal - until[cell], until[cell + 1] - until[cell]
        # No cell crosses a break.
        segment = _interval(self._breaks, 0.5 * (low + high))
        begin = self._breaks[segment]
        points = self._vertices @ ca.reshape(self._extraction, self._size, -1)
        points = ca.reshape(points, 3 * (self._degree + 1), -1)[:, segment]
        # The speed changes little within a cell.
        start = low + rest / whole * (high - low)
        newton = self._newton().map(self._count)
        s, change = newton(start, rest, low, high, points, begin, self._breaks[segment + 1] - begin)
        self._sound.append(ca.mmax(ca.fabs(change)) < _CONVERGED)
        return ca.if_else(fractions == 1.0, 1.0, s)

    def _newton(self) -> ca.Function:
        """Return the function (s, length from `low` on, low, high, segment) -> s at that length, and its last change.

        The segment is given by its Bezier points (3 (d + 1)), begin and width.
        """
        names = ("s", "rest", "low", "high", "begin", "width")
        s, rest, low, high, begin, width = (ca.MX.sym(name) for name in names)
        points = ca.MX.sym("points", 3 * (self._degree + 1))
        inside = low + (s - low) * ca.DM(self._nodes).T
        speeds = _speed(self._degree).map(len(self._nodes) + 1)(ca.horzcat(inside, s), points, begin, width)
        excess = (s - low) * ca.dot(ca.DM(self._weights).T, speeds[:-1]) - rest
        known = [rest, low, high, points, begin, width]
        step = ca.Function("step", [s, *known], [ca.fmax(low, ca.fmin(high, s - excess / speeds[-1]))])
        before = now = s
        for _ in range(_NEWTON_STEPS):
            before, now = now, step(now, *known)
        return ca.Function("newton", [s, *known], [now, now - before])

    def _tangents(self) -> ca.MX:
        """Return transposed frames with the tangents alone."""
        tangent = ca.MX.sym("tangent", 3)
        frame = ca.vertcat(ca.MX.zeros(2, 3), tangent.T)
        return ca.Function("tangents", [tangent], [ca.densify(frame)]).map(self._count)(self.tangent)

    def _turned(self) -> ca.MX:
        """Return transposed frames, carried along the curve without roll, then turned by torsion and the home roll."""
        family, constants = self._shape.family, self._constants
        position, slope = (
            self._vertices @ constants.add(f"grid_{order}", family.weights(family.cells, order))
            for order in (0, 1)
        )
        speed, tangent = _parted(slope)
        normal, start, x = self._base[:, 2], tangent[:, 0], self._base[:, 0]
        cosine, axis = ca.dot(normal, start), ca.cross(normal, start)
        self._start = normal, start, speed[0]
        self._sound += [ca.mmin(speed) > 0.0, 1.0 + cosine > _AGAINST, ca.MX(family.smooth)]
        # The least rotation that brings the normal on the tangent.
        x = cosine * x + ca.cross(axis, x) + axis * (ca.dot(axis, x) / (1.0 + cosine))
        carry, widths = _carry(), constants.add("grid_widths", np.diff(family.cells)).T
        ends = position[:, :-1], position[:, 1:], tangent[:, :-1], tangent[:, 1:]
        along = ca.horzcat(x, carry.mapaccum("along", len(family.cells) - 1, {"base": 4})(x, widths, *ends))
        grid = constants.add("grid", family.cells).T
        cell = _interval(grid, self._s)
        last = self._s - grid[cell], position[:, cell], self.position, tangent[:, cell], self.tangent
        x = carry.map(self._count)(along[:, cell], *last)
        roll = np.zeros(self._count) if self._shape.roll is None else self._shape.roll
        angle = constants.add("roll", roll).T + self._torsion.T @ self._torsions[0]
        return _rolled().map(self._count)(x, self.tangent, angle)

    @cached_property
    def _torsions(self) -> list[ca.MX]:
        """(T, K) weights of the torsion coordinates at the nodes, and their derivatives by s."""
        s, count = ca.SX.sym("s"), self._shape.torsion
        if not count:
            return [ca.MX.zeros(0, self._count)] * 2
        tables = [b[1:] for b in _bernstein(count, s)[:2]]
        function = ca.Function("torsions", [s], [ca.densify(table) for table in tables])
        return list(function.map(self._count)(self._s))

    def _over_interval(self) -> ca.Function:
        """Return the function (p, w', w'' at Gauss points, width) -> integrals (3 V) of w' t and of -w' kappa b."""
        size, points = self._size, len(self._nodes)
        vertices, width = ca.MX.sym("p", 3, size), ca.MX.sym("width")
        first, second = ca.MX.sym("w1", size, points), ca.MX.sym("w2", size, points)
        slope, weights = vertices @ first, _rows(width * ca.DM(self._weights).T, 3)
        values = [_parted(slope)[1]] * self._shape.by_arc_length
        if self._shape.tracks_roll:
            values.append(-_binormal().map(points)(slope, vertices @ second))
        sums = [ca.vec((weights * value) @ first.T) for value in values]
        return ca.Function("interval", [vertices, first, second, width], sums)

    def _integrals(self) -> list[tuple[ca.MX, ca.MX]]:
        """Return the integrals of :meth:`_over_interval` over 0 to s (3 V, K), each with that over all (3 V)."""
        count, cells, interval = self._count, len(self._cells) - 1, self._over_interval()
        whole = interval.map(cells).call([self._vertices, *self._tables, self._widths])
        s, low, begin, width = (ca.MX.sym(name) for name in ("s", "low", "begin", "width"))
        vertices = ca.MX.sym("p", 3, self._size)
        extraction = ca.MX.sym("extraction", self._extraction.shape[0])
        inside = low + (s - low) * ca.DM(self._nodes).T
        tables = self._basis.map(len(self._nodes))(extraction, inside, begin, width)[1:]
        arguments = [vertices, s, low, extraction, begin, width]
        part = ca.Function("part", arguments, interval.call([vertices, *tables, s - low]))
        cell = _interval(self._edges, self._s)
        last = part.map(count).call([self._vertices, self._s, self._edges[cell], *self._segment])
        number = ca.MX.sym("number")
        earlier = ca.Function("earlier", [number], [ca.DM(range(cells)) < number])
        before = earlier.map(count)(cell)
        return [(a @ before + b, ca.sum2(a)) for a, b in zip(whole, last, strict=True)]

    def rows(self) -> tuple[ca.MX, ca.MX]:
        """Return (D, 3 K) the rows of positions, and of the turns of frames.

        Nodes by arc length move along the curve when it changes: x_dot = J_s p_dot + x' s_dot; the paper's eq. (35)
        has the first term alone.
        """
        shape, count, size = self._shape, self._count, 3 * self._size
        roll, torsions = ca.MX.zeros(size, count), ca.MX.zeros(shape.torsion, count)
        rates, twist = ca.MX.zeros(size, count), ca.MX.zeros(1, count)
        if shape.by_arc_length or shape.tracks_roll:
            # They are as accurate as the integrals of the speed.
            assert self._speeds.shape[0]
            integrals = self._integrals()
        if shape.tracks_roll:
            self._check_bends()
            normal, start, speed = self._start
            swept = ca.cross(start, normal) / ((1.0 + ca.dot(normal, start)) * speed)
            at_base = self._constants.add("base_slopes", shape.family.weights(0.0, 1))
            roll = integrals[-1][0] + ca.kron(at_base, swept) @ ca.DM.ones(1, count)
            torsions, twist = self._torsions[0], self._torsion.T @ self._torsions[1]
        if shape.by_arc_length:
            until, whole = integrals[0]
            rates = whole @ self._fraction - until
            rates = rates / _rows(self.speed, size)
        of_node = _node_rows(self._size, shape.torsion)
        bend = self._vertices @ self._ddw
        position_rows, spin_rows = of_node.map(count)(
            self._w, self._dw, self.slope, bend, roll, torsions, twist, rates
        )
        return position_rows, spin_rows

    def spacing(self, position_rows: ca.MX) -> list[ca.MX]:
        """Return (S,) the distances of successive nodes less those at home, and (D, S) their rows."""
        home, size = self._shape.spacing, position_rows.shape[0]
        if home is None:
            return [ca.MX(0, 1), ca.MX(size, 0)]
        points = ca.horzcat(self._vertices[:, 0], self.position)
        rows = ca.horzcat(np.eye(size, 3), position_rows)
        chord, change = ca.MX.sym("chord", 3), ca.MX.sym("change", size, 3)
        function = ca.Function("spacing", [chord, change], spacing(ca.vertsplit(chord), ca.horzsplit(change)))
        pieces = points[:, 1:] - points[:, :-1], rows[:, 3:] - rows[:, :-3]
        lengths, changes = function.map(len(home))(*pieces)
        return [lengths.T - self._constants.add("spacing", home), changes]


def _finest_parts(nodes: Array, weights: Array) -> Array:
    """Return the matrix (2, G) from values at Gauss points to the last two coefficients of their Legendre series."""
    degrees = np.arange(len(nodes))
    table = (
        np.polynomial.legendre.legvander(2.0 * nodes - 1.0, degrees[-1])
        * weights[:, None]
        * (2 * degrees + 1)
    )
    return np.asarray(table.T[-2:])


def _interval(edges: ca.MX, at: ca.MX) -> ca.MX:
    """Return (1, K) the numbers of the intervals between `edges` (1, C + 1) in which `at` (1, K) are."""
    return ca.low(edges.T, at.T, {"lookup_mode": "binary"}).T


def _bernstein(degree: int, u: ca.SX) -> list[ca.SX]:
    """Return the Bernstein basis (d + 1,) of that degree at `u`, and its first and second derivative; all are dense."""
    powers, others = [ca.SX(1)], [ca.SX(1)]
    for _ in range(degree):
        powers.append(powers[-1] * u)
        others.append(others[-1] * (1 - u))
    tables = []
    for order in range(3):
        low = degree - order
        values = [comb(low, j) * powers[j] * others[low - j] for j in range(low + 1)]
        derivative = perm(degree, order) * (
            ca.DM(difference(degree + 1, order)).T @ ca.vertcat(*values, ca.SX(0, 1))
        )
        tables.append(ca.densify(derivative))
    return tables


def _rows(row: ca.MX, count: int) -> ca.MX:
    """Return (count, n) a row, repeated."""
    return ca.DM.ones(count, 1) @ row


def _parted(vectors: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Return the lengths (1, n) and the directions (3, n) of vectors."""
    lengths = ca.sqrt(ca.sum1(vectors * vectors))
    return lengths, vectors / _rows(lengths, 3)


def _sum() -> ca.Function:
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    return ca.Function("sum", [a, b], [a + b])


def _speed(degree: int) -> ca.Function:
    """Return the function (s, Bezier points (3 (d + 1)), begin and width of a segment) -> |r'|."""
    points, s = ca.SX.sym("points", 3 * (degree + 1)), ca.SX.sym("s")
    begin, width = ca.SX.sym("begin"), ca.SX.sym("width")
    slope = ca.reshape(points, 3, degree + 1) @ _bernstein(degree, (s - begin) / width)[1]
    return ca.Function("speed", [s, points, begin, width], [ca.norm_2(slope) / width])


def _binormal() -> ca.Function:
    """Return the function (r', r'') -> kappa b."""
    first, second = ca.SX.sym("first", 3), ca.SX.sym("second", 3)
    value = ca.cross(first, second) / ca.norm_2(first) ** 3
    return ca.Function("binormal", [first, second], [value])


def _reflected(vector: Any, normal: Any) -> Any:
    return vector - (2.0 * ca.dot(normal, vector) / ca.dot(normal, normal)) * normal


def _carry() -> ca.Function:
    """Return the function (x, width, places, tangents at both ends) -> x carried there by double reflection."""
    x, width = ca.SX.sym("x", 3), ca.SX.sym("width")
    start, end, tangent, goal = (ca.SX.sym(name, 3) for name in ("start", "end", "tangent", "goal"))
    # The direction of a chord of no length is that of the tangent.
    chord = ca.if_else(width < _NO_STEP, tangent, end - start)
    carried = _reflected(_reflected(x, chord), goal - _reflected(tangent, chord))
    return ca.Function("carry", [x, width, start, end, tangent, goal], [carried])


def _rolled() -> ca.Function:
    """Return the function (x, tangent, angle) -> the transposed frame after a turn about the tangent."""
    x, tangent, angle = ca.SX.sym("x", 3), ca.SX.sym("tangent", 3), ca.SX.sym("angle")
    y = ca.cross(tangent, x)
    cosine, sine = ca.cos(angle), ca.sin(angle)
    frame = ca.horzcat(cosine * x + sine * y, cosine * y - sine * x, tangent)
    return ca.Function("rolled", [x, tangent, angle], [frame.T])


def _node_rows(size: int, torsion: int) -> ca.Function:
    """Return the function that gives the rows (D, 3) of the position of a node, and of the turn of its frame.

    Its arguments: w, w' (V); r', r''; the rate of the roll by p (3 V) and by the torsion (T); tau'; and ds/dp (3 V).
    """
    names = {"w": size, "dw": size, "slope": 3, "bend": 3, "roll": 3 * size, "torsions": torsion}
    names |= {"twist": 1, "rates": 3 * size}
    arguments = [ca.MX.sym(name, count) for name, count in names.items()]
    w, dw, slope, bend, roll, torsions, twist, rates = arguments
    speed = ca.norm_2(slope)
    tangent = slope / speed
    across, along = -ca.skew(tangent) / speed, ca.cross(slope, bend) / speed**2 + twist * tangent
    # The columns of these rows are the vertices' three coordinates, one vertex after another.
    position = ca.horzcat(*(ca.vec(axis @ w.T) for axis in ca.horzsplit(ca.MX.eye(3))))
    turn = ca.horzcat(*(ca.vec(axis @ dw.T) for axis in ca.horzsplit(across)))
    position_rows = ca.vertcat(position + rates @ slope.T, ca.MX.zeros(torsion, 3))
    spin_rows = ca.vertcat(turn + roll @ tangent.T + rates @ along.T, torsions @ tangent.T)
    return ca.Function("node_rows", arguments, [ca.densify(rows) for rows in (position_rows, spin_rows)])
