"""From the ``[truss]`` or ``[arm]`` table of a problem to its arm."""

from __future__ import annotations

from vgtm_qp.arm.arm import Arm
from vgtm_qp.arm.serial.arm import SerialArm
from vgtm_qp.arm.serial.build import build_chain
from vgtm_qp.arm.truss.arm import TrussArm
from vgtm_qp.arm.truss.build import LockError, build_truss
from vgtm_qp.errors import Mistake, ProblemError
from vgtm_qp.problem import Problem
from vgtm_qp.problem.table import shown


def make_arm(problem: Problem) -> Arm:
    """Return the arm of a problem.

    Raises
    ------
    ProblemError
        A locked member is no actuated one.
    TrussError
        The truss is not statically determinate.
    """
    if problem.arm is not None:
        return SerialArm(build_chain(problem.arm))
    assert problem.truss is not None
    try:
        return TrussArm(build_truss(problem.truss))
    except LockError as error:
        wrong = [Mistake(f"truss.locked[{place}]", shown(name), said) for place, name, said in error.wrong]
        raise ProblemError(str(problem.source or problem.name), wrong) from None
