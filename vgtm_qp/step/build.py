"""From a problem to an arm that is ready to move: the last place that sees a problem."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Arm, Kinematics
from vgtm_qp.arm.build import make_arm
from vgtm_qp.arm.symbols import Constants
from vgtm_qp.compiled import finish_compiling
from vgtm_qp.errors import ProblemError, nearest
from vgtm_qp.geometry import shapes
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.problem import Problem, read_path
from vgtm_qp.problem.fields import quoted
from vgtm_qp.problem.problem import check_is_problem
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.long.select import STAGED_ACTUATORS
from vgtm_qp.qp.long.staged import StagedSolver
from vgtm_qp.qp.long.tracked import TrackedSolver
from vgtm_qp.qp.solvers import DEFAULT_SOLVER, available_solvers, make_solver
from vgtm_qp.rotation import rotation_from_vector
from vgtm_qp.step.chain_engine import ChainEngine
from vgtm_qp.step.curve import home_curve
from vgtm_qp.step.engine import Engine, FusedEngine, GeneralEngine
from vgtm_qp.step.path import base_motion
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.task import TipTask

Array = NDArray[np.float64]

_CONDENSED_ALL_THE_SAME = (
    "elastic end effector: the elimination along the bays does not know its slacks, so the QP is condensed onto the "
    "actuators, which takes longer on an arm of this length"
)


def build_arm(problem: Problem, *, compiled: bool = True) -> Setup:
    """Return the arm of a problem, ready to move; not `compiled`, it is built sooner and steps more slowly.

    Raises
    ------
    ProblemError
        The problem asks for what this arm cannot do at all; each mistake is named.
    TrussError
        The truss is not statically determinate.
    """
    check_is_problem(problem)
    _check_supported(problem)
    check_solver(problem)
    arm = make_arm(problem)
    kinematics = arm.kinematics()
    kinematics.evaluate(arm.home_configuration)
    task = TipTask(problem.end_effector.track, arm)
    curve = home_curve(problem, arm, task)
    layout = replace(curve.layout, elastic_tip=problem.end_effector.mode == "elastic")
    clearance = problem.clearance
    options: dict[str, Any] = {
        "obstacles": [make_obstacle(obstacle) for obstacle in problem.obstacle],
        "safe": clearance.safe,
        "influence": clearance.influence,
    }
    engine = make_engine(problem.method.solver, layout, kinematics, task, compiled=compiled)
    monitor = Clearance(arm.bodies, self_collision=clearance.self_collision, **options)
    finish_compiling()
    spec = problem.truss or problem.arm
    assert spec is not None
    return Setup(
        arm=arm,
        kinematics=kinematics,
        layout=layout,
        task=task,
        engine=engine,
        monitor=monitor,
        control_vertices=curve.vertices,
        torsion=curve.torsion,
        vertex_goals=curve.vertex_goals,
        solver=problem.method.solver,
        safe=clearance.safe,
        self_safe=clearance.between_members,
        influence=clearance.influence,
        margin=clearance.margin,
        dt=step_duration(problem.maneuver),
        minimum_angle=clearance.minimum_angle,
        tip_mode=problem.end_effector.mode,
        base_motion=base_motion(spec.base_motion) if spec.base_motion else None,
        slow_approach=problem.method.slow_approach,
        jams=tuple((lock.member, lock.time) for lock in spec.locked if lock.time > 0.0),
        measure=None if clearance.self_collision else Clearance(arm.bodies, **options),
    )


def make_engine(
    solver: str, layout: Layout, kinematics: Kinematics, task: TipTask, *, compiled: bool = True
) -> Engine:
    """Return the engine that solves the steps of an arm with the solver of that name.

    Raises
    ------
    SolverError
        There is no such solver, or it is not installed.
    """
    is_short = len(layout.arm.actuators) < STAGED_ACTUATORS
    is_default = solver == DEFAULT_SOLVER
    if layout.elastic_tip and is_default and not is_short:
        warnings.warn(_CONDENSED_ALL_THE_SAME, stacklevel=2)
    if is_default and compiled and not layout.elastic_tip:
        if is_short and _can_eliminate(layout.arm):
            return FusedEngine(layout)
        chosen = make_solver(solver, layout)
        if isinstance(chosen, (StagedSolver, TrackedSolver)) and ChainEngine.serves(chosen):
            return ChainEngine(chosen, kinematics, task)
        return GeneralEngine(layout, kinematics, task, chosen)
    return GeneralEngine(layout, kinematics, task, make_solver(solver, layout), compiled=compiled)


def _can_eliminate(arm: Arm) -> bool:
    return arm.symbols(Constants()).can_eliminate


def _check_supported(problem: Problem) -> None:
    """Refuse, in one message, the parts of the contract that no method here serves."""
    mistakes = []
    if problem.arm is not None and problem.arm.urdf is not None:
        expected = "a list of joints [[arm.joint]]; URDF files are not read by this version"
        mistakes.append(problem.mistake(("arm", "urdf"), expected))
    elif problem.truss is not None and problem.truss.module == "plate":
        modules = "octahedral, double-octahedral, hexapod, longeron, tetrahedral or graph"
        mistakes.append(
            problem.mistake(("truss", "module"), f"{modules}; plates are not available in this version")
        )
    if problem.maneuver.kind != "path":
        mistakes.append(
            problem.mistake(("maneuver", "kind"), '"path"; deployment is not available in this version')
        )
    if mistakes:
        raise ProblemError(str(problem.source or problem.name), mistakes)


def check_solver(problem: Problem) -> None:
    """Raise ProblemError where the problem's QP solver is unknown or not installed."""
    name = problem.method.solver
    if name != DEFAULT_SOLVER and name not in (choices := available_solvers()):
        expected = f"one of the solvers installed here, {quoted(choices)}{nearest(name, choices)}"
        mistake = problem.mistake(("method", "solver"), expected)
        raise ProblemError(str(problem.source or problem.name), [mistake])


def make_obstacle(spec: Any) -> shapes.Obstacle:
    """Return the obstacle of one ``[[obstacle]]`` table."""
    rotation = rotation_from_vector(spec.rotation_vector)
    if spec.shape == "box":
        return shapes.box(spec.name, spec.center, spec.size, rotation, spec.velocity)
    if spec.shape == "sphere":
        return shapes.sphere(spec.name, spec.center, spec.radius, spec.velocity)
    if spec.shape == "cylinder":
        return shapes.cylinder(spec.name, spec.center, spec.radius, spec.height, rotation, spec.velocity)
    return shapes.mesh(spec.name, spec.file, spec.center, rotation, spec.scale, spec.velocity)


def step_duration(maneuver: Any) -> float:
    """Return the nominal duration of a step, s."""
    if hasattr(maneuver, "waypoint"):
        return float(maneuver.waypoint[-1].time) / int(maneuver.steps)
    times = np.asarray(read_path(maneuver.path).time)
    return float(np.mean(np.diff(times))) if len(times) > 1 else float(times[0] or 1.0)
