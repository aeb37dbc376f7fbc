"""The usual step in one call of C: from a state and its target to the next state and the proof of the way there.

It takes the same step as an attempt of :mod:`vgtm_qp.step.attempt`, in a third of the time or less. What is unusual it
leaves to that: pairs that are too near already, meshes and hulls, angles, what the tip carries, a path that bends
within the step, rows at places between two states. Each further QP is one more call. See ``native/step.c``.
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import NamedTuple

import numpy as np

from vgtm_qp.arm.arm import Arithmetic, Pose
from vgtm_qp.arrays import record
from vgtm_qp.geometry.pairs import Pair
from vgtm_qp.geometry.watch import Watch
from vgtm_qp.native import Code
from vgtm_qp.qp.answer import Move, StepSolution
from vgtm_qp.qp.graph import Argument
from vgtm_qp.qp.numbers import ClearanceRows
from vgtm_qp.qp.residual import CONTRADICTION, InfeasibleStepError
from vgtm_qp.qp.stepper import Corrector
from vgtm_qp.step.acceptance import Acceptance
from vgtm_qp.step.engine import Engine
from vgtm_qp.step.separation import Separation
from vgtm_qp.step.setup import Setup
from vgtm_qp.step.state import State
from vgtm_qp.step.step import WHOLE, Step
from vgtm_qp.step.step_data import StepData
from vgtm_qp.step.target import QPInput, Target, base_frame

FREE_QPS = 3
"""Greatest number of QPs with free progress along the piece of path."""

MOST_QPS = 6
"""Greatest number of QPs: the last ones start anew from the first answer, and go no further than it."""

NO_CONVERGENCE = "no convergence"

_NOTHING = 1e-9
"""Progress of a QP below which its corrections may go further than the QP."""

_AGAIN = Code.UNSETTLED, Code.TOO_NEAR, Code.OFF_CURVE
"""Codes of a QP after which another one may correct its answer."""

_SETTLED = Code.NOT_PROVEN, Code.TOO_NEAR, Code.OFF_CURVE
"""Codes of a call whose answer may have been settled, and is no step yet."""

_WANTING = Code.ASKS, Code.CROWDED, Code.FULL
"""Codes of a call that goes on once it has what it asks for, contacts or room."""

PHASES = "distance", "qp", "acceptance"
"""Parts of a step whose times are known."""

_NO_ROWS = ClearanceRows()


class Begun(NamedTuple):
    """A step that needs other proofs, or QPs with other rows: where the last QP led, and how it came to that.

    Attributes
    ----------
    move, first : Move
        Where the last QP led, and the first one.
    rows : ClearanceRows
        Of the first QP.
    reach : float
        That of pairs in the last QP, m.
    qps : int
        Number of QPs so far.
    covered : float
        Share of the piece of path that the last QP was for.
    """

    move: Move
    first: Move
    rows: ClearanceRows
    reach: float
    qps: int = 1
    covered: float = 1.0


def can_drive(setup: Setup) -> bool:
    """Return whether usual steps of an arm can be taken in one call, if its ``Arm.arithmetic`` is known."""
    return setup.layout.own is None and setup.minimum_angle == 0.0


def is_cut_short(setup: Setup, move: Move) -> bool:
    """Return whether the answer of a first QP covers a part of the piece, and not the whole of it."""
    return setup.tip_mode == "scaled" and _NOTHING < move.progress < WHOLE


class Driver:
    """Takes the usual steps of one arm with one engine; the arm :func:`can_drive`.

    Attributes
    ----------
    spent : (3,)
        Seconds spent so far in the :data:`PHASES`; may be set to zero.
    """

    _arrays: StepData

    def __init__(self, setup: Setup, engine: Engine, acceptance: Acceptance, separation: Separation) -> None:
        assert engine.stepper is not None
        self._setup, self._acceptance, self._separation = setup, acceptance, separation
        self._engine, self._solver, self._layout = engine, engine.stepper, engine.layout
        self._work, self._known = self._solver.workspace, setup.arm.arithmetic()
        self._started = False
        self._held: State | None = None
        self._watch: Watch | None = None
        self.spent = np.zeros(len(PHASES))
        self._moves, self._has_limit = setup.base_motion is not None, setup.step_limit < np.inf

    def take(self, state: State, target: Target, share: float) -> Step | Begun | None:
        """Return the step from `state`, in which no pair is too near, to the end of the target's piece of path.

        The motion of the step before, times `share`, predicts this one. If the step is no usual one, its beginning is
        returned, or None if nothing is known of it.
        """
        setup, work = self._setup, self._work
        if (
            self._known is None
            or not work.is_ready
            or setup.carrier.carried
            or self._moves != (target.base is not None)
            or (self._moves and self._solver.corrector is None)
            or not target.path.is_straight(target.start, target.end)
        ):
            return None
        monitor = setup.monitor
        watch = self._watch = monitor.watching()
        if watch is None and monitor.scene.has_pairs:
            return None
        if not self._started:
            self._start(self._known)
        arrays, data = self._arrays, self._arrays.data
        arrays.program.refresh()
        work.refresh()
        self._load(state, target, share)
        if watch is None:
            data.way = 0
        else:
            data.way = watch.started(state.nodes if arrays.points is None else arrays.points).address
            watch.refresh()
        code = self._called(self._arrays.take)
        if not code:
            return self._passage(state, target)
        if self._solver.corrector is None and not (data.settled and code in _SETTLED):
            return None
        if code in _AGAIN or code == Code.NOT_PROVEN:
            first = self._solver.led(is_settled=bool(data.settled))
            return self.corrected(state, target, Begun(first, first, self._rows(), data.reach), code)
        return self._denied(state, target, share) if code == Code.INFEASIBLE else None

    def _start(self, known: Arithmetic) -> None:
        """Allocate what the call needs."""
        pace = {**self._separation.pace, "spent": self.spent}
        accuracy = self._acceptance.accuracy
        self._arrays = StepData(self._setup, self._layout, self._work, known, accuracy, **pace)
        self._started = True

    def _called(self, call: Callable[[], int]) -> int:
        """Return the code with which a `call` ends that has got all contacts and room it asked for."""
        code, data = call(), self._arrays.data
        while code and code in _WANTING:
            if code == Code.ASKS:
                self._ask()
                code = self._arrays.resume()
                continue
            if code == Code.CROWDED:
                self._arrays.make_room(2 * data.room)
            else:
                assert self._watch is not None
                self._watch.make_room()
            code = call()
        if data.asked_for and (not code or code in _AGAIN):
            fcl = self._setup.monitor.scene.fcl
            assert fcl is not None
            fcl.refused += data.asked_for - data.proven
        return code

    def corrected(self, state: State, target: Target, begun: Begun, code: int) -> Step | Begun:
        """Return the step by further QPs after the first one, which ended with `code`; its beginning if unusual."""
        first, covered, corrector = begun.first, 1.0, self._solver.corrector
        if code == Code.NOT_PROVEN or corrector is None:
            return begun
        for qps in range(2, MOST_QPS + 1):
            if qps > FREE_QPS and covered == 1.0 and is_cut_short(self._setup, first):
                covered = first.progress
                corrector.go_back(first)
                self._aim_at(target.part(covered), 1.0)
                self._arrays.data.settled = 0
            self._solver.draw(state.control_vertices, None)
            code = self._called(self._arrays.correct)
            if code == Code.DONE:
                return self._passage(state, target, begun._replace(qps=qps, covered=covered))
            if code not in _AGAIN:
                return self._left(corrector, state, target, begun._replace(covered=covered), qps, code)
        return Step.stopped(state, NO_CONVERGENCE, MOST_QPS, first.solution, begun.rows)

    def _left(
        self, corrector: Corrector, state: State, target: Target, begun: Begun, qps: int, code: int
    ) -> Step | Begun:
        """Return where an attempt goes on after QPs of which the last ended with `code`: at a proof, or at that QP."""
        if code == Code.NOT_PROVEN:
            move = self._solver.led(is_settled=True)
        else:
            # The QP before it led to where this one was linearised; no more is known of its answer.
            move, qps = Move(begun.first.solution, *corrector.point(), 0.0, None), qps - 1
        begun = begun._replace(move=move, reach=self._arrays.data.reach, qps=qps)
        return self._corrects_nothing(state, target, begun) if code == Code.INFEASIBLE else begun

    def _aim_at(self, target: Target, progress: float) -> None:
        """Write the goal at a progress along the `target`."""
        inputs, goal = self._work.inputs, target.goal(progress).over(target.end - target.start)
        inputs[Argument.GOAL][:], inputs[Argument.VELOCITY][:] = goal.position, goal.velocity
        if self._setup.task.turns is not None:
            inputs[Argument.TURNED].reshape(3, 3)[:], inputs[Argument.SPIN][:] = goal.rotation.T, goal.spin

    def _load(self, state: State, target: Target, share: float) -> None:
        """Write the step's state, goal and boxes."""
        data, inputs, monitor = self._arrays.data, self._work.inputs, self._setup.monitor
        self._solver.draw(state.control_vertices, target.vertex_goals)
        if self._layout.general is not None:
            self._solver.bend(state.torsion, base_frame(self._setup.arm, target.base))
        self._solver.aim(self._acceptance.accuracy)
        inputs[Argument.LOWER][:], inputs[Argument.UPPER][:] = target.lower, target.upper
        self._aim_at(target, 0.0)
        if state is not self._held:
            # An interrupt during the writing must not leave a mixture of two states that passes for one.
            self._held = None
            self._arrays.load(state)
            self._held = state
        if target.base is not None:
            self._move_base(state, target.base)
        data.duration, data.share = target.duration, share
        data.safe, data.self_safe = monitor.safe, monitor.self_safe
        if (pieces := monitor.pieces).moving:
            data.time, data.next_time = state.time, target.time
            data.drift = pieces.fastest * target.duration
        else:
            data.time = data.next_time = data.drift = 0.0

    def _move_base(self, state: State, pose: Pose) -> None:
        """Write where the base is at the end of the step."""
        arm = self._setup.arm
        based = arm.based(state.q, pose)
        self._arrays.based_q[:], self._arrays.based_nodes[:] = based.reshape(-1), arm.nodes(based).reshape(-1)
        if len(self._layout.tracked):
            self._arrays.base_normal[:] = base_frame(arm, pose)[:, 2]

    def _passage(self, state: State, target: Target, begun: Begun | None = None) -> Step:
        """Return the step that the call took, after the QPs with which it had `begun`."""
        data, work, layout = self._arrays.data, self._work, self._layout
        block = self._arrays.after.copy()
        block.setflags(write=False)
        of_q, of_nodes, of_vertices, of_values, of_motion, of_rates, of_tip = self._arrays.parts
        q, tip = block[of_q].reshape(work.shape), block[of_tip]
        torsion = work.torsions.copy() if layout.torsion else state.torsion
        time, late = state.after(target.duration)
        then = record(
            State,
            time=time,
            q=q,
            nodes=q if self._arrays.is_placed else block[of_nodes].reshape(-1, 3),
            control_vertices=block[of_vertices].reshape(-1, 3),
            torsion=torsion,
            quantities=block[of_values],
            rates=block[of_rates],
            motion=block[of_motion].reshape(work.shape),
            duration=target.duration,
            shortfall={},
            late=late,
            tip=Pose(tip[:3], tip[3:].reshape(3, 3)),
        )
        if begun is None:
            of_qps = 1, self._solver.answered(), self._rows()
        else:
            of_qps = begun.qps, begun.first.solution, begun.rows
        if self._has_limit and (beyond := self._setup.too_long(then.nodes - state.nodes)):
            return Step.stopped(state, beyond, *of_qps)
        self._held = None
        self._arrays.before[:] = block[: len(self._arrays.before)]
        self._held = then
        progress = work.data.reached if begun is None else begun.covered * work.data.reached
        gap = data.gap if layout.tracked.size else np.nan
        return self._acceptance.passed(then, progress, gap, *of_qps)

    def _ask(self) -> None:
        """Have FCL answer the questions of this round."""
        began, fcl = perf_counter(), self._setup.monitor.scene.fcl
        assert fcl is not None
        asked = self._arrays.asked[: self._work.data.near] == self._arrays.data.round
        for k in asked.nonzero()[0].tolist():
            _, other, is_self = self._arrays.named[k].tolist()
            piece = None if is_self else other
            fcl.answer(self._arrays.questions[k], piece, self._arrays.data.at_time, self._arrays.answers[k])
        self.spent[0] += perf_counter() - began

    def _rows(self) -> ClearanceRows:
        """Return the rows of the last QP."""
        near, work = int(self._work.data.near), self._work
        if not near or self._watch is None:
            return _NO_ROWS
        names, named = self._setup.monitor.names, self._arrays.named[:near].copy()

        def name(k: int) -> str:
            body, other, is_self = named[k].tolist()
            return names.clearance(Pair(body, other, bool(is_self)))

        data = self._arrays.data
        return ClearanceRows(
            *work.near(near),
            name,
            data.proven,
            (data.asked_for + data.unasked if data.asks else near) - data.proven,
        )

    def _denied(self, state: State, target: Target, share: float) -> Step | None:
        """Return the step whose first QP has no answer; None if it may have one without the margin."""
        rows = self._rows()
        if len(rows) and rows.lower.max() > 0.0:
            return None
        at, curve = state.q + 0.5 * share * state.motion, (state.control_vertices, state.torsion)
        asked = QPInput(state.q, at, *curve, target, target.goal(0.0), 0.0, rows, True)
        return self._failed(state, asked, 1)

    def _corrects_nothing(self, state: State, target: Target, begun: Begun) -> Step:
        """Return the step whose next QP after its beginning has no answer."""
        move, target = begun.move, target if begun.covered == 1.0 else target.part(begun.covered)
        at = move.q, move.q, move.vertices, move.torsion
        asked = QPInput(*at, target, target.goal(move.progress), move.progress, self._rows(), False)
        return self._failed(state, asked, begun.qps + 1, begun.first.solution, begun.rows)

    def _failed(
        self,
        state: State,
        asked: QPInput,
        qps: int,
        solution: StepSolution | None = None,
        rows: ClearanceRows | None = None,
    ) -> Step:
        """Return the step whose last QP, that which was `asked`, has no answer."""
        error = InfeasibleStepError(CONTRADICTION)
        error.build = lambda: self._engine.qp(asked)
        return Step.failed(state, error, qps, solution, rows)
