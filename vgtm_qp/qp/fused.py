"""The fast path of a step: one call of C linearises, condenses, solves, checks the answer and settles it.

It answers the same QP as :mod:`vgtm_qp.qp.condensed`, in a tenth of the time for short arms; see ``qp.c``.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.symbols import Constants, EliminationStage
from vgtm_qp.arrays import Array, Index, record
from vgtm_qp.compiled import Kernel
from vgtm_qp.errors import EvaluationError
from vgtm_qp.native import Code, Program, building
from vgtm_qp.qp.answer import Accuracy, Closed, CurvePoint, Move, Settled, StepSolution
from vgtm_qp.qp.curve_rows import curve_function, point_function
from vgtm_qp.qp.daqp import DAQP, Daqp
from vgtm_qp.qp.dense import EQUALITY, DenseQP, DenseSolver
from vgtm_qp.qp.fused_rows import RESULTS, row_function
from vgtm_qp.qp.graph import Argument
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.linearise import StepInput
from vgtm_qp.qp.numbers import UNBOUNDED, ClearanceRows
from vgtm_qp.qp.residual import CONTRADICTION, TOLERANCE, InfeasibleStepError, refuse_large
from vgtm_qp.qp.settle import ON_PATH, SETTLING_STEPS, aims, closing_function, missing_function, tolerances
from vgtm_qp.qp.shape import CurveRows
from vgtm_qp.qp.stepper import NearRows
from vgtm_qp.rows.tip import TipGoal

_POINT = Argument.Q, Argument.VERTICES, Argument.PROGRESS
"""Where a QP is linearised, beside the torsion of its curve."""

_NOWHERE: Array = np.zeros((0, 3))
_NO_NUMBERS: Array = np.zeros(0)
_LIBRARIES = (".so", ".dylib", ".dll")

_ROOM, _SLOTS = 24, 4
"""Capacity at first: rows of clearance, and nodes of each."""

SUMS = 16
"""Numbers of ``qp.c`` that sum up the nodes which an actuator moves."""

_SMALL_ERROR, _TINY_ERROR = 3e-6, 1e-11
"""Errors of a quantity, over the arm's unit. Of one below the first, a step of Newton's method leaves so little that
the equalities can be measured after it; of one below the second, rounding alone.
"""


@cache
def daqp_addresses() -> dict[str, int]:
    """Return the addresses of the functions of DAQP in CasADi's wheel, whose headers ``qp.c`` includes.

    There are none where the wheel has DAQP in no library of its own.
    """
    found = Path(ca.__file__).parent.glob("*daqp.*")
    of_daqp = (path for path in found if path.stem in ("libdaqp", "daqp") and path.suffix in _LIBRARIES)
    if (file := next(of_daqp, None)) is None:
        return {}
    library = ctypes.CDLL(str(file))
    names = {"quadprog": "daqp_quadprog", "defaults": "daqp_default_settings"}
    return {field: ctypes.cast(library[name], ctypes.c_void_p).value or 0 for field, name in names.items()}


class FusedSolver:
    """Linearises, condenses, solves and settles; for arms whose symbols ``can_eliminate``.

    Solvers that differ only in their goals of control vertices share one workspace.

    The dense QPs are for `solver`, which C calls back unless it is DAQP.
    """

    def __init__(
        self,
        layout: Layout,
        solver: DenseSolver = DAQP,
        *,
        compiled: bool = True,
        workspace: FusedWorkspace | None = None,
    ) -> None:
        self.layout = layout
        self.workspace = FusedWorkspace(layout, solver, compiled) if workspace is None else workspace
        self.solver = self.workspace.solver
        self._pull = np.zeros((layout.vertices, 3))
        weight = np.isin(np.arange(layout.vertices), layout.vertex_goals) * layout.weights.vertex_goal
        self._goals = {
            "goal_pull": self._pull,
            "goal_weight": np.asarray(weight, dtype=float),
            "curve_hessian": np.ascontiguousarray(layout.curve_hessian),
        }

    def drawn(self, layout: Layout) -> FusedSolver:
        """Return the solver of a layout that differs only in its goals of control vertices."""
        return FusedSolver(layout, workspace=self.workspace)

    @property
    def is_ready(self) -> bool:
        """Whether the C is compiled; always false if it cannot be."""
        return self.workspace.is_ready

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """What the C calls: the functions of the rows, of what settling misses, of the closing, and of the curve."""
        return self.workspace.kernels

    @property
    def corrector(self) -> FusedSolver:
        """See :class:`~vgtm_qp.qp.stepper.Stepper`."""
        return self

    def point(self) -> tuple[Array, Array, Array, float]:
        """See :class:`~vgtm_qp.qp.stepper.Corrector`."""
        work = self.workspace
        q, vertices, progress = (work.inputs[k].copy() for k in _POINT)
        torsion = np.zeros(0) if work.curve is None else work.curve.inputs[1].copy()
        return q.reshape(work.shape), vertices.reshape(-1, 3), torsion, float(progress[0])

    def go_back(self, move: Move) -> None:
        """See :class:`~vgtm_qp.qp.stepper.Corrector`."""
        work = self.workspace
        work.started[:], work.started_points[:] = move.q.reshape(-1), move.vertices.reshape(-1)
        work.started_torsions[:] = move.torsion
        work.gone[0], work.data.reached = 0.0, 1.0

    def load(self, asked: StepInput) -> None:
        """Set the state, the goal and the boxes of the next QP."""
        self.draw(asked.vertices, asked.vertex_goals if asked.motion else None)
        asked.load(self.workspace.condense)
        self.bend(asked.torsion, asked.base_frame)

    def bend(self, torsion: Array, base_frame: Array) -> None:
        """Set the torsion (T,) and the frame (3, 3) at the base of the curve in the next QP."""
        if self.workspace.curve is not None:
            _, given, base, *_ = self.workspace.curve.inputs
            given[:], base[:] = torsion, base_frame.T.reshape(-1)

    def draw(self, vertices: Array, goals: Array | None) -> None:
        """Draw control vertices, which are at `vertices` (V, 3), to the layout's `goals` (V, 3), m, in the next QP."""
        self.workspace.use(self._goals)
        if self.layout.vertex_goals:
            self._pull[:] = self.layout.goal_pull(vertices, goals)

    def aim(self, accuracy: Accuracy) -> None:
        """Settle to that `accuracy` from now on."""
        self.workspace.aim(accuracy)

    def solve(self, clearance: ClearanceRows) -> StepSolution:
        """Solve the QP at the state loaded last.

        Raises
        ------
        InfeasibleStepError, SolverError
            As ``CondensedSolver.solve``.
        """
        near, work = self.workspace.take(clearance), self.workspace
        work.check(work.call("solve"))
        refuse_large(work.data.primal, work.data.dual, work.status)
        return self._whole(work.x, near)

    def move(self, clearance: ClearanceRows) -> Move:
        """Solve the QP at the state loaded last, and return where its answer leads.

        The solution's ``nodes`` and ``vertices`` are empty.

        Raises
        ------
        InfeasibleStepError, SolverError
            As :meth:`solve`.
        """
        self.workspace.take(clearance)
        work, data = self.workspace, self.workspace.data
        code = work.check(work.call("move", TOLERANCE))
        if code == Code.INACCURATE:
            refuse_large(data.primal, data.dual, work.status)
        return self.led(is_settled=code == Code.DONE)

    def led(self, *, is_settled: bool) -> Move:
        """Return where the answer of the QP solved last led; see :meth:`move`."""
        work, solution = self.workspace, self.answered()
        points = work.points if is_settled else work.started_points
        torsion = (work.torsions if is_settled else work.started_torsions).copy()
        q, vertices = work.started.reshape(work.shape).copy(), points.reshape(-1, 3).copy()
        closed = work.closed() if is_settled else None
        return Move(solution, q, vertices, torsion, work.data.reached, work.data.furthest, closed)

    def settle(
        self, q: Array, curve: CurvePoint, lower: Array, upper: Array, goal: TipGoal
    ) -> Settled | None:
        """Return the configuration near `q`, quantities closed and the tip at `goal`, and the curve near `curve`.

        Actuators are in their boxes (n_a,). None if the iteration does not converge; EvaluationError where the nodes of
        the curve can only be had from the curve itself.
        """
        work, inputs = self.workspace, self.workspace.condense.inputs
        work.q[:], work.points[:] = q.reshape(-1), curve.vertices.reshape(-1)
        work.torsions[:] = curve.torsion
        inputs[Argument.LOWER][:], inputs[Argument.UPPER][:] = lower, upper
        inputs[Argument.GOAL][:], inputs[Argument.TURNED][:] = goal.position, goal.rotation.T.reshape(-1)
        work.gone[0] = 0.0
        if work.check(work.call("settle")) != Code.DONE:
            return None
        return Settled(work.closed(), CurvePoint(work.points.reshape(-1, 3).copy(), work.torsions.copy()))

    def _whole(self, x: Array, near: int) -> StepSolution:
        """Return the solution of the unknowns `x`."""
        work, layout = self.workspace, self.layout
        count, nodes = work.actuators, np.zeros((len(layout.arm.node_names), 3))
        nodes[layout.arm.free] = work.displacement(x)
        vertices = work.offset.copy()
        if layout.vertices:
            vertices[1] += work.normal * x[count]
            vertices[2:] += x[count + 1 : work.torsion].reshape(-1, 3)
        return self._solution(x, near, nodes, vertices)

    def answered(self) -> StepSolution:
        """Return the answer of the QP solved last, without ``nodes`` and ``vertices``."""
        return self._solution(self.workspace.x, int(self.workspace.data.near), _NOWHERE, _NOWHERE)

    def _solution(self, x: Array, near: int, nodes: Array, vertices: Array) -> StepSolution:
        work, x = self.workspace, x.copy()
        count, first = work.actuators, work.size + work.first_near
        multipliers = work.multipliers
        return record(
            StepSolution,
            nodes=nodes,
            actuators=x[:count],
            vertices=vertices,
            progress=x.item(-1),
            actuator_multipliers=multipliers[:count].copy(),
            clearance_multipliers=-multipliers[first : first + near] if near else _NO_NUMBERS,
            iterations=work.data.iterations,
            torsion=x[work.torsion : work.torsion + self.layout.torsion]
            if self.layout.torsion
            else _NO_NUMBERS,
            tip_slack=float(x[-1 - work.slacks : -1].max()) if work.slacks else 0.0,
        )


