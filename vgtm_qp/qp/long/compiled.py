"""The step of a long arm in one call of C: see ``native/chain.c``, which does what solvers and engine do by NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.compiled import Kernel
from vgtm_qp.native import Code, CompiledKernel, Program, building
from vgtm_qp.qp.answer import Accuracy, Closed, Move, StepSolution
from vgtm_qp.qp.daqp import Daqp
from vgtm_qp.qp.fused import daqp_addresses, placement
from vgtm_qp.qp.graph import Argument
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.linearise import StepInput
from vgtm_qp.qp.long.chain_data import ChainData, frame_constants_of, period_values
from vgtm_qp.qp.long.ends import begin_function, missing_tip_function
from vgtm_qp.qp.long.products import products
from vgtm_qp.qp.long.solver import PRESSES, ChainSolver
from vgtm_qp.qp.long.working_set import BLOCK, DEPENDENT, INDEPENDENT, NO_ROW
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.qp.residual import TOLERANCE
from vgtm_qp.qp.settle import aims, tolerances
from vgtm_qp.qp.stepper import NearRows

_ROOM, _NEAR, _SLOTS = 64, 64, 4
"""Capacity at first: rows of the dense QP, rows of clearance, and nodes of each of these."""

_NOWHERE: Array = np.zeros((0, 3))


class CompiledChain:
    """Takes the steps of a solver's arm by C once its functions are compiled, if the dense QPs are for DAQP.

    It is the :class:`~vgtm_qp.qp.stepper.Stepper` of that arm, and its workspace.
    """

    def __init__(self, solver: ChainSolver) -> None:
        self._solver = solver
        self.layout, self._chain = solver.layout, solver.chain
        self.shape, self.torsions = solver.layout.arm.home_configuration.shape, np.zeros(0)
        self.curve_nodes: Kernel | None = None
        self._begin, self.missing = (
            begin_function(self.layout).kernel(),
            missing_tip_function(self.layout).kernel(),
        )
        self._given = solver.functions()
        self._functions = {name: Kernel(function) for name, function in self._given.items()}
        self._functions["values"] = Kernel(period_values(self._chain))
        self.library = building()
        self._is_ready = None if solver.dense.is_in_c and daqp_addresses() else False
        self._accuracy: Accuracy | None = None

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """The functions that C calls."""
        return self._begin, self.missing, *self._functions.values()

    @property
    def is_ready(self) -> bool:
        """Whether the C and all its functions are compiled; always false if they cannot be."""
        if self._is_ready is None:
            self.library.ask()
            for kernel in self.kernels:
                kernel.prepare()
            if self.library.is_settled and all(kernel.is_done for kernel in self.kernels):
                is_compiled = all(kernel.is_compiled for kernel in self.kernels)
                self._is_ready = is_compiled and self.library.library is not None
                if self._is_ready:
                    self._start()
        return bool(self._is_ready)

    def move(
        self, asked: StepInput, clearance: ClearanceRows, accuracy: Accuracy
    ) -> tuple[Move, Closed] | None:
        """Return where the QP's answer leads, and the configuration at which settling ended; None without an answer.

        The goal moves straight, and the base is at rest. The move has a closed configuration if all is exact; otherwise
        the second result says how far settling came, its error infinite if it does not count.
        """
        self.aim(accuracy)
        self._load(asked)
        self._take(clearance)
        code = Code.CROWDED
        while code == Code.CROWDED:
            self.points[:] = asked.vertices.reshape(-1)
            self._q[:] = self._begun[:] = asked.q
            code = self._program.call("chain_move", TOLERANCE)
            if code == Code.CROWDED:
                self.widen(2 * self._room)
        if code not in (Code.DONE, Code.UNSETTLED, Code.OFF_CURVE):
            return None
        error = np.inf if code == Code.UNSETTLED else self._program.data.error
        return self.led(is_settled=code == Code.DONE), self._closed(error)

    def answered(self) -> StepSolution:
        """See :class:`~vgtm_qp.qp.stepper.Stepper`."""
        data, count = self._program.data, self._strokes_at + len(self._x)
        return StepSolution(
            nodes=_NOWHERE,
            actuators=self._x.copy(),
            vertices=_NOWHERE,
            progress=data.step,
            actuator_multipliers=self._y.copy(),
            clearance_multipliers=-self._every[count : count + data.near],
            iterations=data.iterations,
        )

    def led(self, *, is_settled: bool) -> Move:
        """See :class:`~vgtm_qp.qp.stepper.Stepper`."""
        data, points = self._program.data, self.points.reshape(-1, 3).copy()
        closed = self._closed(data.error) if is_settled else None
        way = self._begun.copy(), points, np.zeros(0), data.reached, data.furthest
        return Move(self.answered(), *way, closed)

    def _closed(self, error: float) -> Closed:
        """Return the configuration at which settling ended."""
        _, position, rotation = self.missing.outputs
        turned = rotation.reshape(3, 3).T.copy()
        return Closed(self._q.copy(), self._quantities.copy(), error, position.copy(), turned)

    @property
    def workspace(self) -> CompiledChain:
        """See :class:`~vgtm_qp.qp.stepper.Stepper`."""
        return self

    @property
    def corrector(self) -> None:
        """See :class:`~vgtm_qp.qp.stepper.Stepper`; NumPy may settle what C does not."""
        return None

    @property
    def structures(self) -> dict[str, int]:
        """See :class:`~vgtm_qp.qp.stepper.Workspace`."""
        return {"fused": self._step.address, "chain": self._program.address}

    @property
    def data(self) -> Any:
        """See :class:`~vgtm_qp.qp.stepper.Workspace`."""
        return self._step.data

    @property
    def inputs(self) -> Sequence[Array]:
        """See :class:`~vgtm_qp.qp.stepper.Workspace`."""
        return self._inputs

    def refresh(self) -> None:
        """See :class:`~vgtm_qp.qp.stepper.Workspace`; all functions were compiled before."""

    def reserve(self, near: int, slots: int) -> None:
        """See :class:`~vgtm_qp.qp.stepper.Workspace`; with more of these the dense QP may have more rows as well."""
        if not self._rows.hold(near, slots):
            self._make_room(max(near, self._rows.near), max(slots, self._rows.slots))
            self.widen(2 * self._room)

    def near(self, count: int) -> tuple[Index, Array, Array]:
        """See :class:`~vgtm_qp.qp.stepper.Workspace`."""
        return self._rows.read(count, self.data.slots)

    def bend(self, torsion: Array, base_frame: Array) -> None:
        """See :class:`~vgtm_qp.qp.stepper.Stepper`; constant tables describe the curve."""

    def aim(self, accuracy: Accuracy) -> None:
        """See :class:`~vgtm_qp.qp.stepper.Stepper`."""
        if accuracy is not self._accuracy:
            self._accuracy = accuracy
            self._program.set(**aims(self.layout.arm, accuracy))

    def _load(self, asked: StepInput) -> None:
        """Write the state, the goal and the boxes."""
        asked.load(self)
        if self.layout.vertices:
            self._start_nodes[:] = asked.q[self.layout.arm.stations.nodes[0]].reshape(-1)
        self._pull[:] = 0.0
        if asked.motion:
            self.draw(asked.vertices, asked.vertex_goals)

    def draw(self, vertices: Array, goals: Array | None) -> None:
        """See :class:`~vgtm_qp.qp.stepper.Stepper`."""
        if self.layout.vertices:
            self._pull[:] = self.layout.vertex_gradient(vertices, goals)

    def _take(self, clearance: ClearanceRows) -> None:
        """Write the rows of clearance."""
        near, slots = clearance.nodes.shape
        data = self._program.data
        if not self._rows.hold(near, slots):
            self._make_room(max(2 * near, self._rows.near), max(slots, self._rows.slots))
        data.near = near
        if near:
            if data.slots != slots:
                data.pressing, data.slots = 0, slots
            self._rows.write(clearance)

    def _start(self) -> None:
        """Allocate the arrays, and give their addresses to C."""
        layout, arm = self.layout, self.layout.arm
        self._program = program = Program("Chain")
        self._q, self._at, self._begun = (np.zeros(arm.home.shape) for _ in range(3))
        _, _, self._start_nodes, self.points, *given = self._begin.inputs
        self._pull, base = np.zeros((layout.vertices, 3)), np.zeros(arm.home.size)
        self._x, self._y, lower, upper = (np.zeros(len(arm.actuators)) for _ in range(4))
        self._quantities = np.zeros(len(arm.quantity_names))
        state = self._q.reshape(-1), self._at.reshape(-1), base, self.points
        self._inputs = [*state, lower, upper, *given][: Argument.GIVEN]
        goal = self._inputs[Argument.GOAL :]
        for argument, shared in enumerate(goal, start=1):
            self.missing.bind_input(argument, shared)
        self._gone = self.missing.inputs[1 + len(goal)]
        program.set(
            begin=self._begin,
            missing=self.missing,
            q=self._q,
            at=self._at,
            begun=self._begun,
            points=self.points,
            pull=self._pull,
            x=self._x,
            y=self._y,
            lower=lower,
            upper=upper,
            quantities=self._quantities,
            velocity=self._inputs[Argument.VELOCITY],
            spin=self._inputs[Argument.SPIN],
            motion=self._inputs[Argument.MOTION],
            progress=self._inputs[Argument.PROGRESS],
            **self._functions,
            **daqp_addresses(),
        )
        solver, sizes = self._solver, _sizes(self._solver)
        data = ChainData(self._chain, solver.data.sizes)
        program.set(head=data.head, tail=data.tail, table=data.table)
        program.set(**sizes, **_constants(solver, data), **_tolerances(layout), **products(solver, sizes))
        self._strokes_at = sizes["tips"] + sizes["held"] + sizes["ends"] + 1 + sizes["legs"]
        program.set(**_workspace(sizes, self._given))
        self._begin_steps()
        self._make_room(_NEAR, _SLOTS)
        self.widen(_ROOM)

    def _begin_steps(self) -> None:
        """Give C the input and the places of the answer in the order of a short arm's QP, see ``step.c``."""
        layout = self.layout
        if layout.vertices:
            # The base rests at home, wherever this is called.
            self._start_nodes[:] = layout.arm.home[layout.arm.stations.nodes[0]].reshape(-1)
        self._step, values = Program("Fused"), [self._quantities] * 2
        self._addresses = [
            np.array([array.ctypes.data for array in arrays], dtype=np.uintp)
            for arrays in (self._inputs, values)
        ]
        arguments, results = (addresses.ctypes.data for addresses in self._addresses)
        self._step.set(
            condense=CompiledKernel(arg=arguments),
            close=CompiledKernel(res=results),
            missing=self.missing,
            q=self._q,
            points=self.points,
            started=self._begun,
            started_points=self.points,
            gone=self._gone,
            progress=self._inputs[Argument.PROGRESS],
            velocity=self._inputs[Argument.VELOCITY],
            spin=self._inputs[Argument.SPIN],
            work=np.zeros(self._q.size),
            **placement(layout),
        )

    def _make_room(self, near: int, slots: int) -> None:
        """Make room for `near` rows of clearance over `slots` nodes each."""
        self._rows = NearRows(near, slots)
        self._step.set(**self._rows.fields)
        total = self._strokes_at + len(self._x) + near
        self._every = np.zeros(total)
        rows = {name: np.zeros(total) for name in ("low", "high", "value", "out")}
        marks = {name: np.zeros(total, dtype=np.int32) for name in ("state", "remembered")}
        pressed = np.zeros(near * slots, dtype=np.int32)
        self._program.set(
            **self._rows.fields,
            every=self._every,
            pressed=pressed,
            pressing=0,
            slots=slots,
            **rows,
            **marks,
        )

    def widen(self, room: int) -> None:
        """Make room for that many rows in the dense QP."""
        data, self._room = self._program.data, room
        size = data.periods * data.freedom + data.curve + 1
        self._program.set(
            room=room,
            row=np.zeros(room, dtype=np.int32),
            kept=np.zeros(4 * room + BLOCK, dtype=np.int32),
            column=np.zeros((room, size)),
            gram=np.zeros((room, room)),
            multiplier=np.zeros(room),
            level=np.zeros(room),
            scaled=np.zeros(size + room),
            dense=np.zeros(4 * room**2 + 8 * room + 64),
        )


