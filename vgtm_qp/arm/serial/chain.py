"""A serial arm's geometry, and its nodes as a CasADi function of the configuration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property

import casadi as ca
import numpy as np

from vgtm_qp.arm.symbols import rotated
from vgtm_qp.arrays import Array, Index, Mask
from vgtm_qp.geometry.bodies import Hull, lengthened
from vgtm_qp.problem.arm import ArmBody, ArmTable
from vgtm_qp.rotation import rotation_from_vector

UNROLLED = 20
"""Number of joints up to which their functions are written out one after another: faster, but long in C."""


@dataclass(frozen=True, eq=False)
class SerialChain:
    """J joints, base first, each placed in the frame of the one before.

    Attributes
    ----------
    revolute : (J,) bool
        True for revolute, False for prismatic joints.
    axis, position : (J, 3)
        Unit axis in the joint's own frame, and its origin in the frame before, m.
    rotation : (J, 3, 3)
        Attitude in that frame at joint value 0.
    tip : (3,)
        The end effector in the last frame, m.
    every : int
        Every `every`-th joint is a station between the base and the tip, see :attr:`tracked`.
    points : (P, 3)
        Points that span bodies, in the frames that they move with, m.
    carriers : (P,) int
        Numbers of joints that move them: 0 in the base's frame.
    beyond : (P,)
        Greatest distance of the body that each point spans, without its radius, from the origin of that frame, m.
    mass, center : (J,), (J, 3)
        Masses of what each joint moves and the next one does not, kg, and their centres in its frame, m.
    """

    revolute: Mask
    axis: Array
    position: Array
    rotation: Array
    tip: Array
    every: int
    points: Array
    carriers: Index
    beyond: Array
    mass: Array
    center: Array

    @classmethod
    def of(cls, spec: ArmTable, hulls: Sequence[Hull | None]) -> SerialChain:
        """Return the chain of an ``[arm]`` table whose bodies have `hulls`, or are capsules.

        Without its key `every` only base and tip are stations.
        """
        joints, number = spec.joint, {joint.name: k + 1 for k, joint in enumerate(spec.joint)}
        carried = [
            (point, number[body.joint] if body.joint else 0, float(np.linalg.norm(vertices, axis=1).max()))
            for body, hull in zip(spec.body or (), hulls, strict=True)
            for span, vertices in [vertices_of(body, hull)]
            for point in span
        ]
        axis = np.array([joint.axis for joint in joints], dtype=float)
        return cls(
            revolute=np.array([joint.kind == "revolute" for joint in joints]),
            axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
            position=np.array([joint.position for joint in joints], dtype=float),
            rotation=np.stack([rotation_from_vector(joint.rotation_vector) for joint in joints]),
            tip=np.array(spec.tip, dtype=float),
            every=spec.every or len(joints),
            points=np.array([point for point, _, _ in carried], dtype=float).reshape(-1, 3),
            carriers=np.array([carrier for _, carrier, _ in carried], dtype=np.int64),
            beyond=np.array([beyond for _, _, beyond in carried], dtype=float),
            mass=np.array([joint.mass for joint in joints]),
            center=np.array([joint.center_of_mass for joint in joints], dtype=float),
        )

    def __len__(self) -> int:
        return len(self.revolute)

    @cached_property
    def tracked(self) -> list[int]:
        """Joints that are stations between the base and the tip."""
        return list(range(self.every, len(self), self.every))

    @property
    def node_count(self) -> int:
        """Number of nodes N, see :attr:`functions`."""
        return len(self) + 2 + len(self.points) + 2 * (len(self.tracked) + 2)

    @cached_property
    def lengths(self) -> Array:
        """(J + 1,) distances from each origin to the one before, and of the tip from the last, at joint value 0, m."""
        return np.asarray(np.linalg.norm(np.vstack([self.position, self.tip]), axis=1))

    @cached_property
    def mean_length(self) -> float:
        """Mean of those lengths that are not zero, m."""
        return float(np.mean(self.lengths[self.lengths > 0.0]))

    @property
    def spread(self) -> float:
        """Distance of the two nodes that orient a station from its origin: a tenth of the mean link, m."""
        return 0.1 * self.mean_length

    @property
    def constants(self) -> dict[str, Array]:
        """Arguments of :attr:`functions` besides the configuration, the columns of each as rows."""
        return {
            "axes": self.axis,
            "positions": self.position,
            "rotations": self.rotation.transpose(0, 2, 1).reshape(-1, 3),
            "tip": self.tip[None],
            "points": self.points,
        }

    @cached_property
    def functions(self) -> tuple[ca.Function, ca.Function, ca.Function]:
        """Return three functions, of the nodes (3, N): alone, with their Jacobian (3 N, J), and with twists (6, J).

        The twist of a joint is its axis, if it turns, and the velocity of a point of its body at the origin: a node at
        x that the joint moves has the velocity axis x x + velocity, see :attr:`movers`.

        Arguments: q, axes (3, J), positions (3, J), rotations (3, 3 J), tip (3), points (3, P).

        The configuration q (J + 6) holds the joints' values, then position, m, and rotation vector, rad, of the base. A
        node moves across the axis of each revolute joint before it, and along that of each prismatic one. The nodes are
        the base, the joints and the tip, the points of bodies, and two beside each station, along its x- and y-axes.
        """
        count = len(self)
        q, axes = ca.MX.sym("q", count + 6), ca.MX.sym("axes", 3, count)
        positions, rotations = ca.MX.sym("positions", 3, count), ca.MX.sym("rotations", 3, 3 * count)
        tip, points = ca.MX.sym("tip", 3), ca.MX.sym("points", 3, len(self.points))
        origin, frame = q[count : count + 3], _turned()(q[count + 3 :])
        nodes, stations, frames = [origin], [(origin, frame)], [(origin, frame)]
        directions, places = [], []
        for j, turns in enumerate(self.revolute.tolist()):
            geometry = axes[:, j], positions[:, j], rotations[:, 3 * j : 3 * j + 3]
            place, direction, origin, frame = _joint(turns)(origin, frame, q[j], *geometry)
            directions.append(direction)
            places.append(place)
            nodes.append(place)
            if j in self.tracked:
                stations.append((place, frame))
            frames.append((origin, frame))
        end = origin + frame @ tip
        nodes.append(end)
        stations.append((end, frame))
        for k, carrier in enumerate(self.carriers.tolist()):
            at, attitude = frames[carrier]
            nodes.append(at + attitude @ points[:, k])
        for place, attitude in stations:
            nodes += [place + self.spread * attitude[:, axis] for axis in (0, 1)]
        every, movers = ca.horzcat(*nodes), ca.DM(self.movers)
        joints = ca.horzcat(*directions), ca.horzcat(*places), ca.DM(self.revolute.astype(float)).T
        jacobian = _columns(len(nodes), count)(*joints, ca.DM(range(count)).T, movers, every)
        arguments = [q, axes, positions, rotations, tip, points]
        alone = ca.Function("chain_nodes", arguments, [every])
        both = ca.Function("chain", arguments, [every, jacobian])
        twists = ca.Function("chain_twists", arguments, [every, _twist().map(count)(*joints)])
        return (alone, both, twists) if count > UNROLLED else (alone.expand(), both.expand(), twists.expand())

    @cached_property
    def movers(self) -> Index:
        """(N,) numbers of joints, from the base, that move each node; others do not.

        A station turns with its revolute joint; that of a prismatic joint does not move with the slide.
        """
        stations = [0, *(j + int(self.revolute[j]) for j in self.tracked), len(self)]
        places = [0, *range(len(self)), len(self), *self.carriers, *np.repeat(stations, 2)]
        return np.array(places, dtype=np.int64)

    def _frames(self, q: Array) -> Iterator[tuple[Array, Array, Array, Array]]:
        """Yield place and direction (3,) of each joint's axis, origin (3,) and frame (3, 3) after it."""
        origin, frame = q[-6:-3], rotation_from_vector(q[-3:])
        for value, axis, position, rotation, turns in zip(
            q[:-6], self.axis, self.position, self.rotation, self.revolute, strict=True
        ):
            place, frame = origin + frame @ position, frame @ rotation
            direction = frame @ axis
            origin = place if turns else place + value * direction
            frame = frame @ rotation_from_vector(value * axis) if turns else frame
            yield place, direction, origin, frame

    def attitude(self, q: Array, turn: Sequence[float]) -> Array:
        """Return (3, 3) the rotation of the last frame turned by the vector `turn`."""
        return np.asarray([*self._frames(q)][-1][-1] @ rotation_from_vector(turn))

    def weight(self, q: Array, gravity: Array) -> Array:
        """Return (J,) what gravity (3,), m/s^2, exerts about the joints' axes, N m, or along them, N."""
        places, directions, origins, frames = (np.array(part) for part in zip(*self._frames(q), strict=True))
        centers = origins + np.einsum("jab,jb->ja", frames, self.center)
        beyond = np.cumsum(self.mass[::-1])[::-1, None]
        moments = np.cumsum((self.mass[:, None] * centers)[::-1], axis=0)[::-1]
        turning = np.cross(moments - beyond * places, gravity)
        exerted = np.where(self.revolute[:, None], turning, beyond * gravity)
        return np.asarray(np.einsum("ja,ja->j", directions, exerted))

    def at(self, q: Array) -> tuple[Array, Array]:
        """Return nodes (N, 3), m, and Jacobian (N, 3, J) at a configuration."""
        nodes, jacobian = self.functions[1](q, *(value.T for value in self.constants.values()))
        return np.asarray(nodes, dtype=float).T, np.asarray(jacobian, dtype=float).reshape(-1, 3, len(self))