class FusedWorkspace:
    """The arrays of the C, and the kernels that it calls."""

    hessian: Array
    constraint: Array
    lower: Array
    upper: Array
    multipliers: Array

    def __init__(self, layout: Layout, solver: DenseSolver, compiled: bool) -> None:
        arm, self.solver, equal = layout.arm, solver, len(layout.tip_rows) + len(layout.hard)
        self._layout, self._library = layout, building()
        self.condense = row_function(layout).kernel(compiled=compiled)
        self.missing = missing_function(layout).kernel(compiled=compiled)
        self.close = closing_function(layout).kernel(compiled=compiled)
        self.curve = self.curve_nodes = None
        if (shape := layout.general) is not None:
            self.curve = curve_function(shape).kernel(compiled=compiled)
            self.curve_nodes = point_function(shape).kernel(compiled=compiled)
        self.actuators, self.equal = len(arm.actuators), equal
        self.slacks, self.first_near = len(layout.slack_levers), equal + len(layout.legs)
        self.size = self.actuators + layout.free_curve + self.slacks + 1
        self.torsion = self.actuators + layout.free_curve - layout.torsion
        self.shape = arm.home_configuration.shape
        symbols = arm.symbols(Constants())
        self._stages = symbols.elimination()
        moves_by_twists = symbols.twists(ca.MX.sym("q", *symbols.shape)) is not None
        self._movers = symbols.movers().astype(np.int32) if moves_by_twists else None
        self._is_ready: bool | None = None
        self._accuracy: Accuracy | None = None
        self._goals: object = None
        self._other_status = ""
        self._failure: Exception | None = None

    @property
    def is_ready(self) -> bool:
        """See :class:`FusedSolver`."""
        if self._is_ready is None:
            if not self._library.ask():
                for kernel in self.kernels:
                    kernel.prepare()
                return False
            self._is_ready = self._library.library is not None and bool(daqp_addresses())
            if self._is_ready:
                self._start()
        return self._is_ready

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """See :class:`FusedSolver`."""
        of_curve = (kernel for kernel in (self.curve, self.curve_nodes) if kernel is not None)
        return self.condense, self.missing, self.close, *of_curve

    @property
    def data(self) -> Any:
        """The structure of the C."""
        return self._program.data

    @property
    def structures(self) -> dict[str, int]:
        """See :class:`~vgtm_qp.qp.stepper.Workspace`."""
        return {"fused": self._program.address}

    @property
    def inputs(self) -> Sequence[Array]:
        """See :class:`~vgtm_qp.qp.stepper.Workspace`."""
        return self.condense.inputs

    def refresh(self) -> None:
        """Use the kernels that were compiled meanwhile."""
        self._program.refresh()

    def call(self, name: str, *arguments: float) -> Code:
        """Call a function of the C, and return its code."""
        return self._program.call(name, *arguments)

    @property
    def status(self) -> str:
        """Name of the solver, and how it ended."""
        return self._other_status or f"daqp (exit flag {self.data.flag})"

    def check(self, code: Code) -> Code:
        """Return the code that a function returned; raise if there is no answer."""
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure
        if code == Code.INFEASIBLE:
            raise InfeasibleStepError(CONTRADICTION)
        if code == Code.NO_VALUE:
            raise EvaluationError("the rows of the step have no value at its configuration")
        return code

    def _ask(self) -> int:
        """Ask the solver for the QP's answer, on behalf of C; its error is raised once C has returned."""
        rows = self.first_near + self.data.near
        count = self.size + rows
        bounds = self.lower[:count], self.upper[:count], self._sense[:count]
        try:
            answer = self.solver.ask(DenseQP(self.hessian, self.gradient, self.constraint[:rows], *bounds))
        except Exception as error:  # a solver of the user's own raises anything, and C cannot hand it on
            self._failure = error
            return Code.FAILED
        self.x[:], self.multipliers[:count] = answer.x, answer.multipliers
        self._other_status, self.data.iterations = answer.status, answer.iterations
        return Code.DONE

    def use(self, goals: dict[str, Array]) -> None:
        """Set the goals of control vertices for the next QPs."""
        if goals is not self._goals:
            self._program.set(**goals)
            self._goals = goals

    def aim(self, accuracy: Accuracy) -> None:
        """Settle to that `accuracy` from now on."""
        if accuracy is not self._accuracy:
            self._accuracy = accuracy
            self._program.set(**aims(self._layout.arm, accuracy))

    def displacement(self, x: Array) -> Array:
        """Return (N - N_c, 3) displacements of the free nodes by `x` and by residuals, m."""
        count = self.actuators
        if self._movers is None:
            moved = self._response[:, 1:] @ x[:count] + self._response[:, 0]
            return np.asarray(moved.reshape(-1, 3))
        twists, places = self._moving[0].reshape(-1, 6), self._moving[1].reshape(-1, 3)
        known = self._moved.reshape(-1, 3)[self._layout.arm.free]
        summed = np.concatenate([np.zeros((1, 6)), np.cumsum(x[:count, None] * twists, axis=0)])
        summed = summed[self._movers]
        return np.asarray(np.cross(summed[:, :3], places) + summed[:, 3:] + known)

    def take(self, clearance: ClearanceRows) -> int:
        """Give the rows of clearance to the QP, and return their number."""
        near, slots = clearance.nodes.shape
        if not self._rows.hold(near, slots):
            self.reserve(2 * near, slots)
        self.data.near = near
        if near:
            self.data.slots = slots
            self._rows.write(clearance)
        return int(near)

    def near(self, count: int) -> tuple[Index, Array, Array]:
        """See :class:`~vgtm_qp.qp.stepper.Workspace`."""
        return self._rows.read(count, self.data.slots)

    def reserve(self, near: int, slots: int) -> None:
        """See :class:`~vgtm_qp.qp.stepper.Workspace`."""
        if not self._rows.hold(near, slots):
            self._reserve(max(near, self._rows.near), max(slots, self._rows.slots))

    def closed(self) -> Closed:
        """Return the settled configuration."""
        (_, quantities, errors), (_, position, rotation) = self.close.outputs, self.missing.outputs
        q, turned = self.q.reshape(self.shape).copy(), rotation.reshape(3, 3).T.copy()
        return Closed(q, quantities.copy(), float(errors[0]), position.copy(), turned)

    def _start(self) -> None:
        """Allocate the arrays, and give their addresses to C."""
        layout, condense, missing, close = self._layout, self.condense, self.missing, self.close
        # Both kernels share their arguments up to the constants, except q, the control vertices and `motion`.
        own = Argument.Q, Argument.VERTICES, Argument.MOTION
        common = Argument.GIVEN + len(CurveRows._fields) * (layout.general is not None)
        for argument in set(range(common)) - set(own):
            missing.bind_input(argument, condense.inputs[argument])
        self.q, self.points, self.gone = (missing.inputs[k] for k in (*own[:2], common))
        box = condense.inputs[Argument.LOWER], condense.inputs[Argument.UPPER]
        for argument, shared in enumerate((self.q, *box)):
            close.bind_input(argument, shared)
        self.started, self.started_points = self.q.copy(), self.points.copy()
        self.torsions, self.started_torsions = np.zeros(layout.torsion), np.zeros(layout.torsion)
        size, nodes = self.size, layout.node_columns
        rows = layout.least_squares - (0 if self._movers is None else nodes)
        self.hessian, self.gradient, self.x = np.zeros((size, size)), np.zeros(size), np.zeros(size)
        found = dict(zip(RESULTS, condense.outputs, strict=False))
        self._moving, self._moved = condense.outputs[len(RESULTS) :], found["moved"]
        self.offset, self.normal = found["offset"].reshape(-1, 3), found["normal"]
        self._response = np.zeros((nodes, 1 + self.actuators))
        self.stack = np.zeros((size, rows))
        sums = SUMS * (self.actuators + 1)
        work = nodes + sums + size * (rows + SETTLING_STEPS + 2)
        self._program = Program("Fused")
        self._program.set(**_numbers(layout), **daqp_addresses(), unknowns=size)
        # The bounds are written where the QP has them.
        self._program.set(**{name: array for name, array in found.items() if name not in ("lower", "upper")})
        self._program.set(**_composition(layout, condense))
        if self._movers is not None:
            twists, places = self._moving
            free = layout.arm.free.astype(np.int32)
            self._program.set(twists=twists, free=places, free_node=free, movers=self._movers)
        else:
            gradients, rhs = self._moving
            self._program.set(gradients=gradients, rhs=rhs, response=self._response)
            self._program.set(**_elimination(layout, self._stages))
        self._program.set(
            stack=self.stack,
            first_row=_first_rows(layout, self._stages, size),
            squares=rows,
            hard_at=(rows - (layout.least_squares - nodes) + layout.hard).astype(np.int32),
            hessian=self.hessian,
            gradient=self.gradient,
            x=self.x,
            q=self.q,
            points=self.points,
            gone=self.gone,
            progress=condense.inputs[Argument.PROGRESS],
            velocity=condense.inputs[Argument.VELOCITY],
            spin=condense.inputs[Argument.SPIN],
            closer=close.outputs[0],
            errors=close.outputs[2],
            torsions=self.torsions,
            started=self.started,
            started_points=self.started_points,
            started_torsions=self.started_torsions,
            work=np.zeros(work),
            working=self._working(size).address,
            at=np.zeros(size, dtype=np.int32),
            close=close,
            missing=missing,
        )
        if not self.solver.is_in_c:
            self._callback = ctypes.CFUNCTYPE(ctypes.c_int)(self._ask)
            self._program.set(other=ctypes.cast(self._callback, ctypes.c_void_p).value)
        if self.curve is not None:
            self._bend(self.curve)
        self._reserve(_ROOM, _SLOTS)

    def _bend(self, curve: Kernel) -> None:
        """Let the functions of the curve write among the arguments of the others, and give them to C."""
        nodes, inputs = self.curve_nodes, self.condense.inputs[Argument.GIVEN :]
        assert nodes is not None
        curve.bind_input(0, self.condense.inputs[Argument.VERTICES])
        for argument, shared in enumerate((self.points, self.torsions, curve.inputs[2])):
            nodes.bind_input(argument, shared)
        for result, field in enumerate(CurveRows._fields):
            curve.bind_output(result, inputs[result])
            if field in ("position", "frame"):
                nodes.bind_output(int(field == "frame"), inputs[result])
        self._program.set(
            curve=curve,
            curve_is_right=curve.outputs[-1],
            curve_nodes=nodes,
            nodes_are_right=nodes.outputs[-1],
        )

    def _working(self, size: int) -> Program:
        """Return the C's working set of QPs of that size."""
        most = 3 * size
        columns, products, inner = np.zeros((size, most)), np.zeros((most, most)), np.zeros((most, most))
        vectors = {name: np.zeros(most) for name in ("along", "share", "spread")}
        self._set = Program("Working")
        self._set.set(
            unknowns=size,
            most=most,
            factor=np.zeros((size, size)),
            columns=columns,
            products=products,
            inner=inner,
            pull=np.zeros(size),
            point=np.zeros(size),
            chosen=np.zeros(most, dtype=np.int32),
            **vectors,
        )
        return self._set

    def _reserve(self, near: int, slots: int) -> None:
        """Make room for `near` rows of clearance over `slots` nodes each."""
        size, tips = self.size, len(self._layout.tip_rows)
        self._rows, rows = NearRows(near, slots), self.first_near + near
        self.constraint, self.multipliers = np.zeros((rows, size)), np.zeros(size + rows)
        self.lower, self.upper = np.full(size + rows, -UNBOUNDED), np.full(size + rows, UNBOUNDED)
        self._sense = np.zeros(size + rows, dtype=np.int32)
        self._sense[size : size + self.equal] = EQUALITY
        # The kernel writes the bounds up to the tip's rows in place.
        for name, array in (("lower", self.lower), ("upper", self.upper)):
            self.condense.bind_output(RESULTS.index(name), array[: size + tips])
        self._program.set(
            **self._rows.fields,
            constraint=self.constraint,
            lower=self.lower,
            upper=self.upper,
            sense=self._sense,
            side=np.zeros(size + rows, dtype=np.int32),
            column=np.full(size + rows, -1, dtype=np.int32),
            multipliers=self.multipliers,
            condense=self.condense,
        )


