"""Elimination of one period of a chain, as CasADi graphs: one bay of a Riccati recursion from tip to base.

Each graph takes the period's numbers and the *carry*, the result that the period after (or before) hands
over, and returns the carry for the next period; :class:`Sweep` runs it along the chain. A stage's
displacements are u = G (rhs + T u_before) + N t: G from the QR factors of its fixed members' rows, N a basis
of their null space, t the stage's free motions, which are eliminated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import casadi as ca
import numpy as np

from vgtm_qp.qp.long.chain import Chain
from vgtm_qp.qp.long.sparse_symbols import (
    dense_function,
    inverse_factor,
    nonzeros,
    offsets,
    range_and_null,
    small_inverse,
    sparsity_of,
    symbols_like,
    symmetric,
)
from vgtm_qp.rows import curve as curve_rows
from vgtm_qp.rows import members

NewtonStep = Callable[[ca.SX, ca.SX, ca.SX], tuple[ca.SX, ca.SX]]
"""From displacements before (3w,), positions (3w + 3m,), lengths (3m,) to displacements (3w + 3m,), error."""


@dataclass(frozen=True)
class Stage:
    """One stage of a period: own coordinates, coordinates before, and rows of fixed and actuated members.

    T couples the fixed members to the nodes before, rhs are their errors; G and N are as in the module docstring.
    """

    own: list[int]
    before: list[int]
    hard: list[int]
    actuated: list[int]
    T: ca.SX
    rhs: ca.SX
    G: ca.SX
    N: ca.SX

    @property
    def freedom(self) -> int:
        """Number of its free motions."""
        return len(self.own) - len(self.hard)


class Inputs:
    """A period's numbers as three vectors of symbols, in the order in which they are filled.

    Attributes
    ----------
    head, tail, table : vector
        Numbers that all sweeps read; those for the factorisation alone; those that depend on the curve's base
        alone.
    jacobian : (3m, 3w + 3m), rhs : (3m,), actuator_gradient : (actuated,)
    weights, slopes : lists of (V,)
        Of the control vertices, by station.
    tangent_face, tangent_curve, gap, tilt : lists of (2, 9), (2, 3), (3,), (2,)
        Gap and angles are those without any displacement.
    normal : (3,)
        The direction of the second control vertex.
    sizes : dict of dicts
        Length of each part of each vector.
    """

    def __init__(self, chain: Chain) -> None:
        stations, vertices = chain.stations.shape[1], chain.layout.vertices
        # Number of matrices, and their rows and columns; each is stored row by row.
        shapes = {
            "head": {
                "jacobian": (1, int(chain.pattern.sum()), 1),
                "rhs": (1, chain.own, 1),
                "tangent_face": (stations, 2, 9),
            },
            "tail": {
                "actuator_gradient": (1, int(chain.actuated.sum()), 1),
                "tangent_curve": (stations, 2, 3),
                "gap": (stations, 3, 1),
                "tilt": (stations, 2, 1),
            },
            "table": {
                "weights": (stations, vertices, 1),
                "slopes": (stations, vertices, 1),
                "normal": (1, 3, 1),
            },
        }
        self.sizes = {
            name: {part: int(np.prod(shape)) for part, shape in parts.items()}
            for name, parts in shapes.items()
        }
        vectors, found = [], {}
        for name, parts in shapes.items():
            ends = offsets(self.sizes[name].values())
            vectors.append(ca.SX.sym(name, ends[-1]))
            for (part, (count, rows, columns)), piece in zip(
                parts.items(), ca.vertsplit(vectors[-1], ends), strict=True
            ):
                blocks = ca.vertsplit(piece, offsets([rows * columns] * count))
                found[part] = [ca.reshape(block, columns, rows).T for block in blocks]
        self.head, self.tail, self.table = vectors
        self.jacobian = ca.SX(sparsity_of(chain.pattern), found["jacobian"][0])
        self.rhs, self.actuator_gradient, self.normal = (
            found[part][0] for part in ("rhs", "actuator_gradient", "normal")
        )
        self.tangent_face, self.tangent_curve = found["tangent_face"], found["tangent_curve"]
        self.gap, self.tilt = found["gap"], found["tilt"]
        self.weights, self.slopes = found["weights"], found["slopes"]


class Elimination:
    """The graphs of one chain: everything symbolic about a period.

    Attributes
    ----------
    chain : Chain
    stages : list of Stage
    actuated : list of int
        Places of the actuated members.
    live : list of int
        Coordinates that the next period takes over.
    curve : int
        Number of free curve coordinates, 3V - 5.
    freedom : int
        Free motions of a period.
    gain_parts : list
        For each stage free, G, W, Wb and S, see :meth:`factor`, which sets them.
    """

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        self.inputs = Inputs(chain)
        self.actuated = np.flatnonzero(chain.actuated).tolist()
        self.size = chain.before + chain.own
        self.live = [chain.before + 3 * place + axis for place in chain.carried.tolist() for axis in range(3)]
        self.curve = chain.layout.free_curve
        self.stages: list[Stage] = []
        J, rhs = self.inputs.jacobian, self.inputs.rhs
        for start, end in pairwise(offsets(3 * count for count in chain.stage_sizes)):
            own, before = (
                list(range(chain.before + start, chain.before + end)),
                list(range(chain.before + start)),
            )
            hard, actuated = (
                [i for i in range(start, end) if chain.actuated[i] == kind] for kind in (False, True)
            )
            split = range_and_null(J[hard, own])
            self.stages.append(Stage(own, before, hard, actuated, -J[hard, before], rhs[hard], *split))
        self.freedom = sum(stage.freedom for stage in self.stages)
        self.gain_parts: list[ca.SX] = []

    def centre_row(self, k: int) -> ca.SX:
        """Return the constant (3, 3w + 3m) Jacobian of the centre of station `k`."""
        row = ca.SX(1, self.size // 3)
        row[self.chain.station_places[k].tolist()] = self.chain.station_weights[k].tolist()
        return ca.kron(row, ca.SX.eye(3))

    def tangent_row(self, k: int) -> ca.SX:
        """Return the (2, 3w + 3m) rows of the angles of station `k`."""
        row = ca.SX(2, self.size)
        row[:, [3 * place + axis for place in self.chain.station_places[k].tolist() for axis in range(3)]] = (
            self.inputs.tangent_face[k]
        )
        return row

    def curve_columns(self, k: int) -> tuple[ca.SX, ca.SX]:
        """Return the derivatives (3, 3V - 5) of station `k`'s curve point and (2, 3V - 5) of its angles."""
        inputs = self.inputs
        point = curve_rows.weighted_columns(inputs.weights[k], inputs.normal, ca.SX.eye(3))
        turned = curve_rows.weighted_columns(inputs.slopes[k], inputs.normal, inputs.tangent_curve[k])
        return point, turned

    def factor(self, *, curved: bool = True) -> ca.Function:
        """Return (carry, head, tail, table) -> (carry, gains, Y, placed): one period of the recursion.

        The carry holds the upper half of the Hessian in the live coordinates, their linear terms for every
        curve coordinate and for 1, and the gradient of the curve coordinates. Y (freedom, 3V - 5 + 1) is
        stored row by row. `placed` (3m,) are displacements by the errors of fixed members alone. Unless it is `curved`,
        there are no terms of curve coordinates: C adds these.
        """
        inputs, weights, curve = self.inputs, self.chain.layout.weights, self.curve if curved else 0
        columns = curve + 1
        upper = ca.Sparsity.upper(len(self.live))
        ends = offsets([upper.nnz(), len(self.live) * columns, curve])
        carry = ca.SX.sym("carry", ends[-1])
        handed, linear, curve_gradient = ca.vertsplit(carry, ends)
        H, V = ca.SX(self.size, self.size), ca.SX(self.size, columns)
        H[self.live, self.live] = ca.triu2symm(ca.SX(upper, handed))
        V[self.live, :] = ca.reshape(linear, len(self.live), columns)
        own = list(range(self.chain.before, self.size))
        H[own, own] += weights.node_rate * ca.SX.eye(len(own))
        if self.actuated:
            J = inputs.jacobian[self.actuated, :]
            H += symmetric(weights.actuators * (J.T @ J))
            V[:, -1] += J.T @ (inputs.actuator_gradient - weights.actuators * inputs.rhs[self.actuated])
        for k in range(self.chain.stations.shape[1]):
            centre, tangent = self.centre_row(k), self.tangent_row(k)
            point, turned = self.curve_columns(k)
            H += symmetric(weights.tracking * (centre.T @ centre) + weights.tangent * (tangent.T @ tangent))
            V += weights.tracking * (centre.T @ ca.horzcat(-point[:, :curve], inputs.gap[k]))
            V += weights.tangent * (tangent.T @ ca.horzcat(turned[:, :curve], inputs.tilt[k]))
        H = ca.sparsify(H)
        gains: list[ca.SX] = []
        outer: list[ca.SX] = []
        displaced: list[ca.SX] = []
        for stage in reversed(self.stages):
            G, N, T, u, before = stage.G, stage.N, stage.T, stage.own, stage.before
            placed = G @ stage.rhs
            Huu, Hub = ca.sparsify(H[u, u]), ca.sparsify(H[u, before])
            HG = Huu @ G
            total = ca.horzcat(V[u, :-1], V[u, -1] + Huu @ placed)
            free = ca.sparsify(N @ inverse_factor(symmetric(N.T @ (Huu @ N))))
            W, Wb, Y = ca.sparsify(free.T @ HG), ca.sparsify(free.T @ Hub), free.T @ total
            M = symmetric(G.T @ HG - W.T @ W)
            K = ca.sparsify(G.T @ Hub - W.T @ Wb)
            cross = T.T @ K
            rest = ca.horzcat(V[before, :-1], V[before, -1] + Hub.T @ placed)
            V = rest + T.T @ (G.T @ total - W.T @ Y) - Wb.T @ Y
            H = ca.sparsify(symmetric(H[before, before] + T.T @ (M @ T) + cross + cross.T - Wb.T @ Wb))
            curve_gradient += total[:, :-1].T @ placed - Y[:, :-1].T @ Y[:, -1]
            gains = [free, G, W, Wb, small_inverse(inputs.jacobian[stage.actuated, u] @ free), *gains]
            outer, displaced = [Y, *outer], [placed, *displaced]
        self.gain_parts = gains
        handed = ca.vertcat(nonzeros(ca.project(H, upper)), ca.densify(ca.vec(V)), curve_gradient)
        packed = ca.vertcat(*[nonzeros(part) for part in gains])
        outputs = [handed, packed, ca.vertcat(*outer).T, ca.vertcat(*displaced)]
        return dense_function("factor", [carry, inputs.head, inputs.tail, inputs.table], outputs)

    def _gains(self) -> tuple[ca.SX, list[list[ca.SX]]]:
        """Return the symbols of the gains and, per stage, (free, G, W, Wb, S); `factor` fixes their sparsity.

        S takes changes of a stage's actuated lengths to its scaled free motions.
        """
        vector, pieces = symbols_like([part.sparsity() for part in self.gain_parts], "gains")
        return vector, [pieces[5 * k : 5 * k + 5] for k in range(len(self.stages))]

    def columns(self, count: int) -> ca.Function:
        """Return (carry, head, gains, rows (3m, count)) -> (carry, Z): rows through the elimination."""
        vector, gains = self._gains()
        carry, rows = ca.SX.sym("carry", len(self.live), count), ca.SX.sym("rows", self.chain.own, count)
        V = ca.vertcat(ca.SX(self.chain.before, count), rows)
        V[self.live, :] += carry
        V, Z = self._costates(V, gains)
        return dense_function("columns", [carry, self.inputs.head, vector, rows], [V, Z.T])

    def balance(self) -> ca.Function:
        """Return (carry, head, gains, nodal (3m,), actuator (actuated,), stations (5f,)) -> (carry, residual).

        The costates of given gradients; the residual (freedom,) is the violation of stationarity.
        """
        vector, gains = self._gains()
        carry, nodal = ca.SX.sym("carry", len(self.live)), ca.SX.sym("nodal", self.chain.own)
        stations = range(self.chain.stations.shape[1])
        actuator, station = ca.SX.sym("actuator", len(self.actuated)), ca.SX.sym("station", 5 * len(stations))
        V = ca.vertcat(ca.SX.zeros(self.chain.before), nodal)
        V[self.live] += carry
        V += self.inputs.jacobian[self.actuated, :].T @ actuator
        V += self._station_rows().T @ station
        unmoved = [[free, G, ca.SX(*W.shape), ca.SX(*Wb.shape), S] for free, G, W, Wb, S in gains]
        V, residual = self._costates(V, unmoved)
        return dense_function(
            "balance", [carry, self.inputs.head, vector, nodal, actuator, station], [V, residual]
        )

    def _costates(self, V: ca.SX, gains: list[list[ca.SX]]) -> tuple[ca.SX, ca.SX]:
        """Return gradients V (3w + 3m, c) carried through the stages: those before, and in the free motions."""
        outer: list[ca.SX] = []
        for stage, (free, G, W, Wb, _) in reversed(list(zip(self.stages, gains, strict=True))):
            Vu = V[stage.own, :]
            Z = free.T @ Vu
            V = V[stage.before, :] + stage.T.T @ (G.T @ Vu - W.T @ Z) - Wb.T @ Z
            outer = [Z, *outer]
        return V, ca.vertcat(*outer)

    def forward(self) -> ca.Function:
        """Return (carry, head, gains, z) -> (carry, u, J u - rhs, centres and angles of the stations)."""
        vector, gains = self._gains()
        carry, z = ca.SX.sym("carry", len(self.live)), ca.SX.sym("z", self.freedom)
        u = self._moved(carry, z, gains, [stage.rhs for stage in self.stages])
        changed = self.inputs.jacobian @ u - self.inputs.rhs
        outputs = [u[self.live], u[self.chain.before :], changed, self._station_rows() @ u]
        return dense_function("forward", [carry, self.inputs.head, vector, z], outputs)

    def strokes(self, count: int) -> ca.Function:
        """Return (carry, head, gains, z (freedom, count)) -> (carry, J u of the actuated members, u), all without rhs.

        Each column of `z` is one motion; z, J u and u (3m, count) are stored row by row.
        """
        vector, gains = self._gains()
        carry, rows = ca.SX.sym("carry", len(self.live), count), ca.SX.sym("z", count, self.freedom)
        u = self._moved(carry, rows.T, gains, [ca.SX(len(stage.hard), count) for stage in self.stages])
        changed = self.inputs.jacobian[self.actuated, :] @ u
        outputs = [u[self.live, :], changed.T, u[self.chain.before :, :].T]
        return dense_function("strokes", [carry, self.inputs.head, vector, rows], outputs)

    def _moved(self, u: ca.SX, z: ca.SX, gains: list[list[ca.SX]], rhs: list[ca.SX]) -> ca.SX:
        """Return displacements (3w + 3m, c) for free motions `z` (freedom, c) after those `u` (3w, c)."""
        motions = ca.vertsplit(z, offsets(stage.freedom for stage in self.stages))
        for stage, (free, G, W, Wb, _), motion, wanted in zip(self.stages, gains, motions, rhs, strict=True):
            followed = stage.T @ u
            u = ca.vertcat(u, G @ (wanted + followed) - free @ (motion + W @ followed + Wb @ u))
        return u

    def close(self) -> ca.Function:
        """Return :meth:`newton` towards the lengths `aim` (3m,)."""
        vector, gains = self._gains()
        aim, J = ca.SX.sym("aim", self.chain.own), self.inputs.jacobian

        def step(u: ca.SX, _: ca.SX, lengths: ca.SX) -> tuple[ca.SX, ca.SX]:
            error = aim - lengths
            for stage, (free, G, _, _, S) in zip(self.stages, gains, strict=True):
                placed = G @ (error[stage.hard] + stage.T @ u)
                missing = (
                    error[stage.actuated]
                    - J[stage.actuated, stage.before] @ u
                    - J[stage.actuated, stage.own] @ placed
                )
                u = ca.vertcat(u, placed + free @ (S @ missing))
            return u, error

        return self.newton("close", vector, [aim], step)

    def newton(self, name: str, gains: ca.SX, aims: list[ca.SX], step: NewtonStep) -> ca.Function:
        """Return (carry, head, gains, X, *aims) -> (carry, X, lengths, error): one Newton step of a period.

        The carry holds the live nodes' positions and displacements; X (3m,) are the positions of a period's
        own nodes. The lengths (3m,) and the error are those before the step.
        """
        carry, own = ca.SX.sym("carry", 2 * self.chain.before), ca.SX.sym("X", self.chain.own)
        before, moved = ca.vertsplit(carry, offsets([self.chain.before] * 2))
        X = ca.vertcat(before, own)
        lengths = member_lengths(self.chain, ca.reshape(X, 3, self.size // 3))
        u, error = step(moved, X, lengths)
        outputs = [ca.vertcat(X[self.live], u[self.live]), (X + u)[self.chain.before :], lengths, error]
        return dense_function(name, [carry, self.inputs.head, gains, own, *aims], outputs)

    def changes(self) -> ca.Function:
        """Return (carry, head, u (3m,)) -> (carry, J u - rhs, centres and angles of the stations) of displacements."""
        carry, own = ca.SX.sym("carry", len(self.live)), ca.SX.sym("u", self.chain.own)
        u = ca.vertcat(carry, own)
        outputs = [u[self.live], self.inputs.jacobian @ u - self.inputs.rhs, self._station_rows() @ u]
        return dense_function("changes", [carry, self.inputs.head, own], outputs)

    def _station_rows(self) -> ca.SX:
        """Return the (5f, 3w + 3m) rows of the centres and the angles of a period's stations."""
        rows = [(self.centre_row(k), self.tangent_row(k)) for k in range(self.chain.stations.shape[1])]
        return ca.vertcat(ca.SX(0, self.size), *[row for pair in rows for row in pair])


def member_lengths(chain: Chain, points: ca.SX) -> ca.SX:
    """Return (3m,) the lengths of a period's members with nodes at `points` (3, w + m)."""
    if chain.member_places is None:
        raise ValueError("the periods of this chain are not alike")
    return ca.vertcat(*[members.length(points[:, a], points[:, b]) for a, b in chain.member_places.tolist()])
