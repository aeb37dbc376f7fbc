"""The named null-space terms of the truss as one quadratic objective: the same terms and weights as the QP's."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.errors import nearest
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.problem.method import TRUSS_TERMS, Weights
from vgtm_qp.step.arm import Arm

Array = NDArray[np.float64]

DEFAULT_TERMS = ("actuator_rate",)
"""With node displacements alone as the objective, long arms collapse their battens."""

_TRACE = 1e-6
_NEAREST = 0.05
"""Below this part of the influence distance the potential keeps its slope, so that a step stays finite."""


class Terms(NamedTuple):
    """1/2 node |d|^2 + 1/2 actuator |a|^2 + actuator_gradient . a + node_gradient . d, a = J_a d."""

    node: float
    actuator: float
    actuator_gradient: Array
    node_gradient: Array


class TrussObjective:
    """Named terms of the null-space vector of eq. (28).

    Raises
    ------
    ValueError
        A term is unknown.
    """

    def __init__(self, names: tuple[str, ...], weights: Weights, arm: Arm) -> None:
        for name in names:
            if name not in TRUSS_TERMS:
                raise ValueError(
                    f'no null-space term "{name}"{nearest(name, TRUSS_TERMS)}; choices: {", ".join(TRUSS_TERMS)}'
                )
        self.names = names
        self._arm = arm
        self._centring = weights.stroke_centring if "stroke_centring" in names else 0.0
        self._potential = weights.obstacle_potential if "obstacle_potential" in names else 0.0
        actuator = self._centring + (weights.actuator_rate if "actuator_rate" in names else 0.0)
        node = weights.node_rate if "node_rate" in names else 0.0
        # Without any term of the displacements themselves, theirs is the norm that J^+ minimises; beside others a
        # trace of it makes the Hessian regular off the null space too, as the weighted inverse needs.
        self.node = node or (_TRACE * actuator if actuator else 1.0)
        self.actuator = actuator

    def at(self, X: Array, lengths: Array, time: float) -> Terms:
        """Return the terms at node positions `X` (N, 3) with member `lengths` (M,)."""
        arm = self._arm
        actuators = arm.truss.actuators
        centring = self._centring * (lengths[actuators] - arm.home_lengths[actuators])
        gradient = np.zeros(arm.layout.node_columns)
        if self._potential:
            field = potential_gradient(arm.monitor, X, time, arm.influence)
            gradient = self._potential * field[arm.truss.free].reshape(-1)
        return Terms(self.node, self.actuator, centring, gradient)


def potential_slope(distance: Array, influence: float) -> Array:
    """Return d/d distance of 1/2 (influence / distance - 1)^2 (Khatib, IJRR 5, 1986), 1/m; 0 beyond `influence`."""
    d = np.maximum(distance, _NEAREST * influence)
    return np.asarray(np.where(distance < influence, -(influence / d - 1.0) * influence / d**2, 0.0))


def potential_gradient(monitor: Clearance, X: Array, time: float, influence: float) -> Array:
    """Return (N, 3) the gradient of the potential of all near pairs with respect to the node positions, 1/m."""
    pairs = monitor.near(X, time, influence)
    gradient = np.zeros_like(X)
    force = potential_slope(pairs.distance, influence)[:, None] * pairs.normal
    ends = monitor.members[pairs.member]
    np.add.at(gradient, ends[:, 0], (1.0 - pairs.t)[:, None] * force)
    np.add.at(gradient, ends[:, 1], pairs.t[:, None] * force)
    own = np.flatnonzero(pairs.is_self)
    others = monitor.members[pairs.other[own]]
    np.add.at(gradient, others[:, 0], -(1.0 - pairs.t_other[own])[:, None] * force[own])
    np.add.at(gradient, others[:, 1], -pairs.t_other[own][:, None] * force[own])
    return gradient