def _numbers(layout: Layout) -> dict[str, Any]:
    """Return by field what the C knows of a layout: its sizes, the places of its rows, and tolerances."""
    arm, nodes = layout.arm, layout.node_columns
    place, of, share, by_nodes = _places(layout)
    return {
        **placement(layout),
        **tolerances(arm),
        "nodes": nodes,
        "hard": len(layout.hard),
        "by_nodes": int(by_nodes),
        "scale": 1.0 / float(np.sqrt(layout.weights.node_rate)),
        "actuator_weight": layout.actuator_weights,
        "slacks": len(layout.slack_levers),
        "slack_pull": layout.slack_pull,
        "slack_weight": layout.slack_weights,
        "on_path": ON_PATH * arm.fineness,
        "levers": layout.levers,
        "lever": arm.unit,
        "settling_steps": SETTLING_STEPS,
        "small_error": _SMALL_ERROR * arm.unit,
        "tiny_error": _TINY_ERROR * arm.unit,
        "feasibility": Daqp(arm.fineness).accuracy,
        "places": len(place),
        "place": place,
        "of": of,
        "share": share,
    }


def placement(layout: Layout) -> dict[str, Any]:
    """Return by field what the C knows of the places of tip and curve."""
    tip = layout.arm.end_effector
    return {
        "tips": len(layout.tip_rows),
        "legs": len(layout.legs),
        "vertices": layout.vertices,
        "torsion": layout.torsion,
        "coordinates": layout.arm.home_configuration.size,
        "actuators": len(layout.arm.actuators),
        "node_column": layout.node_column.astype(np.int32),
        "tip_nodes": len(tip.nodes),
        "tip_node": tip.nodes.astype(np.int32),
    }


