"""The numbers of a step, period by period, as the eliminations along a chain read them.

They are copied from a QP's numbers, or computed from node positions by one compiled function mapped over
periods.
"""

from __future__ import annotations

from typing import NamedTuple, cast

import casadi as ca
import numpy as np

from vgtm_qp.arm.arm import LengthRowsLike
from vgtm_qp.arm.frames import fitted_frame, frame_constants, turning
from vgtm_qp.arrays import Array, Index
from vgtm_qp.compiled import Kernel
from vgtm_qp.qp.long.chain import Chain
from vgtm_qp.qp.long.elimination import member_lengths
from vgtm_qp.qp.long.sparse_symbols import dense_function, nonzeros, sparsity_of
from vgtm_qp.qp.numbers import Legs, StepNumbers
from vgtm_qp.rows import tracking
from vgtm_qp.rows.curve import free_basis


class ChainData:
    """The numbers of every period as rows of three arrays, and the terms in the curve alone.

    Attributes
    ----------
    head, tail, table : (n, ...)
        In the order of ``elimination.Inputs``; periods from the base to the tip, or reversed if
        `is_reversed`.
    part : dict
        Their parts by name.
    sizes : dict of dicts
        See ``elimination.Inputs``.
    turn_squares : (n, 9f)
        Products t t' of the rows t of ``tangent_curve``, summed over the two angles of a station.
    starts : dict
        The first column of each part.
    window, members, station_order : (n, w + m), (n, 3m), (n, f, 3) int
        Those of the chain, by row.
    at : (M,) int
        Places of the members in `members`.
    stations : (K,) int
        Positions in ``layout.tracked`` of the stations by row.
    is_hard : (K, 2) bool
        Whether gap and angles of those stations are equalities.
    weights, slopes : (K, V)
        Of the control vertices there.
    tracking, along : float, (V, V)
        Weight of the gaps, 0 with hard tracking; Hessian, per axis, of the terms in the vertices and of these.
    offset : (V, 3)
        Displacements of the control vertices for free coordinates of zero, m.
    normal : (3,)
        The direction in which the second control vertex moves.
    """

    def __init__(self, chain: Chain, sizes: dict[str, dict[str, int]], *, is_reversed: bool = False) -> None:
        self._chain, self.sizes, self.is_reversed = chain, sizes, is_reversed
        layout, order = chain.layout, slice(None, None, -1 if is_reversed else 1)
        self.part: dict[str, Array] = {}
        self.starts: dict[str, int] = {}
        arrays = []
        for parts in sizes.values():
            ends = np.cumsum(list(parts.values())).tolist()
            arrays.append(np.zeros((chain.periods, ends[-1])))
            for (name, size), end in zip(parts.items(), ends, strict=True):
                self.part[name], self.starts[name] = arrays[-1][:, end - size : end], end - size
        self.head, self.tail, self.table = arrays
        self.turn_squares: Array = np.zeros((chain.periods, 9 * chain.stations.shape[1]))
        self.window, self.members = chain.window[order], chain.members[order]
        self.at = np.argsort(self.members.reshape(-1))
        self.stations, self.station_order = chain.stations[order].reshape(-1), chain.station_order[order]
        self.is_hard = np.stack([layout.hard_gaps[:, 0], layout.hard_tilts[:, 0]], axis=1)[self.stations]
        self.weights, self.slopes = layout.curve_weights[self.stations], layout.curve_slopes[self.stations]
        self.part["weights"][:] = self.weights.reshape(self.part["weights"].shape)
        self.part["slopes"][:] = self.slopes.reshape(self.part["slopes"].shape)
        self._slope_products = (self.slopes[:, :, None] * self.slopes[:, None, :]).reshape(
            len(self.stations), layout.vertices**2
        )
        self._actuated = self.members[:, chain.actuated]
        self.offset, self.normal = np.zeros((layout.vertices, 3)), np.zeros(3)
        self.vertex_gradient = np.zeros((layout.vertices, 3))
        self._polygon = layout.vertex_hessian
        self.tracking = 0.0 if layout.hard_tracking else layout.weights.tracking
        self.along = self._polygon + self.tracking * self.weights.T @ self.weights
        self._hessian, self._polygon_hessian = (np.kron(a, np.eye(3)) for a in (self.along, self._polygon))
        self._free = free_basis(np.zeros(3), 3 * layout.vertices)

    def fill(self, numbers: StepNumbers) -> None:
        """Overwrite everything with the values of `numbers`."""
        chain, part = self._chain, self.part
        rows, scatter = cast(LengthRowsLike, numbers.motion), chain.bays.scatter
        jacobian = part["jacobian"]
        gradient = rows.gradient.reshape(-1)[scatter.flat]
        found = np.bincount(chain.gathered, gradient, jacobian.size).reshape(jacobian.shape)
        jacobian[:] = found[::-1] if self.is_reversed else found
        part["rhs"][:] = rows.rhs[self.members]
        actuator = np.zeros(chain.bays.member_count)
        actuator[chain.bays.actuators] = numbers.actuator_gradient
        part["actuator_gradient"][:] = actuator[self._actuated]
        if not len(self.offset):
            return
        axes = numbers.base_axes
        self.offset[:2] = numbers.base_displacement
        self.offset[1] += numbers.base_rhs @ axes
        self.hold_base(self.offset, np.cross(*axes))
        self.vertex_gradient = numbers.vertex_gradient
        turns = numbers.tangent_face[self.stations].reshape(-1, 2, 3, 3)
        order = self.station_order.reshape(-1, 1, 3, 1)
        over_slope = numbers.tangent_curve[self.stations]
        gap = numbers.position_rhs[self.stations] - self.weights @ self.offset
        tilt = numbers.tangent_rhs[self.stations]
        tilt = tilt + np.einsum("kac,kc->ka", over_slope, self.slopes @ self.offset)
        filled = {
            "tangent_face": np.take_along_axis(turns, order, axis=2),
            "tangent_curve": over_slope,
            "gap": gap,
            "tilt": tilt,
        }
        for name, values in filled.items():
            part[name][:] = values.reshape(part[name].shape)
        self.turn_squares[:] = np.einsum("kac,kad->kcd", over_slope, over_slope).reshape(
            self.turn_squares.shape
        )

    def hold_base(self, offset: Array, normal: Array) -> None:
        """Set the curve's base: `offset` (V, 3) and `normal` (3,), see the class."""
        self.offset[:], self.normal[:] = offset, normal
        self._free[3:6, 0] = normal
        self.part["normal"][:] = normal

    def member_rows(self, members: Index) -> tuple[Index, Array]:
        """Return nodes (R, w + m) and the gradient (R, w + m, 3) of the lengths of `members` (R,)."""
        period, row = np.divmod(self.at[members], self.members.shape[1])
        entry = self._chain.entry.reshape(self.members.shape[1], -1, 3)[row]
        values = self.part["jacobian"][period[:, None, None], entry]
        return self.window[period], np.where(entry >= 0, values, 0.0)

    def vertices(self, free: Array) -> Array:
        """Return (V, 3) the displacements of the control vertices for free coordinates (3V - 5,)."""
        return self.offset + (self._free @ free).reshape(-1, 3)

    def end_rows(self) -> EndRows:
        """Return the rows that keep the curve's end in the end effector, except those that elimination satisfies."""
        layout = self._chain.layout
        gaps, tilts = layout.ends_at_tip and not layout.hard_tracking, layout.ends_along_tip
        if not (gaps or tilts):
            return EndRows.none(self._free.shape[1])
        (k,) = np.flatnonzero(self.stations == len(layout.tracked) - 1)
        free = self._free.reshape(len(self.offset), 3, -1)
        nodes = layout.arm.stations.nodes[layout.tracked[-1]][self.station_order.reshape(-1, 3)[k]]
        turns = self.part["tangent_face"].reshape(-1, 2, 3, 3)[k]
        over_slope = self.part["tangent_curve"].reshape(-1, 2, 3)[k]
        weights = self._chain.station_weights[-1]
        coefficients = np.concatenate(
            [weights[None, :, None] * np.eye(3)[:, None, :], turns.reshape(2, 3, 3)]
        )
        curve = np.vstack(
            [-np.tensordot(self.weights[k], free, 1), over_slope @ np.tensordot(self.slopes[k], free, 1)]
        )
        rhs = -np.concatenate([self.part["gap"].reshape(-1, 3)[k], self.part["tilt"].reshape(-1, 2)[k]])
        kept = np.flatnonzero([gaps] * 3 + [tilts] * 2)
        return EndRows(nodes, coefficients[kept], curve[kept], rhs[kept])

    def leg_rows(self, legs: Legs) -> Array:
        """Return (G, 3V - 5) the rows of the legs of the control polygon over the curve's free coordinates."""
        return legs.rows @ self._free

    def polygon_terms(self) -> tuple[Array, Array]:
        """Return Hessian (3V - 5, 3V - 5) and gradient (3V - 5,) of the terms in the vertices alone."""
        return self._free.T @ self._polygon_hessian @ self._free, self.polygon_gradient(self.offset)

    def polygon_gradient(self, vertices: Array) -> Array:
        """Return (3V - 5,) the gradient of the same terms at displacements `vertices` (V, 3)."""
        gradient = self._polygon @ vertices + self.vertex_gradient
        return np.asarray(gradient.reshape(-1) @ self._free)

    def curve_terms(self) -> tuple[Array, Array]:
        """Return Hessian and gradient of all terms in the curve's coordinates while the stations stay."""
        count = len(self.offset)
        turning = self._slope_products.T @ self.turn_squares.reshape(-1, 9)
        turning = turning.reshape(count, count, 3, 3).transpose(0, 2, 1, 3).reshape(3 * count, 3 * count)
        hessian = self._hessian + self._chain.layout.weights.tangent * turning
        gap, tilt = self.part["gap"].reshape(-1, 3), self.part["tilt"].reshape(-1, 2)
        return self._free.T @ hessian @ self._free, self.curve_gradient(self.offset, gap, tilt)

    def curve_gradient(self, vertices: Array, gap: Array, tilt: Array) -> Array:
        """Return (3V - 5,) the objective's gradient in the curve's coordinates, given all gaps and angles."""
        over_slope = self.part["tangent_curve"].reshape(-1, 2, 3)
        angles = tilt[:, :1] * over_slope[:, 0] + tilt[:, 1:] * over_slope[:, 1]
        gradient = self._chain.layout.weights.tangent * self.slopes.T @ angles
        gradient -= self.tracking * self.weights.T @ gap
        return self.polygon_gradient(vertices) + gradient.reshape(-1) @ self._free

    def misfit(self, vertices: Array, stations: Array) -> tuple[Array, Array]:
        """Return gap (K, 3) and tilt (K, 2) for displaced vertices and the stations' own parts (K, 5)."""
        moved = vertices - self.offset
        over_slope = self.part["tangent_curve"].reshape(-1, 2, 3)
        gap = self.part["gap"].reshape(-1, 3) - self.weights @ moved
        tilt = self.part["tilt"].reshape(-1, 2) + np.einsum("kac,kc->ka", over_slope, self.slopes @ moved)
        return gap + stations[:, :3], tilt + stations[:, 3:]


