"""The second arm behind the door: joints one after another, whose values and base pose are the configuration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from vgtm_qp.arm.arm import Arm, Label, MotionPattern, Pose, Stations, Tip
from vgtm_qp.arm.frames import frames_at
from vgtm_qp.arm.record import or_none
from vgtm_qp.arm.serial.chain import Array, Index, Mask, SerialChain, chain_function
from vgtm_qp.arm.symbols import Constants
from vgtm_qp.compiled import Kernel
from vgtm_qp.geometry.bodies import Bodies, capsules
from vgtm_qp.rotation import rotation_from_vector, vector_from_rotation

_RANK_TOLERANCE = 1e-8


class ChainRows:
    """d_rho - K d_a = r, for an arm whose actuators are its configuration; see ``arm.MotionRows``."""

    def __init__(self, response: Array, rhs: Array) -> None:
        self._response, self.rhs = response, rhs

    @property
    def values(self) -> Array:
        """See ``arm.MotionRows``."""
        return np.concatenate([np.ones(len(self.rhs)), -self._response.reshape(-1)])

    def response(self) -> tuple[Array, Array]:
        """Return K and r."""
        return self._response, self.rhs


class ChainKinematics:
    """See ``arm.Kinematics``."""

    def __init__(self, arm: SerialArm, *, compiled: bool) -> None:
        q = ca.MX.sym("q", len(arm.chain) + 6)
        X, jacobian = chain_function(arm.chain)(q, *(ca.DM(ca.DM(part)) for part in arm.shaped_geometry))
        tip, stations = arm.end_effector, arm.stations
        frames = frames_at(X, arm.home[stations.nodes], stations.frames, stations.nodes)
        ends = frames_at(X, arm.home[tip.nodes][None], tip.frame[None], tip.nodes[None])
        self._kernel = Kernel(ca.Function("chain_arm", [q], [X, jacobian, *frames, *ends]), compiled=compiled)
        self._joints, self._arm, outputs = len(arm.chain), arm, self._kernel.outputs
        self.quantities, self.gradient = np.zeros(self._joints), np.zeros((0, 0, 3))
        self._jacobian = outputs[1].reshape(self._joints, -1).T
        self.station_rotation = outputs[2].reshape(-1, 3, 3).transpose(0, 2, 1)
        self.station_spin = outputs[3].reshape(-1, 9, 3).transpose(0, 2, 1)
        self.tip_rotation, self.tip_spin = outputs[4].reshape(3, 3).T, outputs[5].reshape(9, 3).T

    def evaluate(self, q: Array) -> None:
        """See ``arm.Kinematics``."""
        self._kernel.inputs[0][:] = q
        self._kernel()
        self.quantities[:] = q[: self._joints]

    evaluate_quantities = evaluate

    def motion(self) -> ChainRows:
        """See ``arm.Kinematics``."""
        rows = (3 * self._arm.free[:, None] + np.arange(3)).reshape(-1)
        return ChainRows(self._jacobian[np.ix_(rows, self._arm.actuators)], np.zeros(len(rows)))


class ChainSymbols:
    """See ``arm.ArmSymbols``: K is the geometric Jacobian, and there is nothing to eliminate."""

    can_eliminate = True

    def __init__(self, arm: SerialArm, constants: Constants) -> None:
        self._joints, self._free, self._actuators = len(arm.chain), arm.free, arm.actuators.tolist()
        self.shape, self.given = (self._joints + 6, 1), list(range(len(arm.node_names)))
        self.home = constants.add("home", arm.home_quantities)
        parts = zip(("axes", "positions", "rotations", "tip"), arm.chain.geometry(), strict=True)
        self._geometry = [constants.add(name, part.reshape(-1, 3)) for name, part in parts]
        self._function = chain_function(arm.chain)
        self._fixed = np.flatnonzero(~arm.actuated).tolist()

    def _chain(self, q: ca.MX) -> tuple[ca.MX, ca.MX]:
        nodes, jacobian = self._function(q, *self._geometry)
        return nodes, jacobian

    def nodes(self, q: ca.MX) -> ca.MX:
        """See ``arm.ArmSymbols``."""
        return self._chain(q)[0]

    def quantities(self, q: ca.MX) -> ca.MX:
        """See ``arm.ArmSymbols``: the joints' values."""
        return q[: self._joints]

    def motion(self, q: ca.MX, at: ca.MX, moved: ca.MX) -> list[ca.MX]:  # noqa: ARG002
        """See ``arm.ArmSymbols``."""
        rows = [3 * int(node) + axis for node in self._free for axis in range(3)]
        return [self._chain(at)[1][rows, self._actuators], ca.vec(moved[:, self._free.tolist()])]

    def response(self, q: ca.MX, at: ca.MX, moved: ca.MX) -> ca.MX:
        """See ``arm.ArmSymbols``."""
        return ca.horzcat(*self.motion(q, at, moved))

    def coordinates(self, nodes: Any, strokes: Any) -> Any:  # noqa: ARG002
        """See ``arm.ArmSymbols``: the actuators."""
        return strokes

    def along(self, q: ca.MX, coordinates: ca.MX) -> ca.MX:
        """See ``arm.ArmSymbols``."""
        q = q * 1.0
        q[self._actuators] = q[self._actuators] + coordinates
        return q

    def closed(self, q: ca.MX, lower: ca.MX, upper: ca.MX) -> ca.MX:
        """See ``arm.ArmSymbols``."""
        q = q * 1.0
        q[self._actuators] = ca.fmax(lower, ca.fmin(upper, q[self._actuators]))
        q[self._fixed] = self.home[self._fixed]
        return q

    def error(self, quantities: ca.MX, lower: ca.MX, upper: ca.MX) -> ca.MX:
        """See ``arm.ArmSymbols``."""
        values = quantities[self._actuators]
        beyond = ca.fmax(ca.fmax(values - upper, lower - values), 0.0)
        return ca.norm_2(ca.vertcat(beyond, quantities[self._fixed] - self.home[self._fixed]))

    def held(self, tracked: Sequence[int]) -> Callable[[Any, Any], Any] | None:  # noqa: ARG002
        """See ``arm.ArmSymbols``: stations alone do not determine the joints."""
        return None


