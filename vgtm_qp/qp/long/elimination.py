"""Elimination of one period of a chain, as CasADi graphs: one bay of a Riccati recursion from tip to base.

Each graph takes the period's numbers and what the period after (or before) hands over, and hands over the
same to the next; :class:`Sweep` runs it along the chain. A stage's displacements are u = G (rhs + T u_before)
+ N t: G from the QR factors of its fixed members' rows, N a basis of their null space, t the stage's free
motions, which are eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from vgtm_qp.qp.long.chain import Chain
from vgtm_qp.qp.long.sparse_symbols import (
    inverse_factor,
    nonzeros,
    offsets,
    range_and_null,
    small_inverse,
    symbols_of,
    symmetric,
)


@dataclass(frozen=True)
class Stage:
    """One stage of a period: its own coordinates, those before, its fixed members' rows, its free motions."""

    own: list[int]
    before: list[int]
    hard: list[int]
    freedom: int


class Inputs:
    """A period's numbers as three vectors of symbols, in the order in which they are filled.

    Attributes
    ----------
    head, tail, table : vector
        What all sweeps read, what the factorisation alone reads, and what depends on the curve's base alone.
    jacobian : (3m, 3w + 3m), rhs : (3m,), actuator_gradient : (soft,)
    weights, slopes : (f, V - 1)
        Of the control vertices that move; the first one stays with the base.
    tangent_face, tangent_curve : lists of (2, 9), (2, 3)
    gap, tilt : (f, 3), (f, 2)
        Gap and angles as they are where no unknown moves.
    normal : (3,)
        The direction of the second control vertex.
    sizes : dict of dicts
        Length of each part of each vector.
    """

    def __init__(self, chain: Chain) -> None:
        faces, vertices = chain.faces.shape[1], max(chain.layout.vertices - 1, 0)
        pattern = chain.coordinate_pattern
        self.sizes = {
            "head": {"jacobian": int(pattern.sum()), "rhs": chain.own, "tangent_face": 18 * faces},
            "tail": {
                "actuator_gradient": int(chain.soft.sum()),
                "tangent_curve": 6 * faces,
                "gap": 3 * faces,
                "tilt": 2 * faces,
            },
            "table": {"weights": faces * vertices, "slopes": faces * vertices, "normal": 3},
        }
        parts: dict[str, ca.SX] = {}
        vectors = []
        for name, sizes in self.sizes.items():
            vectors.append(ca.SX.sym(name, sum(sizes.values())))
            parts |= dict(zip(sizes, ca.vertsplit(vectors[-1], offsets(sizes.values())), strict=True))
        self.head, self.tail, self.table = vectors
        self.jacobian = symbols_of(pattern, parts["jacobian"])
        self.rhs, self.actuator_gradient, self.normal = (
            parts["rhs"],
            parts["actuator_gradient"],
            parts["normal"],
        )
        self.weights, self.slopes = (
            ca.reshape(parts[name], vertices, faces).T for name in ("weights", "slopes")
        )
        self.tangent_face = [
            ca.reshape(parts["tangent_face"][18 * k : 18 * k + 18], 9, 2).T for k in range(faces)
        ]
        self.tangent_curve = [
            ca.reshape(parts["tangent_curve"][6 * k : 6 * k + 6], 3, 2).T for k in range(faces)
        ]
        self.gap = ca.reshape(parts["gap"], 3, faces).T
        self.tilt = ca.reshape(parts["tilt"], 2, faces).T


