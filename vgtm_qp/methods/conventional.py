"""The conventional solution, section 3.4: the whole arm at once, without limits or clearance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg.lapack import dgbsv
from scipy.sparse.csgraph import reverse_cuthill_mckee

from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.errors import SolverError
from vgtm_qp.methods.objectives import DEFAULT_TERMS, NamedTerms, Terms
from vgtm_qp.methods.pseudoinverse import (
    TRUNCATION,
    Cost,
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
    Moved,
    arm_without_curve,
    displacement_to,
)
from vgtm_qp.problem import Problem
from vgtm_qp.problem.method import Method
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.terms import Inequality, Objective
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.path import Path

_LOWER = np.tril_indices(3)


class Linear(NamedTuple):
    """J d = x for displacements of the arm, at one configuration.

    J is made of a ``gradient`` and of J_u of eq. (16) at the ``tip``'s nodes (n_e, 3 K_tip); x of the displacement
    ``x_e`` (n_e,) of the end effector and the changes ``x_g`` (n_l,) of the fixed quantities. For a truss d are those
    of its nodes, and the gradient (M, Q, 3) is that of its members' lengths; for an arm without fixed quantities d are
    those of its actuators, and the gradient K (3 (N - N_c), n_a) is that of its nodes.
    """

    gradient: Array
    tip: Array
    x_e: Array
    x_g: Array


class Resolved(NamedTuple):
    """Displacements (n,), and the rank of their Jacobian."""

    displacement: Array
    rank: int


def resolved(J: Array, x: Array, objective: Cost, method: Method) -> Resolved:
    """Return J^+ x + (1 - J^+ J) v with the null-space vector v of `objective`, by the method's variant."""
    if method.variant in ("moore-penrose", "truncated"):
        truncation = method.truncation if method.variant == "truncated" else TRUNCATION
        inverse = moore_penrose(J, truncation=truncation)
    else:
        inverse = weighted(
            J, objective.hessian, damping=method.damping if method.variant == "damped" else 0.0
        )
    start, N = inverse.matrix @ x, projector(inverse, J)
    if method.variant in ("weighted", "damped"):
        start = start - N @ np.linalg.solve(objective.hessian, objective.gradient)
    elif method.null_space != ():
        start = start + N @ null_space_vector(N, start, objective)
    return Resolved(np.asarray(start), inverse.rank)


class DenseSolution:
    """The solution with dense matrices, as the paper has it."""

    def __init__(self, layout: Layout, method: Method) -> None:
        self._layout, self._truss, self._method = layout, truss_of(layout.arm), method
        self._lengths = np.zeros((self._truss.member_count, layout.node_columns))
        self._fixed = self._truss.fixed
        self._tip, self._present = layout.tip_columns
        self.rank: int | None = None

    def hold(self, members: Index, held: Mask) -> None:  # noqa: ARG002
        """Count some actuated members (h,), True in `held` (n_a,), as fixed ones, after the fixed members."""
        self._fixed = np.concatenate([self._truss.fixed, members])

    def displacement(self, system: Linear, terms: Terms) -> Array:
        """Return the node displacements (3 (N - N_c),), m: eq. (28) with the null-space vector of `terms`."""
        J, actuated = self.jacobians(system.gradient, system.tip)
        hessian = terms.actuator * actuated.T @ actuated
        hessian[np.diag_indices_from(hessian)] += terms.node
        count = len(terms.blocks)
        by_node = hessian.reshape(count, 3, count, 3)
        by_node[np.arange(count), :, np.arange(count)] += terms.blocks
        objective = Cost(hessian, actuated.T @ terms.actuator_gradient + terms.node_gradient)
        found = resolved(J, np.concatenate([system.x_e, system.x_g]), objective, self._method)
        self.rank = found.rank
        return found.displacement

    def jacobians(self, gradient: Array, tip: Array) -> tuple[Array, Array]:
        """Return J (n_e + n_l, 3 (N - N_c)), eq. (26), of tip and fixed lengths, and the rows of actuated lengths."""
        truss = self._truss
        lengths = truss.scatter.dense(gradient, self._lengths)
        J = np.zeros((len(tip) + len(self._fixed), lengths.shape[1]))
        J[: len(tip), self._tip] = tip[:, self._present]
        J[len(tip) :] = lengths[self._fixed]
        return J, lengths[truss.actuators]


class JointSolution:
    """The solution in the actuators of an arm without fixed quantities, with dense matrices."""

    def __init__(self, layout: Layout, method: Method) -> None:
        self._method, self._levers = method, layout.arm.levers
        self._free = np.ones(len(self._levers), dtype=bool)
        self._tip, self._present = layout.tip_columns
        self.rank: int | None = None

    def hold(self, members: Index, held: Mask) -> None:  # noqa: ARG002
        """See :meth:`DenseSolution.hold`."""
        self._free = ~held

    def displacement(self, system: Linear, terms: Terms) -> Array:
        """Return the displacements of the actuators (n_a,), rad or m."""
        K, free = system.gradient[:, self._free], self._free
        by_node = K.reshape(-1, 3, K.shape[1])
        hessian = terms.node * K.T @ K + np.einsum("nai,nab,nbj->ij", by_node, terms.blocks, by_node)
        hessian[np.diag_indices_from(hessian)] += terms.actuator * self._levers[free] ** 2
        objective = Cost(hessian, terms.actuator_gradient[free] + K.T @ terms.node_gradient)
        J = system.tip[:, self._present] @ K[self._tip]
        moved = np.zeros(len(free))
        moved[free], self.rank = resolved(J, system.x_e, objective, self._method)
        return moved


