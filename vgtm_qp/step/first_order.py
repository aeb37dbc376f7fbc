"""An arm's motions from a state to first order: a linear program in actuator displacements and progress.

To first order the arm can cover the share alpha of a piece of path that is the greatest one with

    J d_rho = E d_a,   tip rows d_rho = alpha rate,   clearance and angle rows,   limits <= d_a <= limits.

Rows with multipliers hold the arm back.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array
from vgtm_qp.rows.limits import ACCELERATION, RATE, STROKE
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.actuation import Limits
from vgtm_qp.step.separation import Separation
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State
from vgtm_qp.step.task import over_actuators, tip_over_actuators

_TRUST = 0.05
"""Trust region: greatest change of an actuator in the linear program, rad or a share of the arm's unit."""
_PRESSES = 1e-7
"""Multiplier from which on a row counts as active."""
_FURTHER = 4.0
"""Least trust region for a tip that must not be late, over the length of its piece of path."""

FREE = 1.0 - 1e-6
"""Progress alpha, at most 1, from which on an arm counts as free."""

CLEARANCE, MEMBERS, ANGLE, STEP = "clearance", "members", "angle", "step limit"


class Limit(NamedTuple):
    """A limit that a person can change; one or more rows belong to it.

    Attributes
    ----------
    kind : str
        ``"clearance"`` from an obstacle, between ``"members"``, ``"angle"``, ``"stroke"``, ``"rate"``,
        ``"acceleration"`` or ``"step limit"``.
    name : str
        The obstacle, or the actuator of a stroke; empty for a stroke of all actuators, and for the other
        kinds, which have one limit for all.
    upper : bool
        True for the upper end of a stroke.
    """

    kind: str
    name: str = ""
    upper: bool = True

    @property
    def for_all(self) -> Limit:
        """The same limit of all actuators."""
        return self if self.kind == CLEARANCE else self._replace(name="")


