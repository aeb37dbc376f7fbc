"""A truss as an arm: its configuration is the positions of its nodes, eqs. (7)-(10)."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np

from vgtm_qp.arm.arm import (
    Arithmetic,
    Arm,
    Ends,
    Kinematics,
    Label,
    MotionPattern,
    Newton,
    Pose,
    Stations,
    Tip,
)
from vgtm_qp.arm.frames import frame_constants
from vgtm_qp.arm.symbols import Constants
from vgtm_qp.arm.truss.bounds import bend_function, frame_deviation, hollow, longest_paths
from vgtm_qp.arm.truss.kinematics import EndKinematics, LengthRows, length_gradients, place_function, solved
from vgtm_qp.arm.truss.lengths import LengthSolver
from vgtm_qp.arm.truss.mobility import TrussDescription, describe
from vgtm_qp.arm.truss.symbols import TrussSymbols
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.arrays import Array, Index
from vgtm_qp.compiled import Kernel
from vgtm_qp.errors import TrussError
from vgtm_qp.geometry.bodies import capsules
from vgtm_qp.rows.members import member_end_function


class TrussArm(Arm):
    """See ``arm.Arm``."""

    def __init__(self, truss: Truss) -> None:
        self.truss = self.bays = truss
        self.kind, self.segments = truss.module, truss.bays
        self.leaves_chords = truss.joints is not None
        self.node_names, self.quantity_names = truss.node_names, truss.member_names
        self.home = self.home_configuration = truss.home
        self.base, self.free = truss.base, truss.free
        self.home_quantities, self.height = truss.home_lengths, truss.height
        first, last = truss.home[truss.members.T]
        self.unit = float(np.linalg.norm(last - first, axis=1).mean())
        self.actuated, self.actuator_units = truss.actuated, ("m",) * len(truss.actuators)
        self.stroke, self.rate, self.acceleration = truss.stroke, truss.rate, truss.acceleration
        self.stations = Stations(
            truss.faces, truss.face_weights, truss.face_frames, truss.trackable, truss.face_stride
        )
        self.end_effector = Tip(truss.tip, truss.tip_weights, truss.tip_frame)
        # Members end in their nodes or, in offset joints, in points of their own.
        ends = truss.members if truss.joints is None else np.arange(2 * truss.member_count).reshape(-1, 2)
        self.bodies = capsules(ends, truss.radius, truss.member_names, joints=truss.members)
        self._first, self._last = np.ascontiguousarray(ends.T)

    @cached_property
    def motion_pattern(self) -> MotionPattern:
        """The length Jacobian, and -1 in the rows of actuated members."""
        truss, scatter = self.truss, self.truss.scatter
        labels = tuple(
            Label(
                f"{'actuator' if on else 'member'}: {name}", "actuated member" if on else "fixed member", "m"
            )
            for name, on in zip(truss.member_names, truss.actuated, strict=True)
        )
        own = 3 * len(truss.free) + np.arange(len(truss.actuators))
        return MotionPattern(
            np.concatenate([scatter.member, truss.actuators]), np.concatenate([scatter.column, own]), labels
        )

    def nodes(self, q: Array) -> Array:
        """Return the configuration itself."""
        return q

    def arithmetic(self) -> Arithmetic | None:
        """See ``arm.Arm``; with offset joints the ends of members are no nodes."""
        truss, based = self.truss, np.flatnonzero(np.repeat(self.base, 3))
        bend, ends = None, None
        if truss.joints is not None:
            nodes, offset = truss.joints.triangle[truss.members], truss.joints.offset
            kernels = place_function(truss).kernel(), Kernel(member_end_function())
            ends = Ends(*kernels, nodes.reshape(-1, 3), offset.reshape(-1, 3))
            bend = bend_function(truss).kernel()
        lengths = True, self._first, self._last, np.zeros(len(self._first))
        return Arithmetic(None, bend, *lengths, None, based, ends)

    def measured(self, q: Array) -> Array:
        """See ``arm.Arm``: the distances of the members' ends."""
        points = self.points(q)
        way = points.take(self._first, axis=0) - points.take(self._last, axis=0)
        return np.asarray(np.sqrt(np.einsum("mc,mc->m", way, way)))

    def based(self, q: Array, pose: Pose) -> Array:
        return np.where(self.truss.base[:, None], self.truss.home @ pose.rotation.T + pose.position, q)

    def carried(self, q: Array, before: Pose, after: Pose) -> Array:
        return before.carry(q, after)

    def advanced(self, q: Array, nodes: Array, strokes: Array) -> Array:  # noqa: ARG002
        return q + nodes

    def newton(self, tracked: Index | None = None) -> Newton:
        given, held = None, None
        if tracked is not None:
            given = np.flatnonzero(~self.actuated)
            held = self.stations.nodes[tracked], self.stations.weights[tracked]
        lengths = LengthSolver(self.truss, given, held)

        def step(q: Array, missing: Array, kinematics: Kinematics) -> Array:
            q = q.copy()
            q[self.truss.free] += lengths.solve(kinematics.gradient, missing)
            return q

        return step

    def points(self, q: Array) -> Array:
        """Return the nodes; with offset joints the two ends of each member."""
        return q if self.truss.joints is None else self.truss.member_ends(q).reshape(-1, 3)

    def over_nodes(self, q: Array, points: Index, coefficients: Array) -> tuple[Index, Array]:
        """See ``arm.Arm``: the three nodes that orient an offset joint move the member end in it."""
        ends, (count, slots) = self._ends, points.shape
        if ends is None:
            return points, coefficients
        ends.evaluate(q)
        member, end = points >> 1, points & 1
        by_nodes = np.einsum("rsc,rscn->rsn", coefficients, ends.jacobian[member, end])
        return ends.nodes[member, end].reshape(count, 3 * slots), by_nodes.reshape(count, 3 * slots, 3)

    @cached_property
    def _ends(self) -> EndKinematics | None:
        truss = self.truss
        return None if truss.joints is None else EndKinematics(truss.members, truss.joints)

    def forces(self, q: Array, load: Array, gravity: Array | None = None) -> Array:  # noqa: ARG002
        at_nodes, tip = np.zeros_like(self.home), self.end_effector
        at_nodes[tip.nodes] = tip.weights[:, None] * load
        jacobian = self.truss.scatter.sparse(length_gradients(self.truss, q))
        return solved(jacobian.T, at_nodes[self.free].reshape(-1))

    def travel(self, motion: Array) -> float:
        return float(np.abs(motion).max())

    def reach(self) -> Array:
        bounds, tip = longest_paths(self.truss, np.flatnonzero(self.base)), self.end_effector
        return np.asarray(bounds[:, tip.nodes] @ np.abs(tip.weights))

    def hollow(self) -> float:
        return hollow(self.truss)

    def unreachable(self) -> tuple[str, ...]:
        return describe(self.truss).unreachable

    def deviation(self, start: Array, end: Array) -> float:
        """See ``arm.Arm``: offset joints turn during the motion.

        A curve is no further from its chord than an eighth of the greatest second derivative.
        """
        if self.truss.joints is None:
            return 0.0
        kernel = self._bend
        kernel.inputs[0][:], kernel.inputs[1][:] = start.reshape(-1), end.reshape(-1)
        kernel()
        return 0.25 * float(kernel.outputs[0][0])

    @cached_property
    def _bend(self) -> Kernel:
        return bend_function(self.truss).kernel()

    def tip_deviation(self, start: Array, end: Array, reach: float) -> float:
        """See ``arm.Arm``: infinite where the tip turns too far for a bound."""
        kernel, nodes = self._tip_turning, self.end_effector.nodes
        kernel.inputs[0][:], kernel.inputs[1][:] = start[nodes].reshape(-1), end[nodes].reshape(-1)
        kernel()
        bound = reach * float(kernel.outputs[0][0])
        return bound if math.isfinite(bound) else math.inf

    @cached_property
    def _tip_turning(self) -> Kernel:
        tip = self.end_effector
        kernel = Kernel(frame_deviation(len(tip.nodes)), compiled=False)
        kernel.inputs[2][:], kernel.inputs[3][:], _ = frame_constants(
            self.home[tip.nodes][None], tip.frame[None]
        )
        return kernel

    def symbols(self, constants: Constants) -> TrussSymbols:
        return TrussSymbols(self.truss, constants)

    def describe(self) -> TrussDescription:
        return describe(self.truss)

    def record(self) -> dict[str, Any]:
        """See ``arm.Arm``.

        Keys: ``module``, ``bays``, ``node_names``, ``home`` (N, 3), ``base`` (indices of given nodes),
        ``member_names``, ``length`` (M, at home), ``tip`` (``nodes``, ``weights``, ``frame`` at home) and ``joints``
        (``triangle``, ``offset``, see ``truss.Joints``; None for pin joints). Lengths in m.
        """
        truss, joints = self.truss, self.truss.joints
        return {
            **super().record(),
            "module": truss.module,
            "bays": truss.bays,
            "node_names": list(truss.node_names),
            "home": truss.home.tolist(),
            "base": np.flatnonzero(truss.base).tolist(),
            "member_names": list(truss.member_names),
            "length": truss.home_lengths.tolist(),
            "tip": {key: getattr(self.end_effector, key).tolist() for key in ("nodes", "weights", "frame")},
            "joints": joints and {"triangle": joints.triangle.tolist(), "offset": joints.offset.tolist()},
        }

    def recorded(self, q: Array, quantities: Array) -> dict[str, Any]:
        return {
            "nodes": q,
            "members": self.truss.members,
            "member_names": np.array(self.truss.member_names),
            "member_actuated": self.truss.actuated,
            "member_lengths": quantities,
        }

    def motion_rows(self, *values: Array) -> LengthRows:
        """See ``arm.Arm``: gradients (3 Q M,) and right-hand sides (M,)."""
        gradient, rhs = values
        return LengthRows(self.truss, gradient.reshape(len(rhs), -1, 3), rhs)


def truss_of(arm: Arm) -> Truss:
    """Return the truss of an arm, for methods that know trusses alone.

    Raises
    ------
    TrussError
        It is another arm.
    """
    if not isinstance(arm, TrussArm):
        raise TrussError(f"a {arm.kind} arm is no truss; expected [truss]")
    return arm.truss
