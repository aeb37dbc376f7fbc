"""QP solvers by name.

DAQP solves the condensed QP, for long arms by eliminations along the chain of bays; PIQP, OSQP and the solvers of
qpsolvers solve the full QP.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from vgtm_qp.arrays import Array
from vgtm_qp.errors import SolverError, nearest
from vgtm_qp.qp.answer import StepSolution
from vgtm_qp.qp.condensed import CondensedSolver
from vgtm_qp.qp.full import FullBuilder, StepQP
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.long.select import chain_solver, prefers_staged
from vgtm_qp.qp.numbers import StepNumbers
from vgtm_qp.qp.residual import AnswerError, InfeasibleStepError, NoAnswerError, refuse_large, relative

DEFAULT_SOLVER = "daqp"


class StepSolver(Protocol):
    """Solves the QP of a step.

    Attributes
    ----------
    settles : str
        How its answers are settled: by all "equalities", by the "curve" that stations follow, or by the "strokes" that
        :meth:`gain` changes.
    """

    settles: str

    def solve(self, numbers: StepNumbers) -> StepSolution:
        """Return the solution; raise ``InfeasibleStepError`` or ``SolverError`` instead of a wrong one."""
        ...

    def gain(self, held: NDArray[np.bool_]) -> Array | None:
        """Return the least changes (n_a, n_e) of the actuators per unit of tip error; `held` ones (n_a,) rest."""
        ...


class _Answer(Protocol):
    def __call__(self, qp: StepQP, *, same_structure: bool) -> tuple[Array, Array, Array, int]:
        """Return z, row multipliers, column multipliers, iterations."""
        ...


def available_solvers() -> list[str]:
    """Return the names that `make_solver` accepts, the default first."""
    import qpsolvers

    return [DEFAULT_SOLVER, *sorted({"osqp", "piqp", *qpsolvers.sparse_solvers} - {DEFAULT_SOLVER})]


def make_solver(name: str, layout: Layout) -> StepSolver:
    """Return the solver called `name` for QPs of `layout`.

    Raises
    ------
    SolverError
        There is no such solver, or it is not installed; the message lists those that are.
    """
    if name == DEFAULT_SOLVER:
        solver = chain_solver(layout) if prefers_staged(layout) else None
        return solver or CondensedSolver(layout)
    if name == "osqp":
        return FullSolver(layout, name, _Osqp())
    if name == "piqp":
        return FullSolver(layout, name, _Piqp())
    choices = available_solvers()
    if name not in choices:
        raise SolverError(
            f'no solver "{name}" is installed{nearest(name, choices)}; choices: {", ".join(choices)}'
        )
    return FullSolver(layout, name, _QpSolvers(name))


class FullSolver:
    """Builds the full QP, has it solved, and checks the residuals whatever the solver's status."""

    settles = "equalities"

    def __init__(self, layout: Layout, name: str, answer: _Answer) -> None:
        self.builder = FullBuilder(layout)
        self._name, self._answer = name, answer
        self._structure: object = None

    def solve(self, numbers: StepNumbers) -> StepSolution:
        """Solve one QP.

        Raises
        ------
        InfeasibleStepError
            The solver found that the hard rows contradict one another.
        AnswerError
            The solver failed, or its answer has residuals that are too large.
        """
        qp = self.builder.build(numbers)
        same, self._structure = self.builder.structure == self._structure, None
        if np.any(qp.row_lower > qp.row_upper) or np.any(qp.column_lower > qp.column_upper):
            raise InfeasibleStepError("a lower bound is above its upper bound")
        z, y, w, iterations = self._answer(qp, same_structure=same)
        if not all(np.isfinite(part).all() for part in (z, y, w)):
            refuse_large(np.nan, np.nan, self._name)
        scale = relative(1.0, qp.q, y)
        dual = max(scale * qp.dual_residual(z, y, w), qp.complementarity_residual(z, scale * y, scale * w))
        refuse_large(qp.primal_residual(z), dual, self._name)
        # Only an accurate answer is a warm start: NaN would stay in the solver for ever.
        self._structure = self.builder.structure
        return self.builder.solution(z, y, w, iterations)

    def gain(self, held: NDArray[np.bool_]) -> Array | None:  # noqa: ARG002
        """See :class:`StepSolver`."""
        return None


def _column_multipliers(qp: StepQP, z: Array, y: Array) -> Array:
    """Return the multipliers of the column bounds that stationarity implies."""
    return np.asarray(-(qp.P @ z + qp.q + qp.A.T @ y))


