"""QP solvers by name.

Each solves the QP condensed onto the actuators; for long arms it solves the small QPs of the eliminations
along the bays.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from vgtm_qp.arrays import Array
from vgtm_qp.errors import SolverError, nearest
from vgtm_qp.parts import find_part, part_names
from vgtm_qp.qp.answer import StepSolution
from vgtm_qp.qp.condensed import CondensedSolver
from vgtm_qp.qp.daqp import DAQP
from vgtm_qp.qp.dense import DenseAnswer, DenseQP, DenseSolver, check_question
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.long.select import chain_solver, prefers_staged
from vgtm_qp.qp.numbers import StepNumbers, infinite
from vgtm_qp.qp.own import OwnSolver
from vgtm_qp.qp.residual import AnswerError, InfeasibleStepError, NoAnswerError

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


def available_solvers() -> list[str]:
    """Return the names that `dense_solver` accepts, the default first."""
    import qpsolvers

    others = {"osqp", "piqp", *qpsolvers.available_solvers, *part_names("solver")}
    return [DEFAULT_SOLVER, *sorted(others - {DEFAULT_SOLVER})]


def dense_solver(name: str) -> DenseSolver:
    """Return a solver of dense QPs by its name, for the QPs of one arm, whose sizes do not change.

    Raises
    ------
    SolverError
        There is no such solver, or it is not installed; the message lists those that are.
    PartError
        The name is that of a solver of the user's own, which cannot be imported.
    """
    if name == DEFAULT_SOLVER:
        return DAQP
    own = find_part("solver", name)
    if own is not None:
        return OwnSolver(name, own)
    choices = available_solvers()
    if name not in choices:
        raise SolverError(
            f'no solver "{name}" is installed{nearest(name, choices)}; choices: {", ".join(choices)}'
        )
    if name == "osqp":
        # Imported only if it is asked for: the import takes a tenth of a second.
        from vgtm_qp.qp.osqp import Osqp

        return Osqp()
    return _QpSolvers(name)


def make_solver(name: str, layout: Layout) -> StepSolver:
    """Return the solver called `name` for QPs of `layout`; raises SolverError as `dense_solver` does."""
    solver = dense_solver(name)
    along = chain_solver(layout, solver) if prefers_staged(layout) else None
    return along or CondensedSolver(layout, solver)


_TIGHT: Mapping[str, Mapping[str, float]] = {
    "clarabel": {"tol_feas": 1e-10, "tol_gap_abs": 1e-12, "tol_gap_rel": 1e-12},
    # The complementarity gap must be small enough to distinguish active from nearly active rows.
    "piqp": {
        "eps_abs": 1e-10,
        "eps_rel": 1e-12,
        "eps_duality_gap_abs": 1e-13,
        "eps_duality_gap_rel": 1e-13,
    },
    "proxqp": {"eps_abs": 1e-9, "eps_rel": 0.0, "check_duality_gap": True, "eps_duality_gap_abs": 1e-9},
    "scs": {"eps_abs": 1e-9, "eps_rel": 1e-9},
}
"""Options with which the answers pass the residual check; with these solvers' defaults they would not."""


class _QpSolvers(DenseSolver):
    """Any solver of qpsolvers, by name."""

    accuracy = 1e-8

    def __init__(self, name: str) -> None:
        import qpsolvers

        self._name = name
        self._matrix = np.asarray if name in qpsolvers.dense_solvers else sparse.csc_matrix

    def ask(self, qp: DenseQP) -> DenseAnswer:
        """See :class:`vgtm_qp.qp.dense.DenseSolver`."""
        import qpsolvers

        check_question(self._name, qp)
        (hessian, gradient, constraint, lower, upper, _), bounded = qp, qp.bounded
        box = [np.full(len(gradient), bound) for bound in (-np.inf, np.inf)]
        box[0][:bounded], low = np.split(infinite(lower), [bounded])
        box[1][:bounded], high = np.split(infinite(upper), [bounded])
        equal = low == high
        below, above = ~equal & (high < np.inf), ~equal & (low > -np.inf)
        sides = np.concatenate([constraint[below], -constraint[above]])
        problem = qpsolvers.Problem(
            self._matrix(hessian),
            gradient,
            self._matrix(sides) if len(sides) else None,
            np.concatenate([high[below], -low[above]]) if len(sides) else None,
            self._matrix(constraint[equal]) if equal.any() else None,
            low[equal] if equal.any() else None,
            *box,
        )
        answer = self._solved(problem)
        y = np.zeros(len(low))
        if equal.any():
            y[equal] = answer.y
        if len(sides):
            count = np.count_nonzero(below)
            y[below] += answer.z[:count]
            y[above] -= answer.z[count:]
        # The multipliers of the bounds follow from stationarity.
        of_bounds = -(hessian @ answer.x + gradient + y @ constraint)[:bounded]
        return DenseAnswer(np.array(answer.x), np.concatenate([of_bounds, y]), 0, self._name)

    def _solved(self, problem: Any) -> Any:
        """Return the ``qpsolvers.Solution``.

        Raises
        ------
        InfeasibleStepError, AnswerError
            The solver says that there is no answer, or found none, or failed.
        """
        import qpsolvers

        try:
            answer = qpsolvers.solve_problem(problem, solver=self._name, **_TIGHT.get(self._name, {}))
        except (qpsolvers.exceptions.QPError, ValueError) as error:
            raise AnswerError(f"{self._name}: {error}") from error
        if answer.found and answer.x is not None:
            return answer
        # The status stands in `extras` itself, or in a record of information there.
        status = answer.extras.get("status", getattr(answer.extras.get("info"), "status", ""))
        if "primalinfeasible" in str(status).lower().replace("_", ""):
            raise InfeasibleStepError(f"{self._name}: primal infeasible")
        raise NoAnswerError(f"{self._name} found no solution")