class SparseSolution:
    """The same solution by its KKT system, banded in the order of the bays: the cost is linear in the bays.

    With H the Hessian of the null-space terms, J^+ x + (1 - J^+ J) rho_s is the minimiser of those terms under
    J d = x for either pseudoinverse, so that Moore-Penrose and weighted give the same here. Unknowns are the
    displacements of nodes and actuators, and the multipliers of the lengths and of the tip.
    """

    def __init__(self, layout: Layout, method: Method) -> None:
        truss = truss_of(layout.arm)
        scatter, members, actuators = truss.scatter, truss.member_count, np.arange(len(truss.actuators))
        self._flat, self._fixed = scatter.flat, truss.fixed
        self._tip, self._present = layout.tip_columns
        tips = np.arange(len(layout.tip_rows))
        a = layout.node_columns
        y = a + len(actuators)
        u = y + members
        self._parts = a, y, u
        nodes = np.arange(0, a, 3)[:, None]
        # Places of the entries in the order of `displacement`.
        places = [
            (np.arange(u + len(tips)), np.arange(u + len(tips))),
            (nodes + _LOWER[0], nodes + _LOWER[1]),
            (y + scatter.member, scatter.column),
            (y + truss.actuators, a + actuators),
            (np.repeat(u + tips, len(self._tip)), np.tile(self._tip, len(tips))),
        ]
        rows, columns = (np.concatenate([np.ravel(place[k]) for place in places]) for k in (0, 1))
        self._system = BandedSystem(rows, columns)
        damped = np.zeros(members + len(tips))
        if method.variant == "damped":
            damped[truss.fixed] = damped[members:] = -(method.damping**2)
        self._damped, self._free = damped, np.ones(len(actuators))
        self._damping = -(method.damping**2) if method.variant == "damped" else 0.0
        self.rank: int | None = members - len(actuators) + len(tips)

    def hold(self, members: Index, held: Mask) -> None:
        """See :meth:`DenseSolution.hold`: the row of a held actuator's length loses the actuator's displacement."""
        assert self.rank is not None
        self.rank += int(held.sum()) - int((self._free == 0.0).sum())
        self._fixed = np.concatenate(
            [self._fixed[: self._fixed.size - int((self._free == 0.0).sum())], members]
        )
        self._free = np.where(held, 0.0, 1.0)
        self._damped[members] = self._damping

    def displacement(self, system: Linear, terms: Terms) -> Array:
        """Return the node displacements, as :meth:`DenseSolution.displacement` does."""
        a, y, u = self._parts
        values = [
            np.full(a, terms.node),
            np.where(self._free, terms.actuator, 1.0),
            self._damped,
            terms.blocks[:, *_LOWER].ravel(),
            system.gradient.reshape(-1)[self._flat],
            -self._free,
            system.tip[:, self._present].ravel(),
        ]
        lengths = np.zeros(u - y)
        lengths[self._fixed] = system.x_g
        rhs = np.concatenate([-terms.node_gradient, -terms.actuator_gradient, lengths, system.x_e])
        return self._system.solve(np.concatenate(values), rhs)[:a]


class BandedSystem:
    """A symmetric sparse system of constant pattern, ordered to a narrow band, whose values change.

    An entry at `rows` and `columns` (E,) counts at the mirrored place too; entries at one place are added up.
    """

    def __init__(self, rows: Index, columns: Index) -> None:
        size = int(max(rows.max(), columns.max())) + 1
        pattern = sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=(size, size))
        self._order = reverse_cuthill_mckee(sparse.csr_array(pattern + pattern.T), symmetric_mode=True)
        place = np.empty(size, dtype=np.int64)
        place[self._order] = np.arange(size)
        i, j = place[rows], place[columns]
        self._mirrored = np.flatnonzero(i != j)
        self._width = width = int(np.abs(i - j).max())
        i, j = np.concatenate([i, j[self._mirrored]]), np.concatenate([j, i[self._mirrored]])
        self._shape = 3 * width + 1, size
        self._flat = (2 * width + i - j) * size + j

    def solve(self, values: Array, rhs: Array) -> Array:
        """Return the solution (size,) for entries `values` (E,) in the order of `rows`, by LU with pivoting.

        Raises
        ------
        SolverError
            The matrix is singular to working precision.
        """
        entries = np.concatenate([values, values[self._mirrored]])
        band = np.bincount(self._flat, weights=entries, minlength=self._shape[0] * self._shape[1])
        width = self._width
        factors, _, solution, info = dgbsv(width, width, band.reshape(self._shape), rhs[self._order])
        pivots = np.abs(factors[2 * width])
        if info != 0 or not float(pivots.min()) > 1e-14 * float(pivots.max()):
            raise SolverError("the KKT matrix of eq. (28) is singular to working precision")
        x = np.empty(len(rhs))
        x[self._order] = solution
        return x


