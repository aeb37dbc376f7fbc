"""What moves an arm step by step, whatever the method: all that a maneuver and the live page know of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from numpy.typing import ArrayLike

from vgtm_qp.arrays import Array
from vgtm_qp.problem import Problem
from vgtm_qp.step.path import Path
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import Shortfall, State
from vgtm_qp.step.step import Step
from vgtm_qp.step.stops import Stop


class Mover(Protocol):
    """The interface that all methods meet: ``Resolver``, and those that are compared with it.

    Attributes
    ----------
    setup, state
        What was built for the problem, and where the arm is; the latter may be set to another state of this arm.
    phases : dict of str to float
        Seconds spent so far in each phase.
    solver : str or None
        Name of the QP solver; None where the method solves no QP.
    rank : int or None
        Rank of the Jacobian of eq. (26) in the last step; None where the method does not reveal it.
    draws_vertices : bool
        Whether control vertices follow goals of their own.
    control_vertex_goals : dict of int to (3,)
        Where control vertices are drawn to, m, by their index; may be set as a whole where the method draws any.
    """

    state: State

    @property
    def setup(self) -> Setup: ...
    @property
    def phases(self) -> dict[str, float]: ...
    @property
    def solver(self) -> str | None: ...
    @property
    def rank(self) -> int | None: ...
    @property
    def draws_vertices(self) -> bool: ...
    @property
    def control_vertex_goals(self) -> dict[int, Array]: ...
    @control_vertex_goals.setter
    def control_vertex_goals(self, goals: Mapping[int, ArrayLike]) -> None: ...

    def tip(self) -> tuple[Array, Array]:
        """Return position (3,), m, and rotation (3, 3) of the end effector in the present state."""

    def follow(self, path: Path, start: float, end: float, *, dt: float | None = None) -> Step:
        """Move along `path` from its value `start` towards `end` in one step of `dt`, s, by default the problem's."""

    def brake(self, path: Path, start: float, end: float) -> Step | None:
        """Do the next of the steps that bring the arm to rest; None where it may stay as it is, and nothing moves."""

    def explain(
        self,
        path: Path,
        start: float,
        end: float,
        *,
        dt: float | None = None,
        last: Step | None = None,
        state: State | None = None,
    ) -> Stop:
        """Return why the arm does not get on along `path` from a state, the present one by default; nothing moves.

        Worth asking after a `last` step that was blocked, hardly moved or braked.
        """

    def too_near(self, state: State) -> Shortfall:
        """Return the pairs below their clearance in a state that the method drives apart, with their distances, m."""

    def again(self, problem: Problem) -> Mover | None:
        """Return what tries a maneuver once more from home, for a problem that resolves the redundancy differently.

        None where the method leaves no choice.
        """
