"""What both programs are made of: node positions, member lengths and tip as CasADi expressions."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca

from vgtm_qp.arm.truss.kinematics import joint_frame
from vgtm_qp.arm.truss.truss import Truss

OPTIONS: dict[str, Any] = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-9,
    "ipopt.constr_viol_tol": 1e-10,
    "ipopt.bound_relax_factor": 0.0,
}
"""Options of every program; the bounds are those of the arm, not relaxed ones."""


class ProgramSymbols(NamedTuple):
    """A truss as expressions of the coordinates of its free nodes.

    Attributes
    ----------
    x : (3 F,)
        Coordinates of the free nodes, node after node, m.
    nodes : list of (3,)
        All nodes; the given ones are at home.
    ends : list of pairs of (3,)
        The two ends of each member, eqs. (12)-(13).
    lengths : (M,)
        m.
    tip : (3,)
        The end effector.
    """

    x: ca.SX
    nodes: list[ca.SX]
    ends: list[tuple[ca.SX, ca.SX]]
    lengths: ca.SX
    tip: ca.SX

    def tip_normal(self, truss: Truss) -> ca.SX:
        """Return (3,) a normal of the triangle of the first three nodes of the tip; its length varies."""
        a, b, c = (self.nodes[n] for n in truss.tip[:3])
        normal: ca.SX = ca.cross(b - a, c - a)
        return normal


def program_symbols(truss: Truss) -> ProgramSymbols:
    """Return the expressions of a truss whose base is at rest."""
    x = ca.SX.sym("x", 3 * len(truss.free))
    column = {int(node): 3 * k for k, node in enumerate(truss.free)}
    nodes: list[ca.SX] = [
        x[column[n] : column[n] + 3] if n in column else ca.SX(ca.DM(truss.home[n]))
        for n in range(truss.node_count)
    ]
    ends = _member_ends(truss, nodes)
    lengths = ca.vertcat(*(ca.norm_2(a - b) for a, b in ends))
    tip = sum(weight * nodes[n] for weight, n in zip(truss.tip_weights, truss.tip, strict=True))
    return ProgramSymbols(x, nodes, ends, lengths, tip)


def _member_ends(truss: Truss, nodes: list[ca.SX]) -> list[tuple[ca.SX, ca.SX]]:
    if truss.joints is None:
        return [(nodes[i], nodes[j]) for i, j in truss.members]
    frames = [joint_frame(*(nodes[n] for n in corner)) for corner in truss.joints.triangle]
    return [
        (
            nodes[i] + ca.mtimes(frames[i], ca.DM(truss.joints.offset[m, 0])),
            nodes[j] + ca.mtimes(frames[j], ca.DM(truss.joints.offset[m, 1])),
        )
        for m, (i, j) in enumerate(truss.members)
    ]
