"""The arm's geometry from its record in the manifest: member ends, tip frame, Jacobians, in plain NumPy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import ResultError
from vgtm_qp.result.chain import RecordedChain, extreme_values
from vgtm_qp.result.record import Record
from vgtm_qp.result.result import Result
from vgtm_qp.verify.truss_table import table_contradictions

_TOLERANCE = 1e-9
"""Tolerance of recorded lengths against those of the home nodes, m."""

_DENSE_UNKNOWNS = 300
"""Number of free coordinates up to which singular values by dense matrices cost less."""


class RecordedArm:
    """A truss as the manifest records it (``TrussArm.record``).

    Attributes
    ----------
    members, links : (M, 2) int
        The two nodes of each member.
    home : (N, 3)
        Home positions of the nodes, m.
    node_names : tuple of str
        Name of each node.
    base, free : (N_c,) int, (N - N_c,) int
        Given nodes, and all others.
    actuated, stretches : (M,) bool
        True where a member changes its length.
    quantity_names, home_quantities : (M,)
        Names and home lengths of the members, actuated and fixed.
    length, stroke, rate, acceleration, radius : (M,), (M, 2), (M,), (M,), (M,)
        Home lengths and limits; inf without a limit.
    is_hull : (M,) bool
        All False.
    revolute, followers : (M,) bool, (0, 2) int
        All False and empty: no quantity is an angle, and none follows another.
    corners, offset : (M, 2, 3) int or (M, 2, 1) int, (M, 2, 3)
        Nodes that place the two ends of each member and orient its joints, and the ends in the joint frames,
        eqs. (12)-(13). For pin joints: the end's node alone, and zeros.
    """

    unit, body, rigid_body = "m", "member", "fixed member"
    touching = followers = np.zeros((0, 2), dtype=np.int64)

    def __init__(self, record: Mapping[str, Any], members: Index) -> None:
        count = len(members)
        if kind := record.get("kind"):
            raise ResultError(f"this is the result of a {kind} arm; expected that of a truss")
        table = Record(record, "manifest.arm")
        self.home = table.numbers("home", (None, 3))
        nodes = len(self.home)
        self.base, self.node_names = table.integers("base", (None,), nodes), table.names("node_names", nodes)
        self.member_names = table.names("member_names", count)
        self.actuated = self.stretches = table.flags("actuated", (count,))
        self.length = table.numbers("length", (count,))
        self.stroke = table.numbers("stroke", (count, 2), limits=True)
        self.rate = table.numbers("rate", (count,), limits=True)
        self.acceleration = table.numbers("acceleration", (count,), limits=True)
        self.radius = table.numbers("radius", (count,))
        self.is_hull = self.revolute = np.zeros(count, dtype=np.bool_)
        self.links = members
        tip = table.table("tip")
        self.tip = tip.integers("nodes", (None,), nodes)
        self.tip_weights = tip.numbers("weights", (len(self.tip),))
        self.tip_frame = tip.numbers("frame", (3, 3))
        triangle, self.offset = np.arange(nodes)[:, None], np.zeros((count, 2, 3))
        if table.has("joints"):
            joints = table.table("joints")
            triangle = joints.integers("triangle", (nodes, 3), nodes)
            self.offset = joints.numbers("offset", (count, 2, 3))
        if len(members) and members.max() >= nodes:
            raise ResultError(f"array members names a node outside 0..{nodes - 1} of manifest.arm.home")
        self.members, self.corners = members, triangle[members]
        first, last = self.home[members.T]
        self.size = float(np.linalg.norm(last - first, axis=1).mean()) if len(members) else 1.0
        self.quantity_names, self.home_quantities = self.member_names, self.length
        self.free = np.setdiff1d(np.arange(nodes), self.base)
        # A tip of fewer than three nodes has no attitude.
        self._tip_fit = polygon_frame(self.home[self.tip], None) if len(self.tip) >= 3 else None

    def contradictions(self, problem: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> list[str]:
        """Return where the record disagrees with the arrays of the result file, with itself or with the problem."""
        found = []
        if tuple(arrays["member_names"].tolist()) != self.member_names:
            found.append("array member_names differs from the arm record")
        if not np.array_equal(arrays["member_actuated"], self.actuated):
            found.append("array member_actuated differs from the arm record")
        off = np.abs(self.lengths(self.home) - self.length)
        if off.max(initial=0.0) > _TOLERANCE:
            k = int(np.argmax(off))
            found.append(
                f"the arm record's length of {self.member_names[k]} is {off[k]:.3g} m off its home nodes"
            )
        found += table_contradictions(self, problem.get("truss") or {})
        return found

    @property
    def has_pin_joints(self) -> bool:
        """True if members end in their nodes, and so move along straight lines when the nodes do."""
        return bool(self.corners.shape[2] == 1)

    def nodes_at(self, nodes: Array) -> Array:
        """Return the nodes (T, N, 3) themselves, m, which are a truss's configuration."""
        return nodes

    def frames(self, nodes: Array) -> list[tuple[Array, Array]]:  # noqa: ARG002
        """Return no frames: members are not rigid bodies in them."""
        return []

    def of_values(self, lengths: Array) -> Array:
        """Return (T, M) the quantities at lengths (T, M), which they are."""
        return lengths

    def ends(self, nodes: Array) -> Array:
        """Return (..., M, 2, 3) the members' ends r_ik, eq. (13), m, at node positions (..., N, 3)."""
        return self._ends_at(nodes[..., self.corners, :], self.offset)

    states_ends = ends

    def ends_between(self, before: Array, after: Array, share: Array, member: Index) -> Array:
        """Return (P, 2, 3) the ends, m, of members (P,) at shares (P,) of a straight motion of the nodes."""
        start, stop = before[self.corners[member]], after[self.corners[member]]
        return self._ends_at(start + share[:, None, None, None] * (stop - start), self.offset[member])

    def _ends_at(self, corner: Array, offset: Array) -> Array:
        """Return (..., P, 2, 3) ends from the positions (..., P, 2, 1 or 3, 3) of their corners."""
        origin = corner[..., 0, :]
        if self.has_pin_joints:
            return origin
        to_first, to_second = _unit(corner[..., 1, :] - origin), _unit(corner[..., 2, :] - origin)
        x = _unit(-(to_first + to_second))
        z = _unit(np.cross(to_first, to_second))
        y = np.cross(z, x)
        return np.asarray(origin + offset[..., :1] * x + offset[..., 1:2] * y + offset[..., 2:] * z)

    def bend(self, before: Array, after: Array, member: Index) -> Array:
        """Return (..., P) an upper bound, m, of |d2 r / d share2| of members' ends between node positions (..., N, 3).

        Zero for pin joints. The joint frame's axes are unit vectors of polynomials w of the share, and
        |(w/|w|)''| <= |w''|/|w| + 3 (|w'|/|w|)^2, with a lower bound of |w| from its ends; inf if that is not
        positive.
        """
        if self.has_pin_joints:
            return np.zeros((*before.shape[:-2], len(member)))
        corner = self.corners[member]
        first = [nodes[..., corner[..., 1], :] - nodes[..., corner[..., 0], :] for nodes in (before, after)]
        second = [nodes[..., corner[..., 2], :] - nodes[..., corner[..., 0], :] for nodes in (before, after)]
        x_rate, x_bend = _bisector_bounds(first, second)
        z_rate, z_bend = _normal_bounds(first, second)
        offset = np.abs(self.offset[member])
        y_bend = z_bend + 2.0 * z_rate * x_rate + x_bend
        with np.errstate(invalid="ignore"):
            bound = offset[..., 0] * x_bend + offset[..., 1] * y_bend + offset[..., 2] * z_bend
        return np.asarray(np.where(np.isnan(bound), 0.0, bound).max(axis=-1))

    def lengths(self, nodes: Array) -> Array:
        """Return (..., M) member lengths, m, at node positions (..., N, 3)."""
        ends = self.ends(nodes)
        return _norm(ends[..., 1, :] - ends[..., 0, :])

    quantities = lengths

    def tip_position(self, nodes: Array) -> Array:
        """Return (..., 3) the end effector's position, m, at nodes (..., N, 3)."""
        return np.asarray(np.einsum("k,...kc->...c", self.tip_weights, nodes[..., self.tip, :]))

    def tip_rotations(self, nodes: Array) -> Array:
        """Return (T, 3, 3) the end effector's attitude at nodes (T, N, 3), by the best fit to its nodes."""
        if self._tip_fit is None:
            return np.tile(self.tip_frame, (len(nodes), 1, 1))
        home_frame, angles = self._tip_fit
        frames = [polygon_frame(polygon, angles)[0] for polygon in nodes[:, self.tip]]
        return np.asarray(frames @ home_frame.T @ self.tip_frame)

    def tip_poses(self, nodes: Array) -> tuple[Array, Array]:
        """Return positions (T, 3), m, and attitudes (T, 3, 3) of the end effector at nodes (T, N, 3)."""
        return self.tip_position(nodes), self.tip_rotations(nodes)

    @property
    def tip_joints(self) -> Index:
        """Nodes at which the members end that what is carried may touch."""
        return self.tip

    def tip_bend(self, before: Array, after: Array, reach: Array) -> Array:
        """Return (P,) upper bounds, m, of |d2 r / d share2| of points fixed to the tip between nodes (N, 3).

        The points are at distances `reach` (P,), m, from the tip's position. See :func:`polygon_frame`: z is the unit
        vector of the area, a polynomial of the share, and x that of u - z x w with the sums u and w of the spokes times
        the cosines and the sines of their angles at home, which are linear; x less its part along z.
        """
        if self._tip_fit is None:
            return np.full(len(reach), np.inf)
        spokes = [nodes[self.tip] - nodes[self.tip].mean(axis=0) for nodes in (before, after)]
        area = [np.cross(ring, np.roll(ring, -1, axis=0)).sum(axis=0) for ring in spokes]
        moved = spokes[1] - spokes[0]
        curved = np.cross(moved, np.roll(moved, -1, axis=0)).sum(axis=0)
        # The area's derivative is linear from its value at the start to that at the end.
        slopes = [area[1] - area[0] - curved, area[1] - area[0] + curved]
        rate, least = max(map(_norm, slopes)), np.array(_norm(area[0]) + _norm(area[1]))
        z_rate, z_bend = _unit_bounds((least - rate) / 2.0, rate, 2.0 * _norm(curved))
        _, angles = self._tip_fit
        u, w = (
            [np.asarray(turn @ ring) for ring in (*spokes, moved)]
            for turn in (np.cos(angles), np.sin(angles))
        )
        size, long = _norm(u[0]), max(_norm(w[0]), _norm(w[1]))
        size = max(size, _norm(u[1])) + long
        x_rate = _norm(u[2]) + _norm(w[2]) + long * z_rate
        x_bend = 2.0 * _norm(w[2]) * z_rate + long * z_bend
        if len(self.tip) > 3:
            flat_bend = x_bend + 4.0 * z_rate * x_rate + 2.0 * (z_bend + z_rate**2) * size
            x_rate, x_bend = x_rate + 2.0 * z_rate * size, flat_bend
        z = [_unit(way) for way in area]
        x = [u[k] - np.cross(z[k], w[k]) for k in range(2)]
        least = np.sum([_norm(x[k] - z[k] * (z[k] @ x[k])) for k in range(2)])
        x_rate, x_bend = _unit_bounds((least - x_rate) / 2.0, x_rate, x_bend)
        y_bend = z_bend + 2.0 * z_rate * x_rate + x_bend
        bound = float(np.sqrt(x_bend**2 + y_bend**2 + z_bend**2))
        return reach * (bound if np.isfinite(bound) else np.inf)

    def length_gradient(self, nodes: Array) -> tuple[Array, Index]:
        """Return (..., M, Q, 3) the gradients of the lengths with respect to (M, Q) nodes, m/m, at nodes (..., N, 3).

        An offset joint turns by w where the edges a and b of its triangle, of normal z, change by da and db:
        w = ((db.z) a - (da.z) b) / |a x b| + z (z.(a x da) / a.a + z.(b x db) / b.b) / 2.
        """
        place = nodes[..., self.corners, :]
        ends = self._ends_at(place, self.offset)
        direction = _unit(ends[..., 1, :] - ends[..., 0, :])
        outward = np.stack([-direction, direction], axis=-2)
        if self.has_pin_joints:
            return outward, self.members
        first, second = (place[..., k, :] - place[..., 0, :] for k in (1, 2))
        normal = np.cross(first, second)
        area = np.linalg.norm(normal, axis=-1, keepdims=True)
        z, moment = normal / area, np.cross(ends - place[..., 0, :], outward)
        spin = 0.5 * (moment * z).sum(axis=-1, keepdims=True)
        gradient = np.empty(place.shape)
        for k, edge, across in ((1, first, -second), (2, second, first)):
            tilt = (moment * across).sum(axis=-1, keepdims=True) / area
            along = (edge * edge).sum(axis=-1, keepdims=True)
            gradient[..., k, :] = tilt * z + spin * np.cross(z, edge) / along
        gradient[..., 0, :] = outward - gradient[..., 1, :] - gradient[..., 2, :]
        return gradient.reshape(*gradient.shape[:-4], -1, 6, 3), self.corners.reshape(-1, 6)

    def singular_values(
        self, nodes: Array, *, most_dense: int = _DENSE_UNKNOWNS
    ) -> tuple[float, float, float] | None:
        """Return the least singular value of the length Jacobian, and the least and greatest of the tip's.

        The length Jacobian is d lengths / d (free node positions), square in a determinate truss; the tip's
        is d tip position / d actuated lengths. None if the truss is not determinate or has no actuator. With more
        than `most_dense` free coordinates they come from a sparse factorisation.
        """
        from scipy.sparse import csc_array

        unknowns = 3 * len(self.free)
        if unknowns != len(self.members) or not self.actuated.any():
            return None
        gradient, index = self.length_gradient(nodes)
        column = np.full(len(self.home), -1)
        column[self.free] = np.arange(len(self.free))
        place = column[index]
        row, slot = np.nonzero(place >= 0)
        rows = np.repeat(row, 3)
        columns = (3 * place[row, slot][:, None] + np.arange(3)).reshape(-1)
        values = gradient[row, slot].reshape(-1)
        tip = np.zeros((unknowns, 3))
        for node, weight in zip(self.tip, self.tip_weights, strict=True):
            if column[node] >= 0:
                tip[3 * column[node] : 3 * column[node] + 3] += weight * np.eye(3)
        J = csc_array((values, (rows, columns)), shape=(unknowns, unknowns))
        if unknowns > most_dense:
            return self._sparse_values(J, tip)
        dense = J.toarray()
        least = float(np.linalg.svd(dense, compute_uv=False)[-1])
        try:
            return least, *extreme_values(np.linalg.solve(dense.T, tip)[self.actuated])
        except np.linalg.LinAlgError:
            return 0.0, 0.0, np.inf

    def _sparse_values(self, J: Any, tip: Array) -> tuple[float, float, float]:
        """See :meth:`singular_values`; the least by Lanczos' method on the inverse of J^T J."""
        from scipy.sparse.linalg import LinearOperator, eigsh, splu

        start = np.random.default_rng(0).normal(size=len(tip))
        try:
            factors = splu(J)
            inverse = LinearOperator(
                J.shape, lambda v: factors.solve(factors.solve(v, trans="T")), dtype=np.float64
            )
            greatest = eigsh(inverse, k=1, v0=start, tol=1e-10, return_eigenvectors=False)
        except RuntimeError:
            return 0.0, 0.0, np.inf
        least = float(1.0 / np.sqrt(greatest[0]))
        return least, *extreme_values(factors.solve(tip, trans="T")[self.actuated])


