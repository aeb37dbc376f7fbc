"""Which pairs are too near, and which of them holds the arm back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vgtm_qp.live.reading import Hold, TooNear
from vgtm_qp.methods import Resolver
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State


def pairs_too_near(resolver: Resolver) -> tuple[TooNear, ...]:
    """Return the pairs below their clearance in the state of a resolver, the worst first."""
    monitor = resolver.setup.monitor
    found = [
        TooNear(
            monitor.names.called(pair),
            distance,
            monitor.self_safe if pair.is_self else monitor.safe,
        )
        for pair, distance in resolver.too_near(resolver.state).items()
    ]
    return tuple(sorted(found, key=lambda one: one.distance - one.least))


def hold_of(setup: Setup, state: State, wanted: Sequence[str]) -> Hold | None:
    """Return the first of the `wanted` clearance rows that is near in a state, with its nearest points.

    None if none of them is near.
    """
    points = setup.carrier.points(state.q)
    near = setup.monitor.near(points, state.time)
    rows = {near.name(k): k for k in np.argsort(-near.distance).tolist()}
    k = next((rows[name] for name in wanted if name in rows), None)
    if k is None:
        return None
    body, other, is_self = near.pair(k)
    ours = near.weights[k, :2] @ points[near.points[k, :2]]
    away = float(setup.monitor.bodies.radius[body] + near.distance[k]) * near.normal[k]
    return Hold(
        name=near.names.called(near.pair(k)),
        distance=float(near.distance[k]),
        bodies=(body, other) if is_self else (body,),
        obstacle="" if is_self else near.names.obstacles[near.names.owner[other]],
        line=np.stack([ours, ours - away]),
    )