def _composition(layout: Layout, condense: Kernel) -> dict[str, Any]:
    """Return by field how the C weights the rows of stations and curve, with which it composes the QP."""
    weights, stations, tracked = layout.weights, layout.arm.stations, layout.tracked
    angles = np.array([weights.tangent, weights.tangent, weights.roll])[: layout.turns]
    gaps = np.where(layout.hard_gaps, 1.0, np.sqrt(weights.tracking))
    turns = np.where(layout.hard_tilts, 1.0, np.sqrt(angles))
    spacings = np.full(layout.spacings, np.sqrt(weights.spacing))
    curve: dict[str, Any] = {}
    if layout.general is not None:
        given = CurveRows(*condense.inputs[Argument.GIVEN :][: len(CurveRows._fields)])
        curve = {"point_rows": given.position_rows, "stretch_rows": given.spacing_rows}
    return {
        "stations": len(tracked),
        "station_node": np.ascontiguousarray(stations.nodes[tracked], dtype=np.int32),
        "station_weight": np.ascontiguousarray(stations.weights[tracked]),
        "curve_weight": np.ascontiguousarray(layout.curve_weights),
        "curve_slope": np.ascontiguousarray(layout.curve_slopes),
        "turned": layout.turns,
        "spacings": layout.spacings,
        "row_weight": np.concatenate([gaps.reshape(-1), turns.reshape(-1), spacings]),
        **curve,
    }


