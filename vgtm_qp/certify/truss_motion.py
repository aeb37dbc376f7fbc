"""The motion of a truss whose actuators change their lengths linearly, followed from home on with a proof.

The nodes x solve l(x) = L(s). From a known state, with the inverse A of the length Jacobian J there, they move with
x' = A (L' - e), where e = (J(x) - J) x'. It is bounded by how far, and how fast, each member's nodes move apart and
each offset joint's triangle is deformed. If these bounds reproduce themselves, the motion exists and keeps to them, and
no other nodes within them have its lengths. Each length's l'' = 0 then bounds x'', and so how far ends leave their
chords.

A joint's frame depends on the edges e1 and e2 of its triangle, of heights h1 and h2 above each other. Edges that change
by f1 and f2 turn it by at most r = |f1|/h1 + |f2|/h2, its deformation: across its plane by the vector
((f2.z) e1 - (f1.z) e2) / |e1 x e2|, within it by half of each edge's own turn. That turn's derivative along another
deformation q is at most 2.6 r q, since z and the factors of f1 and f2 change at most by q times their sizes 1, 1/h1
and 1/h2, the factor (z x e1)/|e1|^2 by 2 q/h1. An end at a distance d from its node has a second derivative of at
most 3.6 d r q.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arrays import Array, Index
from vgtm_qp.certify.motion import GivenMotion
from vgtm_qp.certify.verdict import Finding
from vgtm_qp.result.poses import base_poses, rotations
from vgtm_qp.verify.arm import RecordedArm

GREATEST_DEPTH = 12
"""Number of halvings of a segment from which on its motion counts as unknown."""
_GREATEST_COUNT = 100_000
"""Number of intervals at a time from which on the motion counts as unknown."""
_ROUNDS = 8
_SLACK = 1e-3
"""Number of iterations towards bounds that reproduce themselves, and the relative slack asked of these."""
_NEWTON_STEPS = 30
_CHUNK = 4_000_000
_INFLATED = 1.0 + 1e-6
"""Factor of bounds that covers the rounding of solutions of linear equations."""
_BEND = 3.6
_MOST_DEFORMED = 0.5
"""Factor of an end's second derivative, see above, and the deformation of a joint up to which it is bounded."""


