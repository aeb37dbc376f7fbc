"""A truss in CasADi's symbols, and the elimination of its bays one after another.

With the square diagonal blocks D and the blocks L towards earlier bays of the length Jacobian, d_rho = K d_a + r
follows from K = D^-1 (E - L K_earlier), see ``native/qp.c``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from vgtm_qp.arm.symbols import ArmSymbols, Constants, EliminationStage
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.arrays import Index
from vgtm_qp.rows.members import fixed_error, length_rhs, member_function

_Layers = list[tuple[Index, ca.Sparsity]]
"""Terms whose sum is a block: places in the gradients, and the sparsity that they fill."""

_Blocks = list[tuple[ca.MX, ca.MX]]


@dataclass(frozen=True, eq=False)
class PlacedNodes:
    """One stage of the elimination: `nodes` hang by `members` on `earlier` free nodes; all are indices."""

    nodes: Index
    members: Index
    earlier: Index


def elimination_stages(truss: Truss) -> list[PlacedNodes]:
    """Return the stages of the truss in order; empty if one lacks three members for each of its nodes."""
    node_stage = np.where(truss.base, -1, truss.stage)
    member_stage = node_stage[truss.member_nodes].max(axis=1)
    stages = []
    for stage in np.unique(truss.stage[truss.free]):
        nodes = truss.free[node_stage[truss.free] == stage]
        members = np.flatnonzero(member_stage == stage)
        if len(members) != 3 * len(nodes):
            return []
        used = np.unique(truss.member_nodes[members])
        earlier = used[(node_stage[used] < stage) & ~truss.base[used]]
        stages.append(PlacedNodes(nodes, members, earlier))
    return stages


class TrussSymbols(ArmSymbols):
    """Lengths and gradients of a truss at symbolic positions X (3, N); see ``arm.ArmSymbols``."""

    def __init__(self, truss: Truss, constants: Constants) -> None:
        super().__init__(truss.home_lengths, truss.actuators, constants)
        self._truss = truss
        self.shape = 3, truss.node_count
        self.given: list[int] = np.flatnonzero(truss.base).tolist()
        self._offsets: list[ca.MX] = []
        if truss.joints is not None:
            self._offsets = [constants.add("offsets", truss.joints.offset.reshape(-1, 3))]
        self._member = member_function(has_offsets=truss.joints is not None)
        self._solvers: dict[object, ca.Function] = {}
        self._columns = truss.member_nodes.reshape(-1).tolist()
        self._place = {int(node): 3 * k for k, node in enumerate(truss.free)}

    @cached_property
    def _stages(self) -> list[PlacedNodes]:
        return elimination_stages(self._truss)

    @cached_property
    def _patterns(self) -> list[tuple[_Layers, _Layers]]:
        """Layers of the blocks D and L of each stage."""
        return [
            (self._layers(stage.members, stage.nodes), self._layers(stage.members, stage.earlier))
            for stage in self._stages
        ]

    @property
    def can_eliminate(self) -> bool:
        return bool(self._stages)

    def nodes(self, X: ca.MX) -> ca.MX:
        return X

    def quantities(self, X: ca.MX) -> ca.MX:
        """See ``arm.ArmSymbols``: the member lengths."""
        return self._lengths(X)[0]

    def _lengths(self, X: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Return lengths (M, 1) and all gradients (3 Q M, 1) at positions (3, N)."""
        function = self._member.map(self._truss.member_count)
        lengths, gradients = function(X[:, self._columns], *self._offsets)
        return lengths.T, ca.vec(gradients)

    def motion(self, X: ca.MX, at: ca.MX, moved: ca.MX) -> list[ca.MX]:
        """See ``arm.ArmSymbols``: gradients and the rows' right-hand sides."""
        lengths, _ = self._lengths(X)
        _, gradients = self._lengths(at)
        error = fixed_error(lengths, self.home, self._truss.actuated)
        return [gradients, length_rhs(error, gradients, moved, self._truss.member_nodes)]

    def coordinates(self, nodes: Any, strokes: Any) -> Any:  # noqa: ARG002
        """See ``arm.ArmSymbols``: the nodes themselves."""
        return nodes

    def along(self, X: ca.MX, coordinates: ca.MX) -> ca.MX:
        zero, place = ca.DM.zeros(3), self._place
        columns = (
            coordinates[place[n] : place[n] + 3] if n in place else zero
            for n in range(self._truss.node_count)
        )
        return X + ca.horzcat(*columns)

    def closed(self, X: ca.MX, lower: ca.MX, upper: ca.MX) -> ca.MX:
        lengths, gradients = self._lengths(X)
        error = self.aims(lengths, lower, upper) - lengths
        rhs = [error[stage.members.tolist()] for stage in self._stages]
        return X + self._substituted(self._blocks(gradients), rhs)

    def follows(self, tracked: Sequence[int]) -> bool:
        """See ``arm.ArmSymbols``: each stage has a tracked face, whose coordinates stand for three actuated members."""
        truss = self._truss
        faces = {frozenset(truss.faces[face].tolist()) for face in tracked}
        stages = [frozenset(stage.nodes.tolist()) for stage in self._stages]
        three = all(int(truss.actuated[stage.members].sum()) == 3 for stage in self._stages)
        return bool(stages) and three and len(stages) == len(tracked) and faces.issuperset(stages)

    def elimination(self) -> list[EliminationStage]:
        """See ``arm.ArmSymbols``: the length Jacobian, stage by stage."""
        scatter, found = self._truss.scatter, []
        for stage in self._stages:
            row = np.full(scatter.shape[0], -1)
            row[stage.members] = np.arange(len(stage.members))
            kept = np.flatnonzero(row[scatter.member] >= 0)
            places = np.array([self._place[node] for node in stage.nodes.tolist()])
            coordinates = (places[:, None] + np.arange(3)).reshape(-1)
            entries = row[scatter.member[kept]], scatter.column[kept], scatter.flat[kept]
            found.append(EliminationStage(stage.members, coordinates, *entries))
        return found

    def _layers(self, members: Index, nodes: Index) -> _Layers:
        """Return the layers of the block of `members` (rows) and free `nodes` (three columns each)."""
        scatter = self._truss.scatter
        row, column = np.full(scatter.shape[0], -1), np.full(scatter.shape[1], -1)
        row[members] = np.arange(len(members))
        for k, node in enumerate(nodes.tolist()):
            column[self._place[node] : self._place[node] + 3] = 3 * k + np.arange(3)
        rows, columns = row[scatter.member], column[scatter.column]
        kept = np.flatnonzero((rows >= 0) & (columns >= 0))
        kept = kept[np.lexsort((rows[kept], columns[kept]))]
        place = columns[kept] * len(members) + rows[kept]
        depth = np.arange(len(kept)) - np.searchsorted(place, place)
        layers = []
        for k in range(depth.max(initial=-1) + 1):
            chosen = kept[depth == k]
            at = rows[chosen].tolist(), columns[chosen].tolist()
            layers.append((scatter.flat[chosen], ca.Sparsity.triplet(len(members), 3 * len(nodes), *at)))
        return layers

    def _blocks(self, gradients: ca.MX) -> _Blocks:
        """Return the blocks D and L of each stage, sparse."""
        blocks = []
        for stage, (own, earlier) in zip(self._stages, self._patterns, strict=True):
            D = _block(own, gradients, stage.members, stage.nodes)
            blocks.append((D, _block(earlier, gradients, stage.members, stage.earlier)))
        return blocks

    def _solver(self, D: ca.Sparsity) -> ca.Function:
        """Return (D, right-hand side) -> D^-1 rhs by an unrolled sparse QR factorisation."""
        key = D.size1(), tuple(D.row()), tuple(D.colind())
        if key not in self._solvers:
            block, rhs = ca.SX.sym("D", D), ca.SX.sym("rhs", D.size1())
            orthogonal, triangular = ca.qr(block)
            solved = ca.densify(ca.solve(triangular, orthogonal.T @ rhs))
            self._solvers[key] = ca.Function(f"bay{len(self._solvers)}", [block, rhs], [solved])
        return self._solvers[key]

    def _substituted(self, blocks: _Blocks, rhs: list[ca.MX]) -> ca.MX:
        """Return displacements (3, N) of all nodes: each stage's blocks D and L place its nodes after earlier ones."""
        place: dict[int, ca.MX] = {}
        for stage, (D, L), right in zip(self._stages, blocks, rhs, strict=True):
            if len(stage.earlier):
                right = right - L @ ca.vertcat(*(place[int(node)] for node in stage.earlier))
            step = self._solver(D.sparsity())(D, right)
            place |= zip(stage.nodes.tolist(), ca.vertsplit(step, 3), strict=True)
        zero = ca.DM.zeros(3)
        return ca.horzcat(*(place.get(node, zero) for node in range(self._truss.node_count)))


def _block(layers: _Layers, gradients: ca.MX, members: Index, nodes: Index) -> ca.MX:
    block = ca.MX(len(members), 3 * len(nodes))
    for flat, sparsity in layers:
        block = block + ca.MX(sparsity, gradients[flat.tolist()])
    return block
