"""The layout of a step's QP: its columns and rows, built once from the arm, the curve and the task."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from vgtm_qp.arm.arm import Arm
from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.curve.families import CurveFamily
from vgtm_qp.problem.method import Weights
from vgtm_qp.qp.shape import CurveShape
from vgtm_qp.qp.terms import OwnTerms
from vgtm_qp.rows.curve import polygon_bending
from vgtm_qp.rows.tip import axes as tip_axes
from vgtm_qp.rows.tip import levers

_ENDS_AT_TIP = 3
"""Fewest control vertices with which a curve can begin at the base, along its normal, and end anywhere."""

_LEAST_LEG = 0.1
"""Least length of a leg with a given direction, as a share of a leg of the straight polygon at home."""

_GOAL_REACH = 0.01
"""Greatest share of the arm's length by which a control vertex is drawn towards its goal in one step."""


def with_angles(weights: Weights, arm: Arm) -> Weights:
    """Return the weights with those of stations' squared angles times the arm's unit squared, m^2/rad^2."""
    area = arm.unit**2
    return weights.model_copy(update={"tangent": area * weights.tangent, "roll": area * weights.roll})


_REACH = 0.03
"""Greatest part of a gap that a step closes in a layout that gives way, over the arm's unit."""

_SLACK_CURVATURE, _LEAST_PENALTY = 1e-5, 0.1

