"""Random changes of the scene round a running arm, and what they cost."""

from __future__ import annotations

import math
from time import thread_time
from typing import Any

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.methods import Resolver
from vgtm_qp.problem.obstacle import Box, Cylinder, Sphere
from vgtm_qp.study.workers import Row

_MOST = 8
"""Greatest number of obstacles; more are removed."""
_NEAREST, _FURTHEST = 0.15, 0.9
"""Distances of a new obstacle's centre from a point of the arm, over its height."""
_BESIDE = (0.0, 0.15)
"""Distances from the tip of the middle of a body that it takes up, over the arm's height."""
_SIZES = (0.02, 0.12)
"""Least and greatest size of a new obstacle, over the arm's height."""
_FASTEST = 0.05
"""Greatest coordinate of a velocity, m/s."""
_DEAR = 2.0
"""A change that takes more CPU time than so many median steps of the loop is dear."""
_FAR = 1e3
"""Where shapes are tried for the first time, over the arm's height."""


class Disturbance:
    """Changes the scene of a `resolver` before a `share` of its steps.

    Obstacles come, move, change their velocity and go, the clearance changes, and the tip takes bodies up and lets them
    go. What would put an obstacle into the arm, or so near that an arm with limited accelerations cannot brake in time,
    is taken back at once.
    """

    def __init__(self, resolver: Resolver, random: np.random.Generator, share: float) -> None:
        self._resolver, self._random, self._share = resolver, random, share
        self._safe, self._height = resolver.setup.safe, resolver.setup.arm.height
        arm = resolver.setup.arm
        self._is_heavy = bool(np.isfinite(arm.acceleration[arm.actuators]).any())
        self._seconds: list[float] = []
        self._at_tip: list[float] = []
        self._made = 0
        if share > 0.0:
            # The first obstacle of a shape costs more.
            for shape in range(3):
                self._add(shape, np.full(3, _FAR * self._height))
                resolver.remove_obstacle(resolver.obstacles[-1].name)

    def before_step(self) -> None:
        """Change the scene, or leave it."""
        if self._random.random() >= self._share:
            return
        names = [obstacle.name for obstacle in self._resolver.obstacles]
        kinds = [self._come, self._move, self._stop, self._go, self._keep]
        if self._resolver.setup.arm.end_effector.has_frame:
            kinds.append(self._let_go if self._resolver.carried else self._take_up)
        change = self._come if not names else kinds[int(self._random.integers(len(kinds)))]
        if len(names) > _MOST:
            change = self._go
        started = thread_time()
        change(str(self._random.choice(names)) if names else "")
        seconds = self._at_tip if change in (self._take_up, self._let_go) else self._seconds
        seconds.append(thread_time() - started)

    def _is_bad(self, near: dict[str, float]) -> bool:
        """Return whether a change leaves the arm inside an obstacle, or no way to brake before it comes too near."""
        return min(near.values(), default=math.inf) <= 0.0 or (self._is_heavy and bool(near))

    def _come(self, _: str) -> None:
        way = self._random.normal(size=3)
        way *= self._height * self._random.uniform(_NEAREST, _FURTHEST) / np.linalg.norm(way)
        nodes = self._resolver.state.nodes
        near = self._add(int(self._random.integers(3)), nodes[int(self._random.integers(len(nodes)))] + way)
        if self._is_bad(near):
            self._resolver.remove_obstacle(self._resolver.obstacles[-1].name)

    def _take_up(self, _: str) -> None:
        way = self._random.normal(size=3)
        way *= self._height * self._random.uniform(*_BESIDE) / np.linalg.norm(way)
        body = self._body(int(self._random.integers(3)), self._resolver.tip()[0] + way)
        if self._is_bad(self._resolver.attach(body)):
            self._resolver.release(body.name, keep=False)

    def _let_go(self, _: str) -> None:
        name = self._resolver.carried[0].name
        if self._is_bad(self._resolver.release(name)):
            self._resolver.attach(name)

    def _add(self, shape: int, center: Array) -> dict[str, float]:
        return self._resolver.add_obstacle(self._body(shape, center))

    def _body(self, shape: int, center: Array) -> Box | Sphere | Cylinder:
        random, self._made = self._random, self._made + 1
        sizes = self._height * random.uniform(*_SIZES, size=3)
        place: dict[str, Any] = {"name": f"thing {self._made}", "center": center}
        if random.random() < 0.5:
            place["velocity"] = random.uniform(-_FASTEST, _FASTEST, size=3)
        if shape == 0:
            return Sphere(**place, radius=sizes[0])
        turned = {**place, "rotation_vector": random.normal(size=3)}
        if shape == 1:
            return Box(**{**turned, "size": sizes})
        return Cylinder(**turned, radius=sizes[0], height=sizes[1])

    def _move(self, name: str) -> None:
        self._put(name, shift=self._random.normal(scale=0.02 * self._height, size=3))

    def _stop(self, name: str) -> None:
        still = self._random.random() < 0.5
        velocity = np.zeros(3) if still else self._random.uniform(-_FASTEST, _FASTEST, size=3)
        self._put(name, velocity=velocity)

    def _put(self, name: str, *, shift: Array | None = None, velocity: Array | None = None) -> None:
        """Move an obstacle, and put it back if that is bad."""
        resolver = self._resolver
        table = next(obstacle for obstacle in resolver.obstacles if obstacle.name == name)
        center = np.add(table.center, np.multiply(resolver.state.time, table.velocity))
        moved = center if shift is None else center + shift
        if self._is_bad(resolver.move_obstacle(name, center=moved, velocity=velocity)):
            resolver.move_obstacle(name, center=center, velocity=table.velocity)

    def _go(self, name: str) -> None:
        self._resolver.remove_obstacle(name)

    def _keep(self, _: str) -> None:
        before = self._resolver.setup.safe
        if self._is_bad(self._resolver.set_clearance(safe=self._safe * self._random.uniform(0.5, 1.5))):
            self._resolver.set_clearance(safe=before)

    def row(self, step: float) -> Row:
        """Return the numbers of changes, and the medians of their CPU times over that of a `step`.

        Keys: ``changes``, ``change_cost`` and ``dear_changes`` of obstacles and clearances; ``carried`` and
        ``carry_cost`` of bodies taken up and let go.
        """
        costs, others = (np.array(seconds) / max(step, 1e-9) for seconds in (self._seconds, self._at_tip))
        return {
            "changes": len(costs),
            "change_cost": _middle(costs),
            "dear_changes": int(np.sum(costs > _DEAR)),
            "carried": len(others),
            "carry_cost": _middle(others),
        }


def _middle(values: Array) -> float:
    return float(np.median(values)) if len(values) else 0.0