class EndRows(NamedTuple):
    """Equalities that tie the curve's end to the end effector: coefficients . d_rho[nodes] + curve . x = rhs.

    Attributes
    ----------
    nodes : (K,) int
    coefficients : (R, K, 3)
    curve : (R, 3V - 5)
        Over the free coordinates x of the curve.
    rhs : (R,)
    """

    nodes: Index
    coefficients: Array
    curve: Array
    rhs: Array

    @classmethod
    def none(cls, size: int) -> EndRows:
        """Return no rows for a curve of so many free coordinates."""
        return cls(np.zeros(0, dtype=np.int64), np.zeros((0, 0, 3)), np.zeros((0, size)), np.zeros(0))


class PeriodValues:
    """Fills :class:`ChainData` from the positions of the nodes.

    Attributes
    ----------
    lengths : (M,)
        Of the members at the configuration evaluated last, m.
    """

    def __init__(self, chain: Chain, data: ChainData) -> None:
        home, bays = chain.layout.arm.home_quantities, chain.bays
        self._chain, self._data = chain, data
        self._kernel = Kernel(period_values(chain).map(chain.periods))
        for k, array in enumerate((data.head, data.tail, data.turn_squares)):
            self._kernel.bind_output(k, array)
        inputs = [array.reshape(chain.periods, -1) for array in self._kernel.inputs]
        self._X, self._Y = (array.reshape(-1, 3) for array in inputs[:2])
        self._curve, self._motion = inputs[6].reshape(-1, 2, 6), inputs[7]
        # Two switches for each station, for gap and angles: corrections close hard rows as well.
        self._closes = inputs[8].reshape(-1, 2)
        inputs[2][:], inputs[3][:] = home[data.members], ~bays.actuated[data.members]
        for array, constants in zip(inputs[4:6], frame_constants_of(chain, data), strict=True):
            array[:] = constants.reshape(array.shape)
        # The first period's members stand on base nodes, which are not unknowns.
        self._first = -1 if data.is_reversed else 0
        self._base_row, self._base_column = np.nonzero(chain.pattern[:, : chain.before])
        self._of_base = chain.entry[self._base_row, self._base_column]
        self.lengths = np.zeros(bays.member_count)

    def fill(self, X: Array, Y: Array, vertices: Array, moved: Array | None, *, motion: bool) -> None:
        """Overwrite the QP's numbers with those at `X` (N, 3), with Jacobians at `Y` (N, 3), m.

        The curve's base is already set, see :meth:`ChainData.hold_base`. `moved` (N, 3) are displacements of the base
        nodes, m; None if the base is at rest.
        """
        chain, data = self._chain, self._data
        window = data.window.reshape(-1)
        np.take(X, window, axis=0, out=self._X, mode="clip")
        np.take(Y, window, axis=0, out=self._Y, mode="clip")
        self._motion[:] = motion
        self._closes[:] = data.is_hard | motion
        if len(data.stations):
            both = np.hstack([vertices, data.offset])
            np.matmul(data.weights, both, out=self._curve[:, 0])
            np.matmul(data.slopes, both, out=self._curve[:, 1])
        self._kernel()
        np.take(self._kernel.outputs[3], data.at, out=self.lengths, mode="clip")
        first = data.part["jacobian"][self._first]
        if moved is not None:
            shift = moved[chain.window[0]].reshape(-1)[self._base_column]
            np.subtract.at(data.part["rhs"][self._first], self._base_row, first[self._of_base] * shift)
        first[self._of_base] = 0.0


