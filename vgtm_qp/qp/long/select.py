"""Choice of arms that are long and regular enough for a solver whose cost is linear in the bays."""

from __future__ import annotations

from vgtm_qp.qp.daqp import DAQP
from vgtm_qp.qp.dense import DenseSolver
from vgtm_qp.qp.layout import Layout
from vgtm_qp.qp.long.chain import find_chain
from vgtm_qp.qp.long.staged import StagedSolver
from vgtm_qp.qp.long.tracked import TrackedSolver

STAGED_ACTUATORS, SWEPT_ACTUATORS = 70, 36
"""Least number of actuators with which elimination along the chain is faster than condensing onto the actuators: by
NumPy, and in whole steps by C.
"""


def chain_solver(layout: Layout, solver: DenseSolver = DAQP) -> StagedSolver | TrackedSolver | None:
    """Return the solver along the chain of `layout`; None without a chain, or if chains cannot have its rows.

    The dense QPs of the elimination are for `solver`.
    """
    if layout.general is not None or layout.hard_turns or layout.elastic_tip:
        return None
    chain = find_chain(layout)
    if chain is None:
        return None
    if layout.hard_tracking:
        return TrackedSolver(chain, solver) if chain.is_square else None
    return StagedSolver(chain, solver)


def prefers_staged(layout: Layout) -> bool:
    """Whether a `chain_solver` for `layout`, if there is one, is faster than the condensed QP by NumPy."""
    return len(layout.arm.actuators) >= STAGED_ACTUATORS and layout.is_tabled


def prefers_sweeps(layout: Layout) -> bool:
    """Whether whole steps by a `chain_solver`, if there is one, are faster than by the condensed QP.

    The answer is the same with and without a compiler, since the two settle to different states.
    """
    return len(layout.arm.actuators) >= SWEPT_ACTUATORS and layout.is_tabled
