"""Tracking a given curve, eq. (39), section 4.5: bay after bay, or all bays at once chained by small blocks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from vgtm_qp.arm.arm import Kinematics
from vgtm_qp.compiled import Kernel
from vgtm_qp.errors import SolverError
from vgtm_qp.methods.condensation import Condensation, CurveNodes, least_norm
from vgtm_qp.methods.resolver import LENGTH_TOLERANCE, MAX_CORRECTIONS
from vgtm_qp.methods.segment_system import SegmentSystem
from vgtm_qp.methods.segments import Segment
from vgtm_qp.qp.layout import Layout

Array = NDArray[np.float64]

_STILL = 1e-11


class Tracker:
    """Moves the nodes of a truss so that its segments meet the curve nodes.

    A segment with more motions than equations moves by the least sum of squares of its nodes' displacements over
    the step; the others have one answer. Recursive and parallel solve the same equations: *recursive* converges
    each segment before it goes on to the next; *parallel* factorises all segments at the present configuration at
    once, and a chain of small products passes on what each does to the next (block condensation).

    Attributes
    ----------
    segments : tuple of Segment
    """

    def __init__(
        self,
        layout: Layout,
        kinematics: Kinematics,
        segments: Sequence[Segment],
        home_lengths: Array,
        *,
        parallel: bool,
    ) -> None:
        self.segments = tuple(segments)
        self._free, self._columns = layout.arm.free, layout.node_columns
        self._kinematics = kinematics
        self._furthest = 2.0 * float(home_lengths.max())
        self._condensation: Condensation | None = None
        self._systems: list[SegmentSystem] = []
        if parallel:
            self._condensation = Condensation(layout, kinematics, self.segments, home_lengths)
        else:
            kernels: dict[tuple[int, bool], Kernel] = {}
            self._systems = [
                SegmentSystem(layout, segment, home_lengths, kernels) for segment in self.segments
            ]

    def rates(self, X: Array, moved: Array, turned: Array) -> Array:
        """Return node positions (N, 3), m, after a step that meets eq. (39) to first order from `X`.

        Parameters
        ----------
        X : (N, 3)
            Node positions, m.
        moved, turned : (S, 3)
            Displacements, m, and rotation vectors, rad, of the curve nodes.

        Raises
        ------
        SolverError
            A segment is in a singular pose.
        """
        if self._condensation is not None:
            self._kinematics.evaluate(X)
            d = self._condensation.rates(moved, turned)
        else:
            d = np.zeros(self._columns)
            for k, system in enumerate(self._systems):
                segment = system.segment
                system.evaluate(X)
                own, before = system.matrices()
                rhs = system.displacement(moved[k], turned[k]) - before @ d[segment.first : segment.start]
                d[segment.start : segment.start + segment.columns] = least_norm(own, rhs)
        moved_nodes = np.array(X)
        moved_nodes[self._free] += d.reshape(-1, 3)
        return moved_nodes

    def track(self, X: Array, nodes: CurveNodes) -> Array:
        """Return node positions (N, 3), m, that meet eq. (39) and all fixed lengths, by Newton's method from `X`.

        A step of a segment with spare motions is A^+ (residual + A t) - t, with t what it has travelled from `X`:
        its fixed point is the least displacement, whatever the iterates were.

        Raises
        ------
        SolverError
            It does not converge; the segment is named.
        """
        return self._bay_by_bay(X, nodes) if self._condensation is None else self._together(X, nodes)

    def _bay_by_bay(self, start: Array, nodes: CurveNodes) -> Array:
        X = np.array(start)
        d = np.zeros(self._columns)
        for k, system in enumerate(self._systems):
            segment = system.segment
            own = segment.nodes
            # The first step is taken from the old configuration of the bays below too, and passes their motion on.
            system.evaluate(start)
            A, before = system.matrices()
            residual = system.residual(nodes.position[k], nodes.frame[k])
            step = least_norm(A, residual - before @ d[segment.first : segment.start])
            for _ in range(MAX_CORRECTIONS):
                if not float(np.max(np.abs(step))) <= self._furthest:
                    raise SolverError(
                        f"tracking: Newton's method diverges in the bay below face {segment.face}"
                    )
                X[own] += step.reshape(-1, 3)
                system.evaluate(X)
                residual = system.residual(nodes.position[k], nodes.frame[k])
                small = float(np.max(np.abs(residual))) <= LENGTH_TOLERANCE
                if small and segment.is_square:
                    break
                A, _ = system.matrices()
                if segment.is_square:
                    step = least_norm(A, residual)
                    continue
                travelled = (X[own] - start[own]).ravel()
                step = least_norm(A, residual + A @ travelled) - travelled
                if small and float(np.max(np.abs(step))) <= _STILL:
                    break
            else:
                raise SolverError(
                    f"tracking: Newton's method does not converge in the bay below face {segment.face}"
                )
            d[segment.start : segment.start + segment.columns] = (X[own] - start[own]).ravel()
        return X

    def _together(self, start: Array, nodes: CurveNodes) -> Array:
        assert self._condensation is not None
        X, free, condensation = np.array(start), self._free, self._condensation
        for _ in range(MAX_CORRECTIONS):
            self._kinematics.evaluate(X)
            residuals = condensation.residuals(X, nodes)
            small = max(float(np.max(np.abs(residual))) for residual in residuals) <= LENGTH_TOLERANCE
            if small and condensation.is_square:
                return X
            step = condensation.step(residuals, (X[free] - start[free]).ravel())
            largest = float(np.max(np.abs(step)))
            if small and largest <= _STILL:
                return X
            if not largest <= self._furthest:
                raise SolverError("tracking: Newton's method on all bays at once diverges")
            X[free] += step.reshape(-1, 3)
        raise SolverError("tracking: Newton's method on all bays at once does not converge")
