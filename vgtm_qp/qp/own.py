"""A solver of dense QPs that a user brings."""

from __future__ import annotations

import numpy as np

from vgtm_qp.errors import PartError
from vgtm_qp.parts import Part
from vgtm_qp.qp.dense import DenseAnswer, DenseQP, DenseSolver, check_question
from vgtm_qp.qp.numbers import infinite
from vgtm_qp.qp.residual import AnswerError, NoAnswerError


class OwnSolver(DenseSolver):
    """Solves by a function of the user's own; its answers are checked.

    The function gets the QP

        minimise  1/2 x' P x + q' x   subject to   lower <= A x <= upper

    as arrays (n, n), (n,), (m, n), (m,), (m,) of its own, with P positive definite, infinite bounds where there are
    none, and equal ones for equalities. It returns x (n,) and multipliers y (m,), P x + q + A' y = 0, positive at an
    upper and negative at a lower bound; None if it finds no answer. A class is made once for each arm, without
    arguments, and its object is called: so it can keep a workspace. Its attribute ``accuracy`` is the greatest
    violation of a row by its answers, m or rad; 1e-8 without it.
    """

    def __init__(self, name: str, part: Part) -> None:
        self._name = name
        self._solve = part() if isinstance(part, type) else part
        self.accuracy = float(getattr(self._solve, "accuracy", 1e-8))

    def ask(self, qp: DenseQP) -> DenseAnswer:
        """See :class:`vgtm_qp.qp.dense.DenseSolver`; PartError where the function returns no such arrays."""
        check_question(self._name, qp)
        (hessian, gradient, constraint, lower, upper, _), size = qp, len(qp.gradient)
        rows = np.concatenate([np.eye(size)[: qp.bounded], constraint])
        try:
            answer = self._solve(hessian.copy(), gradient.copy(), rows, infinite(lower), infinite(upper))
        except (ValueError, ArithmeticError) as error:
            raise AnswerError(f"{self._name}: {error}") from error
        if answer is None:
            raise NoAnswerError(f"{self._name} found no solution")
        try:
            x, multipliers = (np.array(part, dtype=float) for part in answer)
        except (TypeError, ValueError):
            raise self._unfit(f"{type(answer).__name__}", size, len(lower)) from None
        if x.shape != (size,) or multipliers.shape != (len(lower),):
            raise self._unfit(f"arrays of the shapes {x.shape} and {multipliers.shape}", size, len(lower))
        return DenseAnswer(x, multipliers, 0, self._name)

    def _unfit(self, found: str, size: int, rows: int) -> PartError:
        return PartError(
            f'the solver "{self._name}" returned {found}; expected two arrays, the answer ({size},) and the '
            f"multipliers ({rows},), or None"
        )