class SerialArm:
    """See ``arm.Arm``; its nodes are the joints' origins, the tip, and two beside each station."""

    kind = "serial"
    bays = None
    leaves_chords = True

    def __init__(self, chain: SerialChain) -> None:
        self.chain = chain
        self.node_names, self.quantity_names = chain.node_names, chain.names
        self.stroke, self.rate, self.acceleration = chain.limits, chain.rate, chain.acceleration
        self.home_quantities, self.segments = chain.home, len(chain)
        self.home_configuration = np.concatenate([chain.home, np.zeros(6)])
        self.actuated: Mask = ~chain.locked
        self.actuators: Index = np.flatnonzero(self.actuated)
        self.actuator_units = tuple("rad" if chain.revolute[j] else "m" for j in self.actuators)
        shapes = ((3, len(chain)), (3, len(chain)), (3, 3 * len(chain)), (3, 1))
        self.shaped_geometry = [
            part.reshape(shape, order="F") for part, shape in zip(chain.geometry(), shapes, strict=True)
        ]
        q = ca.SX.sym("q", len(chain) + 6)
        geometry = [ca.DM(part) for part in self.shaped_geometry]
        place = ca.Function("chain_nodes", [q], [chain_function(chain)(q, *geometry)[0]])
        self._nodes = Kernel(place, compiled=False)
        self.home = self.nodes(self.home_configuration)
        self.base: Mask = np.isin(np.arange(len(self.home)), [0, 1, *chain.station_nodes[0]])
        self.free: Index = np.flatnonzero(~self.base)
        self.height = float(np.linalg.norm(np.diff(self.home[: len(chain) + 2], axis=0), axis=1).sum())

    @cached_property
    def stations(self) -> Stations:
        """Base, every so many joints, and the tip; their z-axes lie along the arm at home."""
        nodes = self.chain.station_nodes
        centres = self.home[nodes[:, 0]]
        frames = [np.eye(3)]
        for before, after in pairwise(centres):
            frames.append(_leaning(frames[-1], after - before))
        weights = np.tile([1.0, 0.0, 0.0], (len(nodes), 1))
        return Stations(nodes, weights, np.stack(frames), self._trackable(nodes), word="joint")

    def _trackable(self, nodes: Index) -> tuple[str, ...]:
        """Return whether all stations can keep their positions on the curve at once, by rank at home."""
        jacobian = self._jacobian_at_home[:, self.actuators]
        rows = jacobian.reshape(-1, 3, len(self.actuators))[nodes[1:, 0]].reshape(-1, len(self.actuators))
        values = np.linalg.svd(rows, compute_uv=False)
        full = len(rows) <= rows.shape[1] and values[-1] > _RANK_TOLERANCE * values[0]
        return ("position",) if full else ()

    @cached_property
    def _jacobian_at_home(self) -> Array:
        found = chain_function(self.chain)(self.home_configuration, *(ca.DM(p) for p in self.shaped_geometry))
        return np.asarray(found[1], dtype=float)

    @cached_property
    def end_effector(self) -> Tip:
        """The last station."""
        return Tip(self.chain.station_nodes[-1], np.array([1.0, 0.0, 0.0]), self.stations.frames[-1])

    @cached_property
    def bodies(self) -> Bodies:
        """Links between successive origins; those of joints in one place are joined as if they were one."""
        chain, count = self.chain, len(self.chain)
        apart = (chain.lengths[1:] > 0.0) | ~chain.revolute
        place = np.arange(count + 2)
        for node in range(count, 0, -1):
            place[node] = node if apart[node - 1] else place[node + 1]
        kept = np.flatnonzero(apart)
        points = np.stack([kept + 1, kept + 2], axis=1)
        names = [chain.names[j] for j in kept]
        return capsules(points, chain.radius, names, joints=place[points], kind="link")

    @cached_property
    def motion_pattern(self) -> MotionPattern:
        """d_rho - K d_a, dense in the actuators."""
        rows, count = 3 * len(self.free), len(self.actuators)
        grid = np.indices((rows, count)).reshape(2, -1)
        labels = tuple(
            Label(f"node: {self.node_names[n]} {axis}", "kinematics", "m")
            for n in self.free
            for axis in "xyz"
        )
        every = np.arange(rows)
        return MotionPattern(
            np.concatenate([every, grid[0]]), np.concatenate([every, rows + grid[1]]), labels
        )

    def nodes(self, q: Array) -> Array:
        """See ``arm.Arm``."""
        self._nodes.inputs[0][:] = q
        self._nodes()
        return self._nodes.outputs[0].reshape(-1, 3).copy()

    points = nodes

    def over_nodes(self, q: Array, points: Index, coefficients: Array) -> tuple[Index, Array]:  # noqa: ARG002
        """See ``arm.Arm``: the points are the nodes."""
        return points, coefficients

    def measured(self, q: Array) -> Array:
        """See ``arm.Arm``."""
        return np.array(q[:-6])

    def based(self, q: Array, pose: Pose) -> Array:
        """See ``arm.Arm``."""
        return np.concatenate([q[:-6], pose.position, vector_from_rotation(pose.rotation)])

    def carried(self, q: Array, before: Pose, after: Pose) -> Array:  # noqa: ARG002
        """See ``arm.Arm``: joints keep their values."""
        return self.based(q, after)

    def advanced(self, q: Array, nodes: Array, strokes: Array) -> Array:  # noqa: ARG002
        """See ``arm.Arm``."""
        q = q.copy()
        q[self.actuators] += strokes
        return q

    def corrected(self, q: Array, missing: Array, solve: Callable[[], Array]) -> Array:  # noqa: ARG002
        """See ``arm.Arm``."""
        return np.concatenate([q[:-6] + missing, q[-6:]])

    def travel(self, motion: Array) -> float:
        """See ``arm.Arm``."""
        turn, slide = self._motions(motion)
        return float(turn @ self._reach + slide.sum() + np.abs(motion[-6:-3]).max(initial=0.0))

    def deviation(self, start: Array, end: Array) -> float:
        """See ``arm.Arm``: an eighth of a bound of the nodes' second derivative on the way, for both of a pair.

        A point's velocity is sum w_j a_j x (X - o_j) + sum d_j a_j, the axes a_j turn with all joints before them, and
        what is beyond a joint moves against it by no more than its own joints make it.
        """
        turn, slide = self._motions(end - start)
        before = np.concatenate([[0.0], np.cumsum(turn)[:-1]])
        beyond = np.cumsum((turn * self._reach + slide)[::-1])[::-1]
        bend = turn @ (2.0 * before * self._reach + beyond) + slide @ before
        return 2.0 * float(bend) / 8.0

    @cached_property
    def _reach(self) -> Array:
        """(J + 1,) reach beyond the base and beyond each joint, m."""
        return np.concatenate([[self.chain.reach[0] + self.chain.lengths[0]], self.chain.reach])

    def _motions(self, motion: Array) -> tuple[Array, Array]:
        """Return turns (J + 1,), rad, the base's first and counted twice, and slides (J + 1,), m."""
        joints, revolute = np.abs(motion[:-6]), self.chain.revolute
        base = 2.0 * float(np.linalg.norm(motion[-3:]))
        turn, slide = np.where(revolute, joints, 0.0), np.where(revolute, 0.0, joints)
        return np.concatenate([[base], turn]), np.concatenate([[0.0], slide])

    def reach(self) -> Array:
        """See ``arm.Arm``."""
        return np.full(int(self.base.sum()), self._reach[0])

    def hollow(self) -> float:
        """See ``arm.Arm``: the tip is the end of the last link."""
        return 0.0

    def unreachable(self) -> tuple[str, ...]:
        """See ``arm.Arm``."""
        return ()

    def kinematics(self, *, compiled: bool = True) -> ChainKinematics:
        """See ``arm.Arm``."""
        return ChainKinematics(self, compiled=compiled)

    def symbols(self, constants: Constants) -> ChainSymbols:
        """See ``arm.Arm``."""
        return ChainSymbols(self, constants)

    def record(self) -> dict[str, Any]:
        """See ``arm.Arm``.

        Keys: ``kind``, ``joint_names``, ``revolute``, ``axis``, ``position``, ``rotation`` (in the frame of the one
        before), ``home``, ``stroke``, ``rate``, ``acceleration``, ``actuated``, ``tip`` in the last frame and
        ``tip_frame`` at home; of the bodies ``body_names``, ``radius``, ``links`` (their points: base, joints, tip) and
        ``joined`` (their ends; bodies with one in common are neighbours). None means no limit.
        """
        chain, bodies = self.chain, self.bodies
        return {
            "kind": self.kind,
            "joint_names": list(chain.names),
            "revolute": chain.revolute.tolist(),
            "axis": chain.axis.tolist(),
            "position": chain.position.tolist(),
            "rotation": chain.rotation.tolist(),
            "home": chain.home.tolist(),
            "stroke": [or_none(limits) for limits in chain.limits],
            "rate": or_none(chain.rate),
            "acceleration": or_none(chain.acceleration),
            "actuated": self.actuated.tolist(),
            "tip": chain.tip.tolist(),
            "tip_frame": self.end_effector.frame.tolist(),
            "body_names": list(bodies.names),
            "radius": bodies.radius.tolist(),
            "links": bodies.points.tolist(),
            "joined": bodies.joints.tolist(),
        }

    def recorded(self, q: Array, quantities: Array) -> dict[str, Any]:  # noqa: ARG002
        """See ``arm.Arm``: the base's pose follows from the problem."""
        names = {"joint_names": np.array(self.chain.names), "body_names": np.array(self.bodies.names)}
        return {"joints": quantities, **names}

    def motion_rows(self, *values: Array) -> ChainRows:
        """See ``arm.Arm``: K column by column, and r."""
        response, rhs = values
        return ChainRows(response.reshape(len(self.actuators), -1).T, rhs)


