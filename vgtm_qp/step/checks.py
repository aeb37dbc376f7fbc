"""Mistakes of a problem whose values are each valid, found at the home pose before any step."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

import numpy as np

from vgtm_qp.arm.arm import GRAVITY, rank
from vgtm_qp.arrays import Array
from vgtm_qp.curve.redundancy import BASE_ROWS, excess_freedom
from vgtm_qp.errors import Mistake
from vgtm_qp.geometry.bodies import capsules
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.problem import Problem, read_path
from vgtm_qp.problem.goal import PathManeuver, WaypointManeuver
from vgtm_qp.problem.table import Place, shown
from vgtm_qp.qp.terms import Inequality, Objective
from vgtm_qp.rows.tip import TipGoal
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.task import tip_over_actuators

_LOG = logging.getLogger(__name__)

_POINT = 1e-6
"""Length of the member that stands for a point, over the arm's unit: distances are printed less precisely."""


def checked_arm(
    problem: Problem, objectives: Sequence[Objective] = (), rows: Sequence[Inequality] = ()
) -> Setup:
    """Return the arm of a problem, ready to move; warn of a curve with more freedom than the arm.

    For `objectives` and `rows` see :func:`build_arm`.

    Raises
    ------
    ProblemError
        The end effector is asked for coordinates that no actuator can start to change.
    """
    setup = build_arm(problem, objectives=objectives, rows=rows)
    mistakes = list(unreachable_tip(problem, setup))
    if mistakes:
        raise problem.error(mistakes)
    for excess in excess_of_freedom(problem, setup):
        _LOG.warning("%s = %s: %s", excess.key, excess.value, excess.expected)
    return setup


def check_problem(problem: Problem, setup: Setup) -> list[Mistake]:
    """Return the mistakes that make a problem impossible, each proven: no solvable problem is refused.

    These are overlaps at home of members with obstacles or other members; a target beyond the greatest reach
    of the members; and a target so deep inside an obstacle that no tip can be there.
    """
    mistakes = [mistake for distance, mistake in _at_home(problem, setup) if distance <= 0.0]
    return [
        *unreachable_tip(problem, setup),
        *mistakes,
        *_out_of_reach(problem, setup),
        *_inside_obstacles(problem, setup, setup.arm.hollow()),
    ]


def unreachable_tip(problem: Problem, setup: Setup) -> Iterator[Mistake]:
    """Yield the tracked coordinates of the end effector if the actuators cannot change them all, each on its own.

    To first order at the home pose: eq. (6) holds at full row rank only. A straight octahedral arm cannot roll.
    """
    arm, task, kinematics = setup.arm, setup.task, setup.kinematics
    goal = TipGoal(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))
    kinematics.evaluate(arm.home_configuration)
    jacobian = task.rows(arm.home, kinematics, goal).jacobian
    response = tip_over_actuators(arm, kinematics.motion(), jacobian)
    response[len(task.axes) :] *= arm.height
    values = np.linalg.svd(response, compute_uv=False)
    reached = rank(values)
    if reached < len(jacobian):
        reasons = "; ".join(arm.unreachable())
        found = f"this arm at home has rank {reached} of {len(jacobian)} in these"
        why = f" and cannot start: {reasons}" if reasons else ""
        yield problem.mistake(
            ("end_effector", "track"), f"coordinates that the actuators can change one by one; {found}{why}"
        )


def find_warnings(problem: Problem, setup: Setup) -> list[Mistake]:
    """Return suspicious values of a problem: a home pose nearer than ``safe``, a target at an obstacle, weak joints.

    None of them is impossible: the resolver moves the arm away from what is too near at home, and a tip of three nodes
    may surround an obstacle with its centre inside.
    """
    certain = {mistake.key for mistake in check_problem(problem, setup)}
    near = [mistake for distance, mistake in _at_home(problem, setup) if distance > 0.0]
    doubtful = [mistake for mistake in _inside_obstacles(problem, setup, 0.0) if mistake.key not in certain]
    weak = [*_weak_joints(problem, setup), *_joints_without_rate(problem)]
    return [*near, *doubtful, *weak, *excess_of_freedom(problem, setup)]


def _joints_without_rate(problem: Problem) -> Iterator[Mistake]:
    """Yield the URDF file whose joints have no velocity, or 0, which means no limit."""
    if problem.arm is None or problem.arm.urdf is None:
        return
    names = [joint.name for joint in problem.arm.joint if joint.rate is None and joint.mimic is None]
    if names:
        several = f"joints {', '.join(names)}" if len(names) > 1 else f"joint {names[0]}"
        expected = f"velocity limits greater than 0 in the file; {several} may move at any rate"
        yield problem.mistake(("arm", "urdf"), expected)


def _weak_joints(problem: Problem, setup: Setup) -> Iterator[Mistake]:
    """Yield the effort limits of joints that the arm's own weight surpasses at home."""
    arm = setup.arm
    if arm.effort is None or not arm.mass:
        return
    borne = np.abs(arm.forces(arm.home_configuration, np.zeros(3), gravity=GRAVITY))
    for k in np.flatnonzero(arm.actuated & (borne > arm.effort)).tolist():
        expected = (
            f"{borne[k]:.4g} or more, which joint {arm.quantity_names[k]} bears at home of the arm's weight"
        )
        yield problem.mistake(("arm", "joint", k, "effort"), expected)