class ConventionalResolver(MethodResolver, serves="pseudoinverse"):
    """Moves an arm by the conventional solution.

    Raises
    ------
    ProblemError
        The arm cannot be built.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        objectives: Sequence[Objective] = (),  # noqa: ARG002
        rows: Sequence[Inequality] = (),  # noqa: ARG002
    ) -> None:
        method = problem.method
        super().__init__(arm_without_curve(problem))
        arm, layout = self.setup.arm, self.setup.layout
        self._has_bays = arm.bays is not None
        self._solution: DenseSolution | SparseSolution | JointSolution
        if not self._has_bays:
            self._solution = JointSolution(layout, method)
        elif method.algebra == "sparse":
            self._solution = SparseSolution(layout, method)
        else:
            self._solution = DenseSolution(layout, method)
        names = DEFAULT_TERMS if method.null_space is None else method.null_space
        self._terms = NamedTerms(names, method.weights, self.setup)
        self._correct = method.correct
        self._given = self._fixed = truss_of(arm).fixed if self._has_bays else np.zeros(0, dtype=np.int64)
        self._lengths = arm.home_quantities[self._fixed]

    def lock(self, name: str) -> None:
        """See :class:`Resolver`: a locked actuator is a fixed quantity from then on."""
        super().lock(name)
        held = np.isin(self._actuation.names, list(self._actuation.locked))
        members = self.setup.arm.actuators[held]
        self._solution.hold(members, held)
        if not self._has_bays:
            return
        kept = dict(zip(self._fixed.tolist(), self._lengths.tolist(), strict=True))
        self._fixed = np.concatenate([self._given, members])
        now = self.state.quantities
        self._lengths = np.array([kept.get(k, float(now[k])) for k in self._fixed.tolist()])

    def _move(self, path: Path, start: float, end: float, dt: float) -> Moved:
        setup, state, arm = self.setup, self.state, self.setup.arm
        q = state.q
        system = self._linear(q, displacement_to(path.at(end), path.at(start)))
        if setup.base_motion is not None:
            q = arm.based(q, setup.base_motion.pose(state.after(dt)[0]))
            system = self._carried(system, state.nodes, arm.nodes(q))
        terms = self._terms.at(q, setup.kinematics.quantities, state.time)
        self._clock.add("kinematics")
        q = self._displaced(q, self._solution.displacement(system, terms))
        self.rank = self._solution.rank
        self._clock.add("solve")
        if self._correct:
            q = self._newton(q, path.at(end))
            self._clock.add("correction")
        return Moved(q, state.control_vertices, state.torsion)

    def _carried(self, system: Linear, before: Array, after: Array) -> Linear:
        """Return the rest of the system after the base has moved its nodes, among nodes (N, 3), m."""
        motion = after - before
        if self._has_bays:
            base_rate = truss_of(self.setup.arm).scatter.base_rate(system.gradient, motion)
            return system._replace(x_g=system.x_g - base_rate[self._fixed])
        return system._replace(
            x_e=system.x_e - system.tip @ motion[self.setup.arm.end_effector.nodes].ravel()
        )

    def _displaced(self, q: Array, moved: Array) -> Array:
        """Return the configuration after displacements of its nodes, or of its actuators."""
        arm = self.setup.arm
        if not self._has_bays:
            return arm.advanced(q, np.zeros(0), moved)
        q = np.array(q)
        q[arm.free] += moved.reshape(-1, 3)
        return q

    def _linear(self, q: Array, goal: TipGoal) -> Linear:
        """Return the system at a configuration whose base rests, J d = x, eqs. (25) and (27).

        The right-hand side is the `goal`'s rates over the step, and zero for fixed quantities. With
        corrections it is the errors of tip and fixed quantities.
        """
        setup, kinematics = self.setup, self.setup.kinematics
        kinematics.evaluate(q)
        tip = setup.task.rows(setup.arm.nodes(q), kinematics, goal)
        gradient = kinematics.gradient if self._has_bays else kinematics.motion().response()[0]
        missing = self._lengths - kinematics.quantities[self._fixed]
        if self._correct:
            return Linear(gradient, tip.jacobian, tip.error, missing)
        return Linear(gradient, tip.jacobian, tip.rate, np.zeros_like(missing))

    def _newton(self, q: Array, goal: TipGoal) -> Array:
        """Return `q` with fixed quantities and tip corrected.

        By Newton's method with the same pseudoinverse, without gradients of the null-space terms.
        """
        terms = self._terms.without_gradients()
        for _ in range(MAX_CORRECTIONS):
            system = self._linear(q, goal)
            worst = float(np.max(np.abs(system.x_g), initial=0.0))
            if worst <= LENGTH_TOLERANCE and float(np.max(np.abs(system.x_e))) <= TIP_TOLERANCE:
                return q
            if not worst < 1e3:
                break
            q = self._displaced(q, self._solution.displacement(system, terms))
        raise SolverError("Newton's method on lengths and tip does not converge")