def _elimination(layout: Layout, stages: Sequence[EliminationStage]) -> dict[str, Any]:
    """Return by field what the C knows of the stages of an elimination."""
    arm = layout.arm
    if not stages:
        return {"stages": 0}
    entries, columns = np.cumsum([0, *(len(stage.row) for stage in stages)]), []
    rows = np.cumsum([0, *(len(stage.rows) for stage in stages)])
    for stage in stages:
        # Coordinates of the stage itself are numbered from -1 down.
        own = np.full(layout.node_columns, -1)
        own[stage.coordinates] = np.arange(len(stage.coordinates))
        columns.append(np.where(own[stage.column] >= 0, -1 - own[stage.column], stage.column))
    actuator_of = np.full(len(arm.quantity_names), -1)
    actuator_of[arm.actuators] = np.arange(len(arm.actuators))
    size = max(len(stage.rows) for stage in stages)
    numbers = {
        "stage_rows": rows,
        "stage_entries": entries,
        "stage_quantity": np.concatenate([stage.rows for stage in stages]),
        "stage_coordinate": np.concatenate([stage.coordinates for stage in stages]),
        "entry_row": np.concatenate([stage.row for stage in stages]),
        "entry_column": np.concatenate(columns),
        "entry_flat": np.concatenate([stage.flat for stage in stages]),
        "actuator_of": actuator_of,
    }
    return {
        "stages": len(stages),
        "blocks": np.zeros(size * (size + 1 + len(arm.actuators))),
        **{name: array.astype(np.int32) for name, array in numbers.items()},
    }


