"""Tracking a given curve, eq. (39), section 4.5: bay after bay, or all bays at once chained by small blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from vgtm_qp.arm.arm import Kinematics
from vgtm_qp.arm.truss.arm import truss_of
from vgtm_qp.arrays import Array
from vgtm_qp.errors import SolverError
from vgtm_qp.methods.assembly import CurveNodes, SegmentGroup, SegmentKinematics
from vgtm_qp.methods.resolver import LENGTH_TOLERANCE, MAX_CORRECTIONS
from vgtm_qp.methods.segments import Segment
from vgtm_qp.qp.layout import Layout

_STILL = 1e-11


class Tracker:
    """Moves the nodes of a truss so that its segments meet the curve nodes.

    A segment with more motions than equations moves by the least sum of squares of its nodes' displacements
    over the step; the others have one answer. Recursive and parallel tracking solve the same equations.
    *Recursive* converges each segment before the next. *Parallel* factorises all segments at once at the
    present configuration, and a chain of small products gives the effect of each on the next (block
    condensation).
    """

    def __init__(
        self, layout: Layout, kinematics: Kinematics, segments: Sequence[Segment], *, parallel: bool
    ) -> None:
        self.segments = segments
        self._free, self._columns = layout.arm.free, layout.node_columns
        self._furthest = 2.0 * float(layout.arm.home_quantities.max())
        if parallel:
            failure = "tracking: Newton's method on all bays at once {}"
            self._chains = [_Chain(layout, segments, kinematics, kinematics.evaluate, failure)]
            return
        single = SegmentKinematics(truss_of(layout.arm))
        self._chains = [
            _Chain(
                layout,
                [segment],
                single,
                partial(single.evaluate, segment=segment),
                f"tracking: Newton's method {{}} in the bay below face {segment.face}",
            )
            for segment in segments
        ]

    def rates(self, X: Array, moved: Array, turned: Array) -> Array:
        """Return node positions (N, 3), m, after a step from `X` that follows the curve nodes to first order.

        It solves eq. (39) for the curve nodes' displacements `moved` (S, 3), m, and rotation vectors `turned`
        (S, 3), rad.

        Raises
        ------
        SolverError
            A segment is in a singular pose.
        """
        step, still = np.zeros(self._columns), np.zeros(self._columns)
        for chain in self._chains:
            chain.evaluate(X)
            chain.solve([group.displacements(moved, turned) for group in chain.groups], still, step)
        X = np.array(X)
        X[self._free] += step.reshape(-1, 3)
        return X

    def track(self, X: Array, nodes: CurveNodes) -> Array:
        """Return node positions (N, 3), m, with end faces at the curve nodes and exact lengths, by Newton from `X`.

        The Jacobian is that of eq. (39). A step of a segment with spare motions is A^+ (residual + A t) - t, with t its
        displacement from `X` so far. Its fixed point is the least displacement, whatever the iterates are.

        Raises
        ------
        SolverError
            Newton's method does not converge; the message names the segment.
        """
        start, X = X, np.array(X)
        travelled, step = np.zeros((2, self._columns))
        for chain in self._chains:
            self._converge(chain, start, X, travelled, step, nodes)
        return X

    def _converge(
        self, chain: _Chain, start: Array, X: Array, travelled: Array, step: Array, nodes: CurveNodes
    ) -> None:
        """Move the nodes of a chain to their places; updates `X` and their displacements, `travelled`."""
        # The first step starts at the old configuration of the bays below, and has their displacement as
        # input.
        at, step[chain.before] = start, travelled[chain.before]
        for _ in range(MAX_CORRECTIONS + 1):
            chain.evaluate(at)
            residuals = [group.residuals(at, nodes) for group in chain.groups]
            is_met = all(float(np.abs(residual).max()) <= LENGTH_TOLERANCE for residual in residuals)
            is_met = is_met and not step[chain.before].any()
            if is_met and chain.is_square:
                return
            chain.solve(residuals, travelled, step)
            own = step[chain.own]
            largest = float(np.abs(own).max())
            if is_met and largest <= _STILL:
                return
            if not largest <= self._furthest:
                raise SolverError(chain.failure.format("diverges"))
            travelled[chain.own] += own
            X[chain.nodes] += own.reshape(-1, 3)
            at, step[chain.before] = X, 0.0
        raise SolverError(chain.failure.format("does not converge"))


class _Chain:
    """Segments that are solved at once, as one block-bidiagonal system.

    Each segment's matrix is factorised independently. One sequential product a segment remains: of a small
    matrix with the displacement of the nodes that the segment stands on.

    `evaluate` evaluates the kinematics of all ``groups`` at node positions (N, 3); `failure` is the format of the error
    message. The segments place ``nodes``, columns ``own``, and stand on nodes with the columns ``before``.
    """

    def __init__(
        self,
        layout: Layout,
        segments: Sequence[Segment],
        kinematics: Kinematics | SegmentKinematics,
        evaluate: Callable[[Array], None],
        failure: str,
    ) -> None:
        shapes: dict[tuple[int, int, int, str], list[Segment]] = {}
        for segment in segments:
            before = segment.start - segment.first
            shapes.setdefault((segment.rows, segment.columns, before, segment.tracks), []).append(segment)
        self._on_others = [segment for segment in segments if segment.first < segment.start]
        self.groups = [SegmentGroup(layout, alike, kinematics) for alike in shapes.values()]
        self.evaluate, self.failure = evaluate, failure
        self.is_square = all(group.is_square for group in self.groups)
        self.nodes = np.concatenate([segment.nodes for segment in segments])
        self.own = slice(segments[0].start, segments[-1].start + segments[-1].columns)
        self.before = slice(segments[0].first, segments[0].start)

    def solve(self, right: list[Array], travelled: Array, step: Array) -> None:
        """Overwrite the own columns of `step` with the solution of all segments, given the columns before them."""
        passed: dict[int, Array] = {}
        for group, rhs in zip(self.groups, right, strict=True):
            own, before = group.matrices()
            total = rhs[:, :, None]
            if not group.is_square:
                total = total + own @ travelled[group.columns][:, :, None]
            answers = _least_norm(own, np.concatenate([total, before], axis=2))
            step[group.columns] = answers[:, :, 0]
            if not group.is_square:
                step[group.columns] -= travelled[group.columns]
            passed |= zip(group.numbers.tolist(), answers[:, :, 1:], strict=True)
        for segment in self._on_others:
            end = segment.start + segment.columns
            step[segment.start : end] -= passed[segment.number] @ step[segment.first : segment.start]


def _least_norm(A: Array, b: Array) -> Array:
    """Return the solutions of A x = b, or those of least norm where A (K, r, c) has more columns than rows."""
    rows, columns = A.shape[1:]
    try:
        if rows == columns:
            return np.asarray(np.linalg.solve(A, b))
        At = np.swapaxes(A, 1, 2)
        return np.asarray(At @ np.linalg.solve(A @ At, b))
    except np.linalg.LinAlgError:
        raise SolverError("tracking: a bay is in a singular pose") from None
