"""What would let a stopped arm go on: the fewest changes of limits, and their least amounts."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.rows.limits import ACCELERATION, RATE, STROKE
from vgtm_qp.step.first_order import ANGLE, CLEARANCE, FREE, MEMBERS, STEP, FirstOrder, Limit, limit_of
from vgtm_qp.step.setup import Setup

MOST = 3
"""Greatest number of remedies, and of changes in one."""
_TRIED = 8
"""Number of the most decisive limits that are tried as the next change."""
_BEST = 4
"""Number of sets of changes, those that take the arm furthest, that are tried with one change more."""
_MARGIN = 1.5
"""Amount of a change over the one needed to first order, to allow for the curvature of the motion."""
_SHARE = 0.5
"""First amount of a change that is tried without a linear program, over the limit."""
_STRETCH = 0.05
"""The same for a stroke, over the arm's unit."""


class Change(NamedTuple):
    """A change of one limit.

    Attributes
    ----------
    limit : Limit
    amount : float
        m, rad, m/s or rad/s, rounded up to two digits; infinite if the obstacle has to go.
    unit : str
    most : float
        Greatest possible amount: clearances and angles can go down to zero.
    """

    limit: Limit
    amount: float
    unit: str
    most: float = math.inf

    def __str__(self) -> str:
        (kind, _, upper), name = self.limit, self.limit.name or "all actuators"
        if math.isinf(self.amount):
            return f"{name}: out of the way"
        if "rad" in self.unit:
            size = f"{math.degrees(self.amount):.3g} {self.unit.replace('rad', 'degrees')}"
        else:
            size = (
                f"{1000.0 * self.amount:.3g} m{self.unit}"
                if self.amount < 1.0
                else f"{self.amount:.3g} {self.unit}"
            )
        if kind == CLEARANCE:
            return f"{name}: {size} less clearance"
        if kind == MEMBERS:
            return f"bodies of the arm: {size} less clearance"
        if kind == ANGLE:
            return f"bodies that meet: {size} less angle"
        if kind == STEP:
            return f"method.step_limit: {size} more"
        where = f" at its {'upper' if upper else 'lower'} end" if kind == STROKE else ""
        return f"{name}: {size} more {kind}{where}"

    def times(self, factor: float) -> Change:
        """Return the change with its amount times a factor, rounded up, but at most `most`."""
        if math.isinf(self.amount):
            return self
        return self._replace(amount=min(_rounded_up(factor * self.amount), self.most))

    def to_dict(self) -> dict[str, Any]:
        """Return plain data; an obstacle that has to go has the amount None."""
        amount = None if math.isinf(self.amount) else self.amount
        return {**self.limit._asdict(), "amount": amount, "unit": self.unit, "text": str(self)}


class Remedy(NamedTuple):
    """Changes that together let the arm go on.

    Attributes
    ----------
    changes : tuple of Change
        One to three.
    progress : float
        Share of the piece of path that the arm then covers to first order.
    """

    changes: tuple[Change, ...]
    progress: float

    def __str__(self) -> str:
        return " and ".join(str(change) for change in self.changes)

    def times(self, factor: float) -> Remedy:
        """Return the remedy with all amounts times a factor."""
        return self._replace(changes=tuple(change.times(factor) for change in self.changes))


def remedies(setup: Setup, program: FirstOrder) -> tuple[Remedy, ...]:
    """Return up to `MOST` alternatives, the smallest changes first; empty if no few changes free the arm.

    The amount of a change is half as large again as needed, to first order, for the progress in the trust
    region.
    """
    sets = list(_freeing(program)) or list(_freeing(program, for_all=True))
    found = [_remedy(setup, program, limits) for limits in sets]
    # An obstacle that has to go is the last resort.
    found.sort(key=lambda remedy: sum(change.amount for change in remedy.changes))
    return tuple(found[:MOST])


