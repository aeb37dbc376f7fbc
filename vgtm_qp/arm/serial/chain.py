"""A serial arm as data, and where its nodes are as CasADi functions of its configuration."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vgtm_qp.arm.rank import rank
from vgtm_qp.arm.symbols import rotated
from vgtm_qp.rotation import rotation_from_vector, turn_between

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

    @cached_property
    def geometry(self) -> dict[str, Array]:
        """What the functions take beside the configuration, the columns of each as rows: (J, 3), (3 J, 3), (1, 3)."""
        return {
            "axes": self.axis,
            "positions": self.position,
            "rotations": self.rotation.transpose(0, 2, 1).reshape(-1, 3),
            "tip": self.tip[None],
        }

    @cached_property
    def nodes(self) -> ca.Function:
        """(q, axes (3, J), positions (3, J), rotations (3, 3 J), tip (3)) -> nodes (3, N), see :attr:`moving`."""
        arguments, nodes, _ = self._graph
        return ca.Function("chain_nodes", arguments, [nodes])

    @cached_property
    def moving(self) -> ca.Function:
        """The same arguments -> nodes (3, N), and their geometric Jacobian (3 N, J).

        The configuration q (J + 6) holds the joints' values, then position, m, and rotation vector, rad, of the base. A
        node moves across the axis of each revolute joint before it, and along that of each prismatic one.
        """
        arguments, nodes, jacobian = self._graph
        return ca.Function("chain", arguments, [nodes, jacobian])

    @cached_property
    def _at_home(self) -> tuple[Array, Array]:
        parts = (part.T for part in self.geometry.values())
        nodes, jacobian = self.moving(np.concatenate([self.home, np.zeros(6)]), *parts)
        return np.asarray(nodes, dtype=float).T, np.asarray(jacobian, dtype=float).reshape(-1, 3, len(self))

    @property
    def home_nodes(self) -> Array:
        """(N, 3) the nodes at home, m."""
        return self._at_home[0]

    @cached_property
    def actuators(self) -> Index:
        """(n_a,) joints that are not stuck."""
        return np.flatnonzero(~self.locked)

    @cached_property
    def base(self) -> Mask:
        """(N,) nodes that move with the base alone."""
        return np.isin(np.arange(len(self.node_names)), [0, 1, *self.station_nodes[0]])

    @cached_property
    def free(self) -> Index:
        """(N - N_c,) the other nodes."""
        return np.flatnonzero(~self.base)

    @cached_property
    def station_frames(self) -> Array:
        """(F, 3, 3) rotations of the stations at home; their z-axes lie along the arm."""
        frames = [np.eye(3)]
        for before, after in pairwise(self.home_nodes[self.station_nodes[:, 0]]):
            way = after - before
            turn = turn_between(frames[-1][:, 2], way / np.linalg.norm(way))
            frames.append(rotation_from_vector(turn) @ frames[-1])
        return np.stack(frames)

    def holds_origins(self, nodes: ArrayLike) -> bool:
        """Whether the origins at `nodes` (K,) can be held in place one by one, by rank at home."""
        _, jacobian = self._at_home
        places = np.asarray(nodes)
        rows = jacobian[places][:, :, self.actuators].reshape(3 * len(places), len(self.actuators))
        full = 0 < len(rows) <= len(self.actuators)
        return full and rank(np.linalg.svd(rows, compute_uv=False)) == len(rows)

    @cached_property
    def _graph(self) -> tuple[list[ca.SX], ca.SX, ca.SX]:
        count = len(self)
        q, axes = ca.SX.sym("q", count + 6), ca.SX.sym("axes", 3, count)
        positions, rotations = ca.SX.sym("positions", 3, count), ca.SX.sym("rotations", 3, 3 * count)
        tip = ca.SX.sym("tip", 3)
        origin, frame = q[count : count + 3], rotated(q[count + 3 :])
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
            if self.revolute[j]:
                frame = frame @ rotated(q[j] * axes[:, j])
            else:
                origin = origin + q[j] * axis
            if j in self.tracked:
                # Its station turns with a joint, but stays where a slide begins.
                stations.append((nodes[-1], frame, j + 1 if self.revolute[j] else j))
        end = origin + frame @ tip
        nodes.append(end)
        after.append(count)
        stations.append((end, frame, count))
        for place, attitude, joint in stations:
            nodes += [place + self.spread * attitude[:, 0], place + self.spread * attitude[:, 1]]
            after += [joint, joint]
        columns, rest = [], ca.SX.zeros(3)
        for j, (axis, at) in enumerate(joints):
            turns = bool(self.revolute[j])
            moved = (ca.cross(axis, node - at) if turns else axis for node in nodes)
            columns.append(
                ca.vertcat(*(m if j < last else rest for m, last in zip(moved, after, strict=True)))
            )
        return [q, axes, positions, rotations, tip], ca.horzcat(*nodes), ca.densify(ca.horzcat(*columns))
