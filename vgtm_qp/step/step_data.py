"""The arrays and numbers of one arm's step that Python shares with ``native/step.c``."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from vgtm_qp.arm.arm import Arithmetic, Arm, Ends, tip_frame_function
from vgtm_qp.arrays import Array
from vgtm_qp.geometry.exact import NORMAL_FROM, PROOF
from vgtm_qp.geometry.groups import Scene
from vgtm_qp.geometry.watch import AHEAD
from vgtm_qp.native import Program
from vgtm_qp.qp.answer import Accuracy
from vgtm_qp.qp.curve_rows import point_function
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.residual import TOLERANCE
from vgtm_qp.qp.stepper import Workspace
from vgtm_qp.rows.tip import axes
from vgtm_qp.step.acceptance import LOOSER, ROUNDING
from vgtm_qp.step.arrival import ending_function, gap_function, traced_shape
from vgtm_qp.step.separation import MOST_PIECES
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State
from vgtm_qp.step.target import base_frame

MOTION_MARGIN = 2.5
"""Ratio of the displacement for which pairs are listed to the expected displacement of a node."""

SINGULAR = 1e3
"""Displacement of a node, over the arm's length, above which a QP's answer shows a singular pose."""

LEAP = 1.0
"""Greatest displacement of a control vertex's coordinate in one step, over the arm's length."""

DEVIATION = 0.1
"""Greatest deviation of points from their chords in one step, over the arm's length."""

_ROOM = 64
"""Capacity at first: rows of clearance."""


class StepData:
    """The structure of that name in C, for one arm with one engine, and the arrays that it points to.

    Attributes
    ----------
    program : Program
        The structure, and the functions ``take``, ``resume`` and ``correct``.
    data : ctypes.Structure
        Its fields.
    parts : list of slice
        Configuration, nodes, control vertices, quantities, motion, rates and tip in `before` and `after`.
    before, after : 1-D
        The state, without rates and tip, and the next one.
    based_q, based_nodes : 1-D
        Configuration and nodes when the base alone has moved.
    base_normal : (3,)
        Where the base is at the end of the step.
    points : (P, 3) or None
        Of the bodies, m, where these are not the nodes.
    is_placed : bool
        Whether the configuration is the nodes.
    contacts, questions, answers, group, pair, asked, named
        One row for each of the rows of clearance; see ``step.c``.
    """

    def __init__(
        self,
        setup: Setup,
        layout: Layout,
        work: Workspace,
        known: Arithmetic,
        accuracy: Accuracy,
        **given: Any,
    ) -> None:
        arm = setup.arm
        self.program = Program("StepData")
        self.data, self._work, scene = self.program.data, work, setup.monitor.scene
        # A row is over the points of two bodies, each a function of three nodes where there are ends.
        self._slots = 2 * scene.span * (1 if known.ends is None else 3)
        self._size = scene.size
        self._hold_states(arm, layout)
        self.based_q, self.based_nodes = (self.before[part] for part in self.parts[:2])
        moves = setup.base_motion is not None
        if moves:
            self.based_q, self.based_nodes = self.based_q.copy(), self.based_nodes.copy()
        self.make_room(_ROOM)
        self.is_placed = known.place is None
        kernels = {"place": known.place, "bend": known.bend, "levers": known.levers}
        self.program.set(**{name: value for name, value in kernels.items() if value is not None})
        if setup.task.turns is not None:
            self.program.set(frame=tip_frame_function(arm).kernel())
        of_points = {"points": self.before[self.parts[1]], "next_points": self.after[self.parts[1]]}
        of_points |= _of_points(arm, known.ends)
        self.points: Array | None = None if known.ends is None else of_points["points"]
        if layout.vertices:
            # The gaps of a layout that gives way are those of the tracking that was asked for.
            self._end_curve(setup.layout, work)
        self.take, self.resume, self.correct = map(self.program.entry, ("take", "resume", "correct"))
        self.program.set(
            **work.structures,
            moves=int(moves),
            based_q=self.based_q,
            based_nodes=self.based_nodes,
            influence=setup.influence,
            margin=setup.margin,
            motion_margin=MOTION_MARGIN,
            ahead=AHEAD,
            relative=ROUNDING,
            tolerance=TOLERANCE,
            member=LOOSER * accuracy.member,
            tip=LOOSER * accuracy.tip,
            tracking=accuracy.tracking,
            **_of_arm(arm, known),
            must_track=int(layout.hard_tracking),
            **_of_tip(arm, layout),
            **_of_fcl(scene),
            slots=self._slots,
            **of_points,
            **given,
        )

    def _hold_states(self, arm: Arm, layout: Layout) -> None:
        """Allocate the state and the next one."""
        sizes = {
            "q": arm.home_configuration.size,
            "nodes": arm.home.size,
            "vertices": 3 * layout.vertices,
            "values": len(arm.quantity_names),
            "motion": arm.home_configuration.size,
            "rates": len(arm.quantity_names),
            "tip": 12,
        }
        ends = np.cumsum([0, *sizes.values()]).tolist()
        self.parts = [slice(first, last) for first, last in pairwise(ends)]
        self.before, self.after = np.zeros(ends[5]), np.zeros(ends[-1])
        for name, part in zip(sizes, self.parts, strict=True):
            if part.stop <= len(self.before):
                self.program.set(**{name: self.before[part]})
            self.program.set(**{f"next_{name}": self.after[part]})

    def _end_curve(self, layout: Layout, work: Workspace) -> None:
        """Let C end the curve of the next state, and measure its gaps; see ``Arrival``."""
        ending, gaps = ending_function(layout).kernel(), gap_function(layout).kernel()
        nodes, vertices = self.after[self.parts[1]], self.after[self.parts[2]]
        self.base_normal = ending.inputs[3]
        self.base_normal[:] = base_frame(layout.arm, None)[:, 2]
        for argument, array in enumerate((work.points, *work.missing.outputs[1:])):
            ending.bind_input(argument, array)
        ending.bind_output(0, vertices)
        gaps.bind_input(0, nodes)
        gaps.bind_input(1, vertices)
        if (shape := traced_shape(layout)) is not None:
            assert work.curve_nodes is not None
            traced = point_function(shape).kernel()
            traced.bind_input(0, vertices)
            for argument in (1, 2):
                traced.bind_input(argument, work.curve_nodes.inputs[argument])
                gaps.bind_input(1 + argument, traced.outputs[argument - 1])
            self.program.set(curve_nodes=traced)
        self.program.set(ending=ending, gaps=gaps)

    def load(self, state: State) -> None:
        """Write a state."""
        arrays = state.q, state.nodes, state.control_vertices, state.quantities, state.motion
        for part, values in zip(self.parts, arrays, strict=False):
            self.before[part] = values.reshape(-1)

    def make_room(self, rows: int) -> None:
        """Make room for that many rows of clearance."""
        self._work.reserve(rows, self._slots)
        self.contacts, self.questions, self.answers = (np.zeros((rows, n)) for n in (self._size, 12, 7))
        self.group, self.pair, self.asked = (np.zeros(rows, dtype=np.int32) for _ in range(3))
        self.named = np.zeros((rows, 3), dtype=np.int32)
        self.program.set(
            contacts=self.contacts,
            questions=self.questions,
            answers=self.answers,
            group=self.group,
            pair=self.pair,
            asked=self.asked,
            named=self.named,
            room=rows,
        )


