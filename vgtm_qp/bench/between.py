"""What comes near between steps: the least clearance on the way that somebody's own steps lead along a maneuver."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

from vgtm_qp.arrays import Array
from vgtm_qp.bench.tour import Goal
from vgtm_qp.methods import Resolver
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State

_PIECES = 20
"""Number of pieces of a step at whose ends distances are evaluated."""


@runtime_checkable
class Walker(Protocol):
    """A baseline that goes on from where its last step led."""

    @property
    def configuration(self) -> Array:
        """(J + 6,) where it stands."""
        ...

    def place(self, state: State) -> None:
        """See :class:`~vgtm_qp.bench.contestants.Contestant`."""
        ...

    def step(self, goal: Goal) -> bool:
        """See :class:`~vgtm_qp.bench.contestants.Contestant`."""
        ...


def least_by_walker(setup: Setup, goals: Sequence[Goal], walker: Walker) -> float:
    """Return the least clearance from obstacles, m, at and between the steps of a baseline along all `goals`."""
    walker.place(setup.home_state())

    def take(goal: Goal) -> Array:
        walker.step(goal)
        return walker.configuration

    return _least(setup, goals, take)


def least_by_resolver(resolver: Resolver, goals: Sequence[Goal]) -> float:
    """Return the same of a resolver, which goes home for it and then on from there."""
    resolver.state = resolver.setup.home_state()

    def take(goal: Goal) -> Array:
        resolver.step(position=goal.pose.position, pointing=goal.pointing)
        return resolver.state.q

    found = _least(resolver.setup, goals, take)
    resolver.state = resolver.setup.home_state()
    return found


def _least(setup: Setup, goals: Sequence[Goal], take: Callable[[Goal], Array]) -> float:
    q, least = setup.arm.home_configuration, float("inf")
    for goal in goals[1:]:
        then = take(goal)
        for points in setup.carrier.ways(q, then, _PIECES)[1:]:
            least = min(least, setup.monitor.least(points, among="obstacles")[0])
        q = then
    return least