_FIRM = 1e3
"""Least weight of gaps that give way: far above the null-space terms, so that only other rows open gaps."""


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
        The end effector's rows have slacks with an exact penalty.
    weights : Weights
        With those of squared angles in m^2/rad^2, see :func:`with_angles`.
    hard_turns : bool
        The stations' turns as equalities too, beside their positions.
    reach : float
        Greatest part of a gap, m, or of a turn times the arm's unit, that a step closes if it is not an
        equality.
    shape : CurveShape or None
        How the curve's nodes are placed; None for a curve that constant tables describe.
    vertex_goals : tuple of int
        Control vertices that are drawn to goals.
    own : OwnTerms or None
        Objectives and rows of the user's own; an arm that has some is moved by the general engine.
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
    reach: float = math.inf
    shape: CurveShape | None = None
    vertex_goals: tuple[int, ...] = ()
    own: OwnTerms | None = None

    def giving_way(self) -> Layout:
        """Return the layout in which hard tracking becomes a penalty with a great weight.

        Gaps then open only where other rows leave no choice. The weights draw stations back within a few
        steps; the weights of elastic tracking would leave them off the curve. A step closes a gap by no more
        than a share of the arm's unit: so great a weight on the whole gap would lead to motions that are no
        longer linear.
        """
        weights, firm = self.weights, {"tracking": _FIRM}
        if self.hard_turns:
            firm |= dict.fromkeys(("tangent", "roll"), _FIRM * self.arm.unit**2)
        least = {key: max(value, getattr(weights, key)) for key, value in firm.items()}
        weights = weights.model_copy(update=least)
        reach = _REACH * self.arm.unit
        return replace(self, hard_tracking=False, hard_turns=False, weights=weights, reach=reach)

    @cached_property
    def node_column(self) -> Index:
        """(N,) first column of each free node's displacement; -1 for base nodes."""
        column = np.full(len(self.arm.node_names), -1, dtype=np.int64)
        column[self.arm.free] = 3 * np.arange(len(self.arm.free))
        return column

    @cached_property
    def tip_columns(self) -> tuple[Index, Mask]:
        """(T,) columns of the displacements of the tip's free nodes, and (3 K,) mask of these in the tip's Jacobian."""
        first = self.node_column[self.arm.end_effector.nodes]
        present = np.repeat(first >= 0, 3)
        return (first[:, None] + np.arange(3)).reshape(-1)[present], present

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
        """The curve's shape if its rows are computed for each QP; None if constant tables describe them."""
        return None if self.shape is None or self.shape.is_plain else self.shape

    @property
    def family(self) -> CurveFamily | None:
        """The curve's family, where its shape is known."""
        return None if self.shape is None else self.shape.family

    @property
    def is_tabled(self) -> bool:
        """Whether constant tables give all rows and objectives of the curve."""
        return self.general is None and not self.hard_turns and not self.vertex_goals

    @property
    def torsion(self) -> int:
        """Number of torsion coordinates T."""
        return 0 if self.general is None else self.general.torsion

    @property
    def turns(self) -> int:
        """Number R of turns that each station tracks."""
        return 2 if self.general is None else self.general.turns

    @cached_property
    def ends_at_tip(self) -> bool:
        """Whether the curve ends in the end effector: if that is the last station, and there are enough vertices."""
        tip, last = self.arm.end_effector.nodes, self.arm.stations.nodes[-1:]
        return self.vertices >= _ENDS_AT_TIP and np.array_equal(np.sort(last), np.sort([tip]))

    @cached_property
    def ends_along_tip(self) -> bool:
        """Whether the curve ends along the tip's z-axis: if that is tracked and there is another control vertex."""
        turned = len(tip_axes(self.tip_rows)) < len(self.tip_rows)
        return turned and self.ends_at_tip and self.vertices > _ENDS_AT_TIP

    @cached_property
    def hard_gaps(self) -> Mask:
        """(K, 3) mask of gaps that are equalities: all with hard tracking, and always the gap of the curve's end.

        The curve ends in the end effector, eq. (34), as it begins at the base.
        """
        hard = np.full((len(self.tracked), 3), self.hard_tracking)
        hard[-1:] |= self.ends_at_tip
        return hard

    @cached_property
    def hard_tilts(self) -> Mask:
        """(K, R) mask of turns that are equalities, those of the curve's end among them."""
        hard = np.full((len(self.tracked), self.turns), self.hard_turns)
        hard[-1:, :2] |= self.ends_along_tip
        return hard

    @cached_property
    def hard(self) -> Index:
        """Sorted indices of the equalities among all gaps, then turns."""
        return np.flatnonzero(np.concatenate([self.hard_gaps.reshape(-1), self.hard_tilts.reshape(-1)]))

    @property
    def spacings(self) -> int:
        """Number S of spacings between curve nodes that are rows."""
        return 0 if self.general is None else self.general.spacings

    @property
    def least_squares(self) -> int:
        """Number of least-squares rows of the objective: nodes, gaps and turns of the stations, spacings."""
        return self.node_columns + (3 + self.turns) * len(self.tracked) + self.spacings

    @property
    def free_curve(self) -> int:
        """Number of free coordinates of a curve fixed at its base: 3 V - 5 + T."""
        return 3 * self.vertices - 5 + self.torsion if self.vertices else 0

    @cached_property
    def centring_weights(self) -> Array:
        """(n_a,) weights of the actuators' values less those at home, squared; m^2/rad^2 for angles."""
        return np.asarray(self.weights.stroke_centring * self.arm.levers**2)

    @cached_property
    def actuator_weights(self) -> Array:
        """(n_a,) weights of the squares of all changes of the actuators: by their rate, and by centring."""
        return np.asarray(self.weights.actuators * self.arm.levers**2)

    @property
    def torsion_weight(self) -> float:
        """Weight of squared changes of the torsion, m^2/rad^2."""
        return self.weights.curve_rate * self.arm.unit**2

    @cached_property
    def tip_levers(self) -> Array:
        """(n_e,) lengths, m, to compare tip coordinates by: 1 for positions, the arm's unit for angles."""
        return np.array(levers(self.tip_rows, self.arm.unit))

    @property
    def slack_levers(self) -> Array:
        """Such lengths for the slacks of an elastic tip, above its goal and then below; otherwise empty."""
        return np.tile(self.tip_levers, 2 if self.elastic_tip else 0)

    @property
    def slack_pull(self) -> Array:
        """Gradient of the slacks' penalty."""
        return np.asarray(self.weights.end_effector * self.arm.unit * self.slack_levers)

    @property
    def slack_weights(self) -> Array:
        """Curvature of the slacks' penalty, which is linear by itself, for solvers of strictly convex QPs.

        A dual method starts at the unconstrained minimum, where a slack is the ratio of penalty to curvature. The
        slack's rounding limits the accuracy of the rows; so the curvature is scaled by the penalty.
        """
        curvature = _SLACK_CURVATURE * max(self.weights.end_effector, _LEAST_PENALTY)
        return np.asarray(curvature * self.slack_levers**2)

    @cached_property
    def levers(self) -> Array:
        """(n_e + H,) such lengths for all equalities of a step: those of the tip, then of stations."""
        gaps, tilts = np.ones(self.hard_gaps.size), np.full(self.hard_tilts.size, self.arm.unit)
        return np.concatenate([self.tip_levers, np.concatenate([gaps, tilts])[self.hard]])

    @cached_property
    def gap_weights(self) -> Array:
        """(K, 3) weights of the stations' gaps; zero where they are equalities."""
        return np.where(self.hard_gaps, 0.0, self.weights.tracking)

    @cached_property
    def tilt_weights(self) -> Array:
        """(K, R) weights of the stations' turns; zero where they are equalities."""
        weights = [self.weights.tangent, self.weights.tangent, self.weights.roll][: self.turns]
        return np.where(self.hard_tilts, 0.0, weights)

    @cached_property
    def end_gain(self) -> Array:
        """(V, 1 or 2) least changes of the control vertices that move the curve's end, and that turn it."""
        rows = [self.curve_weights[-1], self.curve_slopes[-1]][: 1 + self.ends_along_tip]
        gain = np.zeros((self.vertices, len(rows)))
        gain[2:] = np.linalg.pinv(np.array(rows)[:, 2:])
        return gain

    @cached_property
    def legs(self) -> Index:
        """(G, 2) control vertices of the legs with given directions: the first, and the last if along the tip."""
        last = self.vertices - 1
        legs = [(0, 1), (last - 1, last)][: int(last > 0) + self.ends_along_tip]
        return np.array(legs, dtype=np.int64).reshape(-1, 2)

    @property
    def least_leg(self) -> float:
        """Least length of a leg with a given direction, m; see ``_LEAST_LEG``."""
        return _LEAST_LEG * self.arm.height / max(self.vertices - 1, 1)

    @cached_property
    def vertex_hessian(self) -> Array:
        """(V, V) Hessian, per axis, of the objectives in the control vertices alone."""
        drawn = np.isin(np.arange(self.vertices), self.vertex_goals) * self.weights.vertex_goal
        rate = self.weights.curve_rate * np.eye(self.vertices)
        return np.asarray(rate + self.weights.smoothness * polygon_bending(self.vertices) + np.diag(drawn))

    @cached_property
    def curve_hessian(self) -> Array:
        """(D, D) Hessian of the same over all coordinates of the curve: control vertices, then torsion."""
        vertices = np.kron(self.vertex_hessian, np.eye(3))
        return np.asarray(block_diag(vertices, self.torsion_weight * np.eye(self.torsion)))

    def goal_pull(self, vertices: Array, goals: Array | None) -> Array:
        """Return (V, 3) the gradient of the control vertices' goals (V, 3), m; NaN where a vertex has none.

        A step draws a vertex by no more than a share of the arm's length: a distant goal must not outweigh the
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
        """Return (V, 3) the gradient of the curve's objectives at control vertices and goals (V, 3), m."""
        return self.weights.smoothness * (polygon_bending(self.vertices) @ vertices) + self.goal_pull(
            vertices, goals
        )