def _first_rows(layout: Layout, stages: Sequence[EliminationStage], size: int) -> NDArray[np.int32]:
    """Return (n,) the first least-squares row that each unknown can change.

    An actuator moves nodes of its own stage and of later ones.
    """
    arm, first = layout.arm, np.zeros(size, dtype=np.int32)
    if not stages:
        return first
    count = len(arm.actuators)
    begins = np.minimum.accumulate([stage.coordinates.min() for stage in stages][::-1])[::-1]
    for stage, begin in zip(stages, begins, strict=True):
        first[:count][np.isin(arm.actuators, stage.rows)] = begin
    first[count:-1] = layout.node_columns
    return first


def _places(layout: Layout) -> tuple[NDArray[np.int32], NDArray[np.int32], Array, bool]:
    """Return how the coordinates of q change with those of a motion: places in both (E,), and factors (E,).

    The last result is True if the coordinates of a motion are displacements of nodes, not of actuators.
    """
    arm = layout.arm
    symbols, strokes = arm.symbols(Constants()), ca.MX.sym("strokes", len(arm.actuators))
    q, nodes = ca.MX.sym("q", *symbols.shape), ca.MX.sym("nodes", layout.node_columns)
    moved = symbols.coordinates(nodes, strokes)
    by_nodes = moved.name() == nodes.name()
    jacobian = ca.jacobian(symbols.along(q, moved), nodes if by_nodes else strokes)
    assert not ca.depends_on(jacobian, ca.veccat(q, nodes, strokes))
    shares = ca.Function("shares", [], [jacobian])()["o0"]
    rows, columns = (np.array(places, dtype=np.int32) for places in shares.sparsity().get_triplet())
    return rows, columns, np.array(shares.nonzeros()), by_nodes
