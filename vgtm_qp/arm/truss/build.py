"""From the ``[truss]`` table of a problem to the truss."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from vgtm_qp.arm.truss.graph import truss_from_graph
from vgtm_qp.arm.truss.modules import stacked, tetrahedral
from vgtm_qp.arm.truss.truss import Truss
from vgtm_qp.errors import TrussError, nearest
from vgtm_qp.problem.truss import GraphTruss, ModuleTruss, TetrahedralTruss


class LockError(TrussError):
    """Locked members are not actuated ones; `wrong` has place in the list, name and expectation of each."""

    def __init__(self, wrong: Sequence[tuple[int, str, str]]) -> None:
        super().__init__(wrong)
        self.wrong = wrong

    def __str__(self) -> str:
        return "\n".join(
            f'locked[{place}]: found "{name}"; expected {expected}' for place, name, expected in self.wrong
        )


def build_truss(spec: ModuleTruss | TetrahedralTruss | GraphTruss) -> Truss:
    """Build the truss of a problem; members locked from the start are fixed at their home length.

    Locks with a later time are left to the maneuver.

    Raises
    ------
    TrussError
        The truss is not statically determinate.
    LockError
        A locked member is not an actuated one.
    """
    truss = _unlocked(spec)
    _check_actuated(truss, [lock.member for lock in spec.locked])
    return lock_members(truss, [lock.member for lock in spec.locked if lock.time == 0.0])


def lock_members(truss: Truss, names: Iterable[str]) -> Truss:
    """Return the truss with actuated members fixed at their home length."""
    locked = np.array([truss.member(name) for name in names], dtype=np.int64)
    actuated, stroke = truss.actuated.copy(), truss.stroke.copy()
    rate, acceleration = truss.rate.copy(), truss.acceleration.copy()
    actuated[locked] = False
    stroke[locked] = truss.home_lengths[locked, None]
    rate[locked] = acceleration[locked] = np.inf
    return dataclasses.replace(truss, actuated=actuated, stroke=stroke, rate=rate, acceleration=acceleration)


def _unlocked(spec: ModuleTruss | TetrahedralTruss | GraphTruss) -> Truss:
    if isinstance(spec, GraphTruss):
        return truss_from_graph(spec)
    return tetrahedral(spec) if isinstance(spec, TetrahedralTruss) else stacked(spec)


def _check_actuated(truss: Truss, names: Sequence[str]) -> None:
    actuated = [truss.member_names[k] for k in truss.actuators]
    some = f"{', '.join(actuated[:6])}{', ...' if len(actuated) > 6 else ''}"
    wrong = []
    for place, name in enumerate(names):
        if name not in actuated:
            fixed = name in truss.member_names
            hint = "; this one has a fixed length" if fixed else nearest(name, actuated)
            wrong.append(
                (place, name, f"the name of one of the {len(actuated)} actuated members {some}{hint}")
            )
    if wrong:
        raise LockError(wrong)