def _of_arm(arm: Arm, known: Arithmetic) -> dict[str, object]:
    """Return by field what the C knows of an arm."""
    return {
        "width": arm.home.size,
        "quantities": len(arm.quantity_names),
        "based": len(known.based),
        "base": known.based.astype(np.int32),
        "distances": int(known.distances),
        "first": known.first.astype(np.int32),
        "last": known.last.astype(np.int32),
        "multiplier": known.multiplier,
        "unit": arm.unit,
        "deviation": DEVIATION * arm.height,
        "furthest": SINGULAR * arm.height,
        "leap": LEAP * arm.height,
        "actuator": arm.actuators.astype(np.int32),
        "home": arm.home_quantities,
    }


def _of_tip(arm: Arm, layout: Layout) -> dict[str, object]:
    """Return by field what the C knows of the tip beside its rows."""
    along = axes(layout.tip_rows)
    return {
        "axes": len(along),
        "axis": np.array(along, dtype=np.int32),
        "turns": len(layout.tip_rows) - len(along),
        "tip_weight": np.ascontiguousarray(arm.end_effector.weights, dtype=float),
    }


def _of_fcl(scene: Scene) -> dict[str, float]:
    """Return by field what the C knows of FCL."""
    if scene.fcl is None:
        return {"asks": 0}
    return {
        "asks": 1,
        "scale": scene.fcl.scale,
        "flaw": PROOF * scene.unit,
        "apart": NORMAL_FROM * scene.unit,
    }


def _of_points(arm: Arm, ends: Ends | None) -> dict[str, Any]:
    """Return by field what the C knows of the points of the bodies, where these are not the nodes."""
    home = arm.points(arm.home_configuration)
    found: dict[str, Any] = {
        "places": np.zeros((MOST_PIECES + 1, *home.shape)),
        "span": home.size,
    }
    if ends is None:
        return found
    # The points at home are the first place of the watch; the C writes those of each state.
    return found | {
        "points": home.copy(),
        "next_points": home.copy(),
        "spread": ends.place,
        "end": ends.row,
        "end_nodes": np.ascontiguousarray(ends.nodes, dtype=np.int32),
        "offset": np.ascontiguousarray(ends.offset),
    }
