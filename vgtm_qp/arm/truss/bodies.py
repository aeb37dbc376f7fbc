"""The members of a truss as bodies that keep a clearance, and the points that span them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.truss.chords import chord_deviation
from vgtm_qp.arm.truss.joints import member_ends
from vgtm_qp.arm.truss.kinematics import EndKinematics
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.geometry.bodies import Bodies, capsules

Array = NDArray[np.float64]
Index = NDArray[np.int64]


def member_bodies(truss: Truss) -> Bodies:
    """Return the members as capsules: between nodes, or with offset joints between the points 2 m and 2 m + 1."""
    points = truss.members if truss.joints is None else np.arange(2 * truss.member_count).reshape(-1, 2)
    return capsules(points, truss.radius, truss.member_names, joints=truss.members, kind="member")


class OffsetEnds:
    """The ends of members in offset joints as functions of the nodes: points 2 m and 2 m + 1 of member m.

    Raises
    ------
    TrussError
        The truss has pin joints: its members end in the nodes.
    """

    def __init__(self, truss: Truss, *, compiled: bool = True) -> None:
        self._truss = truss
        self._kinematics = EndKinematics(truss, compiled=compiled)

    def points(self, X: Array) -> Array:
        """Return the ends (2 M, 3) at node positions `X` (N, 3), m."""
        return member_ends(self._truss, X).reshape(-1, 3)

    def over_nodes(self, X: Array, points: Index, coefficients: Array) -> tuple[Index, Array]:
        """Return the nodes (R, 3 S) and coefficients (R, 3 S, 3) of rows at `X` (N, 3), m.

        The rows are given by `points` (R, S) and `coefficients` (R, S, 3) of the points' displacements. A point is
        moved by the three nodes that orient its joint.
        """
        kinematics, (count, slots) = self._kinematics, points.shape
        kinematics.evaluate(X)
        member, end = points >> 1, points & 1
        jacobian = kinematics.jacobian[member, end]
        by_nodes = np.einsum("rsc,rscn->rsn", coefficients, jacobian).reshape(count, 3 * slots, 3)
        return kinematics.nodes[member, end].reshape(count, 3 * slots), by_nodes

    def deviation(self, start: Array, end: Array) -> float:
        """Return how far a point is from its chord at most, m, while nodes move straight from `start` to `end` (N, 3).

        Infinite where no bound is known.
        """
        return chord_deviation(self._truss, start, end)
