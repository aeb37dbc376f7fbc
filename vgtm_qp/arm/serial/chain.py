"""A serial arm as data, and where its nodes are as a CasADi function of its joints."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class SerialChain:
    """J joints, base first, each placed in the frame of the one before.

    Attributes
    ----------
    names : tuple of str
    revolute : (J,) bool
        True for revolute, False for prismatic joints.
    axis, position : (J, 3)
        Unit axis in the joint's own frame, and its origin in the frame before, m.
    rotation : (J, 3, 3)
        Attitude in that frame at joint value 0.
    limits, rate, acceleration : (J, 2), (J,), (J,)
        rad or m, and per second; inf where there is no limit.
    home : (J,)
        rad or m.
    tip : (3,)
        The end effector in the last frame, m.
    every : int
        Which joints are stations: every so many.
    locked : (J,) bool
        Joints that are stuck at home.
    radius : float
        Of the links, m.
    """

    names: tuple[str, ...]
    revolute: Mask
    axis: Array
    position: Array
    rotation: Array
    limits: Array
    rate: Array
    acceleration: Array
    home: Array
    tip: Array
    every: int
    locked: Mask
    radius: float

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def tracked(self) -> tuple[int, ...]:
        """Joints that are stations between the base and the tip."""
        return tuple(range(self.every, len(self), self.every))

    @cached_property
    def spread(self) -> float:
        """Distance of the two nodes that orient a station from its origin: a tenth of the mean link, m."""
        return 0.1 * float(np.mean(self.lengths[self.lengths > 0.0]))

    @cached_property
    def lengths(self) -> Array:
        """(J + 1,) distances from each origin to the one before, and of the tip from the last, at joint value 0, m."""
        return np.asarray(np.linalg.norm(np.vstack([self.position, self.tip]), axis=1))

    @cached_property
    def reach(self) -> Array:
        """(J,) bound of the distance from each joint's origin to any node beyond it, m, in any pose."""
        slide = np.where(self.revolute, 0.0, np.abs(self.limits).max(axis=1, initial=0.0))
        beyond = np.cumsum((self.lengths[1:] + slide)[::-1])[::-1]
        return np.asarray(beyond + np.sqrt(2.0) * self.spread)

    @cached_property
    def node_names(self) -> tuple[str, ...]:
        """Base, joints and tip, and two nodes ``x`` and ``y`` beside each station."""
        stations = ["base", *(self.names[j] for j in self.tracked), "tip"]
        return ("base", *self.names, "tip", *(f"{name} {axis}" for name in stations for axis in "xy"))

    @cached_property
    def station_nodes(self) -> Index:
        """(F, 3) the nodes of each station: its origin, and those beside it along its x- and y-axes."""
        origins = [0, *(1 + j for j in self.tracked), len(self) + 1]
        beside = len(self) + 2
        return np.array([(o, beside + 2 * k, beside + 2 * k + 1) for k, o in enumerate(origins)])

    def geometry(self) -> list[Array]:
        """Return what :func:`chain_function` takes beside the configuration, each flattened column by column."""
        return [
            self.axis.reshape(-1),
            self.position.reshape(-1),
            self.rotation.transpose(0, 2, 1).reshape(-1),
            self.tip,
        ]


def turned(vector: ca.SX) -> ca.SX:
    """Return the (3, 3) rotation by |vector| about it (Rodrigues), smooth at zero."""
    square = ca.dot(vector, vector) + 1e-30
    angle, cross = ca.sqrt(square), ca.skew(vector)
    return ca.SX.eye(3) + (ca.sin(angle) / angle) * cross + ((1.0 - ca.cos(angle)) / square) * (cross @ cross)


def chain_function(chain: SerialChain) -> ca.Function:
    """Return (q, axes (3, J), positions (3, J), rotations (3, 3 J), tip (3)) -> nodes (3, N) and d nodes / d joints.

    The configuration q (J + 6) holds the joints' values, then position, m, and rotation vector, rad, of the base. The
    Jacobian (3 N, J) is the geometric one: a node moves across the axis of each revolute joint before it, and along
    that of each prismatic one.
    """
    count = len(chain)
    q, axes = ca.SX.sym("q", count + 6), ca.SX.sym("axes", 3, count)
    positions, rotations = ca.SX.sym("positions", 3, count), ca.SX.sym("rotations", 3, 3 * count)
    tip = ca.SX.sym("tip", 3)
    origin, frame = q[count : count + 3], turned(q[count + 3 :])
    nodes, after = [origin], [0]
    stations = [(origin, frame, 0)]
    joints: list[tuple[ca.SX, ca.SX]] = []
    for j in range(count):
        origin = origin + frame @ positions[:, j]
        frame = frame @ rotations[:, 3 * j : 3 * j + 3]
        axis = frame @ axes[:, j]
        joints.append((axis, origin))
        nodes.append(origin)
        after.append(j)
        if chain.revolute[j]:
            frame = frame @ turned(q[j] * axes[:, j])
        else:
            origin = origin + q[j] * axis
        if j in chain.tracked:
            # A prismatic joint carries its station along.
            stations.append((nodes[-1], frame, j + 1))
    end = origin + frame @ tip
    nodes.append(end)
    after.append(count)
    stations.append((end, frame, count))
    for place, attitude, joint in stations:
        nodes += [place + chain.spread * attitude[:, 0], place + chain.spread * attitude[:, 1]]
        after += [joint, joint]
    jacobian = ca.SX(3 * len(nodes), count)
    for n, (node, last) in enumerate(zip(nodes, after, strict=True)):
        for j, (axis, at) in enumerate(joints[:last]):
            moved = ca.cross(axis, node - at) if chain.revolute[j] else axis
            jacobian[3 * n : 3 * n + 3, j] = moved
    results = [ca.horzcat(*nodes), ca.densify(jacobian)]
    return ca.Function("chain", [q, axes, positions, rotations, tip], results)