class _Osqp:
    """OSQP through its own set-up, update and warm start."""

    def __init__(self) -> None:
        self._solver: object = None

    def __call__(self, qp: StepQP, *, same_structure: bool) -> tuple[Array, Array, Array, int]:
        import osqp

        bounded = np.flatnonzero(np.isfinite(qp.column_lower) | np.isfinite(qp.column_upper))
        lower = np.concatenate([qp.row_lower, qp.column_lower[bounded]])
        upper = np.concatenate([qp.row_upper, qp.column_upper[bounded]])
        size = qp.A.shape[1]
        identity = sparse.csc_matrix(
            (np.ones(len(bounded)), (np.arange(len(bounded)), bounded)), shape=(len(bounded), size)
        )
        A = sparse.vstack([qp.A, identity], format="csc")
        P = sparse.triu(qp.P, format="csc")
        if self._solver is None or not same_structure:
            solver = osqp.OSQP()
            solver.setup(
                P,
                qp.q,
                A,
                lower,
                upper,
                verbose=False,
                eps_abs=1e-9,
                eps_rel=1e-9,
                eps_prim_inf=1e-9,
                max_iter=100_000,
                polishing=True,
                check_termination=50,
                adaptive_rho_interval=50,
            )
            self._solver = solver
        else:
            solver = self._solver
            solver.update(q=qp.q, l=lower, u=upper, Px=P.data, Ax=A.data)  # type: ignore[attr-defined]
        result = solver.solve()
        status = str(result.info.status)
        if "primal infeasible" in status:
            raise InfeasibleStepError(f"osqp: {status}")
        if result.x is None or not np.all(np.isfinite(result.x)):
            raise AnswerError(f"osqp: {status}")
        rows = len(qp.row_lower)
        w = np.zeros(size)
        w[bounded] = result.y[rows:]
        return result.x, result.y[:rows], w, int(result.info.iter)


class _Piqp:
    """PIQP's sparse interior-point method through its own set-up and update."""

    def __init__(self) -> None:
        self._solver: object = None

    def __call__(self, qp: StepQP, *, same_structure: bool) -> tuple[Array, Array, Array, int]:
        import piqp

        equal = qp.row_lower == qp.row_upper
        A, G = qp.A[equal], qp.A[~equal]
        data = {
            "c": qp.q,
            "A": sparse.csc_matrix(A),
            "b": qp.row_lower[equal],
            "G": sparse.csc_matrix(G),
            "h_l": qp.row_lower[~equal],
            "h_u": qp.row_upper[~equal],
            "x_l": qp.column_lower,
            "x_u": qp.column_upper,
        }
        if self._solver is None or not same_structure:
            solver = piqp.SparseSolver()
            solver.settings.eps_abs = 1e-10
            solver.settings.eps_rel = 1e-12
            # The complementarity gap must be small enough to tell an active row from a nearly active one.
            solver.settings.eps_duality_gap_abs = 1e-13
            solver.settings.eps_duality_gap_rel = 1e-13
            solver.settings.verbose = False
            solver.setup(qp.P, **data)
            self._solver = solver
        else:
            solver = self._solver
            solver.update(P=qp.P, **data)  # type: ignore[attr-defined]
        status = solver.solve()
        if status == piqp.PIQP_PRIMAL_INFEASIBLE:
            raise InfeasibleStepError("piqp: primal infeasible")
        result = solver.result
        z = np.array(result.x)
        y = np.zeros(len(qp.row_lower))
        y[equal] = result.y
        y[~equal] = result.z_u - result.z_l
        return z, y, _column_multipliers(qp, z, y), int(result.info.iter)


_TIGHT: Mapping[str, Mapping[str, float]] = {
    "clarabel": {"tol_feas": 1e-9, "tol_gap_abs": 1e-9, "tol_gap_rel": 1e-9},
    "proxqp": {"eps_abs": 1e-9, "eps_rel": 0.0, "check_duality_gap": True, "eps_duality_gap_abs": 1e-9},
    "scs": {"eps_abs": 1e-9, "eps_rel": 1e-9},
}
"""Options with which solvers' answers pass the residual check; by their defaults they would not."""


class _QpSolvers:
    """Any other solver, by its name in qpsolvers."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __call__(self, qp: StepQP, *, same_structure: bool) -> tuple[Array, Array, Array, int]:  # noqa: ARG002
        import qpsolvers

        equal = qp.row_lower == qp.row_upper
        problem = qpsolvers.Problem(
            qp.P,
            qp.q,
            -qp.A[~equal],
            -qp.row_lower[~equal],
            qp.A[equal],
            qp.row_lower[equal],
            qp.column_lower,
            qp.column_upper,
        )
        try:
            answer = qpsolvers.solve_problem(problem, solver=self._name, **_TIGHT.get(self._name, {}))
        except (qpsolvers.exceptions.QPError, ValueError) as error:
            raise AnswerError(f"{self._name}: {error}") from error
        if not answer.found or answer.x is None:
            raise NoAnswerError(f"{self._name} found no solution")
        y = np.zeros(len(qp.row_lower))
        y[equal] = answer.y
        y[~equal] = -np.asarray(answer.z)
        return answer.x, y, _column_multipliers(qp, answer.x, y), 0
