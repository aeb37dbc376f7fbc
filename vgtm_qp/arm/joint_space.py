"""Arms in joint space: the configuration is joint values and the base's pose, without constraints to eliminate.

A configuration q (J + 6,) holds the joints' values, rad or m, then position, m, and rotation vector, rad, of the base.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from vgtm_qp.arm.arm import Arithmetic, Arm, Kinematics, Label, MotionPattern, Newton, Pose, between
from vgtm_qp.arm.symbols import ArmSymbols, Bound, Constants
from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.compiled import Compiling, Kernel
from vgtm_qp.rotation import vector_near

_KNOWN = 4
"""Number of configurations whose nodes are kept."""


class Follower(NamedTuple):
    """A joint whose value is `multiplier` times another joint's value, plus a constant: a fixed quantity."""

    joint: int
    followed: int
    multiplier: float


@dataclass(frozen=True)
class JointSpaceDescription:
    """What `vgtm check` prints about an arm.

    Attributes
    ----------
    kind : str
    joints, actuated, links, stations : int
    length : float
        Length of the polyline from the base over the joints to the tip at home, m.
    mass : float
        Of what the joints move, as far as it is given, kg.
    hard : bool
        Whether all stations can keep their positions on the curve at home.
    """

    kind: str
    joints: int
    actuated: int
    links: int
    stations: int
    length: float
    mass: float
    hard: bool

    def __str__(self) -> str:
        can = "can" if self.hard else "cannot"
        several = self.stations != 1
        tracking = "stations track the curve; they" if several else "station tracks the curve; it"
        weight = f", {self.mass:.4g} kg" if self.mass else ""
        return (
            f"{self.kind} arm of {self.joints} joints, {self.actuated} of them actuated, {self.links} links, "
            f"{self.length:.6g} m long{weight}\n"
            f"{self.stations} {tracking} {can} keep {'their positions' if several else 'its position'} on it exactly"
        )


@dataclass(frozen=True, eq=False)
class JacobianRows:
    """d_rho - K d_a = rhs; see ``arm.MotionRows``. `jacobian` is K."""

    jacobian: Array
    rhs: Array

    @property
    def values(self) -> Array:
        return np.concatenate([np.ones(len(self.rhs)), -self.jacobian.reshape(-1)])

    def response(self) -> tuple[Array, Array]:
        """Return K and r."""
        return self.jacobian, self.rhs

    def over_actuators(self, rows: Array) -> Array:
        """Return the rows times K."""
        return np.asarray(rows @ self.jacobian)


