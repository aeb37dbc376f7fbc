"""A serial arm from its record in the manifest: where its joints and links are, in plain NumPy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import ResultError
from vgtm_qp.result.poses import rotation_matrix, rotations
from vgtm_qp.result.record import Record


class RecordedChain:
    """A serial arm as the manifest records it (``SerialArm.record``).

    A configuration (J + 6,) holds the joints' values, rad or m, then position, m, and rotation vector,
    rad, of the base.

    Attributes
    ----------
    quantity_names, member_names : tuple of str
        Joints, and links.
    actuated, home_quantities, stroke, rate, acceleration : (J,), (J,), (J, 2), (J,), (J,)
        Of the joints; limits are infinite if there are none. The quantity of a follower is fixed: its value
        less a multiple of the value of the joint that it follows.
    followers, multipliers : (K, 2) int, (K,)
        Followers, and the joints that they follow; and the multipliers.
    base : (1,) int
        The point that the problem places.
    links : (B, V) int
        The points whose convex hull each link is, but for its radius, counted from the base over the joints to the
        tip, then those of bodies: the two ends of its axis, or the vertices of a hull. The last one is repeated.
    is_hull : (B,) bool
        False for links with an axis.
    members : (B, 2) int
        The link's ends, one of which it shares with each neighbour.
    points, carriers : (P, 3), (P,) int
        Points of bodies, m, in the frames of the joints that they move with, and the numbers of those joints.
    touching : (K, 2) int
        Pairs of links that are not kept apart.
    radius, length : (B,)
        Of the links, m.
    stretches : (B,) bool
        All False: no link is drawn as changing its length.
    """

    kind, unit, body, rigid_body = "serial", "rad or m", "link", "link"

    def __init__(self, record: Mapping[str, Any]) -> None:
        if record.get("kind") != self.kind:
            raise ResultError("manifest.arm is not the record of a serial arm")
        table = Record(record, "manifest.arm")
        self.quantity_names, self.member_names = table.names("joint_names"), table.names("body_names")
        joints, links = len(self.quantity_names), len(self.member_names)
        self.revolute, self.actuated = table.flags("revolute", (joints,)), table.flags("actuated", (joints,))
        self.axis = table.numbers("axis", (joints, 3))
        self.position = table.numbers("position", (joints, 3))
        self.rotation = table.numbers("rotation", (joints, 3, 3))
        home = table.numbers("home", (joints,))
        # Results of earlier versions have no followers.
        follow = table.has("followers")
        self.followers = (
            table.integers("followers", (None, 2), joints) if follow else np.zeros((0, 2), dtype=np.int64)
        )
        self.multipliers = table.numbers("multipliers", (len(self.followers),)) if follow else np.zeros(0)
        self.stroke = table.numbers("stroke", (joints, 2), limits=True)
        self.stroke[np.isinf(self.stroke[:, 0]), 0] = -np.inf
        self.rate = table.numbers("rate", (joints,), limits=True)
        self.acceleration = table.numbers("acceleration", (joints,), limits=True)
        self.tip, self.tip_frame = table.numbers("tip", (3,)), table.numbers("tip_frame", (3, 3))
        self.radius = table.numbers("radius", (links,))
        steps = np.linalg.norm(np.vstack([self.position, self.tip]), axis=1)
        self.size = float(steps[steps > 0.0].mean()) if steps.any() else 1.0
        # Results of earlier versions have no points of bodies.
        bodies = table.has("points")
        self.points = table.numbers("points", (None, 3)) if bodies else np.zeros((0, 3))
        none = np.zeros(0, dtype=np.int64)
        self.carriers = table.integers("carriers", (len(self.points),), joints + 1) if bodies else none
        self.touching = table.integers("touching", (None, 2), links) if bodies else none.reshape(0, 2)
        self.links = table.integers("links", (links, None), joints + 2 + len(self.points))
        if self.links.shape[1] < 2:
            raise ResultError("manifest.arm.links: expected two points or more of each link")
        self.is_hull = (self.links[:, 1:] != self.links[:, 1:2]).any(axis=1)
        self.members = table.integers("joined", (links, 2), 2 * links + joints + 2)
        self.free, self.base = np.zeros(0, dtype=np.int64), np.zeros(1, dtype=np.int64)
        self.stretches = np.zeros(links, dtype=np.bool_)
        self._way: tuple[bytes, bytes, Array, Array] | None = None
        """The last motion of :meth:`ends_between`: its two states, and the shares and links placed so far."""
        at_home = np.concatenate([home, np.zeros(6)])[None]
        self._home_values, self.home_quantities = home, self.quantities(at_home)[0]
        points, _, frames = self.placed(at_home)
        self.home, self._home_tip = points[0], frames[0]
        self.length = self.lengths(self.home)

    def contradictions(self, problem: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> list[str]:
        """Return where the record disagrees with the arrays of the result file or with the problem."""
        found = []
        for name, recorded in (("joint_names", self.quantity_names), ("body_names", self.member_names)):
            if name not in arrays or tuple(arrays[name].tolist()) != recorded:
                found.append(f"array {name} differs from the arm record")
        table = problem.get("arm") or {}
        joints = {str(joint["name"]): joint for joint in table.get("joint") or ()}
        if tuple(joints) != self.quantity_names:
            return [*found, "the joints of the arm record are not those of the problem"]
        origin = (0.0, 0.0, 0.0)
        nobody = {str(joint["mimic"]["joint"]) for joint in joints.values() if joint.get("mimic")} - set(
            joints
        )
        if nobody:
            return [
                *found,
                f"joints of the problem follow {', '.join(sorted(nobody))}, which is none of them",
            ]
        expected = _driven(joints)
        if not np.array_equal(self.followers, expected.followers) or not same(
            self.multipliers, expected.multipliers
        ):
            found.append("the joints that follow others in the arm record are not those of the problem")
        stuck = {
            lock if isinstance(lock, str) else str(lock["joint"])
            for lock in table.get("locked") or ()
            if isinstance(lock, str) or not lock.get("time")
        }
        for k, (name, joint) in enumerate(joints.items()):
            axis = np.array(joint["axis"], dtype=float)
            turn = np.array(joint.get("rotation_vector") or origin, dtype=float)
            wanted = {
                "axis": (self.axis[k], axis / np.linalg.norm(axis)),
                "position": (self.position[k], joint.get("position") or origin),
                "rotation": (self.rotation[k], rotation_matrix(turn)),
                "drive": (float(self.actuated[k]), float(name not in stuck and not joint.get("mimic"))),
                "home": (self._home_values[k], expected.home[k]),
                "limits": (self.stroke[k], expected.stroke[k]),
                "rate": (self.rate[k], expected.rate[k]),
                "acceleration": (self.acceleration[k], expected.acceleration[k]),
                "kind": (float(self.revolute[k]), float(joint.get("kind", "revolute") == "revolute")),
            }
            for key, (recorded, given) in wanted.items():
                if not same(recorded, given):
                    found.append(f"the arm record's {key} of joint {name} differs from the problem's")
        if not same(self.tip, table.get("tip") or origin):
            found.append("the arm record's tip differs from the problem's")
        attitude = table.get("tip_rotation_vector")
        if attitude is not None and not same(
            self._home_tip @ rotation_matrix(np.array(attitude, dtype=float)), self.tip_frame
        ):
            found.append("the arm record's attitude of the tip differs from the problem's")
        if table.get("body") is not None:
            return found + _other_bodies(self, table["body"])
        if table.get("link_radius") is not None and not same(self.radius, table["link_radius"]):
            found.append("the arm record's link radius differs from the problem's")
        return found

    def placed(self, q: Array) -> tuple[Array, Array, Array]:
        """Return base, joints, tip and points of bodies (Q, J + 2 + P, 3), m, axes (Q, J, 3), last frames (Q, 3, 3)."""
        points, axes, frames = self.along(q)
        at, frame = frames[-1]
        points.append(at + frame @ self.tip)
        own = np.empty((len(q), *self.points.shape))
        for carrier in np.unique(self.carriers).tolist():
            origin, attitude = frames[carrier]
            rows = np.flatnonzero(self.carriers == carrier)
            own[:, rows] = origin[:, None] + self.points[rows] @ np.swapaxes(attitude, 1, 2)
        return np.concatenate([np.stack(points, axis=1), own], axis=1), np.stack(axes, axis=1), frame

    def along(self, q: Array) -> tuple[list[Array], list[Array], list[tuple[Array, Array]]]:
        """Return base and joints (Q, 3), m, axes of joints (Q, 3), and origins and attitudes after base and joints."""
        count = len(self.quantity_names)
        at, frame = q[:, count : count + 3], rotations(q[:, count + 3 :])
        turns = np.where(self.revolute, q[:, :count], 0.0)[..., None] * self.axis
        turned = self.rotation @ rotations(turns.reshape(-1, 3)).reshape(-1, count, 3, 3)
        points, axes, frames = [at], [], [(at, frame)]
        for j in range(count):
            at = at + frame @ self.position[j]
            frame = frame @ turned[:, j]
            axes.append(frame @ self.axis[j])
            points.append(at)
            if not self.revolute[j]:
                at = at + q[:, j, None] * axes[-1]
            frames.append((at, frame))
        return points, axes, frames

    def nodes_at(self, q: Array) -> Array:
        """Return (Q, N, 3) base, joints, tip and points of bodies, m, at configurations (Q, J + 6)."""
        return self.placed(q)[0]

    def frames(self, q: Array) -> list[tuple[Array, Array]]:
        """Return origins (Q, 3), m, and attitudes (Q, 3, 3) of what moves with the base and each joint."""
        return self.along(q)[2]

    def ends(self, points: Array) -> Array:
        """Return (..., B, V, 3) the ends or vertices of the links for points (..., J + 2 + P, 3)."""
        return np.asarray(points[..., self.links, :])

    def lengths(self, points: Array) -> Array:
        """Return (..., B) the lengths of the links, m, for points (..., J + 2 + P, 3): those of boxes round hulls."""
        return np.asarray(np.linalg.norm(np.ptp(self.ends(points), axis=-2), axis=-1))

    def quantities(self, q: Array) -> Array:
        """Return (T, J) the quantities at configurations (T, J + 6): see the class."""
        return self.of_values(q[:, : len(self.quantity_names)])

    def of_values(self, values: Array) -> Array:
        """Return (T, J) the quantities at joint values (T, J)."""
        values = values.copy()
        values[:, self.followers[:, 0]] -= self.multipliers * values[:, self.followers[:, 1]]
        return values

    def joints(self, quantities: Array) -> Array:
        """Return (T, J) the joints' values at quantities (T, J)."""
        values = quantities.copy()
        values[:, self.followers[:, 0]] += self.multipliers * values[:, self.followers[:, 1]]
        return values

    def tip_poses(self, q: Array) -> tuple[Array, Array]:
        """Return positions (T, 3), m, and attitudes (T, 3, 3) of the end effector at configurations (T, J + 6)."""
        points, _, frames = self.placed(q)
        position = points[:, len(self.quantity_names) + 1]
        return np.asarray(position), np.asarray(frames @ self._home_tip.T @ self.tip_frame)

    def tip_position(self, q: Array) -> Array:
        """Return (T, 3) the end effector's position, m."""
        return self.tip_poses(q)[0]

    def tip_rotations(self, q: Array) -> Array:
        """Return (T, 3, 3) the end effector's attitude at configurations (T, J + 6)."""
        return self.tip_poses(q)[1]

    def singular_values(self, q: Array) -> tuple[float, float, float] | None:
        """Return 1, in place of the length Jacobian's, and least and greatest value of the tip's Jacobian."""
        points, axes, _ = self.placed(q[None])
        joints = points[0, 1 : len(axes[0]) + 1]
        arms = np.cross(axes[0], points[0, len(joints) + 1] - joints)
        jacobian = np.where(self.revolute[:, None], arms, axes[0])
        np.add.at(jacobian, self.followers[:, 1], self.multipliers[:, None] * jacobian[self.followers[:, 0]])
        jacobian = jacobian[self.actuated]
        if not len(jacobian):
            return None
        return 1.0, *extreme_values(jacobian)

    def states_ends(self, q: Array) -> Array:
        """Return (T, B, V, 3) the ends or vertices of the links, m, at configurations (T, J + 6)."""
        return self.ends(self.nodes_at(q))

    def ends_between(self, before: Array, after: Array, share: Array, link: Index) -> Array:
        """Return (P, V, 3) the ends, m, of links (P,) at shares (P,) of a straight motion between states."""
        # Many pairs of one kind after another are evaluated at the same few instants.
        if self._way is None or self._way[:2] != (before.tobytes(), after.tobytes()):
            self._way = before.tobytes(), after.tobytes(), np.zeros(0), np.zeros((0, *self.links.shape, 3))
        known, ends = self._way[2:]
        new = np.setdiff1d(share, known)
        if len(new):
            known = np.concatenate([known, new])
            order = np.argsort(known)
            ends = np.concatenate([ends, self.states_ends(before + new[:, None] * (after - before))])[order]
            known = known[order]
            self._way = *self._way[:2], known, ends
        return np.asarray(ends[np.searchsorted(known, share), link])

    def bend(self, before: Array, after: Array, link: Index) -> Array:
        """Return (..., P) bounds, m, of |d2 r / d share2| of points of links (P,) as the configuration moves straight.

        Configurations are (..., J + 6). A point is the sum of vectors p, each turned by the joints before it
        at speeds w. The product of these turns has a second derivative of at most the square of the sum of w.
        A slide changes its vector at a constant speed v along itself. So |p''| <= (sum w)^2 |p| + 2 v sum w.
        The base's rotation vector counts twice, as its axis turns too.
        """
        origins, own, _ = self._bends(before, after)
        points = np.concatenate([origins, own], axis=-1)
        return np.asarray(points[..., self.links[link]].max(axis=-1))

    @property
    def tip_joints(self) -> Index:
        """The place at which the links end that what is carried may touch."""
        return np.array([len(self.quantity_names) + 1])

    def tip_bend(self, before: Array, after: Array, reach: Array) -> Array:
        """Return (P,) such bounds, m, of points fixed to the tip at distances `reach` (P,), m, from it."""
        origins, _, turning = self._bends(before, after)
        return np.asarray(origins[-1] + turning[-1] * reach)

    def _bends(self, before: Array, after: Array) -> tuple[Array, Array, Array]:
        """Return the bounds of origins (..., J + 2) and of bodies' points (..., P), and squared speeds (..., J + 1)."""
        count, revolute = len(self.quantity_names), self.revolute
        moved = np.abs(after - before)
        base = 2.0 * np.linalg.norm(moved[..., -3:], axis=-1)[..., None]
        turns = np.concatenate([base, np.where(revolute, moved[..., :count], 0.0)], axis=-1)
        speed = np.cumsum(turns, axis=-1)
        slides = np.where(revolute, 0.0, np.maximum(np.abs(before), np.abs(after))[..., :count])
        slid = np.where(revolute, 0.0, moved[..., :count])
        none = np.zeros_like(base)
        lengths = np.linalg.norm(np.vstack([self.position, self.tip]), axis=1)
        turning = speed * speed
        sliding = turning * np.concatenate([none, slides], axis=-1)
        sliding += 2.0 * speed * np.concatenate([none, slid], axis=-1)
        origins = np.concatenate([none, np.cumsum(turning * lengths + sliding, axis=-1)], axis=-1)
        own = (origins[..., :-1] + sliding)[..., self.carriers]
        own = own + turning[..., self.carriers] * np.linalg.norm(self.points, axis=1)
        return origins, own, turning