def _freeing(program: FirstOrder, *, for_all: bool = False) -> Iterator[tuple[Limit, ...]]:
    """Yield the smallest sets of up to `MOST` limits without which the arm is free to first order.

    Limits are those of single actuators, or, `for_all`, common to all of them.
    """

    def pressing(costs: Array) -> list[Limit]:
        order = np.argsort(-costs, kind="stable")[: np.count_nonzero(costs)]
        each = (limit for k in order if (limit := program.limits[k]) is not None)
        return list(dict.fromkeys(limit.for_all if for_all else limit for limit in each))[:_TRIED]

    share, costs = program.without(())
    best: list[tuple[float, tuple[Limit, ...], list[Limit]]] = [(share, (), pressing(costs))]
    for _ in range(MOST):
        sets = dict.fromkeys(
            tuple(sorted((*limits, more)))
            for _, limits, others in best
            for more in others
            if more not in limits
        )
        tried = []
        for limits in sets:
            share, costs = program.without(limits)
            tried.append((share, limits, pressing(costs)))
        tried.sort(key=lambda entry: -entry[0])
        free = [limits for share, limits, _ in tried if share >= FREE]
        if free:
            yield from free
            return
        best = tried[:_BEST]


def _remedy(setup: Setup, program: FirstOrder, limits: tuple[Limit, ...]) -> Remedy:
    """Return the least changes of limits without which the arm is free."""
    most = [_greatest(setup, limit) for limit in limits]
    amounts = program.least_changes(limits, most)
    if amounts is None:
        # Obstacles in the set have to go; the other limits then change as much as needed.
        amounts = program.least_changes(limits, [math.inf] * len(limits))
        assert amounts is not None, "without these limits the arm is free"
        is_obstacle = np.array([limit.kind == CLEARANCE for limit in limits])
        amounts = np.where(amounts > most, np.where(is_obstacle, math.inf, most), amounts)
    changes = []
    for limit, amount, greatest in zip(limits, amounts.tolist(), most, strict=True):
        size, unit = amount, "m"
        if limit.kind == ANGLE:
            unit = "rad"
        elif limit.kind not in (CLEARANCE, MEMBERS):
            unit = _unit(setup, limit)
            if limit.kind != STROKE:
                size = amount / setup.dt ** (2 if limit.kind == ACCELERATION else 1)
        size = _rounded_up(_MARGIN * size)
        changes.append(Change(limit, min(size, greatest) if amount <= greatest else size, unit, greatest))
    return Remedy(tuple(sorted(changes, key=lambda change: change.amount)), program.progress)


def _unit(setup: Setup, limit: Limit) -> str:
    """Return the unit of a limit of actuators."""
    unit = " or ".join(sorted({unit for _, unit in _actuators(setup, limit)}))
    return unit + {RATE: "/s", ACCELERATION: "/s^2"}.get(limit.kind, "")


def resorts(
    setup: Setup, quantities: Array, names: Iterable[str], found: Sequence[Remedy]
) -> Iterator[Remedy]:
    """Yield remedies to try where none of those `found` to first order lets the arm go on.

    In this order: all changes that were found, at once; of the rows called `names`, the most decisive first, the limit
    of the first one, of two and of three; these limits of all actuators; their obstacles out of the way, alone and
    together with the other limits. `quantities` are the arm's.
    """
    changes = {change.limit: change for remedy in found for change in remedy.changes}
    if 1 < len(changes) <= MOST:
        yield Remedy(tuple(changes.values()), 1.0)
    arm = setup.arm
    is_beyond = quantities - arm.stroke[:, 0] > arm.stroke[:, 1] - quantities
    middle = dict(zip(arm.quantity_names, is_beyond, strict=True))
    each = (limit_of(setup, name, bool(middle.get(name.partition(": ")[2], True))) for name in names)
    limits = list(dict.fromkeys(limit for limit in each if limit is not None))
    first = [_first_try(setup, limit) for limit in limits[:MOST]]
    yield from (Remedy(tuple(first[: k + 1]), 1.0) for k in range(len(first)))
    common = [_first_try(setup, limit) for limit in dict.fromkeys(limit.for_all for limit in limits)]
    if common:
        yield Remedy(tuple(common[:MOST]), 1.0)
    away = [Change(limit, math.inf, "m") for limit in limits if limit.kind == CLEARANCE][:MOST]
    if away:
        yield Remedy(tuple(away), 1.0)
        yield Remedy((*away, *(change for change in common if change.limit.kind != CLEARANCE))[:MOST], 1.0)