class JointSpaceArm(Arm):
    """See ``arm.Arm``; everything that follows from the nodes as functions of the joints, base first.

    Each joint has one quantity, its value. The quantity of a follower is fixed: its value less `multiplier`
    times the value of the joint that it follows.

    Attributes
    ----------
    followers : tuple of Follower
        Joints that follow others; a follower follows no follower.
    functions : three of casadi.Function
        (q, *constants) -> nodes (3, N), m; nodes and their Jacobian (3 N, J); nodes and twists (6, J) of the joints,
        the turn of each and the velocity of its body at the origin.
    movers : (N,) int
        Numbers of joints, from the base, that move each node.
    constants : mapping
        Arguments of these besides the configuration, the columns of each as rows.
    revolute : (J,) bool
        True for joints that turn, False for those that slide.
    weight : callable
        (q, gravity (3,), m/s^2) -> what it exerts about the joints' axes, N m, or along them, N, (J,).
    reaches : (J + 1,)
        Bounds of the distance from the base, and from each joint, to any node beyond it in any pose, m.
    """

    bays = None
    leaves_chords = True
    followers: tuple[Follower, ...] = ()
    functions: tuple[ca.Function, ca.Function, ca.Function]
    movers: Index
    constants: Mapping[str, Array]
    revolute: Mask
    weight: Callable[[Array, Array], Array]
    reaches: Array

    @cached_property
    def motion_pattern(self) -> MotionPattern:
        """d_rho - K d_a, dense in the actuators."""
        rows, count = 3 * len(self.free), len(self.actuators)
        grid, own = np.indices((rows, count)).reshape(2, -1), np.arange(rows)
        names = [f"node: {self.node_names[n]} {axis}" for n in self.free for axis in "xyz"]
        labels = tuple(Label(name, "kinematics", "m") for name in names)
        return MotionPattern(np.concatenate([own, grid[0]]), np.concatenate([own, rows + grid[1]]), labels)

    def symbols(self, constants: Constants) -> JointSpaceSymbols:
        return JointSpaceSymbols(self, constants)

    def motion_rows(self, *values: Array) -> JacobianRows:
        """See ``arm.Arm``: K column by column, and r."""
        response, rhs = values
        return JacobianRows(response.reshape(len(self.actuators), len(rhs)).T, rhs)

    def nodes(self, q: Array) -> Array:
        """See ``arm.Arm``; read-only. A step asks for those of its first and last configuration several times."""
        key, known = q.tobytes(), self._known_nodes
        if key not in known:
            if len(known) == _KNOWN:
                del known[next(iter(known))]
            known[key] = self._nodes(q[None])[0]
            known[key].setflags(write=False)
        return known[key]

    def ways(self, start: Array, end: Array, pieces: int) -> Array:
        return self._nodes(between(start, end, pieces))

    def _nodes(self, states: Array) -> Array:
        """Return (K, N, 3) the nodes at configurations (K, J + 6), m."""
        count, (bound, compiling) = len(states), self._placing
        if count not in self._kernels:
            self._kernels[count] = bound.kernel(times=count, compiled=compiling)
        kernel = self._kernels[count]
        kernel.inputs[0][:] = states.reshape(-1)
        kernel()
        return kernel.outputs[0].reshape(count, -1, 3).copy()

    def arithmetic(self) -> Arithmetic:
        bound, compiling = self._placing
        count = len(self.quantity_names)
        first, last, multiplier = np.arange(count), np.zeros(count, dtype=np.int64), np.zeros(count)
        for joint, followed, factor in self.followers:
            last[joint], multiplier[joint] = followed, factor
        levers, based = np.concatenate([self._levers, np.zeros(6)]), count + np.arange(6)
        place = bound.kernel(times=1, compiled=compiling)
        return Arithmetic(place, self.bending(), False, first, last, multiplier, levers, based)

    @abstractmethod
    def bending(self) -> Kernel:
        """Return ``Arithmetic.bend``."""

    @cached_property
    def _bend(self) -> Kernel:
        return self.bending()

    @cached_property
    def _known_nodes(self) -> dict[bytes, Array]:
        """The nodes of the last configurations."""
        return {}

    @cached_property
    def _placing(self) -> tuple[Bound, Compiling]:
        """The function from q to the nodes, and its compilation."""
        constants = Constants()
        symbols = self.symbols(constants)
        q = ca.MX.sym("q", *symbols.shape)
        bound = constants.bound("nodes", [q], [symbols.nodes(q)])
        return bound, Compiling(bound.function)

    @cached_property
    def _kernels(self) -> dict[int, Kernel]:
        """Kernels, by the number of configurations that each evaluates at once."""
        return {}

    def measured(self, q: Array) -> Array:
        values = np.array(q[:-6])
        for joint, followed, multiplier in self.followers:
            values[joint] -= multiplier * values[followed]
        return values

    def following(self, change: Any) -> Any:
        """Return (J,) or (J, 1) changes of the joints; overwrites `change`, the changes of the quantities."""
        for joint, followed, multiplier in self.followers:
            change[joint] = change[joint] + multiplier * change[followed]
        return change

    def by_quantities(self, jacobian: Any) -> Any:
        """Return derivatives (R, J) by the quantities; overwrites `jacobian`, those by the joints."""
        for joint, followed, multiplier in self.followers:
            jacobian[:, followed] = jacobian[:, followed] + multiplier * jacobian[:, joint]
        return jacobian

    def based(self, q: Array, pose: Pose) -> Array:
        return np.concatenate([q[:-6], pose.position, vector_near(pose.rotation, q[-3:])])

    def advanced(self, q: Array, nodes: Array, strokes: Array) -> Array:  # noqa: ARG002
        change = np.zeros(len(q))
        change[self.actuators] = strokes
        return np.asarray(q + self.following(change))

    def newton(self, tracked: Index | None = None) -> Newton:  # noqa: ARG002
        def step(q: Array, missing: Array, _: Kinematics) -> Array:
            return np.concatenate([q[:-6] + self.following(missing.copy()), q[-6:]])

        return step

    def furthest(self, q: Array, lower: Array, upper: Array) -> Array:
        at = q[self.actuators]
        return self.advanced(np.zeros(len(q)), q, np.maximum(upper - at, at - lower))

    def travel(self, motion: Array) -> float:
        joints, base = np.abs(motion[:-6]) @ self._levers, motion[-6:]
        if base.any():
            joints += 2.0 * float(np.linalg.norm(base[3:])) * self.reaches[0] + np.abs(base[:3]).max()
        return float(joints)

    @cached_property
    def _levers(self) -> Array:
        """(J,) bounds of how far a node moves per change of each joint: a reach in m, or 1."""
        return np.where(self.revolute, self.reaches[1:], 1.0)

    def deviation(self, start: Array, end: Array) -> float:
        """See ``arm.Arm``: twice the bound for one node, since two may leave their chords towards each other."""
        return 2.0 * self.tip_deviation(start, end, 0.0)

    def forces(self, q: Array, load: Array, gravity: Array | None = None) -> Array:
        tip, constants = self.end_effector, [value.T for value in self.constants.values()]
        _, jacobian = self.functions[1](q, *constants)
        moved = self.by_quantities(np.array(jacobian)).reshape(len(self.home), 3, -1)
        borne = np.einsum("k,kcj,c->j", tip.weights, moved[tip.nodes], load)
        if gravity is not None:
            borne = borne + self.by_quantities(self.weight(q, gravity)[None])[0]
        return np.asarray(borne)

    def describe(self) -> JointSpaceDescription:
        stations, hard = len(self.stations) - 1, "position" in self.stations.trackable
        counts = self.segments, len(self.actuators), len(self.bodies), stations
        return JointSpaceDescription(self.kind, *counts, self.height, self.mass, hard)

    def recorded(self, q: Array, quantities: Array) -> dict[str, Any]:
        """See ``arm.Arm``: the base's pose follows from the problem."""
        names = {"joint_names": np.array(self.quantity_names), "body_names": np.array(self.bodies.names)}
        return {"joints": q[:, : quantities.shape[1]], **names}


