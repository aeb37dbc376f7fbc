"""What is wrong with a problem although each value is right: told from the home pose, before any step."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from vgtm_qp.arm.truss.mobility import RANK_TOLERANCE, actuator_response, describe
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.curve.redundancy import BASE_ROWS, excess_freedom
from vgtm_qp.errors import Mistake
from vgtm_qp.geometry.bodies import capsules
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.problem import Problem, read_path
from vgtm_qp.problem.goal import PathManeuver, WaypointManeuver
from vgtm_qp.problem.table import Place, shown
from vgtm_qp.step.arm import Arm
from vgtm_qp.step.path import PathPoint

Array = NDArray[np.float64]

_POINT = 1e-6
"""Length of the member that stands for a point, m; distances are told to no more digits."""


def check_problem(problem: Problem, arm: Arm) -> list[Mistake]:
    """Return what makes a problem hopeless: each is proven, so none refuses a problem that has a solution.

    An obstacle, or a member that shares no node, inside the arm at home; a target farther from the base than
    the members can be long; a target so deep inside an obstacle that no tip can be there.
    """
    mistakes = [mistake for distance, mistake in _at_home(problem, arm) if distance <= 0.0]
    return [
        *unreachable_tip(problem, arm),
        *mistakes,
        *_out_of_reach(problem, arm),
        *_inside_obstacles(problem, arm, _hollow(arm.truss)),
    ]


def unreachable_tip(problem: Problem, arm: Arm) -> Iterator[Mistake]:
    """Yield the tracked coordinates of the end effector if the actuators cannot change them all, each on its own.

    To first order at the home pose: eq. (6) holds at full row rank only. A straight octahedral arm cannot roll.
    """
    truss, task = arm.truss, arm.task
    goal = PathPoint(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    arm.kinematics.evaluate(truss.home)
    jacobian = task.rows(truss.home, goal).jacobian
    rows = np.zeros((len(jacobian), truss.node_count, 3))
    rows[:, truss.tip] = jacobian.reshape(len(jacobian), -1, 3)
    response = actuator_response(truss, rows)
    response[len(task.axes) :] *= truss.height
    values = np.linalg.svd(response, compute_uv=False)
    rank = int(np.count_nonzero(values > RANK_TOLERANCE * values.max(initial=0.0)))
    if rank < len(jacobian):
        reasons = "; ".join(describe(truss).unreachable)
        found = f"this arm at home has rank {rank} of {len(jacobian)} in these"
        why = f" and cannot start: {reasons}" if reasons else ""
        yield problem.mistake(
            ("end_effector", "track"), f"coordinates that the actuators can change one by one; {found}{why}"
        )


def find_warnings(problem: Problem, arm: Arm) -> list[Mistake]:
    """Return what makes a problem suspicious: a home pose nearer than ``safe``, a target at an obstacle.

    The resolver moves the arm away from what is too near at home, and a tip of three nodes may surround what
    its centre is in.
    """
    certain = {mistake.key for mistake in check_problem(problem, arm)}
    warnings = [mistake for distance, mistake in _at_home(problem, arm) if distance > 0.0]
    doubtful = [mistake for mistake in _inside_obstacles(problem, arm, 0.0) if mistake.key not in certain]
    return [*warnings, *doubtful, *excess_of_freedom(problem, arm)]


def excess_of_freedom(problem: Problem, arm: Arm) -> Iterator[Mistake]:
    """Yield the number of control vertices if the curve has more freedom than the arm that tracks it."""
    freedom = len(arm.truss.actuators)
    text = excess_freedom(arm.layout.free_curve, freedom)
    if text is not None:
        most = max((freedom + BASE_ROWS - arm.layout.torsion) // 3, 3)
        yield problem.mistake(("curve", "control_vertices"), f"{most} or fewer; {text}")


def longest_ways(truss: Truss, sources: NDArray[np.int64]) -> Array:
    """Return (S, N) bounds of the distances from nodes `sources` (S,) to all nodes in any pose, m.

    The shortest way along members that are all as long as they can be, joint offsets included; inf where
    there is none.
    """
    longest = truss.stroke[:, 1].copy()
    if truss.joints is not None:
        longest += np.linalg.norm(truss.joints.offset, axis=2).sum(axis=1)
    first, second = truss.members.T
    graph = sparse.coo_array((longest, (first, second)), shape=(truss.node_count, truss.node_count))
    return np.asarray(dijkstra(graph.tocsr(), directed=False, indices=sources))


def _at_home(problem: Problem, arm: Arm) -> Iterator[tuple[float, Mistake]]:
    """Yield least distance, m, and mistake of each obstacle too near at home, and of the members."""
    rules = problem.clearance
    safe = rules.safe
    self_safe = safe if rules.self_safe is None else rules.self_safe
    pairs = arm.monitor.near(arm.points(arm.truss.home), 0.0, reach=safe, self_reach=self_safe)
    names = arm.truss.member_names
    owner = np.where(pairs.is_self, -1, 0)
    owner[~pairs.is_self] = arm.monitor.pieces.obstacle[pairs.other[~pairs.is_self]]
    for index in np.unique(owner):
        rows = np.flatnonzero(owner == index)
        k = rows[np.argmin(pairs.distance[rows])]
        distance, member = float(pairs.distance[k]), names[pairs.body[k]]
        place: Place
        if index < 0:
            place, needed = ("truss", "member_radius"), self_safe
            what = f"members {member} and {names[pairs.other[k]]}, which share no node,"
        else:
            place, needed = ("obstacle", int(index), "center"), safe
            what = f"it and member {member}"
        found = (
            f"they overlap by {-distance:.3g} m" if distance <= 0.0 else f"they are {distance:.3g} m apart"
        )
        yield distance, problem.mistake(place, f"at least {needed:g} m between {what} at home; {found}")


def _targets(problem: Problem) -> Iterator[tuple[Array, str, str]]:
    """Yield each position that the tip is to reach (3,), its key path and its value as a person wrote it."""
    maneuver = problem.maneuver
    if isinstance(maneuver, WaypointManeuver):
        for i, waypoint in enumerate(maneuver.waypoint):
            if waypoint.position is not None:
                mistake = problem.mistake(("maneuver", "waypoint", i, "position"), "")
                yield np.asarray(waypoint.position), mistake.key, mistake.value
    elif isinstance(maneuver, PathManeuver):
        for row, position in enumerate(read_path(maneuver.path).position, start=1):
            yield position, f'maneuver.path "{maneuver.path}", row {row} of numbers', shown(position.tolist())


def _out_of_reach(problem: Problem, arm: Arm) -> Iterator[Mistake]:
    truss, axes = arm.truss, arm.task.axes
    if not len(axes) or (problem.truss and problem.truss.base_motion):
        return
    base = np.flatnonzero(truss.base)
    reach = longest_ways(truss, base)[:, truss.tip] @ np.abs(truss.tip_weights)
    for target, key, value in _targets(problem):
        distance = np.linalg.norm((target - truss.home[base])[:, axes], axis=1)
        k = int(np.argmax(distance - reach))
        if distance[k] > reach[k] + _POINT:
            node = f'base node "{truss.node_names[base[k]]}"'
            where = f"a position at most {reach[k]:.3f} m from {node}, all members at their longest"
            yield Mistake(key, value, f"{where}; this one is {distance[k]:.3f} m from it, out of any reach")


def _inside_obstacles(problem: Problem, arm: Arm, hollow: float) -> Iterator[Mistake]:
    """Yield the targets nearer to an obstacle at rest than clearance and radius of the tip less `hollow`."""
    obstacles = [obstacle for obstacle in arm.monitor.obstacles if not np.any(obstacle.velocity)]
    if len(arm.task.axes) < 3 or not obstacles:
        return
    truss, safe = arm.truss, problem.clearance.safe
    at_tip = np.isin(truss.members, truss.tip).any(axis=1)
    needed = safe + float(truss.radius[at_tip].min())
    point = Clearance(capsules([[0, 1]], 0.0), obstacles, safe=safe, influence=needed, self_collision=False)
    for target, key, value in _targets(problem):
        distance, pair = point.least(np.stack([target, target + _POINT / 2]))
        if pair is not None and distance + hollow + _POINT < needed:
            obstacle = obstacles[point.pieces.obstacle[pair.other]].name
            found = f"{-distance:.3g} m inside it" if distance <= 0.0 else f"{distance:.3g} m from it"
            expected = f'a position {needed:g} m from obstacle "{obstacle}" (clearance and member radius)'
            yield Mistake(key, value, f"{expected}; this one is {found}")


def _hollow(truss: Truss) -> float:
    """Return a bound of the distance from the tip's centre to the nearest point on the axis of a member, m.

    A tip of one node is on its members but for their joint offsets. The centroid of a triangle is no farther
    from its nearest edge than a third of the height of an equilateral one with edges as long as the longest;
    any other tip is bounded by its nodes.
    """
    tip = truss.tip
    offset = 0.0 if truss.joints is None else float(np.linalg.norm(truss.joints.offset, axis=2).max())
    if len(tip) == 1:
        return offset
    between = np.isin(truss.members, tip).all(axis=1)
    if (
        len(tip) == 3
        and np.count_nonzero(between) == 3
        and np.allclose(truss.tip_weights, 1.0 / 3.0)
        and not offset
    ):
        return float(truss.stroke[between, 1].max()) / (2.0 * math.sqrt(3.0))
    return float((longest_ways(truss, tip)[:, tip] @ np.abs(truss.tip_weights)).min()) + offset
