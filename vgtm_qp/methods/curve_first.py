"""The paper's method, section 4: the curve first, then the truss tracks it; and its form with a QP for the curve."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vgtm_qp.arrays import Array
from vgtm_qp.curve.curve import Curve
from vgtm_qp.errors import CurveError, SolverError
from vgtm_qp.methods.assembly import CurveNodes, rotation_vectors
from vgtm_qp.methods.curve_motion import CurveMotion
from vgtm_qp.methods.resolver import MethodResolver, Moved, displacement_to
from vgtm_qp.methods.segments import make_segments
from vgtm_qp.methods.tracking import Tracker
from vgtm_qp.problem import Problem
from vgtm_qp.step.actuation import Actuation
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.path import Path

_SMALLEST = 1 / 64
_MAX_QPS = 5
_LEAST_PROGRESS = 1 / 64
_SLACK = 1e-10
_BETWEEN = 5e-5


class CurveFirstResolver(MethodResolver):
    """Moves the curve by itself, then the truss after it, recursively or in parallel.

    With the method ``curve-pseudoinverse`` the curve moves by eqs. (37)-(38) and nothing else is looked at. With
    ``qp`` it moves by a QP that knows the clearances, the truss tracks it exactly, and a step that breaks a limit
    or a clearance is halved.

    Raises
    ------
    CurveError, ProblemError, TrussError
        The arm cannot be built, or cannot track a curve.
    """

    def __init__(self, problem: Problem) -> None:
        method = problem.method
        # The solver is never called; this one compiles no kernels.
        coupled = {**method.kept_by("qp", "coupled"), "solver": "piqp"}
        super().__init__(build_arm(problem.replace({"method": coupled})))
        setup = self.setup
        if setup.base_motion is not None:
            raise CurveError(
                'a moving base takes tracking = "coupled" or "none", or the method pseudoinverse'
            )
        self.motion = CurveMotion(problem, setup)
        segments = make_segments(setup.layout, setup.task.turns)
        self.tracker = Tracker(
            setup.layout, setup.kinematics, segments, parallel=method.tracking == "parallel"
        )
        self._s = self.motion.s[[segment.face for segment in segments]]
        self._weights = self.motion.home.family.weights(self._s)
        self._frames = any(segment.tracks != "position" for segment in segments)
        self._actuation = Actuation(replace(setup, slow_approach=False, jams=()))
        self._correct, self._is_qp = method.correct, method.name == "qp"
        self.solver = "daqp" if self._is_qp else None

    @property
    def curve(self) -> Curve:
        """The reference curve in the present state."""
        vertices, torsion = self.state.control_vertices, self.state.torsion
        return replace(self.motion.home, control_vertices=vertices, torsion=torsion)

    def _move(self, path: Path, start: float, end: float, dt: float) -> Moved:
        if self._is_qp:
            return self._move_safely(path, start, end, dt)
        state, before = self.state, self.curve
        goal = displacement_to(path.at(end), path.at(start))
        curve = self.motion.follow(before, goal, state.time, state.nodes, correct=self._correct)
        nodes = self._nodes(curve)
        self._clock.add("solve")
        if self._correct:
            X = self.tracker.track(state.nodes, nodes)
        else:
            old = self._nodes(before)
            turned = rotation_vectors(nodes.frame @ np.swapaxes(old.frame, 1, 2))
            X = self.tracker.rates(state.nodes, nodes.position - old.position, turned)
        self._clock.add("correction")
        return Moved(X, curve.control_vertices, curve.torsion)

    def _move_safely(self, path: Path, start: float, end: float, dt: float) -> Moved:
        """Move by the curve's QP; halve the piece of path until the tracking truss keeps every limit."""
        state, share, reason = self.state, 1.0, ""
        while share >= _SMALLEST:
            goal = start + share * (end - start)
            whole = displacement_to(path.at(goal), path.at(start))
            curve, X, progress, time = self.curve, np.array(state.nodes), 0.0, state.time
            for _ in range(_MAX_QPS):
                try:
                    now = path.at(start + progress * (goal - start))
                    now = now._replace(velocity=whole.velocity, spin=whole.spin)
                    curve, change, active = self.motion.follow_qp(curve, now, progress, time, X)
                    progress = min(max(progress + change, 0.0), 1.0)
                    curve = self.motion.corrected(curve, path.at(start + progress * (goal - start)))
                    self._clock.add("solve")
                    X = self.tracker.track(state.nodes, self._nodes(curve))
                except SolverError as error:
                    reason = str(error)
                    break
                self._clock.add("correction")
                time = state.time + dt
                reason = self._broken(X, dt)
                self._clock.add("acceptance")
                if not reason and share * progress >= _LEAST_PROGRESS:
                    return Moved(X, curve.control_vertices, curve.torsion, share * progress)
                if not reason or progress < _LEAST_PROGRESS or reason.startswith("stroke"):
                    reason = reason or ", ".join(active) or "no progress along the path"
                    break
            share /= 2.0
        raise SolverError(reason)

    def _nodes(self, curve: Curve) -> CurveNodes:
        """Return the curve nodes of the segments; their frames are identities where none is tracked."""
        s = self._s
        frame = curve.frame(s) if self._frames else np.broadcast_to(np.eye(3), (len(s), 3, 3))
        return CurveNodes(self._weights @ curve.control_vertices, frame)

    def _broken(self, X: Array, dt: float) -> str:
        """Return which limit the step to node positions `X` would break, empty if none."""
        setup, state = self.setup, self.state
        lower, upper = self._actuation.box(state, dt)
        setup.kinematics.evaluate(X)
        lengths = setup.kinematics.quantities[setup.arm.actuators]
        beyond = np.maximum(lower - lengths, lengths - upper)
        worst = int(np.argmax(beyond))
        if beyond[worst] > _SLACK:
            return f"stroke or rate: {self._actuation.names[worst]}, {beyond[worst]:.2g} m beyond"
        monitor, time, points = setup.monitor, state.time + dt, setup.arm.points(X)
        if not monitor.keeps(points, time, setup.safe - _SLACK, setup.self_safe - _SLACK):
            return "clearance at the end of the step"
        floors = setup.safe - _BETWEEN, max(setup.self_safe - _BETWEEN, 0.0)
        if not monitor.between(setup.arm.points(state.q), points, state.time, time, *floors).certified:
            return "clearance between the states"
        return ""
