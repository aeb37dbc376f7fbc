"""Baselines: other methods for the same steps, each with ``place`` and ``step``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.bench import BaselineName
from vgtm_qp.bench.peers import MinkStep, PinkStep
from vgtm_qp.bench.tour import Goal
from vgtm_qp.errors import SolverError
from vgtm_qp.methods import Resolver, with_method
from vgtm_qp.methods.conventional import DenseSolution
from vgtm_qp.methods.ipopt import NonlinearResolver
from vgtm_qp.methods.resolver import arm_without_curve
from vgtm_qp.problem import Problem
from vgtm_qp.step.state import State
from vgtm_qp.step.step import StepStatus


class Contestant(Protocol):
    """Takes one step from where it was placed."""

    def place(self, state: State) -> None:
        """Stand in `state`; not measured."""
        ...

    def step(self, goal: Goal) -> bool:
        """Move towards a goal in the duration of the problem's steps; False where that failed."""
        ...


class Baseline(NamedTuple):
    """A baseline: what it is, the longest arm that it is tried on, and how it is made."""

    title: str
    most_bays: int
    make: Callable[[Problem], Contestant]


class BarePseudoinverse:
    """Eq. (28) alone: one dense J^+ by singular values; no null-space vector, limit, clearance or check."""

    def __init__(self, problem: Problem) -> None:
        self._setup = setup = arm_without_curve(problem)
        self._solution = DenseSolution(setup.layout, problem.method)
        self._nodes = self.reached = setup.arm.home

    def place(self, state: State) -> None:
        """See :class:`Contestant`."""
        self._nodes = state.nodes

    def step(self, goal: Goal) -> bool:
        """See :class:`Contestant`."""
        setup, truss = self._setup, truss_of(self._setup.arm)
        setup.kinematics.evaluate(self._nodes)
        tip = setup.task.rows(self._nodes, setup.kinematics, goal.pose)
        J, _ = self._solution.jacobians(setup.kinematics.gradient, tip.jacobian)
        x = np.concatenate([tip.error, np.zeros(len(truss.fixed))])
        X = np.array(self._nodes)
        X[truss.free] += (np.linalg.pinv(J) @ x).reshape(-1, 3)
        self.reached = X
        return True


class ResolverStep:
    """A resolver of the package."""

    def __init__(self, resolver: Resolver) -> None:
        self.resolver = resolver

    def place(self, state: State) -> None:
        """See :class:`Contestant`."""
        resolver = self.resolver
        if state.control_vertices.shape != resolver.state.control_vertices.shape:
            state = replace(state, control_vertices=resolver.state.control_vertices)
        resolver.state = state

    def step(self, goal: Goal) -> bool:
        """See :class:`Contestant`."""
        step = self.resolver.step(position=goal.pose.position, pointing=goal.pointing)
        return step.status is StepStatus.REACHED


def _by_method(method: str, problem: Problem) -> ResolverStep:
    return ResolverStep(Resolver(with_method(problem, method)))


def _by_solver(solver: str, problem: Problem) -> ResolverStep:
    return ResolverStep(Resolver(problem.replace({"method.solver": solver})))


def _by_ipopt(problem: Problem) -> ResolverStep:
    return ResolverStep(NonlinearResolver(problem))


BASELINES: dict[BaselineName, Baseline] = {
    "eq28": Baseline("eq. (28), dense pseudoinverse alone", 100, BarePseudoinverse),
    "eq28-sparse": Baseline("eq. (28), banded", 1000, partial(_by_method, "pseudoinverse-sparse")),
    "curve": Baseline(
        "curve by pseudoinverse, bays after it", 1000, partial(_by_method, "curve-pseudoinverse")
    ),
    "ipopt": Baseline("nonlinear programs until clearances are exact, IPOPT", 20, _by_ipopt),
    "osqp": Baseline("the same QPs, OSQP", 200, partial(_by_solver, "osqp")),
    "piqp": Baseline("the same QPs, PIQP", 200, partial(_by_solver, "piqp")),
    "mink": Baseline("the same tip, limits and distances as a QP on MuJoCo, mink", 1000, MinkStep),
    "pink": Baseline("the same tip, limits and distances as a QP on Pinocchio, pink", 1000, PinkStep),
}


def make_baseline(name: BaselineName, problem: Problem, bays: int) -> Contestant:
    """Return a baseline for a problem.

    Raises
    ------
    VgtmError
        The baseline cannot serve that problem, or the arm is longer than the longest that it is tried on.
    """
    baseline = BASELINES[name]
    if bays > baseline.most_bays:
        raise SolverError(f"not tried on more than {baseline.most_bays} bays")
    return baseline.make(problem)
