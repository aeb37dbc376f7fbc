"""The condensed QP of one step as one CasADi graph, from node positions to the rows of its least squares.

The bays are eliminated one after another: with the square diagonal blocks D and the blocks L towards earlier bays of
the length Jacobian, d_rho = K d_a + r follows from K = D^-1 (E - L K_earlier). What comes out is the matrix whose Gram
matrix is Hessian and gradient of the objective; everything constant over a maneuver is an argument that is bound once,
so that the compiled library depends on the topology of the arm alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.truss.kinematics import frame_constants, frame_function, member_function
from vgtm_qp.qp.layout import Layout

Array = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Stage:
    """One step of the elimination: `nodes` hang by `members` on `earlier` free nodes; all are indices."""

    nodes: Index
    members: Index
    earlier: Index


def elimination_stages(layout: Layout) -> list[Stage] | None:
    """Return the stages of the truss in order, or None where a stage does not have three members for each node."""
    truss = layout.truss
    node_stage = np.where(truss.base, -1, truss.stage)
    member_stage = node_stage[layout.member_nodes].max(axis=1)
    stages = []
    for stage in np.unique(truss.stage[truss.free]):
        nodes = truss.free[node_stage[truss.free] == stage]
        members = np.flatnonzero(member_stage == stage)
        if len(members) != 3 * len(nodes):
            return None
        used = np.unique(layout.member_nodes[members])
        earlier = used[(node_stage[used] < stage) & ~truss.base[used]]
        stages.append(Stage(nodes, members, earlier))
    return stages


class TrussGraph:
    """Lengths, gradients and frames of a truss at symbolic positions, and the elimination of its bays."""

    def __init__(self, layout: Layout, stages: list[Stage], constants: Constants) -> None:
        self.layout = layout
        self.stages = stages
        truss = layout.truss
        self._offsets: list[ca.MX] = []
        if truss.joints is not None:
            self._offsets = [constants.add("offsets", truss.joints.offset.reshape(-1, 3))]
        self._member = member_function(truss)
        self._shapes: dict[object, ca.Function] = {}
        self._columns = layout.member_nodes.reshape(-1).tolist()
        self._blocks = [self._pattern(stage) for stage in stages]

    def lengths(self, X: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Return lengths (M, 1) and all gradients (3 Q M, 1) at positions (3, N)."""
        function = self._member.map(self.layout.truss.member_count)
        lengths, gradients = function(X[:, self._columns], *self._offsets)
        return lengths.T, ca.vec(gradients)

    def _pattern(
        self, stage: Stage
    ) -> tuple[list[tuple[Index, ca.Sparsity]], list[tuple[Index, ca.Sparsity]]]:
        """Return, for D and L, the terms whose sum is the block: gradient positions and the sparsity they fill."""
        nodes = self.layout.member_nodes[stage.members]
        terms = []
        for targets in (stage.nodes, stage.earlier):
            found: dict[tuple[int, int], list[int]] = {}
            place = {int(node): 3 * k for k, node in enumerate(targets)}
            for row, (member, names) in enumerate(zip(stage.members, nodes, strict=True)):
                for slot, node in enumerate(names):
                    if int(node) in place:
                        for axis in range(3):
                            flat = (int(member) * nodes.shape[1] + slot) * 3 + axis
                            found.setdefault((row, place[int(node)] + axis), []).append(flat)
            layers = []
            for depth in range(max((len(v) for v in found.values()), default=0)):
                entries = sorted((c, r, v[depth]) for (r, c), v in found.items() if len(v) > depth)
                sparsity = ca.Sparsity.triplet(
                    len(stage.members), 3 * len(targets), [e[1] for e in entries], [e[0] for e in entries]
                )
                layers.append((np.array([e[2] for e in entries], dtype=np.int64), sparsity))
            terms.append(layers)
        return terms[0], terms[1]

    def _block(
        self, layers: list[tuple[Index, ca.Sparsity]], gradients: ca.MX, shape: tuple[int, int]
    ) -> ca.MX:
        block = ca.MX(*shape)
        for flat, sparsity in layers:
            block = block + ca.MX(sparsity, gradients[flat.tolist()])
        return block

    def blocks(self, k: int, gradients: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Return the blocks D and L of stage `k`, sparse."""
        stage = self.stages[k]
        rows = len(stage.members)
        own, earlier = self._blocks[k]
        columns = 3 * len(stage.earlier)
        return self._block(own, gradients, (rows, rows)), self._block(earlier, gradients, (rows, columns))

    def _solver(self, D: ca.Sparsity, width: int) -> ca.Function:
        """Return (D, right-hand sides (rows, width)) -> D^-1 rhs by an unrolled sparse QR factorisation."""
        key = (D.size1(), tuple(D.row()), tuple(D.colind()), width)
        if key not in self._shapes:
            block, rhs = ca.SX.sym("D", D), ca.SX.sym("rhs", D.size1(), width)
            orthogonal, triangular = ca.qr(block)
            solved = ca.densify(ca.solve(triangular, orthogonal.T @ rhs))
            self._shapes[key] = ca.Function(f"bay{len(self._shapes)}", [block, rhs], [solved])
        return self._shapes[key]

    def response(self, gradients: ca.MX, rhs: ca.MX) -> ca.MX:
        """Return [K, r] (3 (N - N_c), n_a + 1): node displacements per actuator displacement, and for `rhs` (M, 1)."""
        truss = self.layout.truss
        actuators = truss.actuators.tolist()
        count = len(actuators)
        place: dict[int, ca.MX] = {}
        for k, stage in enumerate(self.stages):
            D, L = self.blocks(k, gradients)
            own = [(row, actuators.index(int(m))) for row, m in enumerate(stage.members) if truss.actuated[m]]
            unit = ca.DM(len(stage.members), len(own))
            for column, (row, _) in enumerate(own):
                unit[row, column] = 1.0
            earlier = len(stage.earlier)
            arguments: list[ca.MX] = [ca.densify(-L)] if earlier else []
            arguments += [ca.MX(ca.densify(unit))] if own else []
            width = 3 * earlier + len(own) + 1
            solved = self._solver(D.sparsity(), width)(D, ca.horzcat(*arguments, rhs[stage.members.tolist()]))
            particular = solved[:, -1]
            columns = ca.MX(len(stage.members), count)
            if earlier:
                before = ca.vertcat(*(place[int(node)] for node in stage.earlier))
                product = solved[:, : 3 * earlier] @ before
                columns, particular = product[:, :count], product[:, count] + particular
            if own:
                spread = ca.DM(
                    ca.Sparsity.triplet(len(own), count, list(range(len(own))), [c for _, c in own]), 1.0
                )
                columns = columns + solved[:, 3 * earlier : 3 * earlier + len(own)] @ spread
            block = ca.horzcat(ca.densify(columns), particular)
            for j, node in enumerate(stage.nodes):
                place[int(node)] = block[3 * j : 3 * j + 3, :]
        return ca.vertcat(*(place[int(node)] for node in truss.free))

    def newton(self, X: ca.MX, wanted: ca.MX, lengths: ca.MX, gradients: ca.MX) -> ca.MX:
        """Return positions (3, N) after one Newton step of the free nodes to `wanted` lengths (M, 1)."""
        error = wanted - lengths
        blocks = [self.blocks(k, gradients) for k in range(len(self.stages))]
        return X + self._substituted(blocks, [error[stage.members.tolist()] for stage in self.stages])

    def newton_on_faces(
        self, X: ca.MX, wanted: ca.MX, lengths: ca.MX, gradients: ca.MX, gaps: ca.MX, faces: Index
    ) -> ca.MX:
        """Return positions after a Newton step to `wanted` lengths of fixed members and faces moved by `gaps` (3, K).

        `faces` (stages,) are those of :func:`stage_faces`; actuated members take the lengths that follow.
        """
        truss, error = self.layout.truss, wanted - lengths
        tracked = self.layout.tracked.tolist()
        blocks, rhs = [], []
        for k, (stage, face) in enumerate(zip(self.stages, faces.tolist(), strict=True)):
            fixed = np.flatnonzero(~truss.actuated[stage.members]).tolist()
            D, L = self.blocks(k, gradients)
            weight = dict(zip(truss.faces[face].tolist(), truss.face_weights[face], strict=True))
            centre = ca.sparsify(ca.DM(np.kron([weight[int(n)] for n in stage.nodes], np.eye(3))))
            blocks.append((ca.vertcat(D[fixed, :], centre), ca.vertcat(L[fixed, :], ca.MX(3, L.size2()))))
            rhs.append(ca.vertcat(error[stage.members[fixed].tolist()], gaps[:, tracked.index(face)]))
        return X + self._substituted(blocks, rhs)

    def _substituted(self, blocks: list[tuple[ca.MX, ca.MX]], rhs: list[ca.MX]) -> ca.MX:
        """Return displacements (3, N) of all nodes: each stage's blocks D and L place its nodes after earlier ones."""
        place: dict[int, ca.MX] = {}
        for stage, (D, L), right in zip(self.stages, blocks, rhs, strict=True):
            if len(stage.earlier):
                right = right - L @ ca.vertcat(*(place[int(node)] for node in stage.earlier))
            step = self._solver(D.sparsity(), 1)(D, right)
            for j, node in enumerate(stage.nodes):
                place[int(node)] = step[3 * j : 3 * j + 3]
        zero = ca.DM.zeros(3)
        return ca.horzcat(*(place.get(node, zero) for node in range(self.layout.truss.node_count)))


def stage_faces(layout: Layout, stages: list[Stage]) -> Index | None:
    """Return the tracked face of each stage where its place determines the stage's nodes with the fixed members.

    None where that is not so: a face's three coordinates must stand for three actuated members.
    """
    truss = layout.truss
    nodes_of = {frozenset(truss.faces[face].tolist()): int(face) for face in layout.tracked}
    faces = [nodes_of.get(frozenset(stage.nodes.tolist()), -1) for stage in stages]
    three = all(int(truss.actuated[stage.members].sum()) == 3 for stage in stages)
    return np.array(faces) if three and min(faces) >= 0 and len(faces) == len(layout.tracked) else None


class Constants:
    """Numbers that are constant over a maneuver: arguments of a graph beside the values to bind to them once."""

    def __init__(self) -> None:
        self.symbols: list[ca.MX] = []
        self.values: list[Array] = []

    def add(self, name: str, value: Array) -> ca.MX:
        """Return the symbol of a constant whose columns are the rows of `value`, a vector or matrix."""
        self.symbols.append(ca.MX.sym(name, *reversed(np.atleast_2d(value).shape)))
        self.values.append(np.ascontiguousarray(value, dtype=float).reshape(-1))
        return self.symbols[-1]


class Frames:
    """Frames of F faces with K nodes each, with their constants."""

    def __init__(self, home: Array, rotations: Array, nodes: Index, constants: Constants, name: str) -> None:
        values = [frame_constants(points, frame) for points, frame in zip(home, rotations, strict=True)]
        cosines, sines, alignments = (np.stack(column) for column in zip(*values, strict=True))
        self._arguments = [
            constants.add(f"{name}_cosines", cosines),
            constants.add(f"{name}_sines", sines),
            constants.add(f"{name}_alignments", alignments.transpose(0, 2, 1).reshape(-1, 3)),
        ]
        self._columns = nodes.reshape(-1).tolist()
        self._function = frame_function(home.shape[1]).map(len(home))

    def at(self, X: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Return rotations (3, 3F) and spins (3, 3KF) at positions (3, N)."""
        rotation, spin = self._function(X[:, self._columns], *self._arguments)
        return rotation, spin
