"""The program with exact distances: a separating direction for each near pair, for the robustness study.

Distances to boxes and between members enter through their dual, which is smooth and exact. It uses nothing of
this package's resolver except the search for near pairs.
"""

from __future__ import annotations

from dataclasses import replace
from time import process_time
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.geometry.clearance import Contacts
from vgtm_qp.ipopt.symbols import OPTIONS, program_symbols
from vgtm_qp.maneuver.plan import Plan
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State, frozen

Array = NDArray[np.float64]

BETWEEN = 0.01
"""How far it may fall short of `safe` between two states, m: the program knows the states only."""

_MARGIN = 1e-6
_RESOLVES = 3
_OPTIONS: dict[str, Any] = {
    **OPTIONS,
    "ipopt.acceptable_constr_viol_tol": 1e-9,
    "ipopt.max_iter": 150,
    "ipopt.max_cpu_time": 10.0,
    "ipopt.mu_init": 1e-3,
    "ipopt.honor_original_bounds": "yes",
}


class IpoptStepper:
    """Solves steps of an arm among boxes; it knows neither elastic nor scaled goals."""

    def __init__(self, setup: Setup) -> None:
        self.setup = setup
        self._symbols = program_symbols(setup.truss)

    def run(self, plan: Plan, halvings: int = 2, budget: float = 120.0) -> tuple[list[State], list[float]]:
        """Return the states along `plan` and the path values they stand at, up to where a step fails.

        `budget` is the CPU time, s, after which it gives up.
        """
        started = process_time()
        state = self.setup.home_state()
        states, values = [state], [plan.path.start]
        for mark in plan.marks:
            while values[-1] < mark:
                share = 1.0
                while share >= 0.5**halvings and process_time() - started < budget:
                    value = values[-1] + share * (float(mark) - values[-1])
                    duration = share * float(mark - values[-1])
                    found = self._step(state, plan.path.at(value), duration)
                    if found is not None:
                        break
                    share /= 2.0
                else:
                    return states, values
                state = found
                states.append(state)
                values.append(value if share < 1.0 else float(mark))
        return states, values

    def _step(self, state: State, goal: TipGoal, duration: float) -> State | None:
        setup = self.setup
        monitor = setup.monitor
        tip = setup.arm.end_effector.position(state.nodes)
        reach = 1.5 * float(np.linalg.norm(goal.position - tip)) + 0.1
        time = state.time + duration
        for _ in range(_RESOLVES):
            pairs = monitor.near(
                setup.arm.points(state.q),
                state.time,
                setup.safe + reach,
                self_reach=setup.self_safe + reach,
                fcl_reach=0.0,
            )
            X = self._solve(state, goal, duration, pairs)
            if X is None or not self._close(X):
                return None
            points = setup.arm.points(X)
            if monitor.keeps(points, time, setup.safe - 1e-9, setup.self_safe - 1e-9):
                floors = (setup.safe - BETWEEN, setup.self_safe - BETWEEN)
                before = setup.arm.points(state.q)
                if not monitor.between(before, points, state.time, time, *floors).certified:
                    return None
                setup.kinematics.evaluate(X)
                lengths = frozen(setup.kinematics.quantities)
                rates = frozen((lengths - state.quantities) / duration)
                return replace(state, time=time, q=(q := frozen(X)), nodes=q, quantities=lengths, rates=rates)
            reach *= 2.0
        return None

    def _solve(self, state: State, goal: TipGoal, duration: float, pairs: Contacts) -> Array | None:
        setup = self.setup
        truss = setup.truss
        actuators = truss.actuators
        start = state.nodes[truss.free].reshape(-1)
        lower, upper = setup.arm.home_quantities.copy(), setup.arm.home_quantities.copy()
        room = truss.rate[actuators] * duration
        lower[actuators] = np.maximum(truss.stroke[actuators, 0], state.quantities[actuators] - room) + 1e-10
        upper[actuators] = np.minimum(truss.stroke[actuators, 1], state.quantities[actuators] + room) - 1e-10
        target, zero = self._goal_rows(goal)
        g, lbg, ubg = [self._symbols.lengths, target], [lower, zero], [upper, zero]
        variables, first = [self._symbols.x], [start]
        for k in range(len(pairs)):
            v, v0, rows, bounds = self._pair(pairs, k, state.time + duration)
            variables.append(v)
            first.append(v0)
            g.append(rows)
            lbg.append(bounds)
            ubg.append(np.full(len(bounds), np.inf))
        change = self._symbols.x - start
        home = self._symbols.lengths[actuators.tolist()] - setup.arm.home_quantities[actuators]
        objective = 0.5 * ca.dot(change, change) + 0.01 * ca.dot(home, home)
        problem = {"x": ca.vertcat(*variables), "f": objective, "g": ca.vertcat(*g)}
        solver = ca.nlpsol("step", "ipopt", problem, _OPTIONS)
        answer = solver(x0=np.concatenate(first), lbg=np.concatenate(lbg), ubg=np.concatenate(ubg))
        if not solver.stats()["success"]:
            return None
        X = np.array(state.nodes)
        X[truss.free] = np.asarray(answer["x"]).reshape(-1)[: len(start)].reshape(-1, 3)
        return X

    def _goal_rows(self, goal: TipGoal) -> tuple[ca.SX, Array]:
        task = self.setup.task
        rows = [(self._symbols.tip - goal.position)[task.axes.tolist()]]
        count = len(task.axes)
        if task.turns:
            # The frame's normal is that of the tip's triangle in every module.
            normal = self._symbols.tip_normal(self.setup.truss)
            home = self.setup.truss.home[self.setup.truss.tip]
            wanted = (
                goal.rotation @ self.setup.truss.tip_frame.T @ np.cross(home[1] - home[0], home[2] - home[0])
            )
            wanted /= np.linalg.norm(wanted)
            across = np.linalg.svd(wanted[None])[2][1:]
            rows.append(ca.DM(across) @ normal)
            count += 2
        return ca.vertcat(*rows), np.zeros(count)

    def _pair(self, pairs: Contacts, k: int, time: float) -> tuple[ca.SX, Array, ca.SX, Array]:
        """Return the dual variables of a pair, their first values, and rows with their lower bounds."""
        setup, truss = self.setup, self.setup.truss
        member, other = int(pairs.body[k]), int(pairs.other[k])
        a = self._symbols.ends[member]
        if pairs.is_self[k]:
            n = ca.SX.sym("n", 3)
            gap = setup.self_safe + truss.radius[member] + truss.radius[other] + _MARGIN
            rows = [ca.dot(n, p - q) for p in a for q in self._symbols.ends[other]]
            return n, pairs.normal[k], ca.vertcat(*rows, 1.0 - ca.dot(n, n)), np.r_[np.full(4, gap), 0.0]
        piece = setup.monitor.pieces.at(time)[other]
        center, half, rotation = _box(piece)
        v = ca.SX.sym("v", 6)
        n = v[:3] - v[3:]
        support = ca.dot(half, v[:3] + v[3:])
        rows = [ca.dot(n, ca.DM(rotation.T) @ (p - center)) - support for p in a]
        local = rotation.T @ pairs.normal[k]
        first = np.concatenate([np.maximum(local, 0.0), np.maximum(-local, 0.0)]) + 1e-3
        gap = setup.safe + truss.radius[member] + _MARGIN
        return v, first, ca.vertcat(*rows, 1.0 - ca.dot(n, n), v), np.r_[gap, gap, np.zeros(7)]

    def _close(self, X: Array) -> bool:
        """Newton on the fixed lengths alone, the actuated ones kept; True where they close."""
        setup = self.setup
        wanted = setup.arm.home_quantities.copy()
        for _ in range(4):
            setup.kinematics.evaluate(X)
            wanted[setup.truss.actuators] = setup.kinematics.quantities[setup.truss.actuators]
            error = wanted - setup.kinematics.quantities
            if float(np.max(np.abs(error))) < 1e-10:
                return True
            jacobian = setup.truss.scatter.dense(setup.kinematics.gradient)
            try:
                X[setup.truss.free] += np.linalg.solve(jacobian, error).reshape(-1, 3)
            except np.linalg.LinAlgError:
                return False
        return False


def _box(piece: Array) -> tuple[Array, Array, Array]:
    """Return centre, half edges and rotation of a box from its row of parameters."""
    return piece[:3], piece[12:15], piece[3:12].reshape(3, 3)
