"""From a problem to a ``Setup``, an arm ready to move: steps are computed from that without the problem.

Around the steps the problem is read again: by ``checks.py``, which finds its mistakes; by the resolvers in
``methods/``, for keys of their own; by ``Resolver.again``, which builds a resolver from another problem; and
by those who call for steps, for the maneuver.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from vgtm_qp.arm.arm import Arm, Kinematics
from vgtm_qp.arm.build import make_arm
from vgtm_qp.arm.carrying import Carrier
from vgtm_qp.arm.symbols import Constants
from vgtm_qp.arrays import Array
from vgtm_qp.curve.curve import Curve, straight_curve
from vgtm_qp.curve.families import CurveFamily, make_family
from vgtm_qp.errors import Mistake, PartError, nearest
from vgtm_qp.geometry import shapes
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.parts import find_part
from vgtm_qp.problem import Problem, read_path
from vgtm_qp.problem.fields import quoted
from vgtm_qp.problem.problem import check_is_problem
from vgtm_qp.qp.bays import BaySolver
from vgtm_qp.qp.condensed import CondensedSolver
from vgtm_qp.qp.fused import FusedSolver
from vgtm_qp.qp.layout import Layout, with_angles
from vgtm_qp.qp.long.select import STAGED_ACTUATORS, chain_solver, prefers_staged, prefers_sweeps
from vgtm_qp.qp.shape import CurveShape
from vgtm_qp.qp.solvers import DEFAULT_SOLVER, StepSolver, available_solvers, dense_solver, make_solver
from vgtm_qp.qp.terms import Inequality, Objective, OwnTerms
from vgtm_qp.rotation import rotation_from_vector
from vgtm_qp.rows import curve as curve_rows
from vgtm_qp.step.arrival import Arrival
from vgtm_qp.step.chain_engine import ChainEngine
from vgtm_qp.step.engine import Engine, FusedEngine, GeneralEngine
from vgtm_qp.step.path import base_motion
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.task import TipTask

_LOG = logging.getLogger(__name__)

_CONDENSED_ALL_THE_SAME = (
    "elastic end effector: the elimination along the bays does not know its slacks, so the QP is condensed onto the "
    "actuators, which takes longer on an arm of this length"
)


def build_arm(
    problem: Problem,
    *,
    solves: bool = True,
    objectives: Sequence[Objective] = (),
    rows: Sequence[Inequality] = (),
) -> Setup:
    """Return the arm of a problem, ready to move.

    If the caller never `solves` a QP, it gets the engine that is built fastest. `objectives` and `rows` of the user's
    own are for the QP of a whole arm.

    Raises
    ------
    ProblemError
        There is no such arm, or it cannot do at all what the problem asks for; each mistake is named.
    PartError
        An objective or a row is none of this arm, or a row is broken at home.
    """
    check_is_problem(problem)
    check_solver(problem)
    arm = make_arm(problem)
    kinematics = arm.kinematics()
    kinematics.evaluate(arm.home_configuration)
    with problem.blaming(("end_effector", "track"), "coordinates that this tip has"):
        task = TipTask(problem.end_effector.track, arm)
    with problem.blaming(("curve",), "a curve that starts in this arm's home pose"):
        home = home_curve(problem, arm, task)
    if objectives or rows:
        home = home._replace(layout=replace(home.layout, own=OwnTerms(arm, objectives, rows)))
    clearance, spec = problem.clearance, problem.arm_table
    solver, tracking = problem.method.solver, problem.method.tracking
    options: dict[str, Any] = {
        "obstacles": list(_obstacles(problem)),
        "safe": clearance.safe,
        "self_safe": clearance.between_members,
        "influence": clearance.influence,
        "by_fcl": clearance.distance == "fcl",
        "unit": arm.unit,
    }
    if solves:
        with problem.blaming(("method", "tracking"), '"coupled" or "none"'):
            engine = make_engine(solver, home.layout, kinematics, task, tracking)
    else:
        engine = GeneralEngine(home.layout, kinematics, task, CondensedSolver(home.layout), compiled=False)
    gives_way = home.layout.hard_tracking and problem.method.gives_way
    elastic = elastic_engine(solver, home.layout, kinematics, task) if gives_way else None
    monitor = Clearance(arm.bodies, self_collision=clearance.self_collision, **options)
    return Setup(
        arm=arm,
        carrier=Carrier(arm),
        kinematics=kinematics,
        layout=home.layout,
        task=task,
        engine=engine,
        elastic=elastic,
        monitor=monitor,
        solver=solver,
        tracking=tracking,
        control_vertices=home.vertices,
        torsion=home.torsion,
        vertex_goals=home.vertex_goals,
        influence=clearance.influence,
        margin=clearance.margin,
        dt=step_duration(problem.maneuver),
        minimum_angle=clearance.minimum_angle,
        step_limit=problem.method.step_limit or np.inf,
        tip_mode=problem.end_effector.mode,
        base_motion=base_motion(spec.base_motion) if spec.base_motion else None,
        slow_approach=problem.method.slow_approach,
        jams=tuple((lock.actuator, lock.time) for lock in spec.locked if lock.time > 0.0),
        measure=None if clearance.self_collision else Clearance(arm.bodies, **options),
    )


class HomeCurve(NamedTuple):
    """The QP's layout, control vertices (V, 3), m, torsion (T,), rad, and goals (V, 3) of control vertices, m."""

    layout: Layout
    vertices: Array
    torsion: Array
    vertex_goals: Array | None