class Elimination:
    """The graphs of one chain: everything symbolic about a period.

    Attributes
    ----------
    chain : Chain
    stages : list of Stage
    soft : list of int
        Places of the actuated members.
    live : list of int
        Coordinates that the next period takes over.
    curve : int
        Number of free curve coordinates, 3V - 5.
    freedom : int
        Free motions of a period.
    """

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        self.inputs = Inputs(chain)
        self.soft = np.flatnonzero(chain.soft).tolist()
        self.size = chain.before + chain.own
        self.live = [chain.before + 3 * place + axis for place in chain.carried.tolist() for axis in range(3)]
        vertices = chain.layout.vertices
        self.curve = 3 * vertices - 5 if vertices else 0
        self.stages: list[Stage] = []
        start = 0
        for count in chain.stage_sizes:
            rows = range(3 * start, 3 * (start + count))
            own = [chain.before + i for i in rows]
            hard = [i for i in rows if not chain.soft[i]]
            self.stages.append(Stage(own, list(range(own[0])), hard, 3 * count - len(hard)))
            start += count
        self.freedom = sum(stage.freedom for stage in self.stages)
        self.split = [
            range_and_null(self.inputs.jacobian[stage.hard, stage.own])
            if stage.hard
            else (ca.SX(len(stage.own), 0), ca.SX.eye(len(stage.own)))
            for stage in self.stages
        ]
        self._gain_parts: list[ca.SX] = []

    def centre_row(self, k: int) -> ca.SX:
        """Return the constant (3, 3w + 3m) Jacobian of the centre of face `k`."""
        row = ca.SX(3, self.size)
        for place, weight in zip(
            self.chain.face_places[k].tolist(), self.chain.face_weights[k].tolist(), strict=True
        ):
            for axis in range(3):
                row[axis, 3 * place + axis] += weight
        return row

    def tangent_row(self, k: int) -> ca.SX:
        """Return the (2, 3w + 3m) rows of the angles of face `k`."""
        row = ca.SX(2, self.size)
        for i, place in enumerate(self.chain.face_places[k].tolist()):
            row[:, 3 * place : 3 * place + 3] += self.inputs.tangent_face[k][:, 3 * i : 3 * i + 3]
        return row

    def curve_columns(self, values: ca.SX) -> ca.SX:
        """Return the (3, 3V - 5) derivative of sum_i values_i p_i, i from 1, by the free coordinates."""
        blocks = [values[i] * ca.SX.eye(3) for i in range(1, values.numel())]
        return ca.horzcat(values[0] * self.inputs.normal, *blocks)

    def hard_rhs(self, stage: Stage) -> ca.SX:
        """Return the right-hand side of a stage's fixed members."""
        return self.inputs.rhs[stage.hard]

    def transfer(self, stage: Stage) -> ca.SX:
        """Return T, how a stage's fixed members follow the nodes before it."""
        return -self.inputs.jacobian[stage.hard, stage.before]

    def factor(self) -> ca.Function:
        """Return (carry, head, tail, table) -> (carry, gains, Y): one period of the recursion.

        The carry holds the upper half of the Hessian in the live coordinates, their linear terms for every
        curve coordinate and for 1, and the gradient of the curve coordinates. Y (freedom, 3V - 5 + 1) is
        stored row by row.
        """
        inputs, weights, columns = self.inputs, self.chain.layout.weights, self.curve + 1
        upper = ca.Sparsity.upper(len(self.live))
        carry = ca.SX.sym("carry", upper.nnz() + len(self.live) * columns + self.curve)
        handed, linear, curve_gradient = ca.vertsplit(
            carry, [0, upper.nnz(), upper.nnz() + len(self.live) * columns, carry.numel()]
        )
        H, V = ca.SX(self.size, self.size), ca.SX(self.size, columns)
        H[self.live, self.live] = ca.triu2symm(ca.SX(upper, handed))
        V[self.live, :] = ca.reshape(linear, len(self.live), columns)
        own = list(range(self.chain.before, self.size))
        H[own, own] += weights.node_rate * ca.SX.eye(len(own))
        if self.soft:
            J = inputs.jacobian[self.soft, :]
            stiffness = weights.actuator_rate + weights.stroke_centring
            H += symmetric(stiffness * (J.T @ J))
            V[:, -1] += J.T @ (inputs.actuator_gradient - stiffness * inputs.rhs[self.soft])
        for k in range(self.chain.faces.shape[1]):
            centre, tangent = self.centre_row(k), self.tangent_row(k)
            H += symmetric(weights.tracking * (centre.T @ centre) + weights.tangent * (tangent.T @ tangent))
            V[:, :-1] -= weights.tracking * (centre.T @ self.curve_columns(inputs.weights[k, :]))
            turned = inputs.tangent_curve[k] @ self.curve_columns(inputs.slopes[k, :])
            V[:, :-1] += weights.tangent * (tangent.T @ turned)
            V[:, -1] += weights.tracking * (centre.T @ inputs.gap[k, :].T)
            V[:, -1] += weights.tangent * (tangent.T @ inputs.tilt[k, :].T)
        H = ca.sparsify(H)
        gains: list[ca.SX] = []
        outer: list[ca.SX] = []
        for stage, (G, N) in reversed(list(zip(self.stages, self.split, strict=True))):
            T, u, before = self.transfer(stage), stage.own, stage.before
            placed = G @ self.hard_rhs(stage)
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
            soft = [i for i in self.soft if self.chain.before + i in u]
            gains = [free, G, W, Wb, small_inverse(inputs.jacobian[soft, u] @ free), *gains]
            outer = [Y, *outer]
        self._gain_parts = gains
        handed = ca.vertcat(nonzeros(ca.project(H, upper)), ca.densify(ca.vec(V)), curve_gradient)
        return ca.Function(
            "factor",
            [carry, inputs.head, inputs.tail, inputs.table],
            [
                ca.densify(handed),
                ca.vertcat(*[nonzeros(part) for part in gains]),
                ca.densify(ca.vertcat(*outer).T),
            ],
        )

    def _gains(self) -> tuple[ca.SX, list[list[ca.SX]]]:
        """Return the symbols of the gains and, per stage, (free, G, W, Wb, S); `factor` fixes their sparsity.

        S takes changes of a stage's actuated lengths to its scaled free motions.
        """
        parts = self._gain_parts
        ends = offsets(part.nnz() for part in parts)
        vector = ca.SX.sym("gains", ends[-1])
        pieces = [
            ca.SX(part.sparsity(), v) for part, v in zip(parts, ca.vertsplit(vector, ends), strict=True)
        ]
        return vector, [pieces[5 * k : 5 * k + 5] for k in range(len(self.stages))]

    def columns(self, count: int) -> ca.Function:
        """Return (carry, head, gains, rows (3m, count)) -> (carry, Z): rows through the elimination."""
        vector, gains = self._gains()
        carry, rows = ca.SX.sym("carry", len(self.live), count), ca.SX.sym("rows", self.chain.own, count)
        V = ca.vertcat(ca.SX(self.chain.before, count), rows)
        V[self.live, :] += carry
        outer: list[ca.SX] = []
        for stage, (free, G, W, Wb, _) in reversed(list(zip(self.stages, gains, strict=True))):
            Vu = V[stage.own, :]
            Z = free.T @ Vu
            V = V[stage.before, :] + self.transfer(stage).T @ (G.T @ Vu - W.T @ Z) - Wb.T @ Z
            outer = [Z, *outer]
        return ca.Function(
            "columns",
            [carry, self.inputs.head, vector, rows],
            [ca.densify(V), ca.densify(ca.vertcat(*outer).T)],
        )

    def forward(self) -> ca.Function:
        """Return (carry, head, gains, z) -> (carry, u, J u - rhs, centres and angles of the faces)."""
        vector, gains = self._gains()
        carry, z = ca.SX.sym("carry", len(self.live)), ca.SX.sym("z", self.freedom)
        u, done = carry, 0
        for stage, (free, G, W, Wb, _) in zip(self.stages, gains, strict=True):
            followed = self.transfer(stage) @ u
            motion = z[done : done + stage.freedom] + W @ followed + Wb @ u
            u = ca.vertcat(u, G @ (self.hard_rhs(stage) + followed) - free @ motion)
            done += stage.freedom
        outputs = [
            u[self.live],
            u[self.chain.before :],
            self.inputs.jacobian @ u - self.inputs.rhs,
            self._faces(u),
        ]
        return ca.Function("forward", [carry, self.inputs.head, vector, z], [ca.densify(x) for x in outputs])

    def strokes(self, count: int) -> ca.Function:
        """Return (carry, head, gains, z (freedom, count)) -> (carry, J u of the actuated members), all without rhs.

        Each column of `z` is a motion of its own; z and J u are stored row by row.
        """
        vector, gains = self._gains()
        carry, rows = ca.SX.sym("carry", len(self.live), count), ca.SX.sym("z", count, self.freedom)
        u, z, done = carry, rows.T, 0
        for stage, (free, G, W, Wb, _) in zip(self.stages, gains, strict=True):
            followed = self.transfer(stage) @ u
            motion = z[done : done + stage.freedom, :] + W @ followed + Wb @ u
            u = ca.vertcat(u, G @ followed - free @ motion)
            done += stage.freedom
        changed = self.inputs.jacobian[self.soft, :] @ u
        outputs = [ca.densify(u[self.live, :]), ca.densify(changed.T)]
        return ca.Function("strokes", [carry, self.inputs.head, vector, rows], outputs)

    def close(self) -> ca.Function:
        """Return (carry, head, gains, X, aim) -> (carry, X, lengths): one step towards the lengths `aim` (3m,).

        Newton's with the Jacobian in `head`. The carry holds the live nodes' positions, their displacements and the
        greatest error so far; X (3m,) are the positions of a period's own nodes.
        """
        vector, gains = self._gains()
        at = Positions(self)
        aim = ca.SX.sym("aim", self.chain.own)
        error = aim - at.lengths
        J, u = self.inputs.jacobian, at.moved
        for stage, (free, G, _, _, S) in zip(self.stages, gains, strict=True):
            soft = [i for i in self.soft if self.chain.before + i in stage.own]
            placed = G @ (error[stage.hard] + self.transfer(stage) @ u)
            missing = error[soft] - J[soft, stage.before] @ u - J[soft, stage.own] @ placed
            u = ca.vertcat(u, placed + free @ (S @ missing))
        return at.function("close", [self.inputs.head, vector], [aim], u, error)

    def changes(self) -> ca.Function:
        """Return (carry, head, u (3m,)) -> (carry, J u - rhs, centres and angles of the faces) of displacements u."""
        carry, own = ca.SX.sym("carry", len(self.live)), ca.SX.sym("u", self.chain.own)
        u = ca.vertcat(carry, own)
        outputs = [u[self.live], self.inputs.jacobian @ u - self.inputs.rhs, self._faces(u)]
        return ca.Function("changes", [carry, self.inputs.head, own], [ca.densify(x) for x in outputs])

    def _faces(self, u: ca.SX) -> ca.SX:
        """Return (5f,) the centres' motions and the angles of a period's faces at displacements u (3w + 3m,)."""
        rows = (self.centre_row, self.tangent_row)
        return ca.vertcat(*[row(k) @ u for k in range(self.chain.faces.shape[1]) for row in rows])

    def balance(self) -> ca.Function:
        """Return (carry, head, gains, nodal (3m,), actuator (soft,), faces (5f,)) -> (carry, residual).

        The costates of given gradients; the residual (freedom,) is what is left of stationarity.
        """
        vector, gains = self._gains()
        carry, nodal = ca.SX.sym("carry", len(self.live)), ca.SX.sym("nodal", self.chain.own)
        faces = self.chain.faces.shape[1]
        actuator, face = ca.SX.sym("actuator", len(self.soft)), ca.SX.sym("face", 5 * faces)
        V = ca.vertcat(ca.SX.zeros(self.chain.before), nodal)
        V[self.live] += carry
        V += self.inputs.jacobian[self.soft, :].T @ actuator
        for k in range(faces):
            V += (
                self.centre_row(k).T @ face[5 * k : 5 * k + 3]
                + self.tangent_row(k).T @ face[5 * k + 3 : 5 * k + 5]
            )
        outer: list[ca.SX] = []
        for stage, (free, G, _, _, _) in reversed(list(zip(self.stages, gains, strict=True))):
            Vu = V[stage.own]
            outer = [free.T @ Vu, *outer]
            V = V[stage.before] + self.transfer(stage).T @ (G.T @ Vu)
        return ca.Function(
            "balance",
            [carry, self.inputs.head, vector, nodal, actuator, face],
            [ca.densify(V), ca.densify(ca.vertcat(*outer))],
        )


