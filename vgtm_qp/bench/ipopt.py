"""A step as one nonlinear program over the node positions, by IPOPT: the yardstick of general-purpose optimisation.

Its structure is fixed: it is built once and started from the last answer. Clearances enter linearised, as they do in
the QP. With exact distances, and rebuilt when the near pairs change, it would take several times as long.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.arrays import Array
from vgtm_qp.bench.tour import Goal
from vgtm_qp.methods.resolver import arm_without_curve
from vgtm_qp.problem import Problem
from vgtm_qp.rows.clearance import clearance_rows
from vgtm_qp.rows.limits import actuator_box
from vgtm_qp.step.state import State

_PAIRS = 24
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


class NonlinearStep:
    """Steps of a truss of pin joints whose base is at rest: exact lengths and tip, the QP's truss terms."""

    def __init__(self, problem: Problem) -> None:
        self._setup = setup = arm_without_curve(problem)
        truss, weights = truss_of(setup.arm), problem.method.weights
        actuators = truss.actuators.tolist()
        free = 3 * len(truss.free)
        x, x0 = ca.SX.sym("x", free), ca.SX.sym("x0", free)
        goal, across = ca.SX.sym("goal", 3), ca.SX.sym("across", 2, 3)
        rows = ca.SX.sym("rows", _PAIRS, free)
        nodes = ca.SX(ca.DM(truss.home.T))
        nodes[:, truss.free.tolist()] = ca.reshape(x, 3, -1)
        lengths = ca.vertcat(*(ca.norm_2(nodes[:, i] - nodes[:, j]) for i, j in truss.members.tolist()))
        before = ca.substitute(lengths, x, x0)
        corners = nodes[:, truss.tip.tolist()]
        end = (corners @ truss.tip_weights - goal)[setup.task.axes.tolist()]
        if setup.task.turns:
            # The normal of the tip's triangle is the z-axis of its frame.
            normal = ca.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            end = ca.vertcat(end, across @ normal)
        changed = (lengths - before)[actuators]
        off_home = lengths[actuators] - setup.arm.home_quantities[truss.actuators]
        objective = 0.5 * (
            weights.node_rate * ca.sumsqr(x - x0)
            + weights.actuator_rate * ca.sumsqr(changed)
            + weights.stroke_centring * ca.sumsqr(off_home)
        )
        parameters = ca.vertcat(x0, goal, ca.vec(across), ca.vec(rows))
        g = ca.vertcat(lengths, end, rows @ (x - x0))
        self._solver = ca.nlpsol("step", "ipopt", {"x": x, "p": parameters, "f": objective, "g": g}, _OPTIONS)
        self._ends = int(end.numel())
        self._rows = np.zeros((_PAIRS, free))
        self._multipliers = np.zeros(free), np.zeros(int(g.numel()))
        self._state = setup.home_state()

    def place(self, state: State) -> None:
        """See :class:`~vgtm_qp.bench.contestants.Contestant`."""
        self._state = state

    def step(self, goal: Goal) -> bool:
        """See :class:`~vgtm_qp.bench.contestants.Contestant`; False where IPOPT fails."""
        setup, state = self._setup, self._state
        truss, actuators = truss_of(setup.arm), setup.arm.actuators
        here, pose = state.nodes[truss.free].reshape(-1), goal.pose
        lower, upper = setup.arm.home_quantities.copy(), setup.arm.home_quantities.copy()
        limits = truss.stroke[actuators], truss.rate[actuators], truss.acceleration[actuators]
        lower[actuators], upper[actuators] = actuator_box(
            state.quantities[actuators], state.rates[actuators], *limits, setup.dt, state.duration or None
        )
        floors = self._clearances(state)
        zero = np.zeros(self._ends)
        across = pose.rotation[:, :2].T
        moved = state.motion[truss.free].reshape(-1)
        answer = self._solver(
            x0=here + moved,
            p=np.concatenate([here, pose.position, across.T.reshape(-1), self._rows.T.reshape(-1)]),
            lbg=np.concatenate([lower, zero, floors]),
            ubg=np.concatenate([upper, zero, np.full(_PAIRS, np.inf)]),
            lam_x0=self._multipliers[0],
            lam_g0=self._multipliers[1],
        )
        if not self._solver.stats()["success"]:
            return False
        self._multipliers = np.asarray(answer["lam_x"]).reshape(-1), np.asarray(answer["lam_g"]).reshape(-1)
        self.reached = np.array(state.nodes)
        self.reached[truss.free] = np.asarray(answer["x"]).reshape(-1, 3)
        return True

    def _clearances(self, state: State) -> Array:
        """Write the rows of the nearest pairs; return their lower bounds (24,), m. Unused rows are zero."""
        setup = self._setup
        near = setup.monitor.near(setup.arm.points(state.q), state.time, setup.influence)
        coefficients, lower = clearance_rows(
            near.distance, near.normal, near.weights, near.is_self, setup.safe, setup.self_safe
        )
        nearest = np.argsort(-lower)[:_PAIRS]
        self._rows[:] = 0.0
        floors = np.full(_PAIRS, -1.0)
        floors[: len(nearest)] = np.minimum(lower[nearest], 0.0)
        first = setup.layout.node_column[near.points[nearest]]
        row, slot = np.nonzero(first >= 0)
        columns = first[row, slot][:, None] + np.arange(3)
        np.add.at(self._rows, (row[:, None], columns), coefficients[nearest[row], slot])
        return floors
