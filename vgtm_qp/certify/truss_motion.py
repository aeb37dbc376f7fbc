"""The motion of a truss whose actuators change their lengths linearly, followed from home on with a proof.

The nodes x solve l(x) = L(s). From a known state, with the inverse A of the length Jacobian there, they move with
x' = A (L' - e), where e holds for each member the change of its direction times the relative velocity w of its ends.
If bounds of |w| reproduce themselves, the motion exists and keeps to them, and no other nodes within them have its
lengths. Each length's l'' = 0 then bounds x'', and so how far nodes leave their chords.
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


class TrussSolver:
    """Node positions of a truss from the lengths of its members, its base at home."""

    def __init__(self, arm: RecordedArm) -> None:
        self.arm = arm
        self._column = np.full(len(arm.home), len(arm.free))
        self._column[arm.free] = np.arange(len(arm.free))
        self.size = float(np.abs(arm.home).max()) + float(arm.length.max())

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
        tolerance = 64.0 * float(np.finfo(float).eps) * self.size
        open_ = np.arange(len(nodes))
        before = np.full(len(nodes), np.inf)
        for _ in range(_NEWTON_STEPS):
            missing = lengths[open_] - self.arm.lengths(nodes[open_])
            worst = np.abs(missing).max(axis=1)
            # Once the residual no longer halves, the last digits are as good as they get.
            going = np.isfinite(worst) & ((worst > tolerance) | (worst < 0.5 * before[open_]))
            before[open_] = worst
            open_, missing = open_[going], missing[going]
            if not len(open_):
                break
            try:
                step = np.linalg.solve(self.jacobian(nodes[open_]), missing[:, :, None])
            except np.linalg.LinAlgError:
                break
            nodes[open_[:, None], free] += step.reshape(len(open_), -1, 3)
        return nodes, before <= tolerance

    def apart(self, moved: Array) -> Array:
        """Return (U, M) how far the vectors between members' ends change where nodes are moved by (U, N, 3), m."""
        first, last = self.arm.members.T
        return np.asarray(np.linalg.norm(moved[:, last] - moved[:, first], axis=2))

    def inverse(self, nodes: Array) -> Array:
        """Return (U, F, 3, M) the derivatives of the free nodes by the lengths; NaN where they are singular."""
        found = np.full((len(nodes), 3 * len(self.arm.free), len(self.arm.members)), np.nan)
        for k, jacobian in enumerate(self.jacobian(nodes)):
            try:
                found[k] = np.linalg.inv(jacobian)
            except np.linalg.LinAlgError:
                continue
        return found.reshape(len(nodes), len(self.arm.free), 3, -1)


@dataclass
class Tube:
    """Proven bounds of motions (U,) that start from known states, while a share goes from 0 to 1.

    Attributes
    ----------
    closed : (U,) bool
        Whether the bounds hold.
    apart : (U, M)
        Bounds of the change of the vector between a member's ends, m.
    speed, bend : (U, N)
        Bounds of |x'| and |x''| of the nodes, m.
    sensitivity : (U,)
        Bound of a node's displacement per error in each length, anywhere within the bounds, m/m.
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
    relative = every[:, arm.members[:, 1]] - every[:, arm.members[:, 0]]
    of_nodes, of_members = np.linalg.norm(every, axis=2), np.linalg.norm(relative, axis=2)
    velocity = np.einsum("unck,uk->unc", every, change)
    first = solver.apart(velocity)
    first = first * _INFLATED + 1e-9 * (first.max(axis=1, keepdims=True) + 1e-9 * solver.size)
    eye = np.eye(len(arm.members))
    wider = (1.0 + _SLACK) * first + _SLACK**2 * first.max(axis=1, keepdims=True)
    apart = wider
    for _ in range(_ROUNDS):
        system = eye - of_members * _turned(apart, start)[:, None, :]
        apart = _solved(system, wider)
        # Bounds that have become useless stay so.
        apart = np.where((apart >= wider) & (apart < start), apart, 0.999 * start)
    turned = _turned(apart, start)
    again = first + np.einsum("umk,uk->um", of_members, turned * apart) * _INFLATED
    closed = ~singular & (again < apart).all(axis=1) & (apart < start).all(axis=1)
    least = np.minimum(start, start + change)
    curved = np.maximum(apart * apart - change * change, 0.0) / np.maximum(least, 1e-300)
    system = eye - of_members * turned[:, None, :]
    bends = _solved(system, np.einsum("umk,uk->um", of_members, curved))
    # Rounding turns zeros into small numbers of either sign.
    largest = 1e-9 * np.abs(bends).max(axis=1, keepdims=True)
    closed &= np.isfinite(bends).all(axis=1) & (bends >= -largest).all(axis=1) & (least > 0.0).all(axis=1)
    bends = np.where(closed[:, None], np.maximum(bends, 0.0) * _INFLATED + largest, 0.0)
    speed = np.linalg.norm(velocity, axis=2) + np.einsum("unm,um->un", of_nodes, turned * apart)
    bend = np.einsum("unm,um->un", of_nodes, curved + turned * bends) * _INFLATED
    wrong = 1.0 + turned * _solved(system, of_members.sum(axis=2))
    sensitivity = np.einsum("unm,um->un", of_nodes, wrong).max(axis=1)
    return Tube(closed, apart, speed * _INFLATED, bend, sensitivity)


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
        first, last = solver.arm.members.T
        self.bends = np.maximum(bends[:, first], bends[:, last])
        self.lost: set[int] = set()

    def ends_at(self, segment: Index, share: Array) -> Array:
        """Return the ends of the members; nodes are solved for from the lengths, starting on their chords."""
        share = share[:, None]
        before, after = self._nodes[segment], self._nodes[segment + 1]
        chord = before + share[..., None] * (after - before)
        lengths = self._lengths[segment] + share * (self._lengths[segment + 1] - self._lengths[segment])
        nodes, solved = self._solver.solve(chord, lengths)
        beyond = self._solver.apart(nodes - before) - self._apart[segment]
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
    if not arm.has_pin_joints:
        return None, [_doubt(start, end, "where offset joints are between rows is not bounded")]
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
        closed = np.asarray(found.closed & (self.solver.apart(last - first) <= found.apart).all(axis=1))
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
        self.error = max(self.error, float(found.sensitivity[closed].max(initial=0.0)))
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
            still = np.zeros((1, len(arm.home))), np.zeros((1, len(arm.members)))
            return self._with_rounding(TrussMotion(self.solver, time, np.stack([row, row]), *still, problem))
        segment, start = segment[order], start[order]
        nodes = np.concatenate([first[order], last[order[-1:]]])
        before, after = self.time[segment - 1], self.time[segment]
        time = np.append(before + start * (after - before), self.time[known - 1])
        poses = base_poses(problem, time)
        turn = np.linalg.norm(np.diff(poses[:, 3:], axis=0), axis=1)[:, None]
        reach = np.linalg.norm(nodes, axis=2)
        reach = np.maximum(reach[:-1], reach[1:]) + bend[order] / 8.0
        bends = bend[order] + turn * (2.0 * speed[order] + turn * reach)
        return self._with_rounding(TrussMotion(self.solver, time, nodes, bends, apart[order], problem))

    def _with_rounding(self, motion: TrussMotion) -> TrussMotion:
        """Return the motion, its `rounding` increased by the effect of the lengths' rounding on positions."""
        motion.rounding += 2.0 * self.error * 64.0 * float(np.finfo(float).eps) * self.solver.size
        return motion