class JointSpaceSymbols(ArmSymbols):
    """See ``arm.ArmSymbols``: K is the geometric Jacobian."""

    def __init__(self, arm: JointSpaceArm, constants: Constants) -> None:
        super().__init__(arm.home_quantities, arm.actuators, constants)
        self._joints, self._free, self._arm = len(arm.quantity_names), arm.free.tolist(), arm
        self._nodes, self._moving, self._turning = arm.functions
        self.shape, self.given = (self._joints + 6, 1), list(range(len(arm.home)))
        self._constants = [constants.add(name, value) for name, value in arm.constants.items()]

    def nodes(self, q: ca.MX) -> ca.MX:
        return self._nodes(q, *self._constants)

    def quantities(self, q: ca.MX) -> ca.MX:
        """See ``arm.ArmSymbols``, and :class:`JointSpaceArm` for the quantities of followers."""
        values = q[: self._joints]
        for joint, followed, multiplier in self._arm.followers:
            values[joint] = values[joint] - multiplier * values[followed]
        return values

    def motion(self, q: ca.MX, at: ca.MX, moved: ca.MX) -> list[ca.MX]:  # noqa: ARG002
        """See ``arm.ArmSymbols``: K and r."""
        rows = [3 * node + axis for node in self._free for axis in range(3)]
        _, jacobian = self._moving(at, *self._constants)
        jacobian = self._arm.by_quantities(jacobian)
        return [jacobian[rows, self._actuators], ca.vec(moved[:, self._free])]

    def twists(self, at: ca.MX) -> ca.MX | None:
        """See ``arm.ArmSymbols``; with followers a joint moves nodes by several twists."""
        if self._arm.followers:
            return None
        _, twists = self._turning(at, *self._constants)
        return twists[:, self._actuators]

    def movers(self) -> Index:
        arm = self._arm
        moved = np.concatenate([[0], np.cumsum(arm.actuated)])[arm.movers]
        return np.asarray(moved[arm.free])

    def coordinates(self, nodes: Any, strokes: Any) -> Any:  # noqa: ARG002
        """See ``arm.ArmSymbols``: the actuators."""
        return strokes

    def along(self, q: ca.MX, coordinates: ca.MX) -> ca.MX:
        change = ca.MX.zeros(*q.shape)
        change[self._actuators] = coordinates
        moved: ca.MX = q + self._arm.following(change)
        return moved

    def closed(self, q: ca.MX, lower: ca.MX, upper: ca.MX) -> ca.MX:
        aims = self.aims(self.quantities(q), lower, upper)
        return ca.vertcat(self._arm.following(aims), q[self._joints :])