def excess_of_freedom(problem: Problem, setup: Setup) -> Iterator[Mistake]:
    """Yield the number of control vertices if the curve has more freedom than the arm that tracks it."""
    freedom = len(setup.arm.actuators)
    text = excess_freedom(setup.layout.free_curve, freedom)
    if text is not None:
        most = max((freedom + BASE_ROWS - setup.layout.torsion) // 3, 3)
        yield problem.mistake(("curve", "control_vertices"), f"{most} or fewer; {text}")


def _at_home(problem: Problem, setup: Setup) -> Iterator[tuple[float, Mistake]]:
    """Yield least distance, m, and mistake of each obstacle too near at home, and of the members."""
    arm, bodies, rules = setup.arm, setup.arm.bodies, problem.clearance
    safe, self_safe = rules.safe, rules.between_members
    pairs = setup.monitor.near(arm.points(arm.home_configuration), 0.0, reach=safe, self_reach=self_safe)
    owner = np.where(pairs.is_self, -1, 0)
    owner[~pairs.is_self] = setup.monitor.pieces.obstacle[pairs.other[~pairs.is_self]]
    for index in np.unique(owner):
        rows = np.flatnonzero(owner == index)
        k = rows[np.argmin(pairs.distance[rows])]
        distance, body = float(pairs.distance[k]), bodies.called(int(pairs.body[k]))
        place: Place
        if index < 0:
            place = problem.arm_table.thickness if distance <= 0.0 else ("clearance", "self_safe")
            first, second = bodies.names[int(pairs.body[k])], bodies.names[int(pairs.other[k])]
            needed, what = self_safe, f"{bodies.kind}s {first} and {second}, which do not join,"
        else:
            place, needed, what = ("obstacle", int(index), "center"), safe, f"it and {body}"
        found = (
            f"they overlap by {-distance:.3g} m" if distance <= 0.0 else f"they are {distance:.3g} m apart"
        )
        yield distance, problem.mistake(place, f"at least {needed:g} m between {what} at home; {found}")


def _targets(problem: Problem) -> Iterator[tuple[Array, str, str]]:
    """Yield each target position of the tip (3,), its key path and its value as written in the file."""
    maneuver = problem.maneuver
    if isinstance(maneuver, WaypointManeuver):
        for i, waypoint in enumerate(maneuver.waypoint):
            if waypoint.position is not None:
                mistake = problem.mistake(("maneuver", "waypoint", i, "position"), "")
                yield np.asarray(waypoint.position), mistake.key, mistake.value
    elif isinstance(maneuver, PathManeuver):
        for row, position in enumerate(read_path(maneuver.path).position, start=1):
            yield position, f'maneuver.path "{maneuver.path}", row {row} of numbers', shown(position.tolist())


def _out_of_reach(problem: Problem, setup: Setup) -> Iterator[Mistake]:
    arm, axes = setup.arm, setup.task.axes
    if not len(axes) or setup.base_motion is not None:
        return
    base, reach = np.flatnonzero(arm.base), arm.reach()
    for target, key, value in _targets(problem):
        distance = np.linalg.norm((target - arm.home[base])[:, axes], axis=1)
        k = int(np.argmax(distance - reach))
        if distance[k] > reach[k] + _POINT * arm.unit:
            node = f'base node "{arm.node_names[base[k]]}"'
            where = (
                f"a position at most {reach[k]:.3f} m from {node}, all {arm.bodies.kind}s at their longest"
            )
            yield Mistake(key, value, f"{where}; this one is {distance[k]:.3f} m from it, out of any reach")


def _inside_obstacles(problem: Problem, setup: Setup, hollow: float) -> Iterator[Mistake]:
    """Yield the targets nearer to an obstacle at rest than clearance and radius of the tip less `hollow`."""
    obstacles = [obstacle for obstacle in setup.monitor.obstacles if not np.any(obstacle.velocity)]
    arm, safe = setup.arm, problem.clearance.safe
    at_tip = np.isin(arm.bodies.joints, arm.end_effector.nodes).any(axis=1)
    if len(setup.task.axes) < 3 or not obstacles or not at_tip.any():
        return
    point_size = _POINT * arm.unit
    needed = safe + float(arm.bodies.radius[at_tip].min())
    spot = capsules([[0, 1]], 0.0)
    point = Clearance(spot, obstacles, safe=safe, influence=needed, self_collision=False, by_fcl=False)
    for target, key, value in _targets(problem):
        # Unlike a clearance, a contact has the depth of a point inside.
        contacts = point.near(np.stack([target, target + point_size / 2]))
        k = int(np.argmin(contacts.distance)) if len(contacts) else -1
        if k >= 0 and (distance := float(contacts.distance[k])) + hollow + point_size < needed:
            obstacle = obstacles[point.pieces.obstacle[contacts.other[k]]].name
            found = f"{-distance:.3g} m inside it" if distance <= 0.0 else f"{distance:.3g} m from it"
            expected = (
                f'a position {needed:g} m from obstacle "{obstacle}" (clearance and {arm.bodies.kind} radius)'
            )
            yield Mistake(key, value, f"{expected}; this one is {found}")