class _Driven(NamedTuple):
    """Home, limits and followers of the joints in a problem's table; see :class:`RecordedChain`."""

    home: Array
    stroke: Array
    rate: Array
    acceleration: Array
    followers: Index
    multipliers: Array


def _driven(joints: Mapping[str, Mapping[str, Any]]) -> _Driven:
    """Return home values, limits and followers of joints, from the tables of a problem."""
    number, tables = {name: k for k, name in enumerate(joints)}, list(joints.values())
    home = np.array([joint.get("home") or 0.0 for joint in tables], dtype=float)
    stroke = np.array([joint.get("limits") or (-np.inf, np.inf) for joint in tables], dtype=float)
    most = np.array([[joint.get(key) or np.inf for joint in tables] for key in ("rate", "acceleration")])
    rules = [(k, joint["mimic"]) for k, joint in enumerate(tables) if joint.get("mimic")]
    followers = np.array([(k, number[rule["joint"]]) for k, rule in rules], dtype=np.int64).reshape(-1, 2)
    multipliers = np.array([rule.get("multiplier", 1.0) for _, rule in rules], dtype=float)
    for (k, rule), other, factor in zip(rules, followers[:, 1], multipliers, strict=True):
        offset = float(rule.get("offset", 0.0))
        home[k] = factor * home[other] + offset
        own = np.sort((stroke[k] - offset) / factor)
        stroke[other] = max(stroke[other, 0], own[0]), min(stroke[other, 1], own[1])
        most[:, other] = np.minimum(most[:, other], most[:, k] / abs(factor))
    for k, _ in rules:
        stroke[k], most[:, k] = (-np.inf, np.inf), np.inf
    return _Driven(home, stroke, most[0], most[1], followers, multipliers)


