"""The tracked coordinates of the end effector as numbers, and the paths to goals for them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from vgtm_qp.arm.arm import Arm, Kinematics, MotionRows
from vgtm_qp.arrays import Array, Index
from vgtm_qp.compiled import Kernel
from vgtm_qp.errors import GoalError
from vgtm_qp.qp.numbers import norm
from vgtm_qp.rotation import rotation_from_vector, turn_between, vector_from_rotation
from vgtm_qp.rows.tip import TipGoal, axes, levers, row_names, tip_function
from vgtm_qp.step.path import Path

_UNCHANGED = "the state of the arm is unchanged"

_SHORTEST, _LONGEST = 1e-8, 1e8
"""Least and greatest duration of a step, s: rates over a shorter one would be rounding errors."""


class TipRows(NamedTuple):
    """Jacobian (n_e, 3 K_tip) w.r.t. the tip's nodes, rate (n_e,) along the path, and error (n_e,) goal minus value."""

    jacobian: Array
    rate: Array
    error: Array


class TipTask:
    """One to six coordinates of the end effector.

    Raises
    ------
    GoalError
        A name is unknown, coordinates are given twice, or the tip has too few nodes to have a direction.
    """

    def __init__(self, track: Sequence[str], arm: Arm) -> None:
        self.track = tuple(track)
        self.row_names = row_names(track)
        self.turns = "pointing" if "pointing" in track else "orientation" if "orientation" in track else None
        self._tip = tip = arm.end_effector
        if self.turns and not tip.has_frame:
            raise GoalError(
                f'"{self.turns}" needs a tip of three or more nodes; this one has {len(tip.nodes)}'
            )
        self.axes = np.array(axes(self.row_names), dtype=np.int64)
        self._rows = Kernel(tip_function(self.row_names, arm.unit), compiled=False)
        self._levers = np.array(levers(self.row_names, arm.unit))
        self._position_jacobian = np.kron(tip.weights, np.eye(3))[self.axes]

    def residual(
        self, position: Array, rotation: Array, goal: TipGoal, *, motion: bool = False
    ) -> tuple[Array, Array, Array, float]:
        """Return error (n_e,) goal minus value, rate (n_e,) along the path, turned axes (r, 3) and weight of progress.

        The axes times the tip's angular velocity are the rates of the tracked turns. With `motion`, errors within an
        accepted state's tolerance are zero.
        """
        inputs = self._rows.inputs
        inputs[0][:], inputs[1][:] = position, rotation.T.reshape(-1)
        inputs[2][:], inputs[3][:] = goal.position, goal.rotation.T.reshape(-1)
        inputs[4][:], inputs[5][:] = goal.velocity, goal.spin
        inputs[6][0] = 1.0 if motion else 0.0
        self._rows()
        error, rate, across, weight = self._rows.outputs
        return error.copy(), rate.copy(), across.reshape(3, -1).T.copy(), float(weight[0])

    def off(self, position: Array, rotation: Array, goal: TipGoal) -> float:
        """Return the norm of the error, m: angles times the arm's unit."""
        return norm(self._levers * self.error(position, rotation, goal))

    def error(self, position: Array, rotation: Array, goal: TipGoal) -> Array:
        """Return the error (n_e,) alone, m or rad, which every step of settling needs."""
        return self.residual(position, rotation, goal)[0]

    def rows(self, X: Array, kinematics: Kinematics, goal: TipGoal) -> TipRows:
        """Return the rows at nodes `X` (N, 3), at which the kinematics was evaluated, towards `goal`."""
        error, rate, across, _ = self.residual(self._tip.position(X), kinematics.tip_rotation, goal)
        return TipRows(self.jacobian(across, kinematics.tip_spin), rate, error)

    def jacobian(self, across: Array, spin: Array | None) -> Array:
        """Return (n_e, 3 K_tip) the rows' Jacobian, from turned axes `across` and `spin` (3, 3 K_tip)."""
        if spin is None or not len(across):
            return np.asarray(self._position_jacobian)
        return np.concatenate([self._position_jacobian, across @ spin])

    def path_to(
        self,
        tip: tuple[Array, Array],
        position: ArrayLike | None,
        pointing: ArrayLike | None,
        rotation_vector: ArrayLike | None,
    ) -> Path:
        """Return the straight path from the tip's pose, (3,) and (3, 3), to a goal.

        Raises
        ------
        GoalError
            The goal is not three finite numbers, has coordinates without a row in the QP, or has a coordinate
            twice.
        """
        steered = {
            "position": (position, bool(len(self.axes))),
            "pointing": (pointing, bool(self.turns)),
            "rotation_vector": (rotation_vector, bool(self.turns)),
        }
        for name, (value, is_tracked) in steered.items():
            if value is not None and not is_tracked:
                raise GoalError(f"{name} is not tracked, only {', '.join(self.track)}; {_UNCHANGED}")
        if pointing is not None and rotation_vector is not None:
            raise GoalError(f"give pointing or rotation_vector, not both; {_UNCHANGED}")
        here, rotation = tip
        there = here if position is None else vector(position, "position")
        turned, spin = rotation, None
        if pointing is not None:
            wanted = vector(pointing, "pointing")
            norm = float(np.linalg.norm(wanted))
            if norm < 1e-9:
                raise GoalError(f"pointing must not be the zero vector; {_UNCHANGED}")
            spin = turn_between(rotation[:, 2], wanted / norm)
            turned = rotation_from_vector(spin) @ rotation
        elif rotation_vector is not None:
            turned = rotation_from_vector(vector(rotation_vector, "rotation_vector"))
            spin = vector_from_rotation(turned @ rotation.T)
        return Path.straight(here, rotation, there, turned, spin)


def over_actuators(arm: Arm, motion: MotionRows, nodes: Index, coefficients: Array) -> Array:
    """Return rows over displacements of `nodes` (R, S), by `coefficients` (R, S, 3), as rows (R, n_a) over actuators.

    Nodes of the base do not move. SolverError in a singular pose.
    """
    rows = np.zeros((len(nodes), len(arm.node_names), 3))
    np.add.at(rows, (np.arange(len(nodes))[:, None], nodes), coefficients)
    return motion.over_actuators(rows[:, arm.free].reshape(len(nodes), 3 * len(arm.free)))


def tip_over_actuators(arm: Arm, motion: MotionRows, jacobian: Array) -> Array:
    """Return (n_e, n_a) the changes of the tip's coordinates, by `jacobian` (n_e, 3 K_tip), with the actuators."""
    nodes = np.broadcast_to(arm.end_effector.nodes, (len(jacobian), len(arm.end_effector.nodes)))
    return over_actuators(arm, motion, nodes, jacobian.reshape(*nodes.shape, 3))


def duration(dt: float) -> float:
    """Return a step's duration, s; raise GoalError where it is not a positive number."""
    try:
        seconds = float(dt)
    except (TypeError, ValueError):
        seconds = math.nan
    if not _SHORTEST <= seconds <= _LONGEST:
        raise GoalError(
            f"dt must be a positive number of seconds, from {_SHORTEST:g} to {_LONGEST:g}, not {dt!r}; {_UNCHANGED}"
        )
    return seconds


def vector(value: ArrayLike, name: str) -> Array:
    """Return three finite numbers; raise GoalError where they are not."""
    try:
        numbers = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.shape != (3,) or not all(map(math.isfinite, numbers.tolist())):
        raise GoalError(f"{name} must be three finite numbers, not {value!r}; {_UNCHANGED}")
    return numbers