def home_curve(problem: Problem, arm: Arm, task: TipTask) -> HomeCurve:
    """Return the QP's layout and the curve at home; both without a curve where no station tracks one.

    Raises
    ------
    ProblemError
        The arm cannot keep its stations on the curve exactly as asked.
    """
    method, stations, spec = problem.method, arm.stations, problem.curve
    elastic, weights = problem.end_effector.mode == "elastic", with_angles(method.weights, arm)
    if method.goes_by_bays and len(stations) < 2:
        text = '"coupled" or "none": the others go along the faces, and this arm has fewer than two'
        raise problem.error([problem.mistake(("method", "tracking"), text)])
    if method.tracking == "none" or len(stations) < 2:
        tables = np.zeros((0, 0)), np.zeros((0, 0)), np.zeros(0, dtype=np.int64)
        layout = Layout(arm, *tables, task.row_names, weights, elastic_tip=elastic)
        return HomeCurve(layout, np.zeros((0, 3)), np.zeros(0), None)
    is_hard, mistakes = method.holds_curve, list(_beyond_the_arm(problem, arm, task))
    if method.gives_way and mistakes and method.hard_coordinates == ("position",):
        # By default tracking becomes a penalty here: this arm can hold only the curve's end exactly.
        is_hard, mistakes = False, []
    if mistakes:
        raise problem.error(mistakes)
    keys = ("degree", "bias", "tension", "breaks", "extraction")
    options = {key: getattr(spec, key) for key in keys if hasattr(spec, key)}
    family = make_family(spec.family, spec.control_vertices, **options)
    stride = stations.stride if is_hard else 1
    tracked = np.arange(len(stations) - 1, stride - 1, -stride)[::-1]
    centres = stations.centres(arm.home)
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(centres, axis=0), axis=1))])
    fractions = travelled[tracked] / travelled[-1]
    normal = stations.frames[0][:, 2]
    s, vertices = _fitted(family, fractions, centres[0], centres[tracked], normal)
    torsion = np.zeros(spec.torsion_vertices)
    tracks_roll = bool(torsion.size) or (is_hard and "orientation" in method.hard_coordinates)
    roll = None
    if tracks_roll:
        frames = Curve(family, vertices, torsion, stations.frames[0]).frame(s)
        turn = np.swapaxes(frames, 1, 2) @ stations.frames[tracked]
        roll = np.arctan2(turn[:, 1, 0], turn[:, 0, 0])
    by_arc_length = spec.nodes == "arc-length"
    spacing = np.linalg.norm(np.diff(centres[[0, *tracked]], axis=0), axis=1)
    shape = CurveShape(
        family,
        fractions if by_arc_length else s,
        by_arc_length=by_arc_length,
        torsion=torsion.size,
        roll=roll,
        tracks_roll=tracks_roll,
        spacing=spacing if method.weights.spacing else None,
    )
    goals = None
    if spec.control_vertex_goals:
        goals = np.full(vertices.shape, np.nan)
        for goal in spec.control_vertex_goals:
            goals[goal.index] = goal.position
    layout = Layout(
        arm,
        family.weights(s),
        family.weights(s, 1),
        tracked,
        task.row_names,
        weights,
        hard_tracking=is_hard,
        hard_turns=is_hard and len(method.hard_coordinates) > 1,
        elastic_tip=elastic,
        shape=shape,
        vertex_goals=tuple(sorted(goal.index for goal in spec.control_vertex_goals)),
    )
    arrival, tip = Arrival(layout), (arm.end_effector.position(arm.home), arm.end_effector.frame)
    ended, _ = arrival.ended(vertices, *tip)
    if layout.ends_along_tip and np.abs(ended - vertices).max() > 1e-9 * arm.height:
        # The direction of the curve's end is to move the stations of a bent arm as little as possible.
        along = layout.curve_slopes[-1], arm.end_effector.frame[:, 2]
        vertices = curve_rows.fitted(layout.curve_weights, centres[tracked], centres[0], normal, along)
        ended, _ = arrival.ended(vertices, *tip)
    return HomeCurve(layout, ended, torsion, goals)


