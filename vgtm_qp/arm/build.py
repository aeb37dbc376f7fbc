"""From the ``[truss]`` or ``[arm]`` table of a problem to its arm."""

from __future__ import annotations

from collections.abc import Iterator

from vgtm_qp.arm.arm import Arm
from vgtm_qp.arm.serial.arm import SerialArm
from vgtm_qp.arm.truss.arm import TrussArm
from vgtm_qp.arm.truss.build import LockError, build_truss
from vgtm_qp.errors import Mistake
from vgtm_qp.problem import Problem
from vgtm_qp.problem.arm import ArmTable
from vgtm_qp.problem.table import shown


def make_arm(problem: Problem) -> Arm:
    """Return the arm of a problem.

    Raises
    ------
    ProblemError
        A locked member is not actuated, the joints make an arm that cannot move, or the truss is not
        statically determinate.
    """
    if problem.arm is not None:
        mistakes = list(_beyond_serial(problem, problem.arm))
        if mistakes:
            raise problem.error(mistakes)
        return SerialArm(problem.arm)
    assert problem.truss is not None
    with problem.blaming(("truss",), "nodes and members of a statically determinate truss"):
        try:
            return TrussArm(build_truss(problem.truss))
        except LockError as error:
            wrong = [
                Mistake(f"truss.locked[{place}]", shown(name), said) for place, name, said in error.wrong
            ]
            raise problem.error(wrong) from None


def _beyond_serial(problem: Problem, spec: ArmTable) -> Iterator[Mistake]:
    """Yield the mistakes of joints with which a serial arm has no extent, or no bound of its reach."""
    if not any(any(joint.position) for joint in spec.joint[1:]) and not any(spec.tip):
        expected = "a position away from the last joint, since all joints are in one place"
        yield problem.mistake(("arm", "tip"), expected)
    for k, joint in enumerate(spec.joint):
        if joint.kind == "prismatic" and joint.limits is None:
            expected = "[least, greatest], m: how far a joint slides bounds how far the arm reaches"
            yield problem.mistake(("arm", "joint", k, "limits"), expected)
