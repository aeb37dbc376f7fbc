"""Why an arm stops, and what would let it go on, found at the state itself.

The rows with multipliers in the linear program of ``step/first_order.py`` hold the arm back. Rows without
which the arm gets no further are dropped one after another, until each remaining row is needed. An arm may
stop although the linear program allows a little progress: near a fold of its motion the curvature uses up
that progress.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import partial
from typing import Any

import numpy as np

from vgtm_qp.arm.arm import Arm
from vgtm_qp.errors import SolverError
from vgtm_qp.rows.limits import ACCELERATION
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.actuation import Limits
from vgtm_qp.step.first_order import FirstOrder, obstacle_of
from vgtm_qp.step.remedies import Remedy, longer_steps, remedies, resorts
from vgtm_qp.step.separation import Separation
from vgtm_qp.step.setup import TOO_LONG, Setup
from vgtm_qp.step.state import State
from vgtm_qp.step.step import Step

_BLOCKED = 0.02
"""Share of the path, within the trust region, below which the arm counts as blocked."""
_FREER = 2.0
"""A row holds the arm if the share grows by at least this factor without the row."""
_SINGULAR = 0.1
"""Share below which the tip moves far less than the actuators do."""
_OUTWARD, _A_LITTLE = 0.5, 0.2
"""Cosine of a path's direction to that away from the base above which it leads outward, and a little outward."""
_FURTHER = (2.0, 4.0, 8.0, 16.0)
"""Factors of the piece of path that are tried one after another if the arm is free on the piece itself."""
_NAMED = 3
"""Number of rows that a text names."""

CANNOT_BRAKE = "the arm could not brake after it"
"""Reason of a step that is refused because no braking was found after it."""
BASE_MOVES_ON = "its base moves on, and the tip cannot stay on its path with accelerations as limited"
"""The reason of a step in which the tip leaves its path."""


class StopKind(StrEnum):
    """The kind of cause that stops an arm."""

    OBSTACLE = "obstacle"
    MEMBERS = "members"
    ANGLE = "angle"
    ROW = "row"
    STROKE = "stroke"
    RATE = "rate"
    ACCELERATION = "acceleration"
    LOCKED = "locked"
    SINGULAR = "singular pose"
    OUT_OF_REACH = "out of reach"
    STEP_LIMIT = "step limit"
    NONLINEAR = "nonlinear"
    SOLVER = "solver"
    INTERRUPTED = "interrupted"


