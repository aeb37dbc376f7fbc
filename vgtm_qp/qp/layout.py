"""The layout of a step's QP: which columns and rows there are, built once from the arm, the curve and the task."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from vgtm_qp.arm.arm import Arm
from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.curve.families import CurveFamily
from vgtm_qp.problem.method import Weights
from vgtm_qp.qp.shape import CurveShape
from vgtm_qp.rows.curve import legs
from vgtm_qp.rows.tip import axes as tip_axes

_ENDS_AT_TIP = 3
"""A curve of so many control vertices can begin at the base, along its normal, and end anywhere."""

_LEAST_LEG = 0.1
"""Shortest that a leg whose direction is given becomes, as a share of one of a straight polygon at home."""

_GOAL_REACH = 0.01
"""Greatest part of the arm's length that a control vertex is drawn towards its goal in one step."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Index maps of one arm with one curve and one tip task; everything here is constant over a maneuver.

    Attributes
    ----------
    arm : Arm
    curve_weights, curve_slopes : (K, V)
        w_i(s_k) and w_i'(s_k) at the curve nodes; V = 0 where there is no curve.
    tracked : (K,) int
        The stations that track them.
    tip_rows : tuple of str
        Names of the end effector's coordinates.
    hard_tracking : bool
        Position tracking as an equality at every station instead of a penalty.
    elastic_tip : bool
        The end effector's rows may give way at an exact penalty.
    weights : Weights
    hard_turns : bool
        The stations' turns as equalities too, beside their positions.
    shape : CurveShape or None
        How the curve's nodes are placed; None for a curve that is no more than its tables.
    vertex_goals : tuple of int
        Control vertices that are drawn to goals.
    """

    arm: Arm
    curve_weights: Array
    curve_slopes: Array
    tracked: Index
    tip_rows: tuple[str, ...]
    weights: Weights
    hard_tracking: bool = False
    elastic_tip: bool = False
    hard_turns: bool = False
    shape: CurveShape | None = None
    vertex_goals: tuple[int, ...] = ()

    @cached_property
    def node_column(self) -> Index:
        """(N,) first column of each free node's displacement; -1 for base nodes."""
        column = np.full(len(self.arm.node_names), -1, dtype=np.int64)
        column[self.arm.free] = 3 * np.arange(len(self.arm.free))
        return column

    @property
    def node_columns(self) -> int:
        """Number of node displacement coordinates, 3 (N - N_c)."""
        return 3 * len(self.arm.free)

    @property
    def vertices(self) -> int:
        """Number of control vertices V."""
        return int(self.curve_weights.shape[1])

    @property
    def general(self) -> CurveShape | None:
        """The curve's shape where its rows have to be computed anew for each QP; None where tables do."""
        return None if self.shape is None or self.shape.is_plain else self.shape

    @property
    def family(self) -> CurveFamily | None:
        """The curve's family, where its shape is known."""
        return None if self.shape is None else self.shape.family

    @property
    def is_tabled(self) -> bool:
        """Whether the QP has no more rows and objectives than a curve of constant tables needs."""
        return self.general is None and not self.hard_turns and not self.vertex_goals

    @property
    def torsion(self) -> int:
        """Number of torsion coordinates T."""
        return 0 if self.general is None else self.general.torsion

    @property
    def turns(self) -> int:
        """Turns R of each station that are tracked."""
        return 2 if self.general is None else self.general.turns

    @cached_property
    def ends_at_tip(self) -> bool:
        """Whether the curve ends in the end effector, where it has control vertices enough to go there."""
        tip, last = self.arm.end_effector.nodes, self.arm.stations.nodes[-1:]
        return self.vertices >= _ENDS_AT_TIP and np.array_equal(last, [tip])

    @property
    def ends_along_tip(self) -> bool:
        """Whether it does so in the tip's direction: where that is tracked, and another control vertex is there."""
        turned = len(tip_axes(self.tip_rows)) < len(self.tip_rows)
        return turned and self.ends_at_tip and self.vertices > _ENDS_AT_TIP

    @cached_property
    def hard_gaps(self) -> Mask:
        """(K, 3) which gaps are equalities: with hard tracking all, and always that of the curve's end.

        The curve ends in the end effector, eq. (34), as it begins at the base.
        """
        hard = np.full((len(self.tracked), 3), self.hard_tracking)
        hard[-1:] |= self.ends_at_tip
        return hard

    @cached_property
    def hard_tilts(self) -> Mask:
        """(K, R) which turns are, those of the curve's end among them."""
        hard = np.full((len(self.tracked), self.turns), self.hard_turns)
        hard[-1:, :2] |= self.ends_along_tip
        return hard

    @cached_property
    def hard(self) -> Index:
        """Which of all gaps, then turns, are equalities, rising."""
        return np.flatnonzero(np.concatenate([self.hard_gaps.reshape(-1), self.hard_tilts.reshape(-1)]))

    @property
    def spacings(self) -> int:
        """Number S of spacings between curve nodes that are rows."""
        return 0 if self.general is None else self.general.spacings

    @property
    def least_squares(self) -> int:
        """Number of the objective's rows over displacements: nodes, gaps and turns of the stations, spacings."""
        return self.node_columns + (3 + self.turns) * len(self.tracked) + self.spacings

    @property
    def free_curve(self) -> int:
        """Number of coordinates of the curve that its base leaves free: 3 V - 5 + T."""
        return 3 * self.vertices - 5 + self.torsion if self.vertices else 0

    @cached_property
    def gap_weights(self) -> Array:
        """(K, 3) weights of the stations' gaps; zero where they are equalities."""
        return np.where(self.hard_gaps, 0.0, self.weights.tracking)

    @cached_property
    def tilt_weights(self) -> Array:
        """(K, R) weights of the stations' turns, likewise."""
        weights = [self.weights.tangent, self.weights.tangent, self.weights.roll][: self.turns]
        return np.where(self.hard_tilts, 0.0, weights)

    @cached_property
    def _end_gain(self) -> Array:
        """(V, 1 or 2) least changes of the control vertices behind the base that move the curve's end, or turn it."""
        rows = [self.curve_weights[-1], self.curve_slopes[-1]][: 1 + self.ends_along_tip]
        gain = np.zeros((self.vertices, len(rows)))
        gain[2:] = np.linalg.pinv(np.array(rows)[:, 2:])
        return gain

    def ended(self, vertices: Array, position: Array, rotation: Array) -> Array:
        """Return (V, 3) control vertices whose curve ends at the tip's `position` (3,), m, by the least change.

        It ends along the z-axis of its `rotation` (3, 3) where the direction is tracked.
        """
        if not self.ends_at_tip:
            return vertices
        missing = [position - self.curve_weights[-1] @ vertices]
        if self.ends_along_tip:
            slope, axis = self.curve_slopes[-1] @ vertices, rotation[:, 2]
            missing.append((slope @ axis) * axis - slope)
        return np.asarray(vertices + self._end_gain @ np.array(missing))

    @cached_property
    def legs(self) -> Index:
        """(G, 2) control vertices of the legs whose directions are given: the first, and the last along the tip's."""
        last = self.vertices - 1
        legs = [(0, 1), (last - 1, last)][: int(last > 0) + self.ends_along_tip]
        return np.array(legs, dtype=np.int64).reshape(-1, 2)

    def leg_bounds(self, vertices: Array, normal: Array) -> tuple[Array, Array]:
        """Return axes (G, 3) of the :attr:`legs`, and what their lengths may change by at least (G,), m."""
        if not len(self.legs):
            return np.zeros((0, 3)), np.zeros(0)
        axes, lengths = legs(vertices, normal, both=len(self.legs) > 1)
        least = _LEAST_LEG * self.arm.height / (self.vertices - 1)
        return axes, np.minimum(least - lengths, 0.0)

    def record(self) -> dict[str, Any] | None:
        """Return what verification needs to know of the curve and of the stations on it, as JSON data; or None.

        Keys: ``breaks``, ``extraction``, ``nodes`` and ``by_arc_length`` of the curve, see ``CurveFamily`` and
        ``CurveShape``; ``stations`` and ``weights``, the nodes whose mean each station is; ``held``, whether they are
        kept on the curve; ``ends_at_tip``, ``ends_along_tip``.
        """
        if self.shape is None:
            return None
        stations, family = self.arm.stations, self.shape.family
        used = np.flatnonzero(stations.weights[self.tracked].any(axis=0))
        return {
            "breaks": family.breaks.tolist(),
            "extraction": family.extraction.tolist(),
            "nodes": self.shape.nodes.tolist(),
            "by_arc_length": self.shape.by_arc_length,
            "stations": stations.nodes[self.tracked][:, used].tolist(),
            "weights": stations.weights[self.tracked][:, used].tolist(),
            "held": self.hard_tracking,
            "ends_at_tip": self.ends_at_tip,
            "ends_along_tip": self.ends_along_tip,
        }

    @cached_property
    def vertex_hessian(self) -> Array:
        """(V, V) of the objectives that are the curve's own, for each axis."""
        drawn = np.isin(np.arange(self.vertices), self.vertex_goals) * self.weights.vertex_goal
        rate = self.weights.curve_rate * np.eye(self.vertices)
        return np.asarray(rate + self.weights.smoothness * self.polygon_bending + np.diag(drawn))

    @cached_property
    def curve_hessian(self) -> Array:
        """(D, D) the same over all coordinates of the curve: control vertices, then torsion."""
        vertices = np.kron(self.vertex_hessian, np.eye(3))
        return np.asarray(block_diag(vertices, self.weights.curve_rate * np.eye(self.torsion)))

    def goal_pull(self, vertices: Array, goals: Array | None) -> Array:
        """Return (V, 3) the gradient of the control vertices' goals (V, 3), m; NaN where a vertex has none.

        A step draws a vertex no further than by a share of the arm's length: a goal far away must not outweigh the
        progress of the tip.
        """
        pull = np.zeros_like(vertices)
        drawn = list(self.vertex_goals)
        if drawn and goals is not None:
            gap = vertices[drawn] - goals[drawn]
            apart = np.linalg.norm(gap, axis=1, keepdims=True)
            reach = _GOAL_REACH * self.arm.height
            pull[drawn] = self.weights.vertex_goal * gap * np.minimum(1.0, reach / np.maximum(apart, 1e-300))
        return pull

    def vertex_gradient(self, vertices: Array, goals: Array | None) -> Array:
        """Return (V, 3) the gradient of the curve's own objectives at control vertices (V, 3), m, and their goals."""
        return self.weights.smoothness * (self.polygon_bending @ vertices) + self.goal_pull(vertices, goals)

    @cached_property
    def polygon_bending(self) -> Array:
        """(V, V) D'D with D the second difference of the control vertices."""
        second = (
            np.diff(np.eye(self.vertices), n=2, axis=0) if self.vertices > 2 else np.zeros((0, self.vertices))
        )
        return np.asarray(second.T @ second)