class Positions:
    """Where the nodes of a period are, as symbols: the live ones of the period before, then its own.

    Attributes
    ----------
    points : (3, w + m)
    moved : (3w,)
        Displacements of the former in the step that is being taken.
    lengths : (3m,)
    """

    def __init__(self, elimination: Elimination) -> None:
        chain = self._chain = elimination.chain
        self._live = elimination.live
        self._carry = ca.SX.sym("carry", 2 * chain.before + 1)
        before, self.moved, self._worst = ca.vertsplit(self._carry, offsets([chain.before, chain.before, 1]))
        self._own = ca.SX.sym("X", chain.own)
        self._all = ca.vertcat(before, self._own)
        self.points = ca.reshape(self._all, 3, elimination.size // 3)
        self.lengths = member_lengths(chain, self.points)

    def centre(self, k: int) -> ca.SX:
        """Return (3,) the centre of the period's face `k`."""
        places, weights = self._chain.face_places[k].tolist(), self._chain.face_weights[k]
        return self.points[:, places] @ ca.DM(weights)

    def function(
        self, name: str, before: list[ca.SX], after: list[ca.SX], u: ca.SX, error: ca.SX
    ) -> ca.Function:
        """Return (carry, *before, X, *after) -> (carry, X, lengths) of a step `u` (3w + 3m,) on an `error`."""
        worst = _greater(self._worst, _greatest([ca.fabs(error[i]) for i in range(error.numel())]))
        X = self._all + u
        carry = ca.vertcat(self._all[self._live], u[self._live], worst)
        outputs = [ca.densify(output) for output in (carry, X[self._chain.before :], self.lengths)]
        return ca.Function(name, [self._carry, *before, self._own, *after], outputs)


def _greatest(values: list[ca.SX]) -> ca.SX:
    """Return the greatest of one or more numbers, pair by pair."""
    while len(values) > 1:
        values = [_greater(a, b) for a, b in zip(values[::2], values[1::2], strict=False)] + (
            values[-1:] if len(values) % 2 else []
        )
    return values[0]


def _greater(a: ca.SX, b: ca.SX) -> ca.SX:
    """Return the greater of two numbers, or NaN where one is; ``fmax`` would pass over it."""
    return (a + b + ca.fabs(a - b)) / 2


def member_lengths(chain: Chain, points: ca.SX) -> ca.SX:
    """Return (3m,) the lengths of a period's members where its nodes are at `points` (3, w + m)."""
    first, second = (points[:, chain.member_places[:, e].tolist()] for e in range(2))
    return ca.vertcat(*[ca.norm_2(first[:, i] - second[:, i]) for i in range(chain.own)])
