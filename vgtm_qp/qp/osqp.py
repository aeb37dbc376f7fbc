"""OSQP on the dense QP of a step: set up once, updated by values, and started from its last answer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import osqp
from scipy import sparse

from vgtm_qp.qp.dense import DenseAnswer, DenseQP, DenseSolver, check_question, residuals
from vgtm_qp.qp.numbers import UNBOUNDED
from vgtm_qp.qp.residual import TOLERANCE, AnswerError, InfeasibleStepError, refuse_large

_SPARE = 8
"""Rows that a new workspace has beyond those of the first QP."""

_SETTINGS = {"verbose": False, "polishing": True, "check_termination": 10}

FIRST = {
    "eps_abs": 1e-6,
    "eps_rel": 1e-6,
    "eps_prim_inf": 1e-9,
    "max_iter": 2_000,
    "adaptive_rho_interval": 50,
    # Unknowns and rows are in m and rad already. Scaling by OSQP takes several times the iterations.
    "scaling": 0,
}
"""Settings with which polishing finds the answer of nearly every QP. Intervals are in iterations, not by time."""

_SELDOM = {
    "eps_abs": 1e-8,
    "eps_rel": 1e-8,
    "eps_prim_inf": 1e-7,
    "max_iter": 30_000,
    "adaptive_rho_interval": 2_000,
}
AGAIN = ({**_SELDOM, "scaling": 0, "rho": 0.03}, {**_SELDOM, "scaling": 10, "rho": 1.0})
"""Settings of further tries, for QPs on which polishing failed or the step size `rho` went to and fro.