def _sizes(solver: ChainSolver) -> dict[str, int]:
    """Return by field how many there are of what, and where parts of a period's numbers begin."""
    layout, chain, data = solver.layout, solver.chain, solver.data
    gaps, tilts = layout.ends_at_tip and not layout.hard_tracking, layout.ends_along_tip
    at = data.starts
    return {
        "periods": chain.periods,
        "own": chain.own,
        "before": chain.before,
        "moving": int(chain.actuated.sum()),
        "stations": int(chain.stations.shape[1]),
        "freedom": 0 if layout.hard_tracking else solver.elimination.freedom,
        "actuators": len(layout.arm.actuators),
        "held": len(chain.locked),
        "tips": len(layout.tip_rows),
        "tip_nodes": len(layout.arm.end_effector.nodes),
        "vertices": layout.vertices,
        "curve": layout.free_curve,
        "ends": 3 * gaps + 2 * tilts,
        "end_gaps": int(gaps),
        "legs": len(layout.legs),
        "width": 4 * (layout.free_curve // 4 + 1),
        "follows": int(layout.hard_tracking),
        "stages": len(chain.stage_sizes),
        "rhs_at": at["rhs"],
        "heads": data.head.shape[1],
        "tails": data.tail.shape[1],
        "tables": data.table.shape[1],
        "faces_at": at["tangent_face"],
        "gradient_at": at["actuator_gradient"],
        "over_slope_at": at["tangent_curve"],
        "gap_at": at["gap"],
        "tilt_at": at["tilt"],
        "normal_at": at["normal"],
    }


def _constants(solver: ChainSolver, data: ChainData) -> dict[str, Any]:
    """Return by field the tables of a chain, and the weights of its QP."""
    layout, chain, arm, weights = solver.layout, solver.chain, solver.layout.arm, solver.layout.weights
    members, fixed = chain.members, ~chain.bays.actuated[chain.members]
    base_row, base_column = np.nonzero(chain.pattern[:, : chain.before])
    angles, alignments = frame_constants_of(chain, data)
    end = {}
    if layout.vertices:
        (k,) = np.flatnonzero(data.stations == len(layout.tracked) - 1)
        nodes = arm.stations.nodes[layout.tracked[-1]][data.station_order.reshape(-1, 3)[k]]
        weight = chain.station_weights[-1]
        end = {"end_station": int(k), "end_node": nodes, "end_weight": np.ascontiguousarray(weight)}
    found = {
        "node": chain.nodes,
        "node_at": solver.node_at,
        "window": chain.window,
        "entry": chain.entry,
        "member": members,
        "stroke_at": solver.strokes_at,
        "held_at": solver.held_at,
        "moving_at": solver.moving_at,
        "is_fixed": fixed,
        "base_entries": chain.entry[base_row, base_column],
        "live": np.array(solver.elimination.live),
        "tip_node": arm.end_effector.nodes,
        "home": arm.home_quantities[members],
        "aim": arm.home_quantities[members],
        "fixed": fixed.astype(float),
        "angles": angles,
        "alignment": alignments,
        "hard": data.is_hard.astype(float),
        "weight": data.weights,
        "slope": data.slopes,
        "polygon": layout.vertex_hessian,
        "along": data.along,
        "levers": layout.tip_levers,
        "base_count": len(base_row),
        "node_rate": weights.node_rate,
        "actuator_weight": weights.actuators,
        "tangent": weights.tangent,
        "tracking": data.tracking,
        **end,
    }
    return {name: _for_c(value) for name, value in found.items()}


def _for_c(value: Any) -> Any:
    """Return an array of numbers, or of integers or marks, as C reads it."""
    if not isinstance(value, np.ndarray):
        return value
    return np.array(value, dtype=float if value.dtype == np.float64 else np.int32, order="C")


def _tolerances(layout: Layout) -> dict[str, Any]:
    """Return by field the tolerances of the dense QP and of settling; those of the accuracy come later."""
    return {
        **tolerances(layout.arm),
        "presses": PRESSES,
        "accuracy": Daqp(layout.arm.fineness).accuracy,
        "no_row": NO_ROW,
        "dependent": DEPENDENT,
        "independent": INDEPENDENT,
    }


def _workspace(sizes: dict[str, int], functions: dict[str, ca.Function]) -> dict[str, Any]:
    """Return by field the arrays of the sweeps."""
    periods, own, moving, before = (sizes[name] for name in ("periods", "own", "moving", "before"))
    columns, freedom, stations = sizes["curve"] + 1, sizes["freedom"], sizes["stations"]
    follows, factor = bool(sizes["follows"]), functions["eliminate"]
    carries, gains = (0, factor.nnz_out(0)) if follows else (factor.nnz_in(0), factor.nnz_out(1))
    width = sizes["width"]
    shapes: dict[str, tuple[int, ...]] = {
        "gains": (periods, gains),
        "lengths": (periods, own),
        "factor": (columns - 1, columns - 1),
        "rhs": (width,),
        "free": (width,),
        "shift": (sizes["vertices"], 3),
        "displaced": (periods + 1, own),
        "changed": (periods, own),
        "parts": (periods, 5 * stations),
        "nodal": (periods, own),
        "force": (periods, moving),
        "pushed": (periods, 5 * stations),
        "settled": (periods, own),
        "next": (periods, own),
        "errors": (periods, own),
        "wanted": (sizes["actuators"],),
        "curve_aim": (periods, 3 * stations),
        "work": (2 * carries + 4 * before + own + 3 * stations + freedom,),
    }
    if follows:
        shapes |= {
            "moved": (periods + 1, own, width),
            "stroke_rows": (periods, moving, width),
            "strokes": (periods, moving),
            "angle_rows": (periods, 2 * stations, width),
        }
    else:
        shapes |= {
            "outer": (periods, freedom, width),
            "placed": (periods, own),
            "motions": (periods, freedom),
            "passed": (periods, freedom, BLOCK),
            "entering": (periods, own, BLOCK),
            "gain": (sizes["actuators"], sizes["tips"]),
            "gain_moved": (periods, own, sizes["tips"]),
        }
    return {name: np.zeros(shape) for name, shape in shapes.items()} | {
        "carries": carries,
        "gains_size": gains,
    }