AnyRecordedArm = RecordedArm | RecordedChain
"""What both have in common is all that those know who need not know the kind."""


def recorded_arm(record: Mapping[str, Any], members: Index) -> AnyRecordedArm:
    """Return the arm of a manifest's record; `members` (M, 2) are the nodes of each member of a truss."""
    return RecordedChain(record) if record.get("kind") == RecordedChain.kind else RecordedArm(record, members)


def arm_of(maneuver: Result) -> AnyRecordedArm:
    """Return the arm of a result; ResultError if its record is malformed, or has another number of nodes."""
    arm, count = recorded_arm(maneuver.manifest["arm"], maneuver.members), maneuver.nodes.shape[1]
    if count != len(arm.home):
        raise ResultError(f"array nodes holds {count} nodes; manifest.arm describes {len(arm.home)}")
    return arm


def polygon_frame(points: Array, angles: Array | None) -> tuple[Array, Array]:
    """Return the (3, 3) frame fitted to a polygon (K, 3), and its nodes' polar angles (K,) in that frame.

    z is the direction of the area vector. x is the direction in the plane from which the nodes' polar angles
    differ least from `angles` (the planar Procrustes problem); any direction if `angles` is None.
    """
    spokes = points - points.mean(axis=0)
    z = _unit(np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0))
    seed = np.eye(3)[np.argmin(np.abs(z))]
    u = _unit(np.cross(seed, z))
    v = np.cross(z, u)
    planar = spokes @ u + 1j * (spokes @ v)
    if angles is not None:
        turn = np.sum(planar * np.exp(-1j * angles))
        turn /= abs(turn)
        u, v = turn.real * u + turn.imag * v, turn.real * v - turn.imag * u
        planar = planar / turn
    return np.stack([u, v, z], axis=1), np.angle(planar)


