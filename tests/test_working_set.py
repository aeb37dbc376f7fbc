"""The QP that is tried with the working set of the one before, against DAQP alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from arms import TRUSSES
from steps import asked_at_random, curved

from vgtm_qp.compiled import compiler
from vgtm_qp.errors import SolverError
from vgtm_qp.native import building
from vgtm_qp.qp.daqp import DAQP
from vgtm_qp.qp.dense import DenseAnswer, DenseQP, DenseSolver
from vgtm_qp.qp.fused import FusedSolver
from vgtm_qp.qp.residual import AnswerError, InfeasibleStepError

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")


class Listening(DenseSolver):
    """DAQP by Python, which keeps the last QP that it was asked and its answer."""

    accuracy = DAQP.accuracy

    def __init__(self) -> None:
        self.answer: DenseAnswer | None = None

    def ask(self, qp: DenseQP) -> DenseAnswer:
        self.answer = DAQP.ask(qp)
        return self.answer


@pytest.mark.dear
@pytest.mark.property
@pytest.mark.parametrize("curve", ["none", "tables", "hard", "hard turns"])
@pytest.mark.parametrize("name", ["octahedral", "hexapod", "longeron"])
def test_it_gives_the_answers_of_daqp_whatever_was_asked_before(name, curve, rng):
    assert building().finish() is not None
    layout = curved(TRUSSES[name](), ("position",), curve)
    listening = Listening()
    ours, other = FusedSolver(layout), FusedSolver(layout, listening)
    assert ours.is_ready
    assert other.is_ready
    bound, answered = 0, 0
    for seed in rng.integers(2**31, size=90).tolist():
        draws = np.random.default_rng(seed)
        asked, rows = asked_at_random(layout, seed, base=False, progress=0.0, motion=True)
        # Boxes of all sizes about the present values, some of them points; rows that press and others.
        half = 0.5 * (asked.upper - asked.lower) * draws.choice([0.0, 1e-3, 0.1, 1.0], len(asked.lower))
        middle = 0.5 * (asked.upper + asked.lower)
        asked = asked._replace(lower=middle - half, upper=middle + half)
        rows = replace(rows, lower=draws.choice([-1.0, -1e-3, 1e-4], len(rows)))
        for solver in (ours, other):
            solver.load(asked)
        try:
            wanted = other.solve(rows)
        except AnswerError:
            # Random configurations may be all but singular.
            continue
        except InfeasibleStepError:
            with pytest.raises(SolverError):
                ours.solve(rows)
            continue
        found = ours.solve(rows)
        scale = 1.0 + np.abs(wanted.nodes).max()
        for field in ("nodes", "actuators", "vertices", "progress"):
            np.testing.assert_allclose(getattr(found, field), getattr(wanted, field), atol=1e-9 * scale)
        forces = 1.0 + np.abs(wanted.actuator_multipliers).max() + wanted.clearance_multipliers.sum()
        for field in ("actuator_multipliers", "clearance_multipliers"):
            np.testing.assert_allclose(getattr(found, field), getattr(wanted, field), atol=1e-7 * forces)
        bound += np.count_nonzero(found.actuator_multipliers) + np.count_nonzero(found.clearance_multipliers)
        answered += 1
    assert answered > 3
    assert bound > answered