def _other_bodies(chain: RecordedChain, table: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return where the bodies of the record differ from those of the problem's table."""
    if tuple(str(body["name"]) for body in table) != chain.member_names:
        return ["the bodies of the arm record are not those of the problem"]
    found, number = [], {name: k + 1 for k, name in enumerate(chain.quantity_names)}
    first = len(number) + 2
    for k, body in enumerate(table):
        ends, radius = np.array(body["points"], dtype=float), float(body.get("radius") or 0.0)
        own = chain.links[k] - first
        carrier = number.get(str(body.get("joint")), 0)
        if own.min() < 0 or (chain.carriers[own] != carrier).any():
            found.append(f"the arm record's joint of body {body['name']} differs from the problem's")
        elif not same(chain.radius[k], radius) or not _is_shape(chain, k, own, ends, radius):
            found.append(f"the arm record's shape of body {body['name']} differs from the problem's")
    return found


def _is_shape(chain: RecordedChain, link: int, own: Index, points: Array, radius: float) -> bool:
    """Whether the recorded points `own` (V,) of a link are the `points` (K, 3) of its table, m."""
    if len(points) <= 2:
        return not chain.is_hull[link] and _are_ends(chain.points[own[:2]], points, radius)
    count = len(points)
    is_padded = count <= len(own) and bool((own[count:] == own[count - 1]).all())
    return is_padded and same(chain.points[own[:count]], points)


def _are_ends(recorded: Array, ends: Array, radius: float) -> bool:
    """Whether both points (2, 3) of a recorded capsule are the `ends` (1 or 2, 3) of its axis, m.

    A ball, or a capsule that is nearly one, is recorded as a capsule with a short axis through its centre.
    """
    if float(np.linalg.norm(ends[-1] - ends[0])) >= 1e-3 * radius:
        return same(recorded, ends)
    return same(recorded.mean(axis=0), ends.mean(axis=0)) and bool(
        np.linalg.norm(recorded - ends.mean(axis=0), axis=1).max() <= 1e-3 * radius
    )


def same(recorded: ArrayLike, given: ArrayLike) -> bool:
    """Whether the numbers of a record are those of the problem, to 1e-9."""
    return bool(np.allclose(recorded, given, rtol=0.0, atol=1e-9))


def extreme_values(jacobian: NDArray[Any]) -> tuple[float, float]:
    """Return the least and the greatest singular value of the tip's Jacobian (n, 3)."""
    values = np.linalg.svd(jacobian, compute_uv=False)
    return float(values[-1]) if len(values) == 3 else 0.0, float(values[0])