@cache
def _turned() -> ca.Function:
    """Return the function from a rotation vector (3) to its rotation (3, 3)."""
    vector = ca.SX.sym("vector", 3)
    return ca.Function("turned", [vector], [ca.densify(rotated(vector))])


@cache
def _joint(turns: bool) -> ca.Function:
    """Return the function of one joint that turns, or slides.

    Arguments: origin (3) and frame (3, 3) before it, its value, axis, position and rotation, see :class:`SerialChain`.
    Results: place and direction (3) of its axis, origin and frame after it.
    """
    origin, frame, value = ca.SX.sym("origin", 3), ca.SX.sym("frame", 3, 3), ca.SX.sym("value")
    axis, position = ca.SX.sym("axis", 3), ca.SX.sym("position", 3)
    rotation = ca.SX.sym("rotation", 3, 3)
    place, after = origin + frame @ position, frame @ rotation
    direction = after @ axis
    moved = (place, after @ rotated(value * axis)) if turns else (place + value * direction, after)
    arguments = [origin, frame, value, axis, position, rotation]
    return ca.Function("turning" if turns else "sliding", arguments, [place, direction, *moved])


@cache
def _twist() -> ca.Function:
    """Return the function from direction and place (3) of a joint's axis, and whether it turns, to its twist (6)."""
    direction, place, turns = ca.SX.sym("direction", 3), ca.SX.sym("place", 3), ca.SX.sym("turns")
    velocity = ca.if_else(turns, ca.cross(place, direction), direction)
    return ca.Function("twist", [direction, place, turns], [ca.vertcat(turns * direction, velocity)])


