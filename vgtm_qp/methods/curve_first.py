"""The paper's method, section 4: the curve first, then the arm tracks it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vgtm_qp.arm.joint_space import JointSpaceArm
from vgtm_qp.curve.curve import Curve
from vgtm_qp.methods.assembly import BaySegments, CurveNodes, rotation_vectors
from vgtm_qp.methods.curve_motion import CurveMotion
from vgtm_qp.methods.joint_segments import JointSegments
from vgtm_qp.methods.resolver import MethodResolver, Moved, displacement_to
from vgtm_qp.methods.segments import make_segments
from vgtm_qp.methods.tracking import SegmentedArm, Tracker
from vgtm_qp.problem import Problem
from vgtm_qp.qp.terms import Inequality, Objective
from vgtm_qp.step.build import build_arm
from vgtm_qp.step.path import Path


class CurveFirstResolver(MethodResolver, serves="curve-pseudoinverse"):
    """Moves the curve by itself, then the arm after it, recursively or in parallel.

    The curve moves by eqs. (37)-(38).

    Raises
    ------
    ProblemError
        The arm cannot be built, or cannot track a curve.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        objectives: Sequence[Objective] = (),  # noqa: ARG002
        rows: Sequence[Inequality] = (),  # noqa: ARG002
    ) -> None:
        method = problem.method
        coupled = problem.replace({"method": method.kept_by("qp", "coupled")})
        super().__init__(build_arm(coupled, solves=False))
        setup, mistakes = self.setup, []
        table = "truss" if problem.truss is not None else "arm"
        if not setup.layout.vertices:
            text = '"qp" or "pseudoinverse": this method moves a curve that stations track, and this arm has none'
            mistakes.append(problem.mistake(("method", "name"), text))
        if setup.base_motion is not None:
            text = "a base at rest: the methods qp and pseudoinverse know a moving one"
            mistakes.append(problem.mistake((table, "base_motion"), text))
        if setup.jams:
            text = "no actuator that jams on the way: the methods qp and pseudoinverse hold one"
            mistakes.append(problem.mistake((table, "locked"), text))
        if mistakes:
            raise problem.error(mistakes)
        self.motion = CurveMotion(problem, setup)
        arm, kinematics, layout = setup.arm, setup.kinematics, setup.layout
        with problem.blaming(("method", "name"), '"qp", or an arm whose every segment can follow the curve'):
            segments = make_segments(layout, kinematics, setup.task.turns)
        tracked = np.array([segment.station for segment in segments])
        self._s, family, shape = self.motion.s[tracked], self.motion.home.family, layout.shape
        self._weights = family.weights(self._s)
        in_segments: SegmentedArm
        if isinstance(arm, JointSpaceArm):
            in_segments = JointSegments(arm, kinematics)
            # Gaps are measured where the segments end.
            assert shape is not None, "the motion of the curve has its family"
            shape = replace(shape, nodes=self._s, roll=None, tracks_roll=False, spacing=None)
            slopes = family.weights(self._s, 1)
            layout = replace(
                layout, curve_weights=self._weights, curve_slopes=slopes, tracked=tracked, shape=shape
            )
            self._setup = replace(setup, layout=layout)
        else:
            in_segments = BaySegments(layout, kinematics)
        self.tracker = Tracker(in_segments, segments, parallel=method.tracking == "parallel")
        self._frames = any(segment.tracks != "position" for segment in segments)
        self._correct = method.correct

    @property
    def curve(self) -> Curve:
        """The reference curve in the present state."""
        vertices, torsion = self.state.control_vertices, self.state.torsion
        return replace(self.motion.home, control_vertices=vertices, torsion=torsion)

    def lock(self, name: str) -> None:  # noqa: ARG002
        """Refuse: a segment with as many rows as motions could not follow the curve with a locked actuator."""
        self._refuse("hold an actuator", '"qp", "pseudoinverse"')

    def _move(self, path: Path, start: float, end: float, dt: float) -> Moved:  # noqa: ARG002
        state, before = self.state, self.curve
        goal = displacement_to(path.at(end), path.at(start))
        curve = self.motion.follow(before, goal, state.time, state.q, correct=self._correct)
        nodes = self._nodes(curve)
        self._clock.add("solve")
        if self._correct:
            q = self.tracker.track(state.q, nodes)
        else:
            old = self._nodes(before)
            turned = rotation_vectors(nodes.frame @ np.swapaxes(old.frame, 1, 2))
            q = self.tracker.rates(state.q, nodes.position - old.position, turned)
        self._clock.add("correction")
        return Moved(q, curve.control_vertices, curve.torsion)

    def _nodes(self, curve: Curve) -> CurveNodes:
        """Return the curve nodes of the segments; their frames are identities where none is tracked."""
        s = self._s
        frame = np.tile(np.eye(3), (len(s), 1, 1))
        if self._frames:
            frame = curve.frame(s)
            frame[-1] = frame[-1] @ self.motion.roll
        return CurveNodes(self._weights @ curve.control_vertices, frame)