def _leaning(frame: Array, direction: Array) -> Array:
    """Return the frame (3, 3) turned the short way until its z-axis has that direction (3,)."""
    axis = np.cross(frame[:, 2], direction / np.linalg.norm(direction))
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return frame
    angle = float(np.arctan2(sine, frame[:, 2] @ direction / np.linalg.norm(direction)))
    return np.asarray(rotation_from_vector(angle / sine * axis) @ frame)


@dataclass(frozen=True)
class ChainDescription:
    """The counts of a serial arm.

    Attributes
    ----------
    joints, actuated, links, stations : int
    length : float
        Of the way from the base over the joints to the tip at home, m.
    hard : bool
        Whether all stations can keep their positions on the curve at home.
    """

    joints: int
    actuated: int
    links: int
    stations: int
    length: float
    hard: bool

    def __str__(self) -> str:
        """Return two lines."""
        can = "can" if self.hard else "cannot"
        return (
            f"serial arm of {self.joints} joints, {self.actuated} of them actuated, {self.links} links, "
            f"{self.length:.6g} m long\n"
            f"{self.stations} stations track the curve; they {can} keep their positions on it exactly"
        )


def describe_chain(arm: Arm) -> ChainDescription:
    """Return the counts of a serial arm."""
    count, stations = len(arm.quantity_names), arm.stations
    hard = "position" in stations.trackable
    return ChainDescription(count, len(arm.actuators), len(arm.bodies), len(stations) - 1, arm.height, hard)