def _unit_bounds(least: Array, rate: Array, bend: Array) -> tuple[Array, Array]:
    """Bounds of the first and second derivative of w/|w| from |w| >= least, |w'| <= rate, |w''| <= bend."""
    held = least > 0.0
    safe = np.where(held, least, 1.0)
    relative = rate / safe
    return np.where(held, relative, np.inf), np.where(held, bend / safe + 3.0 * relative**2, np.inf)


def _bisector_bounds(first: list[Array], second: list[Array]) -> tuple[Array, Array]:
    """Bounds of the derivatives of the outward bisector's direction."""
    rates, bends, units = [], [], []
    for before, after in (first, second):
        rate = _norm(after - before)
        least = (_norm(before) + _norm(after) - rate) / 2.0
        unit_rate, unit_bend = _unit_bounds(least, rate, np.zeros_like(rate))
        rates.append(unit_rate)
        bends.append(unit_bend)
        units.append([before / _norm(before)[..., None], after / _norm(after)[..., None]])
    rate, bend = rates[0] + rates[1], bends[0] + bends[1]
    sums = [_norm(units[0][k] + units[1][k]) for k in range(2)]
    return _unit_bounds((sums[0] + sums[1] - rate) / 2.0, rate, bend)


def _normal_bounds(first: list[Array], second: list[Array]) -> tuple[Array, Array]:
    """Bounds of the derivatives of the direction of the product first x second, quadratic in the share."""
    change = [after - before for before, after in (first, second)]
    bend = 2.0 * _norm(np.cross(change[0], change[1]))
    slopes = [np.cross(change[0], second[k]) + np.cross(first[k], change[1]) for k in range(2)]
    rate = np.maximum(_norm(slopes[0]), _norm(slopes[1]))
    areas = [_norm(np.cross(first[k], second[k])) for k in range(2)]
    return _unit_bounds((areas[0] + areas[1] - rate) / 2.0, rate, bend)


def _norm(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
