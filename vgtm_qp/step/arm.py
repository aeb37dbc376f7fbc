"""Everything that is built once for a problem: truss, curve, task, QP layout, solver and clearance monitor."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.truss.bodies import OffsetEnds, member_bodies
from vgtm_qp.arm.truss.build import LockError, build_truss
from vgtm_qp.arm.truss.kinematics import Kinematics
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.compiled import finish_compiling
from vgtm_qp.errors import Mistake, ProblemError, nearest
from vgtm_qp.geometry import shapes
from vgtm_qp.geometry.clearance import Clearance
from vgtm_qp.problem import Problem, read_path
from vgtm_qp.problem.fields import quoted
from vgtm_qp.problem.problem import check_is_problem
from vgtm_qp.problem.table import shown
from vgtm_qp.qp.fused import FusedSolver
from vgtm_qp.qp.graph import elimination_stages
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.long.select import STAGED_ACTUATORS
from vgtm_qp.qp.long.staged import StagedSolver
from vgtm_qp.qp.long.tracked import TrackedSolver
from vgtm_qp.qp.solvers import DEFAULT_SOLVER, available_solvers, make_solver
from vgtm_qp.step.base import BaseMotion
from vgtm_qp.step.chain_engine import ChainEngine
from vgtm_qp.step.curve import home_curve
from vgtm_qp.step.engine import ElasticEngine, Engine, FusedEngine, PlainEngine
from vgtm_qp.step.linearise import Linearisation
from vgtm_qp.step.path import rotation_from_vector
from vgtm_qp.step.separation import BodyPoints
from vgtm_qp.step.state import State, frozen
from vgtm_qp.step.task import TipTask

Array = NDArray[np.float64]

FUSED_ACTUATORS = 45
"""Up to so many actuators the dense condensed QP is the faster one."""

_CONDENSED_ALL_THE_SAME = (
    "elastic end effector: the elimination along the bays does not know its slacks, so the QP is condensed onto the "
    "actuators, which takes longer on an arm of this length"
)


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm ready to move.

    Attributes
    ----------
    home_lengths : (M,)
        Member lengths at home, m: what fixed members must keep.
    control_vertices : (V, 3)
        The curve at home, m.
    safe, self_safe, influence : float
        Least clearance to obstacles and between members, and the distance from which pairs enter the QP, m.
    margin : float
        What the QP keeps over the least clearance, m.
    minimum_angle : float
        Least angle between members that share a node, rad.
    tip_mode : str
        How strictly the end effector follows its path: ``scaled``, ``hard`` or ``elastic``.
    dt : float
        Duration of a step, s.
    torsion : (T,)
        Torsion coordinates of the curve at home, rad.
    vertex_goals : (V, 3) or None
        Where the problem draws control vertices, m.
    solver : str
        Name of the QP solver.
    jams : tuple of (str, float)
        Actuated members that lock later than at the start, and the times, s.
    base_motion : BaseMotion or None
        None where the base rests.
    slow_approach : bool
        Whether members slow down before they touch, and actuators before the ends of their strokes.
    measure : Clearance or None
        What the clearance of a state is measured with where the monitor does not see pairs of members.
    body_points : BodyPoints or None
        Where the members end; None where they end in the nodes.
    """

    truss: Truss
    kinematics: Kinematics
    layout: Layout
    task: TipTask
    engine: Engine
    monitor: Clearance
    home_lengths: Array
    control_vertices: Array
    safe: float
    self_safe: float
    influence: float
    margin: float
    dt: float
    minimum_angle: float = 0.0
    tip_mode: str = "scaled"
    torsion: Array = field(default_factory=lambda: np.zeros(0))
    vertex_goals: Array | None = None
    solver: str = DEFAULT_SOLVER
    base_motion: BaseMotion | None = None
    jams: tuple[tuple[str, float], ...] = ()
    slow_approach: bool = True
    measure: Clearance | None = None
    body_points: BodyPoints | None = None

    def points(self, X: Array) -> Array:
        """Return the points (P, 3) that span the monitor's bodies at node positions `X` (N, 3), m."""
        return X if self.body_points is None else self.body_points.points(X)

    def least_clearance(self, X: Array, time: float, among: str = "all") -> float:
        """Return the exact least surface distance at node positions `X` (N, 3), m; see ``Clearance.least``."""
        return (self.measure or self.monitor).least(self.points(X), time, among=among)[0]

    def base_at(self, time: float) -> tuple[Array | None, Array | None]:
        """Return positions (N, 3), m, whose rows at base nodes are theirs at `time`, and the base's rotation (3, 3).

        None twice where the base rests.
        """
        motion = self.base_motion
        return (None, None) if motion is None else (motion.nodes(time), motion.rotation(time))

    def home_state(self) -> State:
        """Return the arm at rest in its home pose at time 0."""
        return State(
            time=0.0,
            nodes=frozen(self.truss.home),
            control_vertices=frozen(self.control_vertices),
            torsion=frozen(self.torsion),
            lengths=frozen(self.home_lengths),
            length_rates=frozen(np.zeros(self.truss.member_count)),
            motion=frozen(np.zeros_like(self.truss.home)),
        )