def _fitted(
    family: CurveFamily, fractions: Array, start: Array, points: Array, normal: Array
) -> tuple[Array, Array]:
    """Return s_k (K,) and control vertices (V, 3) at home: on the straight axis, or fitted to a bent arm.

    `fractions` (K,) are the shares, at each of the `points` (K, 3), of the length from `start` (3,) through
    the points. The curve of a bent arm begins along the base's `normal` (3,).
    """
    end, length = points[-1], float(np.linalg.norm(points[-1] - start))
    straight = straight_curve(family, start, end)
    off = points - start - fractions[:, None] * (end - start)
    aside = np.linalg.norm(np.cross(normal, end - start))
    if np.abs(off).max() <= 1e-9 * length and aside <= 1e-9 * length:
        # Families without linear precision run along the axis at a varying speed.
        even = np.abs(straight.position(fractions) - points).max() <= 1e-12 * length
        return fractions if even else straight.arc_parameter(fractions), straight.control_vertices
    return fractions, curve_rows.fitted(family.weights(fractions), points, start, normal)


def _beyond_the_arm(problem: Problem, arm: Arm, task: TipTask) -> Iterator[Mistake]:
    """Yield the coordinates that stations shall keep on the curve if the arm has too few motions."""
    method, curve = problem.method, problem.curve
    if not method.holds_curve:
        return
    wanted = list(method.hard_coordinates)
    if len(wanted) == 2 and curve.torsion_vertices:
        wanted.append("orientation")
    stations = arm.stations
    if len(stations) <= stations.stride:
        key, other = ("tracking", '"coupled"') if method.goes_by_bays else ("tracking_mode", '"elastic"')
        yield problem.mistake(
            ("method", key), f"{other}: no {stations.word} of so short an arm can be kept on the curve"
        )
        return
    missing = ", ".join(name for name in wanted if name not in stations.trackable)
    if missing:
        which = f"every {stations.word}" if stations.stride == 1 else f"every second {stations.word}"
        can = ", ".join(stations.trackable) or "nothing"
        text = f"what {which} of this {arm.kind} arm can keep, {can}; it cannot keep {missing}"
        yield problem.mistake(("method", "hard_coordinates"), text)
    if "orientation" in wanted and task.turns == "orientation" and not curve.torsion_vertices:
        text = "1 or more: the tip is asked for roll, and faces keep the roll of the curve, which has none of its own"
        yield problem.mistake(("curve", "torsion_vertices"), text)