class TrussSolver:
    """Node positions of a truss from the lengths of its members, its base at home."""

    def __init__(self, arm: RecordedArm) -> None:
        self.arm = arm
        self._column = np.full(len(arm.home), len(arm.free))
        self._column[arm.free] = np.arange(len(arm.free))
        self.size = float(np.abs(arm.home).max()) + float(arm.length.max())
        self.tolerance = 64.0 * float(np.finfo(float).eps) * self.size
        """Of lengths that nodes are solved for, m."""
        # Triangles (J, 3) of offset joints; both joints of each member (M, 2), (M, 0) for pin joints.
        self._triangles, self.joints = np.zeros((0, 3), dtype=np.int64), np.zeros_like(arm.members[:, :0])
        if not arm.has_pin_joints:
            self._triangles, joints = np.unique(arm.corners.reshape(-1, 3), axis=0, return_inverse=True)
            self.joints = joints.reshape(-1, 2)
        self.reach = np.linalg.norm(arm.offset, axis=2)[:, : self.joints.shape[1]]
        """(M, 2) distances of members' ends from their nodes, m; (M, 0) for pin joints."""

    def jacobian(self, nodes: Array) -> Array:
        """Return (U, M, 3 F) the derivatives of the lengths by the free nodes at nodes (U, N, 3), m/m."""
        gradient, index = self.arm.length_gradient(nodes)
        found = np.zeros((len(nodes), len(index), len(self.arm.free) + 1, 3))
        rows = np.arange(len(index))
        for slot in range(index.shape[1]):
            found[:, rows, self._column[index[:, slot]]] += gradient[:, :, slot]
        return found[:, :, :-1].reshape(len(nodes), len(index), -1)

    def solve(self, nodes: Array, lengths: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return nodes (U, N, 3) of lengths (U, M), m, by Newton steps from `nodes`, and which of them were found."""
        nodes, free = nodes.copy(), self.arm.free
        open_ = np.arange(len(nodes))
        before = np.full(len(nodes), np.inf)
        for _ in range(_NEWTON_STEPS):
            missing = lengths[open_] - self.arm.lengths(nodes[open_])
            worst = np.abs(missing).max(axis=1)
            # Once the residual no longer halves, the last digits are as good as they get.
            going = np.isfinite(worst) & ((worst > self.tolerance) | (worst < 0.5 * before[open_]))
            before[open_] = worst
            open_, missing = open_[going], missing[going]
            if not len(open_):
                break
            try:
                step = np.linalg.solve(self.jacobian(nodes[open_]), missing[:, :, None])
            except np.linalg.LinAlgError:
                break
            nodes[open_[:, None], free] += step.reshape(len(open_), -1, 3)
        return nodes, before <= self.tolerance

    def apart(self, nodes: Array, moved: Array) -> Array:
        """Return (U, M + J, ...) how far members' nodes move apart, m, and how far joints are deformed.

        Nodes (U, N, 3) are moved by (U, N, 3, ...), m. See above for the deformation, which has no unit.
        """
        first, last = self.arm.members.T
        between = np.linalg.norm(moved[:, last] - moved[:, first], axis=2)
        if not len(self._triangles):
            return np.asarray(between)
        own, others = self._triangles[:, :1], self._triangles[:, 1:]
        edges = np.linalg.norm(moved[:, others] - moved[:, own], axis=3)
        heights = self._heights(nodes).reshape(*edges.shape[:3], *(1,) * (edges.ndim - 3))
        return np.concatenate([between, (edges / heights).sum(axis=2)], axis=1)

    def _heights(self, nodes: Array) -> Array:
        """Return (U, J, 2) the distance of both edges' far ends from the other edge's line, m."""
        edges = nodes[:, self._triangles[:, 1:]] - nodes[:, self._triangles[:, :1]]
        area = np.linalg.norm(np.cross(edges[:, :, 0], edges[:, :, 1]), axis=2)
        return np.asarray(area[..., None] / np.linalg.norm(edges[:, :, ::-1], axis=3))

    def slots(self, bounds: Array) -> list[Array]:
        """Return the rows (U, M, ...) of `bounds` (U, M + J, ...) of a member's nodes, and of its offset joints."""
        count = len(self.arm.members)
        return [bounds[:, :count], *(bounds[:, count + joint] for joint in self.joints.T)]

    def end_errors(self, nodes: Array) -> float:
        """Return how far an end may move at most if each node at (U, N, 3) moves by 1 m, m."""
        deformed = 2.0 * (1.0 / self._heights(nodes)).sum(axis=2)
        return 1.0 + float((self.reach * deformed[:, self.joints]).max(initial=0.0))

    def inverse(self, nodes: Array) -> Array:
        """Return (U, F, 3, M) the derivatives of the free nodes by the lengths; NaN where they are singular."""
        found = np.full((len(nodes), 3 * len(self.arm.free), len(self.arm.members)), np.nan)
        for k, jacobian in enumerate(self.jacobian(nodes)):
            try:
                found[k] = np.linalg.inv(jacobian)
            except np.linalg.LinAlgError:
                continue
        return found.reshape(len(nodes), len(self.arm.free), 3, -1)


class TubeBounds:
    """How far lengths (U, M), m, and ends may change while a truss keeps to bounds `apart` (U, M + J).

    See `TrussSolver.apart`. A deformation by r leaves at least (1 - r - r^2/4) / (1 + r) of a joint's heights.

    Attributes
    ----------
    between : (U, M)
        How far the vectors between members' ends change, m.
    turn, lever : (U, M, E)
        How far a member's joints turn, rad, and how far its ends move per deformation, m. E is 2, or 0 for pin joints.
    slopes : list of (U, M)
        How far the derivatives of a length change: that by the vector between its nodes, m/m, and with offset joints
        those by the deformations of its first and its second joint, m.
    bends : (U, M, E)
        Second derivatives of the ends in their joints by a share, if `apart` bounds speeds as well, m.
    """

    def __init__(self, solver: TrussSolver, apart: Array, length: Array) -> None:
        self._solver = solver
        apart, *deformed = solver.slots(apart)
        r = np.stack(deformed, axis=2) if deformed else np.zeros((*apart.shape, 0))
        grown = (1.0 + r) / (1.0 - r - 0.25 * r * r)
        self.lever, self.turn = solver.reach * grown, grown * r
        self.between = apart + (self.lever * r).sum(axis=2)
        turned = _turned(self.between, length)
        of_joints = self.lever * (turned[:, :, None] + _BEND * self.turn)
        self.slopes = [turned, *np.moveaxis(of_joints, 2, 0)]
        self.bends = _BEND * solver.reach * self.turn**2

    def errors(self, rates: list[Array]) -> Array:
        """Return (U, M, ...) how far the lengths' rates differ from those at the start, m, for rates as of `slots`."""
        wider = (..., *(None,) * (rates[0].ndim - 2))
        found: Array = self.slopes[0][wider] * rates[0]
        for slope, rate in zip(self.slopes[1:], rates[1:], strict=True):
            found += slope[wider] * rate
        return found

    def ends(self, nodes: Array, deformed: Array) -> Array:
        """Return (U, M) how far members' ends move, m, where nodes move by (U, N), and joints as in `deformed`."""
        _, *joints = self._solver.slots(deformed)
        found = nodes[:, self._solver.arm.members].max(axis=2)
        for k, rate in enumerate(joints):
            found = np.maximum(found, nodes[:, self._solver.arm.members[:, k]] + self.lever[:, :, k] * rate)
        return np.asarray(found)


@dataclass
class Tube:
    """Proven bounds of motions (U,) that start from known states, while a share goes from 0 to 1.

    Attributes
    ----------
    closed : (U,) bool
        Whether the bounds hold.
    apart : (U, M + J)
        Bounds of the change of the vector between a member's nodes, m, and of joints' deformations.
    speed, bend : (U, M)
        Bounds of |r'| and |r''| of members' ends, m.
    sensitivity : (U,)
        Bound of an end's displacement per error in each length, anywhere within the bounds, m/m.
    """

    closed: NDArray[np.bool_]
    apart: Array
    speed: Array
    bend: Array
    sensitivity: Array


# Near singular states numbers overflow, and then prove nothing.
@np.errstate(all="ignore")
def tube(solver: TrussSolver, nodes: Array, start: Array, change: Array) -> Tube:
    """Return the tube from states (U, N, 3) of lengths `start` (U, M) that change by `change` (U, M), m."""
    arm, count = solver.arm, len(nodes)
    inverse = solver.inverse(nodes)
    singular = np.array([not np.isfinite(each).all() for each in inverse], dtype=np.bool_)
    every = np.zeros((count, len(arm.home), 3, len(arm.members)))
    every[:, arm.free] = np.where(singular[:, None, None, None], 0.0, inverse)
    of_nodes, of_all = np.linalg.norm(every, axis=2), solver.apart(nodes, every)
    of_slots = solver.slots(of_all)
    velocity = np.einsum("unck,uk->unc", every, change)
    first = solver.apart(nodes, velocity)
    # Where the truss stands still, nodes are solved for to the last digits only.
    first = first * _INFLATED + 2.0 * solver.tolerance * of_all.sum(axis=2)
    first += 1e-9 * first.max(axis=1, keepdims=True)
    most = np.full(first.shape, _MOST_DEFORMED)
    most[:, : start.shape[1]] = start
    eye = np.eye(len(arm.members))
    wider = (1.0 + _SLACK) * first + _SLACK**2 * first.max(axis=1, keepdims=True)
    apart = wider
    for _ in range(_ROUNDS):
        within = TubeBounds(solver, apart, start)
        errors = _solved(eye - within.errors(of_slots), within.errors(solver.slots(wider)))
        apart = wider + _times(of_all, errors)
        # Bounds that have become useless stay so.
        apart = np.where((apart >= wider) & (apart < most), apart, 0.999 * most)
    within = TubeBounds(solver, apart, start)
    errors = within.errors(solver.slots(apart))
    again = first + _times(of_all, errors) * _INFLATED
    closed = ~singular & (again < apart).all(axis=1) & (apart < most).all(axis=1)
    least = np.minimum(start, start + change)
    closed &= ((within.between < start) & (least > 0.0)).all(axis=1)
    curved = np.maximum(within.between**2 - change * change, 0.0) / np.maximum(least, 1e-300)
    system = eye - within.errors(of_slots)
    curved = _solved(system, curved + within.bends.sum(axis=2))
    # Rounding turns zeros into small numbers of either sign.
    largest = 1e-9 * np.abs(curved).max(axis=1, keepdims=True)
    closed &= np.isfinite(curved).all(axis=1) & (curved >= -largest).all(axis=1)
    curved = np.where(closed[:, None], np.maximum(curved, 0.0) * _INFLATED + largest, 0.0)
    speed = within.ends(np.linalg.norm(velocity, axis=2) + _times(of_nodes, errors), apart)
    bend = within.ends(_times(of_nodes, curved), _times(of_all, curved))
    bend += within.bends.max(axis=2, initial=0.0)
    wrong = _solved(system, np.ones(start.shape))
    sensitivity = within.ends(_times(of_nodes, wrong), _times(of_all, wrong)).max(axis=1)
    return Tube(closed, apart, speed * _INFLATED, bend * _INFLATED, sensitivity)


def _times(factors: Array, of: Array) -> Array:
    """Return (U, K) the products of matrices (U, K, M) and vectors (U, M)."""
    return np.asarray((factors @ of[:, :, None])[:, :, 0])


def _turned(apart: Array, length: Array) -> Array:
    """Return how far the directions of vectors of `length` change at most if these change by `apart`, m.

    |u - v| <= 2 |x - y| / (|x| + |y|) for the directions u and v of x and y (Dunkl and Williams, 1964).
    """
    return np.asarray(2.0 * apart / np.maximum(2.0 * length - apart, 1e-300))


def _solved(system: Array, right: Array) -> Array:
    """Return (U, M) solutions; NaN where a system (M, M) is singular."""
    found = np.full(right.shape, np.nan)
    for k in range(len(system)):
        try:
            found[k] = np.linalg.solve(system[k], right[k])
        except np.linalg.LinAlgError:
            continue
    return found


class TrussMotion(GivenMotion):
    """A truss along intervals in each of which a `tube` proves where it is."""

    def __init__(
        self,
        solver: TrussSolver,
        time: Array,
        nodes: Array,
        bends: Array,
        apart: Array,
        problem: Mapping[str, Any],
    ) -> None:
        self._solver, self._nodes, self._apart, self._problem = solver, nodes, apart, problem
        self._lengths = solver.arm.lengths(nodes)
        super().__init__(solver.arm, time, self._placed(nodes, time))
        self.bends = bends
        self.lost: set[int] = set()

    def ends_at(self, segment: Index, share: Array) -> Array:
        """Return the ends of the members; nodes are solved for from the lengths, starting on their chords."""
        share = share[:, None]
        before, after = self._nodes[segment], self._nodes[segment + 1]
        chord = before + share[..., None] * (after - before)
        lengths = self._lengths[segment] + share * (self._lengths[segment + 1] - self._lengths[segment])
        nodes, solved = self._solver.solve(chord, lengths)
        beyond = self._solver.apart(before, nodes - before) - self._apart[segment]
        self.lost |= set(segment[~solved | (beyond > 1e-9 * self._solver.size).any(axis=1)].tolist())
        return self.arm.states_ends(self._placed(nodes, self.times_at(segment, share[:, 0])))

    def doubts(self) -> Iterator[Finding]:
        """Yield the segments in which positions were not found where they are proven to be."""
        for k in sorted(self.lost):
            reason = "its nodes were not found to the last digits"
            yield _doubt(float(self.time[k]), float(self.time[k + 1]), reason)

    def _placed(self, nodes: Array, time: Array) -> Array:
        """Return nodes (U, N, 3) with the base where it is at times (U,)."""
        poses = base_poses(self._problem, time)
        turned = nodes @ np.swapaxes(rotations(poses[:, 3:]), 1, 2)
        return np.asarray(turned + poses[:, None, :3])


def truss_motion(
    arm: RecordedArm, time: Array, lengths: Array, problem: Mapping[str, Any]
) -> tuple[TrussMotion | None, list[Finding]]:
    """Return the motion of a truss through rows of lengths (T, M) at times (T,), s, and findings.

    From home the lengths go to the first row in a straight line. The motion ends where no tube is found; None
    if that is before the first row. A finding says from when on it is unknown.
    """
    start, end = float(time[0]), float(time[-1])
    solver, lengths = TrussSolver(arm), np.concatenate([arm.length[None], lengths])
    followed = _FollowedTruss(solver, _rows(solver, lengths), lengths, time)
    known = followed.follow()
    if known == 0:
        reason = "its first row was not reached from home in a straight line of lengths"
        return None, [_doubt(start, end, reason)]
    doubts = []
    if known < len(time):
        reason = "it comes too near to a singular pose to be followed from here on"
        doubts = [_doubt(float(time[known - 1]), end, reason)]
    return followed.motion(known, problem), doubts


def _doubt(start: float, end: float, reason: str) -> Finding:
    return Finding(start, end, "motion", ("truss",), np.nan, np.nan, reason=reason)


def _rows(solver: TrussSolver, lengths: Array) -> Array:
    """Return (R, N, 3) nodes of rows of lengths (R, M), home first, up to the first unsolved row."""
    found = [solver.arm.home]
    for k in range(1, len(lengths)):
        nodes, solved = solver.solve(found[-1][None], lengths[k : k + 1])
        if not solved[0]:
            break
        found.append(nodes[0])
    return np.array(found)


class _FollowedTruss:
    """A truss that is followed from row to row, with intervals of segments as short as the proof needs them."""

    def __init__(self, solver: TrussSolver, rows: Array, lengths: Array, time: Array) -> None:
        self.solver, self.rows, self.lengths, self.time = solver, rows, lengths, time
        self.parts: list[tuple[Index, Array, Array, Array, Array, Array, Array]] = []
        self.error = 0.0

    def follow(self) -> int:
        """Return the number of rows, without home, through which the motion is known."""
        segment = np.arange(len(self.rows) - 1)
        start, width = np.zeros(len(segment)), 1.0
        first, last = self.rows[:-1], self.rows[1:]
        known = len(segment)
        for _ in range(GREATEST_DEPTH):
            closed = np.zeros(len(segment), dtype=np.bool_)
            size = max(1, _CHUNK // (3 * len(self.solver.arm.members) ** 2))
            for k in range(0, len(segment), size):
                rows = np.arange(k, min(k + size, len(segment)))
                closed[rows] = self._prove(segment[rows], start[rows], width, first[rows], last[rows])
            open_ = np.flatnonzero(~closed & (segment < known))
            if not len(open_):
                return known
            if 2 * len(open_) > _GREATEST_COUNT:
                break
            segment, start, first, last = segment[open_], start[open_], first[open_], last[open_]
            width /= 2.0
            middle, solved = self.solver.solve(0.5 * (first + last), self._lengths_at(segment, start + width))
            known = min(known, int(segment[~solved].min(initial=known)))
            first, last = (
                np.stack(pair, axis=1).reshape(-1, *first.shape[1:])
                for pair in ((first, middle), (middle, last))
            )
            start = np.stack([start, start + width], axis=1).reshape(-1)
            segment = np.repeat(segment, 2)
        return min(known, int(segment.min(initial=known)))

    def _lengths_at(self, segment: Index, share: Array) -> Array:
        before, after = self.lengths[segment], self.lengths[segment + 1]
        return np.asarray(before + share[:, None] * (after - before))

    def _prove(
        self, segment: Index, start: Array, width: float, first: Array, last: Array
    ) -> NDArray[np.bool_]:
        """Return the intervals (P,) in which a tube proves that `first` leads to `last`, and store these."""
        begin, end = (self._lengths_at(segment, start + step) for step in (0.0, width))
        found = tube(self.solver, first, begin, end - begin)
        closed = np.asarray(
            found.closed & (self.solver.apart(first, last - first) <= found.apart).all(axis=1)
        )
        self.parts.append(
            (
                segment[closed],
                start[closed],
                first[closed],
                last[closed],
                found.speed[closed],
                found.bend[closed],
                found.apart[closed],
            )
        )
        error = float(found.sensitivity[closed].max(initial=0.0)) * self.solver.end_errors(first[closed])
        self.error = max(self.error, error)
        return closed

    def motion(self, known: int, problem: Mapping[str, Any]) -> TrussMotion:
        """Return the motion through the first `known` rows."""
        arm = self.solver.arm
        segment, start, first, last, speed, bend, apart = (
            np.concatenate(parts) for parts in zip(*self.parts, strict=True)
        )
        # The first segment leads from home to the first row.
        order = np.lexsort((start, segment))
        order = order[(segment[order] >= 1) & (segment[order] < known)]
        if not len(order):
            row, time = self.rows[1], np.repeat(self.time[:1], 2)
            still = np.zeros((1, len(arm.members))), np.zeros((1, apart.shape[1]))
            return self._with_rounding(TrussMotion(self.solver, time, np.stack([row, row]), *still, problem))
        segment, start = segment[order], start[order]
        nodes = np.concatenate([first[order], last[order[-1:]]])
        before, after = self.time[segment - 1], self.time[segment]
        time = np.append(before + start * (after - before), self.time[known - 1])
        poses = base_poses(problem, time)
        turn = np.linalg.norm(np.diff(poses[:, 3:], axis=0), axis=1)[:, None]
        reach = np.linalg.norm(arm.ends(nodes), axis=3).max(axis=2)
        reach = np.maximum(reach[:-1], reach[1:]) + bend[order] / 8.0
        bends = bend[order] + turn * (2.0 * speed[order] + turn * reach)
        return self._with_rounding(TrussMotion(self.solver, time, nodes, bends, apart[order], problem))

    def _with_rounding(self, motion: TrussMotion) -> TrussMotion:
        """Return the motion, its `rounding` increased by the effect of the lengths' rounding on positions."""
        motion.rounding += 2.0 * self.error * self.solver.tolerance
        return motion