@dataclass(frozen=True)
class Stop:
    """Why an arm stopped.

    Attributes
    ----------
    kind : StopKind
        ``obstacle`` if one is in the set, then ``members``, ``angle`` or a ``row`` of the user's own, then limits by
        name; ``singular pose`` if the tip cannot start in that direction even without limits, or the fixed quantities
        do not determine the nodes; ``out of reach`` if the arm is stretched towards a goal further away. If no row
        forbids the step to first order: ``acceleration`` if the arm could not brake after it, ``step limit`` if it is
        longer than the problem allows, ``solver`` if the QP solver gave no accurate answer, else ``nonlinear``.
    multipliers : dict
        Rows of the set, the most decisive first, and the share of the path that each costs per metre (radian); 0 for
        an obstacle that strikes an arm at rest.
    obstacles : tuple of str
        Names of the obstacles among the rows of the set.
    reason : str
        Reason of the last attempt.
    away : tuple of float
        (3,) direction in which the obstacles in the set push the arm, weighted by multipliers; zero without obstacles.
    remedies : tuple of Remedy
        Up to three alternatives, the smallest first: each lets the arm go on, to first order.
    resorts : tuple of Remedy
        What to try if none of them does.
    """

    kind: StopKind
    multipliers: Mapping[str, float] = field(default_factory=dict)
    obstacles: tuple[str, ...] = ()
    reason: str = ""
    away: tuple[float, ...] = (0.0, 0.0, 0.0)
    remedies: tuple[Remedy, ...] = ()
    resorts: tuple[Remedy, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the rows of the set, or else the kind of the stop, with a solver's reason."""
        return tuple(self.multipliers) or (str(self if self.kind is StopKind.SOLVER else self.kind),)

    def __str__(self) -> str:
        """Return what lets the arm go on; or else the rows that hold it, or the reason."""
        if self.reason and self.reason in self.multipliers:
            # A method without rows gives the reason of its breakdown in its own words.
            return self.reason
        if self.remedies:
            return f"{self.kind}; to go on: {', or '.join(map(str, self.remedies))}"
        is_unclear = self.kind in (StopKind.STEP_LIMIT, StopKind.NONLINEAR, StopKind.SOLVER)
        reason = self.reason if is_unclear or _is_braking(self.reason) else ""
        names = list(self.multipliers)
        held = ", ".join(names[:_NAMED]) + (f" and {more} more" if (more := len(names) - _NAMED) > 0 else "")
        return ": ".join(part for part in (str(self.kind), held, reason) if part)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data."""
        return {
            "kind": str(self.kind),
            "multipliers": dict(self.multipliers),
            "obstacles": list(self.obstacles),
            "reason": self.reason,
            "remedies": [[change.to_dict() for change in remedy.changes] for remedy in self.remedies],
            "text": str(self),
        }


def explain(
    setup: Setup,
    separation: Separation,
    state: State,
    goal: TipGoal,
    limits: Limits,
    last: Step | None = None,
) -> Stop:
    """Return why the arm stopped at `state` on its way to a goal, with rates over a whole piece of path.

    If no rows forbid it to first order, the answer is the active rows of the `last` step and its reason.
    """
    reason, pressing, solver_failed = "", dict[str, float](), False
    if last is not None:
        reason, pressing, solver_failed = last.reason, last.multipliers, last.solver_failed
        if last.left_path:
            reason, solver_failed = BASE_MOVES_ON, False
    make = partial(FirstOrder, setup, separation, state, goal, limits)
    try:
        program = make()
    except SolverError:
        return Stop(StopKind.SINGULAR, reason=reason)
    share, costs = program.solve(np.ones(program.count, dtype=bool))
    if solver_failed and share > _BLOCKED:
        return Stop(StopKind.SOLVER, reason=reason)
    bar = min(max(_BLOCKED, _FREER * share), 0.5 * (1.0 + share))
    kept = costs > 0.0
    is_outward = _is_outward(setup.arm, state, goal)
    if not kept.any() or program.solve(np.zeros(program.count, dtype=bool))[0] <= bar:
        if share <= _SINGULAR:
            return Stop(StopKind.OUT_OF_REACH if is_outward else StopKind.SINGULAR, reason=reason)
        if reason.startswith(TOO_LONG):
            return Stop(StopKind.STEP_LIMIT, reason=reason, remedies=(longer_steps(setup),))
        other = StopKind.ACCELERATION if _is_braking(reason) else StopKind.NONLINEAR
        kinds = {_kind(setup, name) for name in pressing}
        ways = _remedies(setup, program, make)
        names = [*pressing, *([ACCELERATION] if _is_braking(reason) else [])]
        others = tuple(resorts(setup, state.quantities, names, ways))
        kind = StopKind.OUT_OF_REACH if _is_straight(setup, state, goal, kinds) else _first(kinds, other)
        return Stop(kind, pressing, _obstacles(setup, pressing), reason, remedies=ways, resorts=others)
    for k in sorted(np.flatnonzero(kept).tolist(), key=lambda k: costs[k]):
        kept[k] = False
        if program.solve(kept)[0] > bar:
            kept[k] = True
    _, costs = program.solve(kept)
    multipliers: dict[str, float] = {}
    kinds, away = set(), np.zeros(3)
    for k in sorted(np.flatnonzero(kept).tolist(), key=lambda k: -costs[k]):
        name, cost = program.names[k], float(costs[k])
        multipliers[name] = max(multipliers.get(name, 0.0), cost)
        kinds.add(kind := _kind(setup, name))
        if kind is StopKind.OBSTACLE:
            away += cost * program.normal(k)
    is_long = kinds == {StopKind.STROKE} and np.count_nonzero(kept) >= setup.arm.segments
    is_beyond = (is_outward and is_long) or _is_straight(setup, state, goal, kinds)
    kind = StopKind.OUT_OF_REACH if is_beyond else _first(kinds, StopKind.NONLINEAR)
    ways = _remedies(setup, program, make)
    others = tuple(resorts(setup, state.quantities, multipliers, ways))
    return Stop(kind, multipliers, _obstacles(setup, multipliers), reason, tuple(away.tolist()), ways, others)


def _remedies(setup: Setup, program: FirstOrder, make: Callable[..., FirstOrder]) -> tuple[Remedy, ...]:
    """Return the remedies of a stop; if the arm is free to first order, those on a longer piece of path.

    `make` gives the linear program for a ``reach``.
    """
    found = remedies(setup, program)
    for reach in _FURTHER:
        if found:
            break
        found = remedies(setup, make(reach=reach))
    return found


def struck(stop: Stop, setup: Setup, separation: Separation, state: State, dt: float) -> Stop:
    """Return a stop led by the obstacles that come too near to an arm at rest in `state` within `dt`, s.

    The rows of a step are those of its end: then a fast obstacle may be on the other side of the arm already.
    """
    if not setup.monitor.pieces.moving:
        return stop
    then, short = state.after(dt)[0], separation.shortfall_of(state)
    failing = separation.between(state.q, state.q, state.time, then, short).failing
    names = {failing.name(k): 0.0 for k in np.argsort(failing.distance) if not failing.is_self[k]}
    if not names:
        return stop
    names |= stop.multipliers
    return replace(stop, kind=StopKind.OBSTACLE, multipliers=names, obstacles=_obstacles(setup, names))


def _is_braking(reason: str) -> bool:
    """Return whether a step was refused, or left its path, because the arm could not brake after it."""
    return reason.startswith((CANNOT_BRAKE, BASE_MOVES_ON))


def _first(kinds: Iterable[StopKind], other: StopKind) -> StopKind:
    """Return the first of `kinds` in the order of ``StopKind``, or `other` if there are none."""
    return next((kind for kind in StopKind if kind in kinds), other)


def _obstacles(setup: Setup, names: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the obstacles in the names of rows."""
    found = {obstacle_of(setup, name) for name in names}
    return tuple(o.name for o in setup.monitor.obstacles if o.name in found)


def _kind(setup: Setup, name: str) -> StopKind:
    """Return the kind of stop that the row of that name causes."""
    first = name.split(":")[0]
    if first == "clearance":
        return StopKind.OBSTACLE if _obstacles(setup, [name]) else StopKind.MEMBERS
    return StopKind(first)


def _is_straight(setup: Setup, state: State, goal: TipGoal, kinds: set[StopKind]) -> bool:
    """Return whether the arm is stretched out, by the kinds of rows that hold it.

    Rates alone hold a tip that may slow down where joints would have to turn without end.
    """
    slowed = kinds == {StopKind.RATE} and setup.tip_mode == "scaled"
    return slowed and _is_outward(setup.arm, state, goal, _A_LITTLE)


def _is_outward(arm: Arm, state: State, goal: TipGoal, least: float = _OUTWARD) -> bool:
    """Return whether the path to the goal leads away from the base: its cosine is above the `least`."""
    way = goal.position - state.nodes[arm.base].mean(axis=0)
    speed = float(np.linalg.norm(goal.velocity))
    return speed > 0.0 and float(way @ goal.velocity) > least * speed * float(np.linalg.norm(way))
