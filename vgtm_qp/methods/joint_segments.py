"""The equations of an arm in joint space in segments, section 4.8: end stations as functions of joints, eq. (39)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from vgtm_qp.arm.arm import Kinematics
from vgtm_qp.arm.joint_space import JointSpaceArm
from vgtm_qp.arrays import Array
from vgtm_qp.methods.assembly import CurveNodes, station_gaps, station_motions
from vgtm_qp.methods.segments import Segment, moved_by_joints, tip_rows


class JointSegments:
    """See ``tracking.SegmentedArm``: coordinates are the actuators, angles times the arm's unit.

    Segments move with all joints before them.
    """

    def __init__(self, arm: JointSpaceArm, kinematics: Kinematics) -> None:
        self.coordinates, self.furthest = len(arm.actuators), 2.0 * arm.unit
        self.arm, self.kinematics = arm, kinematics
        self.by_joints = np.zeros((len(arm.home), 3, self.coordinates))

    def move(self, q: Array, own: slice, d: Array) -> None:
        """See ``tracking.SegmentedArm``; followers move with the joints that they follow."""
        strokes = np.zeros(self.coordinates)
        strokes[own] = d / self.arm.levers[own]
        q[:] = self.arm.advanced(q, q, strokes)

    def equations(self, segments: Sequence[Segment]) -> tuple[Callable[[Array], None], list[JointGroup]]:
        """See ``tracking.SegmentedArm``."""
        shapes: dict[tuple[int, str], list[Segment]] = {}
        for segment in segments:
            shapes.setdefault((segment.columns, segment.tracks), []).append(segment)
        return self._evaluate, [JointGroup(self, alike) for alike in shapes.values()]

    def _evaluate(self, q: Array) -> None:
        self.kinematics.evaluate(q)
        self.by_joints = moved_by_joints(self.arm, self.kinematics)


class JointGroup:
    """The equations of K segments of one shape, stacked: see ``tracking.SegmentEquations``."""

    def __init__(self, arm: JointSegments, segments: Sequence[Segment]) -> None:
        one = segments[0]
        self.numbers = np.array([segment.number for segment in segments])
        self.columns = np.array([segment.start for segment in segments])[:, None] + np.arange(one.columns)
        self._arm, self._tracks = arm, one.tracks
        self._before = max(segment.start for segment in segments)
        stations = arm.arm.stations
        numbers = [segment.station for segment in segments]
        self._nodes, self._weights = stations.nodes[numbers], stations.weights[numbers]

    def matrices(self) -> tuple[Array, Array]:
        """See ``tracking.SegmentEquations``; columns beyond those before a segment are without meaning."""
        arm = self._arm
        if self._tracks == "position":
            rows = np.einsum("kp,kpcj->kcj", self._weights, arm.by_joints[self._nodes])
        else:
            # Only the last segment, which ends in the end effector, turns its station.
            rows = tip_rows(arm.arm, arm.kinematics, arm.by_joints, self._tracks)[None]
        own = np.take_along_axis(rows, self.columns[:, None], axis=2)
        return own, rows[:, :, : self._before]

    def displacements(self, moved: Array, turned: Array) -> Array:
        """See ``tracking.SegmentEquations``."""
        return station_motions(self._tracks, self._frames, moved[self.numbers], turned[self.numbers])

    def residuals(self, q: Array, nodes: CurveNodes) -> Array:
        """See ``tracking.SegmentEquations``."""
        X = self._arm.arm.nodes(q)
        centres = np.einsum("kp,kpc->kc", self._weights, X[self._nodes])
        return station_gaps(self._tracks, centres, self._frames, nodes.of(self.numbers))

    @property
    def _frames(self) -> Array:
        """(1, 3, 3) the frame of the end effector, in which the last segment ends."""
        return self._arm.kinematics.tip_rotation[None]