def build_arm(problem: Problem, *, compiled: bool = True) -> Arm:
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
    spec = problem.truss
    assert spec is not None
    try:
        truss = build_truss(spec)
    except LockError as error:
        wrong = [Mistake(f"truss.locked[{place}]", shown(name), said) for place, name, said in error.wrong]
        raise ProblemError(str(problem.source or problem.name), wrong) from None
    kinematics = Kinematics(truss)
    kinematics.evaluate(truss.home)
    task = TipTask(problem.end_effector.track, kinematics)
    curve = home_curve(problem, truss, task)
    layout = replace(curve.layout, elastic_tip=problem.end_effector.mode == "elastic")
    clearance = problem.clearance
    options: dict[str, Any] = {
        "obstacles": [make_obstacle(obstacle) for obstacle in problem.obstacle],
        "safe": clearance.safe,
        "influence": clearance.influence,
    }
    engine = make_engine(problem.method.solver, layout, kinematics, task, compiled=compiled)
    bodies = member_bodies(truss)
    body_points = None if truss.joints is None else OffsetEnds(truss, compiled=compiled)
    monitor = Clearance(bodies, self_collision=clearance.self_collision, **options)
    finish_compiling()
    return Arm(
        truss=truss,
        kinematics=kinematics,
        layout=layout,
        task=task,
        engine=engine,
        monitor=monitor,
        home_lengths=truss.home_lengths,
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
        base_motion=BaseMotion(spec.base_motion, truss) if spec.base_motion else None,
        slow_approach=problem.method.slow_approach,
        jams=tuple((lock.member, lock.time) for lock in spec.locked if lock.time > 0.0),
        measure=None if clearance.self_collision else Clearance(bodies, **options),
        body_points=body_points,
    )


def reshaped(arm: Arm, layout: Layout) -> Arm:
    """Return the arm with another curve: a layout of :func:`vgtm_qp.step.curve.with_curve`."""
    engine: Engine
    if isinstance(arm.engine, FusedEngine) and layout.family is arm.layout.family:
        engine = arm.engine.drawn(layout)
    else:
        engine = make_engine(arm.solver, layout, arm.kinematics, arm.task)
        finish_compiling()
    return replace(arm, layout=layout, engine=engine)


def make_engine(
    solver: str, layout: Layout, kinematics: Kinematics, task: TipTask, *, compiled: bool = True
) -> Engine:
    """Return the engine that solves the steps of an arm with the solver of that name.

    Raises
    ------
    SolverError
        There is no such solver, or it is not installed.
    """
    if layout.elastic_tip:
        linearisation = Linearisation(layout, kinematics, task, layout.truss.home_lengths)
        if solver == DEFAULT_SOLVER and len(layout.truss.actuators) >= STAGED_ACTUATORS:
            warnings.warn(_CONDENSED_ALL_THE_SAME, stacklevel=2)
        return ElasticEngine(linearisation, make_solver(solver, layout))
    if solver == DEFAULT_SOLVER and compiled:
        stages = elimination_stages(layout)
        if stages is not None and len(layout.truss.actuators) <= FUSED_ACTUATORS:
            return FusedEngine(FusedSolver(layout, stages))
    chosen = make_solver(solver, layout)
    if isinstance(chosen, (StagedSolver, TrackedSolver)) and compiled and ChainEngine.serves(chosen):
        return ChainEngine(chosen, kinematics, task, layout.truss.home_lengths)
    linearisation = Linearisation(layout, kinematics, task, layout.truss.home_lengths)
    return PlainEngine(linearisation, chosen)


def _check_supported(problem: Problem) -> None:
    """Refuse, in one message, the parts of the contract that no method here serves."""
    mistakes = []
    if problem.truss is None:
        mistakes.append(problem.mistake(("arm",), "[truss]; serial arms are not available in this version"))
    elif problem.truss.module == "plate":
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