@cache
def _columns(nodes: int, joints: int) -> ca.Function:
    """Return the function that gives the Jacobian (3 N, J) of nodes, a column a joint, by a loop over the joints.

    Arguments: directions and places (3, J) of the joints' axes, whether they turn and their numbers (1, J); numbers (N)
    of joints that move each node, and the nodes (3, N).
    """
    direction, place = ca.SX.sym("direction", 3), ca.SX.sym("place", 3)
    turns, number = ca.SX.sym("turns"), ca.SX.sym("number")
    moving, every = ca.SX.sym("moving", nodes), ca.SX.sym("every", 3, nodes)
    columns = []
    for k in range(nodes):
        turned = ca.if_else(turns, ca.cross(direction, every[:, k] - place), direction)
        columns.append(ca.if_else(number < moving[k], turned, ca.SX.zeros(3)))
    arguments = [direction, place, turns, number, moving, every]
    column = ca.Function("column", arguments, [ca.densify(ca.vertcat(*columns))])
    return column.map("columns", "serial", joints, [4, 5], [])


def hull_of(body: ArmBody) -> Hull | None:
    """Return the hull of a body; None for a ball or capsule."""
    return Hull.of(body.points) if len(body.points) > 2 else None


def vertices_of(body: ArmBody, hull: Hull | None) -> tuple[Array, Array]:
    """Return the points that span a body, and all of its vertices, m: the ends of its axis, or those of its hull."""
    if hull is None:
        axis = np.array(body.points, dtype=float)[None, [0, -1]]
        (ends,) = lengthened(axis, np.array([body.radius]))
        return ends, ends
    return hull.simplex, np.array(body.points, dtype=float)
