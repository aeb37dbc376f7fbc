"""Tracking a given curve, eq. (39), section 4.5: segment after segment, or all at once chained by blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from vgtm_qp.arrays import Array, Index
from vgtm_qp.errors import SolverError
from vgtm_qp.methods.assembly import CurveNodes
from vgtm_qp.methods.resolver import LENGTH_TOLERANCE, MAX_CORRECTIONS
from vgtm_qp.methods.segments import Segment


class SegmentEquations(Protocol):
    """The equations of K segments of one shape, stacked: r rows over c own coordinates and b before them.

    ``numbers`` (K,) are those of the segments; ``columns`` (K, c) are their own coordinates.
    """

    numbers: Index
    columns: Index

    def matrices(self) -> tuple[Array, Array]:
        """Return the derivatives by own coordinates (K, r, c) and by those from ``Segment.first`` on (K, r, b)."""
        ...

    def displacements(self, moved: Array, turned: Array) -> Array:
        """Return the right-hand sides (K, r) for curve nodes that move and turn, (S, 3) each, m and rad."""
        ...

    def residuals(self, q: Array, nodes: CurveNodes) -> Array:
        """Return (K, r) what is missing at the evaluated configuration `q`."""
        ...


class SegmentedArm(Protocol):
    """An arm in segments: everything that a :class:`Tracker` knows of it.

    ``coordinates`` is their number, and ``furthest`` the greatest displacement, m, of one in an iteration.
    """

    coordinates: int
    furthest: float

    def equations(
        self, segments: Sequence[Segment]
    ) -> tuple[Callable[[Array], None], Sequence[SegmentEquations]]:
        """Return what evaluates the equations of some segments at a configuration, and the equations in groups."""
        ...

    def move(self, q: Array, own: slice, d: Array) -> None:
        """Add displacements `d` of the coordinates `own`, m, to a configuration."""
        ...


class Tracker:
    """Moves an arm so that its segments meet the curve nodes.

    A segment with more motions than equations moves by the least displacements of its coordinates to first
    order: in the row space of its matrix at the start of the step, where its answer is unique. Recursive and
    parallel tracking solve the same equations. *Recursive* converges each segment before the next. *Parallel*
    factorises all segments at once at the present configuration, and a chain of small products gives the
    effect of each on the next (block condensation).
    """

    def __init__(self, arm: SegmentedArm, segments: Sequence[Segment], *, parallel: bool) -> None:
        self.segments, self._arm = segments, arm
        if parallel:
            self._chains = [_Chain(arm, segments, "tracking: Newton's method on all segments at once {}")]
            return
        failure = "tracking: Newton's method {{}} for the {}"
        self._chains = [_Chain(arm, [one], failure.format(one.name)) for one in segments]

    def rates(self, q: Array, moved: Array, turned: Array) -> Array:
        """Return the configuration after a step from `q` that follows the curve nodes to first order.

        It solves eq. (39) for the curve nodes' displacements `moved` (S, 3), m, and rotation vectors `turned`
        (S, 3), rad.

        Raises
        ------
        SolverError
            A segment is in a singular pose.
        """
        step = np.zeros(self._arm.coordinates)
        for chain in self._chains:
            chain.evaluate(q)
            chain.solve([group.displacements(moved, turned) for group in chain.groups], step)
        q = np.array(q)
        self._arm.move(q, slice(0, len(step)), step)
        return q

    def track(self, q: Array, nodes: CurveNodes) -> Array:
        """Return the configuration with end stations at the curve nodes and exact fixed lengths, by Newton from `q`.

        The Jacobian is that of eq. (39).

        Raises
        ------
        SolverError
            Newton's method does not converge; the message names the segment.
        """
        start, q = q, np.array(q)
        travelled, step = np.zeros((2, self._arm.coordinates))
        for chain in self._chains:
            self._converge(chain, start, q, travelled, step, nodes)
        return q

    def _converge(
        self, chain: _Chain, start: Array, q: Array, travelled: Array, step: Array, nodes: CurveNodes
    ) -> None:
        """Move the segments of a chain to their places; writes `q`, `travelled` and the last `step`."""
        # The first step starts at the old configuration of the segments before, and has their displacement as
        # input.
        at, step[chain.before] = start, travelled[chain.before]
        within = None
        for _ in range(MAX_CORRECTIONS + 1):
            chain.evaluate(at)
            residuals = [group.residuals(at, nodes) for group in chain.groups]
            is_met = all(float(np.abs(residual).max()) <= LENGTH_TOLERANCE for residual in residuals)
            if is_met and not step[chain.before].any():
                return
            within = chain.solve(residuals, step, within)
            own = step[chain.own]
            if not float(np.abs(own).max()) <= self._arm.furthest:
                raise SolverError(chain.failure.format("diverges"))
            travelled[chain.own] += own
            self._arm.move(q, chain.own, own)
            at, step[chain.before] = q, 0.0
        raise SolverError(chain.failure.format("does not converge"))


class _Chain:
    """Segments that are solved at once, as one block-triangular system.

    Each segment's matrix is factorised independently. One sequential product a segment remains: of a small
    matrix with the displacements of the coordinates that the segment stands on.

    `failure` is the format of the error message. The segments own the coordinates ``own``, and stand on those
    ``before``. ``evaluate`` evaluates the equations of all ``groups`` at a configuration.
    """

    def __init__(self, arm: SegmentedArm, segments: Sequence[Segment], failure: str) -> None:
        self._on_others = [segment for segment in segments if segment.first < segment.start]
        self.evaluate, self.groups = arm.equations(segments)
        self.failure = failure
        self.own = slice(segments[0].start, segments[-1].end)
        self.before = slice(segments[0].first, segments[0].start)

    def solve(self, right: list[Array], step: Array, within: list[Array] | None = None) -> list[Array]:
        """Overwrite the own coordinates of `step` with the solution of all segments, given the coordinates before them.

        Those of each segment are in the row space of `within`, matrices (K, r, c) of each group; by default of
        the present ones. Returns these matrices.
        """
        passed: dict[int, Array] = {}
        matrices = [group.matrices() for group in self.groups]
        within = within or [own for own, _ in matrices]
        for group, (own, before), rhs, rows in zip(self.groups, matrices, right, within, strict=True):
            answers = _solution(own, np.concatenate([rhs[:, :, None], before], axis=2), rows)
            step[group.columns] = answers[:, :, 0]
            passed |= zip(group.numbers.tolist(), answers[:, :, 1:], strict=True)
        for segment in self._on_others:
            passes = passed[segment.number][:, : segment.start - segment.first]
            step[segment.start : segment.end] -= passes @ step[segment.first : segment.start]
        return within


def _solution(A: Array, b: Array, within: Array) -> Array:
    """Return the solutions (K, c, n) of A x = b in the row space of `within`, which is shaped as A (K, r, c)."""
    try:
        if A.shape[1] == A.shape[2]:
            return np.asarray(np.linalg.solve(A, b))
        columns = np.swapaxes(within, 1, 2)
        return np.asarray(columns @ np.linalg.solve(A @ columns, b))
    except np.linalg.LinAlgError:
        raise SolverError("tracking: a segment is in a singular pose") from None