On 43 such QPs, infeasible ones among them, the first settings decided all, alone of all that were tried. The
second settings solve QPs whose rows nearly contradict one another.
"""

_NEAR = 1e-4
"""Residual below which a further try starts from the answer so far; a worse start would delay it."""


class Osqp(DenseSolver):
    """OSQP, with a workspace that is used again.

    All rows of the workspace are dense. Unused rows are zero and have infinite bounds, so that the sparsity
    does not change when near pairs come and go.
    """

    accuracy = 1e-8

    def __init__(self) -> None:
        self._workspace: _OsqpWorkspace | None = None
        self._further: list[_OsqpWorkspace] = []

    def ask(self, qp: DenseQP) -> DenseAnswer:
        """See :class:`vgtm_qp.qp.dense.DenseSolver`."""
        check_question("osqp", qp)
        workspace = self._workspace_for(len(qp.gradient), qp.bounded, len(qp.constraint))
        # A workspace is used again only after an accurate answer, or a proof that there is none: a poor
        # answer would start the next QP far off.
        self._workspace = None
        try:
            answer = workspace.solved(qp)
            off = np.inf if answer is None else max(residuals(answer, qp))
            if not off <= self.accuracy:
                answer = self._again(workspace, answer, off, qp)
        except InfeasibleStepError:
            self._workspace = workspace
            raise
        assert answer is not None
        self._workspace = workspace
        return answer

    def _workspace_for(self, size: int, bounded: int, rows: int) -> _OsqpWorkspace:
        """Return the workspace in use, a larger one that starts from its answer, or an unused one."""
        old = self._workspace
        if old is None or old.sizes[:2] != (size, bounded):
            return _OsqpWorkspace(size, bounded, rows + _SPARE, FIRST)
        if rows <= old.sizes[2]:
            return old
        return _OsqpWorkspace(size, bounded, max(rows, 2 * old.sizes[2]), FIRST, start=old.last)

    def _again(
        self, workspace: _OsqpWorkspace, answer: DenseAnswer | None, off: float, qp: DenseQP
    ) -> DenseAnswer:
        """Return an accurate answer by further tries after one of residual `off`; the next QP starts there.

        Raises
        ------
        InfeasibleStepError, AnswerError
            There is no answer, or none is accurate.
        """
        if not self._further or self._further[0].sizes != workspace.sizes:
            self._further = [_OsqpWorkspace(*workspace.sizes, settings) for settings in AGAIN]
        for further in self._further:
            further.restart(answer if off <= _NEAR else None)
            found = further.solved(qp)
            apart = np.inf if found is None else max(residuals(found, qp))
            if apart <= off:
                answer, off = found, apart
            if off <= TOLERANCE:
                break
        if answer is None:
            raise AnswerError("osqp: neither an answer nor a proof that there is none")
        refuse_large(*residuals(answer, qp), answer.status)
        workspace.start(answer)
        return answer


class _OsqpWorkspace:
    """OSQP with room for QPs of `size` unknowns, the first `bounded` of them with bounds, and `capacity` rows.

    Its constraints are an identity over the unknowns with bounds, and dense rows below it.

    Attributes
    ----------
    sizes : tuple of int
        ``size``, ``bounded``, ``capacity``.
    last : DenseAnswer or None
        The last answer, from which iterations start.
    """

    def __init__(
        self,
        size: int,
        bounded: int,
        capacity: int,
        settings: Mapping[str, float],
        *,
        start: DenseAnswer | None = None,
    ) -> None:
        self.sizes, self.last, self._settings = (size, bounded, capacity), start, settings
        self._bounded, self._used = bounded, bounded + capacity
        self._hessian = sparse.triu(np.ones((size, size)), format="csc")
        self._upper_triangle = np.flatnonzero(np.tri(size).reshape(-1))
        self._constraint = sparse.vstack([sparse.eye(bounded, size), np.ones((capacity, size))], format="csc")
        self._constraint.sort_indices()
        # Columns in order, those of bounded unknowns first: each of these begins with an entry of the
        # identity.
        first, rest = np.split(self._constraint.data, [bounded * (capacity + 1)])
        self._first = first.reshape(bounded, capacity + 1)[:, 1:]
        self._rest = rest.reshape(size - bounded, capacity)
        self._lower, self._upper = np.zeros(self._used), np.zeros(self._used)
        self._solver: Any = None

    def start(self, answer: DenseAnswer | None) -> None:
        """Start the iterations of the next QP from `answer`, or from zero."""
        unknowns, multipliers = np.zeros(self.sizes[0]), np.zeros(len(self._lower))
        if answer is not None:
            unknowns, multipliers[: len(answer.multipliers)] = answer.x, answer.multipliers
        self._solver.warm_start(x=unknowns, y=multipliers)

    def restart(self, answer: DenseAnswer | None) -> None:
        """Start the next iterations from `answer`, or from zero, with the step size of a new workspace."""
        self.last = answer
        if self._solver is not None:
            self._solver.update_settings(rho=self._settings["rho"])
            self.start(answer)

    def solved(self, qp: DenseQP) -> DenseAnswer | None:
        """Return the answer by iterations from the last one and by polishing; None if OSQP finds none.

        Raises
        ------
        InfeasibleStepError
            OSQP proved that there is no answer.
        """
        self._load(qp)
        result = self._solver.solve(raise_error=False)
        status, x, y, self.last = f"osqp: {result.info.status}", result.x, result.y, None
        if result.info.status_val == osqp.SolverStatus.OSQP_PRIMAL_INFEASIBLE:
            raise InfeasibleStepError(status)
        if x is None or not (np.isfinite(x).all() and np.isfinite(y).all()):
            return None
        multipliers = np.array(y[: self._used])
        self.last = DenseAnswer(np.array(x), multipliers, int(result.info.iter), status)
        return self.last

    def _load(self, qp: DenseQP) -> None:
        """Write a QP; unknowns and multipliers stay those of the last answer."""
        hessian, gradient, constraint, lower, upper, _ = qp
        rows, self._used = len(constraint), len(lower)
        np.take(hessian, self._upper_triangle, out=self._hessian.data)
        self._first[:, :rows] = constraint[:, : self._bounded].T
        self._rest[:, :rows] = constraint[:, self._bounded :].T
        self._first[:, rows:] = self._rest[:, rows:] = 0.0
        self._lower[: self._used], self._lower[self._used :] = lower, -UNBOUNDED
        self._upper[: self._used], self._upper[self._used :] = upper, UNBOUNDED
        vectors = {"q": gradient, "l": self._lower, "u": self._upper}
        if self._solver is not None:
            self._solver.update(**vectors, Px=self._hessian.data, Ax=self._constraint.data)
            return
        self._solver = osqp.OSQP()
        self._solver.setup(self._hessian, A=self._constraint, **vectors, **_SETTINGS, **self._settings)
        if self.last is not None:
            self.start(self.last)
