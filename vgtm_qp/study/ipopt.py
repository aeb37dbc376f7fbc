"""The yardstick: each step as a nonlinear program over the node positions, solved by CasADi and IPOPT.

Distances to boxes and between members enter through their dual, a separating direction for each near pair, which is
smooth and exact. Nothing else of this package's resolver is used, but for which pairs are near.
"""

from __future__ import annotations

from dataclasses import replace
from time import process_time
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.truss.kinematics import joint_frame
from vgtm_qp.geometry.clearance import Contacts
from vgtm_qp.maneuver.plan import Plan
from vgtm_qp.step.arm import Arm
from vgtm_qp.step.path import PathPoint
from vgtm_qp.step.state import State, frozen

Array = NDArray[np.float64]

BETWEEN = 0.01
"""What it may pass `safe` by between two states, m: it sees the states alone."""

_MARGIN = 1e-6
_RESOLVES = 3
_OPTIONS: dict[str, Any] = {
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-9,
    "ipopt.constr_viol_tol": 1e-10,
    "ipopt.acceptable_constr_viol_tol": 1e-9,
    "ipopt.max_iter": 150,
    "ipopt.max_cpu_time": 10.0,
    "ipopt.mu_init": 1e-3,
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.honor_original_bounds": "yes",
}


class IpoptStepper:
    """Solves steps of an arm among boxes; elastic and scaled goals are not its business."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        truss = arm.truss
        self._columns = {int(node): 3 * k for k, node in enumerate(truss.free)}
        self._x = ca.SX.sym("x", 3 * len(truss.free))
        nodes: list[ca.SX] = [
            self._x[self._columns[n] : self._columns[n] + 3]
            if n in self._columns
            else ca.SX(ca.DM(truss.home[n]))
            for n in range(truss.node_count)
        ]
        self._nodes = nodes
        self._ends = _member_ends(arm, nodes)
        self._lengths = ca.vertcat(*(ca.norm_2(a - b) for a, b in self._ends))
        self._tip = sum(w * nodes[n] for w, n in zip(truss.tip_weights, truss.tip, strict=True))

    def run(self, plan: Plan, halvings: int = 2, budget: float = 120.0) -> tuple[list[State], list[float]]:
        """Return the states along `plan` and the path values they stand at, up to where a step fails.

        `budget` is the CPU time, s, after which it gives up.
        """
        started = process_time()
        state = self.arm.home_state()
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

    def _step(self, state: State, goal: PathPoint, duration: float) -> State | None:
        arm = self.arm
        truss, monitor = arm.truss, arm.monitor
        tip = truss.tip_weights @ state.nodes[truss.tip]
        reach = 1.5 * float(np.linalg.norm(goal.position - tip)) + 0.1
        time = state.time + duration
        for _ in range(_RESOLVES):
            pairs = monitor.near(
                arm.points(state.nodes),
                state.time,
                arm.safe + reach,
                self_reach=arm.self_safe + reach,
                fcl_reach=0.0,
            )
            X = self._solve(state, goal, duration, pairs)
            if X is None or not self._close(X):
                return None
            if monitor.keeps(arm.points(X), time, arm.safe - 1e-9, arm.self_safe - 1e-9):
                floors = (arm.safe - BETWEEN, arm.self_safe - BETWEEN)
                way = arm.points(state.nodes), arm.points(X)
                if not monitor.between(*way, state.time, time, *floors).certified:
                    return None
                arm.kinematics.evaluate(X)
                lengths = frozen(arm.kinematics.lengths)
                rates = frozen((lengths - state.lengths) / duration)
                return replace(state, time=time, nodes=frozen(X), lengths=lengths, length_rates=rates)
            reach *= 2.0
        return None

    def _solve(self, state: State, goal: PathPoint, duration: float, pairs: Contacts) -> Array | None:
        arm = self.arm
        truss = arm.truss
        actuators = truss.actuators
        start = state.nodes[truss.free].reshape(-1)
        lower, upper = arm.home_lengths.copy(), arm.home_lengths.copy()
        room = truss.rate[actuators] * duration
        lower[actuators] = np.maximum(truss.stroke[actuators, 0], state.lengths[actuators] - room) + 1e-10
        upper[actuators] = np.minimum(truss.stroke[actuators, 1], state.lengths[actuators] + room) - 1e-10
        target, zero = self._goal_rows(goal)
        g, lbg, ubg = [self._lengths, target], [lower, zero], [upper, zero]
        variables, first = [self._x], [start]
        for k in range(len(pairs)):
            v, v0, rows, bounds = self._pair(pairs, k, state.time + duration)
            variables.append(v)
            first.append(v0)
            g.append(rows)
            lbg.append(bounds)
            ubg.append(np.full(len(bounds), np.inf))
        change = self._x - start
        home = self._lengths[actuators.tolist()] - arm.home_lengths[actuators]
        objective = 0.5 * ca.dot(change, change) + 0.01 * ca.dot(home, home)
        problem = {"x": ca.vertcat(*variables), "f": objective, "g": ca.vertcat(*g)}
        solver = ca.nlpsol("step", "ipopt", problem, _OPTIONS)
        answer = solver(x0=np.concatenate(first), lbg=np.concatenate(lbg), ubg=np.concatenate(ubg))
        if not solver.stats()["success"]:
            return None
        X = np.array(state.nodes)
        X[truss.free] = np.asarray(answer["x"]).reshape(-1)[: len(start)].reshape(-1, 3)
        return X

    def _goal_rows(self, goal: PathPoint) -> tuple[ca.SX, Array]:
        task = self.arm.task
        rows = [(self._tip - goal.position)[task.axes.tolist()]]
        count = len(task.axes)
        if task.turns:
            # The frame's normal is that of the tip's triangle in every module.
            corner = [self._nodes[n] for n in self.arm.truss.tip]
            normal = ca.cross(corner[1] - corner[0], corner[2] - corner[0])
            home = self.arm.truss.home[self.arm.truss.tip]
            wanted = (
                goal.rotation @ self.arm.truss.tip_frame.T @ np.cross(home[1] - home[0], home[2] - home[0])
            )
            wanted /= np.linalg.norm(wanted)
            across = np.linalg.svd(wanted[None])[2][1:]
            rows.append(ca.DM(across) @ normal)
            count += 2
        return ca.vertcat(*rows), np.zeros(count)

    def _pair(self, pairs: Contacts, k: int, time: float) -> tuple[ca.SX, Array, ca.SX, Array]:
        """Return the dual variables of a pair, their first values, and rows with their lower bounds."""
        arm, truss = self.arm, self.arm.truss
        member, other = int(pairs.body[k]), int(pairs.other[k])
        a = self._ends[member]
        if pairs.is_self[k]:
            n = ca.SX.sym("n", 3)
            gap = arm.self_safe + truss.radius[member] + truss.radius[other] + _MARGIN
            rows = [ca.dot(n, p - q) for p in a for q in self._ends[other]]
            return n, pairs.normal[k], ca.vertcat(*rows, 1.0 - ca.dot(n, n)), np.r_[np.full(4, gap), 0.0]
        piece = arm.monitor.pieces.at(time)[other]
        center, half, rotation = _box(piece)
        v = ca.SX.sym("v", 6)
        n = v[:3] - v[3:]
        support = ca.dot(half, v[:3] + v[3:])
        rows = [ca.dot(n, ca.DM(rotation.T) @ (p - center)) - support for p in a]
        local = rotation.T @ pairs.normal[k]
        first = np.concatenate([np.maximum(local, 0.0), np.maximum(-local, 0.0)]) + 1e-3
        gap = arm.safe + truss.radius[member] + _MARGIN
        return v, first, ca.vertcat(*rows, 1.0 - ca.dot(n, n), v), np.r_[gap, gap, np.zeros(7)]

    def _close(self, X: Array) -> bool:
        """Newton on the fixed lengths alone, the actuated ones kept; True where they close."""
        arm = self.arm
        wanted = arm.home_lengths.copy()
        for _ in range(4):
            arm.kinematics.evaluate(X)
            wanted[arm.truss.actuators] = arm.kinematics.lengths[arm.truss.actuators]
            error = wanted - arm.kinematics.lengths
            if float(np.max(np.abs(error))) < 1e-10:
                return True
            jacobian = arm.layout.length_jacobian(arm.kinematics.gradient)
            try:
                X[arm.truss.free] += np.linalg.solve(jacobian, error).reshape(-1, 3)
            except np.linalg.LinAlgError:
                return False
        return False


def _member_ends(arm: Arm, nodes: list[ca.SX]) -> list[tuple[ca.SX, ca.SX]]:
    truss = arm.truss
    if truss.joints is None:
        return [(nodes[i], nodes[j]) for i, j in truss.members]
    frames = [joint_frame(*(nodes[n] for n in corner)) for corner in truss.joints.triangle]
    return [
        (
            nodes[i] + ca.mtimes(frames[i], ca.DM(truss.joints.offset[m, 0])),
            nodes[j] + ca.mtimes(frames[j], ca.DM(truss.joints.offset[m, 1])),
        )
        for m, (i, j) in enumerate(truss.members)
    ]


def _box(piece: Array) -> tuple[Array, Array, Array]:
    """Return centre, half edges and rotation of a box from its row of parameters."""
    return piece[:3], piece[12:15], piece[3:12].reshape(3, 3)