def make_engine(
    solver: str,
    layout: Layout,
    kinematics: Kinematics,
    task: TipTask,
    tracking: str = "coupled",
    *,
    compiled: bool = True,
) -> Engine:
    """Return the engine for the steps of an arm: with the QP solver of that name, or by its bays.

    Without `compiled` it is built faster, and steps more slowly.

    Raises
    ------
    SolverError
        There is no such solver, or it is not installed.
    """
    if tracking in ("recursive", "parallel"):
        by_bays = BaySolver(layout, parallel=tracking == "parallel")
        return GeneralEngine(layout, kinematics, task, by_bays, compiled=compiled)
    is_short = _is_short(layout)
    if layout.elastic_tip and not is_short:
        _LOG.warning(_CONDENSED_ALL_THE_SAME)
    is_quick = not layout.own
    is_long = is_quick and compiled and prefers_sweeps(layout)
    along = chain_solver(layout, dense_solver(solver)) if is_long else None
    if along is not None and ChainEngine.serves(along):
        return ChainEngine(along, kinematics, task)
    if is_quick and is_short and layout.arm.symbols(Constants()).can_eliminate:
        fused = FusedSolver(layout, dense_solver(solver), compiled=compiled)
        return FusedEngine(layout, kinematics, task, fused)
    general: StepSolver
    if layout.own:
        general = CondensedSolver(layout, dense_solver(solver))
    elif along is not None and prefers_staged(layout):
        general = along
    else:
        general = make_solver(solver, layout)
    return GeneralEngine(layout, kinematics, task, general, compiled=compiled)


def elastic_engine(
    solver: str, layout: Layout, kinematics: Kinematics, task: TipTask
) -> Callable[[], Engine]:
    """Return a function that gives the engine for ``Layout.giving_way``; the first call builds it."""
    # The engine of a long arm is seldom needed, and built faster without compiling.
    is_short = _is_short(layout)
    return cache(lambda: make_engine(solver, layout.giving_way(), kinematics, task, compiled=is_short))


def _is_short(layout: Layout) -> bool:
    """Whether condensing onto the actuators is fastest: there are few, or no bays to eliminate one after another."""
    return len(layout.arm.actuators) < STAGED_ACTUATORS or layout.arm.bays is None


def check_solver(problem: Problem) -> None:
    """Raise ProblemError if the problem's QP solver is unknown or not installed."""
    name = problem.method.solver
    try:
        own = find_part("solver", name)
    except PartError as error:
        expected = f"a solver that can be used; {error}"
        raise problem.error([problem.mistake(("method", "solver"), expected)]) from error
    if own is None and name != DEFAULT_SOLVER and name not in (choices := available_solvers()):
        expected = f"one of the solvers installed here, {quoted(choices)}{nearest(name, choices)}"
        mistake = problem.mistake(("method", "solver"), expected)
        raise problem.error([mistake])


def _obstacles(problem: Problem) -> Iterator[shapes.Obstacle]:
    for k, spec in enumerate(problem.obstacle):
        place = ("obstacle", k, "file") if spec.shape == "mesh" else ("obstacle", k)
        with problem.blaming(place, "a mesh of triangles with finite coordinates, m"):
            yield make_obstacle(spec)


def make_obstacle(spec: Any) -> shapes.Obstacle:
    """Return the obstacle of one ``[[obstacle]]`` table.

    Raises
    ------
    GeometryError
        A mesh cannot be read or has no volume.
    """
    rotation = rotation_from_vector(spec.rotation_vector)
    if spec.shape == "box":
        made = shapes.box(spec.name, spec.center, spec.size, rotation, spec.velocity)
    elif spec.shape == "sphere":
        made = shapes.sphere(spec.name, spec.center, spec.radius, spec.velocity)
    elif spec.shape == "cylinder":
        made = shapes.cylinder(spec.name, spec.center, spec.radius, spec.height, rotation, spec.velocity)
    else:
        made = shapes.mesh(spec.name, spec.file, spec.center, rotation, spec.scale, spec.velocity)
    return replace(made, table=spec)


def step_duration(maneuver: Any) -> float:
    """Return the nominal duration of a step, s."""
    if hasattr(maneuver, "waypoint"):
        return float(maneuver.waypoint[-1].time) / int(maneuver.steps)
    times = np.asarray(read_path(maneuver.path).time)
    return float(np.mean(np.diff(times))) if len(times) > 1 else float(times[0] or 1.0)
