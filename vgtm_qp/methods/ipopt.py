"""A step as one nonlinear program, by IPOPT: the yardstick of general-purpose optimisation, for every arm.

Quantities and tip are exact, clearances linear, as they are in the QP. The program's structure is fixed: it is built
once and started from the last answer. It knows no curve.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from vgtm_qp.arm.arm import tip_frames
from vgtm_qp.arm.symbols import Constants, goal_after
from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import SolverError
from vgtm_qp.methods.resolver import MethodResolver, Moved
from vgtm_qp.problem import Problem
from vgtm_qp.rows.tip import TipGoal, axes, turned_axes
from vgtm_qp.step.actuation import Bounds, within
from vgtm_qp.step.advance import SMALLEST, TRUST
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.path import Path
from vgtm_qp.step.separation import Separation
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import Shortfall, State
from vgtm_qp.step.step import Step

_OPTIONS: dict[str, Any] = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-9,
    "ipopt.constr_viol_tol": 1e-10,
    # The bounds are those of the arm, not relaxed ones.
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.max_iter": 200,
    "ipopt.warm_start_init_point": "yes",
    "ipopt.warm_start_bound_push": 1e-6,
    "ipopt.warm_start_slack_bound_push": 1e-6,
    "ipopt.warm_start_mult_bound_push": 1e-6,
    "ipopt.mu_init": 1e-4,
}

_PAIRS = 60
_ROUNDS = 8
"""Greatest number of rows of pairs, and of programs until the exact clearances hold."""

_ARRIVED = 1e-7
"""Share of a piece that an interior point leaves uncovered at its end."""


class ProgramAnswer(NamedTuple):
    """Displacements of the free nodes of a truss, m, or of actuators, and the progress, 0 to 1."""

    displacement: Array
    progress: float


class NonlinearProgram:
    """A step of one arm over the positions of its free nodes, or in joint space over its actuators.

    The objective has the QP's terms of the arm, of the progress of a scaled tip, and of the slacks of an elastic one; a
    hard tip has neither. There are `most` rows of clearance.
    """

    def __init__(self, setup: Setup, most: int, tip_mode: str) -> None:
        self._setup, self._most = setup, most
        arm, layout, names, constants = setup.arm, setup.layout, setup.task.row_names, Constants()
        weights, symbols, tip = layout.weights, arm.symbols(constants), arm.end_effector
        self._in_joints, self._ends = arm.bays is None, len(names)
        self.size = size = len(arm.actuators) if self._in_joints else 3 * len(arm.free)
        self._progress, self._slacks = int(tip_mode == "scaled"), 2 * len(names) * (tip_mode == "elastic")
        start, d = ca.MX.sym("start", *symbols.shape), ca.MX.sym("d", size)
        alpha, slack = ca.MX.sym("alpha", self._progress), ca.MX.sym("slack", self._slacks)
        push, rows = ca.MX.sym("push"), ca.MX.sym("rows", most, size)
        goal, turned = ca.MX.sym("goal", 3), ca.MX.sym("turned", 3, 3)
        velocity, spin = ca.MX.sym("velocity", 3), ca.MX.sym("spin", 3)

        q, actuators = symbols.along(start, d), arm.actuators.tolist()
        X, quantities, wanted, frame = symbols.nodes(q), symbols.quantities(q), goal, turned
        if self._progress:
            wanted, frame = goal_after(goal, turned, velocity, spin, alpha - 1.0)
        end = (X[:, tip.nodes.tolist()] @ ca.DM(tip.weights) - wanted)[axes(names)]
        if setup.task.turns:
            rotation = tip_frames(arm, constants).rotations(X)
            # The axis of the turn to the goal by its sine, or of three turns by two thirds of it.
            columns = [2] if setup.task.turns == "pointing" else [0, 1, 2]
            twist = sum(ca.cross(frame[:, k], rotation[:, k]) for k in columns) / len(columns)
            end = ca.vertcat(end, turned_axes(names, frame) @ twist)
        if self._slacks:
            end -= slack[: len(names)] - slack[len(names) :]
        moved = (X - symbols.nodes(start))[:, arm.free.tolist()]
        changed = (quantities - symbols.quantities(start))[actuators]
        off_home = (quantities - ca.DM(arm.home_quantities))[actuators]
        levers, penalty = ca.DM(arm.levers), weights.end_effector * arm.unit
        objective = 0.5 * (
            weights.node_rate * ca.sumsqr(moved)
            + weights.actuator_rate * ca.sumsqr(levers * changed)
            + weights.stroke_centring * ca.sumsqr(levers * off_home)
            + push * ca.sumsqr(alpha - 2.0)
        ) + penalty * ca.dot(ca.DM(np.resize(layout.tip_levers, self._slacks)), slack)
        # In joint space actuators are unknowns, and bounded as such.
        held = ca.MX(0, 1) if self._in_joints else quantities
        unknown, given = [d, alpha, slack], [start, goal, turned, velocity, spin, push, rows]
        results = [objective, ca.vertcat(held, end, rows @ d)]
        whole = ca.Function("whole", [*unknown, *given, *constants.symbols], results).expand()
        inputs = whole.sx_in()[: len(unknown) + len(given)]
        values = (
            ca.reshape(ca.DM(v), *s.shape) for v, s in zip(constants.values, constants.symbols, strict=True)
        )
        f, g = whole(*inputs, *values)
        x, p = ca.veccat(*inputs[: len(unknown)]), ca.veccat(*inputs[len(unknown) :])
        vectors = {"x": x, "p": p, "f": f, "g": g}
        self._solver = ca.nlpsol("step", "ipopt", vectors, _OPTIONS)
        self._multipliers = np.zeros(x.numel()), np.zeros(g.numel())

    def answer(
        self,
        start: Array,
        box: Bounds,
        goal: TipGoal,
        rows: Array,
        floors: Array,
        guess: Array,
        push: float = 0.0,
    ) -> ProgramAnswer | None:
        """Return the displacement from a configuration whose base has moved already; None where IPOPT fails.

        Parameters
        ----------
        box
            Least and greatest values (n_a,) of the actuators.
        goal
            The tip's goal, with rates over the piece of path that leads there.
        rows, floors : (R, n), (R,)
            Rows over displacements (n,) and their lower bounds, m; the `most` highest bounds count.
        guess : (n,)
            Where the search begins.
        push
            Weight of the progress, m^2.
        """
        arm, actuators, most = self._setup.arm, self._setup.arm.actuators, self._most
        nearest = np.argsort(-floors)[:most]
        table, least = np.zeros((most, self.size)), np.full(most, -1.0)
        table[: len(nearest)], least[: len(nearest)] = rows[nearest], floors[nearest]
        low, high, held = np.full(self.size, -np.inf), np.full(self.size, np.inf), (np.zeros(0), np.zeros(0))
        if self._in_joints:
            values = arm.measured(start)[actuators]
            low, high = box[0] - values, box[1] - values
        else:
            held = arm.home_quantities.copy(), arm.home_quantities.copy()
            held[0][actuators], held[1][actuators] = box
        whole, none, zero = np.ones(self._progress), np.zeros(self._slacks), np.zeros(self._ends)
        place = [start.reshape(-1), goal.position, goal.rotation.T.reshape(-1), goal.velocity, goal.spin]
        found = self._solver(
            x0=np.concatenate([np.clip(guess, low, high), whole, none]),
            p=np.concatenate([*place, [push], table.T.reshape(-1)]),
            lbx=np.concatenate([low, 0.0 * whole, none]),
            ubx=np.concatenate([high, whole, none + np.inf]),
            lbg=np.concatenate([held[0], zero, least]),
            ubg=np.concatenate([held[1], zero, np.full(most, np.inf)]),
            lam_x0=self._multipliers[0],
            lam_g0=self._multipliers[1],
        )
        if not self._solver.stats()["success"]:
            return None
        self._multipliers = np.asarray(found["lam_x"]).reshape(-1), np.asarray(found["lam_g"]).reshape(-1)
        x = np.asarray(found["x"]).reshape(-1)
        return ProgramAnswer(x[: self.size], float(x[self.size]) if self._progress else 1.0)

    def rows_over(self, q: Array, nodes: Index, coefficients: Array) -> Array:
        """Return rows (R, n) over the unknown displacements from rows over those of `nodes` (R, S)."""
        setup = self._setup
        table = np.zeros((len(nodes), setup.layout.node_columns))
        first = setup.layout.node_column[nodes]
        row, slot = np.nonzero(first >= 0)
        np.add.at(table, (row[:, None], first[row, slot][:, None] + np.arange(3)), coefficients[row, slot])
        if not self._in_joints:
            return table
        setup.kinematics.evaluate(q)
        return np.asarray(table @ setup.kinematics.motion().response()[0])

    def displacement(self, motion: Array) -> Array:
        """Return the unknowns (n,) of a displacement of the configuration."""
        arm = self._setup.arm
        return motion[arm.actuators] if self._in_joints else motion[arm.free].reshape(-1)

    def moved(self, start: Array, displacement: Array) -> Array:
        """Return the configuration after a displacement."""
        arm = self._setup.arm
        nodes = np.zeros((len(arm.node_names), 3))
        if not self._in_joints:
            nodes[arm.free] = displacement.reshape(-1, 3)
        return arm.advanced(start, nodes, displacement)


class NonlinearResolver(MethodResolver):
    """Moves an arm by one nonlinear program a step: the states keep all that the problem asks for, but for the curve.

    The rows of clearance are those of the QP, at the start of the step, and again at the answer until that is exact. If
    a step fails and the tip may slow down, half of its piece is tried within a trust region, and so on. Nothing is
    asked of the motion between two states.

    Raises
    ------
    ProblemError
        The arm cannot be built.
    """

    def __init__(self, problem: Problem) -> None:
        super().__init__(build_arm(problem, solves=False))
        self._program = NonlinearProgram(self.setup, _PAIRS, self.setup.tip_mode)
        self._separation = Separation(self.setup)
        self._share = self._progress = 1.0

    def too_near(self, state: State) -> Shortfall:
        """See :class:`~vgtm_qp.step.resolver.Resolver`."""
        return self._separation.shortfall(state.q, state.time)

    def _follow(self, path: Path, start: float, end: float, dt: float, whole: float) -> Step:
        """See :class:`~vgtm_qp.step.resolver.Resolver`; a tip that may slow down covers a part of its piece."""
        may_slow, self._share = self.setup.tip_mode == "scaled", 1.0
        while True:
            step = super()._follow(path, start, start + self._share * (end - start), dt, whole)
            if step.moved:
                return step.over(self._share * self._progress, None)
            if not may_slow or self._share <= SMALLEST:
                return step
            self._share /= 2.0

    def _move(self, path: Path, start: float, end: float, dt: float) -> Moved:
        setup, state, program = self.setup, self.state, self._program
        goal, time = path.at(end).over(end - start), state.after(dt)[0]
        base = setup.base_at(time)
        origin = state.q if base is None else setup.arm.based(state.q, base)
        short, box = self.too_near(state), self._box(state, dt)
        position, rotation = setup.arm.end_effector.position(state.nodes), path.at(start).rotation
        push = setup.layout.weights.progress * setup.task.residual(position, rotation, goal)[3]
        q, displacement = origin, np.zeros(program.size)
        guess = program.displacement(state.motion)
        found = self._separation.rows(q, time, 0.0, setup.influence, short, 0.0)
        for _ in range(_ROUNDS):
            rows = program.rows_over(q, found.nodes, found.coefficients)
            floors = found.lower + rows @ displacement
            answer = program.answer(origin, box, goal, rows, floors, guess, push)
            if answer is None:
                raise SolverError("IPOPT finds no answer")
            displacement = guess = answer.displacement
            q = program.moved(origin, displacement)
            found = self._separation.rows(q, time, 0.0, setup.influence, short, 0.0)
            if found.lower.max(initial=0.0) <= 0.5 * setup.margin:
                self._progress = 1.0 if answer.progress > 1.0 - _ARRIVED else answer.progress
                return Moved(q, state.control_vertices, state.torsion)
        raise SolverError(f"the clearances do not hold after {_ROUNDS} programs")

    def _box(self, state: State, dt: float) -> Bounds:
        """Return the box of the actuators after a step, for a share of it within a trust region."""
        arm, box = self.setup.arm, self._actuation.box(state, dt)
        if self._share == 1.0:
            return box
        return within(box, self._actuation.values(state), self._share * TRUST * arm.unit / arm.levers)

    def _refuse_breakdown(self, nodes: Array, path: Path, start: float, end: float) -> None:  # noqa: ARG002
        """Raise SolverError if a node moves further than the problem allows; nothing is linear here."""
        if too_long := self.setup.too_long(nodes - self.state.nodes):
            raise SolverError(too_long)
