"""The conventional solution, eqs. (25)-(28): the whole truss at once, without limits or clearance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.errors import SolverError
from vgtm_qp.methods.banded import BandedSystem
from vgtm_qp.methods.objectives import DEFAULT_TERMS, Terms, TrussObjective
from vgtm_qp.methods.pseudoinverse import (
    Inverse,
    Objective,
    moore_penrose,
    null_space_vector,
    projector,
    weighted,
)
from vgtm_qp.methods.resolver import (
    LENGTH_TOLERANCE,
    MAX_CORRECTIONS,
    TIP_TOLERANCE,
    MethodResolver,
    arm_without_curve,
    pose_displacement,
)
from vgtm_qp.problem import Problem
from vgtm_qp.problem.method import Method
from vgtm_qp.qp.layout import Layout
from vgtm_qp.step.path import Path

Array = NDArray[np.float64]


class DenseSolution:
    """Eq. (28) with dense matrices, as the paper has it."""

    def __init__(self, layout: Layout, method: Method) -> None:
        self._layout, self._truss, self._method = layout, truss_of(layout.arm), method
        self._lengths = np.zeros((self._truss.member_count, layout.node_columns))
        self._tip, self._present = tip_columns(layout)
        self.rank: int | None = None

    def displacement(self, gradient: Array, tip: Array, x: Array, terms: Terms) -> Array:
        """Return the node displacements (3 (N - N_c),), m.

        Parameters
        ----------
        gradient : (M, Q, 3)
            Of the member lengths.
        tip : (n_e, 3 K_tip)
            J_u of eq. (16) at the tip's nodes.
        x : (n_e + n_l,)
            Displacement of the end effector, then the changes of the fixed members' lengths, eq. (25).
        terms
            Null-space terms.
        """
        layout, truss, method = self._layout, self._truss, self._method
        lengths = truss.scatter.dense(gradient, self._lengths)
        J = np.zeros((len(x), layout.node_columns))
        J[: len(tip), self._tip] = tip[:, self._present]
        J[len(tip) :] = lengths[truss.fixed]
        actuated = lengths[truss.actuators]
        hessian = terms.actuator * actuated.T @ actuated
        hessian[np.diag_indices_from(hessian)] += terms.node
        if terms.blocks is not None:
            count = len(terms.blocks)
            by_node = hessian.reshape(count, 3, count, 3)
            by_node[np.arange(count), :, np.arange(count)] += terms.blocks
        objective = Objective(hessian, actuated.T @ terms.actuator_gradient + terms.node_gradient)
        inverse = self._inverse(J, objective)
        self.rank = inverse.rank
        start = inverse.matrix @ x
        N = projector(inverse, J)
        if method.variant in ("weighted", "damped"):
            return np.asarray(start - N @ np.linalg.solve(hessian, objective.gradient))
        if method.null_space == ():
            return np.asarray(start)
        return np.asarray(start + N @ null_space_vector(N, start, objective))

    def _inverse(self, J: Array, objective: Objective) -> Inverse:
        method = self._method
        if method.variant == "moore-penrose":
            return moore_penrose(J)
        if method.variant == "truncated":
            return moore_penrose(J, truncation=method.truncation)
        return weighted(J, objective.hessian, damping=method.damping if method.variant == "damped" else 0.0)


class SparseSolution:
    """Eq. (28) by its KKT system, banded in the order of the bays: the cost grows with the bays, not their cube.

    With H the Hessian of the null-space terms, J^+ x + (1 - J^+ J) rho_s is the minimiser of those terms under
    J d = x whichever pseudoinverse is meant, so that Moore-Penrose and weighted are one here.
    """

    def __init__(self, layout: Layout, method: Method) -> None:
        truss = truss_of(layout.arm)
        self._fixed = truss.fixed
        self._damping = method.damping**2 if method.variant == "damped" else 0.0
        self._tip, self._present = tip_columns(layout)
        nodes, actuators, members, tips = (
            layout.node_columns,
            len(truss.actuators),
            truss.member_count,
            len(layout.tip_rows),
        )
        self._parts = np.cumsum([0, nodes, actuators, members, tips])
        a, y, u = self._parts[1:4]
        scatter = truss.scatter
        member, flat, column = scatter.member, scatter.flat, scatter.column
        self._flat = flat
        tip_row = np.repeat(np.arange(tips), len(self._tip))
        tip_column = np.tile(self._tip, tips)
        index = np.arange(actuators)
        diagonal = np.arange(self._parts[-1])
        block = (3 * np.arange(nodes // 3)[:, None] + np.arange(3))[:, :, None]
        block_row = np.broadcast_to(block, (nodes // 3, 3, 3)).ravel()
        block_column = np.broadcast_to(np.swapaxes(block, 1, 2), (nodes // 3, 3, 3)).ravel()
        self._no_blocks = np.zeros(3 * nodes)
        rows = [
            block_row,
            diagonal,
            y + member,
            column,
            a + index,
            y + truss.actuators,
            u + tip_row,
            tip_column,
        ]
        columns = [
            block_column,
            diagonal,
            column,
            y + member,
            y + truss.actuators,
            a + index,
            tip_column,
            u + tip_row,
        ]
        self._system = BandedSystem(np.concatenate(rows), np.concatenate(columns), int(self._parts[-1]))
        self._damped = np.zeros(members + tips)
        self._damped[truss.fixed] = self._damped[members:] = -self._damping
        self.rank: int | None = members - actuators + tips

    def displacement(self, gradient: Array, tip: Array, x: Array, terms: Terms) -> Array:
        """Return the node displacements; parameters as of :meth:`DenseSolution.displacement`."""
        nodes, a, y, u = (int(part) for part in self._parts[1:])
        count = a - nodes
        lengths = gradient.reshape(-1)[self._flat]
        ends = tip[:, self._present].reshape(-1)
        ones = np.full(count, -1.0)
        diagonal = np.concatenate([np.full(nodes, terms.node), np.full(count, terms.actuator), self._damped])
        blocks = self._no_blocks if terms.blocks is None else terms.blocks.ravel()
        values = np.concatenate([blocks, diagonal, lengths, lengths, ones, ones, ends, ends])
        rhs = np.zeros(u)
        rhs[:nodes], rhs[nodes:a] = -terms.node_gradient, -terms.actuator_gradient
        rhs[a + self._fixed] = x[len(tip) :]
        rhs[y:] = x[: len(tip)]
        return self._system.solve(values, rhs)[:nodes]


class ConventionalResolver(MethodResolver):
    """Moves an arm by eq. (28).

    Raises
    ------
    ProblemError, TrussError
        The arm cannot be built.
    """

    def __init__(self, problem: Problem) -> None:
        method = problem.method
        super().__init__(arm_without_curve(problem), method.step_limit)
        names = DEFAULT_TERMS if method.null_space is None else method.null_space
        self._objective = TrussObjective(names, method.weights, self.setup)
        layout = self.setup.layout
        sparse = method.algebra == "sparse"
        self._solution = SparseSolution(layout, method) if sparse else DenseSolution(layout, method)
        self._correct = method.correct
        self._home_fixed = self.setup.arm.home_quantities[self.setup.truss.fixed]

    def _move(self, path: Path, start: float, end: float, dt: float) -> tuple[Array, Array, float]:
        setup, state = self.setup, self.state
        kinematics, task, free = setup.kinematics, setup.task, setup.truss.free
        here, goal = path.at(start), path.at(end)
        X = np.array(state.nodes)
        kinematics.evaluate(X)
        tip = task.rows(X, kinematics, goal)
        moved, turned = pose_displacement(here, goal)
        x_e = [moved[task.axes]]
        if task.turns:
            x_e.append(turned if task.turns == "orientation" else kinematics.tip_rotation[:, :2].T @ turned)
        base_rate = np.zeros(setup.truss.member_count)
        if setup.base_motion is not None:
            motion = setup.arm.based(X, setup.base_motion.pose(state.time + dt)) - X
            base_rate = setup.truss.scatter.base_rate(kinematics.gradient, motion)
            X += motion
        x = np.concatenate([*x_e, -base_rate[setup.truss.fixed]])
        if self._correct:
            gap = self._home_fixed - kinematics.quantities[setup.truss.fixed]
            x = np.concatenate([tip.error, gap - base_rate[setup.truss.fixed]])
        terms = self._objective.at(X, kinematics.quantities, state.time)
        self.spend("kinematics")
        X[free] += self._solution.displacement(kinematics.gradient, tip.jacobian, x, terms).reshape(-1, 3)
        self.rank = self._solution.rank
        self.spend("solve")
        if self._correct:
            self._newton(X, path, end)
            self.spend("correction")
        return X, state.control_vertices, 1.0

    def _newton(self, X: Array, path: Path, end: float) -> None:
        """Correct fixed members and tip in place: Newton's method by the same pseudoinverse, without gradients."""
        setup, goal = self.setup, path.at(end)
        kinematics, free = setup.kinematics, setup.truss.free
        for _ in range(MAX_CORRECTIONS):
            kinematics.evaluate(X)
            tip = setup.task.rows(X, kinematics, goal)
            gap = self._home_fixed - kinematics.quantities[setup.truss.fixed]
            worst = float(np.max(np.abs(gap), initial=0.0))
            if worst <= LENGTH_TOLERANCE and float(np.max(np.abs(tip.error))) <= TIP_TOLERANCE:
                return
            if not worst < 1e3:
                break
            terms = Terms(
                self._objective.node,
                self._objective.actuator,
                np.zeros(len(setup.truss.actuators)),
                np.zeros(setup.layout.node_columns),
            )
            x = np.concatenate([tip.error, gap])
            X[free] += self._solution.displacement(kinematics.gradient, tip.jacobian, x, terms).reshape(-1, 3)
        raise SolverError("Newton's method on lengths and tip does not converge")


def tip_columns(layout: Layout) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the columns of the tip's free nodes, and which columns of the tip's Jacobian those are."""
    first = layout.node_column[truss_of(layout.arm).tip]
    present = np.repeat(first >= 0, 3)
    return (first[:, None] + np.arange(3)).reshape(-1)[present], present