def curve_record(layout: Layout) -> dict[str, Any] | None:
    """Return the curve of a layout and its stations as JSON data for verification; None without a curve.

    Keys: ``breaks``, ``extraction``, ``nodes`` and ``by_arc_length`` of the curve, see ``CurveFamily`` and
    ``CurveShape``; ``stations`` and ``weights``, the nodes whose mean each station is; ``held``, whether they are
    kept on the curve, and ``frames``, those of the stations at home whose normals are kept along it, or none;
    ``start``, ``start_weights``, ``normal``, the same of the base and its normal at home; ``ends_at_tip``,
    ``ends_along_tip``.
    """
    if layout.shape is None:
        return None
    stations, family = layout.arm.stations, layout.shape.family
    used = np.flatnonzero(stations.weights[layout.tracked].any(axis=0))
    return {
        "breaks": family.breaks.tolist(),
        "extraction": family.extraction.tolist(),
        "nodes": layout.shape.nodes.tolist(),
        "by_arc_length": layout.shape.by_arc_length,
        "stations": stations.nodes[layout.tracked][:, used].tolist(),
        "weights": stations.weights[layout.tracked][:, used].tolist(),
        "held": layout.hard_tracking,
        "frames": stations.frames[layout.tracked].tolist() if layout.hard_turns else [],
        "start": stations.nodes[0, used].tolist(),
        "start_weights": stations.weights[0, used].tolist(),
        "normal": stations.frames[0][:, 2].tolist(),
        "ends_at_tip": layout.ends_at_tip,
        "ends_along_tip": layout.ends_along_tip,
    }
