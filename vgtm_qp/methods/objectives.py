"""The named null-space terms of an arm as one quadratic objective: the same terms and weights as the QP's."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.problem.method import Weights
from vgtm_qp.step.setup import Setup

DEFAULT_TERMS = ("actuator_rate",)
"""Terms of a problem that names none."""

_TRACE = 1e-6
"""Weight of the nodes' displacements over that of the actuators', if no term weighs them: else battens of long arms
collapse.
"""
_NEAREST = 0.05
"""Share of the influence distance below which the potential's slope is constant, so that a step stays finite."""


class Terms(NamedTuple):
    """1/2 node |d|^2 + 1/2 actuator |a|^2 + actuator_gradient . a + node_gradient . d + 1/2 d' blocks d.

    The displacements d of the free nodes, m, and those of the actuators, a, rad or m, depend on each other; |a| counts
    angles times ``Arm.unit``. ``blocks`` (N - N_c, 3, 3) couple the coordinates of one node.
    """

    node: float
    actuator: float
    actuator_gradient: Array
    node_gradient: Array
    blocks: Array


class NamedTerms:
    """Named terms of the null-space vector, of ``problem.method.TRUSS_TERMS``."""

    def __init__(self, names: tuple[str, ...], weights: Weights, setup: Setup) -> None:
        self._setup = setup
        self._centring = weights.stroke_centring if "stroke_centring" in names else 0.0
        area = setup.arm.unit**2
        self._potential = area * weights.obstacle_potential if "obstacle_potential" in names else 0.0
        actuator = self._centring + (weights.actuator_rate if "actuator_rate" in names else 0.0)
        node = weights.node_rate if "node_rate" in names else 0.0
        # Without terms of displacements the objective is their norm, which J^+ minimises. Beside other terms a small
        # weight of the norm makes the Hessian regular off the null space too, as the weighted inverse needs.
        self._node = node or (_TRACE * actuator if actuator else 1.0)
        self._actuator = actuator

    def at(self, q: Array, quantities: Array, time: float) -> Terms:
        """Return the terms at a configuration with its quantities (M,)."""
        setup, arm = self._setup, self._setup.arm
        actuators, free = arm.actuators, arm.free
        centring = self._centring * arm.levers**2 * (quantities[actuators] - arm.home_quantities[actuators])
        terms = self.without_gradients()._replace(actuator_gradient=centring)
        if not self._potential:
            return terms
        field, blocks = potential_field(setup, q, time)
        gradient = self._potential * field[free].reshape(-1)
        return terms._replace(node_gradient=gradient, blocks=self._potential * blocks[free])

    def without_gradients(self) -> Terms:
        """Return the terms that are squares of displacements alone."""
        arm = self._setup.arm
        return Terms(
            self._node,
            self._actuator,
            np.zeros(len(arm.actuators)),
            np.zeros(3 * len(arm.free)),
            np.zeros((len(arm.free), 3, 3)),
        )


def potential_slope(distance: Array, influence: float) -> Array:
    """Return d/d distance of 1/2 (influence / distance - 1)^2 (Khatib, IJRR 5, 1986), 1/m; 0 beyond `influence`."""
    d = np.maximum(distance, _NEAREST * influence)
    return np.asarray(np.where(distance < influence, -(influence / d - 1.0) * influence / d**2, 0.0))


def potential_curvature(distance: Array, influence: float) -> Array:
    """Return the second derivative of the same potential, 1/m^2; 0 beyond `influence`."""
    d = np.maximum(distance, _NEAREST * influence)
    ratio = influence / d
    return np.asarray(np.where(distance < influence, (3.0 * ratio - 2.0) * ratio / d**2, 0.0))


def potential_field(setup: Setup, q: Array, time: float) -> tuple[Array, Array]:
    """Return the potential's gradient (N, 3), 1/m, by the nodes, and blocks (N, 3, 3), 1/m^2, above its Hessian.

    With the gradient alone, steps grow without bound as a distance shrinks. With the curvature along the
    normals, the step of each pair is a share of its own distance. One block per node bounds the Hessian: the
    square of a mean of two displacements is at most the mean of their squares, and the square of a difference
    at most twice their sum.
    """
    influence, count = setup.influence, len(setup.arm.node_names)
    pairs = setup.monitor.near(setup.carrier.points(q), time, influence)
    nodes, rows = setup.carrier.over_nodes(q, pairs.points, pairs.weights[:, :, None] * pairs.normal[:, None])
    gradient, blocks = np.zeros((count, 3)), np.zeros((count, 3, 3))
    np.add.at(gradient, nodes, potential_slope(pairs.distance, influence)[:, None, None] * rows)
    curvature = potential_curvature(pairs.distance, influence) * np.where(pairs.is_self, 2.0, 1.0)
    size = np.maximum(np.linalg.norm(rows, axis=2), np.finfo(float).tiny)
    outer = rows[:, :, :, None] * (rows / size[:, :, None])[:, :, None]
    np.add.at(blocks, nodes, curvature[:, None, None, None] * outer)
    return gradient, blocks