class FirstOrder:
    """The linear program in (d_a, alpha), and its rows by number: clearances, lower limits, upper limits.

    Its numbers are those of an arm of unit size: lengths are divided by the arm's unit, angles are not.

    Attributes
    ----------
    unit, progress : float
        Share of the piece of path at alpha = 1, roughly the greatest share within the trust region; and the
        same share for a `reach` of 1, the factor of trust region and piece of path.
    names, limits : tuple of str, tuple of (Limit or None)
        Of each row; None for a row that nobody can change, of a locked actuator.

    Raises
    ------
    SolverError
        The pose is singular: the quantities do not determine how the nodes move.
    """

    def __init__(
        self,
        setup: Setup,
        separation: Separation,
        state: State,
        goal: TipGoal,
        limits: Limits,
        reach: float = 1.0,
    ) -> None:
        arm, kinematics = setup.arm, setup.kinematics
        kinematics.evaluate(state.q)
        motion = kinematics.motion()
        tip = setup.task.rows(state.nodes, kinematics, goal)
        # Units of length, and of each actuator's changes, m or rad.
        self._size, self._sizes = arm.unit, arm.unit / arm.levers
        length = float(np.linalg.norm(tip.rate)) / self._size
        self._trust, self.unit = reach * _TRUST, reach * (min(1.0, _TRUST / length) if length > 0.0 else 1.0)
        if setup.tip_mode == "hard":
            # The tip must not be late: less than the whole piece does not count.
            self._trust, self.unit = reach * max(_TRUST, _FURTHER * length), reach
        self.progress = min(self.unit / reach, 1.0)
        response = tip_over_actuators(arm, motion, tip.jacobian) * self._sizes
        self._equal = np.column_stack([response, -tip.rate * self.unit]) / self._size
        self._rows = separation.rows(state.q, state.time, 0.0, 2.0 * self._trust * self._size, {}, 0.0)
        near = over_actuators(arm, motion, self._rows.nodes, self._rows.coefficients)
        self._near = np.column_stack([-near * self._sizes, np.zeros(len(near))]) / self._size
        self._near_bound = np.maximum(setup.margin - self._rows.lower, 0.0) / self._size
        now = state.quantities[arm.actuators]
        self._low = np.minimum(limits.lower - now, 0.0) / self._sizes
        self._high = np.maximum(limits.upper - now, 0.0) / self._sizes
        self.count = len(self._rows) + 2 * len(now)
        self.names = (
            *(self._rows.name(k) for k in range(len(self._rows))),
            *(limits.name(k, upper=upper) for upper in (False, True) for k in range(len(now))),
        )
        self.limits = tuple(
            limit_of(setup, name, k >= self.count - len(now)) for k, name in enumerate(self.names)
        )

    def solve(self, kept: NDArray[np.bool_]) -> tuple[float, Array]:
        """Return the greatest share alpha with the `kept` rows, and the multiplier of every row, 1/m or 1/rad."""
        near, actuators = len(self._rows), len(self._low)
        low = np.where(kept[near : near + actuators], np.maximum(self._low, -self._trust), -self._trust)
        high = np.where(kept[near + actuators :], np.minimum(self._high, self._trust), self._trust)
        rows = np.flatnonzero(kept[:near])
        cost = np.zeros(actuators + 1)
        cost[-1] = -1.0
        answer = _linear_program(
            cost, self._near[rows], self._near_bound[rows], self._equal, low=(*low, 0.0), high=(*high, 1.0)
        )
        multipliers = np.zeros(self.count)
        if answer.status != 0:
            return 0.0, multipliers
        multipliers[rows] = -answer.ineqlin.marginals
        multipliers[near : near + actuators] = np.where(low > -self._trust, answer.lower.marginals[:-1], 0.0)
        multipliers[near + actuators :] = np.where(high < self._trust, -answer.upper.marginals[:-1], 0.0)
        sizes = np.repeat([self._size, *self._sizes, *self._sizes], [near, *[1] * (2 * actuators)])
        return float(answer.x[-1]), np.where(multipliers > _PRESSES, multipliers, 0.0) * self.unit / sizes

    def without(self, limits: Iterable[Limit]) -> tuple[float, Array]:
        """Return share and multipliers as :meth:`solve` does, without the rows of some limits."""
        kept = np.ones(self.count, dtype=bool)
        for limit in limits:
            kept[self._rows_of(limit)] = False
        return self.solve(kept)

    def _rows_of(self, limit: Limit) -> list[int]:
        """Return the rows of a limit by number."""
        return [k for k, other in enumerate(self.limits) if other and limit in (other, other.for_all)]

    def least_changes(self, limits: Sequence[Limit], most: Sequence[float]) -> Array | None:
        """Return the changes of some limits, m or rad, with the least sum for which alpha = `FREE`.

        None if changes up to `most` do not suffice.
        """
        near, actuators, changed = len(self._rows), len(self._low), len(limits)
        low, high = np.maximum(self._low, -self._trust), np.minimum(self._high, self._trust)
        slack, sizes = np.zeros((near, changed)), np.full(changed, self._size)
        rows, bounds = [], []
        for g, limit in enumerate(limits):
            of_limit = self._rows_of(limit)
            if of_limit[0] >= near:
                # If only some of the actuators turn, each gets at least the change that it needs.
                sizes[g] = max(self._sizes[(k - near) % actuators] for k in of_limit)
            for k in of_limit:
                if k < near:
                    slack[k, g] = -1.0
                    continue
                j, upper = (k - near) % actuators, k >= near + actuators
                row = np.zeros(actuators + changed)
                row[j], row[actuators + g] = (1.0 if upper else -1.0), -1.0
                rows.append(row)
                bounds.append(self._high[j] if upper else -self._low[j])
                (high if upper else low)[j] = self._trust if upper else -self._trust
        answer = _linear_program(
            np.repeat([0.0, 1.0], [actuators, changed]),
            np.vstack([np.hstack([self._near[:, :-1], slack]), *rows]),
            np.concatenate([self._near_bound, bounds]),
            np.hstack([self._equal[:, :-1], np.zeros((len(self._equal), changed))]),
            -FREE * self._equal[:, -1],
            low=(*low, *np.zeros(changed)),
            high=(*high, *(most / sizes)),
        )
        return np.asarray(answer.x[actuators:]) * sizes if answer.status == 0 else None

    def normal(self, k: int) -> Array:
        """Return (3,) the direction in which a translation of the arm leaves the obstacle of row `k`."""
        return np.asarray(self._rows.coefficients[k].sum(axis=0))


def _linear_program(
    cost: Array,
    inequality: Array,
    bound: Array,
    equality: Array,
    value: Array | None = None,
    *,
    low: Sequence[float],
    high: Sequence[float],
) -> Any:
    """Return SciPy's answer of min cost.x with inequality x <= bound, equality x = value, low <= x <= high."""
    # Its import takes a tenth of the time of a start.
    from scipy.optimize import linprog

    return linprog(
        cost,
        A_ub=inequality,
        b_ub=bound,
        A_eq=equality,
        b_eq=np.zeros(len(equality)) if value is None else value,
        bounds=[*zip(low, high, strict=True)],
        method="highs",
    )


def obstacle_of(setup: Setup, name: str) -> str:
    """Return the obstacle of the row of that name, as ``PairNames.clearance`` makes it; empty if there is none.

    What stands before the obstacle has to be a body of the arm, as the name of one obstacle may end with another's.
    """
    bodies = setup.monitor.bodies.names
    for obstacle in setup.monitor.obstacles:
        row, end = name.removeprefix(f"{CLEARANCE}: "), f" / {obstacle.name}"
        if row.endswith(end) and row.removesuffix(end).partition(" ")[2] in bodies:
            return obstacle.name
    return ""


def limit_of(setup: Setup, row: str, upper: bool) -> Limit | None:
    """Return the limit to which the row of that name belongs; None if nobody can change it."""
    kind, _, name = row.partition(": ")
    if kind == CLEARANCE:
        obstacle = obstacle_of(setup, row)
        return Limit(CLEARANCE, obstacle) if obstacle else Limit(MEMBERS)
    if kind == ANGLE:
        return Limit(ANGLE)
    if kind in (RATE, ACCELERATION):
        return Limit(kind)
    return Limit(STROKE, name, upper) if kind == STROKE else None
