"""The goals that a control loop gives a resolver, one a step: the marks of a maneuver, there and back."""

from __future__ import annotations

from typing import NamedTuple

from vgtm_qp.arrays import Array
from vgtm_qp.maneuver.plan import make_plan
from vgtm_qp.maneuver.solve import STALLED_PROGRESS, STALLED_STEPS
from vgtm_qp.methods import Resolver
from vgtm_qp.problem import Problem
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.step import Step, StepStatus


class Goal(NamedTuple):
    """Where a step leads: a pose, and the direction ``pointing`` (3,) to ask a resolver for, or None."""

    pose: TipGoal
    pointing: Array | None


def make_goals(problem: Problem, resolver: Resolver) -> list[Goal]:
    """Return the goals of a problem's maneuver in order; the first is the home pose, where the resolver stands.

    A direction or an orientation that the problem tracks is asked for as ``pointing``, the z-axis of the tip.
    """
    plan = make_plan(problem, *resolver.tip())
    poses = [plan.path.at(value) for value in (plan.path.start, *plan.marks.tolist())]
    turns = resolver.setup.task.turns is not None
    return [Goal(pose, pose.rotation[:, 2] if turns else None) for pose in poses]


class Tour:
    """A tour from goal to goal, to the last and back to the first, again and again.

    A goal that a step did not reach is asked for again. ``stuck`` names what stopped the arm, empty if nothing did.
    """

    def __init__(self, goals: list[Goal]) -> None:
        self._goals = goals
        self.covered = 0.0
        """Greatest share of the maneuver behind the arm so far, 0 to 1."""
        self.restart()

    def restart(self) -> None:
        """Begin at the first goal again, where nothing holds the arm."""
        self._at, self._direction, self._share = 0, 1, 0.0
        self._stalled, self.stuck = 0, ""

    @property
    def goal(self) -> Goal:
        """What the next step is asked for."""
        return self._goals[self._at + self._direction]

    @property
    def round_trip(self) -> int:
        """Number of steps there and back, if each reaches its goal."""
        return 2 * (len(self._goals) - 1)

    def advance(self, step: Step) -> None:
        """Note what a step towards the goal did."""
        self._stalled = self._stalled + 1 if step.progress < STALLED_PROGRESS else 0
        if step.status is StepStatus.BLOCKED or self._stalled == STALLED_STEPS:
            self.stuck = ", ".join(step.blocked_by) or "nothing that has a name"
            return
        last = len(self._goals) - 1
        if step.status is StepStatus.SLOWED:
            self._share += (1.0 - self._share) * step.progress
        else:
            self._at, self._share = self._at + self._direction, 0.0
        self.covered = max(self.covered, (self._at + self._direction * self._share) / last)
        if self._share == 0.0 and self._at in (0, last):
            self._direction = 1 if self._at == 0 else -1