def _first_try(setup: Setup, limit: Limit) -> Change:
    """Return a change of a limit by a share of it."""
    most = _greatest(setup, limit)
    if math.isfinite(most):
        return Change(
            limit, min(_rounded_up(_SHARE * most), most), "rad" if limit.kind == ANGLE else "m", most
        )
    if limit.kind == STEP:
        return Change(limit, _rounded_up(_SHARE * setup.step_limit), "m")
    rows = [k for k, _ in _actuators(setup, limit)]
    values = {RATE: setup.arm.rate, ACCELERATION: setup.arm.acceleration}.get(limit.kind)
    amount = _STRETCH * setup.arm.unit if values is None else _SHARE * float(values[rows].max())
    return Change(limit, _rounded_up(amount), _unit(setup, limit))


def longer_steps(setup: Setup) -> Remedy:
    """Return the remedy of a stop because steps would be too long."""
    return Remedy((_first_try(setup, Limit(STEP)),), 1.0)


def _greatest(setup: Setup, limit: Limit) -> float:
    """Return the greatest amount of a limit's change, m or rad; clearances and angles can go down to zero."""
    kept = {CLEARANCE: setup.safe, MEMBERS: setup.self_safe, ANGLE: setup.minimum_angle}
    return kept.get(limit.kind, math.inf)


def _rounded_up(amount: float) -> float:
    """Return an amount rounded up to two digits."""
    if amount <= 0.0 or math.isinf(amount):
        return amount
    digit = 10.0 ** (math.floor(math.log10(amount)) - 1)
    return float(f"{math.ceil(amount / digit - 1e-9) * digit:.2g}")


def _actuators(setup: Setup, limit: Limit) -> list[tuple[int, str]]:
    """Return numbers among the arm's quantities, and units, of the actuators that have a limit."""
    arm = setup.arm
    each = zip(arm.actuators.tolist(), arm.actuator_units, strict=True)
    return [(k, unit) for k, unit in each if limit.name in ("", arm.quantity_names[k])]


def relaxed(setup: Setup, changes: Sequence[Change]) -> Setup:
    """Return a setup with changed limits that shares everything else with `setup`."""
    arm = copy.copy(setup.arm)
    arm.stroke, arm.rate, arm.acceleration = arm.stroke.copy(), arm.rate.copy(), arm.acceleration.copy()
    step_limit = setup.step_limit
    allowance, self_safe, angle = dict[str, float](), setup.self_safe, setup.minimum_angle
    for limit, amount, *_ in changes:
        kind, name, upper = limit
        rows = [k for k, _ in _actuators(setup, limit)]
        if kind == CLEARANCE:
            allowance[name] = amount
        elif kind == MEMBERS:
            self_safe = max(self_safe - amount, 0.0)
        elif kind == ANGLE:
            angle = max(angle - amount, 0.0)
        elif kind == STEP:
            step_limit += amount
        elif kind == STROKE:
            arm.stroke[rows, int(upper)] += amount if upper else -amount
        elif kind == ACCELERATION:
            arm.acceleration[rows] += amount
        else:
            arm.rate[rows] += amount
    before = setup.monitor
    obstacles = [
        replace(obstacle, allowance=allowance.get(obstacle.name, 0.0))
        for obstacle in before.obstacles
        if not math.isinf(allowance.get(obstacle.name, 0.0))
    ]
    options: dict[str, Any] = {
        "safe": before.safe,
        "self_safe": self_safe,
        "influence": before.influence,
        "by_fcl": before.scene.fcl is not None,
        "unit": setup.arm.unit,
    }
    monitor = Clearance(before.bodies, obstacles, self_collision=before.self_collision, **options)
    # A copy: from now on each of the two arms takes up and releases bodies by itself.
    carrier = copy.copy(setup.carrier)
    return replace(
        setup,
        arm=arm,
        carrier=carrier,
        monitor=monitor,
        measure=None,
        minimum_angle=angle,
        step_limit=step_limit,
    )