def period_values(chain: Chain) -> ca.Function:
    """Return one period's numbers as a function of its nodes' positions.

    Arguments: X, Y (3, w + m), where residuals and where Jacobians are evaluated; home (3m), lengths, and fixed (3m),
    1 where a member keeps it; angles (6f), polar angles' cosines and sines of each station; alignment (3, 3f); curve
    (12f), for each station its point, the point's displacement with the base, the slope and that slope's displacement;
    motion, 0 or 1; closes (2f), for each station whether its gap and its angles are closed.

    Results: ``head`` and ``tail`` of ``elimination.Inputs``, ``ChainData.turn_squares`` and the lengths (3m) at X.
    """
    layout, stations = chain.layout, chain.stations.shape[1]
    X, Y = (ca.SX.sym(name, 3, chain.window.shape[1]) for name in "XY")
    home, fixed = ca.SX.sym("home", chain.own), ca.SX.sym("fixed", chain.own)
    angles, alignment = ca.SX.sym("angles", 6 * stations), ca.SX.sym("alignment", 3, 3 * stations)
    curve, motion, closes = (
        ca.SX.sym("curve", 12 * stations),
        ca.SX.sym("motion"),
        ca.SX.sym("closes", 2 * stations),
    )

    lengths, actuated = member_lengths(chain, X), np.flatnonzero(chain.actuated).tolist()
    jacobian = ca.jacobian(member_lengths(chain, Y), ca.vec(Y))
    head = [nonzeros(ca.project(jacobian, sparsity_of(chain.pattern))), fixed * (home - lengths)]
    tail = [motion * layout.weights.stroke_centring * ((1.0 - fixed) * (lengths - home))[actuated]]
    turns, turn_curves, gaps, tilts, products = [], [], [], [], []
    for k, places in enumerate(chain.station_places.tolist()):
        polar, nodes = ca.vertsplit(angles[6 * k : 6 * k + 6], 3), Y[:, places]
        rotation = fitted_frame(X[:, places], *polar) @ alignment[:, 3 * k : 3 * k + 3]
        point, moved, slope, slope_moved = ca.vertsplit(curve[12 * k : 12 * k + 12], 3)
        tilt, c, over_slope = tracking.slope_rows(rotation, slope)
        turns.append(ca.vec(turning(fitted_frame(nodes, *polar), nodes, c).T))
        turn_curves.append(ca.vec(over_slope.T))
        products.append(ca.vec(over_slope.T @ over_slope))
        centre = X[:, places] @ ca.DM(chain.station_weights[k])
        gaps.append(closes[2 * k] * tracking.gap(centre, point) - moved)
        tilts.append(closes[2 * k + 1] * tilt + over_slope @ slope_moved)
    outputs = [
        ca.vertcat(*head, *turns),
        ca.vertcat(*tail, *turn_curves, *gaps, *tilts),
        ca.vertcat(*products),
        lengths,
    ]
    return dense_function("values", [X, Y, home, fixed, angles, alignment, curve, motion, closes], outputs)


def frame_constants_of(chain: Chain, data: ChainData) -> tuple[Array, Array]:
    """Return angles (K, 6) and alignments (K, 3, 3), columns first, of the stations in the order of `data`.

    A station with its nodes in clockwise order has y- and z-axis of its fitted frame reversed.
    """
    arm, order = chain.layout.arm, data.station_order.reshape(-1, 3)
    stations = chain.layout.tracked[data.stations]
    cosines, sines, alignments = frame_constants(
        arm.home[arm.stations.nodes[stations]], arm.stations.frames[stations]
    )
    first = order.argmin(axis=1)[:, None]
    turned = np.take_along_axis(order, (first + np.arange(3)) % 3, axis=1)
    sense = np.where((turned == np.arange(3)).all(axis=1), 1.0, -1.0)[:, None]
    angles = [np.take_along_axis(angle, order, axis=1) for angle in (cosines, sense * sines)]
    reversed_axes = np.concatenate([np.ones_like(sense), sense, sense], axis=1)[:, :, None]
    return np.concatenate(angles, axis=1), (reversed_axes * alignments).transpose(0, 2, 1)
